"""When a further effect would help, at every time and frequency at once: from the tangent flow of one trajectory.

A disturbance at time s shows at time t as R(t) Phi(s)^-1 times it, where Phi are the slopes of the phase point in its
start and R those of the readings. So the response to a blow, a periodic force, an unseen oscillator or a change of a
parameter is a sum of columns that are known already, and no trajectory is stepped for any place (the score test of Rao
1948, as in `_score`; only the best places are looked at there).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from .. import _effects as effects
from ._calibrate import Fits, Priors, by_the_noise, noise_roots, weights
from ._problem import Problem
from ._scan import BEST, ends, grid, layout, packed, resolved, spacing
from ._score import Unit
from ._stochastic import trajectories
from ._trajectory import Stepper

# Places kept for each effect and target, of all choices of recordings; times and frequencies that are looked at, and
# how many of these together.
_KEPT, _TIMES, _FREQUENCIES, _TOGETHER = 8, 400, 400, 80
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
    path: Float[np.ndarray, "row state"]

    def drawn(self, vectors: Float[np.ndarray, "*place row state"]) -> "_Sums":
        """Sums over what `vectors` at the start show at each row."""
        shown = np.einsum("tmd,...td->...tm", self.slopes, vectors)
        flat = shown.reshape(*shown.shape[:2], -1)
        return _Sums(flat @ flat.mT, flat @ self.error.ravel(), flat @ self.others.reshape(flat.shape[2], -1))

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

    @classmethod
    def joined(cls, listed: Sequence["_Sums"]) -> "_Sums":
        """Of places one after the other."""
        each = zip(*((one.square, one.push, one.shared) for one in listed), strict=True)
        return cls(*(np.concatenate(some) for some in each))

    def __add__(self, other: "_Sums") -> "_Sums":
        return _Sums(self.square + other.square, self.push + other.push, self.shared + other.shared)

    def gains(self, scales: Float[np.ndarray, " amplitude"]) -> Float[np.ndarray, " place"]:
        """Log evidence that amplitudes of these prior widths gain at each place."""
        left, gained = self._solved(scales)
        return gained - 0.5 * np.linalg.slogdet(left)[1]

    def likelihoods(self, scales: Float[np.ndarray, " amplitude"]) -> Float[np.ndarray, " place"]:
        """What the log likelihood and prior gain at each place: the evidence of amplitudes of unknown order of
        magnitude goes with it, whether a unit shows much, as in resonance, or little."""
        return self._solved(scales)[1]

    def _solved(
        self, scales: Float[np.ndarray, " amplitude"]
    ) -> tuple[Float[np.ndarray, "place amplitude amplitude"], Float[np.ndarray, " place"]]:
        unit = np.outer(scales, scales)
        square = self.square * unit
        left = square - np.einsum("kaq,kbq->kab", self.shared, self.shared) * unit
        diagonal = np.arange(len(scales))
        left[:, diagonal, diagonal] += 1.0 + _ROUND_OFF * square[:, diagonal, diagonal]
        push = self.push * scales
        solved = np.linalg.solve(left, push[..., None])[..., 0]
        return left, 0.5 * (push * solved).sum(1)


def sharp_units(stepper: Stepper, fits: Fits, rows: Sequence[int], priors: Priors) -> dict[int, list[Unit]]:
    """The best times and frequencies about a fit, by effect and target; empty where it cannot be drawn back."""
    problem = stepper.problem
    wanted = [c for c in problem.searched if (kind := problem.candidate(c).effect).swings or kind in effects.AT_ONCE]
    with np.errstate(all="ignore"):  # a trajectory that ran away is told by what is not finite
        recordings = _recordings(stepper, fits, rows, priors) if wanted else None
        if recordings is None:
            return {}
        return {c: [Unit(c, place) for place in _best(problem, recordings, priors, c)] for c in wanted}


def _best(problem: Problem, recordings: Sequence[_Recording], priors: Priors, candidate: int) -> list[float]:
    """The best places of an effect and target, in all recordings or in some."""
    one = problem.equations.candidates[candidate]
    places = _places(problem, recordings, priors, candidate)
    cut = range(0, len(places), _TOGETHER) if one.effect.swings else (0,)
    parts = [places[a : a + _TOGETHER] if one.effect.swings else places for a in cut]
    alone = len(recordings) == 1
    sums = [_Sums.joined([_sums(problem, own, candidate, some, alone) for some in parts]) for own in recordings]
    scales = priors.scales[one.first : one.first + one.effect.amplitudes]
    scales = np.concatenate([scales, priors.starts_of(one)]) if one.effect is effects.HIDDEN and alone else scales
    apart = _APART * spacing(one, *ends(priors, one))
    found: dict[int, float] = {}
    for member in [candidate, *problem.variants(candidate)]:
        which = problem.members[member].recordings
        if one.effect is effects.IMPULSE and len(which) > 1:
            continue
        mine = sums[which[0]]
        for r in which[1:]:
            mine = mine + sums[r]
        gains = mine.likelihoods(scales) if one.effect is effects.HIDDEN else mine.gains(scales)
        gains = np.nan_to_num(gains, nan=-np.inf, posinf=-np.inf)
        for k in _peaks(gains, places, apart)[: _KEPT if one.effect is effects.HIDDEN else BEST]:
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
    if one.effect.swings:
        low, high = ends(priors, one)
        number = int(np.ceil((high - low) / spacing(one, low, high))) + 1
        longest = max(float(np.ptp(own.times)) for own in recordings)
        if number <= _FREQUENCIES or high - low <= resolved(longest) * _FREQUENCIES:
            return np.linspace(low, high, min(number, _FREQUENCIES))
        return np.array([unit.place for unit in grid(problem, priors, candidate)])
    times = np.unique(np.concatenate([own.times[:-1] for own in recordings]))
    return times[:: max(1, -(-len(times) // _TIMES))]


def _sums(problem: Problem, own: _Recording, candidate: int, places: np.ndarray, alone: bool = True) -> _Sums:
    """Of some places; an unseen oscillator's start is looked for where a recording is `alone`, and is at rest else."""
    one = problem.equations.candidates[candidate]
    if one.effect is effects.IMPULSE:
        blows = own.back[:, :, problem.equations.width + one.place]
        return own.after(np.zeros_like(own.error), blows, places)
    done = own.done[_steady(problem, candidate)]
    if one.effect is effects.REGIME:
        return own.after(np.einsum("tmd,td->tm", own.slopes, done), -done, places)
    angle = places[:, None] * (0.5 * (own.times[1:] + own.times[:-1]) - problem.equations.origin)
    waves = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    if one.effect is effects.HIDDEN:
        waves = _given_back(own, one.place, places, waves, alone)
    pushed = waves[..., None] * np.diff(done, axis=0)
    return own.drawn(np.pad(np.cumsum(pushed, axis=2), [(0, 0), (0, 0), (1, 0), (0, 0)]))


