"""Distributions that noise can have, over a vector of entries: for `Additive` and `Multiplicative` noise.

A Gaussian filter uses a distribution's first two moments, `mean` and `structure`; a particle filter and `simulate` use
`sample` and `log_density`. Bare numbers are known; `Positive`, `Bounded` and `Learnt` ones learn.
"""

import abc
import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import gammaln, xlogy
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from ._errors import InputError
from ._noise import AbstractCovariance, Diagonal, StandardDeviation
from ._parameters import AbstractKnown, number, resolve
from ._triangular import forward_substitution, semidefinite_cholesky

_LOG_2PI = math.log(2 * math.pi)


def _require(holds: Any, sentence: str) -> None:
    """Refuse numbers that can be looked at; inside a transformation there are none."""
    if not isinstance(holds, jax.core.Tracer) and not np.all(holds):
        raise InputError(sentence)


def _vectors(dim: int | None, *numbers: Any) -> list[Array]:
    """Each number as a vector of the distribution's entries."""
    plain = [jnp.asarray(resolve(number)) for number in numbers]
    try:
        shape = jnp.broadcast_shapes((1 if dim is None else dim,), *(number.shape for number in plain))
    except ValueError:
        shape = ()
    if len(shape) != 1 or dim not in (None, *shape):
        raise InputError(
            f"A distribution's numbers have the shapes {[number.shape for number in plain]} with dim={dim}, which is "
            "not one vector; give numbers and a `dim`, or vectors of one length."
        )
    return [jnp.broadcast_to(number, shape) for number in plain]


class AbstractDistribution(AbstractKnown):
    """The distribution of a vector of `dim` entries: its moments, its draws and its density."""

    @property
    @abc.abstractmethod
    def mean(self) -> Float[Array, " dim"]:
        """The mean."""

    @property
    @abc.abstractmethod
    def structure(self) -> AbstractCovariance:
        """The covariance, with its `.matrix` and its `.root`."""

    @abc.abstractmethod
    def sample(self, key: PRNGKeyArray) -> Float[Array, " dim"]:
        """One draw."""

    @abc.abstractmethod
    def log_density(self, value: Float[Array, " dim"], observed: Bool[Array, " dim"] | None = None) -> Float[Array, ""]:
        """The log density in nats, -inf outside the support; with `observed`, that of the observed entries alone."""


class MultivariateNormal(AbstractDistribution):
    """N(location, covariance) with a covariance of any structure: `MultivariateNormal(jnp.ones(2), Dense(R))`.

    `log_density` is NaN where the covariance is singular: there is no density then.

    **Raises:** `InputError` where the mean is not a vector of the covariance's size.
    """

    location: Any = eqx.field(converter=number)
    covariance: Any

    def __check_init__(self):
        plain = resolve(self)
        shape, size = plain.location.shape, plain.covariance.matrix.shape[0]
        if shape != (size,):
            raise InputError(f"`MultivariateNormal` needs a mean of shape ({size},), as its covariance, not {shape}.")

    @property
    def mean(self) -> Float[Array, " dim"]:
        return self.location

    @property
    def structure(self) -> AbstractCovariance:
        return self.covariance

    def sample(self, key: PRNGKeyArray) -> Float[Array, " dim"]:
        return self.location + self.covariance.root @ jax.random.normal(key, self.location.shape)

    def log_density(self, value: Float[Array, " dim"], observed: Bool[Array, " dim"] | None = None) -> Float[Array, ""]:
        seen = jnp.ones(value.shape, bool) if observed is None else observed
        # A missing entry is made independent of the others, with variance 1 and no deviation.
        covariance = jnp.where(seen[:, None] & seen[None, :], self.covariance.matrix, jnp.eye(value.shape[0]))
        L = semidefinite_cholesky(covariance)
        pivots = jnp.diagonal(L)
        e = forward_substitution(L, jnp.where(seen, value - self.location, 0.0))
        log_root = jnp.sum(jnp.log(jnp.where(pivots > 0.0, pivots, jnp.nan)))
        return -0.5 * e @ e - log_root - 0.5 * _LOG_2PI * jnp.sum(seen)


