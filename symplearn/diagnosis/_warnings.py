"""What a reader of a diagnosis must be told."""

import itertools
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from .._effects import NOISE, OUTLIERS
from .._recording import Recording
from .._simulation_records import SimulationFile
from ._found import Found
from ._hard_stops import hardly_entered
from ._law_text import moment
from ._locate import spell_windows
from ._nameless import is_clear
from ._outlook import Outlook
from ._own_period import in_tune
from ._posterior import Posterior, Weighed
from ._problem import Problem
from ._record import Forecast
from ._weighed import Estimate

# Evidence that was discounted by less than this is not told: by a factor of 1.0, to the digits that are.
_TOLD = 1 / 1.05
# A forecast is far off that leaves the middle of what was read by this many times its range.
_FAR = 10.0
# Held-out errors of this many times what is expected are no chance: a free run's are of one piece, as two readings,
# whose mean square is above nine once in eight thousand times.
_MISSED = 3.0
# A value is at its bound that is within this share of its standard deviation, unless the bound is nothing beside it.
_AT, _NOTHING = 0.01, 1e-6
# Held-out errors that grow by less than this are as large as before.
_WORSE = 1.1

# What is left beside the findings, by kind of remainder.
_REMAINDERS = {
    "coloured": "an error of the sensor",
    "clock": "an error of the clock",
    "jitter": "an error of single times",
    "positional": "an error of the sensor that goes with what it reads",
    "kinematic": "an error of the sensor that goes with what it reads and how fast that changes",
    "static": "a small force that goes with place",
    "force": "a small missing force",
    "spell": "a missing force for a while",
}


def warnings(
    problem: Problem,
    recordings: Sequence[Recording],
    found: Found,
    odds: Posterior,
    chosen: Weighed | None,
    after: Estimate,
    without: Sequence[Outlook],
    with_: Sequence[Outlook],
    forecast: Forecast | None,
) -> list[str]:
    """What is wrong or to be borne in mind, a sentence each."""
    out, c = [], problem.calibrated
    shortened = [r for r, whole in zip(problem.rows, recordings, strict=True)
                 if r.times[0] > whole.times[0] and r.counts.max() <= 1]  # fmt: skip
    for r in shortened:
        out.append(f"only the last {r.fitted} rows before the held-out part were fitted, of {r.given} in all: "
                   "they are too many, and too sparse for the motion to be averaged")  # fmt: skip
    if any(r.counts.max() > 1 for r in problem.rows):
        given, used = sum(r.given for r in problem.rows), sum(r.used for r in problem.rows)
        out.append(f"the rows were averaged from {given} to {used}: "
                   "they are sampled far above the motion's frequencies")  # fmt: skip
    if odds.is_constant:
        out.append("nothing that was read shows the simulated motion: constants and noise tell the readings as well; "
                   "check [initial], the units, and [recording.observe]")  # fmt: skip
    if not after.converged:
        out.append("the fit did not converge; its numbers are not to be relied on")
    if not all(np.isfinite(o.readings).all() for o in (*without, *with_)):
        out.append("the simulated trajectory diverges: it leaves every bound before the recording ends")
    if not all(o.ok for o in (*without, *with_)):
        out.append("a filter step failed: the trajectory diverges from the recording, or is not finite")
    for outlook in with_:
        out += strayed(outlook, recordings[outlook.recording], len(recordings) > 1)
    if forecast is not None:
        out += far_off(forecast, recordings[0])
    if not found.is_fine:
        out.append("halving the substeps once more still changes the readings by what can be seen: the motion is too "
                   "stiff, or too sensitive, for them; try a shorter [integrator] step")  # fmt: skip
    out += [f"recordings {a} and {b} hold the same numbers: what they show counts twice" for a, b in _same(recordings)]
    if not found.complete:
        out.append("the time limit was reached before every combination was weighed")
    out += at_bounds(problem, after) + stuck(recordings)
    for j, name in enumerate(c.names):
        moved = abs(after.z[problem.head + j] - c.mean[j]) / c.sd[j]
        if moved > 3:
            out.append(f"{name} moved {moved:.1f} of its prior standard deviations to fit the recording")
    if chosen is not None and is_clear(found, chosen.best):
        when = _when(problem, recordings, chosen.best)
        out.append(f"a remainder without a name is left beside the findings: {_REMAINDERS[chosen.best.kind]}{when}")
    if chosen is not None:
        out += in_tune(problem, after) + hardly_entered(with_)
    if chosen is not None and any(o.estimate.bends for o in with_):
        out.append("what is known of that error is part of the readings that are expected with the findings; "
                   "augmented.toml does not have it")  # fmt: skip
    if found.ahead:
        out.append("the remainder is clear, so answers were also weighed by how well they predict rows that they were "
                   "not fitted to")  # fmt: skip
    if odds.tempered < _TOLD:
        out.append(f"evidence was discounted by a factor of {1 / odds.tempered:.1f}: "
                   "the remainder is not white on the scale of the motion")  # fmt: skip
    return out


