"""Simple laws of force with a shape of their own, which the missing force shows: a knee, teeth, one place."""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
import sympy
from jaxtyping import Bool, Float

from .._effects import Nameless
from .._simulation_records import SimulationFile
from .._symbolic import derivative
from ._along import along, force
from ._outlook import Outlook
from ._unnamed import along_path

# Knees, as shares of how far the coordinate goes; teeth in a turn; places of the swing and widths, as shares of it.
_KNEES, _TEETH = np.geomspace(0.01, 1.0, 13), range(1, 25)
_PLACES, _WIDTHS = np.linspace(0.05, 0.95, 19), np.geomspace(0.03, 0.25, 5)
# Members of a family that are weighed first, so many steps apart, and what share of the missing force each must
# explain, beside what a constant, the place and the speed do. What is smoothed shows the sharp ones too little.
_FIRST, _APART, _EXPLAINED = 3, 3, 0.05
# Steps to the members that are tried about one.
_STEPS = (-2, -1, 1, 2)
# Forces that are the same but for round-off.
_SAME = 1e-9


@dataclass(frozen=True)
class Family:
    """Laws on one coordinate that differ in nothing but their shape, by their places on a grid."""

    laws: dict[tuple[int, ...], Nameless]

    def first(self, shares: Float[np.ndarray, " law"]) -> list[Nameless]:
        """Those that explain most, some steps apart."""
        chosen: list[tuple[int, ...]] = []
        ranked = [list(self.laws)[k] for k in np.argsort(-shares) if shares[k] > _EXPLAINED]
        for place in ranked:
            if len(chosen) < _FIRST and all(np.max(np.abs(np.subtract(place, one))) >= _APART for one in chosen):
                chosen.append(place)
        return [self.laws[place] for place in chosen]

    def near(self, law: Nameless) -> list[Nameless]:
        """Those next to one, along each axis of the grid; none where it is of another family."""
        place = next((place for place, one in self.laws.items() if one.words == law.words), None)
        if place is None:
            return []
        steps = [step * np.eye(len(place), dtype=int)[axis] for axis in range(len(place)) for step in _STEPS]
        moved = [tuple(int(x) for x in place + step) for step in steps]
        return [self.laws[one] for one in moved if one in self.laws]


class Shapes:
    """What families of laws a motion bounds; `outlooks`, one a recording, are of the simulation without effects."""

    def __init__(self, file: SimulationFile, outlooks: Sequence[Outlook]):
        self.file, self.outlooks = file, outlooks
        self._points = [_points(o, len(file.coordinates)) for o in outlooks]
        self.families = self._families() if outlooks else []

    def first(self) -> list[Nameless]:
        """Of each family the laws whose shapes explain most of the missing force."""
        out = list[Nameless]()
        for family in self.families:
            laws = list(family.laws.values())
            (i,) = laws[0].places
            missing = np.concatenate([o.missing_force()[:, i] for o in self.outlooks])
            plain, shapes = self._values(_plain(self.file, i)), self._values([t for law in laws for t in law.pushes[0]])
            out += family.first(_explained(plain, shapes.reshape(len(shapes), len(laws), -1), missing))
        return out

    def near(self, law: Nameless | None) -> list[Nameless]:
        """Laws of the same family with shapes next to this one's; none of what has no family."""
        return [] if law is None else [one for family in self.families for one in family.near(law)]

    def _families(self) -> list[Family]:
        points, turning = np.concatenate(self._points), _turning(self.outlooks[0], self._points[0])
        out = list[Family]()
        for i, name in enumerate(self.file.coordinates):
            (_, q, v), low, high = _plain(self.file, i), float(points[:, i].min()), float(points[:, i].max())
            if low < high:
                out.append(_saturating(i, name, q, max(-low, high)))
                out += [_cogging(i, name, q)] if turning[i] else _at_one_place(i, name, q, v, low, high)
        return out

    def _values(self, terms: Iterable[sympy.Expr]) -> Float[np.ndarray, "row term"]:
        """Terms along the smoothed motion of all recordings."""
        columns, terms = list[np.ndarray](), list(terms)
        for o, x in zip(self.outlooks, self._points, strict=True):
            fixed = o.stepper.problem.parameter_values(o.recording, o.estimate.z)[: len(self.file.parameters)]
            columns.append(along_path(self.file, terms, fixed, x, o.rows.inputs[: len(x)], o.rows.times[: len(x)]))
        return np.concatenate(columns)


def _family(laws: dict[tuple[int, ...], Nameless]) -> Family:
    """Each member is chosen from all of them."""
    return Family({place: replace(law, choices=float(np.log(len(laws)))) for place, law in laws.items()})


