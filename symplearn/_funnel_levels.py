"""The levels of a posterior's funnel: along log Sigma, where the rest is and how wide, and how much mass there is."""

import functools
import sys
import time
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from scipy.special import logsumexp, ndtri

from ._importance import kish, softened
from ._lane_loops import with_lane_loops
from ._log_posterior import gradient
from ._noise import AdditiveGaussian
from ._parameters import flatten, resolve
from ._posterior import LogPosterior
from ._sampler import TOGETHER
from ._student_mixture import shrunk

# How far apart the levels of log Sigma are, how many there may be on each side, and nats below the highest at the last.
STEP, MOST, _ENOUGH = 1.0, 18, 9.0
# Beyond so many standard deviations of log Gamma the widths grow no more.
FAR = 6.0
# How far the mass may lie from the conditional optimum, in widths of the measurement noise.
_FARTHEST = 4.0
# The widths have come to rest where their product changes by less than this share from one level to the next.
_AT_REST = 0.05
# Lengths of a step of Newton's method that are tried, each half the one before.
_LENGTHS = 8
# Draws a level is weighed by, in how many rounds at most, how much wider than it, the least effective number, and the
# share of effective ones from which on another round changes little.
_DRAWS, _ROUNDS, _WIDER, _LEAST, _FITS = 512, 3, 1.1, 5.0, 1 / 3


class Level(NamedTuple):
    """One level of log Sigma: the optimum there, `mode`, and Laplace's root of the covariance, `laplace`; mean and root
    of the mass itself; how the logarithms of the widths grow along one width of log Gamma; the log of the mass; and
    whether a normal of that mean and root came near the mass."""

    s: float
    mode: np.ndarray
    laplace: np.ndarray
    mean: np.ndarray
    root: np.ndarray
    growth: np.ndarray
    mass: float = 0.0
    fits: bool = False


