"""SINDy: sparse regression of a vector field x' = Xi(x) theta on a library of functions. Dissertation (4.2)-(4.3).

Brunton, Proctor and Kutz (2016), PNAS 113. Theorem 4: with `ForwardDifference` and `Lasso` this is the MAP of a model
stepped by forward Euler, whose whole state is read without error, under a Laplace prior.
"""

import abc
import functools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg
import scipy.sparse
from jaxtyping import Array, Float

from ._counts import refuse_count
from ._errors import InputError
from ._hamiltonians import MONOMIALS, exponents
from ._model import Interval
from ._objectives import as_recordings

_OPTIMAL = 1e-10  # what the lasso's optimality conditions may miss, as a share of the largest possible slope
_GAP = 1e-8  # what the smoothed path's objective may lie above its minimum, as a share of it
_ROUND_OFF = 1e-4  # the same, where round-off leaves no better
_SMOOTHING_STEPS = 100  # about 30 are usual

Rows = tuple[Float[np.ndarray, "row state"], Float[np.ndarray, "row state"]]
Solution = tuple[Float[np.ndarray, " term"], bool, int]


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


class AbstractDerivative(eqx.Module):
    """How slopes are taken from readings."""

    @abc.abstractmethod
    def __call__(self, times: Float[np.ndarray, " time"], readings: Float[np.ndarray, "time state"]) -> Rows:
        """Points of the path, and the slopes there. Rows that a missing reading leaves unknown hold NaN."""


class ForwardDifference(AbstractDerivative):
    """(y_k - y_{k-1}) / dt at y_{k-1}, of first order in dt: what (4.3) and Theorem 4 use."""

    def __call__(self, times: Float[np.ndarray, " time"], readings: Float[np.ndarray, "time state"]) -> Rows:
        return readings[:-1], np.diff(readings, axis=0) / np.diff(times)[:, None]


class CentralDifference(AbstractDerivative):
    """Slopes of the parabola through three neighbouring readings, of second order on any spacing.

    At the ends the parabola is the first or the last one. It needs three rows.
    """

    def __call__(self, times: Float[np.ndarray, " time"], readings: Float[np.ndarray, "time state"]) -> Rows:
        _require_three(times, "CentralDifference")
        return readings, np.gradient(readings, times, axis=0, edge_order=2)


class TotalVariation(AbstractDerivative):
    """Slopes of a smoothed path, for noisy readings: total-variation regularisation. Chartrand (2011).

    The path x of each state minimises integral (x - y)^2 dt / 2 + weight * (total variation of x'). Sampled as a
    polygon at the readings this is a convex problem with a banded matrix (the l1 trend filter of Kim, Koh, Boyd and
    Gorinevsky 2009), solved to a relative duality gap of 1e-8, or to round-off (1e-4 at worst). It gives the slope of
    each edge at the edge's middle. Corners, as of relaxation oscillations, stay; smooth motion becomes a staircase.

    Rows with a missing reading are bridged. `weight` is positive, in reading * time^2; larger is smoother. A hundredth
    to a tenth of (error standard deviation) * (data interval) * (period) is a start.

    **Raises:** `InputError` where fewer than three rows are complete, or the weight is too large for the gap.
    """

    weight: float = eqx.field(static=True, converter=float)

    def __check_init__(self):
        if not self.weight > 0:
            raise InputError(f"`TotalVariation` needs a positive weight, but was given {self.weight}.")

    def __call__(self, times: Float[np.ndarray, " time"], readings: Float[np.ndarray, "time state"]) -> Rows:
        whole = np.isfinite(readings).all(axis=1)
        times, readings = times[whole], readings[whole]
        _require_three(times, "TotalVariation")
        path = np.stack([_smooth_path(times, one, self.weight) for one in readings.T], axis=1)
        return 0.5 * (path[1:] + path[:-1]), np.diff(path, axis=0) / np.diff(times)[:, None]


def _require_three(times: np.ndarray, owner: str) -> None:
    if len(times) < 3:
        raise InputError(f"`{owner}` needs at least three complete rows of readings, but was given {len(times)}.")


