"""Fits with a missing force of given intensity: paths and unknowns together, many combinations at once."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from ._before import Before
from ._calibrate import Priors, weights
from ._evidence import Laplace
from ._path import backward_lanes, forward_lanes, linearise
from ._problem import Combination, Problem
from ._stochastic import exposure, padded
from ._trajectory import LANES, Stepper

# Steps towards a smaller or larger reading noise are lengthened this much: plain EM is slow where noise is small.
_HASTE = 1.5
# A fit has converged when its log evidence moves by less than this many nats in a step.
_SETTLED = 0.05


@dataclass(frozen=True)
class PathFit:
    """One combination under one intensity of the missing force: unknowns, noise, path by recording, evidence.

    `exposures` holds the share of each span in which the force acts, by recording, None where it always does; `choices`
    is the log of how many such spells this one was chosen from.
    """

    combination: Combination
    intensity: Float[np.ndarray, " d"]
    z: Float[np.ndarray, " z"]
    noise: Float[np.ndarray, " channel"]
    paths: list[Float[np.ndarray, "_ state"]]
    laplace: Laplace | None = None
    converged: bool = False
    errors: Float[np.ndarray, "row channel"] | None = None  # innovations by their own sd, NaN where nothing was read
    left_out: tuple[Bool[np.ndarray, "_ channel"], ...] | None = None  # readings that this fit does not use
    exposures: tuple[Float[np.ndarray, " _"], ...] | None = None
    choices: float = 0.0

    def used(self, r: int, weight: Float[np.ndarray, "time channel"]) -> Float[np.ndarray, "time channel"]:
        """Weights of the readings that this fit uses."""
        return weight if self.left_out is None else np.where(self.left_out[r][: len(weight)], 0.0, weight)

    @property
    def log_evidence(self) -> float:
        """Log evidence in nats, minus infinity before the first step; steps that did not settle are not relied on."""
        if self.laplace is None:
            return -np.inf
        return self.laplace.log_evidence - (0.0 if self.converged else self.laplace.promised)


def fit_paths(
    stepper: Stepper, starts: Sequence[PathFit], priors: Priors, rows: Sequence[int], iterations: int = 10
) -> list[PathFit]:
    """Gauss-Newton on paths and unknowns from given starts, `LANES` of them at a time."""
    chunks = [list(starts[a : a + LANES]) for a in range(0, len(starts), LANES)]
    done = stepper.ahead(lambda chunk: _fit_chunk(stepper, chunk, priors, rows, iterations), chunks)
    return [fit for chunk in done for fit in chunk]


@np.errstate(all="ignore")  # a lane that diverged is told by its evidence
def _fit_chunk(stepper, fits: list[PathFit], priors: Priors, rows: Sequence[int], iterations: int) -> list[PathFit]:
    wanted = len(fits)
    fits = (fits * LANES)[:LANES] if wanted < LANES else fits
    fits = [_begun(stepper.problem, fit) for fit in fits]
    weight = weights(stepper.problem, rows)
    before = np.full(LANES, -np.inf)
    for count in range(iterations):
        fits = _iterate(stepper, fits, priors, rows, weight, noisy=count < iterations - 2)
        now = np.array([fit.log_evidence for fit in fits])
        with np.errstate(invalid="ignore"):
            settled = np.abs(now - before) < _SETTLED
        if (settled | ~np.isfinite(now)).all():
            break
        before = now
    return [replace(fit, converged=bool(ok)) for fit, ok in zip(fits, settled, strict=True)][:wanted]


def _begun(problem: Problem, fit: PathFit) -> PathFit:
    """The same with every path beginning at z's own x_0, wherever the rest of it comes from, and a noise that is given
    as it is given: the start may be of a combination that doubts it."""
    begins = [fit.z[r * problem.state : (r + 1) * problem.state] for r in range(len(fit.paths))]
    paths = [np.concatenate([x[None], path[1:]]) for x, path in zip(begins, fit.paths, strict=True)]
    known = problem.noise_of(fit.combination)
    return replace(fit, paths=paths, noise=np.where(np.isnan(known), fit.noise, known))


def _iterate(stepper, fits: list[PathFit], priors: Priors, rows, weight, noisy: bool) -> list[PathFit]:
    """One forward pass, one step of the unknowns, one backward pass."""
    problem = stepper.problem
    passes = [_forward(stepper, fits, r, rows[r], weight[r]) for r in range(len(rows))]
    told = [(np.asarray(done.gram), np.asarray(done.logs)) for _, _, done in passes]
    steps = [_integrated(problem, fits[b], [(grams[b], logs[b]) for grams, logs in told], priors, weight)
             for b in range(LANES)]  # fmt: skip
    moved = np.stack([fit.z + one.step for fit, one in zip(fits, steps, strict=True)])
    bounds = np.stack([priors.bounds_of(problem, fit.combination) for fit in fits])
    z = np.clip(moved, bounds[:, 0], bounds[:, 1])
    moved = z - np.stack([fit.z for fit in fits])
    paths: list[list[np.ndarray]] = [[] for _ in fits]
    squares, numbers = 0.0, 0.0
    for r, (linear, variances, done) in enumerate(passes):
        local = problem.local(r)
        back = backward_lanes(linear, done, variances, moved[:, local])
        shift = np.asarray(back.shift)[:, : rows[r]]
        used = np.stack([fit.used(r, weight[r]) for fit in fits])
        squares = squares + (used * np.asarray(back.noise)[:, : rows[r]]).sum(1)
        numbers = numbers + (used > 0).sum(1)
        for b, fit in enumerate(fits):
            paths[b].append(fit.paths[r] + shift[b])
    noise = np.stack([fit.noise for fit in fits])
    if noisy:
        known = np.stack([problem.noise_of(fit.combination) for fit in fits])
        noise = _next_noise(known, noise, squares / np.maximum(numbers, 1))
    errors = _innovations(problem, passes, moved)
    return [replace(fit, z=z[b], noise=noise[b], paths=paths[b], laplace=steps[b], errors=errors[b])
            for b, fit in enumerate(fits)]  # fmt: skip


def _innovations(problem: Problem, passes, moved: np.ndarray) -> Float[np.ndarray, "lane row channel"]:
    """Innovations of all recordings by their own sd where a step has moved the unknowns; NaN where nothing was read."""
    parts = []
    for r, (_, variances, done) in enumerate(passes):
        columns = np.concatenate([np.ones((len(moved), 1)), moved[:, problem.local(r)]], axis=1)
        e = np.einsum("btjc,bc->btj", np.asarray(done.innovations), columns)
        parts.append(np.where(np.asarray(variances) > 0, e / np.sqrt(np.asarray(done.variances)), np.nan))
    return np.concatenate(parts, axis=1)


def _next_noise(known: np.ndarray, noise: np.ndarray, expected: np.ndarray) -> np.ndarray:
    with np.errstate(invalid="ignore", divide="ignore"):
        ratio = np.sqrt(expected) / noise
    ratio = np.where(np.isfinite(ratio), np.clip(ratio, 0.3, 3.0), 1.0)
    return np.where(np.isnan(known), noise * ratio**_HASTE, noise)


def _forward(stepper, fits: list[PathFit], r: int, rows: int, weight: np.ndarray):
    problem = stepper.problem
    slots = np.stack([fit.z[problem.slots :] for fit in fits])
    hots = np.stack([problem.onehot(fit.combination, r) for fit in fits])
    return _pass(stepper, fits, r, rows, weight, slots, hots, [np.nonzero(hot[:-1].any(1))[0] for hot in hots])


def _pass(
    stepper, fits: list[PathFit], r: int, rows: int, weight: np.ndarray, slots: np.ndarray, hots: np.ndarray,
    along: Sequence[np.ndarray],
):  # fmt: skip
    """Linearise one recording about every lane's path, `along` some of its slots, and filter it."""
    problem, course = stepper.problem, stepper.courses[r]
    length = max(len(path) for fit in fits for path in fit.paths)
    variances = []
    for fit in fits:
        used = fit.used(r, weight)
        variances.append(
            padded(fit.noise**2 * np.where(used > 0, 1.0 / np.where(used > 0, used, 1.0), 0.0), length, 0.0)
        )
    given = np.stack(variances)
    paths = np.stack([_prolonged(fit.paths[r], length) for fit in fits])
    values = np.concatenate([np.stack([fit.z[problem.head : problem.slots] for fit in fits]), slots], axis=1)
    linear = linearise(stepper, r, paths, values, hots, along, problem.rows[r].readings[:rows])
    lengths = (np.asarray(course.spans.step) * np.asarray(course.spans.pieces))[:length]
    acting = np.stack([lengths * exposure(fit.exposures, r, length) for fit in fits])
    intensities = np.stack([fit.intensity for fit in fits])
    return linear, given, forward_lanes(linear, given, intensities, acting)