def _plain(file: SimulationFile, i: int) -> tuple[sympy.Expr, sympy.Expr, sympy.Expr]:
    """What hides no shape: a constant, the place and the speed."""
    states = file.symbols
    return sympy.Integer(1), states[file.coordinates[i]], derivative(file.hamiltonian.tree, states[file.momenta[i]])


def _saturating(i: int, name: str, q: sympy.Expr, far: float) -> Family:
    def law(rate: float) -> Nameless:
        words = f"goes with {name} and saturates from {1 / rate:.2g} on"
        return Nameless((i,), ((-sympy.tanh(rate * q),),), words=words, kind="conservative")

    return _family({(k,): law(_rounded(1 / (share * far))) for k, share in enumerate(_KNEES)})


def _cogging(i: int, name: str, q: sympy.Expr) -> Family:
    def law(n: int) -> Nameless:
        words = f"goes up and down {n} times in a turn of {name}, as where teeth cog"
        return Nameless((i,), ((sympy.cos(n * q), sympy.sin(n * q)),), words=words, kind="conservative")

    return _family({(n,): law(n) for n in _TEETH})


def _at_one_place(i: int, name: str, q: sympy.Expr, v: sympy.Expr, low: float, high: float) -> list[Family]:
    """Brakes, and hollows."""

    def brake(place: float, width: float) -> Nameless:
        words = f"goes with its speed, about {_where(name, place, width)}"
        return Nameless((i,), ((-_near(q, place, width) * v,),), words=words, kind="dissipation")

    def hollow(place: float, width: float) -> Nameless:
        words = f"comes from a hollow or a bump of the potential energy, about {_where(name, place, width)}"
        push = -_near(q, place, width) * (q - place)
        return Nameless((i,), ((push,),), words=words, kind="conservative")

    def every(law: Callable[[float, float], Nameless]) -> Family:
        digits = 2 - math.floor(math.log10(high - low))  # of the swing's hundredths, however far from zero it is
        places = [round(low + share * (high - low), digits) for share in _PLACES]
        widths = [_rounded(share * (high - low)) for share in _WIDTHS]
        grid = product(enumerate(places), enumerate(widths))
        return _family({(a, b): law(place, width) for (a, place), (b, width) in grid})

    return [every(brake), every(hollow)]


def _where(name: str, place: float, width: float) -> str:
    return f"{name} = {place} alone, within {width:g}"


def _near(q: sympy.Expr, place: float, width: float) -> sympy.Expr:
    return sympy.exp(-_rounded(0.5 / width**2) * (q - place) ** 2)


def _rounded(value: float) -> float:
    """Two digits, which is how a law is told."""
    return float(f"{value:.2g}")


def _points(o: Outlook, d: int) -> Float[np.ndarray, "row two_d"]:
    """The smoothed phase points of the file's own coordinates, at the rows that are fitted."""
    means, width = np.asarray(o.smoothed.means[: o.rows.fitted]), o.stepper.problem.equations.width
    return np.concatenate([means[:, :d], means[:, width : width + d]], axis=1)


def _turning(o: Outlook, points: Float[np.ndarray, "row two_d"]) -> Bool[np.ndarray, " d"]:
    """Which coordinates go round, a whole turn of which changes no force."""
    means, d = np.asarray(o.smoothed.means[: o.rows.fitted]), points.shape[1] // 2
    out = np.ptp(points[:, :d], axis=0) >= 2 * np.pi
    for i in np.flatnonzero(out):
        turned = means + 2 * np.pi * (np.arange(means.shape[1]) == i)
        here, there = (along(o.stepper.problem, force, o.recording, o.estimate.z, (), x) for x in (means, turned))
        out[i] = np.allclose(here, there, rtol=_SAME, atol=_SAME * np.abs(here).max())
    return out


def _explained(
    plain: Float[np.ndarray, "row plain"], shapes: Float[np.ndarray, "row shape term"], push: Float[np.ndarray, " row"]
) -> Float[np.ndarray, " shape"]:
    """The share of a force that each shape explains of what the plain terms leave."""
    total = _left(plain, push)
    rests = [_left(np.concatenate([plain, shapes[:, k]], axis=1), push) for k in range(shapes.shape[1])]
    return 1.0 - np.array(rests) / total if total > 0 else np.zeros(len(rests))


def _left(columns: Float[np.ndarray, "row term"], push: Float[np.ndarray, " row"]) -> float:
    scale = np.linalg.norm(columns, axis=0)
    scaled = columns / np.where(scale > 0, scale, 1.0)
    return float(((push - scaled @ np.linalg.lstsq(scaled, push, rcond=None)[0]) ** 2).sum())
