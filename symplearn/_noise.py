"""Noise of the dynamics and of the readings, as its first two moments enter a filter. Dissertation (2.5), (2.9)-(2.12).

Bare numbers in a noise are known; wrap them in `Positive`, or a matrix in `PositiveDefinite`, to learn them. Numbers
are variances unless wrapped in `StandardDeviation` or `LogVariance`: what is wrapped is what a prior is over.
"""

import abc
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ._counts import refuse_count
from ._errors import InputError
from ._model_checks import length_of, refuse_asymmetric, refuse_negative, shape_of
from ._parameters import AbstractKnown, number
from ._small_products import product
from ._transforms import Moments, with_noise
from ._triangular import semidefinite_cholesky


def _root(number: Any) -> Array:
    """The square root, with derivative 0 at 0; NaN below, which the filter reports."""
    number = jnp.asarray(number)
    return jnp.where(number == 0.0, 0.0, jnp.sqrt(jnp.where(number == 0.0, 1.0, number)))


class StandardDeviation(AbstractKnown):
    """A variance given by its square root: `ScaledIdentity(StandardDeviation(Positive(0.05)), dim=4)`.

    A prior is then over the standard deviation.
    """

    sd: Any = eqx.field(converter=number)


class LogVariance(AbstractKnown):
    """A variance given by its natural logarithm, of any sign: `Diagonal(LogVariance(Learnt([-6.0, -8.0])))`.

    A prior is then over the logarithm.
    """

    log_variance: Any = eqx.field(converter=number)


def _variance(number: Any) -> Array:
    if isinstance(number, StandardDeviation):
        return number.sd**2
    return jnp.exp(number.log_variance) if isinstance(number, LogVariance) else number


def _deviation(number: Any) -> Array:
    if isinstance(number, StandardDeviation):
        return jnp.abs(number.sd)
    return jnp.exp(0.5 * number.log_variance) if isinstance(number, LogVariance) else _root(number)


def _shape_of(number: Any) -> tuple[int, ...] | None:
    if isinstance(number, StandardDeviation):
        return shape_of(number.sd)
    return shape_of(number.log_variance if isinstance(number, LogVariance) else number)


class AbstractCovariance(AbstractKnown):
    """A covariance matrix of size (dim, dim) and a square root of it."""

    @property
    @abc.abstractmethod
    def matrix(self) -> Float[Array, "dim dim"]:
        """The covariance matrix."""

    @property
    @abc.abstractmethod
    def root(self) -> Float[Array, "dim dim"]:
        """Lower triangular, root root' = matrix."""

    @property
    def size(self) -> int | None:
        """`dim`, or None where it cannot be told without computing the matrix."""
        return None


class ScaledIdentity(AbstractCovariance):
    """The covariance `variance` times the identity of size `dim`.

    **Raises:** `InputError` where `dim` is no whole number of at least 1, or the variance is below 0.
    """

    variance: Any = eqx.field(converter=number)
    dim: int = eqx.field(static=True)

    def __check_init__(self):
        refuse_count("ScaledIdentity", "dim", self.dim)
        refuse_negative("ScaledIdentity", "variance", self.variance)

    @property
    def size(self) -> int | None:
        return self.dim

    @property
    def matrix(self) -> Float[Array, "dim dim"]:
        return _variance(self.variance) * jnp.eye(self.dim)

    @property
    def root(self) -> Float[Array, "dim dim"]:
        return _deviation(self.variance) * jnp.eye(self.dim)


class Diagonal(AbstractCovariance):
    """The covariance with `variances` (dim,) on its diagonal.

    **Raises:** `InputError` where the variances are no vector, or one is below 0.
    """

    variances: Any = eqx.field(converter=number)

    def __check_init__(self):
        if _shape_of(self.variances) == ():
            raise InputError("`Diagonal` needs a vector of variances, but was given one number; use `ScaledIdentity`.")
        refuse_negative("Diagonal", "variances", self.variances)

    @property
    def size(self) -> int | None:
        shape = _shape_of(self.variances)
        return shape[-1] if shape else None

    @property
    def matrix(self) -> Float[Array, "dim dim"]:
        return jnp.diag(_variance(self.variances))

    @property
    def root(self) -> Float[Array, "dim dim"]:
        return jnp.diag(_deviation(self.variances))


class Dense(AbstractCovariance):
    """A covariance (dim, dim), symmetric and positive semi-definite; `PositiveDefinite` learns one.

    **Raises:** `InputError` where it is not square or not symmetric.
    """

    covariance: Any = eqx.field(converter=number)

    def __check_init__(self):
        refuse_asymmetric("Dense", "covariance", self.covariance)

    @property
    def size(self) -> int | None:
        return length_of(self.covariance)

    @property
    def matrix(self) -> Float[Array, "dim dim"]:
        return self.covariance

    @property
    def root(self) -> Float[Array, "dim dim"]:
        return semidefinite_cholesky(self.covariance)


