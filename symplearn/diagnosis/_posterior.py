"""From evidences to probabilities: the contract's prior, the price of a combination, tempering under misfit."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from .._effects import GAIN, HIDDEN, REGIME, Memory
from ._constant import constant_evidence
from ._found import UNCONVERGED, Found, speaker
from ._own_period import in_tune
from ._problem import Combination, Problem
from ._static import LARGEST
from ._strength import faint_share
from ._weighed import Estimate

# A coefficient whose posterior is as wide as this share of its prior has learnt nothing from the recording.
_UNINFORMED = 0.7
# One that has moved so many standard deviations has, however narrow its prior was; a law that may be nothing is none.
_MOVED = 2.0
# A sensor that shows less than this share of the motion shows none of it, and its scale is no finding.
_DEAD = 0.1
# The simulation counts as consistent unless the probability of nothing left out is below this (contract).
CONSISTENT = 0.05
# Prior share of a remainder beside findings: as many cases as issue 6 would have carry one.
_BESIDE = 0.25
# A remainder that gains so many times what the findings do hides what they are.
_DWARFED = 3.0
# Constants tell readings as well that are behind by so many nats at most.
_AS_WELL = 3.0
# Kinds of remainder other than white noise, which divide its prior among them.
_REMAINDERS = ("coloured", "clock", "positional", "kinematic", "jitter", "static", "force", "spell")


@dataclass(frozen=True)
class Weighed:
    """A combination with its posterior probability and the estimate that speaks for it."""

    combination: Combination
    probability: float
    log_evidence: float  # over kinds of remainder, tempered, prior of the combination not included; scores ahead added
    best: Estimate


@dataclass(frozen=True)
class Posterior:
    """Probabilities of everything that was weighed.

    `as_it_is` is the probability of the simulation with nothing left out, `unexplained` that of a remainder without
    a name; `named` holds the combinations, likeliest first; `faint` that of a single effect that was not fitted because
    the recording shows nothing of it. They add up to one. `tempered` is the factor by which log evidences were shrunk
    because the remainder is not white on the scale of the motion.
    """

    as_it_is: float
    unexplained: float
    named: tuple[Weighed, ...]
    faint: float
    nothing: Estimate  # the best estimate without effects
    evidences: dict[Combination, float]  # tempered log evidence of everything fitted, nothing (best kind) included
    tempered: float
    is_constant: bool  # whether readings are told as well by constants as by anything that was weighed


def posterior(problem: Problem, found: Found, inflation: float) -> Posterior:
    """Weigh every combination by evidence and the contract's prior (section 4)."""
    remainder = found.prices.remainder
    factor = 1.0 / max(1.0, inflation)
    top = max(e.log_evidence for es in found.estimates.values() for e in es)
    if not np.isfinite(top):
        return Posterior(0.0, 1.0, (), 0.0, speaker(found.estimates[()]), {(): -np.inf}, factor, False)
    unseen = min((one.score for one in found.ahead.values()), default=0.0)
    named_runs = max((one.score for c, one in found.ahead.items() if not found.has_law(c)), default=unseen)
    bare = found.of((), "white")
    least = -np.inf if bare is None else top + factor * (bare.log_evidence - top)
    constant = top + factor * (constant_evidence(problem, bare) - top)
    white, other, named = -np.inf, constant + np.log(remainder), []
    evidences: dict[Combination, float] = {}
    for combination, estimates in found.estimates.items():
        tempered = {e.kind: top + factor * (e.log_evidence - top) for e in estimates}
        ahead = found.ahead[combination].score if combination in found.ahead else unseen
        if found.has_law(combination):  # it explains what no name explains, and is no better extrapolation
            ahead = min(ahead, named_runs)
        plain = tempered.get("white", -np.inf) + ahead
        beside, doubtful = _beside_a_remainder(tempered, least if combination else np.inf, remainder, ahead)
        noisy = float(np.logaddexp(beside, doubtful))
        if not combination:
            white, other = plain, float(np.logaddexp(other, noisy))
            evidences[combination] = max(plain, noisy - np.log(remainder))
            continue
        total = evidences[combination] = float(np.logaddexp(plain + np.log(1.0 - _BESIDE), noisy))
        if _swings_out_of_step(problem, found, combination):
            continue
        if _informed(problem, found, combination) and not _is_remainder(problem, found, combination):
            # What no fit of came to its end, as where a time stops between two rows, may have less than it was given.
            doubt = 0.0 if any(e.converged for e in estimates) else UNCONVERGED
            price = found.prices.log(combination) - doubt
            # What explains less than it leaves, and was not seen to predict anything, is not what was left out.
            if found.ahead and not _predicts(problem, found, combination, _is_dwarfed(tempered, least)):
                other = float(np.logaddexp(other, price + doubtful))
                total = float(np.logaddexp(plain + np.log(1.0 - _BESIDE), beside))
            named.append((combination, price, total, speaker(estimates)))
    with np.errstate(divide="ignore"):
        faint = white + np.log(_unseen(problem, found))
    logs = np.array([white, other, faint, *(w + total for _, w, total, _ in named)])
    probability = np.exp(logs - logs.max())
    probability /= probability.sum()
    ranked = sorted(zip(named, probability[3:], strict=True), key=lambda pair: -pair[1])
    return Posterior(
        as_it_is=float(probability[0]),
        unexplained=float(probability[1]),
        named=tuple(Weighed(c, float(p), float(total), best) for (c, _, total, best), p in ranked),
        faint=float(probability[2]),
        nothing=speaker(found.estimates[()]),
        evidences=evidences,
        tempered=factor,
        is_constant=bool(constant > max(evidences[c] for c in ((), *(c for c, *_ in named))) - _AS_WELL),
    )


