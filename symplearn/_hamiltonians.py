"""Hamiltonians that are linear in what they learn: monomials or Legendre products. Dissertation sec. 5.4."""

import abc
import functools
import itertools
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import integrators as ig

from ._counts import refuse_count
from ._errors import InputError
from ._model_checks import shape_of
from ._small_products import product

# Terms of a gradient up to which they are written out one by one. Cherry's 60 would be no faster for it, and take six
# times as long to compile in a batch.
_WRITTEN_OUT = 32


class AbstractBasis(eqx.Module):
    """Polynomials B_0 = 1, B_1, ... of one variable, from which products over the variables are made."""

    @abc.abstractmethod
    def values(self, x: Float[Array, "*shape"], degree: int) -> list[Float[Array, "*shape"]]:
        """B_n(x) for n = 0..degree, at a variable over its scale."""

    @abc.abstractmethod
    def slopes(self, degree: int) -> np.ndarray:
        """The matrix M (degree + 1, degree + 1) of the derivatives: B_n' = sum_m M[n, m] B_m, before
        scaling."""

    @abc.abstractmethod
    def scales(self, variables: int) -> Float[Array, " variable"]:
        """The length by which each variable is divided."""

    @abc.abstractmethod
    def written(self, name: str, power: int) -> str:
        """B_power of the variable called `name`."""


class Monomials(AbstractBasis):
    """1, z, z^2, ..."""

    def values(self, x: Float[Array, "*shape"], degree: int) -> list[Float[Array, "*shape"]]:
        table = [jnp.ones_like(x), x]
        for n in range(1, degree):
            table.append(table[n] * x)
        return table[: degree + 1]

    def slopes(self, degree: int) -> np.ndarray:
        return np.diag(np.arange(1.0, degree + 1), k=-1)

    def scales(self, variables: int) -> Float[Array, " variable"]:
        return jnp.ones(variables)

    def written(self, name: str, power: int) -> str:
        return name if power == 1 else f"{name}^{power}"


MONOMIALS = Monomials()


def _half_widths(box: Any) -> Any:
    """As they can be compared and hashed."""
    return float(box) if np.ndim(box) == 0 else tuple(float(width) for width in box)


class Legendre(AbstractBasis):
    """Legendre polynomials of z / box, orthogonal on [-box, box]; better conditioned than monomials there.

    `box` is the half-width, one number for all variables or one for each.

    **Raises:** `InputError` where a half-width is not positive, or there is not one for each variable.
    """

    box: tuple[float, ...] | float = eqx.field(static=True, default=1.0, converter=_half_widths)

    def __check_init__(self):
        if not np.all(np.asarray(self.box) > 0):
            raise InputError(f"`Legendre` needs positive half-widths, but was given {self.box}.")

    def scales(self, variables: int) -> Float[Array, " variable"]:
        if np.shape(self.box) not in ((), (variables,)):
            raise InputError(
                f"`Legendre` has {np.size(self.box)} half-widths, but the polynomial {variables} variables; give one "
                "for each, or one for all."
            )
        return jnp.broadcast_to(jnp.asarray(self.box, dtype=float), (variables,))

    def values(self, x: Float[Array, "*shape"], degree: int) -> list[Float[Array, "*shape"]]:
        table = [jnp.ones_like(x), x]
        for n in range(1, degree):
            table.append(((2 * n + 1) * x * table[n] - n * table[n - 1]) / (n + 1))
        return table[: degree + 1]

    def slopes(self, degree: int) -> np.ndarray:
        # P_n' = sum of (2 m + 1) P_m over m = n - 1, n - 3, ...
        n, m = np.indices((degree + 1, degree + 1))
        return np.where((m < n) & ((n - m) % 2 == 1), 2.0 * m + 1, 0.0)

    def written(self, name: str, power: int) -> str:
        return f"P{power}({name})"


