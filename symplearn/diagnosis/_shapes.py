"""Simple laws of force with a shape of their own, which the missing force shows: a knee, teeth, one place."""

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
import sympy
from jaxtyping import Bool, Float

from .._effects import Nameless
from .._simulation_records import SimulationFile
from .._symbolic import derivative
from ._along import along, force
from ._law_text import moment
from ._locate import strained_coordinates
from ._outlook import Outlook
from ._sweeps import Sweep, swept
from ._unnamed import along_outlooks, missing, points

# Knees, as shares of how far the coordinate goes; teeth in a turn, or waves in a swing; places of the swing and widths,
# as shares of it.
_KNEES, _TEETH, _WAVES = np.geomspace(0.01, 1.0, 13), np.arange(1.0, 25.0), np.arange(2.0, 24.0, 0.2)
_PLACES, _WIDTHS = np.linspace(0.05, 0.95, 19), np.geomspace(0.03, 0.25, 5)
# Members of a family that are weighed first, so many steps apart, and what share of the missing force each must
# explain, beside what a constant, the place and the speed do. What is smoothed shows the sharp ones too little. Of all
# families so many, those that explain most.
_FIRST, _APART, _EXPLAINED, _MOST = 3, 3, 0.05, 12
# How far the frequencies of a sweep are moved each way: by steps that shift the phase at one end by so many cycles.
# None is slower than a share of what it was.
_EITHER_WAY, _APART_IN_PHASE, _SLOWEST = 8, 0.05, 0.1
# Share of the prior of what has no name that all families have, beside that of simple laws.
_SHARE = 0.25
# Forces that are the same but for round-off.
_SAME = 1e-9

Place = tuple[float, ...]


@dataclass(frozen=True, eq=False)
class Family:
    """Laws on one coordinate that differ in nothing but their shape: the numbers that `law` takes, each from an axis.

    A place is one index for each axis, between two of which shapes are interpolated, unless the numbers are `counts`.
    With `choices` its middle was chosen from so many already (their logarithm), and is where it begins.
    """

    law: Callable[..., Nameless]
    axes: tuple[Float[np.ndarray, " _"], ...]
    counts: bool = False
    choices: float | None = None

    def places(self) -> list[Place]:
        """Of the grid."""
        if self.choices is not None:
            return [tuple((len(axis) - 1) / 2 for axis in self.axes)]
        return [tuple(map(float, place)) for place in product(*(range(len(axis)) for axis in self.axes))]

    def at(self, place: Place, step: float = 1.0) -> Nameless:
        """One law, chosen from as many as there are that far apart."""
        shape = [float(np.interp(x, np.arange(len(axis)), axis)) for x, axis in zip(place, self.axes, strict=True)]
        choices = sum(np.log(len(axis)) for axis in self.axes) if self.choices is None else self.choices
        return replace(self.law(*shape), choices=float(choices - len(self.axes) * np.log(step)))

    def first(self, shares: Float[np.ndarray, " place"]) -> list[Place]:
        """Those of the grid that explain most, some steps apart."""
        chosen, every = list[Place](), self.places()
        for place in (every[k] for k in np.argsort(-shares) if shares[k] > _EXPLAINED):
            if len(chosen) < _FIRST and all(np.max(np.abs(np.subtract(place, one))) >= _APART for one in chosen):
                chosen.append(place)
        return chosen

    def near(self, place: Place, steps: Sequence[float]) -> list[tuple[Place, float]]:
        """Those so many steps away along each axis, with the step."""
        out = list[tuple[Place, float]]()
        for axis, step, sign in product(range(len(place)), steps, (-1, 1)):
            moved = tuple(x + sign * step * (k == axis) for k, x in enumerate(place))
            if 0 <= moved[axis] <= len(self.axes[axis]) - 1 and (step >= 1 or not self.counts):
                out.append((moved, min(step, 1.0)))
        return out


