"""A remainder in the sensor that goes with what it reads: a scale that is not straight, an axis off its centre.

Such an error repeats with the motion, and its harmonics look like forces at twice and four times the frequency. It is a
random function of the reading: Legendre polynomials with independent coefficients of one variance, which enter in
proportion and are integrated out. A bias or a gain alone has a name of its own, and fewer unknowns to pay for.

What a camera sees or a gear with play turns is off by another amount on the way back: such an error goes with the
reading's rate of change as well (the kind `kinematic`), by polynomials of that, or as play.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float

from ._bearers import Left, Sizes, borne, log_likelihood, sizes
from ._bend import Bend, Form, Shapes
from ._calibrate import Fits, Priors, residuals, weights
from ._evidence import variance_inflation
from ._problem import Problem
from ._scatter import factor_evidence, law_gain
from ._weighed import Estimate, amplitudes_out, correlated, largest, of_any_strength

# Forms of an error that goes with what is read alone, and of one that goes with how that changes.
_FORMS = ((Form.CURVE, Form.BENDS), (Form.CURVE, Form.BENDS, Form.PLAY))
# Variances of the error against the noise's that are tried.
_RATIOS = np.geomspace(0.03, 1e4, 12)


@dataclass(frozen=True, eq=False)
class _Channel:
    """Columns [error, slopes, shapes] of one channel, all recordings end to end, in units of one reading."""

    columns: Float[np.ndarray, "column row"]
    plain: int  # columns that are no shapes
    seen: Bool[np.ndarray, " row"]
    log_weights: float
    total: float  # of all weights
    shapes: Shapes = Shapes((0.0, 1.0))

    @property
    def number(self) -> int:
        """How many readings."""
        return int(self.seen.sum())

    @cached_property
    def gram(self) -> Float[np.ndarray, "column column"]:
        """Of all columns."""
        return self.columns @ self.columns.T

    def marginal(self, ratio: float) -> tuple[np.ndarray, float]:
        """Gram matrix of the plain columns with the shapes integrated out, and the log determinant they leave."""
        unit = np.where(np.arange(len(self.gram)) < self.plain, 1.0, np.sqrt(ratio / (len(self.gram) - self.plain)))
        gram, _, log = amplitudes_out(self.gram * np.outer(unit, unit), self.plain)
        return gram, log - self.log_weights

    def left(self, precision: Float[np.ndarray, " plain"]) -> Callable[[float], tuple[float, float]]:
        """By ratio, the squared error that unknowns of some precisions cannot make up for, by one reading's noise, and
        that log determinant; those of infinite precision are known."""
        free = 1 + np.flatnonzero(np.isfinite(precision))
        rest = np.concatenate([[0], np.arange(self.plain, len(self.columns))])
        held = self.gram[np.ix_(free, free)] + np.diag(precision[free - 1])
        # In the unknowns' own units; one that does nothing, of no precision, makes up for nothing.
        size = np.sqrt(np.where(np.diagonal(held) > 0, np.diagonal(held), 1.0))
        gram, cross = self.gram[np.ix_(rest, rest)], self.gram[np.ix_(free, rest)] / size[:, None]
        if not np.isfinite(self.gram).all():  # a trajectory that ran away
            return lambda ratio: (np.nan, 0.0)
        gram = gram - cross.T @ np.linalg.lstsq(held / np.outer(size, size), cross)[0]
        rates, ways = np.linalg.eigh(gram[1:, 1:])  # once for every ratio
        rates, along = np.maximum(rates, 0.0) / len(rates), (ways.T @ gram[1:, 0]) ** 2 / len(rates)

        def value(ratio: float) -> tuple[float, float]:
            square = gram[0, 0] - (ratio * along / (1.0 + ratio * rates)).sum()
            return float(square), float(np.log1p(ratio * rates).sum()) - self.log_weights

        return value

    def cleared(self, ratio: float) -> Float[np.ndarray, "column row"]:
        """The plain columns without what the shapes take of them."""
        cross, held = self.gram[: self.plain, self.plain :], self._held(ratio)
        return self.columns[: self.plain] - np.linalg.solve(held, cross.T).T @ self.columns[self.plain :]

    def _held(self, ratio: float) -> Float[np.ndarray, "shape shape"]:
        """What is known of the shapes' coefficients, in units of one reading."""
        shapes = self.gram[self.plain :, self.plain :]
        return shapes + np.eye(len(shapes)) * len(shapes) / ratio

    def bend(self, column: Float[np.ndarray, " column"], ratio: float, noise: float) -> Bend:
        """What is known of the error, given the plain columns' errors as a sum of them."""
        spread = np.linalg.inv(self._held(ratio))
        mean = spread @ (self.gram[self.plain :, : self.plain] @ column)
        square = float((spread * self.gram[self.plain :, self.plain :]).sum()) / max(self.total, 1e-300)
        return Bend(self.shapes, mean, noise * float(np.sqrt(max(square, 0.0))))


