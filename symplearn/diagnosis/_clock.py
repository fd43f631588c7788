"""A remainder in the times: a clock that runs ahead and behind, beside an error of the sensor with a memory.

Such an error goes with the rate of change of what is read, and vanishes where that turns. There the amplitudes stand as
they are, so that laws which differ in how a motion decays are told apart however far its phase wanders.

What a camera sees has other errors at the same time: its view is askew, and its rows are read one after the other. So a
plain curve of place and speed may stand beside both.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from scipy.special import logsumexp

from ._bend import Bend, Form, Shapes
from ._calibrate import Fits, Priors, residuals, weights
from ._clock_errors import Piece, cleared, fitted, pieces_of
from ._coloured import Colour
from ._evidence import variance_inflation
from ._problem import Problem
from ._scatter import law_gain
from ._weighed import Estimate, amplitudes_out, correlated, largest, of_any_strength, trusting

# How often errors of sensor and clock are fitted, about the path that follows.
_PASSES = 2
# Sizes of a curve that are tried, against the white noise.
_CURVES = (1.0, 4.0, 16.0)

Both = list[tuple[Colour, Colour]]


@dataclass(frozen=True, eq=False)
class _Lane:
    """One combination's fit: its pieces by channel and recording, whose last columns are a curve's shapes, if any."""

    problem: Problem
    fits: Fits
    priors: Priors
    b: int
    pieces: list[list[Piece]]
    number: np.ndarray  # readings by channel
    shapes: tuple[Shapes, ...] = ()  # by channel

    @classmethod
    def every(cls, problem: Problem, fits: Fits, priors: Priors, rows: Sequence[int]) -> "list[_Lane]":
        """All that take a given noise as it is given, without a curve."""
        weight = weights(problem, rows)
        errors, number = residuals(problem, fits.predictions, weight), sum((w > 0).sum(0) for w in weight)
        return [
            cls(problem, fits, priors, b,
                [pieces_of(problem, fits, [x[b, :, j] for x in errors], weight, b, j) for j in range(problem.channels)],
                number)
            for b in trusting(problem, fits)
        ]  # fmt: skip

    @property
    def curves(self) -> int:
        """How many shapes a channel's curve has."""
        return self.pieces[0][0].columns.shape[0] - 1 - self.problem.local(0).size

    def left(
        self, z: Float[np.ndarray, " z"], amplitudes: Float[np.ndarray, "channel curve"], j: int
    ) -> list[Float[np.ndarray, " column"]]:
        """What unknowns and curves leave of one channel's errors, as sums of its columns, by recording."""
        off = self.fits.z[self.b] - z
        return [np.concatenate([[1.0], off[self.problem.local(k)], -amplitudes[j]])
                for k in range(len(self.pieces[j]))]  # fmt: skip

    def bent(self) -> "_Lane":
        """The same with a plain curve of place and speed among the columns of every channel."""
        expected, shapes, pieces = self.fits.predictions, [], []
        for j, own in enumerate(self.pieces):
            shown, times = [p.readings[self.b, :, j] for p in expected], [one.times for one in own]
            seen = np.concatenate([one.weight > 0 for one in own])
            shape = Shapes.over(shown, times, seen, moving=True, form=Form.CURVE)
            curves = [np.where(one.weight > 0, shape(x, one.times).T, 0.0) for one, x in zip(own, shown, strict=True)]
            pieces.append([replace(one, columns=np.concatenate([one.columns, curve]))
                           for one, curve in zip(own, curves, strict=True)])  # fmt: skip
            shapes.append(shape)
        return replace(self, pieces=pieces, shapes=tuple(shapes))


@dataclass(frozen=True, eq=False)
class _White:
    """A lane's columns whitened beside errors of sensors and clocks: by channel and recording, with the log
    determinants that the whitening leaves."""

    both: Both
    series: list[list[tuple[Float[np.ndarray, "_ column"], float]]]

    @classmethod
    def beside(cls, lane: _Lane, both: Both) -> "_White":
        return cls(both, [[cleared(one, own) for one in pieces] for pieces, own in zip(lane.pieces, both, strict=True)])


@dataclass(frozen=True, eq=False)
class _Known:
    """What is known of a lane beside errors of sensors and clocks: the estimate, and its curves' amplitudes with what
    is not known of them."""

    estimate: Estimate
    white: _White
    amplitudes: Float[np.ndarray, "channel curve"]
    spread: Float[np.ndarray, "channel curve curve"]