def at_bounds(problem: Problem, after: Estimate) -> list[str]:
    """Which calibrated values the readings would have beyond a bound that is given; zero is no other."""
    c, out = problem.calibrated, []
    for j, name in enumerate(c.names):
        k = problem.head + j
        z, near = float(after.z[k]), _AT * float(np.sqrt(after.covariance[k, k]))
        for bound, beyond in ((c.lower[j], z <= c.lower[j] + near), (c.upper[j], z >= c.upper[j] - near)):
            if np.isfinite(bound) and abs(bound) > _NOTHING * abs(c.mean[j]) and beyond:
                out.append(f"{name} is at its bound, {bound:g}: the readings would have it beyond, and what is found "
                           "may stand in for that; widen the bound if it may be")  # fmt: skip
    return out


def stuck(recordings: Sequence[Recording]) -> list[str]:
    """Which columns read one value throughout, beside others that do not."""
    every = np.concatenate([r.readings for r in recordings])
    still = [np.ptp(column[~np.isnan(column)]) == 0 for column in every.T]
    return [
        f"{name} reads {column[~np.isnan(column)][0]:g} in every row: a sensor that is stuck shows nothing of the "
        "motion and misleads; take the column out of [recording.observe] unless it is right"
        for name, column, same in zip(recordings[0].columns, every.T, still, strict=True)
        if same and not all(still)
    ]


def set_back(before: Mapping[str, Any], after: Mapping[str, Any]) -> list[str]:
    """Which readings the held-out run misses by more with the findings than without, of what `fit` tells of both."""
    first, later = before["holdout_rmse"] or {}, after["holdout_rmse"] or {}
    worse = [name for name, error in first.items() if error is not None and (later.get(name) or 0.0) > _WORSE * error]
    return [
        f"the held-out rows of {name} are missed by more with the findings than without: "
        f"{later[name]:.4g} against {first[name]:.4g}"
        for name in worse
    ]


def missed(fit: Mapping[str, Any]) -> list[str]:
    """Which readings the held-out run misses by far more than the answer itself expects, of what `fit` tells."""
    return [
        f"the held-out rows of {name} are missed by {misfit:.2g} times what is expected of this answer: it does not go "
        "on as it began, so something is missing in it, or what is held out is another regime"
        for name, misfit in (fit["holdout_misfit"] or {}).items()
        if misfit is not None and misfit > _MISSED
    ]


def asks_for_more(all_rows: Mapping[str, Any] | None) -> list[str]:
    """That the held-out rows hold what the fitted ones do not, of what `all_rows` tells."""
    if all_rows is None:
        return []
    one = all_rows["likeliest"]
    names = [f"{found['effect']} of {_targets(found['target'])}" for found in one["findings"]]
    return [
        "the held-out rows ask for more: with them among the fitted ones nothing left out has a probability of "
        f"{all_rows['as_it_is']:.2g}, and {' and '.join(names) or 'something without a name'} one of "
        f"{one['probability']:.2g}; ask again with --holdout 0"
    ]


def _targets(target: str | Sequence[str]) -> str:
    return target if isinstance(target, str) else " and ".join(target)


def _same(recordings: Sequence[Recording]) -> list[tuple[int, int]]:
    """Numbers of recordings that are copies of one another."""
    return [
        (a.number, b.number)
        for a, b in itertools.combinations(recordings, 2)
        if np.array_equal(a.times, b.times) and np.array_equal(a.readings, b.readings, equal_nan=True)
    ]


