"""The bootstrap particle filter: Algorithm 1 by Monte Carlo, the yardstick of the Gaussian approximation.

Gordon, Salmond and Smith (1993). Its likelihood is an unbiased estimate of (2.4) whatever the noises and however few
the particles (Del Moral 2004): where the Gaussian filter's differs by more than its scatter, the moments are to blame.
"""

import enum
import math
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.scipy.special import logsumexp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, PyTree

from ._counts import refuse_count
from ._distributions import MultivariateNormal
from ._errors import InputError
from ._faults import IMPOSSIBLE
from ._hidden_markov import HiddenMarkovModel
from ._keys import refuse_key
from ._model import AbstractStateSpaceModel, slice_at
from ._noise import Additive, Dense, Multiplicative
from ._parameters import resolve
from ._simulate import draw_initial, draw_state, own_parts, same_size, sampled


class ParticleFault(enum.IntEnum):
    """Why a particle filter's result is not to be trusted; NONE where it is.

    After any other the log density is -1e15 nats and later moments mean nothing.
    """

    NONE = 0
    STATE = 1
    DENSITY = 2
    WEIGHTLESS = 3


_SENTENCES = {
    ParticleFault.NONE: "no fault",
    ParticleFault.STATE: "no particle's state is finite: the trajectories escaped, or a noise's covariance is not "
    "positive semi-definite",
    ParticleFault.DENSITY: "the density of the reading given the state is not a number, as for measurement noise with "
    "a singular covariance",
    ParticleFault.WEIGHTLESS: "all weights are zero: no particle gives the reading any density",
}


class SystematicResampling(eqx.Module):
    """Systematic resampling where the effective sample size falls below `share` of the particles. Kitagawa (1996).

    A share of 1 resamples wherever weights differ, 0 never. Another rule is a module with `share` and `ancestors`.

    **Raises:** `ValueError` where the share is not between 0 and 1.
    """

    share: float = eqx.field(static=True, default=0.5)

    def __check_init__(self):
        if not 0.0 <= self.share <= 1.0:
            raise ValueError(f"`SystematicResampling` needs a share between 0 and 1, but was given {self.share}.")

    def ancestors(self, key: PRNGKeyArray, weights: Float[Array, " particle"]) -> Int[Array, " particle"]:
        """Indices of the particles to go on from; the expected number of copies is particles * weight."""
        count = weights.shape[0]
        heights = jnp.cumsum(weights)
        points = (jnp.arange(count) + jax.random.uniform(key)) / count
        # From the right, so that a particle without weight is never chosen; scaled, for sums that miss 1 by round-off.
        found = jnp.searchsorted(heights / heights[-1], points, side="right")
        return jnp.minimum(found, count - 1)


SYSTEMATIC = SystematicResampling()


class ParticleFiltered(eqx.Module):
    """What a particle filter says of the state at each of n readings.

    `log_likelihood` is the estimate in nats: its exponential is unbiased. `increments` add up to it. The filtered
    moments are those of the weighted particles given the readings so far. `effective_sizes` are 1 / sum of the squared
    weights, before resampling; `lost` is the share of weight, at each reading, of particles whose state or density
    was not finite: their weight is 0 from then on. `fault` and `fault_step` are the first `ParticleFault` and the
    reading it was met at (-1 for none); `str(filtered)` says it in words. `particles` and `log_weights` are those
    after the last reading.
    """

    log_likelihood: Float[Array, ""]
    increments: Float[Array, " time"]
    filtered_means: Float[Array, "time state"]
    filtered_covariances: Float[Array, "time state state"]
    effective_sizes: Float[Array, " time"]
    lost: Float[Array, " time"]
    particles: Float[Array, "particle state"]
    log_weights: Float[Array, " particle"]
    fault: Int[Array, ""]
    fault_step: Int[Array, ""]

    @property
    def ok(self) -> Bool[Array, "..."]:
        """Whether the filter came through."""
        return self.fault == int(ParticleFault.NONE)

    def __str__(self) -> str:
        text = (
            f"{self.particles.shape[0]} particles through {self.increments.shape[0]} readings: log likelihood "
            f"{float(self.log_likelihood):.6g} nats, effective size at least {float(jnp.min(self.effective_sizes)):.0f}"
        )
        if bool(self.ok):
            return text
        return f"{text}. FAILED at reading {int(self.fault_step)}: {_SENTENCES[ParticleFault(int(self.fault))]}"