class AbstractIndependent(AbstractDistribution):
    """A distribution of independent entries.

    Its numbers are vectors (dim,), or numbers that hold for each of `dim` entries; `dim` is 1 where nothing says more.
    """

    @property
    @abc.abstractmethod
    def deviations(self) -> Float[Array, " dim"]:
        """The standard deviation of each entry."""

    @abc.abstractmethod
    def entry_log_densities(self, value: Float[Array, " dim"]) -> Float[Array, " dim"]:
        """The log density of each entry."""

    @property
    def structure(self) -> Diagonal:
        return Diagonal(StandardDeviation(self.deviations))

    def log_density(self, value: Float[Array, " dim"], observed: Bool[Array, " dim"] | None = None) -> Float[Array, ""]:
        each = self.entry_log_densities(value)
        return jnp.sum(each if observed is None else jnp.where(observed, each, 0.0))


class Uniform(AbstractIndependent):
    """Entries uniform between `lower` and `upper`: `Uniform(0.9, 1.1, dim=2)` has mean 1 and variance 0.1^2 / 3.

    **Raises:** `InputError` where upper <= lower.
    """

    lower: Any = eqx.field(converter=number)
    upper: Any = eqx.field(converter=number)
    dim: int | None = eqx.field(static=True, default=None)

    def __check_init__(self):
        lower, upper = self._entries
        _require(lower < upper, "`Uniform` needs lower < upper in every entry; exchange them, or leave the noise out.")

    @property
    def _entries(self):
        return _vectors(self.dim, self.lower, self.upper)

    @property
    def mean(self) -> Float[Array, " dim"]:
        lower, upper = self._entries
        return 0.5 * (lower + upper)

    @property
    def deviations(self) -> Float[Array, " dim"]:
        lower, upper = self._entries
        return (upper - lower) / math.sqrt(12.0)

    def sample(self, key: PRNGKeyArray) -> Float[Array, " dim"]:
        lower, upper = self._entries
        return lower + (upper - lower) * jax.random.uniform(key, lower.shape)

    def entry_log_densities(self, value: Float[Array, " dim"]) -> Float[Array, " dim"]:
        lower, upper = self._entries
        return jnp.where((lower <= value) & (value <= upper), -jnp.log(upper - lower), -jnp.inf)


class DoubleExponential(AbstractIndependent):
    """Entries with the Laplace density exp(-|x - location| / scale) / (2 scale), of variance 2 scale^2.

    **Raises:** `InputError` where a scale is not positive.
    """

    scale: Any = eqx.field(converter=number)
    location: Any = eqx.field(converter=number, default=0.0)
    dim: int | None = eqx.field(static=True, default=None)

    def __check_init__(self):
        _require(self._entries[0] > 0, "`DoubleExponential` needs a positive scale in every entry.")

    @property
    def _entries(self):
        return _vectors(self.dim, self.scale, self.location)

    @property
    def mean(self) -> Float[Array, " dim"]:
        return self._entries[1]

    @property
    def deviations(self) -> Float[Array, " dim"]:
        return math.sqrt(2.0) * self._entries[0]

    def sample(self, key: PRNGKeyArray) -> Float[Array, " dim"]:
        scale, location = self._entries
        return location + scale * jax.random.laplace(key, scale.shape)

    def entry_log_densities(self, value: Float[Array, " dim"]) -> Float[Array, " dim"]:
        scale, location = self._entries
        return -jnp.abs(value - location) / scale - jnp.log(2 * scale)