class Correlated(AbstractCovariance):
    """The covariance with `variances` (dim,) on its diagonal and the matrix `correlation` (dim, dim).

    A dense covariance whose `variances` may be wrapped as those of `Diagonal`; `Correlation` learns the rest:
    `Correlated(StandardDeviation(Positive(sds)), Correlation(matrix))` (Barnard, McCulloch and Meng 2000).

    **Raises:** `InputError` where the correlation is not square or not symmetric.
    """

    variances: Any = eqx.field(converter=number)
    correlation: Any = eqx.field(converter=number)

    def __check_init__(self):
        refuse_asymmetric("Correlated", "correlation", self.correlation)

    @property
    def size(self) -> int | None:
        return length_of(self.correlation)

    @property
    def matrix(self) -> Float[Array, "dim dim"]:
        deviations = _deviation(self.variances)
        return deviations[:, None] * self.correlation * deviations

    @property
    def root(self) -> Float[Array, "dim dim"]:
        return _deviation(self.variances)[:, None] * semidefinite_cholesky(self.correlation)


class AbstractNoise(eqx.Module):
    """What the dynamics or the readings add to their noiseless value: one draw per data interval or per reading."""

    @abc.abstractmethod
    def enter(self, moments: Moments, interval: Any = None) -> Moments:
        """The moments with the noise in."""


def enter(noise: Any, moments: Moments, record: Any) -> Moments:
    """The moments with a noise in: an `AbstractNoise`, or any module with `covariance(record)`, which is added."""
    if hasattr(noise, "enter"):
        return noise.enter(moments, record)
    return with_noise(moments, semidefinite_cholesky(noise.covariance(record)))


class AdditiveGaussian(AbstractNoise):
    """Independent zero-mean Gaussian noise: one draw per reading, or one per data interval.

    As process noise its variances are per data interval, as in the dissertation, and not comparable across
    sampling intervals; use `WienerIncrement` where intervals differ.
    """

    structure: Any

    def covariance(self, interval: Any = None) -> Float[Array, "dim dim"]:
        """The covariance of one draw."""
        return self.structure.matrix

    def enter(self, moments: Moments, interval: Any = None) -> Moments:
        return with_noise(moments, self.structure.root)


class WienerIncrement(AbstractNoise):
    """Process noise that adds up over time: the structure's variances are per unit time, times the
    interval's length.

    `interval` needs a `length`, as `Interval` has.
    """

    structure: Any

    def covariance(self, interval: Any) -> Float[Array, "dim dim"]:
        """The covariance of the noise gathered over one data interval."""
        return self.structure.matrix * interval.length

    def enter(self, moments: Moments, interval: Any = None) -> Moments:
        return with_noise(moments, self.structure.root * _root(interval.length))


class Additive(AbstractNoise):
    """Added noise of any distribution, by its mean and covariance: exact moments in (2.6), (2.7), whatever it is.

    `distribution` is one of this package's, as `Uniform(-0.1, 0.1, dim=2)`, or anything with `mean` (dim,) and
    `structure`, a covariance; a particle filter needs its `sample` and `log_density` as well.
    """

    distribution: Any

    def enter(self, moments: Moments, interval: Any = None) -> Moments:
        _check_size(self.distribution, moments, "Additive")
        shifted = moments._replace(mean=moments.mean + self.distribution.mean)
        return with_noise(shifted, self.distribution.structure.root)


class Multiplicative(AbstractNoise):
    """Noise that multiplies each entry, and noise added after: f .* w + xi. Dissertation (2.9)-(2.12).

    `factor` is the distribution of w, as `Uniform(0.9, 1.1, dim=2)`, entries independent or not; `additive` an
    `AdditiveGaussian`, `Additive` or `WienerIncrement`, or None. The moments are exact for any distribution:
    E = E[f] .* E[w], Var = Var[f] .* (Var[w] + E[w] E[w]') + E[f] E[f]' .* Var[w] + Var[xi].
    """

    factor: Any
    additive: Any = None

    def enter(self, moments: Moments, interval: Any = None) -> Moments:
        _check_size(self.factor, moments, "Multiplicative")
        mean, structure = self.factor.mean, self.factor.structure
        scaled = Moments(moments.mean * mean, moments.factor * mean[:, None], moments.source)
        if isinstance(structure, ScaledIdentity | Diagonal):
            second = moments.mean**2 + jnp.sum(moments.factor**2, axis=1)
            multiplied = with_noise(scaled, _root(second)[:, None] * structure.root)
        else:
            second = jnp.outer(moments.mean, moments.mean) + product(moments.factor, moments.factor.T)
            # Semi-definite by Schur's product theorem.
            multiplied = with_noise(scaled, semidefinite_cholesky(second * structure.matrix))
        return multiplied if self.additive is None else enter(self.additive, multiplied, interval)


def _check_size(distribution: Any, moments: Moments, owner: str) -> None:
    # One entry would be stretched over all without a word, and correlate them.
    given, needed = jnp.shape(distribution.mean), moments.mean.shape
    if given != needed:
        raise InputError(
            f"`{owner}` needs a distribution of {needed[0]} entries here, but was given one of shape {given}; give it "
            f"`dim={needed[0]}`, or one number for each entry."
        )
