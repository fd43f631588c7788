"""The verb: from a simulation and its recordings to what the simulation left out."""

import os
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from .._recording import Recording
from .._simulation_records import SimulationFile
from . import _document as document
from ._augment import augmented
from ._build import Restriction, augmented_equations, build, first_substep, refined, rows_fitted
from ._forecast import forecast, forecast_times
from ._locate import motion, strained_coordinates, strained_windows, where_sentence
from ._outlook import Outlook, intensity_of
from ._posterior import Posterior, Weighed, posterior
from ._problem import Combination, Problem
from ._record import Diagnosis, Forecast, Series
from ._search import Found, Search
from ._start import STRENGTH, first_fits, priors_without_effects
from ._trajectory import Stepper
from ._weighed import Estimate, coloured_inflation
from ._words import equation_lines, finding_sentence, next_measurement

VERSION = "0.1.0"
# The simulation counts as consistent unless the probability of nothing left out is below this (contract).
CONSISTENT = 0.05


@dataclass(frozen=True)
class Options:
    """How to diagnose.

    **Arguments:** - `holdout`: share of the used rows of each recording that no fit sees. - `restriction`: which
    effects are searched. - `jobs`: threads. - `time_limit`: seconds after which the search is cut short. - `progress`:
    told what is being done.
    """

    holdout: float = 0.25
    seed: int = 0
    restriction: Restriction = Restriction()
    jobs: int = os.cpu_count() or 1
    time_limit: float = np.inf
    forecast_until: float | None = None
    forecast_step: float | None = None
    progress: Callable[[str], None] = lambda message: None


def diagnose(file: SimulationFile, recordings: Sequence[Recording], options: Options = Options()) -> Diagnosis:
    """Locate what differs between a simulation and its recordings, name what was left out, and show the fit without
    and with it.

    `InputError` where simulation and recordings do not fit together.
    """
    with np.errstate(all="ignore"):  # what is not finite is told in the answer
        return _diagnosed(file, recordings, options)


def _diagnosed(file: SimulationFile, recordings: Sequence[Recording], options: Options) -> Diagnosis:
    begin = time.monotonic()
    options.progress("reading the equations of motion")
    times = _times_ahead(recordings[0], options)
    stepper, seeds = _ready(file, recordings, options)
    search = Search(stepper, seeds, begin + options.time_limit, options.progress)
    found = search.run()
    options.progress("comparing before and after on the held-out rows")
    answer = _Answer(file, recordings, stepper, found, options, times)
    return answer.diagnosis(time.monotonic() - begin)


def _times_ahead(recording: Recording, options: Options) -> np.ndarray | None:
    """Times to forecast; asked before the long work, so that a wrong wish, or a missing input, is said at once."""
    if options.forecast_until is None:
        return None
    times = forecast_times(recording, options.forecast_until, options.forecast_step)
    if recording.inputs is not None:
        recording.inputs.at(times)
    return times


def _ready(file: SimulationFile, recordings: Sequence[Recording], options: Options) -> tuple[Stepper, np.ndarray]:
    """The problem laid out with substeps that are fine enough, and initial states to start from."""
    built, substep = augmented_equations(file, float(recordings[0].times[0])), first_substep(file, recordings)

    def rebuild(longest: float) -> Problem:
        return build(file, built, recordings, options.holdout, longest, options.restriction)

    problem = rebuild(substep)
    stepper = Stepper(problem, options.jobs)
    options.progress("finding where the motion starts")
    seeds = first_fits(stepper, priors_without_effects(problem), rows_fitted(problem.rows))
    finer = refined(rebuild, problem, seeds.z[0], seeds.noise[0], substep)
    return (stepper if finer is problem else Stepper(finer, options.jobs)), seeds.z


