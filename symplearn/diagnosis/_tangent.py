"""When a further effect would help, at every time and frequency at once: from the tangent flow of one trajectory.

A disturbance at time s shows at time t as R(t) Phi(s)^-1 times it, where Phi are the slopes of the phase point in its
start and R those of the readings. So the response to a blow, a periodic force or a change of a parameter is a sum of
columns that are known already, and no trajectory is stepped for any place (the score test of Rao 1948, as in `_score`;
only the best places are looked at there).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from .. import _effects as effects
from ._calibrate import Fits, Priors, by_the_noise, noise_roots, weights
from ._problem import Problem
from ._scan import BEST, grid, layout, packed, spacing
from ._score import Unit
from ._trajectory import Stepper

# Effects whose places are looked for here: at times, and at frequencies.
_SUDDEN, _PERIODIC = (effects.IMPULSE, effects.REGIME), (effects.FORCING, effects.MODULATION)
# Places kept for each effect and target, of all choices of recordings; times that are looked at.
_KEPT, _TIMES = 8, 400
# Of the distance of a grid's neighbours, how far apart those are at least.
_APART = 1.5
# Round-off of an inverse, relative; beyond, the trajectory is too chaotic to be drawn back to its start.
_EXACT = 1e-6
# Of what is left of a square after a projection.
_ROUND_OFF = 1e-9


@dataclass(frozen=True, eq=False)
class _Recording:
    """What one recording has of a trajectory, readings by their noise: what arises is drawn back to the start."""

    times: Float[np.ndarray, " row"]
    slopes: Float[np.ndarray, "row channel state"]  # R
    back: Float[np.ndarray, "row state state"]  # Phi^-1
    done: dict[int, Float[np.ndarray, "row state"]]  # up to each row, by a unit of what acts all the time
    error: Float[np.ndarray, "row channel"]  # what the unknowns leave of the readings' errors
    others: Float[np.ndarray, "row channel unknown"]  # an orthonormal basis of what the unknowns can do

    def drawn(self, vectors: Float[np.ndarray, "*place row state"]) -> "_Sums":
        """Sums over what `vectors` at the start show at each row."""
        shown = np.einsum("tmd,...td->...tm", self.slopes, vectors)
        return _Sums(
            np.einsum("katm,kbtm->kab", shown, shown),
            np.einsum("katm,tm->ka", shown, self.error),
            np.einsum("katm,tmq->kaq", shown, self.others),
        )

    def after(self, tail: Float[np.ndarray, "row channel"], vectors: np.ndarray, places: np.ndarray) -> "_Sums":
        """The same of `tail` plus what `vectors` (row, state) show, over the rows later than each place."""
        all_columns = np.concatenate([self.slopes, tail[..., None]], axis=-1)
        first = np.clip(np.searchsorted(self.times, places, side="right"), 1, len(self.times))
        each = np.concatenate([vectors, np.ones((len(vectors), 1))], axis=1)[first - 1]

        def later(rows: np.ndarray) -> np.ndarray:
            sums = np.cumsum(rows[::-1], axis=0)[::-1]
            return np.concatenate([sums, np.zeros_like(sums[:1])])[first]

        square = later(np.einsum("tma,tmb->tab", all_columns, all_columns))
        push = later(np.einsum("tma,tm->ta", all_columns, self.error))
        shared = later(np.einsum("tma,tmq->taq", all_columns, self.others))
        return _Sums(
            np.einsum("ka,kab,kb->k", each, square, each)[:, None, None],
            np.einsum("ka,ka->k", each, push)[:, None],
            np.einsum("ka,kaq->kq", each, shared)[:, None],
        )


@dataclass(frozen=True, eq=False)
class _Sums:
    """Of the responses to an effect's amplitudes at every place: products with each other, with the errors, and with
    the basis of what the unknowns can do."""

    square: Float[np.ndarray, "place amplitude amplitude"]
    push: Float[np.ndarray, "place amplitude"]
    shared: Float[np.ndarray, "place amplitude unknown"]

    def __add__(self, other: "_Sums") -> "_Sums":
        return _Sums(self.square + other.square, self.push + other.push, self.shared + other.shared)

    def gains(self, scales: Float[np.ndarray, " amplitude"]) -> Float[np.ndarray, " place"]:
        """Log evidence that amplitudes of these prior widths gain at each place."""
        unit = np.outer(scales, scales)
        square = self.square * unit
        left = square - np.einsum("kaq,kbq->kab", self.shared, self.shared) * unit
        diagonal = np.arange(len(scales))
        left[:, diagonal, diagonal] += 1.0 + _ROUND_OFF * square[:, diagonal, diagonal]
        push = self.push * scales
        solved = np.linalg.solve(left, push[..., None])[..., 0]
        return 0.5 * (push * solved).sum(1) - 0.5 * np.linalg.slogdet(left)[1]


def sharp_units(stepper: Stepper, fits: Fits, rows: Sequence[int], priors: Priors) -> dict[int, list[Unit]]:
    """The best times and frequencies about a fit, by effect and target; empty where it cannot be drawn back."""
    problem = stepper.problem
    wanted = [c for c in problem.searched if problem.candidate(c).effect in _SUDDEN + _PERIODIC]
    with np.errstate(all="ignore"):  # a trajectory that ran away is told by what is not finite
        recordings = _recordings(stepper, fits, rows, priors) if wanted else None
        if recordings is None:
            return {}
        return {c: [Unit(c, place) for place in _best(problem, recordings, priors, c)] for c in wanted}


def _best(problem: Problem, recordings: Sequence[_Recording], priors: Priors, candidate: int) -> list[float]:
    """The best places of an effect and target, in all recordings or in some."""
    one = problem.equations.candidates[candidate]
    places = _places(problem, recordings, priors, candidate)
    sums = [_sums(problem, own, candidate, places) for own in recordings]
    scales = priors.scales[one.first : one.first + one.effect.amplitudes]
    ends = priors.lower[one.values.stop - 1], priors.upper[one.values.stop - 1]
    apart = _APART * spacing(one, *map(float, ends))
    found: dict[int, float] = {}
    for member in [candidate, *problem.variants(candidate)]:
        which = problem.members[member].recordings
        if one.effect is effects.IMPULSE and len(which) > 1:
            continue
        mine = sums[which[0]]
        for r in which[1:]:
            mine = mine + sums[r]
        gains = np.nan_to_num(mine.gains(scales), nan=-np.inf, posinf=-np.inf)
        for k in _peaks(gains, places, apart)[:BEST]:
            found[k] = max(found.get(k, -np.inf), float(gains[k]))
    every = np.full(len(places), -np.inf)
    every[list(found)] = list(found.values())
    return [float(places[k]) for k in _peaks(every, places, apart)[:_KEPT]]


def _peaks(gains: Float[np.ndarray, " place"], places: Float[np.ndarray, " place"], apart: float) -> list[int]:
    """The best places, best first, none within `apart` of a better one."""
    kept: list[int] = []
    for k in np.argsort(-gains, kind="stable"):
        if not np.isfinite(gains[k]) or len(kept) == _KEPT:
            break
        if all(abs(places[k] - places[j]) >= apart for j in kept):
            kept.append(int(k))
    return kept


def _places(problem: Problem, recordings: Sequence[_Recording], priors: Priors, candidate: int) -> np.ndarray:
    one = problem.equations.candidates[candidate]
    if one.effect in _PERIODIC:
        return np.array([unit.place for unit in grid(problem, priors, candidate)])
    times = np.unique(np.concatenate([own.times[:-1] for own in recordings]))
    return times[:: max(1, -(-len(times) // _TIMES))]


def _sums(problem: Problem, own: _Recording, candidate: int, places: np.ndarray) -> _Sums:
    one = problem.equations.candidates[candidate]
    if one.effect is effects.IMPULSE:
        blows = own.back[:, :, problem.equations.width + one.place]
        return own.after(np.zeros_like(own.error), blows, places)
    done = own.done[_steady(problem, candidate)]
    if one.effect is effects.REGIME:
        return own.after(np.einsum("tmd,td->tm", own.slopes, done), -done, places)
    angle = places[:, None] * (0.5 * (own.times[1:] + own.times[:-1]) - problem.equations.origin)
    waves = np.stack([np.cos(angle), np.sin(angle)], axis=1)[..., None] * np.diff(done, axis=0)
    return own.drawn(np.pad(np.cumsum(waves, axis=2), [(0, 0), (0, 0), (1, 0), (0, 0)]))


def _steady(problem: Problem, candidate: int) -> int:
    """What acts all the time as a periodic force or a change of a parameter does at one."""
    one = problem.equations.candidates[candidate]
    kind = effects.POWERS[0] if one.effect is effects.FORCING else effects.ERROR
    return next(k for k, c in enumerate(problem.equations.candidates) if c.effect is kind and c.places == one.places)


def _recordings(stepper: Stepper, fits: Fits, rows: Sequence[int], priors: Priors) -> list[_Recording] | None:
    """Every recording's part of a fit of one lane; None where it cannot be drawn back to the start."""
    problem = stepper.problem
    left = _left(problem, fits, rows, priors)
    if left is None:
        return None
    steady = {
        _steady(problem, c) for c in problem.searched if problem.candidate(c).effect in (effects.REGIME, *_PERIODIC)
    }
    lanes = list(packed(problem, [Unit(c, None) for c in sorted(steady)]))
    laid = [layout(problem, units) for units in ([], *lanes)]
    out = []
    for r, (error, others) in enumerate(left):
        start, *further = stepper.carried(fits.z[0], fits.combinations[0], laid, rows[r], r)
        back = _inverses(start[:, :, problem.channels :].transpose(1, 2, 0))
        if back is None:
            return None
        pairs = [pair for units, lane in zip(lanes, further, strict=True) for pair in zip(units, lane, strict=True)]
        done = {unit.candidate: np.einsum("tds,ts->td", back, x[:, problem.channels :]) for unit, x in pairs}
        root = noise_roots(weights(problem, rows), fits)[r]
        slopes = start[:, :, : problem.channels].transpose(1, 2, 0) * root[..., None]
        out.append(_Recording(problem.rows[r].times[: rows[r]], slopes, back, done, error, others))
    return out