def doubled(file: SimulationFile) -> list[str]:
    """Which known terms of one coefficient are there twice in a recording: their sum is one of the same law.

    Forcings and impulses of several frequencies and times are not; they may well be several.
    """
    out = []
    for k, one in enumerate(file.terms):
        for other in file.terms[:k]:
            same = (one.effect, one.target) == (other.effect, other.target) and len(one.coefficients) == 1
            anywhere = one.recordings is None or other.recordings is None
            if same and (anywhere or {*(one.recordings or ())} & {*(other.recordings or ())}):
                out.append(f"[[terms]] has {one.effect} of {', '.join(one.target)} more than once: all of them act")
    return list(dict.fromkeys(out))


def idle_units(file: SimulationFile) -> list[str]:
    """Which names of [units] are no quantity of the simulation, and so are shown nowhere."""
    r = file.recording
    known = {*file.states, *file.parameters, *r.inputs, *r.observe, r.time, *r.group, *r.where, "t", "H"}
    return [
        f"[units] has {name}, which is no column, coordinate, momentum, parameter or input of the simulation: "
        "it is shown nowhere"
        for name in file.units
        if name not in known
    ]


def unused(file: SimulationFile) -> list[str]:
    """What the file says and nothing uses: limits of a start, and what is known of a calibrated scatter."""
    starts = [name for name, q in file.initial.items() if q.positive or q.lower is not None or q.upper is not None]
    open_ = [term for term in file.terms if not all(q.known for q in term.coefficients.values())]
    noises, outliers = ([t.target[0] for t in open_ if t.effect == one.name] for one in (NOISE, OUTLIERS))
    return [
        *(f"[initial] {name} has limits, which are not kept: a start is known by its value and sd" for name in starts),
        *(f"the noise of {column} is estimated, as if nothing were known of its factor in [[terms]]; give a number to "
          "have it kept" for column in noises),
        *(f"the outliers of {column} are taken out as if nothing were known of their share and size in [[terms]]"
          for column in outliers),
    ]  # fmt: skip


def _when(problem: Problem, recordings: Sequence[Recording], best: Estimate) -> str:
    """From when to when a remainder acts that does not always."""
    acts = spell_windows(problem, best.exposures) if best.exposures is not None else []
    where = [f" in recording {recordings[r].number}" if len(recordings) > 1 else "" for r, _ in acts]
    return "".join(f", t = {moment(w[0])} to {moment(w[1])}{run}" for (_, w), run in zip(acts, where, strict=True))


def strayed(outlook: Outlook, recording: Recording, is_one_of_several: bool) -> list[str]:
    """Which readings of the held-out run leave what was read by far."""
    where = f" in recording {recording.number}" if is_one_of_several else ""
    return [
        f"the held-out run of {name}{where} leaves all that was read by more than {_FAR:g} times its range: "
        "what is fitted does not say how it goes on"
        for name, run, read in zip(recording.columns, outlook.run.T, recording.readings.T, strict=True)
        if _off(run, read[~np.isnan(read)]).any()
    ]


def _off(run: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """Where readings leave the middle of what was seen by far; what never moved gives no range to compare with."""
    if not len(seen) or np.ptp(seen) == 0:
        return np.zeros(len(run), bool)
    return np.abs(run - (seen.min() + seen.max()) / 2) > _FAR * np.ptp(seen)


def far_off(forecast: Forecast, recording: Recording) -> list[str]:
    """Which expected readings leave what was read by far, or are not known, from what time on."""
    out = []
    for (name, column), read in zip(forecast.columns.items(), recording.readings.T, strict=True):
        for label in ("before", "after"):
            if (lost := ~np.isfinite(column[label] + column[f"{label}_sd"])).any():
                out.append(f"the forecast of {name} {label} the findings is empty from t = "
                           f"{moment(forecast.times[lost][0])} on: the trajectory diverges there")  # fmt: skip
        for label in ("before", "after"):
            if (off := _off(column[label], read[~np.isnan(read)])).any():
                out.append(f"the forecast of {name} {label} the findings leaves all that was read by more than "
                           f"{_FAR:g} times its range from t = {moment(forecast.times[off][0])} on")  # fmt: skip
    return out