def _smooth_path(times: np.ndarray, y: np.ndarray, weight: float) -> np.ndarray:
    """argmin_x 1/2 sum w (x - y)^2 + weight |D x|_1, D the jumps of the polygon's slopes, w the trapezoidal rule.

    A primal-dual interior point method on the dual, min z'Qz / 2 - z'Dy over |z| <= weight with Q = D W^-1 D'; then
    x = y - W^-1 D'z. Time is counted in mean intervals and z in units of the weight, so that slacks keep their digits.
    """
    h = np.diff(times) / np.mean(np.diff(times))
    lam = weight / np.mean(np.diff(times)) ** 2
    w = 0.5 * (np.append(h, 0.0) + np.insert(h, 0, 0.0))
    D = scipy.sparse.diags([1 / h[:-1], -1 / h[:-1] - 1 / h[1:], 1 / h[1:]], [0, 1, 2], shape=(len(y) - 2, len(y)))
    if np.sum(np.abs(D @ y)) <= 10 * np.finfo(float).eps * np.sum(abs(D) @ np.abs(y)):
        return y  # a straight line already
    bands = _bands((D @ scipy.sparse.diags(1 / w) @ D.T) * lam)
    z = np.zeros(len(y) - 2)
    above, below = np.ones_like(z), np.ones_like(z)  # 1 - z and 1 + z
    up, low = (np.full_like(z, np.mean(np.abs(D @ y))) for _ in range(2))  # the multipliers of both
    for _ in range(_SMOOTHING_STEPS):
        x = y - lam * (D.T @ z) / w
        jumps = D @ x
        gap, loss = np.sum(np.abs(jumps) - z * jumps), 0.5 * np.sum(w * (x - y) ** 2) / lam + np.sum(np.abs(jumps))
        noise = np.finfo(float).eps * np.sum(abs(D) @ (np.abs(y) + lam * (abs(D).T @ np.abs(z)) / w))
        if gap <= max(_GAP * loss, noise) and noise <= _ROUND_OFF * loss:
            return x
        barrier = 0.1 * (above @ up + below @ low) / (2 * len(z))
        matrix = bands.copy()
        matrix[-1] += up / above + low / below
        dz = scipy.linalg.solveh_banded(matrix, jumps - barrier / above + barrier / below)
        d_up, d_low = (barrier + up * dz) / above - up, (barrier - low * dz) / below - low
        values, steps = np.concatenate([above, below, up, low]), np.concatenate([-dz, dz, d_up, d_low])
        stretch = min(1.0, 0.99 / max(float(np.max(-steps / values)), 1e-300))
        z, above, below = z + stretch * dz, above - stretch * dz, below + stretch * dz
        up, low = up + stretch * d_up, low + stretch * d_low
    raise InputError(
        f"`TotalVariation` with weight {weight:.3g} did not settle in {_SMOOTHING_STEPS} steps; choose a smaller one."
    )


def _bands(matrix: Any) -> np.ndarray:
    """The upper bands of a symmetric pentadiagonal matrix, as `solveh_banded` takes them."""
    bands = np.zeros((3, matrix.shape[0]))
    for k in range(min(3, matrix.shape[0])):
        bands[2 - k, k:] = matrix.diagonal(k)
    return bands


class AbstractPenalty(eqx.Module):
    """How coefficients are kept few."""

    @abc.abstractmethod
    def __call__(self, features: Float[np.ndarray, "row term"], slopes: Float[np.ndarray, " row"]) -> Solution:
        """The coefficients of one state's equation, whether they are final, and the steps taken."""


class Lasso(AbstractPenalty):
    """The L1 penalty: the theta that minimises, exactly as (4.3),

    sum_k ||(y_k - y_{k-1})/dt - Xi(y_{k-1}) theta||^2 + weight |theta|_1

    (with another derivative, its points and slopes). By Theorem 4, corrected, a Laplace prior of density
    exp(-rate |theta|) on a model with unit process noise is weight = 2 rate / dt^2.

    Sweeps of coordinate descent, each followed by the exact minimum on the signs it found, end where the optimality
    conditions hold to 1e-10 of the largest possible slope. Coordinate descent alone crawls if features are alike.
    A weight near 0 on features that are almost dependent may end unconverged. **Arguments:** `weight` - at least 0;
    `max_sweeps`.
    """

    weight: float = eqx.field(static=True, converter=float)
    max_sweeps: int = eqx.field(static=True, default=1000)

    def __check_init__(self):
        if not self.weight >= 0:
            raise InputError(f"`Lasso` needs a weight of at least 0, but was given {self.weight}.")

    def __call__(self, features: Float[np.ndarray, "row term"], slopes: Float[np.ndarray, " row"]) -> Solution:
        # Columns of length 1, the weight divided likewise: the same problem, better conditioned.
        lengths = _lengths(features)
        X, lam = features / lengths, self.weight / lengths
        G, c = X.T @ X, X.T @ slopes
        theta = np.zeros(len(c))
        for sweep in range(1, self.max_sweeps + 1):
            theta = _finish_signs(G, c, lam, _sweep(G, c, lam, theta))
            pull = 2 * X.T @ (slopes - X @ theta)
            missed = np.where(theta != 0, np.abs(pull - lam * np.sign(theta)), np.maximum(np.abs(pull) - lam, 0.0))
            if np.max(missed) <= _OPTIMAL * 2 * np.linalg.norm(slopes):
                return theta / lengths, True, sweep
        return theta / lengths, False, self.max_sweeps


