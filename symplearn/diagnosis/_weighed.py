"""One combination of effects with its evidence under each kind of remainder."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float

from ._before import Before
from ._bend import Bend
from ._calibrate import Fits, Priors, normal_equations, residuals, weights
from ._coloured import Colour, fit_colour, whitened_gram, whitened_residuals, whitened_series
from ._evidence import Laplace, variance_inflation
from ._magnitude import strength_gains
from ._problem import Combination, Problem
from ._scatter import factor_evidence, law_gain
from ._trajectory import Stepper

# A remainder of the sensor is smaller than this share of what it reads; else it is the signal.
REMAINDER = 0.3
# How often white noise and the unknowns are found in turn at most, and the share of the former by which it still moves:
# the likelihood is stationary in it, so that it is off by the square of that.
_TURNS, _SETTLED = 6, 1e-5
# The least share of the white noise that a remainder leaves of it in a channel that has no more readings than there are
# numbers to fit: these may explain every one of them, and then no noise would be left.
_LEAST = 1e-3


@dataclass(frozen=True)
class Mode:
    """One optimum of several."""

    log_evidence: float
    z: Float[np.ndarray, " z"]
    covariance: Float[np.ndarray, "z z"]


@dataclass(frozen=True, eq=False)
class Estimate:
    """A combination fitted under one kind of remainder.

    `kind` is `white` (no remainder), `coloured` (an error of the sensor with a memory), `clock` (one of its clock
    beside that), `positional` (one that goes with what is read), `kinematic` (with how fast that changes, too),
    `jitter` (one of each row's time), `static` (a small force that goes with a coordinate), `force` (a white missing
    force of `intensity`) or `spell` (one that acts for a while: in the share `exposures` of each span, by recording).
    `noise` is the white sd of one original reading, `bent` the variance of a positional or kinematic error against its
    square, `bends` that error itself.
    """

    combination: Combination
    kind: str
    z: Float[np.ndarray, " z"]
    covariance: Float[np.ndarray, "z z"]
    noise: Float[np.ndarray, " channel"]
    log_evidence: float
    converged: bool
    inflation: float = 1.0
    intensity: Float[np.ndarray, " d"] | None = None
    exposures: tuple[np.ndarray, ...] | None = field(default=None, repr=False)
    paths: list[np.ndarray] | None = field(default=None, repr=False)
    colours: tuple[Colour, ...] = ()
    bent: tuple[float, ...] = ()
    bends: tuple[Bend, ...] = ()
    clocks: tuple[Colour, ...] = ()  # errors of the times, as the rms error of the reading that they make
    jitters: tuple[float, ...] = ()  # variance of the error that single times make against the noise's
    modes: tuple[Mode, ...] = ()  # all optima that were found, this one among them
    outliers: tuple[tuple[float, float], ...] = ()  # share and size by channel, where they were left out
    promised: float = 0.0  # nats that the step to it is to bring, beside a remainder
    unearned: float = 0.0  # nats that one more step promises though the fit has ended, under white noise
    owed: float | None = None  # nats added for what its errors of a clock were weighed with, once it is settled
    log_likelihood: float = np.nan  # of the readings at `z`, of a trajectory fit

    @property
    def reading_noise(self) -> Float[np.ndarray, " channel"]:
        """Sd of one original reading, with the rms of a positional error and of one that jitter makes."""
        return self.scatter * np.sqrt(1.0 + np.array(self.bent or 0.0))

    @property
    def scatter(self) -> Float[np.ndarray, " channel"]:
        """Sd of what is new in every reading: noise, and jitter."""
        return self.noise * np.sqrt(1.0 + np.array(self.jitters or 0.0))


def weigh_white(problem: Problem, fits: Fits, priors: Priors, rows: list[int]) -> list[Estimate]:
    """Estimates under white reading noise alone."""
    weight = weights(problem, rows)
    matrix, vector = normal_equations(problem, fits, weight)
    r = residuals(problem, fits.predictions, weight)
    square = sum((w * (x / fits.noise[:, None]) ** 2).sum((1, 2)) for w, x in zip(weight, r, strict=True))
    offset = _constant(weight, fits.noise)
    out, led_to = [], []
    number = sum((w > 0).sum(0) for w in weight)
    for b, combination in enumerate(fits.combinations):
        gram = np.block([[np.full((1, 1), square[b]), vector[b][None]], [vector[b][:, None], matrix[b]]])
        one = Before.of(problem, combination, priors).integrate(gram, offset[b], fits.z[b])
        scores = _scores(problem, fits, b, r, weight)
        # Errors as they are where the evidence is taken: after the step that a fit which is done is granted.
        taken = one.step if fits.converged[b] and not unearned(fits, b) else np.zeros(problem.size)
        left = [x[b] - np.einsum("i,itj->tj", taken[problem.local(k)], p.slopes[b])
                for k, (x, p) in enumerate(zip(r, fits.predictions, strict=True))]  # fmt: skip
        errors = standardised(left, weight, fits.noise[b])
        value = _earned(one, fits, b) + law_gain(problem, combination, errors)
        value += factor_evidence(problem, combination, fits.noise[b], number)
        led_to.append(fits.z[b] + one.step)
        out.append(
            Estimate(
                combination,
                "white",
                fits.z[b],
                one.covariance,
                fits.noise[b],
                value,
                bool(fits.converged[b]),
                variance_inflation(scores),
                log_likelihood=float(offset[b] - 0.5 * square[b]),
                unearned=unearned(fits, b),
            )  # fmt: skip
        )
    return of_any_strength(problem, priors, out, led_to)


def of_any_strength(
    problem: Problem, priors: Priors, estimates: Sequence[Estimate], z: Sequence[np.ndarray] | None = None
) -> list[Estimate]:
    """Estimates with what they gain where effects may be of any order of magnitude, about their own `z` or others."""
    about = [one.z for one in estimates] if z is None else z
    combinations, spreads = [one.combination for one in estimates], [one.covariance for one in estimates]
    return _gained(estimates, strength_gains(problem, combinations, priors, about, spreads))


def _gained(estimates: Sequence[Estimate], gains: Iterable[float]) -> list[Estimate]:
    pairs = zip(estimates, gains, strict=True)
    return [replace(one, log_evidence=one.log_evidence + float(gain)) for one, gain in pairs]


def largest(problem: Problem, channel: int) -> float:
    """The largest error of a sensor that is not the signal, as far as it is fitted."""
    return REMAINDER * float(np.nanstd(np.concatenate([r.readings[: r.fitted, channel] for r in problem.rows])))


def weigh_coloured(problem: Problem, fits: Fits, priors: Priors, rows: list[int]) -> list[Estimate]:
    """Estimates where each channel's error has a memory: generalised least squares about the trajectory fit.

    None for a combination with a wrongly given noise, which a colour would only blur.
    """
    if not trusting(problem, fits):
        return []
    weight, lanes = weights(problem, rows), len(fits.z)
    r = residuals(problem, fits.predictions, weight)
    times = [rows_.times[:n] for rows_, n in zip(problem.rows, rows, strict=True)]
    size = 1 + problem.size
    grams, logs = np.zeros((lanes, problem.channels, size, size)), np.zeros((lanes, problem.channels))
    chosen: list[list[Colour]] = []
    for j in range(problem.channels):
        known = None if np.isnan(problem.noise[j]) else float(problem.noise[j])
        seen, most = [w[:, j] for w in weight], largest(problem, j)
        colours = fit_colour([x[..., j] for x in r], seen, times, known, most)
        chosen.append(colours)
        for k in range(len(times)):
            gram, log = _channel_gram(problem, fits, r[k][..., j], weight[k][:, j], times[k], colours, k, j)
            grams[:, j] += gram
            logs[:, j] += log
    number = sum((w > 0).sum(0) for w in weight)
    out = []
    for b in trusting(problem, fits):
        mine = tuple(c[b] for c in chosen)
        one = correlated(problem, fits, b, grams[b], logs[b], number, sum(c.occam for c in mine), priors)
        out.append(replace(one, kind="coloured", colours=mine))
    return of_any_strength(problem, priors, _with_laws(problem, fits, out, r, weight))


def _with_laws(problem: Problem, fits: Fits, estimates: list[Estimate], r, weight) -> list[Estimate]:
    """With what the innovations of coloured errors gain where noise may have heavier tails."""
    lanes = trusting(problem, fits)
    parts = []
    for k, (x, w) in enumerate(zip(r, weight, strict=True)):
        moved = np.stack([one.z - fits.z[b] for one, b in zip(estimates, lanes, strict=True)])[:, problem.local(k)]
        left = x[lanes] - np.where(w > 0, np.einsum("bi,bitj->btj", moved, fits.predictions[k].slopes[lanes]), 0.0)
        times = problem.rows[k].times[: len(w)]
        series = [whitened_residuals(left[..., j], w[:, j], times, [one.colours[j] for one in estimates])
                  for j in range(problem.channels)]  # fmt: skip
        parts.append(np.where(w > 0, np.stack(series, axis=-1), np.nan))
    errors = np.concatenate(parts, axis=1)
    each = zip(estimates, errors, strict=True)
    return _gained(estimates, [law_gain(problem, one.combination, e / one.noise) for one, e in each])


def trusting(problem: Problem, fits: Fits) -> list[int]:
    """Lanes that take a given noise as it is given."""
    return [b for b, c in enumerate(fits.combinations)
            if np.array_equal(problem.noise_of(c), problem.noise, equal_nan=True)]  # fmt: skip


def _channel_gram(problem, fits: Fits, residual, weight, times, colours: list[Colour], recording: int, channel: int):
    place = np.concatenate([[0], 1 + problem.local(recording)])
    slopes = np.where(weight > 0, fits.predictions[recording].slopes[..., channel], 0.0)
    columns = np.concatenate([residual[:, None], slopes], axis=1)
    gram, log = whitened_gram(columns, weight, times, colours)
    full = np.zeros((len(columns), 1 + problem.size, 1 + problem.size))
    full[:, place[:, None], place[None, :]] = gram
    return full, log


def correlated(
    problem: Problem, fits: Fits, b: int, grams, logs, number: np.ndarray, occam: float, priors: Priors
) -> Estimate:  # fmt: skip
    """Integrate the unknowns with each channel's white noise at its best value, found by alternation; all effects under
    their widest priors.

    **Arguments:** - `grams`, `logs`: of each channel's whitened columns, in units of its white noise; those after the
    unknowns enter with amplitudes of unit variance. - `occam`: what the choice of the correlations owes.
    """
    combination, noise = fits.combinations[b], fits.noise[b].copy()
    free = np.isnan(problem.noise_of(combination))
    fitted = int(problem.active(combination).sum()) + grams.shape[1] - 1 - problem.size
    least = np.where(number > fitted, 0.0, _LEAST) * noise
    before = Before.of(problem, combination, priors)
    for _ in range(_TURNS):
        gram, follow, log = amplitudes_out((grams / (noise**2)[:, None, None]).sum(0), 1 + problem.size)
        offset = -0.5 * float((number * np.log(2 * np.pi * noise**2) + logs).sum() + log)
        one = before.integrate(gram, offset, fits.z[b])
        z = fits.z[b] + one.step
        column = np.concatenate([[1.0], fits.z[b] - z])
        column = np.concatenate([column, -follow @ column])
        square = np.einsum("i,jik,k->j", column, grams, column)
        last = noise
        found = np.sqrt(np.maximum(square, 1e-300) / np.maximum(number, 1))
        noise = np.where(free, np.maximum(found, least), noise)
        if (np.abs(noise - last) <= _SETTLED * last).all():
            break
    # A step may be too small for the numbers it is added to: where a trajectory is that sensitive it ran away, and what
    # the step would have gained is not there.
    lost = _misfit(gram, fits.z[b] - z) - _misfit(gram, -one.step)
    value = _earned(one, fits, b) - 0.5 * max(0.0, lost)
    value += occam
    if (square < 0).any():  # round-off of a trajectory that ran away
        value = -np.inf
    converged, promised = bool(fits.converged[b]), one.promised
    return Estimate(combination, "", z, one.covariance, noise, value, converged, promised=promised)


def _misfit(gram: Float[np.ndarray, "column column"], change: Float[np.ndarray, " z"]) -> float:
    """Sum of the squares of the errors [e0, E] (1, change)."""
    column = np.concatenate([[1.0], change])
    return float(column @ gram @ column)


def amplitudes_out(
    gram: Float[np.ndarray, "column column"], kept: int
) -> tuple[Float[np.ndarray, "kept kept"], Float[np.ndarray, "rest kept"], float]:
    """A Gram matrix with the columns after the first `kept`, which enter with amplitudes of unit variance, integrated
    out; how those amplitudes follow the others, and the log determinant that they leave. NaN where no number tells."""
    nothing = np.full((kept, kept), np.nan), np.zeros((len(gram) - kept, kept)), 0.0
    if not np.isfinite(gram).all():  # a trajectory that ran away
        return nothing
    rest = gram[kept:, kept:] + np.eye(len(gram) - kept)
    try:
        follow = np.linalg.solve(rest, gram[kept:, :kept])
    except np.linalg.LinAlgError:  # a trajectory through every reading, beside which any amplitude is certain
        return nothing
    return gram[:kept, :kept] - gram[:kept, kept:] @ follow, follow, float(np.linalg.slogdet(rest)[1])


def _earned(one: Laplace, fits: Fits, lane: int) -> float:
    """The log evidence, without what a step promises that no fit could take."""
    return one.log_evidence - min(one.promised, unearned(fits, lane) if fits.converged[lane] else np.inf)


def unearned(fits: Fits, lane: int) -> float:
    """Nats that one more step promises of a fit that has ended."""
    return 0.0 if fits.unearned is None else float(fits.unearned[lane])


def standardised(r: list[np.ndarray], weight: list[np.ndarray], noise: np.ndarray) -> Float[np.ndarray, "row channel"]:
    """Errors of the readings by their own noise, recordings end to end; NaN where nothing was read."""
    parts = [np.where(w > 0, np.sqrt(w) * x / noise, np.nan) for x, w in zip(r, weight, strict=True)]
    return np.concatenate(parts)


def _constant(weight: list[np.ndarray], noise: np.ndarray) -> np.ndarray:
    """Log normalisation of the readings by lane."""
    number = sum((w > 0).sum(0) for w in weight)
    return -0.5 * (number * np.log(2 * np.pi * noise**2)).sum(1) + 0.5 * information(weight)


def information(weight: list[np.ndarray]) -> float:
    """Sum of the log weights of the rows, which every kind of remainder owes for readings that are averages."""
    return float(sum(np.log(w[w > 0]).sum() for w in weight))


def coloured_inflation(stepper: Stepper, estimate: Estimate, rows: list[int]) -> float:
    """Variance inflation that is left after a coloured error was whitened."""
    problem, weight = stepper.problem, weights(stepper.problem, rows)
    predictions = stepper.predict(estimate.z[None], [estimate.combination], rows)
    parts = []
    for k, (x, w) in enumerate(zip(residuals(problem, predictions, weight), weight, strict=True)):
        total = 0.0
        for j, colour in enumerate(estimate.colours):
            slopes = np.where(w[:, j] > 0, predictions[k].slopes[0, problem.state :, :, j], 0.0)
            columns = np.concatenate([x[0, None, :, j], slopes]) / estimate.noise[j]
            series = whitened_series(columns, w[:, j], problem.rows[k].times[: len(w)], colour)
            total = total + series[:, :1] * series[:, 1:]
        parts.append(total)
    return variance_inflation(np.concatenate(parts))


def _scores(problem: Problem, fits: Fits, b: int, r, weight) -> np.ndarray:
    """Score of every row and every shared unknown; recordings end to end."""
    parts = []
    shared = slice(problem.state, None)
    for p, x, w in zip(fits.predictions, r, weight, strict=True):
        scaled = np.where(w > 0, p.slopes[b, shared], 0.0) * (w * x[b] / fits.noise[b] ** 2)
        parts.append(scaled.sum(-1).T)
    return np.concatenate(parts)