def _given_back(
    own: _Recording, coordinate: int, places: np.ndarray, waves: Float[np.ndarray, "place 2 span"], alone: bool
) -> Float[np.ndarray, "place amplitude span"]:
    """The force of an unseen oscillator, begun at rest, by a unit of its strength; and that of a unit of its place and
    of its speed at the start. In the middle of each span: w'' = -omega^2 w + q."""
    q = own.path[:, coordinate]
    taken = waves * (0.5 * (q[1:] + q[:-1]) * np.diff(own.times))
    before = np.cumsum(taken, axis=2) - 0.5 * taken
    omega = places[:, None]
    given = (waves[:, 1] * before[:, 0] - waves[:, 0] * before[:, 1]) / omega
    if not alone:
        return given[:, None]
    angle = omega * (0.5 * (own.times[1:] + own.times[:-1]) - own.times[0])
    return np.stack([given, np.cos(angle), np.sin(angle) / omega], axis=1)


def _steady(problem: Problem, candidate: int) -> int:
    """What acts all the time as a periodic force or a change of a parameter does at one."""
    one = problem.equations.candidates[candidate]
    kind = effects.POWERS[0] if one.effect in (effects.FORCING, effects.HIDDEN) else effects.ERROR
    return next(k for k, c in enumerate(problem.equations.candidates) if c.effect is kind and c.places == one.places)


def _recordings(stepper: Stepper, fits: Fits, rows: Sequence[int], priors: Priors) -> list[_Recording] | None:
    """Every recording's part of a fit of one lane; None where it cannot be drawn back to the start."""
    problem = stepper.problem
    left = _left(problem, fits, rows, priors)
    if left is None:
        return None
    ones = {c: problem.candidate(c).effect for c in problem.searched}
    steady = {_steady(problem, c) for c, kind in ones.items() if kind.swings or kind is effects.REGIME}
    lanes = list(packed(problem, [Unit(c, None) for c in sorted(steady)]))
    laid = [layout(problem, units) for units in ([], *lanes)]
    paths, out = trajectories(stepper, fits.z[0], fits.combinations[0], rows), list[_Recording]()
    if not all(np.isfinite(path).all() for path in paths):
        return None
    for r, (error, others) in enumerate(left):
        start, *further = stepper.carried(fits.z[0], fits.combinations[0], laid, rows[r], r)
        back = _inverses(start[:, :, problem.channels :].transpose(1, 2, 0))
        if back is None:
            return None
        pairs = [pair for units, lane in zip(lanes, further, strict=True) for pair in zip(units, lane, strict=True)]
        done = {unit.candidate: np.einsum("tds,ts->td", back, x[:, problem.channels :]) for unit, x in pairs}
        root = noise_roots(weights(problem, rows), fits)[r]
        slopes = start[:, :, : problem.channels].transpose(1, 2, 0) * root[..., None]
        out.append(_Recording(problem.rows[r].times[: rows[r]], slopes, back, done, error, others, paths[r]))
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