class Shapes:
    """What families of laws a motion bounds, each one choice of all. `outlooks`, one a recording, are of the simulation
    without effects."""

    def __init__(self, file: SimulationFile, outlooks: Sequence[Outlook]):
        self.file, self.outlooks = file, outlooks
        self._families = dict(self._on_each()) if outlooks else {}
        self._made: dict[str, tuple[Family, Place]] = {}

    def first(self) -> list[Nameless]:
        """Of each family the laws whose shapes explain most of the missing force."""
        out = list[tuple[float, Nameless]]()
        for family, i in self._families.items():
            laws = [family.at(place) for place in family.places()]
            terms = [*_plain(self.file, i), *(term for law in laws for term in law.pushes[0])]
            values = along_outlooks(self.file, terms, self.outlooks)
            shapes = values[:, 3:].reshape(len(values), len(laws), -1)
            shares = _explained(values[:, :3], shapes, missing(self.outlooks)[:, i])
            share = dict(zip(family.places(), shares, strict=True))
            for place in family.first(shares):
                out += [(share[place], law) for law in self._new(family, [(place, 1.0)])]
        return [law for _, law in sorted(out, key=lambda one: -one[0])[:_MOST]]

    def has(self, law: Nameless | None) -> bool:
        """Whether a law is of one of the families."""
        return law is not None and law.words in self._made

    def near(self, law: Nameless, steps: Sequence[float]) -> list[Nameless]:
        """Laws of the same family so many steps away that were not told before."""
        family, place = self._made[law.words]
        return self._new(family, family.near(place, steps))

    def _new(self, family: Family, listed: Iterable[tuple[Place, float]]) -> list[Nameless]:
        out = list[Nameless]()
        for place, step in listed:
            law = family.at(place, step)
            law = replace(law, choices=law.choices + float(np.log(len(self._families) / _SHARE)))
            if law.words not in self._made:
                self._made[law.words] = family, place
                out.append(law)
        return out

    def _on_each(self) -> Iterator[tuple[Family, int]]:
        """Families, and which coordinate they are on."""
        every = [points(self.file, o) for o in self.outlooks]
        ends, turning = np.concatenate(every), _turning(self.outlooks[0], every[0])
        known = range(len(self.file.coordinates))  # those of known unseen oscillators follow them
        for i in set(known) & set(strained_coordinates(self.outlooks)):
            (_, q, v), low, high = _plain(self.file, i), float(ends[:, i].min()), float(ends[:, i].max())
            name = self.file.coordinates[i]
            if low < high:
                some = [_saturating(i, name, q, max(-low, high))]
                some += [_cogging(i, name, q)] if turning[i] else _in_a_swing(i, name, q, v, low, high)
                some += self._sweeping(i, name) if len(self.outlooks) == 1 else []
                yield from ((family, i) for family in some)

    def _sweeping(self, i: int, name: str) -> list[Family]:
        """Of one recording: clocks of several begin anew."""
        (o,) = self.outlooks
        push, plain = missing(self.outlooks)[:, i], along_outlooks(self.file, _plain(self.file, i), self.outlooks)
        finite = np.isfinite(push) & np.isfinite(plain).all(1)
        times = o.rows.times[: len(push)][finite]
        return [_sweep(i, name, *one) for one in swept(times, push[finite], plain[finite])]


def _plain(file: SimulationFile, i: int) -> tuple[sympy.Expr, sympy.Expr, sympy.Expr]:
    """What hides no shape: a constant, the place and the speed."""
    states = file.symbols
    return sympy.Integer(1), states[file.coordinates[i]], derivative(file.hamiltonian.tree, states[file.momenta[i]])


def _saturating(i: int, name: str, q: sympy.Expr, far: float) -> Family:
    def law(share: float) -> Nameless:
        rate = _rounded(1 / (share * far), 2)
        words = f"goes with {name} and saturates from {1 / rate:.2g} on"
        return Nameless((i,), ((-sympy.tanh(rate * q),),), words=words, kind="conservative")

    return Family(law, (_KNEES,))