class Walk:
    """From level to level, each time one step of Newton's method with a search along it."""

    def __init__(self, density: LogPosterior, axes: np.ndarray, widths: np.ndarray, measured: bool):
        self.density, self.axes, self.began = density, axes, time.monotonic()
        # Of the readings' information only what is more than the priors' counts, in units of the priors' widths.
        self.scales = np.sqrt(np.sum((axes[:, 1:] * widths[:, None]) ** 2, axis=0))
        self.measured = measured

    def all(self, free: np.ndarray) -> list[Level]:
        """The levels in order, from the estimate to both sides until little is left, or nothing changes any more."""
        place = self.axes.T @ free
        begin = self._level(place, None)
        if begin is None:
            return []
        above = self._side(begin, 1.0, begin.mass)
        highest = max(one.mass for one in above)
        return [*self._side(begin, -1.0, highest)[:0:-1], *above]

    def _side(self, begin: Level, way: float, highest: float) -> list[Level]:
        """The levels from the first one on, to one side."""
        found = [begin]
        while len(found) <= MOST:
            new = self._next(found[-1], found[-1].s + way * STEP)
            if new is None:
                break
            found.append(new)
            highest = max(highest, new.mass)
            calm = abs(_log_det(new) - _log_det(found[-2])) < _AT_REST
            if new.mass < highest - _ENOUGH or (way < 0 and calm):
                break
        return found

    def _next(self, last: Level, s: float) -> Level | None:
        if time.monotonic() - self.began > 2.0:
            print(f"sample: following the process noise, log variance near {s:.1f}", file=sys.stderr, flush=True)
            self.began = time.monotonic() + 8.0
        return self._level(np.concatenate([[s], last.mode]), last)

    def _level(self, place: np.ndarray, last: Level | None) -> Level | None:
        value, slopes, hessian = self._differences(place, None if last is None else last.laplace)
        if not (np.isfinite(value) and np.all(np.isfinite(slopes)) and np.all(np.isfinite(hessian))):
            return None
        root = self._root(hessian)
        if last is not None:
            lengths = 0.5 ** np.arange(_LENGTHS)
            step = np.concatenate([[0.0], root @ (root.T @ slopes[1:])])
            tried = self._values(place + lengths[:, None] * step)
            best = int(np.argmax(tried))
            if tried[best] > value:
                place = place + lengths[best] * step
        growth = self._growth(place, root)
        s, mode = float(place[0]), place[1:]
        if last is not None and last.fits:
            # What the draws said of the level before is most of what they will say of this one.
            moved = root @ np.linalg.inv(last.laplace)
            level = Level(s, mode, root, mode + moved @ (last.mean - last.mode), moved @ last.root, growth)
        else:
            # exp(-x^2 / 2) times the volume, which grows as exp(sum(growth) x), is the greatest at x = sum(growth).
            middle = min(float(np.sum(growth)), _FARTHEST)
            level = Level(s, mode, root, mode + root[:, 0] * middle, root * np.exp(growth * middle), growth)
        return self._weighed(level, _ROUNDS)

    def _weighed(self, level: Level, rounds: int) -> Level | None:
        """The level with its mass by importance sampling, and mean and root moved towards those of the draws."""
        z = _WIDER * _normal(level.mode.size)
        grown = level.growth * np.clip(z[:, :1], -FAR, FAR)
        free = level.mean + (np.exp(grown) * z) @ level.root.T
        found = self._values(np.column_stack([np.full(len(z), level.s), free]))
        log_volume = np.sum(np.log(np.diagonal(level.root))) + np.sum(grown, axis=1)
        # The normal density's constant is that of every level, and left out.
        log_weights = found + log_volume + 0.5 * np.sum((z / _WIDER) ** 2, axis=1)
        if not np.any(np.isfinite(log_weights)):
            return None
        weights = softened(log_weights, least=_LEAST * (level.mode.size + 1))
        level = level._replace(
            mean=level.mean + level.root @ (weights @ z),
            root=level.root @ np.linalg.cholesky(shrunk(z, weights)),
            mass=float(logsumexp(log_weights)),
            fits=kish(log_weights) >= _FITS * len(z),
        )
        return level if level.fits or rounds == 1 else self._weighed(level, rounds - 1)

    def _growth(self, place: np.ndarray, root: np.ndarray) -> np.ndarray:
        """How the logarithms of the widths grow over one width of log Gamma."""
        none = np.zeros(place.size - 1)
        if not self.measured:
            return none
        shifted = place + np.concatenate([[0.0], root[:, 0]])
        _, _, hessian = self._differences(shifted, root)
        if not np.all(np.isfinite(hessian)):
            return none
        # More noise cannot tell more, and widths do not grow faster than it; all else is the likelihood's own bend.
        before, after = _log_noise(self.density, self.axes, np.stack([place, shifted]))
        most = max(float(after - before), 0.0)
        grown = np.clip(np.log(np.diagonal(self._root(hessian)) / np.diagonal(root)), 0.0, most)
        return np.concatenate([[0.0], grown[1:]])

    def _values(self, places: np.ndarray) -> np.ndarray:
        """The log posterior at some places, -inf where it is not a number; in chunks of two sizes, compiled once."""
        each = TOGETHER if len(places) <= TOGETHER else _DRAWS
        size = -(-len(places) // each) * each
        chunks = np.resize(places, (size, places.shape[1])).reshape(-1, each, places.shape[1])
        found = np.concatenate([_values(self.density, self.axes, jnp.asarray(one)) for one in chunks])[: len(places)]
        return np.where(np.isfinite(found), found, -np.inf)

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


def _log_det(level: Level) -> float:
    return float(np.sum(np.log(np.diagonal(level.laplace))))


@functools.cache
def _normal(size: int) -> np.ndarray:
    """Points (draw, parameter) that fill a standard normal evenly, the same ones at every level."""
    from scipy.stats import qmc  # slow to import, and nothing else here needs it

    # Scrambled, by a number that is part of the rule: unscrambled the first of Sobol's points is at 0.
    return ndtri(qmc.Sobol(size, rng=0).random(_DRAWS))


@eqx.filter_jit
def _log_noise(density, axes, places):
    """The logarithm of the measurement noise's standard deviation at each place, the mean of its directions."""
    rebuild = flatten(density.model)[1]

    def one(place):
        noise = resolve(rebuild(axes @ place)).measurement_noise
        if not isinstance(noise, AdditiveGaussian):
            return place[1]
        return 0.5 * jnp.linalg.slogdet(noise.covariance())[1] / len(noise.covariance())

    return jax.vmap(one)(places)


@eqx.filter_jit
def _values(density, axes, places):
    return jax.vmap(with_lane_loops(lambda place: density(axes @ place)))(places)


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
