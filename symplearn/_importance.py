"""Adaptive multiple importance sampling: weighted draws of Student mixtures that learn where the posterior is."""

import dataclasses
import math
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import PRNGKeyArray
from scipy.special import logsumexp, softmax

from ._arviz import pareto_k
from ._blocks import Course
from ._errors import InputError
from ._rounds import Rounds
from ._sampler import NEGLIGIBLE, AbstractBlockSampler, Drawn, LogDensity, at_each, generator, refuse_counts, whitened
from ._student_mixture import StudentMixture, refined, shrunk
from ._whitening import Whitening

# The weighted draws are dealt to this many hands; R-hat compares them, as it does chains.
_HANDS = 4
# Share and stretch of the component over everything met so far, which no mode and no tail can be lost to.
_DEFENSIVE = 0.2
_STRETCH = 2.0
# Rounds that are drawn in any case; in the first half of them the components start afresh, at draws of the weights.
_FEWEST = 4
_ITERATIONS = 5
# Adaptation ends at this share of the target.
_LEARNT = 0.25
# Below this Pareto k the weights have a variance.
_VARIANCE = 0.5
# Draws go on while one has a larger share than this, since its copies count as one effective draw. Of ten posteriors of
# Henon-Heiles all have 600 effective draws of 1600 then, by 11,000 evaluations; at twice this share two of eight have
# 400.
_LARGEST_SHARE = 5e-3


class AdaptiveImportance(AbstractBlockSampler):
    """Adaptive multiple importance sampling. Cornuet et al. (2012), Scand. J. Statist. 39, 798.

    Rounds of `batch` draws from a mixture of `components` Student t densities, fitted to all draws before, each
    weighed by the mixture of all rounds' proposals, until their effective size is a quarter of `target`. Then fresh
    draws of the mixture reached, without which the evidence would be too low, until Kish's effective size of their
    weights is `target` and their tail is light; or until `rounds` are used up, half of them to adapt.

    The result is `draws` of equal weight, resampled in four independent hands; copies of one draw lie side by side, so
    that autocorrelation, and with it the effective sample size, knows them. Good with 36 parameters, in straight
    coordinates, and for densities with one mode, or a few near each other. Gives the evidence. Left out, `components`
    are 4 for up to six parameters and 1 from thirteen on, and `dof` as many as there are parameters, at least 5.

    **Raises:** `InputError` where a number is too small, or no draw has a finite density.
    """

    draws: int = 4000
    target: int = 2000
    batch: int = 1000
    rounds: int = 60
    components: int | None = None
    dof: float | None = None

    def __check_init__(self):
        refuse_counts(self, draws=4 * _HANDS, target=1, batch=16, rounds=1)
        if self.components is not None:
            refuse_counts(self, components=1)
        if self.dof is not None and not self.dof > 2:
            raise InputError(f"`AdaptiveImportance` needs `dof` above 2, but was given {self.dof}.")

    def draw_in(self, course: Course, density: LogDensity, start: Whitening, key: PRNGKeyArray) -> Drawn:
        random = generator(key)
        sample = weighted_sample(self, density, start, random, course)
        drawn = resampled(sample, start, self.draws, random)
        if not course.interrupted:
            return drawn
        rounds = sample.evaluations // self.batch
        remark = f"Stopped by Ctrl-C after {rounds} of at most {self.rounds} rounds."
        return dataclasses.replace(drawn, stopped=True, remarks=(remark,))


class WeightedSample(NamedTuple):
    """Draws in whitened coordinates (draw, parameter), log densities there, log weights, whose mean estimates the
    evidence, and the evaluations it took."""

    z: np.ndarray
    log_density: np.ndarray
    log_weights: np.ndarray
    evaluations: int


def weighted_sample(
    options: AdaptiveImportance,
    density: LogDensity,
    start: Whitening,
    random: np.random.Generator,
    course: Course | None = None,
) -> WeightedSample:
    """The weighted draws behind the posterior: fresh ones of the proposal that adaptation ended with.

    **Raises:** `InputError` where no draw has a finite density; `KeyboardInterrupt` where Ctrl-C came before the first
    fresh round.
    """
    course = Course("sample") if course is None else course
    # One round to adapt and one to draw there are in any case.
    rounds = Rounds(lambda z: densities(density, start, z), max(2, options.rounds), options.batch, course)
    try:
        proposal, spent = _adaptation(options, rounds, start.centre.size, random)
        return _fresh(options, rounds, proposal, spent, random)
    finally:
        course.save(rounds.state)