@np.errstate(all="ignore")  # a lane that diverged is told by its evidence
def weigh_clock(
    problem: Problem, fits: Fits, priors: Priors, rows: Sequence[int], colours: Sequence[Sequence[Colour]],
    like: Estimate | None = None,
) -> list[Estimate]:  # fmt: skip
    """Estimates where every channel's error has a memory and its clock runs ahead and behind, about the trajectory fit;
    alone, and beside a plain curve of place and speed, each as likely as the other.

    `colours` are those of the sensors alone, by lane and channel; `like` is an estimate of this kind whose errors the
    search may begin at, too. None for a combination with a wrongly given noise.
    """
    out: list[Estimate] = []
    for lane in _Lane.every(problem, fits, priors, rows):
        begins: list[Both] = [[(colour, replace(colour, ratio=0.0)) for colour in colours[lane.b]]]
        if out or like is not None:  # each search may be caught in an optimum of its own
            best = max([*out, *([] if like is None else [like])], key=lambda one: one.log_evidence)
            begins.append(_both(best))
        straight = _straight(lane, begins)
        out.append(_mixed([_told(lane, straight)], _curved(lane.bent(), straight)))
    return out


@np.errstate(all="ignore")  # a lane that diverged is told by its evidence
def weigh_known_clock(problem: Problem, fits: Fits, priors: Priors, rows: Sequence[int], like: Estimate) -> Estimate:
    """The only lane beside the errors of sensor and clock that another estimate has, and beside a curve where that has
    one: of its sizes the likeliest, which is granted all of their weight."""
    (lane,) = _Lane.every(problem, fits, priors, rows)
    lane = lane.bent() if like.bends else lane
    tried = _of_each_size(lane, _both(like), like.noise) if like.bends else [_alone(lane, _both(like))]
    return _told(lane, max(tried, key=_evidence))


@np.errstate(all="ignore")
def weigh_shared_clock(
    problem: Problem, fits: Fits, priors: Priors, rows: Sequence[int], like: Estimate
) -> list[Estimate]:
    """All lanes as `weigh_clock` weighs them, but beside the errors of sensor and clock that another estimate has."""
    out = []
    for lane in _Lane.every(problem, fits, priors, rows):
        straight, bent = _alone(lane, _both(like)), lane.bent()
        curved = _of_each_size(bent, _both(like), straight.estimate.noise)
        out.append(_mixed([_told(lane, straight)], [_told(bent, one) for one in curved]))
    return out


def _both(one: Estimate) -> Both:
    return list(zip(one.colours, one.clocks, strict=True))


def _evidence(one: _Known) -> float:
    return float(np.nan_to_num(one.estimate.log_evidence, nan=-np.inf))


def _alone(lane: _Lane, both: Both) -> _Known:
    """Beside given errors of sensor and clock, and no curve."""
    (one,) = _integrated(lane, _White.beside(lane, both), [np.ones(lane.problem.channels)])
    return one


def _of_each_size(lane: _Lane, both: Both, noise: Float[np.ndarray, " channel"]) -> list[_Known]:
    """Beside the same and a curve of each size."""
    return _integrated(lane, _White.beside(lane, both), _sizes(lane, noise))


def _straight(lane: _Lane, begins: list[Both]) -> _Known:
    """Beside errors of sensor and clock alone."""
    z, nothing = lane.fits.z[lane.b], np.zeros((lane.problem.channels, 0))
    for _ in range(_PASSES):  # what is off the path changes what the path is
        known = _alone(lane, _refitted(lane, z, nothing, begins))
        z, begins = known.estimate.z, [known.white.both]
    return known


def _curved(lane: _Lane, straight: _Known) -> list[Estimate]:
    """Beside a curve of each size, too, none larger than a remainder may be; of the likeliest size the errors of sensor
    and clock are fitted again."""
    tried = _of_each_size(lane, straight.white.both, straight.estimate.noise)
    best = int(np.argmax(list(map(_evidence, tried))))
    one = tried[best]
    both = _refitted(lane, one.estimate.z, one.amplitudes, [straight.white.both])
    (again,) = _integrated(lane, _White.beside(lane, both), [_sizes(lane, straight.estimate.noise)[best]])
    if again.estimate.log_evidence > one.estimate.log_evidence:
        tried[best] = again
    return [_told(lane, one) for one in tried]


def _sizes(lane: _Lane, noise: Float[np.ndarray, " channel"]) -> list[Float[np.ndarray, " channel"]]:
    """Root mean squares of a curve that are tried, by channel."""
    most = np.array([largest(lane.problem, j) for j in range(lane.problem.channels)])
    return [np.minimum(size * noise, most) for size in _CURVES]


def _mixed(*ways: list[Estimate]) -> Estimate:
    """The likeliest of several ways, each of the same weight in all, with the evidence of all of them."""
    listed = [one for way in ways for one in way]
    share = np.concatenate([np.full(len(way), 1.0 / (len(ways) * len(way))) for way in ways])
    values = np.nan_to_num([one.log_evidence for one in listed], nan=-np.inf, neginf=-np.inf)
    best = listed[int((values + np.log(share)).argmax())]
    return replace(best, log_evidence=float(logsumexp(values, b=share)))