@functools.cache
def exponents(variables: int, degree: int, lowest: int = 1) -> np.ndarray:
    """The powers of all products of total degree `lowest`..`degree`, (term, variable), low degrees first."""
    rows = []
    for total in range(lowest, degree + 1):
        for chosen in itertools.combinations_with_replacement(range(variables), total):
            rows.append(np.bincount(np.array(chosen, dtype=int), minlength=variables))
    return np.array(rows, dtype=int).reshape(-1, variables)


@functools.cache
def _grown_exponents(variables: int, degree: int) -> np.ndarray:
    """The powers of all products of total degree 0..`degree`, (term, variable), in the order of `_products`."""
    if variables == 1:
        return np.arange(degree + 1)[:, None]
    rest = [_grown_exponents(variables - 1, degree - power) for power in range(degree + 1)]
    return np.concatenate([np.insert(one, 0, power, axis=1) for power, one in enumerate(rest)])


@functools.cache
def _derivative_table(basis: AbstractBasis, variables: int, degree: int) -> np.ndarray:
    """T (variable, lower term, term): d(term)/dz_i = sum over lower terms of T[i, lower, term] times them."""
    high, low = exponents(variables, degree), _grown_exponents(variables, degree - 1)
    slopes = basis.slopes(degree)
    table = np.zeros((variables, len(low), len(high)))
    for i in range(variables):
        others = np.delete(high, i, axis=1)[None] == np.delete(low, i, axis=1)[:, None]
        table[i] = others.all(axis=2) * slopes[high[None, :, i], low[:, None, i]]
    return table


def _products(basis: AbstractBasis, variables: list[Array], degree: int) -> list[Array]:
    """All products of total degree 0..`degree` of the variables, in the order of `_grown_exponents`.

    One array each, grown from those of the later variables: a loop over an array of all of them could not be
    vectorised, since each entry is made in another way; the derivative of a gather is a scatter, which is slow, and
    that of `prod` divides by zero.
    """
    scales = basis.scales(len(variables))
    made: list[list[Array]] = []
    for i in reversed(range(len(variables))):
        powers = basis.values(variables[i] / scales[i], degree)
        if i == len(variables) - 1:
            made = [powers[: left + 1] for left in range(degree + 1)]
        else:
            made = [
                made[left] + [powers[k] * rest for k in range(1, left + 1) for rest in made[left - k]]
                for left in range(degree + 1)
            ]
    return made[degree]


@functools.cache
def _places(variables: int, degree: int) -> np.ndarray:
    """Where the terms of `exponents` are among those of `_grown_exponents`."""
    same = exponents(variables, degree)[:, None] == _grown_exponents(variables, degree)[None]
    return np.argmax(same.all(axis=2), axis=1)


def _polynomial(basis: AbstractBasis, coefficients: Array, z: Array, degree: int) -> Array:
    return product(coefficients, jnp.stack(_products(basis, list(z), degree))[_places(z.shape[0], degree)])


def _weights(basis: AbstractBasis, coefficients: Array, variables: int, degree: int) -> Any:
    """What the gradient's components are made of, the same all along a trajectory: an array (variable, lower term), or,
    where there are few, a list of dictionaries from lower terms to numbers."""
    table, scales = _derivative_table(basis, variables, degree), basis.scales(variables)
    if table.shape[1] * variables > _WRITTEN_OUT:
        return jnp.sum(jnp.asarray(table) * coefficients, axis=-1) / scales[:, None]
    return [
        {
            k: sum(float(row[k, m]) * coefficients[m] for m in np.flatnonzero(row[k])) / scales[i]
            for k in np.flatnonzero(row.any(axis=1)).tolist()
        }
        for i, row in enumerate(table)
    ]


def _gradient(basis: AbstractBasis, weights: Any, variables: list[Array], degree: int) -> list[Array]:
    """The gradient of a polynomial of such weights: sums of products for each component, written out if few."""
    products = _products(basis, variables, degree - 1)
    if not isinstance(weights, list):
        return list(product(weights, jnp.stack(products)))
    return [sum(weight * products[k] for k, weight in row.items()) for row in weights]


