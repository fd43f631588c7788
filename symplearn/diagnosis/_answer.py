"""Everything that is said about a finished search."""

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np

from .._effects import COORDINATE, FORCING, IMPULSE, MEMORIES, OUTLIERS, PAIR, Candidate
from .._simulation_records import SimulationFile
from . import _document as document
from ._along import along, energy, force
from ._augment import augmented
from ._effect_priors import STRENGTH
from ._forecast import forecast
from ._found import Found
from ._law_text import equation_lines, stated
from ._locate import (
    blows_sentence,
    kind_and_targets,
    most_strained,
    motion,
    present_windows,
    spell_windows,
    strained_coordinates,
    strained_when,
    where_sentence,
    whole_windows,
)
from ._next import ASK_AGAIN, NOTHING_SHOWN, all_rows, next_measurement
from ._options import Options
from ._outlook import Outlook, intensity_of
from ._problem import Combination, Problem
from ._record import Diagnosis, Forecast, Series
from ._told import Told
from ._trajectory import Stepper
from ._units import coefficient_units, time_unit
from ._verdict import judged
from ._warnings import asks_for_more, doubled, idle_units, missed, set_back, unused, warnings
from ._weighed import Estimate
from ._words import finding_sentence

VERSION = "0.1.0"
# How readings are off, by kind of remainder.
_WAYS = {
    "coloured": "that remembers itself",
    "clock": "that goes with how fast they change, as where they are read too early or too late",
    "positional": "that goes with what is read",
    "kinematic": "that goes with what is read and how fast that changes",
    "jitter": "that is larger the faster they change, as where single times are a little off",
}