def _cogging(i: int, name: str, q: sympy.Expr) -> Family:
    def law(teeth: float) -> Nameless:
        n = round(teeth)
        words = f"goes up and down {n} times in a turn of {name}, as where teeth cog"
        return Nameless((i,), ((sympy.cos(n * q), sympy.sin(n * q)),), words=words, kind="conservative")

    return Family(law, (_TEETH,), counts=True)


def _in_a_swing(i: int, name: str, q: sympy.Expr, v: sympy.Expr, low: float, high: float) -> list[Family]:
    """Waves, a brake, and a hollow."""
    span = high - low
    digits = 2 - math.floor(math.log10(span))  # of the swing's hundredths, however far from zero it is

    def wave(number: float) -> Nameless:
        k = _rounded(2 * np.pi * number / span, 4)
        words = f"goes up and down every {2 * np.pi / k:.4g} of {name}, as where teeth cog"
        return Nameless((i,), ((sympy.cos(k * q), sympy.sin(k * q)),), words=words, kind="conservative")

    def brake(share: float, wide: float) -> Nameless:
        near, apart, where = about(share, wide)
        return Nameless((i,), ((-near * v,),), words=f"goes with its speed, {where}", kind="dissipation")

    def hollow(share: float, wide: float) -> Nameless:
        near, apart, where = about(share, wide)
        words = f"comes from a hollow or a bump of the potential energy, {where}"
        return Nameless((i,), ((-near * apart,),), words=words, kind="conservative")

    def about(share: float, wide: float) -> tuple[sympy.Expr, sympy.Expr, str]:
        place, width = round(low + share * span, digits), _rounded(wide * span, 2)
        apart = q - place
        near = sympy.exp(-_rounded(0.5 / width**2, 2) * apart**2)
        return near, apart, f"about {name} = {place} alone, within {width:g}"

    return [Family(wave, (_WAVES,)), Family(brake, (_PLACES, _WIDTHS)), Family(hollow, (_PLACES, _WIDTHS))]


def _sweep(i: int, name: str, middle: Sweep, number: int) -> Family:
    def law(first: float, last: float) -> Nameless:
        moved = replace(middle, first=_rounded(first, 7), last=_rounded(last, 7))
        begin, end = (f"{2 * np.pi / one:.6g} at t = {moment(t)}"
                      for one, t in ((moved.first, moved.start), (moved.last, moved.start + moved.span)))  # fmt: skip
        as_what = " and the square of its frequency, as of an unbalance" if middle.grows else ""
        words = f"swings in time, on {name}, with a period from {begin} to {end}{as_what}"
        return Nameless((i,), (moved.terms(),), words=words, kind="forcing")

    apart = _APART_IN_PHASE * 4 * np.pi / middle.span * np.arange(-_EITHER_WAY, _EITHER_WAY + 1)
    axes = tuple(np.maximum(end + apart, _SLOWEST * end) for end in (middle.first, middle.last))
    return Family(law, axes, choices=float(np.log(number)))


def _rounded(value: float, digits: int) -> float:
    """As a law is told."""
    return float(f"{value:.{digits}g}")


def _turning(o: Outlook, points: Float[np.ndarray, "row two_d"]) -> Bool[np.ndarray, " d"]:
    """Which coordinates go round, a whole turn of which changes no force."""
    means, d = o.states, points.shape[1] // 2
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
    finite = np.isfinite(plain).all(1) & np.isfinite(shapes).all((1, 2)) & np.isfinite(push)
    plain, shapes, push = plain[finite], shapes[finite], push[finite]
    total = _left(plain, push)
    rests = [_left(np.concatenate([plain, shapes[:, k]], axis=1), push) for k in range(shapes.shape[1])]
    return 1.0 - np.array(rests) / total if total > 0 else np.zeros(len(rests))


def _left(columns: Float[np.ndarray, "row term"], push: Float[np.ndarray, " row"]) -> float:
    scale = np.linalg.norm(columns, axis=0)
    scaled = columns / np.where(scale > 0, scale, 1.0)
    return float(((push - scaled @ np.linalg.lstsq(scaled, push, rcond=None)[0]) ** 2).sum())
