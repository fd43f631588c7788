"""Variational inference with a normal density, weighed against the density it stands for."""

import abc
import dataclasses
from collections.abc import Callable
from types import ModuleType
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, PRNGKeyArray

from ._blackjax import blackjax
from ._blocks import Course, run_blocks
from ._errors import InputError
from ._importance import WeightedSample, densities, refuse_nothing, resampled
from ._sampler import AbstractBlockSampler, Drawn, LogDensity, generator, refuse_counts, whitened
from ._whitening import Whitening


class AbstractFamily(eqx.Module):
    """The normal densities among which variational inference looks."""

    @property
    @abc.abstractmethod
    def algorithm(self) -> ModuleType:
        """blackjax's `init`, `step` and `sample`."""

    @abc.abstractmethod
    def coordinates(self, start: Whitening) -> Whitening:
        """The coordinates that the family is one of normal densities in."""

    @abc.abstractmethod
    def log_density(self, *numbers: Array) -> Callable[[Array], Array]:
        """The log density with the numbers that `algorithm` learns."""


class MeanField(AbstractFamily):
    """Normal densities without correlations between free coordinates. They are too narrow where there are some."""

    @property
    def algorithm(self) -> ModuleType:
        return blackjax().vi.meanfield_vi

    def coordinates(self, start: Whitening) -> Whitening:
        # Scaled but not turned: turned coordinates would hide the correlations.
        sd = jnp.sqrt(jnp.sum(start.root**2, axis=1))
        return Whitening(start.centre, jnp.diag(sd))

    def log_density(self, *numbers: Array) -> Callable[[Array], Array]:
        return blackjax().vi.meanfield_vi.generate_meanfield_logdensity(*numbers)


class FullRank(AbstractFamily):
    """Normal densities of any covariance."""

    @property
    def algorithm(self) -> ModuleType:
        return blackjax().vi.fullrank_vi

    def coordinates(self, start: Whitening) -> Whitening:
        return Whitening(start.centre, start.root)

    def log_density(self, *numbers: Array) -> Callable[[Array], Array]:
        return blackjax().vi.fullrank_vi.generate_fullrank_logdensity(*numbers)


class VariationalInference(AbstractBlockSampler):
    """The normal density of a `family` with the largest ELBO, by blackjax; its draws are importance resampled.

    Adam takes `steps` with slopes from `batch` draws each, at a `rate` that falls to zero by half a cosine. Of the
    normal density, `draws` are weighed against the density itself: with a Pareto k below 0.7 the resampled ones stand
    for it, above it the diagnostics say that they do not. Yao et al. (2018), ICML. The ELBO, a lower bound of the log
    evidence whose distance from it is the Kullback-Leibler divergence, is `posterior.drawn.elbo` and in the remarks.
    **A mode that the normal density does not reach, or a tail much heavier than its own, is missed, and no number here
    tells.**

    **Raises:** `InputError` where a number is too small, or no draw has a finite density.
    """

    family: AbstractFamily = FullRank()
    draws: int = 4000
    steps: int = 1000
    batch: int = 10
    rate: float = 0.05

    def __check_init__(self):
        refuse_counts(self, draws=16, steps=10, batch=1)
        if not self.rate > 0:
            raise InputError(f"`VariationalInference` needs a `rate` above 0, but was given {self.rate}.")

    def draw_in(self, course: Course, density: LogDensity, start: Whitening, key: PRNGKeyArray) -> Drawn:
        fit_key, draw_key = jax.random.split(key)
        coordinates = self.family.coordinates(start)
        ascent = _ascended(self, course, density, coordinates, fit_key)
        z, log_q = (np.asarray(one) for one in _drawn(self, ascent.normal, draw_key))
        if not np.all(np.isfinite(z)):
            raise InputError("The ELBO's slopes were not finite; start nearer to the mode, or lower the `rate`.")
        log_density, done = densities(density, coordinates, z), int(ascent.done)
        refuse_nothing(log_density)
        sample = WeightedSample(z, log_density, log_density - log_q, self.draws)
        drawn = resampled(sample, coordinates, self.draws, generator(draw_key))
        remarks = [f"Importance resampled from the normal density of largest ELBO, {_elbo(sample.log_weights)}."]
        if course.interrupted:
            remarks.append(f"Stopped by Ctrl-C after {done} of {self.steps} steps of the ELBO's ascent.")
        return dataclasses.replace(
            drawn,
            gradients=done * self.batch,
            elbo=float(np.mean(sample.log_weights)),
            stopped=course.interrupted,
            remarks=tuple(remarks),
        )


def _elbo(ratios: np.ndarray) -> str:
    possible = np.isfinite(ratios)
    if not possible.all():
        return f"which is minus infinity: {np.mean(~possible):.2%} of its draws are impossible"
    return f"{np.mean(ratios):.3f} +- {np.std(ratios) / len(ratios) ** 0.5:.3f} nats"


class _Ascent(NamedTuple):
    """blackjax's record of the normal density, and the steps done."""

    normal: Any
    done: Array


def _ascended(
    options: VariationalInference, course: Course, density: LogDensity, coordinates: Whitening, key: PRNGKeyArray
) -> _Ascent:
    state = course.resumed(lambda: _begun(options, coordinates.centre))
    return run_blocks(
        course,
        lambda state, count: _ascend(options, density, coordinates, state, key, count),
        _begun(options, coordinates.centre) if state is None else state,
        lambda state: int(state.done),
        options.steps,
        lambda state: f"step {int(state.done)} of {options.steps} of the ELBO's ascent",
    )


def _optimiser(options: VariationalInference) -> Any:
    return optax.adam(optax.cosine_decay_schedule(options.rate, options.steps))


def _begun(options: VariationalInference, centre: Array) -> _Ascent:
    algorithm: Any = options.family.algorithm
    state = _Ascent(algorithm.init(jnp.zeros_like(centre), _optimiser(options)), jnp.zeros((), int))
    # Strong types: with weak ones a state from a file would compile anew.
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, leaf.dtype), state)


@eqx.filter_jit
def _ascend(options, density, coordinates, state, key, count):
    log_density = whitened(density, coordinates, slopes=True)

    def step(_, state):
        now = jax.random.fold_in(key, state.done)
        # What blackjax calls `elbo` in the second result is minus it.
        normal, _ = options.family.algorithm.step(now, state.normal, log_density, _optimiser(options), options.batch)
        return _Ascent(normal, state.done + 1)

    return jax.lax.fori_loop(0, count, step, state)


@eqx.filter_jit
def _drawn(options, normal, key):
    """Draws of the normal density, and its log density there."""
    z = options.family.algorithm.sample(key, normal, options.draws)
    return z, jax.vmap(options.family.log_density(*normal[:2]))(z)
