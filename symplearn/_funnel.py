"""Coordinates in which a posterior's funnel is straight.

The less process noise, the tighter what learns of the dynamics is held to the readings: along log Sigma the posterior
is a funnel. Its tip is high and holds next to nothing. On Cherry's problem the conditional widths of 34 coefficients
change until the maximum a posteriori lies two decades of Sigma and many nats of mass away from where the posterior is,
and no linear coordinates fit both. So the conditional optimum and its Laplace covariance are followed along log Sigma,
and what is sampled is the distance from the one in units of the other, as in nested Laplace approximations (Rue et al.,
2009, J. R. Stat. Soc. B 71, 319). The change of coordinates is exact; only how well it fits is approximate.
"""

import dataclasses
import sys
import time
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.special import softmax

from ._descent import coordinates
from ._fit import Estimate
from ._information import reference_widths
from ._log_posterior import gradient
from ._parameters import flatten
from ._posterior import LogPosterior
from ._sampler import Drawn, LogDensity, possible

# How far apart the levels of log Sigma are, how many there may be on each side, and nats below the highest at the last.
_STEP, _MOST, _ENOUGH = 1.0, 18, 9.0
# The widths have come to rest where their product changes by less than this share from one level to the next.
_AT_REST = 0.05
# Lengths of a step of Newton's method that are tried, each half the one before.
_LENGTHS = 8
# With more parameters than this the conditional covariances would cost more than they save.
_LARGEST = 100


class Funnel(eqx.Module):
    """Straight coordinates (s, w), with free = axes (s, mean(s) + root(s) w): s along log Sigma, w about N(0, 1).

    `levels` (level,) of s, with the conditional `means` (level, rest) and `roots` (level, rest, rest), between which is
    interpolated linearly; beyond the last ones they are constant. `centre` (parameter,) is the middle of the mass in
    straight coordinates.
    """

    axes: Float[Array, "parameter parameter"]
    levels: Float[Array, " level"]
    means: Float[Array, "level rest"]
    roots: Float[Array, "level rest rest"]
    centre: Float[Array, " parameter"]

    def free(self, straight: Float[Array, " parameter"]) -> Float[Array, " parameter"]:
        """The free coordinates of straight ones."""
        mean, root = self._at(straight[0])
        return self.axes @ jnp.concatenate([straight[:1], mean + root @ straight[1:]])

    def log_volume(self, straight: Float[Array, " parameter"]) -> Float[Array, ""]:
        """log |d free / d straight|; the roots are triangular."""
        return jnp.sum(jnp.log(jnp.diagonal(self._at(straight[0])[1])))

    def _at(self, s: Array) -> tuple[Array, Array]:
        k = jnp.clip(jnp.searchsorted(self.levels, s) - 1, 0, self.levels.size - 2)
        share = jnp.clip((s - self.levels[k]) / (self.levels[k + 1] - self.levels[k]), 0.0, 1.0)
        means, roots = self.means, self.roots
        return (1 - share) * means[k] + share * means[k + 1], (1 - share) * roots[k] + share * roots[k + 1]


class Straightened(eqx.Module):
    """A log density over straight coordinates."""

    density: LogDensity
    funnel: Funnel

    def __call__(self, straight: Float[Array, " parameter"]) -> Float[Array, ""]:
        return possible(self.density(self.funnel.free(straight))) + self.funnel.log_volume(straight)


def bent_back(drawn: Drawn, funnel: Funnel) -> Drawn:
    """Draws of straight coordinates in free ones."""
    free, log_volume = _bent(funnel, drawn.free)
    return dataclasses.replace(drawn, free=free, log_density=drawn.log_density - log_volume)


@eqx.filter_jit
def _bent(funnel, draws):
    return tuple(jax.vmap(jax.vmap(one))(draws) for one in (funnel.free, funnel.log_volume))


class _Level(NamedTuple):
    """One level: conditional optimum, root of the conditional covariance, and the log of the mass there."""

    s: float
    mean: np.ndarray
    root: np.ndarray
    mass: float


def funnel_of(estimate: Estimate, density: LogPosterior) -> Funnel | None:
    """The funnel of an estimate's posterior along its process noise; None where none learns, or nothing else does, or
    too much, or the likelihood has no derivatives there."""
    process = getattr(estimate.model, "process_noise", None)
    if process is None:
        return None
    marks = np.asarray(coordinates(estimate.model, lambda m: m.process_noise))
    if not 0 < marks.sum() < marks.size or marks.size > _LARGEST:
        return None
    walk = _Walk(density, _axes(marks), np.asarray(reference_widths(estimate)))
    levels = walk.all(np.asarray(flatten(estimate.model)[0]))
    return None if len(levels) < 2 else _funnel(walk.axes, levels)


def _axes(marks: np.ndarray) -> np.ndarray:
    """An orthonormal basis whose first column is along all process noises together, the rest by place."""
    first = marks / np.linalg.norm(marks)
    others = np.eye(marks.size)[:, np.delete(np.arange(marks.size), np.argmax(marks))]
    basis, upper = np.linalg.qr(np.column_stack([first, others]))
    return basis * np.sign(np.diagonal(upper))