class _PreparedPotential(ig.AbstractSeparableHamiltonian):
    """A polynomial potential with its gradient's weights worked out."""

    of: "PolynomialPotential"
    weights: Any

    side_by_side: ClassVar[bool] = True

    def kinetic(self, p: Float[Array, " d"]) -> Float[Array, ""]:
        return self.of.kinetic(p)

    def potential(self, q: Float[Array, " d"]) -> Float[Array, ""]:
        return self.of.potential(q)

    def velocity(self, q: Float[Array, "d ..."], p: Float[Array, "d ..."]) -> Float[Array, "d ..."]:
        return p

    def slope(self, q: Float[Array, "d ..."], p: Float[Array, "d ..."]) -> Float[Array, "d ..."]:
        return jnp.stack(_gradient(self.of.basis, self.weights, list(q), self.of.degree))


class _Prepared(ig.AbstractHamiltonian):
    """A polynomial with its gradient's weights worked out."""

    of: "Polynomial"
    weights: Any

    side_by_side: ClassVar[bool] = True

    def energy(self, q: Float[Array, " d"], p: Float[Array, " d"]) -> Float[Array, ""]:
        return self.of.energy(q, p)

    def velocity(self, q: Float[Array, "d ..."], p: Float[Array, "d ..."]) -> Float[Array, "d ..."]:
        return self.velocity_and_force(q, p)[0]

    def slope(self, q: Float[Array, "d ..."], p: Float[Array, "d ..."]) -> Float[Array, "d ..."]:
        return -self.velocity_and_force(q, p)[1]

    def vector_field(self, x: Float[Array, "two_d ..."]) -> Float[Array, "two_d ..."]:
        """dx/dt at the phase point x, by one gradient."""
        return jnp.concatenate(self.velocity_and_force(*ig.split(x)))

    def velocity_and_force(
        self, q: Float[Array, "d ..."], p: Float[Array, "d ..."]
    ) -> tuple[Float[Array, "d ..."], Float[Array, "d ..."]]:
        """dq/dt and dp/dt, by one gradient."""
        slopes, d = _gradient(self.of.basis, self.weights, [*q, *p], self.of.degree), self.of.dim
        return jnp.stack(slopes[d:]), -jnp.stack(slopes[:d])


def _terms(basis: AbstractBasis, names: list[str], degree: int) -> tuple[str, ...]:
    def written(row):
        return " ".join(basis.written(name, int(power)) for name, power in zip(names, row, strict=True) if power)

    return tuple(written(row) for row in exponents(len(names), degree))


def _equation(left: str, constant: str, coefficients: Any, terms: tuple[str, ...]) -> str:
    numbers = np.asarray(getattr(coefficients, "value", coefficients))
    if numbers.ndim > 1:  # of several systems side by side a line each
        return "\n".join(_equation(left, constant, row, terms) for row in numbers)
    parts = [f"{number:+.6g} {term}" for number, term in zip(numbers, terms, strict=True) if number]
    return f"{left} = " + " ".join([constant, *parts] if constant else parts or ["0"])


def _names(letter: str, dim: int) -> list[str]:
    return [letter] if dim == 1 else [f"{letter}{i}" for i in range(dim)]


def _coefficients(given: Any, terms: int) -> Any:
    """Zeros where none are given: a random start of a cubic potential lets trajectories escape."""
    if given is None:
        return jnp.zeros(terms)
    given = given if isinstance(given, eqx.Module) else jnp.asarray(given, dtype=float)
    if (shape := shape_of(given)) is not None and shape[-1:] != (terms,):
        raise InputError(
            f"A polynomial with {terms} terms needs as many coefficients, but was given the shape {shape}; `terms` "
            "tells their order."
        )
    return given


def _refuse_counts(polynomial: Any) -> None:
    for name in ("dim", "degree"):
        refuse_count(type(polynomial).__name__, name, getattr(polynomial, name))