class _Answer:
    """Everything that is said about a finished search."""

    def __init__(self, file, recordings, stepper: Stepper, found: Found, options: Options, times: np.ndarray | None):
        self.times = times
        self.file, self.recordings, self.stepper, self.found, self.options = file, recordings, stepper, found, options
        self.problem: Problem = stepper.problem
        self.posterior: Posterior = posterior(self.problem, found, 1.0)
        self.chosen, self.verdict = self._verdict()
        inflation = self._inflation()
        if inflation > 1:
            self.posterior = posterior(self.problem, found, inflation)
            self.chosen, self.verdict = self._verdict()
        self.before: Estimate = self.posterior.nothing
        self.after: Estimate = self.chosen.best if self.chosen else self.before
        # Shown before: the calibrated simulation as it is, which knows no missing force.
        plain = found.of((), "white") or self.before
        self.without = self._outlooks(plain, intensity_of(stepper, plain))
        self.with_ = self._outlooks(self.after, intensity_of(stepper, self.after)) if self.chosen else self.without
        self.pull = found.of((), "force")
        self.lens = self._lenses(self.pull or self.before)
        self.lens_after = self._lenses(self.after)

    def _inflation(self) -> float:
        """How much the evidence of the likeliest answer claims too much."""
        rows = rows_fitted(self.problem.rows)
        top = self.chosen.best if self.chosen else self.posterior.nothing
        return coloured_inflation(self.stepper, top, rows) if top.kind == "coloured" else max(1.0, top.inflation)

    def _verdict(self) -> tuple[Weighed | None, str]:
        p = self.posterior
        if p.as_it_is >= CONSISTENT:
            return None, "consistent"
        if not p.named or p.unexplained > p.named[0].probability:
            return None, "unexplained"
        return p.named[0], "mismatch"

    def _outlooks(self, estimate: Estimate, intensity: np.ndarray) -> list[Outlook]:
        return [Outlook(self.stepper, estimate, r, intensity) for r in range(len(self.problem.rows))]

    def _lenses(self, estimate: Estimate) -> list[Outlook]:
        """Outlooks with the missing force of the simulation without effects: before and after through one lens."""
        if self.pull is None or self.pull.intensity is None:
            return self._outlooks(estimate, intensity_of(self.stepper, estimate))
        return self._outlooks(estimate, self.pull.intensity)

    def diagnosis(self, seconds: float) -> Diagnosis:
        f, eq, values = self.file, self.problem.equations, self._coefficients()
        chosen = [(eq.candidates[c], v) for c, v in values.items()]
        forces = {p: e.text for p, e in f.forces.items()}
        readings = {c: e.text for c, e in f.recording.observe.items()}
        lines = (self.problem, f.hamiltonian.text, forces, readings)
        return Diagnosis(
            title=f.title,
            document=self._document(seconds),
            columns=eq.columns,
            coordinates=eq.coordinates,
            units=f.units,
            equation_before=equation_lines(*lines, []),
            equation_after=equation_lines(*lines, chosen),
            series=tuple(self._series(r) for r in range(len(self.recordings))),
            augmented=augmented(f, self.problem, self.after, values),
            forecast=self._forecast(),
        )

    def _coefficients(self) -> dict[int, float]:
        inflation = self._spread()
        return {
            c: document.coefficient(self.problem, self.after, slot, inflation)["mean"]
            for slot, c in enumerate(self.after.combination)
        }

    def _spread(self) -> float:
        return 1.0 / self.posterior.tempered

    def _document(self, seconds: float) -> dict[str, Any]:
        p, spread = self.posterior, self._spread()
        rows, other = document.alternatives(self.problem, p, self.verdict, self.chosen)
        before = document.fit(self.problem, self.pull or self.before, self.without, self.recordings)
        after = document.fit(self.problem, self.after, self.with_, self.recordings) if self.chosen else before
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
                "before": document.parameters(self.problem, self.before, spread),
                "after": document.parameters(self.problem, self.after, spread),
            },
            "fit": {"before": before, "after": after},
            "next_measurement": next_measurement(self.problem, p, self.chosen.combination if self.chosen else None),
            "warnings": self._warnings(),
            "thinning": {
                "rows": sum(r.given for r in self.problem.rows),
                "used": sum(r.used for r in self.problem.rows),
            },
            "converged": bool(self.after.converged and all(o.ok and np.isfinite(o.readings).all() for o in self.with_)),
            "version": VERSION,
            "seed": self.options.seed,
            "seconds": round(seconds, 2),
        }

    def _probability(self) -> float:
        p = self.posterior
        if self.chosen is not None:
            return self.chosen.probability
        return p.as_it_is if self.verdict == "consistent" else p.unexplained

    def _bayes_factor(self) -> float | None:
        p = self.posterior
        if self.verdict == "consistent":
            return None
        if self.chosen is None:
            white = self.found.of((), "white")
            plain = white.log_evidence if white else -np.inf
            return document.finite(p.tempered * (self.before.log_evidence - plain))
        return document.finite(p.evidences[self.chosen.combination] - p.evidences[()])

    def _findings(self) -> list[dict[str, Any]]:
        if self.chosen is None:
            return []
        found = [self._finding(slot, c) for slot, c in enumerate(self.chosen.combination)]
        return sorted(found, key=lambda one: -(one["log_bayes_factor"] or 0.0))

    def _finding(self, slot: int, candidate: int) -> dict[str, Any]:
        p, one = self.posterior, self.problem.equations.candidates[candidate]
        rest = tuple(c for c in self.after.combination if c != candidate)
        value = document.coefficient(self.problem, self.after, slot, self._spread())
        unit = self.problem.units.get(one.target, "") if one.effect.name == "sensor_bias" else ""
        sentence = finding_sentence(one, value["mean"], value["sd"], self._strength(candidate, value["mean"]), unit,
                                    self._rivals(candidate))  # fmt: skip
        return {
            "effect": one.effect.name,
            "target": one.target,
            "family": one.effect.family,
            "recordings": list(range(1, len(self.recordings) + 1)),
            "probability": document.presence(p, candidate),
            "log_bayes_factor": self._against(rest),
            "coefficients": {one.effect.coefficient: value},
            "sentence": sentence,
        }

    def _against(self, rest: Combination) -> float | None:
        """Log Bayes factor against a smaller combination; against nothing at all where that one cannot be fitted."""
        mine, without = (self.posterior.evidences.get(c, -np.inf) for c in (self.after.combination, rest))
        if not np.isfinite(without):
            without = self.posterior.evidences[()]
        return document.finite(mine - without)

    def _strength(self, candidate: int, value: float) -> float:
        """Root mean square of an effect's force over that of the forces already there."""
        return abs(value) / self.found.priors.scales[candidate] * STRENGTH

    def _rivals(self, candidate: int) -> list[str]:
        """Effects that could stand in this one's place: in a likely combination that lacks it."""
        mine = set(self.after.combination)
        out = []
        for w in self.posterior.named:
            if candidate not in w.combination and w.probability > 0.1 * self._probability():
                out += [str(self.problem.equations.candidates[c]) for c in w.combination if c not in mine]
        return list(dict.fromkeys(out))[:4]

    def _location(self) -> dict[str, Any]:
        if self.verdict == "consistent":
            return {"kind": "none", "targets": [], "recordings": [], "time_windows": [],
                    "where": "nothing differs that the noise does not explain"}  # fmt: skip
        if self.chosen is not None:
            return document.location(self.problem, self.chosen.combination, self.lens, self._where())
        return self._unexplained_location()

    def _where(self) -> str:
        chosen = [self.problem.equations.candidates[c] for c in self.after.combination]
        moving = [one.place for one in chosen if one.effect.acts_on == "coordinate"]
        if not moving:
            return f"in the sensor of {', '.join(dict.fromkeys(one.target for one in chosen))}"
        return where_sentence(self.problem, self.lens[0], moving[0])

    def _unexplained_location(self) -> dict[str, Any]:
        eq, several = self.problem.equations, len(self.lens) > 1
        # A nearly periodic remainder goes with the motion, so a force is likelier than an error of the sensor.
        if self.before.kind == "coloured" and all(colour.damping >= 1 for colour in self.before.colours):
            kind, targets = "sensor", list(eq.columns)
            where = "the readings are off in a way that remembers itself, without a name in the vocabulary"
            windows = document.whole_windows(self.lens)
        else:
            strained = strained_coordinates(self.lens)
            kind, targets = "dynamics", [eq.coordinates[i] for i in strained]
            where = where_sentence(self.problem, self.lens[0], strained[0])
            found = [(w, o.recording + 1) for o in self.lens for w in strained_windows(o, strained[0])]
            windows = [[*w, r] if several else w for w, r in found]
        numbers = list(range(1, len(self.lens) + 1))
        return {"kind": kind, "targets": targets, "recordings": numbers, "time_windows": windows, "where": where}

    def _warnings(self) -> list[str]:
        out, c = [], self.problem.calibrated
        shortened = [r for r, whole in zip(self.problem.rows, self.recordings, strict=True)
                     if r.times[0] > whole.times[0] and r.counts.max() <= 1]  # fmt: skip
        for r in shortened:
            out.append(f"only the last {r.fitted} rows before the held-out part were fitted, of {r.given} in all: "
                       "they are too many, and too sparse for the motion to be averaged")  # fmt: skip
        if any(r.counts.max() > 1 for r in self.problem.rows):
            given, used = sum(r.given for r in self.problem.rows), sum(r.used for r in self.problem.rows)
            out.append(f"the rows were averaged from {given} to {used}: "
                       "they are sampled far above the motion's frequencies")  # fmt: skip
        if not self.after.converged:
            out.append("the fit did not converge; its numbers are not to be relied on")
        if not all(np.isfinite(o.readings).all() for o in (*self.without, *self.with_)):
            out.append("the simulated trajectory diverges: it leaves every bound before the recording ends")
        if not all(o.ok for o in (*self.without, *self.with_)):
            out.append("a filter step failed: the trajectory diverges from the recording, or is not finite")
        if not self.found.complete:
            out.append("the time limit was reached before every combination was weighed")
        for j, name in enumerate(c.names):
            moved = abs(self.after.z[self.problem.head + j] - c.mean[j]) / c.sd[j]
            if moved > 3:
                out.append(f"{name} moved {moved:.1f} of its prior standard deviations to fit the recording")
        if self.verdict == "mismatch" and self.after.kind != "white":
            kind = "an error of the sensor" if self.after.kind == "coloured" else "a small missing force"
            out.append(f"a remainder without a name is left beside the findings: {kind}")
        if self.posterior.tempered < 1:
            out.append(f"evidence was discounted by a factor of {1 / self.posterior.tempered:.1f}: "
                       "the remainder is not white on the scale of the motion")  # fmt: skip
        return out

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
        means = np.asarray(outlook.smoothed.means[: outlook.rows.fitted])
        return outlook.along(self.problem.equations.energy, means)[:, 0]

    def _forecast(self) -> Forecast | None:
        if self.times is None:
            return None
        return forecast(self.stepper, self.recordings[0], self.before, self.after, self.times, self._spread(),
                        self.options.seed)  # fmt: skip