def _prolonged(path: np.ndarray, length: int) -> np.ndarray:
    """A path that stays at its last phase point up to `length`; nothing is read there."""
    return np.concatenate([path, np.repeat(path[-1:], length - len(path), axis=0)])


def _integrated(problem: Problem, fit: PathFit, passes, priors: Priors, weight) -> Laplace:
    """Evidence and step of one lane from its recordings' Gram matrices, and logs of their innovations' variances.

    The columns of the state at the first row are those of x_0, so that its prior and the step are taken together.
    """
    size = 1 + problem.size
    gram, offset = np.zeros((size, size)), 0.0
    for r, (g, logs) in enumerate(passes):
        place = np.concatenate([[0], 1 + problem.local(r)])
        # The path's first point is z's own x_0, so a step of x_0 from z is a step of the path's first point.
        sign = np.ones(len(place))
        sign[1:] = -1.0
        gram[np.ix_(place, place)] += g * np.outer(sign, sign)
        offset -= 0.5 * (float(logs) + (fit.used(r, weight[r]) > 0).sum() * np.log(2 * np.pi))
    return Before.of(problem, fit.combination, priors).integrate(gram, offset, fit.z)


def lane_grams(
    stepper: Stepper, fit: PathFit, laid: Sequence[tuple[np.ndarray, np.ndarray, Sequence[np.ndarray]]],
    rows: Sequence[int], r: int,
) -> list[np.ndarray]:  # fmt: skip
    """Gram matrices of one recording's innovations about a path, by column [1, x_0, calibrated, slots].

    **Arguments:** - `laid`: at most `LANES` times the values of the slots, the coefficients that they are, and the
    slots of the amplitudes; columns of other slots are 0.
    """
    problem, number = stepper.problem, len(laid)
    fixed = problem.coefficients(r, fit.z, fit.combination) - problem.coefficients(r, fit.z, ())
    slots, hots, along = [], [], []
    for values, matrix, amplitudes in laid:
        hot = matrix.copy()
        hot[-1] += fixed
        slots.append(values)
        hots.append(hot)
        along.append(np.concatenate(amplitudes))
    lanes = np.arange(LANES) % number
    weight, every = weights(problem, rows)[r], [along[k] for k in lanes]
    given = np.stack(slots)[lanes], np.stack(hots)[lanes], every
    done = _pass(stepper, [fit] * LANES, r, rows[r], weight, *given)[2]
    sign = np.ones(done.gram.shape[-1])
    sign[1:] = -1.0
    return list(np.asarray(done.gram)[:number] * np.outer(sign, sign))
