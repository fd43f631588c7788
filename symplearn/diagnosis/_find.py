"""From files to everything that was weighed: the problem laid out finely enough, searched, and searched again where
no name fits."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from .._augmented import Equations
from .._recording import Recording
from .._simulation_records import SimulationFile
from ._ahead import look_ahead
from ._build import build, equations_for, first_substep, refined, rows_fitted
from ._calibrate import Fits
from ._found import Found, doubtful_outliers, speaker
from ._kept_back import of_all_rows, promises_more
from ._lasting import total_noise
from ._late import left_out, without_the_time_before
from ._missed import rough_noise
from ._nameless import is_clear, weigh_nameless
from ._options import Options
from ._other_units import in_another_time, in_other_units
from ._problem import Problem
from ._search import Search
from ._start import first_fits, priors_without_effects
from ._trajectory import Stepper
from ._usable import check_columns, check_fitted, check_motion, check_searched, check_steps
from ._verdict import judged

# Third differences show the noise and some of the motion: the share of them that counts as noise at least.
_ROUGH = 0.3
# How often a search begins, at most, without what was found to be of another time.
_ANEW = 2


@dataclass(frozen=True)
class _Laid:
    """A problem in steps to begin with, the first fits, and what lays it out anew in steps of another length."""

    stepper: Stepper
    seeds: Fits
    rebuild: Callable[..., Problem]
    substep: float


def searched(
    file: SimulationFile, recordings: Sequence[Recording], options: Options, deadline: float
) -> tuple[Found, Stepper, list[str], dict[str, Any] | None]:
    """Lay the problem out with substeps that are fine enough, and search; once more where what is found needs finer,
    or shows readings to be of another time, which is told in sentences, as other units are. At last what all
    rows say, the held-out ones too, where that is another answer.

    `InputError` where there is nothing to fit, to search or to step.
    """
    given = recordings
    laid = _laid_out(file, recordings, options)
    units = in_another_time(file, recordings, laid.stepper, laid.seeds.z, options, deadline)
    search, steps = _begun(laid, options, deadline)
    for _ in range(_ANEW):
        shown = without_the_time_before(search.stepper, search.found, recordings)
        if shown is None or not search.in_time():
            break
        options.progress("searching once more without what late sensors show of the time before")
        recordings = shown
        laid = _laid_out(file, recordings, options)
        search, steps = _begun(laid, options, deadline, search.found)
    weigh_nameless(file, recordings, options, search, steps[0])
    likeliest = max(search.found.estimates, key=search.found.odds)
    if search.found.has_law(likeliest):  # its shape may pass faster than the motion
        steps = _refined(search, lambda longest: laid.rebuild(longest, search.problem.equations), steps, options)
    search.settle()
    found = search.found
    options.progress("comparing how well answers predict ahead")
    look_ahead(search.stepper, found, search.rows)
    found.is_fine = steps[1]
    units = units or in_other_units(file, given, search.stepper, found, options, deadline)
    told = [*units, *left_out(search.problem, found, given, recordings)]
    return found, search.stepper, told, _with_all_rows(laid, search, steps[0], options, deadline)


def _laid_out(file: SimulationFile, recordings: Sequence[Recording], options: Options) -> _Laid:
    check_steps(file, recordings)
    built = equations_for(file, recordings, options.restriction)
    substep = first_substep(file, recordings)

    def rebuild(longest: float, equations: Equations = built, holdout: float = options.holdout) -> Problem:
        return build(file, equations, recordings, holdout, longest, options.restriction)

    problem = rebuild(substep)
    check_fitted(file, problem, options.holdout)
    check_columns(file, problem)
    check_searched(problem, options.restriction)
    check_motion(file, problem)
    stepper = Stepper(problem, options.jobs)
    options.progress("finding where the motion starts")
    seeds = first_fits(stepper, priors_without_effects(problem), rows_fitted(problem.rows))
    return _Laid(stepper, seeds, rebuild, substep)


def _begun(
    laid: _Laid, options: Options, deadline: float, earlier: Found | None = None
) -> tuple[Search, tuple[float, bool]]:
    """The search for names, and its longest substep with whether that is fine."""
    problem, seeds = laid.stepper.problem, laid.seeds
    # A few rows are fitted too well to tell the noise; where it is still too small, the search only takes longer.
    noise = np.maximum(seeds.noise[0], _ROUGH * rough_noise(problem, rows_fitted(problem.rows)))
    finer, substep, is_fine = refined(laid.rebuild, problem, seeds.z[0], noise, laid.substep)
    stepper = laid.stepper if finer is problem else Stepper(finer, options.jobs)
    search = _run(stepper, seeds.z, deadline, options, earlier)
    return search, _refined(search, laid.rebuild, (substep, is_fine), options)


def _with_all_rows(
    laid: _Laid, search: Search, longest: float, options: Options, deadline: float
) -> dict[str, Any] | None:
    """What all rows say where the fitted ones agree with the simulation, and all of them promise an effect."""
    if options.holdout <= 0 or not search.in_time() or judged(search.stepper, search.found)[2] != "consistent":
        return None
    options.progress("asking all rows, the held-out ones too")
    stepper = Stepper(laid.rebuild(longest, search.problem.equations, 0.0), options.jobs)
    if not promises_more(stepper, search.found):
        return None
    options.progress("searching once more, with the held-out rows among the fitted ones")
    whole = _run(stepper, search.beginning.seeds, deadline, options)
    return of_all_rows(whole.stepper, whole.found)


def _refined(
    search: Search, rebuild: Callable[[float], Problem], steps: tuple[float, bool], options: Options
) -> tuple[float, bool]:
    """Weigh the best combinations again in finer steps, if the best one needs them: the longest substep then, and
    whether it is fine enough."""
    best = max((e for es in search.found.estimates.values() for e in es), key=lambda e: e.log_evidence)
    if not np.isfinite(best.log_evidence):
        return steps
    # What lasts among the errors hides steps of some length, too: without it they would be no end too long.
    finer, longest, is_fine = refined(rebuild, search.problem, best.z, total_noise(best), steps[0], best.combination)
    if finer is not search.problem:
        options.progress("weighing the best combinations again in finer steps")
        search.again(Stepper(finer, options.jobs))
    return longest, is_fine


def _run(
    stepper: Stepper, seeds: np.ndarray, deadline: float, options: Options, earlier: Found | None = None
) -> Search:
    """Search with outliers taken out; anew with those of a column left in that turn out to be none: what the simulation
    misses of a motion may look like outliers of a path that follows it, and takes their places in a combination. Beside
    a clear remainder they may be a part of it: there the likelier one of both searches is the answer. What the other
    one weighed stays beside it."""
    spared: frozenset[int] = frozenset()
    rival: Search | None = None
    before: Found | None = None
    while True:
        search = Search(stepper, seeds, deadline, options.progress, spared, earlier)
        found = search.run()
        if rival is not None and _most(rival.found) >= _most(found):
            rival.found.stand_by(found)
            return rival
        if before is not None:
            found.stand_by(before)
        best = speaker(found.estimates[max(found.estimates, key=found.odds)])
        doubtful, rival = doubtful_outliers(search.problem, search.base, best), None
        if not doubtful and is_clear(found, best):
            doubtful, rival = frozenset(search.problem.candidate(m).place for m in search.base), search
        if not doubtful or not found.complete:
            return search
        options.progress("leaving readings in that are no outliers")
        spared, before = spared | doubtful, found


def _most(found: Found) -> float:
    """What the probability of the likeliest answer goes with."""
    return max(map(found.odds, found.estimates))
