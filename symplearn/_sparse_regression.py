"""SINDy: sparse regression of a vector field x' = Xi(x) theta on a library of functions. Dissertation (4.2)-(4.3).

Brunton, Proctor and Kutz (2016), PNAS 113. Theorem 4: with `ForwardDifference` and `Lasso` this is the MAP of a model
stepped by forward Euler, whose whole state is read without error, under a Laplace prior.
"""

import functools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ._counts import refuse_count
from ._errors import InputError
from ._hamiltonians import MONOMIALS, exponents
from ._model import Interval
from ._objectives import as_recordings
from ._reading_slopes import AbstractDerivative, ForwardDifference
from ._sparsity import AbstractPenalty


def _names(dim: int) -> list[str]:
    return ["x"] if dim == 1 else [f"x{i}" for i in range(dim)]


class PolynomialLibrary(eqx.Module):
    """All monomials of total degree 0..`degree` in `dim` variables, low degrees first; 10 for dim 2 and degree 3.

    **Raises:** `InputError` where `dim` or `degree` is no whole number of at least 1, or of 0.
    """

    dim: int = eqx.field(static=True)
    degree: int = eqx.field(static=True)

    def __check_init__(self):
        refuse_count("PolynomialLibrary", "dim", self.dim)
        refuse_count("PolynomialLibrary", "degree", self.degree, least=0)

    @property
    def terms(self) -> tuple[str, ...]:
        """The monomials in words, in the order of the features: 1, x0, x1, x0^2, ..."""
        names, rows = _names(self.dim), exponents(self.dim, self.degree, 0)
        factors = [
            [MONOMIALS.written(n, int(power)) for n, power in zip(names, row, strict=True) if power] for row in rows
        ]
        return tuple(" ".join(row) or "1" for row in factors)

    def __call__(self, x: Float[Array, " dim"]) -> Float[Array, " term"]:
        powers, values = exponents(self.dim, self.degree, 0), jnp.stack(MONOMIALS.values(x, self.degree))
        return functools.reduce(jnp.multiply, [values[powers[:, i], i] for i in range(self.dim)])


class SparseModel(eqx.Module):
    """A vector field x' = Xi(x) theta: called `(x)`, it gives x'. `ForwardEuler` makes dynamics of it.

    `coefficients` (term, state) learn where the model is fitted further; `library` is x -> (term,). `converged` says
    whether the regression ended at its optimum (`Lasso`) or at a support that repeats (`SequentialThresholding`), in
    every state; `steps` is the most any state took. It prints as equations.
    """

    coefficients: Float[Array, "term state"]
    library: Callable[[Any], Any]
    converged: bool = eqx.field(static=True, default=True)
    steps: int = eqx.field(static=True, default=0)

    def __call__(self, x: Float[Array, " state"]) -> Float[Array, " state"]:
        return self.library(x) @ self.coefficients

    @property
    def terms(self) -> tuple[str, ...]:
        """The features in words: the library's own `terms`, or f0(x), f1(x), ..."""
        own = getattr(self.library, "terms", None)
        return tuple(own) if own is not None else tuple(f"f{i}(x)" for i in range(self.coefficients.shape[0]))

    def __str__(self) -> str:
        columns = np.asarray(self.coefficients).T
        lines = [_equation(*one, self.terms) for one in zip(_names(len(columns)), columns, strict=True)]
        return "\n".join(lines if self.converged else [*lines, "NOT CONVERGED: do not use as an estimate"])


def _equation(state: str, numbers: np.ndarray, terms: tuple[str, ...]) -> str:
    pairs = zip(numbers, terms, strict=True)
    parts = [f"{number:+.6g}" + ("" if term == "1" else f" {term}") for number, term in pairs if number]
    return f"{state}' = " + (" ".join(parts) or "0")


class ForwardEuler(eqx.Module):
    """Dynamics x + dt f(x), repeated `substeps` times (at least 1) in each data interval. Dissertation (4.4).

    `field` is called `(x)`, such as a `SparseModel`.

    **Raises:** `InputError` where `substeps` is no whole number of at least 1.
    """

    field: Callable[[Any], Any]
    substeps: int = eqx.field(static=True, default=1)

    def __check_init__(self):
        refuse_count("ForwardEuler", "substeps", self.substeps)

    def __call__(self, x: Float[Array, " state"], interval: Interval) -> Float[Array, " state"]:
        dt = interval.length / self.substeps
        return jax.lax.scan(lambda x, _: (x + dt * self.field(x), None), x, length=self.substeps)[0]


FORWARD_DIFFERENCE = ForwardDifference()


def sindy(
    recording: Any,
    library: Callable[[Any], Any],
    penalty: AbstractPenalty,
    derivative: AbstractDerivative = FORWARD_DIFFERENCE,
) -> SparseModel:
    """Sparse identification of x' = Xi(x) theta from readings of the whole state. Dissertation (4.2)-(4.3).

    **Arguments:**
    - `recording`: one, or a list whose rows are pooled. Times may be unevenly spaced. Rows that a missing reading
      leaves unknown are dropped.
    - `library`: `PolynomialLibrary(dim, degree)`, or any function of JAX from x (state,) to features (term,), with
      `terms` (their names) if it has such an attribute.
    - `penalty`: `Lasso(weight)` or `SequentialThresholding(threshold)`.
    - `derivative`: `ForwardDifference()` is that of (4.3); `CentralDifference()` has an error of dt^2 in place of dt;
      `TotalVariation(weight)` is for noisy readings.

    Look at `converged` of the result before using it.
    **Raises:** `InputError` where recordings have inputs or different channels, no row is complete, or the library does
    not fit the state or is not finite at a reading; and as the penalty and the derivative do.
    """
    points, slopes = _rows(recording, derivative)
    features = _features(library, points)
    columns = [penalty(features, one) for one in slopes.T]
    theta = np.stack([coefficients for coefficients, _, _ in columns], axis=1)
    done = all(converged for _, converged, _ in columns)
    return SparseModel(jnp.asarray(theta), library, converged=done, steps=max(steps for _, _, steps in columns))


def _rows(recording: Any, derivative: AbstractDerivative) -> tuple[np.ndarray, np.ndarray]:
    """The complete points and slopes of all recordings."""
    several = as_recordings(recording)
    if any(series.inputs is not None for series in several):
        raise InputError("A recording has inputs, which x' = f(x) would ignore; give it without them.")
    if len({series.readings.shape[1] for series in several}) > 1:
        raise InputError("The recordings have different numbers of channels; give recordings of the same state.")
    parts = [derivative(np.asarray(one.times, float), np.asarray(one.readings, float)) for one in several]
    points, slopes = (np.concatenate(halves) for halves in zip(*parts, strict=True))
    complete = np.isfinite(points).all(axis=1) & np.isfinite(slopes).all(axis=1)
    if not complete.any():
        raise InputError("Missing readings leave no slope known; give more complete rows next to each other.")
    return points[complete], slopes[complete]


def _features(library: Callable[[Any], Any], points: np.ndarray) -> Float[np.ndarray, "row term"]:
    states = points.shape[1]
    if (dim := getattr(library, "dim", states)) != states:
        raise InputError(f"The library is for {dim} variables, but the recording has {states} channels.")
    features = np.asarray(jax.vmap(library)(jnp.asarray(points)), float)
    if features.ndim != 2:
        raise InputError(f"The library must give features of shape (term,) at one x, but gives {features.shape[1:]}.")
    if not np.isfinite(features).all():
        row, term = np.argwhere(~np.isfinite(features))[0]
        raise InputError(f"Term {term} of the library is {features[row, term]} at x = {points[row]}; remove the term.")
    return features