class Answer:
    """Everything that is said about a finished search."""

    def __init__(
        self, file, recordings, stepper: Stepper, found: Found, options: Options, times: np.ndarray | None,
        notes: Sequence[str] = (), all_rows: Mapping[str, Any] | None = None,
    ):  # fmt: skip
        """`all_rows` is what they say, where that is another answer."""
        self.times, self.notes, self.all_rows = times, notes, all_rows
        self.file, self.recordings, self.stepper, self.found, self.options = file, recordings, stepper, found, options
        self.problem: Problem = stepper.problem
        self.posterior, self.chosen, self.verdict = judged(stepper, found)
        self.before: Estimate = self.posterior.nothing
        self.after, self.run = self._after()
        # Shown before: the calibrated simulation as it is, which knows no missing force.
        plain = found.of((), "white") or self.before
        self.without = self._outlooks(plain)
        self.with_ = self._outlooks(self.run) if self.chosen else self.without
        self.pull = self._missing_force()
        self.lens = self._lenses(self.pull or self.before)
        self.lens_after = self._lenses(self.after)

    def _after(self) -> tuple[Estimate, Estimate]:
        """With the findings: the estimate whose numbers are told, and the one that runs on."""
        if self.chosen is None:
            return self.before, self.before
        answer = self.chosen.combination, self.chosen.best
        return self.found.told(*answer), self.found.shown(*answer)

    def _missing_force(self) -> Estimate | None:
        """The simulation without effects beside a missing force, with outliers taken out where there were some."""
        bare = [c for c in self.found.estimates if all(self.problem.candidate(m).effect is OUTLIERS for m in c)]
        return next((e for c in sorted(bare, key=len) if (e := self.found.of(c, "force"))), None)

    def _outlooks(self, estimate: Estimate) -> list[Outlook]:
        """Under the remainder that it was fitted with."""
        own = intensity_of(self.stepper, estimate), estimate.exposures
        return [Outlook(self.stepper, estimate, r, *own) for r in range(len(self.problem.rows))]

    def _lenses(self, estimate: Estimate) -> list[Outlook]:
        """Outlooks with the missing force of the simulation without effects: before and after through one lens."""
        if self.pull is None or self.pull.intensity is None:
            return self._outlooks(estimate)
        return [Outlook(self.stepper, estimate, r, self.pull.intensity) for r in range(len(self.problem.rows))]

    def diagnosis(self, begin: float) -> Diagnosis:
        """The whole answer to what was asked at a time of the monotonic clock."""
        f, eq = self.file, self.problem.equations
        forces = {p: e.text for p, e in f.forces.items()}
        readings = {c: e.text for c, e in f.recording.observe.items()}
        lines = (f.coordinates, f.momenta, eq.columns, f.hamiltonian.text, forces, readings)
        calibrated = augmented(f, self.problem, self.found.priors, self.before, {}, {}, {})
        whole, ahead = self._whole(), self.forecast  # before the clock is read: it is part of the work
        return Diagnosis(
            title=f.title,
            document=self._document(time.monotonic() - begin),
            columns=eq.columns,
            coordinates=f.coordinates,
            units=f.units,
            equation_before=equation_lines(*lines, stated(calibrated.terms)),
            equation_after=equation_lines(*lines, stated(whole.terms)),
            series=tuple(self._series(r) for r in range(len(self.recordings))),
            augmented=whole,
            forecast=ahead,
        )

    def _whole(self) -> SimulationFile:
        """The file with the findings put back, and what is calibrated as well known as it is told."""
        told, after = self.told, replace(self.after, covariance=self.after.covariance * self._spread())
        texts = told.values, told.expressions, told.memories
        return augmented(self.file, self.problem, self.found.priors, after, *texts)

    @cached_property
    def told(self) -> Told:
        """The numbers and expressions of the findings."""
        return Told(self.file, self.problem, self.found.priors, self.after, self._spread())

    def _spread(self) -> float:
        return 1.0 / self.posterior.tempered

    def _document(self, seconds: float) -> dict[str, Any]:
        p, spread = self.posterior, self._spread()
        rows, other = document.alternatives(self.problem, p, self.verdict, self.chosen)
        before = document.fit(self.problem, self.pull or self.before, self.without, self.recordings, spread)
        after = document.fit(self.problem, self.run, self.with_, self.recordings, spread) if self.chosen else before
        return {
            "schema": "symplearn.diagnosis/1",
            "verdict": self.verdict,
            "probability": self._probability(),
            "log_bayes_factor": self._bayes_factor(),
            "location": self._location(),
            "findings": self._findings(),
            "alternatives": rows,
            "other": other,
            "family_probability": document.family_probability(self.problem, p),
            "parameters": {
                "before": document.parameters(self.problem, self.found.priors, self.before, spread),
                "after": document.parameters(self.problem, self.found.priors, self.after, spread),
            },
            "fit": {"before": before, "after": after},
            "next_measurement": self._next(),
            "warnings": [*self.notes]
            + doubled(self.file)
            + idle_units(self.file)
            + unused(self.file)
            + warnings(
                self.problem,
                self.recordings,
                self.found,
                self.posterior,
                self.chosen,
                self.after,
                self.without,
                self.with_,
                self.forecast,
            )
            + set_back(before, after)
            + missed(after)
            + asks_for_more(self.all_rows),
            "all_rows": self.all_rows,
            "thinning": {
                "rows": sum(r.given for r in self.problem.rows),
                "used": sum(r.used for r in self.problem.rows),
            },
            "converged": bool(self.after.converged and all(o.ok and np.isfinite(o.readings).all() for o in self.with_)),
            "complete": self.found.complete,
            "version": VERSION,
            "seed": self.options.seed,
            "seconds": round(seconds, 2),
        }

    def _next(self) -> str:
        p = self.posterior
        if p.is_constant:
            return NOTHING_SHOWN
        if self.all_rows is not None:
            return ASK_AGAIN
        top = max((w.probability for w in p.named), default=0.0)
        rivals = [[one.key for m in w.combination for one in self.problem.candidate(m).told()]
                  for w in p.named if w.probability > max(0.02, 0.1 * top)][:6]  # fmt: skip
        told = next_measurement(rivals, self.verdict, p.as_it_is, p.unexplained)
        return told + (all_rows(self.options.holdout, self.chosen.probability) if self.chosen else "")

    def _probability(self) -> float:
        p = self.posterior
        if self.chosen is not None:
            return self.chosen.probability
        return p.as_it_is if self.verdict == "consistent" else p.unexplained

    def _bayes_factor(self) -> float | None:
        """Of the answer against the best simulation without effects, process noise allowed; `unexplained` is that."""
        p = self.posterior
        if self.verdict == "consistent":
            return None
        if self.chosen is None:
            return 0.0
        return document.finite(p.evidences[self.chosen.combination] - p.evidences[()])

    def _findings(self) -> list[dict[str, Any]]:
        if self.chosen is None:
            return []
        members = [(member, one) for member in self.chosen.combination for one in self.problem.candidate(member).told()]
        found = [self._finding(member, one) for member, one in members]
        return sorted(found, key=lambda one: -(one["log_bayes_factor"] or 0.0))

    def _finding(self, member: int, one: Candidate) -> dict[str, Any]:
        p, rest = self.posterior, tuple(c for c in self.after.combination if c != member)
        told = self.told.of(member, one)
        which = [r + 1 for r in self.problem.members[member].recordings]
        only = None if len(which) == len(self.recordings) else which
        f = self.file
        clock, momenta = time_unit(f.units, f.recording.time), dict(zip(f.coordinates, f.momenta, strict=True))
        units = coefficient_units(one.effect.name, one.targets, f.units, momenta, clock)
        found = {
            "effect": one.effect.name,
            "target": one.target,
            "family": one.effect.family,
            "recordings": which,
            "probability": document.presence(self.problem, p, one),
            "log_bayes_factor": self._against(rest),
            "coefficients": {name: value for name, value in told.items() if name != "relative_sd"},
            "sentence": finding_sentence(one, told, self._strength(member), units, self._rivals(member), only),
        }
        further = {"side": one.side, "relative_sd": told.get("relative_sd")}
        return found | {name: value for name, value in further.items() if value is not None}

    def _against(self, rest: Combination) -> float | None:
        """Log Bayes factor against a smaller combination; against nothing at all where that one cannot be fitted."""
        mine, without = (self.posterior.evidences.get(c, -np.inf) for c in (self.after.combination, rest))
        if not np.isfinite(without):
            without = self.posterior.evidences[()]
        return document.finite(mine - without)

    def _strength(self, member: int) -> float | None:
        """An effect's amplitudes by their prior's scales, in shares of the forces already there; None for no force, for
        one that fades, and where none is there."""
        one, place = self.problem.candidate(member), dict(self.problem.placed(self.after.combination))[member]
        if one.effect.acts_on != COORDINATE or one.effect in MEMORIES or not self._there[:, one.place].any():
            return None
        amplitudes = self.after.z[place][: one.effect.amplitudes]
        priors, values = self.found.priors, slice(one.first, one.first + one.effect.amplitudes)
        if one.effect is FORCING and priors.forces is not None:  # its prior is wider
            return float(np.linalg.norm(amplitudes) / priors.forces[one.place])
        return float(np.linalg.norm(amplitudes / priors.scales[values])) * STRENGTH

    @cached_property
    def _there(self) -> np.ndarray:
        """The force that the simulation has on every coordinate along the motion."""
        o = self.lens[0]
        return along(self.problem, force, o.recording, o.estimate.z, (), o.states)

    def _rivals(self, member: int) -> list[str]:
        """Effects that could stand in this one's place: in a likely combination that lacks it."""
        mine = {one.key for m in self.after.combination for one in self.problem.candidate(m).told()}
        key, out = self.problem.candidate(member).told()[0].key, []
        for w in self.posterior.named:
            ones = [one for m in w.combination for one in self.problem.candidate(m).told()]
            if key not in {one.key for one in ones} and w.probability > 0.1 * self._probability():
                out += [str(one) for one in ones if one.key not in mine]
        return list(dict.fromkeys(out))[:4]

    def _location(self) -> dict[str, Any]:
        if self.verdict == "consistent":
            rows = "in the fitted rows " if self.all_rows else ""
            return {"kind": "none", "targets": [], "recordings": [], "time_windows": [],
                    "where": f"{rows}nothing differs that the noise does not explain"}  # fmt: skip
        if self.chosen is None:
            return self._unexplained_location()
        combination = self.chosen.combination
        kind, targets = kind_and_targets(self.problem, combination)
        which = sorted({r + 1 for m in combination for r in self.problem.members[m].recordings})
        windows = present_windows(self.problem, self.lens, combination, self.told.values)
        return {"kind": kind, "targets": targets, "recordings": which, "time_windows": windows, "where": self._where()}

    def _where(self) -> str:
        members = self.after.combination
        chosen = [self.problem.candidate(member) for member in members]
        moving = [one.place for one in chosen if one.effect.acts_on in (COORDINATE, PAIR)]
        if not moving and all(not one.effect.is_dynamics for one in chosen):
            return f"in the sensor of {', '.join(dict.fromkeys(one.targets[0] for one in chosen))}"
        if all(one.effect is IMPULSE for one in chosen):
            times = [self.told.values[member]["t_star"] for member in self.after.combination]
            return blows_sentence(chosen, times)
        told = [(one.targets, one.nameless.words) for one in chosen if one.nameless and one.nameless.words]
        if told:
            return f"the missing force on {' and '.join(told[0][0])} {told[0][1]}"
        dynamics = [m for m, one in zip(members, chosen, strict=True) if one.effect.is_dynamics]
        there = sorted({r for m in dynamics for r in self.problem.members[m].recordings})
        lenses = [self.lens[r] for r in there]
        first = moving[0] if moving else strained_coordinates(lenses)[0]
        return where_sentence(self.problem, most_strained(lenses, first), first)

    def _unexplained_location(self) -> dict[str, Any]:
        eq, numbers = self.problem.equations, list(range(1, len(self.lens) + 1))
        several = len(numbers) > 1
        # A nearly periodic remainder goes with the motion, so a force is likelier than an error of the sensor.
        remembered = all(colour.damping >= 1 for colour in (*self.before.colours, *self.before.clocks))
        if remembered and (way := _WAYS.get(self.before.kind)):
            kind, targets = "sensor", list(eq.columns)
            where = f"the readings are off in a way {way}, without a name in the vocabulary"
            windows = whole_windows(self.lens)
        else:
            strained = strained_coordinates(self.lens)
            kind, targets = "dynamics", [eq.coordinates[i] for i in strained]
            if self.before.exposures is not None:
                where = f"something pulls on {targets[0]} for a while, and neither before nor after"
                found = [(w, r + 1) for r, w in spell_windows(self.problem, self.before.exposures)]
                numbers = [r for _, r in found]
            else:
                where = where_sentence(self.problem, most_strained(self.lens, strained[0]), strained[0])
                found = strained_when(self.lens, strained)
            windows = [[*w, r] if several else w for w, r in found]
        if self.posterior.is_constant:
            where = "nothing that was read shows the simulated motion, so that nothing is located"
        return {"kind": kind, "targets": targets, "recordings": numbers, "time_windows": windows, "where": where}

    def _series(self, r: int) -> Series:
        before, after, lens, lens_after = self.without[r], self.with_[r], self.lens[r], self.lens_after[r]
        n, rows = before.rows.fitted, before.rows
        position, velocity = motion(lens)
        return Series(
            name=self.recordings[r].name,
            boundary=rows.boundary,
            times=rows.times,
            readings=rows.readings,
            before=before.readings,
            after=after.readings,
            fitted_times=rows.times[:n],
            position=position,
            velocity=velocity,
            force_before=lens.missing_force(),
            force_after=lens_after.missing_force(),
            strain_before=lens.strain(),
            strain_after=lens_after.strain(),
            innovations_before=before.innovations,
            innovations_after=after.innovations,
            energy_before=self._energy(lens),
            energy_after=self._energy(lens_after),
        )

    def _energy(self, outlook: Outlook) -> np.ndarray:
        return outlook.along(energy, outlook.states)

    @cached_property
    def forecast(self) -> Forecast | None:
        """Readings to come, where they were asked for."""
        if self.times is None:
            return None
        self.options.progress("forecasting")
        # What is missing was a force to the simulation as it is; one that errs by its sensor's memory alone claims to
        # know how it goes on.
        before = self.pull or self.before if self.chosen else self.before
        return forecast(self.stepper, self.recordings[0], before, self.run, self.times, self._spread(),
                        self.options.seed)  # fmt: skip