class PolynomialPotential(ig.AbstractSeparableHamiltonian):
    """H = p'p / 2 + U(q) with U all products of total degree 1..`degree`. Dissertation (5.3), (5.21).

    **Arguments:** `dim` - degrees of freedom; `degree`; `coefficients` - (term,) in the order of `terms`,
    zeros if left out; `basis` - `Monomials()` or `Legendre(box)`. It prints as an equation.

    **Raises:** `InputError` where `dim` or `degree` is no whole number of at least 1, or there are not as many
    coefficients as terms, or as half-widths of the basis as variables.
    """

    dim: int = eqx.field(static=True)
    degree: int = eqx.field(static=True)
    coefficients: Any
    basis: AbstractBasis

    def __init__(self, dim: int, degree: int, coefficients: Any = None, basis: AbstractBasis = MONOMIALS):
        self.dim, self.degree, self.basis = dim, degree, basis
        _refuse_counts(self)
        basis.scales(dim)  # refuses a basis that is for another number of variables
        self.coefficients = _coefficients(coefficients, len(exponents(dim, degree)))

    @property
    def terms(self) -> tuple[str, ...]:
        """The terms in words, in the order of the coefficients."""
        return _terms(self.basis, _names("q", self.dim), self.degree)

    def kinetic(self, p: Float[Array, " d"]) -> Float[Array, ""]:
        return 0.5 * product(p, p)

    def potential(self, q: Float[Array, " d"]) -> Float[Array, ""]:
        return _polynomial(self.basis, self.coefficients, q, self.degree)

    def velocity(self, q: Float[Array, " d"], p: Float[Array, " d"]) -> Float[Array, " d"]:
        return p

    def slope(self, q: Float[Array, " d"], p: Float[Array, " d"]) -> Float[Array, " d"]:
        return self.prepared().slope(q, p)

    def prepared(self) -> _PreparedPotential:
        """The same potential with the weights of its gradient, much cheaper than differentiating."""
        return _PreparedPotential(self, _weights(self.basis, self.coefficients, self.dim, self.degree))

    def __str__(self) -> str:
        return _equation("H(q, p)", "p'p/2", self.coefficients, self.terms)


class Polynomial(ig.AbstractHamiltonian):
    """H(q, p) of all products of total degree 1..`degree` in the variables [q, p]. Dissertation sec. 5.4.2.

    Arguments as for `PolynomialPotential`. With dim 2 and degree 3 there are 34 terms.

    **Raises:** `InputError` as `PolynomialPotential`.
    """

    dim: int = eqx.field(static=True)
    degree: int = eqx.field(static=True)
    coefficients: Any
    basis: AbstractBasis

    def __init__(self, dim: int, degree: int, coefficients: Any = None, basis: AbstractBasis = MONOMIALS):
        self.dim, self.degree, self.basis = dim, degree, basis
        _refuse_counts(self)
        basis.scales(2 * dim)
        self.coefficients = _coefficients(coefficients, len(exponents(2 * dim, degree)))

    @property
    def terms(self) -> tuple[str, ...]:
        """The terms in words, in the order of the coefficients."""
        return _terms(self.basis, _names("q", self.dim) + _names("p", self.dim), self.degree)

    def energy(self, q: Float[Array, " d"], p: Float[Array, " d"]) -> Float[Array, ""]:
        return _polynomial(self.basis, self.coefficients, jnp.concatenate([q, p]), self.degree)

    def velocity(self, q: Float[Array, " d"], p: Float[Array, " d"]) -> Float[Array, " d"]:
        return self.prepared().velocity(q, p)

    def slope(self, q: Float[Array, " d"], p: Float[Array, " d"]) -> Float[Array, " d"]:
        return self.prepared().slope(q, p)

    def vector_field(self, x: Float[Array, " two_d"]) -> Float[Array, " two_d"]:
        """dx/dt at the phase point x, by one gradient."""
        return self.prepared().vector_field(x)

    def prepared(self) -> _Prepared:
        """The same polynomial with the weights of its gradient, much cheaper than differentiating."""
        return _Prepared(self, _weights(self.basis, self.coefficients, 2 * self.dim, self.degree))

    def __str__(self) -> str:
        return _equation("H(q, p)", "", self.coefficients, self.terms)