def _inverses(phi: Float[np.ndarray, "row state state"]) -> np.ndarray | None:
    """Their inverses; None where round-off would be more than `_EXACT` of them, whatever the units of the state."""
    if not np.isfinite(phi).all():
        return None
    try:
        back = np.linalg.inv(phi)
    except np.linalg.LinAlgError:
        return None
    grown = np.einsum("tab,tba->ta", np.abs(back), np.abs(phi)).max()
    return back if grown * np.finfo(float).eps < _EXACT else None


def _left(
    problem: Problem, fits: Fits, rows: Sequence[int], priors: Priors
) -> list[tuple[np.ndarray, np.ndarray]] | None:
    """What the unknowns of a fit leave of the errors, and an orthonormal basis of what they can do, by recording."""
    (combination,), (z,) = fits.combinations, fits.z
    free = np.nonzero(problem.active(combination))[0]
    held = np.sqrt(priors.precision_of(problem, combination)[free])
    errors, slopes = by_the_noise(problem, fits, rows)
    columns = np.concatenate([slopes[free].T, np.diag(held)])
    whole = np.concatenate([errors, held * (priors.mean_of(problem, combination) - z)[free]])
    if not (np.isfinite(columns).all() and np.isfinite(whole).all()):
        return None
    basis = np.linalg.qr(columns / np.maximum(np.linalg.norm(columns, axis=0), 1e-300))[0]
    whole = whole - basis @ (basis.T @ whole)
    ends = np.cumsum([0, *(n * problem.channels for n in rows)])
    parts = [slice(a, b) for a, b in zip(ends[:-1], ends[1:], strict=True)]
    return [(whole[part].reshape(n, -1), basis[part].reshape(n, problem.channels, -1))
            for n, part in zip(rows, parts, strict=True)]  # fmt: skip