def _funnel(axes: np.ndarray, levels: list[_Level]) -> Funnel:
    s, mass = np.array([one.s for one in levels]), np.array([one.mass for one in levels])
    # Always as many levels, or what walks on it would be compiled anew for each posterior; the last one is repeated.
    more = 2 * _MOST + 1 - len(levels)
    filled = [*levels, *([levels[-1]] * more)]
    return Funnel(
        jnp.asarray(axes),
        jnp.concatenate([jnp.asarray(s), s[-1] + _STEP * jnp.arange(1.0, more + 1)]),
        jnp.asarray([one.mean for one in filled]),
        jnp.asarray([one.root for one in filled]),
        jnp.zeros(len(axes)).at[0].set(softmax(mass) @ s),
    )


class _Walk:
    """From level to level, each time one step of Newton's method with a search along it."""

    def __init__(self, density: LogPosterior, axes: np.ndarray, widths: np.ndarray):
        self.density, self.axes, self.began = density, axes, time.monotonic()
        # Of the readings' information only what is more than the priors' counts, in units of the priors' widths.
        self.scales = np.sqrt(np.sum((axes[:, 1:] * widths[:, None]) ** 2, axis=0))

    def all(self, free: np.ndarray) -> list[_Level]:
        """The levels in order, from the estimate to both sides until little is left, or nothing changes any more."""
        place = self.axes.T @ free
        begin = self._level(place, None)
        if begin is None:
            return []
        above = self._side(begin, 1.0, begin.mass)
        highest = max(one.mass for one in above)
        return [*self._side(begin, -1.0, highest)[:0:-1], *above]

    def _side(self, begin: _Level, way: float, highest: float) -> list[_Level]:
        """The levels from the first one on, to one side."""
        found = [begin]
        while len(found) <= _MOST:
            new = self._next(found[-1], found[-1].s + way * _STEP)
            if new is None:
                break
            found.append(new)
            highest = max(highest, new.mass)
            calm = abs(_log_det(new) - _log_det(found[-2])) < _AT_REST
            if new.mass < highest - _ENOUGH or (way < 0 and calm):
                break
        return found

    def _next(self, last: _Level, s: float) -> _Level | None:
        if time.monotonic() - self.began > 2.0:
            print(f"sample: following the process noise, log variance near {s:.1f}", file=sys.stderr, flush=True)
            self.began = time.monotonic() + 8.0
        return self._level(np.concatenate([[s], last.mean]), last)

    def _level(self, place: np.ndarray, last: _Level | None) -> _Level | None:
        values, slopes, hessian = self._differences(place, last)
        if not (np.isfinite(values) and np.all(np.isfinite(slopes)) and np.all(np.isfinite(hessian))):
            return None
        root = self._root(hessian)
        if last is not None:
            lengths = 0.5 ** np.arange(_LENGTHS)
            step = np.concatenate([[0.0], root @ (root.T @ slopes[1:])])
            tried = np.asarray(_values(self.density, self.axes, place + lengths[:, None] * step))
            best = int(np.argmax(np.where(np.isfinite(tried), tried, -np.inf)))
            if tried[best] > values:
                place, values = place + lengths[best] * step, tried[best]
        return _Level(float(place[0]), place[1:], root, float(values + np.sum(np.log(np.diagonal(root)))))

    def _differences(self, place: np.ndarray, last: _Level | None) -> tuple[float, np.ndarray, np.ndarray]:
        """Value and slope of the log posterior, and the Hessian of minus the log likelihood in all but s."""
        size = place.size - 1
        sds = self.scales * 1e-3 if last is None else np.sqrt(np.sum(last.root**2, axis=1))
        steps = np.zeros((size, place.size))
        # To one side, by a hundredth of a standard deviation: a per cent is more than enough for a preconditioner.
        steps[:, 1:] = np.diag(1e-2 * np.minimum(sds, self.scales))
        found = _values_and_slopes(self.density, self.axes, np.concatenate([place[None], place + steps]))
        values, slopes, of_likelihood = (np.asarray(one) for one in found)
        hessian = (of_likelihood[0, 1:] - of_likelihood[1:, 1:]) / np.diagonal(steps[:, 1:])[:, None]
        return float(values[0]), slopes[0], 0.5 * (hessian + hessian.T)

    def _root(self, hessian: np.ndarray) -> np.ndarray:
        scaled = hessian * np.outer(self.scales, self.scales)
        eigenvalues, vectors = np.linalg.eigh(scaled)
        half = self.scales[:, None] * vectors / np.sqrt(1.0 + np.maximum(eigenvalues, 0.0))
        return np.linalg.cholesky(half @ half.T)


def _log_det(level: _Level) -> float:
    return float(np.sum(np.log(np.diagonal(level.root))))


@eqx.filter_jit
def _values(density, axes, places):
    """The log posterior at each place, one after the other."""
    return jax.lax.map(lambda place: density(axes @ place), places)


@eqx.filter_jit
def _values_and_slopes(density, axes, places):
    """Log posterior, its slope, and that of the log likelihood alone, at each place, one after the other."""
    size = axes.shape[0]
    rebuild = flatten(density.model)[1]

    def likelihood(place):
        return -density.objective(rebuild(axes @ place), density.series)

    def prior(place):
        return density.prior.log_density(rebuild(axes @ place))

    def one(place):
        of_likelihood = gradient(likelihood, size)(place)
        return density(axes @ place), of_likelihood + jax.grad(prior)(place), of_likelihood

    return jax.lax.map(one, places)
