"""Coordinates in which a posterior's funnel is straight.

The less process noise, the tighter what learns of the dynamics is held to the readings: along log Sigma the posterior
is a funnel. Its tip is high and holds next to nothing. On Cherry's problem the conditional widths of 34 coefficients
change until the maximum a posteriori lies two decades of Sigma and many nats of mass away from where the posterior is,
and no linear coordinates fit both. So the conditional optimum and its Laplace covariance are followed along log Sigma,
and what is sampled is the distance from the one in units of the other, as in nested Laplace approximations (Rue et al.,
2009, J. R. Stat. Soc. B 71, 319). The measurement noise Gamma makes a funnel as well, a narrow one whose widths grow
steadily: k coefficients that it holds with widths of Gamma^1/2 put the mass k/2 squared widths of log Gamma above the
optimum. The change of coordinates is exact; only how well it fits is approximate.
"""

import dataclasses
import sys
import time
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.interpolate import PchipInterpolator
from scipy.special import ndtri_exp

from ._descent import coordinates
from ._fit import Estimate
from ._information import reference_widths
from ._log_posterior import gradient
from ._parameters import flatten
from ._posterior import LogPosterior
from ._sampler import Drawn, LogDensity, possible

# How far apart the levels of log Sigma are, how many there may be on each side, and nats below the highest at the last.
_STEP, _MOST, _ENOUGH = 1.0, 18, 9.0
# How far the mass may lie from the conditional optimum, in widths of the measurement noise.
_FARTHEST = 4.0
# Beyond so many standard deviations the widths grow no more, and quantiles go on straight; and how far their knots are.
_FAR, _KNOT = 6.0, 0.5
# How far beyond the levels the mass is followed, at how many places, and how slowly it may fall a level there.
_TAIL, _FINE, _SLOWEST = 60.0, 20_000, 0.1
# The widths have come to rest where their product changes by less than this share from one level to the next.
_AT_REST = 0.05
# Lengths of a step of Newton's method that are tried, each half the one before.
_LENGTHS = 8
# With more parameters than this the conditional covariances would cost more than they save.
_LARGEST = 100


class Funnel(eqx.Module):
    """Straight coordinates (a, w), all of them about N(0, 1): a along log Sigma, the first of w, w0, along log Gamma.

    free = axes (s, mean(s) + root(s) (e(s, w0) w)), where s(a) has the quantiles of the mass along log Sigma, and
    e = exp(growth(s) w0) are the widths in units of those at w0 = 0; of w0 itself it is 1. `levels` (level,) of s, with
    `means` (level, rest), `roots` (level, rest, rest) and `growths` (level, rest), between which is interpolated
    linearly; beyond the last ones they are constant. `quantiles` (interval, 4) are s(a)'s cubics.
    """

    axes: Float[Array, "parameter parameter"]
    levels: Float[Array, " level"]
    means: Float[Array, "level rest"]
    roots: Float[Array, "level rest rest"]
    growths: Float[Array, "level rest"]
    quantiles: Float[Array, "interval 4"]

    def free(self, straight: Float[Array, " parameter"]) -> Float[Array, " parameter"]:
        """The free coordinates of straight ones."""
        s, _ = self._along(straight[0])
        mean, root, grown = self._at(s, straight[1])
        return self.axes @ jnp.concatenate([s[None], mean + root @ (jnp.exp(grown) * straight[1:])])

    def log_volume(self, straight: Float[Array, " parameter"]) -> Float[Array, ""]:
        """log |d free / d straight|; the roots are triangular."""
        s, slope = self._along(straight[0])
        _, root, grown = self._at(s, straight[1])
        return jnp.log(slope) + jnp.sum(jnp.log(jnp.diagonal(root)) + grown)

    def _along(self, a: Array) -> tuple[Array, Array]:
        """s(a) and its slope; straight on beyond the last knots."""
        inside = jnp.clip(a, -_FAR, _FAR)
        k = jnp.clip(jnp.floor((inside + _FAR) / _KNOT).astype(int), 0, len(self.quantiles) - 1)
        c3, c2, c1, c0 = self.quantiles[k]
        x = inside - (k * _KNOT - _FAR)
        slope = (3 * c3 * x + 2 * c2) * x + c1
        return ((c3 * x + c2) * x + c1) * x + c0 + slope * (a - inside), slope

    def _at(self, s: Array, w0: Array) -> tuple[Array, Array, Array]:
        k = jnp.clip(jnp.searchsorted(self.levels, s) - 1, 0, self.levels.size - 2)
        share = jnp.clip((s - self.levels[k]) / (self.levels[k + 1] - self.levels[k]), 0.0, 1.0)
        tables = (self.means, self.roots, self.growths)
        mean, root, growth = ((1 - share) * one[k] + share * one[k + 1] for one in tables)
        return mean, root, growth * jnp.clip(w0, -_FAR, _FAR)


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
    """One level: conditional optimum, root of the conditional covariance, the growth of the widths for each width of
    log Gamma, and the log of the mass there."""

    s: float
    mean: np.ndarray
    root: np.ndarray
    growth: np.ndarray
    mass: float

    @property
    def middle(self) -> float:
        """Where along log Gamma the mass is: exp(-x^2 / 2) times the volume, which grows as exp(sum(growth) x)."""
        return min(float(np.sum(self.growth)), _FARTHEST)


