"""What every sampler is asked for and gives back: draws of a density over a vector of free coordinates."""

import abc
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from ._blocks import Course
from ._counts import refuse_count
from ._errors import InputError
from ._faults import IMPOSSIBLE
from ._fit import guarded
from ._lane_loops import with_lane_loops
from ._whitening import Whitening

LogDensity = Callable[[Any], Any]
# Where no importance weight has a larger share, a few odd ones among near-equal weights can make a Pareto k large, but
# no mean feels them.
NEGLIGIBLE = 1e-3
# Places whose log densities a processor computes together: with 128 of Henon-Heiles each took 1.5 times as long.
TOGETHER = 64


class Drawn(eqx.Module):
    """Draws of equal weight, with what their sampler knows of them; None where it has no such thing.

    `free` and `log_density` (nats, not normalised) are of independent chains. `divergent` and `energy` are those of
    Hamiltonian trajectories, `accepted` is the share of proposals taken, `pareto_k` the shape of the tail of importance
    weights and `largest_weight` the largest one's share. `evaluations` counts the density's values, those of warm-up
    included; `gradients` likewise. `elbo` is a normal approximation's lower bound of the log evidence. `stopped` says
    that Ctrl-C ended the sampling before all was drawn.
    """

    free: Float[Array, "chain draw parameter"]
    log_density: Float[Array, "chain draw"]
    evaluations: int
    gradients: int = 0
    accepted: float | None = None
    divergent: Bool[Array, "chain draw"] | None = None
    energy: Float[Array, "chain draw"] | None = None
    pareto_k: float | None = None
    largest_weight: float | None = None
    log_evidence: float | None = None
    log_evidence_sd: float | None = None
    elbo: float | None = None
    stopped: bool = False
    remarks: tuple[str, ...] = ()


class AbstractSampler(eqx.Module):
    """A way to draw from a density; its numbers are the options."""

    @property
    def by_place(self) -> bool:
        """Whether its options name places of the free vector, so that no other coordinates will do."""
        return False

    @abc.abstractmethod
    def draw(self, density: LogDensity, start: Whitening, key: PRNGKeyArray) -> Drawn:
        """Draws from the density, started at what is known of its mode.

        `density` is a pytree, or a function, that maps a vector (parameter,) to nats.
        """


class AbstractBlockSampler(AbstractSampler):
    """A sampler that draws in blocks: long runs are told on stderr, kept in a file, and stopped between two blocks."""

    @abc.abstractmethod
    def draw_in(self, course: Course, density: LogDensity, start: Whitening, key: PRNGKeyArray) -> Drawn:
        """`draw`, told and kept as the course says, and from the course's file on where there is one."""

    def draw(self, density: LogDensity, start: Whitening, key: PRNGKeyArray) -> Drawn:
        return self.draw_in(Course("sample"), density, start, key)


def possible(value: Float[Array, "..."]) -> Float[Array, "..."]:
    """A log density with -inf for what is not a number and for what a failed filter gives."""
    return jnp.where(jnp.isfinite(value) & (value > 0.5 * IMPOSSIBLE), value, -jnp.inf)


def whitened(density: LogDensity, start: Whitening, slopes: bool = False) -> LogDensity:
    """The log density of the whitened coordinates, z with free = centre + root z; never NaN.

    With `slopes` it is finite everywhere, and so are its derivatives, as Hamiltonian trajectories need.
    """

    def log_density(z):
        return possible(density(start.free(z))) + start.log_volume

    if not slopes:
        return with_lane_loops(log_density)
    minus = guarded(lambda z: -log_density(z), start.centre.shape[0])
    return lambda z: -minus(z)


def at_each(density: LogDensity, places: Float[Array, "place parameter"]) -> Float[Array, " place"]:
    """The log density at each place: on a processor so many at a time as stay in its cache."""
    count = len(places)
    together = min(count, TOGETHER) if jax.default_backend() == "cpu" else count
    filled = jnp.concatenate([places, jnp.tile(places[-1:], (-count % together, 1))])
    parts = filled.reshape(-1, together, places.shape[1])
    return jax.lax.map(jax.vmap(density), parts).reshape(-1)[:count]


def refuse_counts(sampler: AbstractSampler, **least: int) -> None:
    """Refuse an option of a sampler that is no whole number, or below the least that works."""
    for name, lowest in least.items():
        refuse_count(type(sampler).__name__, name, getattr(sampler, name), lowest)


def refuse_sampler(given: Any) -> None:
    """Refuse, with `InputError`, what is no sampler: its name in a string, or its class."""
    if not isinstance(given, AbstractSampler):
        shown = f"the class `{given.__name__}`" if isinstance(given, type) else f"{str(given):.60}"
        raise InputError(f"A sampler is an object with its options, such as `NUTS()`, but {shown} was given.")


def generator(key: PRNGKeyArray) -> np.random.Generator:
    """NumPy's random numbers from a key of JAX."""
    data = jax.random.key_data(key) if jnp.issubdtype(key.dtype, jax.dtypes.prng_key) else key
    return np.random.default_rng(np.asarray(data).tolist())