def _predicts(problem: Problem, found: Found, combination: Combination, is_dwarfed: bool) -> bool:
    """Whether a trajectory goes on as it began, or at least better than that of the simulation as it is. The latter
    does not count where something has the motion's own period, which for a while follows whatever goes with it; the
    former where the simulation as it is goes on, too, as what an input drives does, and a finding is dwarfed by what it
    leaves: any unknown takes a part of that."""
    one, bare = found.ahead.get(combination), found.ahead.get(())
    if one is None:
        return False
    if one.holds:
        return one.is_better or not (is_dwarfed and bare is not None and bare.holds)
    return one.is_better and not in_tune(problem, speaker(found.estimates[combination]))


def _swings_out_of_step(problem: Problem, found: Found, combination: Combination) -> bool:
    """Whether something that swings by itself does not go on as it began, where what has nothing of the kind does and
    predicts as well: beside a clear remainder a swing follows any curve for a while."""
    one = found.ahead.get(combination)
    if (one is not None and one.holds) or not problem.swings(combination):
        return False
    steady = [other for c, other in found.ahead.items() if problem.is_steady(c)]
    return any(r.holds and r.is_better and (one is None or r.score >= one.score) for r in steady)


@np.errstate(invalid="ignore")  # where neither has an evidence, nothing is dwarfed
def _is_dwarfed(tempered: Mapping[str, float], least: float) -> bool:
    """Whether the remainder beside a combination gains far more than the combination does over `least`."""
    white = tempered.get("white", -np.inf)
    rest = max((value for kind, value in tempered.items() if kind != "spell"), default=-np.inf)
    return bool(rest - white > _DWARFED * (white - least))


@np.errstate(invalid="ignore")  # where neither has an evidence, which gains more does not matter
def _beside_a_remainder(tempered: Mapping[str, float], least: float, price: float, ahead: float) -> tuple[float, float]:
    """Log evidence of a combination beside remainders, prior of these included: of those that it may be told beside,
    and of the doubtful. `least` is the evidence of nothing, `ahead` what is added for how a trajectory goes on.

    Real systems often keep a small one. But one that gains more than the findings do is not small beside them: it has
    the contract's price of what has no name, as it has without findings, and they are doubtful. How a trajectory goes
    on says nothing of a force that acts for a while.
    """
    white = tempered.get("white", -np.inf)
    values = np.array([tempered.get(kind, -np.inf) for kind in _REMAINDERS])
    small, lasts = white - least >= values - white, np.array(_REMAINDERS) != "spell"
    logs = values + np.where(lasts, ahead, 0.0) + np.log(np.where(small, _BESIDE, price))
    doubtful = ~small & lasts
    return _mixture(np.where(doubtful, -np.inf, logs)), _mixture(np.where(doubtful, logs, -np.inf))


def _unseen(problem: Problem, found: Found) -> float:
    """Prior of the effects that were not fitted, as far as they are too weak to be seen: on average as those that were.

    Where the simulation nearly follows the recording only those of the highest scores are fitted.
    """
    alone = [c for c in found.estimates if len(c) == 1]
    shares = [share for c in alone if (share := _faint(problem, found, c)) is not None]
    fitted = {problem.whole(m) for (m,) in alone}
    return sum(p for m, p in found.prices.whole.items() if m not in fitted) * float(np.mean(shares)) if shares else 0.0