@np.errstate(all="ignore")  # a lane that diverged is told by its evidence
def weigh_positional(
    problem: Problem, fits: Fits, priors: Priors, rows: Sequence[int], moving: bool = False, form: Form | None = None
) -> list[Estimate]:
    """Estimates where each channel's error goes with what it reads, about the trajectory fit: by a plain curve or by
    one of many bends, each as likely as the other; with `moving` with how fast that changes, too, or as play. What is
    told is the likeliest form, or `form`; the evidence is that of all.

    Of a combination with a wrongly given noise, too: no such error is as rough as noise.
    """
    forms, lanes, out = _FORMS[moving], range(len(fits.combinations)), []
    every = [_weighed(problem, fits, b, priors, rows, moving, each) for b in lanes for each in forms]
    every = of_any_strength(problem, priors, every)
    for b in lanes:
        ways = every[b * len(forms) : (b + 1) * len(forms)]
        values = np.nan_to_num([one.log_evidence for one in ways], nan=-np.inf, neginf=-np.inf)
        value = float(np.logaddexp.reduce(values)) - float(np.log(len(ways)))
        told = int(values.argmax()) if form is None else forms.index(form)
        out.append(replace(ways[told], log_evidence=value))
    return out


def _weighed(
    problem: Problem, fits: Fits, b: int, priors: Priors, rows: Sequence[int], moving: bool, form: Form
) -> Estimate:
    """The same by an error of one form, all effects under their widest priors."""
    combination, active = fits.combinations[b], problem.active(fits.combinations[b])
    known, precision = problem.noise_of(combination), priors.precision_of(problem, combination)
    channels = [_channel(problem, fits, b, rows, j, moving, form) for j in range(problem.channels)]
    held = [np.where(active, precision * noise**2, np.inf) for noise in fits.noise[b]]
    each = zip(channels, known, held, strict=True)
    ratios, occam = borne([_sizes(problem, one, j, sd, free) for j, (one, sd, free) in enumerate(each)])
    both = [one.marginal(ratio) for one, ratio in zip(channels, ratios, strict=True)]
    grams, logs = np.stack([gram for gram, _ in both]), np.array([log for _, log in both])
    number = np.array([one.number for one in channels])
    one = correlated(problem, fits, b, grams, logs, number, occam, priors)
    told = _told(problem, one, fits.z[b], channels, ratios, grams)
    return replace(told, kind="kinematic" if moving else "positional")


def _channel(problem: Problem, fits: Fits, b: int, rows: Sequence[int], j: int, moving: bool, form: Form) -> _Channel:
    weight = weights(problem, rows)
    expected, times = [p.readings[b, :, j] for p in fits.predictions], _times(problem, weight)
    seen, parts = np.concatenate([w[:, j] > 0 for w in weight]), []
    shapes = Shapes.over(expected, times, seen, moving, form)
    for r, (x, w) in enumerate(zip(residuals(problem, fits.predictions, weight), weight, strict=True)):
        slopes = np.zeros((problem.size, len(w)))
        slopes[problem.local(r)] = fits.predictions[r].slopes[b, :, :, j]
        parts.append(np.concatenate([x[b, None, :, j], slopes, shapes(expected[r], times[r]).T]))
    root = np.sqrt(np.concatenate([w[:, j] for w in weight]))
    columns = np.where(seen, np.concatenate(parts, axis=1), 0.0) * root
    return _Channel(
        columns, 1 + problem.size, seen, float(2 * np.log(root[seen]).sum()), float((root[seen] ** 2).sum()), shapes
    )


def _times(problem: Problem, weight: Sequence[np.ndarray]) -> list[Float[np.ndarray, " _"]]:
    return [r.times[: len(w)] for r, w in zip(problem.rows, weight, strict=True)]


