"""Coordinates in which a posterior's funnel is straight.

The less process noise, the tighter what learns of the dynamics is held to the readings: along log Sigma the posterior
is a funnel. Its tip is high and holds next to nothing. On Cherry's problem the conditional widths of 34 coefficients
change until the maximum a posteriori lies two decades of Sigma and many nats of mass away from where the posterior is,
and no linear coordinates fit both. So the conditional optimum and its Laplace covariance are followed along log Sigma,
as in nested Laplace approximations (Rue et al., 2009, J. R. Stat. Soc. B 71, 319), each is moved towards mean and
covariance of some draws, and what is sampled is the distance from the one in units of the other. The measurement noise
Gamma makes a funnel as well, a narrow one whose widths grow steadily: k coefficients that it holds with widths of
Gamma^1/2 put the mass k/2 squared widths of log Gamma above the optimum. The change of coordinates is exact; only how
well it fits is approximate.
"""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.interpolate import PchipInterpolator
from scipy.special import ndtri_exp

from ._descent import coordinates
from ._fit import Estimate
from ._funnel_levels import FAR, MOST, STEP, Level, Walk
from ._information import reference_widths
from ._parameters import flatten
from ._posterior import LogPosterior
from ._sampler import Drawn, LogDensity, possible

# How far apart the quantiles' knots are, in standard deviations; beyond the last ones they go on straight.
_KNOT = 0.5
# How far beyond the levels the mass is followed, at how many places, and how slowly it may fall a level there.
_TAIL, _FINE, _SLOWEST = 60.0, 20_000, 0.1
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
        inside = jnp.clip(a, -FAR, FAR)
        k = jnp.clip(jnp.floor((inside + FAR) / _KNOT).astype(int), 0, len(self.quantiles) - 1)
        c3, c2, c1, c0 = self.quantiles[k]
        x = inside - (k * _KNOT - FAR)
        slope = (3 * c3 * x + 2 * c2) * x + c1
        return ((c3 * x + c2) * x + c1) * x + c0 + slope * (a - inside), slope

    def _at(self, s: Array, w0: Array) -> tuple[Array, Array, Array]:
        k = jnp.clip(jnp.searchsorted(self.levels, s) - 1, 0, self.levels.size - 2)
        share = jnp.clip((s - self.levels[k]) / (self.levels[k + 1] - self.levels[k]), 0.0, 1.0)
        tables = (self.means, self.roots, self.growths)
        mean, root, growth = ((1 - share) * one[k] + share * one[k + 1] for one in tables)
        return mean, root, growth * jnp.clip(w0, -FAR, FAR)


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
    walk = Walk(density, axes, np.asarray(reference_widths(estimate)), bool(measurement.any()))
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


def _funnel(axes: np.ndarray, levels: list[Level]) -> Funnel:
    # Always as many levels, or what walks on it would be compiled anew for each posterior; the last one is repeated.
    more = 2 * MOST + 1 - len(levels)
    filled = [*levels, *([levels[-1]] * more)]
    s = np.array([one.s for one in levels])
    return Funnel(
        jnp.asarray(axes),
        jnp.concatenate([jnp.asarray(s), s[-1] + STEP * jnp.arange(1.0, more + 1)]),
        jnp.asarray([one.mean for one in filled]),
        jnp.asarray([one.root for one in filled]),
        jnp.asarray([one.growth for one in filled]),
        jnp.asarray(_quantiles(s, np.array([one.mass for one in levels]))),
    )


def _quantiles(s: np.ndarray, mass: np.ndarray) -> np.ndarray:
    """Cubics (interval, 4) of s(a), increasing, for which a is normal where s has this log mass at its levels."""
    log_mass = PchipInterpolator(s, mass)
    fine = np.linspace(s[0] - _TAIL, s[-1] + _TAIL, _FINE)
    inside = np.clip(fine, s[0], s[-1])
    # Beyond the levels it falls on as it did, at least a little.
    falls = np.where(fine < s[0], max(mass[1] - mass[0], _SLOWEST), min(mass[-1] - mass[-2], -_SLOWEST)) / STEP
    logs = log_mass(inside) + falls * (fine - inside)
    below, above = np.logaddexp.accumulate(logs), np.logaddexp.accumulate(logs[::-1])[::-1]
    total = below[-1]
    # Half of each place's own mass is on either side of it.
    half = logs - np.log(2.0)
    left, right = (one + np.log1p(-np.exp(half - one)) - total for one in (below, above))
    a = np.where(left < right, ndtri_exp(left), -ndtri_exp(right))
    knots = np.linspace(-FAR, FAR, round(2 * FAR / _KNOT) + 1)
    return PchipInterpolator(knots, np.interp(knots, a, fine)).c.T
