"""What is asked: recordings, the augmented simulation, what is calibrated and its priors.

The unknowns of one combination of effects are one vector z = [x_0 of every recording, calibrated values, slots].
A slot holds one value of an effect of the combination; which effect is data, so that nothing is compiled anew.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int

import integrators as ig

from .._augmented import Equations
from .._effects import HIDDEN, NOISE, OUTLIERS, Candidate, Oscillating
from .._rows import Rows

# Effects in the largest combination, and in the largest that has one at a place or without a word: what a real motion
# leaves rarely has a name, and a fourth frequency, time or threshold suits itself to that.
MOST, USUAL = 5, 3
_FEW = 4  # recordings of which an effect may be in any
SLOTS = 9  # values of the largest combination: three of three each, or five of fewer

# Numbers of members of a problem, in increasing order: effects on targets, in all recordings or in some.
Combination = tuple[int, ...]


@dataclass(frozen=True)
class Member:
    """An effect on a target that may be left out, and the recordings (from 0) that it is in."""

    candidate: Candidate
    recordings: tuple[int, ...]


@dataclass(frozen=True)
class Calibrated:
    """The values that are calibrated with every combination: parameters first, then coefficients of known terms.

    `place` (f,) is where each stands in the parameter or coefficient vector; `parameters` is how many are parameters.
    """

    names: tuple[str, ...]
    place: Int[np.ndarray, " f"]
    parameters: int
    mean: Float[np.ndarray, " f"]
    sd: Float[np.ndarray, " f"]  # inf where the prior is flat
    lower: Float[np.ndarray, " f"]
    upper: Float[np.ndarray, " f"]
    recordings: Float[np.ndarray, "recording f"]  # 1 where it acts, 0 where a term is not in the recording

    @cached_property
    def size(self) -> int:
        return len(self.names)


@dataclass(frozen=True)
class InitialPrior:
    """Prior of the phase point at the first row: sd 0 where it is known, inf where nothing is."""

    mean: Float[np.ndarray, " state"]
    sd: Float[np.ndarray, " state"]


@dataclass(frozen=True, eq=False)
class Problem:
    """A simulation and its recordings, ready to be fitted with any combination of effects."""

    equations: Equations
    integrator: ig.AbstractIntegrator
    rows: tuple[Rows, ...]
    parameters: Float[np.ndarray, "recording parameter"]  # known ones, and starting values of the calibrated
    terms: Float[np.ndarray, "recording coefficient"]  # coefficients already in the simulation
    calibrated: Calibrated
    initial: InitialPrior
    noise: Float[np.ndarray, " channel"]  # sd of one original reading, nan where it is estimated
    searched: tuple[int, ...]  # members that may be reported and are in all recordings
    units: dict[str, str]
    latest: float  # how late a sensor may be
    known_outliers: tuple[int, ...] = ()  # columns whose outliers the file knows of

    @cached_property
    def state(self) -> int:
        """Dimension of the phase space."""
        return 2 * self.equations.width

    @cached_property
    def channels(self) -> int:
        return len(self.equations.columns)

    @cached_property
    def head(self) -> int:
        """Where the calibrated values start in z."""
        return self.state * len(self.rows)

    @cached_property
    def slots(self) -> int:
        """Where the values of effects start in z."""
        return self.head + self.calibrated.size

    @cached_property
    def size(self) -> int:
        """Length of z."""
        return self.slots + SLOTS

    @cached_property
    def members(self) -> tuple[Member, ...]:
        """Every effect on every target: in all recordings, and after those in some of them only: of more than a few
        in one, or in all but one."""
        every = tuple(range(len(self.rows)))
        sizes = range(1, len(every)) if len(every) <= _FEW else (1, len(every) - 1)
        some = [which for size in sizes for which in itertools.combinations(every, size)]
        candidates = self.equations.candidates
        return tuple(Member(c, which) for which in (every, *some) for c in candidates)

    def variants(self, member: int) -> list[int]:
        """The same effect and target in some of the recordings only."""
        number = len(self.equations.candidates)
        return list(range(member % number + number, len(self.members), number))

    def whole(self, member: int) -> int:
        """The same effect and target in all recordings."""
        return member % len(self.equations.candidates)

    def candidate(self, member: int) -> Candidate:
        return self.members[member].candidate

    def placed(self, combination: Sequence[int]) -> list[tuple[int, slice]]:
        """Members with where their values stand in z."""
        known, key = self._placed, tuple(combination)
        if key not in known:
            sizes = [self.candidate(member).effect.size for member in key]
            ends = np.cumsum([self.slots, *sizes]).tolist()
            known[key] = [(m, slice(a, b)) for m, a, b in zip(key, ends[:-1], ends[1:], strict=True)]
        return list(known[key])

    @cached_property
    def _placed(self) -> dict[tuple[int, ...], list[tuple[int, slice]]]:
        """What was asked of `placed` before."""
        return {}

    def carried(
        self, z: Float[np.ndarray, " z"], before: Combination, combination: Combination
    ) -> Float[np.ndarray, " z"]:
        """The unknowns of one combination as those of another: members of both keep their values, new ones are zero."""
        out, where = z.copy(), dict(self.placed(before))
        out[self.slots :] = 0.0
        for member, place in self.placed(combination):
            if member in where:
                out[place] = z[where[member]]
        return out

    def is_possible(self, combination: Sequence[int]) -> bool:
        """Whether a combination is looked at: each effect and target once, at most one unseen oscillator or force that
        fades, one force without a name on a coordinate, no more values than there are slots; of more effects than usual
        only with names and without a time, frequency or threshold."""
        whole, ones = {self.whole(member) for member in combination}, [self.candidate(m) for m in combination]
        unseen = sum(one.effect.switched for one in ones)
        pushed = [i for one in ones if one.nameless for i in one.places]
        once = len(whole) == len(combination) and len(pushed) == len(set(pushed))
        few = len(ones) <= (MOST if self.is_plain(combination) else USUAL)
        return once and few and unseen <= 1 and sum(one.effect.size for one in ones) <= SLOTS

    def is_plain(self, combination: Sequence[int]) -> bool:
        """Whether all effects have names, and none a time, a frequency or a threshold."""
        ones = [self.candidate(m) for m in combination]
        return all(one.nameless is None and not one.effect.places for one in ones)

    def swings(self, combination: Sequence[int]) -> bool:
        """Whether an effect swings by itself: what has a frequency, or an unseen oscillator."""
        return any(self.candidate(m).effect.swings for m in combination)

    def is_steady(self, combination: Sequence[int]) -> bool:
        """Whether there is an effect, beside what is wrong with single readings, and none swings by itself."""
        effects = {self.candidate(m).effect for m in combination}
        return bool(effects - {NOISE, OUTLIERS}) and not self.swings(combination)

    def has_unseen(self, combination: Sequence[int]) -> bool:
        """Whether an effect brings unknowns of its own: an unseen oscillator, a force that fades."""
        return any(self.candidate(m).effect.switched for m in combination)

    def local(self, recording: int) -> Int[np.ndarray, " local"]:
        """Which entries of z one recording depends on."""
        own = np.arange(recording * self.state, (recording + 1) * self.state)
        return np.concatenate([own, np.arange(self.head, self.size)])

    def onehot(self, combination: Sequence[int], recording: int) -> Float[np.ndarray, "row coefficient"]:
        """Which coefficient each slot is in a recording; the last row switches on what has no amplitude for it."""
        matrix = np.zeros((SLOTS + 1, self.equations.size))
        for member, place in self.placed(combination):
            if recording in self.members[member].recordings:
                one = self.candidate(member)
                rows = np.arange(place.start, place.stop) - self.slots
                matrix[rows, np.arange(one.values.start, one.values.stop)] = 1.0
                if one.effect.switched:
                    matrix[-1, one.values.stop] = 1.0
                if isinstance(one.effect, Oscillating):
                    matrix[-1, one.values.stop] = self.origin(member) - self.equations.origin
        return matrix

    def turned(
        self, member: int, place: float | None, amplitudes: Float[np.ndarray, "amplitude ..."]
    ) -> Float[np.ndarray, "amplitude ..."]:
        """Amplitudes at a frequency, or what they do, whose phase counts from the member's own origin, by those that
        count from that of all; as they are where there is no phase."""
        if place is None or not isinstance(self.candidate(member).effect, Oscillating):
            return amplitudes
        angle = place * (self.origin(member) - self.equations.origin)
        return np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]]) @ amplitudes

    def origin(self, member: int) -> float:
        """From when the phase of an effect counts inside: the middle of the first recording that has it."""
        first = self.members[member].recordings[0]
        return float(np.mean(self.rows[first].times[[0, -1]])) if first else self.equations.origin

    def active(self, combination: Sequence[int]) -> Bool[np.ndarray, " z"]:
        """Which entries of z are free under a combination."""
        free = np.zeros(self.size, bool)
        free[: self.head] = np.tile(self.initial.sd > 0, len(self.rows))
        free[self.head : self.slots] = True
        for member, place in self.placed(combination):
            free[place] = True
            free[self.starts(member)] = True
        return free

    def unseen(self, recording: int) -> Int[np.ndarray, "2"]:
        """Where the unseen coordinate and its momentum at the first row stand in z."""
        width = self.equations.width
        return recording * self.state + np.array([width - 1, 2 * width - 1])

    def starts(self, member: int) -> Int[np.ndarray, "recording start"]:
        """Where in z what a member adds unseen begins: an oscillator, or a force that fades, which has no place."""
        effect, some = self.candidate(member).effect, self.members[member].recordings
        if not effect.switched:
            return np.zeros((len(some), 0), int)
        return np.stack([self.unseen(r) for r in some])[:, 0 if effect is HIDDEN else 1 :]

    def moving(self, coefficients: Float[np.ndarray, " coefficient"]) -> Int[np.ndarray, " _"]:
        """What one recording depends on before its slots: on the start of what is unseen only where there is some."""
        switches = [one.values.stop for one in self.equations.candidates if one.effect.switched]
        present = coefficients[switches].any() if self.equations.hidden else False
        every = np.arange(self.state + self.calibrated.size)
        return every if present else np.setdiff1d(every, self.unseen(0) if self.equations.hidden else [])

    def coefficients(self, recording: int, z: Float[np.ndarray, " z"], combination: Sequence[int]) -> np.ndarray:
        """The coefficient vector that one recording is stepped with."""
        c = self.calibrated
        values = self.terms[recording].copy()
        for j in range(c.parameters, c.size):
            values[c.place[j]] += c.recordings[recording, j] * z[self.head + j]
        return values + np.append(z[self.slots :], 1.0) @ self.onehot(combination, recording)

    def parameter_values(self, recording: int, z: Float[np.ndarray, " z"]) -> Float[np.ndarray, " parameter"]:
        """The parameter vector with its calibrated entries filled in."""
        c, values = self.calibrated, self.parameters[recording].copy()
        values[c.place[: c.parameters]] = z[self.head : self.head + c.parameters]
        return values

    def without(self, flagged: Sequence[Bool[np.ndarray, "_ channel"]]) -> "Problem":
        """The same with some readings left out, by recording."""
        rows = tuple(
            replace(r, readings=np.where(bad, np.nan, r.readings), counts=np.where(bad, 0.0, r.counts))
            for r, bad in zip(self.rows, flagged, strict=True)
        )
        return replace(self, rows=rows)

    def noise_of(self, combination: Sequence[int]) -> Float[np.ndarray, " channel"]:
        """Noise that a combination takes as known, NaN where it is estimated."""
        noise = self.noise.copy()
        for member in combination:
            if self.candidate(member).effect is NOISE:
                noise[self.candidate(member).place] = np.nan
        return noise

    def lower_bounds(self, combination: Sequence[int]) -> dict[int, float]:
        """Entries of z that are physical above a bound only: a drag adds up to at least nothing with its known term."""
        return {
            place.start + k: float(low)
            for m, place in self.placed(combination)
            if self.candidate(m).effect.positive
            for k, low in enumerate(self.lowest(m))
        }

    def lowest(self, member: int) -> Float[np.ndarray, " amplitude"]:
        """Below which value each amplitude of an effect is not physical, by what is known in its own recordings."""
        one, where = self.candidate(member), list(self.members[member].recordings)
        number = one.effect.amplitudes
        known = self.terms[where, one.first : one.first + number].min(0)
        return -known if one.effect.positive else np.full(number, -np.inf)