def _refitted(
    lane: _Lane, z: Float[np.ndarray, " z"], amplitudes: Float[np.ndarray, "channel curve"], begins: list[Both]
) -> Both:
    """Errors of every channel's sensor and clock, in what these unknowns and curves leave."""
    return [fitted(lane.problem, own, j, [one[j] for one in begins], lane.left(z, amplitudes, j))
            for j, own in enumerate(lane.pieces)]  # fmt: skip


def _integrated(lane: _Lane, white: _White, sizes: Sequence[Float[np.ndarray, " channel"]]) -> list[_Known]:
    """Unknowns and curves, whose shapes have together each of these root mean squares, integrated beside given
    errors."""
    each = [_of_size(lane, white, size) for size in sizes]
    estimates = of_any_strength(lane.problem, lane.priors, [one.estimate for one in each])
    return [replace(one, estimate=estimate) for one, estimate in zip(each, estimates, strict=True)]


def _of_size(lane: _Lane, white: _White, size: Float[np.ndarray, " channel"]) -> _Known:
    """The same of one size, all effects under their widest priors."""
    problem, fits, b = lane.problem, lane.fits, lane.b
    unit = size / np.sqrt(max(lane.curves, 1))
    grams, logs = zip(*(_gram(lane, j, white, unit[j]) for j in range(problem.channels)), strict=True)
    occam = sum(colour.occam + clock.occam for colour, clock in white.both)
    one = correlated(problem, fits, b, np.stack(grams), np.array(logs), lane.number, occam, lane.priors)
    total = (np.stack(grams) / (one.noise**2)[:, None, None]).sum(0)
    follow = amplitudes_out(total, 1 + problem.size)[1]
    column = np.concatenate([[1.0], fits.z[b] - one.z])
    amplitudes = (follow @ column).reshape(problem.channels, -1) * unit[:, None]
    rest = np.nan_to_num(total[1 + problem.size :, 1 + problem.size :])  # a trajectory that ran away
    own = np.arange(len(rest)).reshape(problem.channels, -1)
    spread = np.stack(
        [np.linalg.inv(rest[np.ix_(k, k)] + np.eye(len(k))) * u**2 for k, u in zip(own, unit, strict=True)]
    )
    return _Known(one, white, amplitudes, spread)


def _gram(lane: _Lane, j: int, white: _White, unit: float) -> tuple[np.ndarray, float]:
    """Gram matrix of one channel's whitened columns, all recordings together, those of all channels' curves behind the
    unknowns; and the log determinants."""
    size, curves = 1 + lane.problem.size, lane.curves
    full, total = np.zeros((size + curves * lane.problem.channels,) * 2), 0.0
    for k, (series, log) in enumerate(white.series[j]):
        place = np.concatenate([[0], 1 + lane.problem.local(k), size + j * curves + np.arange(curves)])
        series = series * np.where(place < size, 1.0, unit)
        full[np.ix_(place, place)] += series.T @ series
        total += log
    return full, total


def _told(lane: _Lane, known: _Known) -> Estimate:
    """With what heavier tails gain, how far from white the scores are that are left, and the curves."""
    one, errors, scores = known.estimate, [], []
    left = [lane.left(one.z, known.amplitudes, j) for j in range(lane.problem.channels)]
    for k in range(len(lane.problem.rows)):
        slopes = slice(1 + lane.problem.state, 1 + lane.problem.local(k).size)
        series = [own[k][0] / noise for own, noise in zip(known.white.series, one.noise, strict=True)]
        each = [np.where(piece[k].weight > 0, x @ column[k], np.nan)
                for piece, x, column in zip(lane.pieces, series, left, strict=True)]  # fmt: skip
        errors.append(np.stack(each, axis=1))
        scores.append(sum((x @ column[k])[:, None] * x[:, slopes] for x, column in zip(series, left, strict=True)))
    value = one.log_evidence + law_gain(lane.problem, one.combination, np.concatenate(errors))
    colours, clocks = zip(*known.white.both, strict=True)
    inflation = variance_inflation(np.concatenate(scores))
    one = replace(one, kind="clock", log_evidence=value, colours=colours, clocks=clocks, inflation=inflation)
    return one if not lane.shapes else _with_curves(lane, known, one)


def _with_curves(lane: _Lane, known: _Known, one: Estimate) -> Estimate:
    """With the curve of every channel, and its variance against the noise's."""
    bends, sizes = [], []
    for shapes, own, mean, spread in zip(lane.shapes, lane.pieces, known.amplitudes, known.spread, strict=True):
        every = np.concatenate([piece.columns[-lane.curves :].T[piece.weight > 0] for piece in own])
        unsure = np.einsum("ra,ab,rb->r", every, spread, every).mean()
        bends.append(Bend(shapes, mean, float(np.sqrt(unsure))))
        sizes.append(float(((every @ mean) ** 2).mean()))
    return replace(one, bends=tuple(bends), bent=tuple(np.array(sizes) / one.noise**2))