def whitened_along(
    columns: Sequence[Float[np.ndarray, "column _"]], shown: Sequence[Float[np.ndarray, " _"]],
    times: Sequence[Float[np.ndarray, " _"]], weight: Sequence[Float[np.ndarray, " _"]], ratio: float, moving: bool,
    form: Form,
) -> list[Float[np.ndarray, "column _"]]:  # fmt: skip
    """One channel's columns, by recording, whitened beside an error that goes with what is read: the noise's variance
    and that of `ratio` times its size together. `shown` are the expected readings."""
    w = np.concatenate(weight)
    shapes = Shapes.over(shown, times, w > 0, moving, form)
    roots = [np.sqrt(one) for one in weight]
    whole = [shapes(x, t).T * root for x, t, root in zip(shown, times, roots, strict=True)]
    return cleared_of([x * root for x, root in zip(columns, roots, strict=True)], whole, ratio)


def cleared_of(
    columns: Sequence[Float[np.ndarray, "column _"]], shapes: Sequence[Float[np.ndarray, "shape _"]], ratio: float
) -> list[Float[np.ndarray, "column _"]]:
    """Columns of white noise, by recording, whitened beside shapes that share a variance of `ratio` times its own."""
    every, rest = np.concatenate(columns, axis=1), np.concatenate(shapes, axis=1)
    _, sizes, ways = np.linalg.svd(rest, full_matrices=False)
    less = 1.0 - 1.0 / np.sqrt(1.0 + ratio / len(rest) * sizes**2)
    done = every - (every @ ways.T * less) @ ways
    return np.split(done, np.cumsum([one.shape[1] for one in columns])[:-1], axis=1)


def _sizes(problem: Problem, one: _Channel, j: int, known: float, precision: Float[np.ndarray, " plain"]) -> Sizes:
    """Variances of the error against the noise's, which may be known, beside unknowns of some precisions."""
    left, most = one.left(precision), largest(problem, j)

    def value(ratio: float) -> float:
        return log_likelihood(Left(*left(ratio)), one.number, known, ratio, most)

    return sizes(value, _RATIOS)


def _told(
    problem: Problem, one: Estimate, begin: np.ndarray, channels: Sequence[_Channel], ratios: Sequence[float],
    grams: Float[np.ndarray, "channel column column"],
) -> Estimate:  # fmt: skip
    """With what heavier tails gain and a wrongly given noise owes, the error's size unless the noise is what is told,
    and how far from white the scores are that it leaves."""
    column = np.concatenate([[1.0], begin - one.z])
    errors = np.array([((column @ c.columns[: c.plain]) ** 2).sum() for c in channels])
    number = np.array([max(c.number, 1) for c in channels])
    total = np.maximum(errors / number, one.noise**2)
    cleared = [c.cleared(ratio) for c, ratio in zip(channels, ratios, strict=True)]
    scores = sum(x[1:] * (column @ x) / noise**2 for x, noise in zip(cleared, one.noise, strict=True))
    squares = np.einsum("i,jik,k->j", column, grams, column)
    left = [_left(c.seen, column @ x, square) for c, x, square in zip(channels, cleared, squares, strict=True)]
    value = one.log_evidence + law_gain(problem, one.combination, np.stack(left, axis=1) / one.noise)
    value += factor_evidence(problem, one.combination, one.noise, number)
    told = np.isnan(problem.noise_of(one.combination)) & ~np.isnan(problem.noise)
    # Averaging readings does not make the error smaller that they share.
    averaged = np.exp([c.log_weights / max(c.number, 1) for c in channels])
    bent = np.where(told, 0.0, (total / one.noise**2 - 1.0) / averaged)
    inflation = variance_inflation(scores.T)
    bends = tuple(c.bend(column, *both) for c, *both in zip(channels, ratios, one.noise, strict=True))
    return replace(one, bent=tuple(bent.tolist()), bends=() if told.any() else bends,
                   log_evidence=value, inflation=inflation)  # fmt: skip


def _left(seen: Bool[np.ndarray, " row"], errors: np.ndarray, square: float) -> Float[np.ndarray, " row"]:
    """Errors that the polynomials leave, NaN where nothing was read; of the size that the evidence takes them for."""
    return np.where(seen, errors * np.sqrt(max(square, 0.0) / max(float((errors**2).sum()), 1e-300)), np.nan)