def _lengths(features: np.ndarray) -> np.ndarray:
    """The columns' Euclidean lengths, 1 for a column of zeros."""
    lengths = np.linalg.norm(features, axis=0)
    return np.where(lengths > 0, lengths, 1.0)


def _sweep(G: np.ndarray, c: np.ndarray, lam: np.ndarray, theta: np.ndarray) -> np.ndarray:
    """Each coordinate in turn at its minimum: a soft threshold."""
    theta = theta.copy()
    for i in np.flatnonzero(np.diagonal(G)):
        rest = c[i] - G[i] @ theta + G[i, i] * theta[i]
        theta[i] = np.sign(rest) * max(abs(rest) - 0.5 * lam[i], 0.0) / G[i, i]
    return theta


def _finish_signs(G: np.ndarray, c: np.ndarray, lam: np.ndarray, theta: np.ndarray) -> np.ndarray:
    """Straight towards the minimum for the present signs; a coefficient that reaches zero on the way leaves."""
    theta = theta.copy()
    while (kept := np.flatnonzero(theta)).size:
        here, block = theta[kept], G[np.ix_(kept, kept)]
        slope = c[kept] - 0.5 * lam[kept] * np.sign(here) - block @ here
        step = np.linalg.lstsq(block, slope, rcond=1e-12)[0]
        # Features that depend on each other: what they cannot fit only shortens theta, until a sign changes.
        rest = slope - block @ step
        if np.max(np.abs(rest)) > max(1e-6 * np.min(lam[kept]), 1e-13 * np.linalg.norm(c)):
            step = rest
        reach = np.divide(-here, step, where=here * step < 0, out=np.full_like(here, np.inf))
        first, bend = int(np.argmin(reach)), step @ block @ step
        stretch = min(reach[first], step @ slope / bend if bend > 0 else np.inf)
        if not (np.isfinite(stretch) and stretch > 0):
            break  # round-off alone
        theta[kept] = here + stretch * step
        if stretch < reach[first]:
            break
        theta[kept[first]] = 0.0
    return theta


class SequentialThresholding(AbstractPenalty):
    """Least squares again and again without the coefficients below a threshold. Brunton, Proctor and Kutz (2016).

    Each fit minimises ||x' - Xi theta||^2 + ridge |theta|^2 on the terms left, the last one included.

    **Arguments:** `threshold` - in the units of the coefficients, at least 0; `ridge` - at least 0; `max_steps`.

    **Raises:** `InputError` where the data do not determine the coefficients and `ridge` is 0.
    """

    threshold: float = eqx.field(static=True, converter=float)
    ridge: float = eqx.field(static=True, converter=float, default=0.0)
    max_steps: int = eqx.field(static=True, default=20)

    def __check_init__(self):
        if not (self.threshold >= 0 and self.ridge >= 0):
            given = f"{self.threshold} and {self.ridge}"
            raise InputError(f"`SequentialThresholding` needs a threshold and a ridge of at least 0, but got {given}.")

    def __call__(self, features: Float[np.ndarray, "row term"], slopes: Float[np.ndarray, " row"]) -> Solution:
        terms = features.shape[1]
        rank = np.linalg.matrix_rank(features / _lengths(features))
        if self.ridge == 0 and rank < terms:
            raise InputError(
                f"The library has {terms} terms, but the data tell only {rank} of them apart; give more readings, "
                "fewer terms, or a `ridge` above 0."
            )
        kept = np.ones(terms, dtype=bool)
        theta = self._fit(features, slopes, kept)
        for step in range(1, self.max_steps + 1):
            still = kept & (np.abs(theta) >= self.threshold)
            if np.array_equal(still, kept):
                return theta, True, step
            kept, theta = still, self._fit(features, slopes, still)
        return theta, False, self.max_steps

    def _fit(self, features: np.ndarray, slopes: np.ndarray, kept: np.ndarray) -> np.ndarray:
        # Dividing by the columns' lengths does not move the minimum.
        X, theta = features[:, kept], np.zeros(features.shape[1])
        lengths = _lengths(X)
        stacked = np.vstack([X, np.sqrt(self.ridge) * np.eye(X.shape[1])]) / lengths
        theta[kept] = np.linalg.lstsq(stacked, np.append(slopes, np.zeros(X.shape[1])), rcond=None)[0] / lengths
        return theta


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