class _Carry(NamedTuple):
    states: Array
    log_weights: Array
    log_likelihood: Array
    fault: Array
    fault_step: Array


class _Record(NamedTuple):
    increment: Array
    mean: Array
    covariance: Array
    effective_size: Array
    lost: Array


def particle_filter(
    model: AbstractStateSpaceModel,
    readings: Float[Array, "time channel"],
    intervals: PyTree,
    contexts: PyTree = None,
    *,
    key: PRNGKeyArray,
    particles: int = 1000,
    resampling: SystematicResampling | Any = SYSTEMATIC,
) -> ParticleFiltered:
    """Filter a recording by particles that move by the model and are weighed by the density of each reading.

    For a `StateSpaceModel` whose noises are distributions or have a `covariance`, and for a `HiddenMarkovModel` with
    `log_density_of_reading`. A measurement factor in front of additive noise is drawn for each particle, which keeps
    the likelihood unbiased; without additive noise its own density is used.

    **Arguments:** `readings`, `intervals`, `contexts` - as for `unscented_filter`, NaN where missing, in whole rows or
    in part; `key` - of `jax.random.key`, the same key gives the same answer; `particles` - how many, at least 2: the
    variance of the log likelihood falls as 1 / particles, and grows with the number of readings; `resampling` - the
    rule and its share.

    Works under `jit` and `vmap`. Resampling jumps as parameters move: the result has no derivative worth using.

    **Raises:** `InputError` where the density of a reading is not known, a noise cannot be drawn, sizes do not fit, or
    the model has no initial distribution.
    """
    refuse_key(key)
    refuse_count("particle_filter", "particles", particles, least=2)
    return _filter(resolve(model), jnp.asarray(readings), intervals, contexts, key, particles, resampling)


@eqx.filter_jit
def _filter(model, readings, intervals, contexts, key, particles, resampling) -> ParticleFiltered:
    initial_key, first_key, later_key = jax.random.split(key, 3)
    states = jax.vmap(lambda key: draw_initial(model, key))(jax.random.split(initial_key, particles))
    none = jnp.asarray(int(ParticleFault.NONE))
    start = _Carry(states, _equal(particles), jnp.zeros((), states.dtype), none, jnp.asarray(-1))
    carry, first = _weigh(model, start, states, readings[0], slice_at(contexts, 0), first_key, 0)

    def step(carry, data):
        reading, interval, context, key, k = data
        resample_key, move_key, weigh_key = jax.random.split(key, 3)
        carry = _resample(resampling, carry, resample_key)
        moved = jax.vmap(lambda x, key: draw_state(model, x, interval, key))(
            carry.states, jax.random.split(move_key, particles)
        )
        return _weigh(model, carry, moved, reading, context, weigh_key, k)

    count = readings.shape[0] - 1
    later_contexts = jax.tree.map(lambda leaf: leaf[1:], contexts)
    keys, counts = jax.random.split(later_key, count), jnp.arange(1, count + 1)
    carry, later = jax.lax.scan(step, carry, (readings[1:], intervals, later_contexts, keys, counts))
    history = [jnp.concatenate([one[None], rest]) for one, rest in zip(first, later, strict=True)]
    # The fields of `_Record` are those of `ParticleFiltered` between the log likelihood and the particles.
    return ParticleFiltered(
        *(carry.log_likelihood, *history, carry.states, carry.log_weights, carry.fault, carry.fault_step)
    )


def _equal(particles: int) -> Array:
    return jnp.full(particles, -math.log(particles))


def _resample(resampling, carry, key):
    """Equal weights on resampled particles, where the effective sample size is small."""
    weights, particles = jnp.exp(carry.log_weights), carry.log_weights.shape[0]
    few = _effective_size(weights) < resampling.share * particles
    chosen = jnp.where(few, resampling.ancestors(key, weights), jnp.arange(particles))
    kept = jnp.where(few, _equal(particles), carry.log_weights)
    return carry._replace(states=carry.states[chosen], log_weights=kept)


def _effective_size(weights):
    return 1.0 / jnp.sum(weights**2)