def _fresh(
    options: AdaptiveImportance, rounds: Rounds, proposal: StudentMixture, spent: int, random: np.random.Generator
) -> WeightedSample:
    """Rounds of draws of the proposal, until they are enough, used up or stopped."""
    z, log_density = np.zeros((0, proposal.means.shape[1])), np.zeros(0)
    sample = None
    try:
        while sample is None or sample.evaluations < options.rounds * options.batch:
            new = proposal.sample(random, options.batch)
            z, log_density = np.concatenate([z, new]), np.concatenate([log_density, rounds(new)])
            log_weights = log_density - proposal.log_density(z)
            refuse_nothing(log_weights)
            sample = WeightedSample(z, log_density, log_weights, spent * options.batch + len(z))
            if kish(log_weights) >= options.target and _light(log_weights):
                break
    except KeyboardInterrupt:
        if sample is None or not rounds.course.catches:
            raise
        rounds.course.interrupted = True
    return sample


def resampled(sample: WeightedSample, start: Whitening, draws: int, random: np.random.Generator) -> Drawn:
    """`draws` of equal weight in four independent hands, with what the weights say of them, and the evidence."""
    rows = _dealt(sample.log_weights, draws // _HANDS, random)
    log_evidence, error = _evidence(sample.log_weights)
    return Drawn(
        start.free(jnp.asarray(sample.z[rows])),
        jnp.asarray(sample.log_density[rows]) - start.log_volume,
        evaluations=sample.evaluations,
        pareto_k=pareto_k(sample.log_weights),
        largest_weight=largest_share(sample.log_weights),
        log_evidence=log_evidence,
        log_evidence_sd=error,
    )


def _adaptation(
    options: AdaptiveImportance, rounds: Rounds, size: int, random: np.random.Generator
) -> tuple[StudentMixture, int]:
    """The proposal learnt from some rounds, and how many they were; all of their draws are weighed by all proposals."""
    most = max(1, options.rounds // 2)
    proposals = [_first(options, size)]
    z, log_density, log_proposals = np.zeros((0, size)), np.zeros(0), np.zeros(0)
    while True:
        latest = proposals[-1]
        new = latest.sample(random, options.batch)
        # The old draws under the latest proposal, the new draws under all of them.
        under = logsumexp([q.log_density(new) for q in proposals], axis=0)
        log_proposals = np.concatenate([np.logaddexp(log_proposals, latest.log_density(z)), under])
        z = np.concatenate([z, new])
        log_density = np.concatenate([log_density, rounds(new)])
        log_weights = log_density - log_proposals
        refuse_nothing(log_weights)
        proposals.append(_adapted(options, latest, z, log_weights, len(proposals), random))
        done = len(proposals) - 1
        if (done >= _FEWEST and kish(log_weights) >= _LEARNT * options.target) or done >= most:
            return proposals[-1], done


def refuse_nothing(log_weights: np.ndarray) -> None:
    """Refuse draws of which none is possible."""
    if not np.any(np.isfinite(log_weights)):
        raise InputError(f"None of {len(log_weights)} draws has a finite log density; start nearer to the mode.")


def densities(density: LogDensity, start: Whitening, z: np.ndarray) -> np.ndarray:
    """The log density of the whitened coordinates at each draw."""
    return np.asarray(_densities(density, start, jnp.asarray(z)))


@eqx.filter_jit
def _densities(density, start, z):
    return at_each(whitened(density, start), z)


def _first(options: AdaptiveImportance, size: int) -> StudentMixture:
    """Components at the mode, of scales from that of the whitening to twice it."""
    count = _components(options, size)
    scales = np.linspace(1.0, 2.0, count)
    return StudentMixture(
        np.full(count, 1.0 / count), np.zeros((count, size)), scales[:, None, None] * np.eye(size), _dof(options, size)
    )


def _dof(options: AdaptiveImportance, size: int) -> float:
    # The tails of a t density hold more of its draws the more dimensions there are, unless they are lighter.
    return max(5.0, float(size)) if options.dof is None else options.dof


def _components(options: AdaptiveImportance, size: int) -> int:
    # Each has a scale matrix to learn, of so many numbers that few draws tell no more than one.
    return max(1, min(4, 24 // size)) if options.components is None else options.components


def _adapted(
    options: AdaptiveImportance,
    latest: StudentMixture,
    z: np.ndarray,
    log_weights: np.ndarray,
    done: int,
    random: np.random.Generator,
) -> StudentMixture:
    """The next proposal: a wide component over all draws, and a mixture fitted to them."""
    size, count = z.shape[1], _components(options, z.shape[1])
    weights = softened(log_weights, least=5.0 * (size + 1))
    middle, common = weights @ z, np.linalg.cholesky(shrunk(z, weights))
    if count == 1:
        fitted = StudentMixture(np.ones(1), middle[None], common[None], latest.dof)
        return _defended(fitted, middle, common)
    if done <= _FEWEST // 2:
        points = z[random.choice(len(z), size=count, p=weights)]
        begin = StudentMixture(
            np.full(count, 1.0 / count), points, np.broadcast_to(common, (count, size, size)), _dof(options, size)
        )
    else:
        shares = latest.shares[1:] / latest.shares[1:].sum()
        begin = StudentMixture(shares, latest.means[1:], latest.roots[1:], latest.dof)
    return _defended(refined(begin, z, weights, _ITERATIONS), middle, common)


def _defended(fitted: StudentMixture, middle: np.ndarray, common: np.ndarray) -> StudentMixture:
    """With the wide component over all draws."""
    return StudentMixture(
        np.concatenate([[_DEFENSIVE], (1 - _DEFENSIVE) * fitted.shares]),
        np.concatenate([middle[None], fitted.means]),
        np.concatenate([_STRETCH * common[None], fitted.roots]),
        fitted.dof,
    )


def softened(log_weights: np.ndarray, least: float) -> np.ndarray:
    """Weights that add up to one, raised to the greatest power up to 1 that leaves an effective size of `least`."""
    low, high = 0.0, 1.0
    if kish(log_weights) >= least:
        low = 1.0
    finite = np.isfinite(log_weights)
    logs = log_weights[finite] - np.max(log_weights)

    def effective(power: float) -> float:
        some = np.exp(power * logs)
        return float(some.sum() ** 2 / (some @ some))

    while high - low > 1e-6:
        middle = 0.5 * (low + high)
        low, high = (middle, high) if effective(middle) >= least else (low, middle)
    weights = np.zeros(len(log_weights))
    weights[finite] = softmax(low * logs)
    return weights


def kish(log_weights: np.ndarray) -> float:
    """Kish's effective size, (sum w)^2 / sum w^2."""
    return float(np.exp(2 * logsumexp(log_weights) - logsumexp(2 * log_weights)))


def largest_share(log_weights: np.ndarray) -> float:
    """The largest weight's share of all."""
    return float(np.exp(np.max(log_weights) - logsumexp(log_weights)))


def _light(log_weights: np.ndarray) -> bool:
    largest = largest_share(log_weights)
    return largest < NEGLIGIBLE or (largest < _LARGEST_SHARE and pareto_k(log_weights) < _VARIANCE)


def _evidence(log_weights: np.ndarray) -> tuple[float, float]:
    """The log of the mean weight, and its standard error to first order."""
    count = len(log_weights)
    spread = max(1.0 / kish(log_weights) - 1.0 / count, 0.0)
    return float(logsumexp(log_weights)) - math.log(count), math.sqrt(spread)


def _dealt(log_weights: np.ndarray, each: int, random: np.random.Generator) -> np.ndarray:
    """Rows (hand, draw) of equal weight: shuffled, dealt to the hands, each hand resampled systematically."""
    order = random.permutation(len(log_weights))[: len(log_weights) // _HANDS * _HANDS].reshape(_HANDS, -1)
    weights = np.exp(log_weights - np.max(log_weights))
    picked = [hand[_systematic(weights[hand], each, random)] for hand in order]
    return np.stack(picked)


def _systematic(weights: np.ndarray, count: int, random: np.random.Generator) -> np.ndarray:
    """`count` rows in order, each as often as its weight says, to the nearest one."""
    if not weights.sum() > 0:
        return random.integers(len(weights), size=count)
    levels = (np.arange(count) + random.uniform()) / count * weights.sum()
    return np.minimum(np.searchsorted(np.cumsum(weights), levels), len(weights) - 1)
