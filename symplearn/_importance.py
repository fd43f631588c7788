"""Adaptive multiple importance sampling: weighted draws of Student mixtures that learn where the posterior is."""

import math
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PRNGKeyArray
from scipy.special import logsumexp, softmax

from ._arviz import pareto_k
from ._errors import InputError
from ._sampler import NEGLIGIBLE, AbstractSampler, Drawn, LogDensity, generator, refuse_counts, whitened
from ._student_mixture import StudentMixture, refined, scatter
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


class AdaptiveImportance(AbstractSampler):
    """Adaptive multiple importance sampling. Cornuet et al. (2012), Scand. J. Statist. 39, 798.

    Rounds of `batch` draws from a mixture of `components` Student t densities, fitted to all draws before, each
    weighed by the mixture of all rounds' proposals, until their effective size is a quarter of `target`. Then fresh
    draws of the mixture reached, without which the evidence would be too low, until Kish's effective size of their
    weights is `target` and their tail is light; or until `rounds` are used up, half of them to adapt.

    The result is `draws` of equal weight, resampled in four independent hands; copies of one draw lie side by side, so
    that autocorrelation, and with it the effective sample size, knows them. Best up to some twenty parameters and for
    densities with one mode, or a few near each other. Gives the evidence.

    **Raises:** `InputError` where a number is too small, or no draw has a finite density.
    """

    draws: int = 4000
    target: int = 2000
    batch: int = 1000
    rounds: int = 40
    components: int = 4
    dof: float = 5.0

    def __check_init__(self):
        refuse_counts(self, draws=4 * _HANDS, target=1, batch=16, rounds=1, components=1)
        if not self.dof > 2:
            raise InputError(f"`AdaptiveImportance` needs `dof` above 2, but was given {self.dof}.")

    def draw(self, density: LogDensity, start: Whitening, key: PRNGKeyArray) -> Drawn:
        random = generator(key)
        sample = weighted_sample(self, density, start, random)
        rows = _dealt(sample.log_weights, self.draws // _HANDS, random)
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


class WeightedSample(NamedTuple):
    """Draws in whitened coordinates (draw, parameter), log densities there, log weights, whose mean estimates the
    evidence, and the evaluations it took."""

    z: np.ndarray
    log_density: np.ndarray
    log_weights: np.ndarray
    evaluations: int


def weighted_sample(
    options: AdaptiveImportance, density: LogDensity, start: Whitening, random: np.random.Generator
) -> WeightedSample:
    """The weighted draws behind the posterior: fresh ones of the proposal that adaptation ended with.

    **Raises:** `InputError` where no draw has a finite density.
    """
    proposal, spent = _adaptation(options, density, start, random)
    z, log_density = np.zeros((0, start.centre.size)), np.zeros(0)
    while True:
        new = proposal.sample(random, options.batch)
        z = np.concatenate([z, new])
        log_density = np.concatenate([log_density, np.asarray(_densities(density, start, jnp.asarray(new)))])
        log_weights = log_density - proposal.log_density(z)
        done = spent + len(z) // options.batch
        _refuse_nothing(log_weights)
        if (kish(log_weights) >= options.target and _light(log_weights)) or done >= options.rounds:
            return WeightedSample(z, log_density, log_weights, done * options.batch)


def _adaptation(
    options: AdaptiveImportance, density: LogDensity, start: Whitening, random: np.random.Generator
) -> tuple[StudentMixture, int]:
    """The proposal learnt from some rounds, and how many they were; all of their draws are weighed by all proposals."""
    size, most = start.centre.size, max(1, options.rounds // 2)
    proposals = [_first(options, size)]
    z, log_density, log_proposals = np.zeros((0, size)), np.zeros(0), np.zeros(0)
    while True:
        latest = proposals[-1]
        new = latest.sample(random, options.batch)
        # The old draws under the latest proposal, the new draws under all of them.
        under = logsumexp([q.log_density(new) for q in proposals], axis=0)
        log_proposals = np.concatenate([np.logaddexp(log_proposals, latest.log_density(z)), under])
        z = np.concatenate([z, new])
        log_density = np.concatenate([log_density, np.asarray(_densities(density, start, jnp.asarray(new)))])
        log_weights = log_density - log_proposals
        _refuse_nothing(log_weights)
        proposals.append(_adapted(options, latest, z, log_weights, len(proposals), random))
        rounds = len(proposals) - 1
        if (rounds >= _FEWEST and kish(log_weights) >= _LEARNT * options.target) or rounds >= most:
            return proposals[-1], rounds


def _refuse_nothing(log_weights: np.ndarray) -> None:
    if not np.any(np.isfinite(log_weights)):
        raise InputError(f"None of {len(log_weights)} draws has a finite log density; start nearer to the mode.")


@eqx.filter_jit
def _densities(density, start, z):
    return jax.vmap(whitened(density, start))(z)


def _first(options: AdaptiveImportance, size: int) -> StudentMixture:
    """Components at the mode, of scales from that of the whitening to twice it."""
    scales = np.linspace(1.0, 2.0, options.components)
    shares = np.full(options.components, 1.0 / options.components)
    return StudentMixture(
        shares, np.zeros((options.components, size)), scales[:, None, None] * np.eye(size), options.dof
    )


def _adapted(
    options: AdaptiveImportance,
    latest: StudentMixture,
    z: np.ndarray,
    log_weights: np.ndarray,
    done: int,
    random: np.random.Generator,
) -> StudentMixture:
    """The next proposal: a wide component over all draws, and a mixture fitted to them."""
    size, count = z.shape[1], options.components
    weights = softened(log_weights, least=5.0 * (size + 1))
    common = np.linalg.cholesky(scatter(z, weights))
    if done <= _FEWEST // 2:
        points = z[random.choice(len(z), size=count, p=weights)]
        begin = StudentMixture(
            np.full(count, 1.0 / count), points, np.broadcast_to(common, (count, size, size)), options.dof
        )
    else:
        shares = latest.shares[1:] / latest.shares[1:].sum()
        begin = StudentMixture(shares, latest.means[1:], latest.roots[1:], options.dof)
    fitted = refined(begin, z, weights, _ITERATIONS)
    return StudentMixture(
        np.concatenate([[_DEFENSIVE], (1 - _DEFENSIVE) * fitted.shares]),
        np.concatenate([(weights @ z)[None], fitted.means]),
        np.concatenate([_STRETCH * common[None], fitted.roots]),
        options.dof,
    )


def softened(log_weights: np.ndarray, least: float) -> np.ndarray:
    """Weights that add up to one, raised to the greatest power up to 1 that leaves an effective size of `least`."""
    low, high = 0.0, 1.0
    if kish(log_weights) >= least:
        low = 1.0
    finite = np.isfinite(log_weights)
    logs = log_weights[finite]
    while high - low > 1e-6:
        middle = 0.5 * (low + high)
        low, high = (middle, high) if kish(middle * logs) >= least else (low, middle)
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
    return largest_share(log_weights) < NEGLIGIBLE or pareto_k(log_weights) < _VARIANCE


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