class StudentT(AbstractIndependent):
    """Entries location + scale t, with t of Student's distribution with `dof` degrees of freedom: heavy tails.

    The variance is scale^2 dof / (dof - 2): a `dof` that learns is best `Bounded` above 2.

    **Raises:** `InputError` where a scale is not positive or a dof not above 2.
    """

    scale: Any = eqx.field(converter=number)
    dof: Any = eqx.field(converter=number)
    location: Any = eqx.field(converter=number, default=0.0)
    dim: int | None = eqx.field(static=True, default=None)

    def __check_init__(self):
        scale, dof, _ = self._entries
        _require((scale > 0) & (dof > 2), "`StudentT` needs a positive scale, and dof above 2 for a variance to exist.")

    @property
    def _entries(self):
        return _vectors(self.dim, self.scale, self.dof, self.location)

    @property
    def mean(self) -> Float[Array, " dim"]:
        return self._entries[2]

    @property
    def deviations(self) -> Float[Array, " dim"]:
        scale, dof, _ = self._entries
        return scale * jnp.sqrt(dof / (dof - 2))

    def sample(self, key: PRNGKeyArray) -> Float[Array, " dim"]:
        scale, dof, location = self._entries
        return location + scale * jax.random.t(key, dof, scale.shape)

    def entry_log_densities(self, value: Float[Array, " dim"]) -> Float[Array, " dim"]:
        scale, dof, location = self._entries
        norm = gammaln(0.5 * (dof + 1)) - gammaln(0.5 * dof) - 0.5 * jnp.log(dof * math.pi) - jnp.log(scale)
        return norm - 0.5 * (dof + 1) * jnp.log1p(((value - location) / scale) ** 2 / dof)


class Gamma(AbstractIndependent):
    """Positive entries of the gamma distribution, of mean shape * scale and variance shape * scale^2.

    `Gamma(100.0, 0.01)` is a factor of mean 1 and standard deviation 0.1.

    **Raises:** `InputError` where a shape or a scale is not positive.
    """

    shape: Any = eqx.field(converter=number)
    scale: Any = eqx.field(converter=number)
    dim: int | None = eqx.field(static=True, default=None)

    def __check_init__(self):
        shape, scale = self._entries
        _require((shape > 0) & (scale > 0), "`Gamma` needs a positive shape and a positive scale in every entry.")

    @property
    def _entries(self):
        return _vectors(self.dim, self.shape, self.scale)

    @property
    def mean(self) -> Float[Array, " dim"]:
        shape, scale = self._entries
        return shape * scale

    @property
    def deviations(self) -> Float[Array, " dim"]:
        shape, scale = self._entries
        return jnp.sqrt(shape) * scale

    def sample(self, key: PRNGKeyArray) -> Float[Array, " dim"]:
        shape, scale = self._entries
        return scale * jax.random.gamma(key, shape)

    def entry_log_densities(self, value: Float[Array, " dim"]) -> Float[Array, " dim"]:
        shape, scale = self._entries
        x = jnp.where(value >= 0, value, 1.0) / scale
        return jnp.where(value >= 0, xlogy(shape - 1, x) - x - gammaln(shape) - jnp.log(scale), -jnp.inf)


class LogNormal(AbstractIndependent):
    """Positive entries whose logarithm is N(log_mean, log_sd^2): the mean is exp(log_mean + log_sd^2 / 2).

    `LogNormal(-0.005, 0.1)` is a factor of mean 1 and standard deviation 0.1003.

    **Raises:** `InputError` where a log_sd is not positive.
    """

    log_mean: Any = eqx.field(converter=number)
    log_sd: Any = eqx.field(converter=number)
    dim: int | None = eqx.field(static=True, default=None)

    def __check_init__(self):
        _require(self._entries[1] > 0, "`LogNormal` needs a positive log_sd in every entry.")

    @property
    def _entries(self):
        return _vectors(self.dim, self.log_mean, self.log_sd)

    @property
    def mean(self) -> Float[Array, " dim"]:
        log_mean, log_sd = self._entries
        return jnp.exp(log_mean + 0.5 * log_sd**2)

    @property
    def deviations(self) -> Float[Array, " dim"]:
        return self.mean * jnp.sqrt(jnp.expm1(self._entries[1] ** 2))

    def sample(self, key: PRNGKeyArray) -> Float[Array, " dim"]:
        log_mean, log_sd = self._entries
        return jnp.exp(log_mean + log_sd * jax.random.normal(key, log_sd.shape))

    def entry_log_densities(self, value: Float[Array, " dim"]) -> Float[Array, " dim"]:
        log_mean, log_sd = self._entries
        log_value = jnp.log(jnp.where(value > 0, value, 1.0))
        z = (log_value - log_mean) / log_sd
        return jnp.where(value > 0, -0.5 * z**2 - log_value - jnp.log(log_sd) - 0.5 * _LOG_2PI, -jnp.inf)