def funnel_of(estimate: Estimate, density: LogPosterior) -> Funnel | None:
    """The funnel of an estimate's posterior along its process noise; None where none learns, or nothing else does, or
    too much, or the likelihood has no derivatives there."""
    process = getattr(estimate.model, "process_noise", None)
    if process is None:
        return None
    marks = np.asarray(coordinates(estimate.model, lambda m: m.process_noise))
    if not 0 < marks.sum() < marks.size or marks.size > _LARGEST:
        return None
    measurement = _of_measurement(estimate.model)
    axes = _axes(marks, measurement)
    walk = _Walk(density, axes, np.asarray(reference_widths(estimate)), bool(measurement.any()))
    levels = walk.all(np.asarray(flatten(estimate.model)[0]))
    return None if len(levels) < 2 else _funnel(walk.axes, levels)


def _of_measurement(model: Any) -> np.ndarray:
    """1 at the free coordinates of a measurement noise, else 0."""
    if getattr(model, "measurement_noise", None) is None:
        return np.zeros(flatten(model)[0].size)
    return np.asarray(coordinates(model, lambda m: m.measurement_noise))


def _axes(process: np.ndarray, measurement: np.ndarray) -> np.ndarray:
    """An orthonormal basis: along all process noises together, along all measurement noises if any, the rest by
    place."""
    first = [one / np.linalg.norm(one) for one in (process, measurement) if one.any()]
    others = np.delete(np.eye(process.size), [int(np.argmax(one)) for one in first], axis=1)
    basis, upper = np.linalg.qr(np.column_stack([*first, others]))
    return basis * np.sign(np.diagonal(upper))


def _funnel(axes: np.ndarray, levels: list[_Level]) -> Funnel:
    # Always as many levels, or what walks on it would be compiled anew for each posterior; the last one is repeated.
    more = 2 * _MOST + 1 - len(levels)
    filled = [*levels, *([levels[-1]] * more)]
    s = np.array([one.s for one in levels])
    return Funnel(
        jnp.asarray(axes),
        jnp.concatenate([jnp.asarray(s), s[-1] + _STEP * jnp.arange(1.0, more + 1)]),
        jnp.asarray([one.mean + one.root[:, 0] * one.middle for one in filled]),
        jnp.asarray([one.root * np.exp(one.growth * one.middle) for one in filled]),
        jnp.asarray([one.growth for one in filled]),
        jnp.asarray(_quantiles(s, np.array([one.mass for one in levels]))),
    )


def _quantiles(s: np.ndarray, mass: np.ndarray) -> np.ndarray:
    """Cubics (interval, 4) of s(a), increasing, for which a is normal where s has this log mass at its levels."""
    log_mass = PchipInterpolator(s, mass)
    fine = np.linspace(s[0] - _TAIL, s[-1] + _TAIL, _FINE)
    inside = np.clip(fine, s[0], s[-1])
    # Beyond the levels it falls on as it did, at least a little.
    falls = np.where(fine < s[0], max(mass[1] - mass[0], _SLOWEST), min(mass[-1] - mass[-2], -_SLOWEST)) / _STEP
    logs = log_mass(inside) + falls * (fine - inside)
    below, above = np.logaddexp.accumulate(logs), np.logaddexp.accumulate(logs[::-1])[::-1]
    total = below[-1]
    # Half of each place's own mass is on either side of it.
    half = logs - np.log(2.0)
    left, right = (one + np.log1p(-np.exp(half - one)) - total for one in (below, above))
    a = np.where(left < right, ndtri_exp(left), -ndtri_exp(right))
    knots = np.linspace(-_FAR, _FAR, round(2 * _FAR / _KNOT) + 1)
    return PchipInterpolator(knots, np.interp(knots, a, fine)).c.T


class _Walk:
    """From level to level, each time one step of Newton's method with a search along it."""

    def __init__(self, density: LogPosterior, axes: np.ndarray, widths: np.ndarray, measured: bool):
        self.density, self.axes, self.began = density, axes, time.monotonic()
        # Of the readings' information only what is more than the priors' counts, in units of the priors' widths.
        self.scales = np.sqrt(np.sum((axes[:, 1:] * widths[:, None]) ** 2, axis=0))
        self.measured = measured

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
        values, slopes, hessian = self._differences(place, None if last is None else last.root)
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
        level = _Level(float(place[0]), place[1:], root, self._growth(place, root), 0.0)
        middle, volume = level.middle, float(np.sum(np.log(np.diagonal(root))))
        gained = middle * (float(np.sum(level.growth)) - 0.5 * middle)
        return level._replace(mass=float(values) + volume + gained)

    def _growth(self, place: np.ndarray, root: np.ndarray) -> np.ndarray:
        """How the logarithms of the widths grow over one width of log Gamma."""
        none = np.zeros(place.size - 1)
        if not self.measured:
            return none
        _, _, hessian = self._differences(place + np.concatenate([[0.0], root[:, 0]]), root)
        if not np.all(np.isfinite(hessian)):
            return none
        # More noise cannot tell more, and widths do not grow faster than it.
        grown = np.clip(np.log(np.diagonal(self._root(hessian)) / np.diagonal(root)), 0.0, 1.0)
        return np.concatenate([[0.0], grown[1:]])

    def _differences(self, place: np.ndarray, root: np.ndarray | None) -> tuple[float, np.ndarray, np.ndarray]:
        """Value and slope of the log posterior, and the Hessian of minus the log likelihood in all but s."""
        size = place.size - 1
        sds = self.scales * 1e-3 if root is None else np.sqrt(np.sum(root**2, axis=1))
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