def _weigh(model, carry, states, reading, context, key, k):
    """Weights, moments and the increment of the log likelihood after one reading."""
    seen = ~jnp.isnan(reading)
    keys = jax.random.split(key, states.shape[0])
    log_densities = jax.vmap(lambda x, key: _log_density_of_reading(model, reading, seen, x, context, key))(
        states, keys
    )
    log_densities = jnp.where(jnp.any(seen), log_densities, 0.0)
    alive, finite = jnp.isfinite(carry.log_weights), jnp.all(jnp.isfinite(states), axis=1)
    usable = finite & (log_densities < jnp.inf)
    log_weights = jnp.where(usable, carry.log_weights + jnp.where(usable, log_densities, 0.0), -jnp.inf)
    increment = logsumexp(log_weights)
    holds = jnp.any(alive & finite), jnp.any(alive & usable), carry.log_likelihood + increment > IMPOSSIBLE
    faults = ParticleFault.STATE, ParticleFault.DENSITY, ParticleFault.WEIGHTLESS
    fault = jnp.select([~one for one in holds], [jnp.asarray(int(one)) for one in faults], int(ParticleFault.NONE))
    after = _accept(carry, jnp.where(finite[:, None], states, 0.0), log_weights - increment, increment, fault, k)
    weights = jnp.exp(after.log_weights)
    mean = weights @ after.states
    deviations = after.states - mean
    covariance = (weights[:, None] * deviations).T @ deviations
    lost = jnp.sum(jnp.where(usable, 0.0, jnp.exp(carry.log_weights)))
    gain = after.log_likelihood - carry.log_likelihood
    return after, _Record(gain, mean, covariance, _effective_size(weights), lost)


def _accept(carry, states, log_weights, increment, fault, k):
    """The next carry, or harmless zeros of equal weight from the first fault on."""
    none = int(ParticleFault.NONE)
    failed = (carry.fault != none) | (fault != none)
    first = jnp.where(carry.fault == none, fault, carry.fault)
    return _Carry(
        jnp.where(failed, 0.0, states),
        jnp.where(failed, _equal(states.shape[0]), log_weights),
        jnp.where(failed, IMPOSSIBLE, carry.log_likelihood + increment),
        first,
        jnp.where((carry.fault == none) & failed, k, carry.fault_step),
    )


def _log_density_of_reading(model, reading, seen, x, context, key):
    """log p(y | x), or for a factor before additive noise log p(y | x, v) with v drawn."""
    if isinstance(model, HiddenMarkovModel):
        if model.log_density_of_reading is None:
            raise InputError(
                "A particle filter needs the density of a reading given the state, which a `HiddenMarkovModel` does "
                "not have by itself; give it `log_density_of_reading(y, x, context)`, or write a `StateSpaceModel`."
            )
        return model.log_density_of_reading(reading, x, context)
    noiseless = own_parts(model).observation(x, context)
    same_size(reading, noiseless, "reading")
    return _log_density(model.measurement_noise, jnp.where(seen, reading, 0.0), seen, noiseless, context, key)


def _log_density(noise, y, seen, noiseless, record, key):
    if isinstance(noise, Multiplicative):
        if noise.additive is None:
            return _log_density_of_product(_dense(noise.factor), y, seen, noiseless)
        factor_key, key = jax.random.split(key)
        product = noiseless * same_size(sampled(noise.factor, factor_key), noiseless, "factor")
        return _log_density(noise.additive, y, seen, product, record, key)
    if isinstance(noise, Additive):
        same_size(noise.distribution.mean, noiseless, "additive noise")
        return _dense(noise.distribution).log_density(y - noiseless, seen)
    if not hasattr(noise, "covariance"):
        raise _no_density(noise)
    covariance = noise.covariance(record)
    same_size(jnp.diagonal(covariance), noiseless, "additive noise")
    return MultivariateNormal(jnp.zeros_like(noiseless), Dense(covariance)).log_density(y - noiseless, seen)


def _log_density_of_product(factor, y, seen, noiseless):
    """The density of y = h .* v from that of v: p(y / h) / |prod h|, which at h = 0 has none unless y is 0 too."""
    same_size(factor.mean, noiseless, "factor")
    usable = seen & (noiseless != 0.0)
    safe = jnp.where(usable, noiseless, 1.0)
    log_density = factor.log_density(y / safe, usable) - jnp.sum(jnp.log(jnp.abs(safe)))
    return jnp.where(jnp.all(usable | ~seen), log_density, -jnp.inf)


def _dense(distribution: Any) -> Any:
    """The distribution, which must have a density."""
    if not hasattr(distribution, "log_density"):
        raise _no_density(distribution)
    return distribution


def _no_density(owner: Any) -> InputError:
    return InputError(
        f"A particle filter needs the density of a reading, but the measurement noise `{type(owner).__name__}` has no "
        "`log_density` and no `covariance`; use `AdditiveGaussian`, or `Additive` with a distribution that has one."
    )