def _faint(problem: Problem, found: Found, combination: Combination) -> float | None:
    """Share of the prior of an effect alone that the recording could not show; None where it says nothing of it."""
    ((member, place),) = problem.placed(combination)
    one = problem.candidate(member)
    if not one.effect.amplitudes:
        return None
    best = max(found.estimates[combination], key=lambda e: e.log_evidence)
    sd = float(np.sqrt(best.covariance[place.start, place.start]) / found.priors.scales[one.first])
    return faint_share(sd) if sd < _UNINFORMED else None


def _is_remainder(problem: Problem, found: Found, combination: Combination) -> bool:
    """Whether a law of place without a word that a combination holds, beside findings, is as small as what counts as a
    remainder there."""
    for member in combination:
        law, rest = problem.candidate(member).nameless, tuple(m for m in combination if m != member)
        if law is None or law.kind != "conservative" or len(law.places) > 1 or not found.of(rest, "static"):
            continue
        white, without = found.of(combination, "white"), found.of(rest, "white")
        number = sum(int((~np.isnan(rows.readings[: rows.fitted])).sum()) for rows in problem.rows)
        if white and without and white.log_evidence - without.log_evidence < 0.5 * LARGEST**2 * number:
            return True
    return False


def _mixture(values: Float[np.ndarray, " kind"]) -> float:
    """Log of the mean of exponentials."""
    return float(np.logaddexp.reduce(values) - np.log(len(values)))


def _informed(problem: Problem, found: Found, combination: Combination) -> bool:
    """Whether the recording says anything about every coefficient of a combination, or how an unseen one swings.

    An effect that calibration owns already (a stiffness beside a free stiffness) changes nothing, and its
    posterior is its prior; weighing it would only dilute the others. One that would swing, but fits best where it has
    not come round once, at the lowest frequency looked for or below, was not seen to swing: any slow change would do.
    What changes before the readings say more than where the motion starts was not seen to change: it is another value
    of its parameter, which a prior may exclude. A scale that makes a reading vanish says nothing of the motion that was
    to be read. A law without a word whose size may be nothing has its evidence from no optimum: where it goes with a
    coordinate that is not read, it is as large as that coordinate is small.
    """
    best = max(found.estimates[combination], key=lambda e: e.log_evidence)
    sd = np.sqrt(np.diag(best.covariance))
    known = True
    for member, place in problem.placed(combination):
        one = problem.candidate(member)
        amplitudes = slice(place.start, place.start + one.effect.amplitudes)
        scales = found.priors.scales[one.first : one.first + one.effect.amplitudes]
        moved = _moved(best, amplitudes)
        shown = moved or bool((sd[amplitudes] < _UNINFORMED * scales).all())
        known &= moved or one.nameless is None
        if one.effect is HIDDEN:  # how it swings may be seen where how strongly it is joined is not
            shown |= bool((sd[problem.starts(member)] < _UNINFORMED * found.priors.starts_of(one)).any())
        known &= shown and not (one.effect is GAIN and abs(1.0 + best.z[place.start]) < _DEAD)
        if one.effect.swings or isinstance(one.effect, Memory):
            known &= bool(best.z[place.stop - 1] > found.priors.lower[one.values.stop - 1])
        if one.effect is REGIME:
            known &= _is_seen_before(problem, member, best.z[place.stop - 1])
        if isinstance(one.effect, Memory):  # what fades at once is a loss that has a name
            known &= bool(best.z[place.stop - 1] < found.priors.upper[one.values.stop - 1])
    return bool(np.isfinite(best.log_evidence) and known)


def _is_seen_before(problem: Problem, member: int, time: float) -> bool:
    """Whether more is read before a time than the numbers of a start, in any of the recordings that an effect is in, or
    the others, which it is not in, show how it was."""
    which = problem.members[member].recordings
    seen = [int((~np.isnan(problem.rows[r].readings[problem.rows[r].times < time])).sum()) for r in which]
    return len(which) < len(problem.rows) or max(seen) > 2 * problem.equations.declared


def _moved(best: Estimate, amplitudes: slice) -> bool:
    """Whether amplitudes are clearly not zero, all together."""
    z, spread = best.z[amplitudes], best.covariance[amplitudes, amplitudes]
    return bool(z @ np.linalg.pinv(spread) @ z > _MOVED**2)
