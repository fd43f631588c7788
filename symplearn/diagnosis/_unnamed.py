"""A missing force that no name fits: a sparse expression in position, velocity and inputs, kept where it is stable."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import combinations_with_replacement

import numpy as np
import sympy
from jaxtyping import Float

from .._effects import Nameless
from .._expression import Expression
from .._kinks import Absolute, Sign
from .._simulation_records import SimulationFile
from .._simulation_text import worded
from .._symbolic import derivative, numpy_function
from ._outlook import Outlook

# Highest degree of the monomials, and the most terms of an expression.
_DEGREE, _TERMS = 3, 3
# Stretches the recording is cut into, halves of them that are drawn, and in what share of them a term must be chosen.
_STRETCHES, _HALVES, _STABLE = 12, 24, 0.7
# A term is taken up while it lowers the unexplained variance by this share at least.
_GAIN = 0.03
# An expression that explains less of the smoothed missing force than this is not worth a fit.
_EXPLAINED = 0.2


@dataclass(frozen=True)
class Proposal:
    """A force on one coordinate, with what each of its terms is multiplied by."""

    force: Nameless
    sizes: tuple[float, ...]


def proposals(file: SimulationFile, outlooks: Sequence[Outlook], coordinates: Sequence[int]) -> list[Proposal]:
    """A stable expression for the missing force on each of some coordinates, where there is one.

    `outlooks` hold the missing force of the simulation without effects, by recording.
    """
    terms = library(file)
    values, push, out = along_outlooks(file, terms, outlooks), missing(outlooks), list[Proposal]()
    for i in coordinates:
        chosen, sizes, explained = stable_terms(values, push[:, i])
        if chosen and explained > _EXPLAINED:
            choices = float(np.log(math.comb(len(terms), len(chosen))))
            one = Nameless((i,), (tuple(terms[k] for k in chosen),), choices)
            out.append(Proposal(one, tuple(float(x) for x in sizes)))
    return out


def written(terms: Sequence[sympy.Expr], sizes: Iterable[float]) -> Expression:
    """The force as an expression of the simulation's names."""
    return worded(
        sympy.Add(*(sympy.Float(float(f"{size:.6g}"), 8) * term for term, size in zip(terms, sizes, strict=True)))
    )


def library(file: SimulationFile) -> list[sympy.Expr]:
    """Products of coordinates and velocities up to a degree, |v| v and sign(v), inputs, and inputs times those."""
    states = file.symbols
    v = [derivative(file.hamiltonian.tree, states[p]) for p in file.momenta]
    letters = [states[q] for q in file.coordinates] + v
    out: list[sympy.Expr] = [sympy.Integer(1)]
    for degree in range(1, _DEGREE + 1):
        if degree == _DEGREE and len(letters) > 4:
            break
        out += [sympy.Mul(*chosen) for chosen in combinations_with_replacement(letters, degree)]
    out += [form for one in v for form in (Absolute(one) * one, Sign(one))]
    inputs = [states[u] for u in file.recording.inputs]
    return out + inputs + [u * letter for u in inputs for letter in letters]


def missing(outlooks: Sequence[Outlook]) -> Float[np.ndarray, "row coordinate"]:
    """The smoothed missing force at the rows of all recordings."""
    return np.concatenate([o.missing_force() for o in outlooks])


def along_outlooks(
    file: SimulationFile, terms: Sequence[sympy.Expr], outlooks: Sequence[Outlook]
) -> Float[np.ndarray, "row term"]:
    """Terms along the smoothed motion at those rows."""
    columns = []
    for o in outlooks:
        fixed, x = (
            o.stepper.problem.parameter_values(o.recording, o.estimate.z)[: len(file.parameters)],
            points(file, o),
        )
        columns.append(along_path(file, terms, fixed, x, o.rows.inputs[: len(x)], o.rows.times[: len(x)]))
    return np.concatenate(columns)


def points(file: SimulationFile, o: Outlook) -> Float[np.ndarray, "row two_d"]:
    """The smoothed phase points of the file's own coordinates."""
    d, width = len(file.coordinates), o.stepper.problem.equations.width
    return np.concatenate([o.states[:, :d], o.states[:, width : width + d]], axis=1)


def along_path(
    file: SimulationFile, terms: Sequence[sympy.Expr], parameters: np.ndarray, path: np.ndarray, inputs: np.ndarray,
    times: np.ndarray,
) -> Float[np.ndarray, "row term"]:  # fmt: skip
    """Values of terms along a path (row, 2d) of phase points."""
    names = [*file.states, *file.parameters, *file.recording.inputs, "t"]
    function = numpy_function(list(terms), [file.symbols[name] for name in names])
    fixed = np.broadcast_to(parameters[:, None], (len(parameters), len(path)))
    with np.errstate(all="ignore"):
        known = inputs.T[: len(file.recording.inputs)]
        return np.asarray(function(np.concatenate([path.T, fixed, known, times[None]]))).T


def stable_terms(
    columns: Float[np.ndarray, "row term"], force: Float[np.ndarray, " row"]
) -> tuple[list[int], np.ndarray, float]:
    """Terms that are chosen in most halves of the rows, their coefficients, and the share of the force explained."""
    scale = np.sqrt((columns**2).mean(0))
    usable = np.isfinite(scale) & (scale > 0)
    scaled = np.where(usable, columns / np.where(usable, scale, 1.0), 0.0)
    rng, number = np.random.default_rng(0), np.zeros(columns.shape[1])
    stretch = np.minimum(np.arange(len(force)) * _STRETCHES // len(force), _STRETCHES - 1)
    for _ in range(_HALVES):
        half = np.isin(stretch, rng.choice(_STRETCHES, _STRETCHES // 2, replace=False))
        number[_forward(scaled[half], force[half])] += 1
    chosen = [int(k) for k in np.argsort(-number) if number[k] >= _STABLE * _HALVES][:_TERMS]
    if not chosen:
        return [], np.zeros(0), 0.0
    sizes = np.linalg.lstsq(scaled[:, chosen], force, rcond=None)[0]
    left = force - scaled[:, chosen] @ sizes
    return chosen, sizes / scale[chosen], 1.0 - float((left**2).sum() / max((force**2).sum(), 1e-300))


def _forward(columns: np.ndarray, force: np.ndarray) -> list[int]:
    """Forward selection: the term that explains most, then the next one beside it."""
    chosen: list[int] = []
    total = left = float((force**2).sum())
    for _ in range(_TERMS):
        losses = np.full(columns.shape[1], np.inf)
        for k in set(range(columns.shape[1])) - set(chosen):
            some = columns[:, [*chosen, k]]
            losses[k] = ((force - some @ np.linalg.lstsq(some, force, rcond=None)[0]) ** 2).sum()
        best = int(np.argmin(losses))
        if left - losses[best] < _GAIN * total:
            break
        chosen, left = [*chosen, best], float(losses[best])
    return chosen
