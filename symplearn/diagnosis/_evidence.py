"""Evidence of one combination of effects: Laplace's integral over the unknowns, from a Gram matrix of innovations."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy.special import erfcx, log_ndtr, ndtr, owens_t

from .._normal import log_density

# Probabilities of a half space below this are as good as impossible.
_TINY = 1e-300
# Of the variance of what is known to be on one side of a bound.
_ROUND_OFF = 1e-12
# Standard deviations that a variance of block sums may lie above its expectation and still be chance.
_CHANCE = 2.5
# Standard deviations inside a bound beyond which nothing lies.
_CERTAIN = 8.0
# Points of a cubature for each dimension: of 144 orthants of up to eight, half of them nearly singular, the logarithm
# was off by 0.006 at most, as with the million that SciPy would take; a dozen took 11 ms each at most, and 76 ms there.
_POINTS = 2000
# Standard deviations beyond a bound from which a cubature of the allowed region is no longer to be trusted, and a
# probability that is lost in its errors, as in those of a difference of numbers near one: such are taken one after the
# other, which is off by more where they exclude each other.
_FAR, _LOST = -4.0, 1e-9
# A reach of nothing at all, which a quadrant divides by.
_AT_THE_BOUND = 1e-150


@dataclass(frozen=True)
class Laplace:
    """A Gaussian posterior around `z + step`, and the log evidence in nats, half-priors of signed effects included."""

    log_evidence: float
    step: Float[np.ndarray, " z"]
    covariance: Float[np.ndarray, "z z"]  # zero where nothing is free
    promised: float  # nats of the evidence that the step is to bring, which only near an optimum it does


def laplace(
    gram: Float[np.ndarray, "column column"],
    offset: float,
    z: Float[np.ndarray, " z"],
    mean: Float[np.ndarray, " z"],
    precision: Float[np.ndarray, " z"],
    active: Bool[np.ndarray, " z"],
    lower: dict[int, float],
    bounds: tuple[Float[np.ndarray, " z"], Float[np.ndarray, " z"]] = (np.array(-np.inf), np.array(np.inf)),
) -> Laplace:
    """Integrate exp(offset - |e0 - E d|^2 / 2) times the priors over the step d, exactly where e is linear.

    **Arguments:** - `gram`: of the columns [e0, E]. - `offset`: minus half of what does not depend on d. - `lower`: the
    entries of z that are physical only above a bound; prior and posterior are cut off there. - `bounds`: what no fit
    leaves. An entry that stands at one and is pushed against it takes no step; what lies inside is integrated, by the
    density of the priors as they are.
    """
    slope = gram[0, 1:] - precision * (z - mean)
    pushed = active & ((z <= bounds[0]) & (slope < 0) | (z >= bounds[1]) & (slope > 0))
    a = np.nonzero(active & ~pushed)[0]
    matrix = gram[1:, 1:][np.ix_(a, a)] + np.diag(precision[a])
    vector = slope[a]
    diagonal = np.diag(matrix)
    scale = np.sqrt(np.where(diagonal > _TINY, diagonal, 1.0))
    scaled = matrix / np.outer(scale, scale)
    if not np.isfinite(scaled).all():  # a trajectory that ran away
        return Laplace(-np.inf, np.zeros(len(z)), np.zeros((len(z), len(z))), 0.0)
    values, vectors = np.linalg.eigh(scaled)
    values = np.maximum(values, 1e-13)  # a direction that neither data nor prior hold keeps a wide, finite spread
    inverse = (vectors / values) @ vectors.T / np.outer(scale, scale)
    along = vectors.T @ (vector / scale)  # not through the inverse, which loses what flat directions leave
    step = vectors @ (along / values) / scale
    promised = 0.5 * float((along**2 / values).sum())
    square = gram[0, 0] + (precision[a] * (z - mean)[a] ** 2).sum() - 2 * promised
    held = precision[a][precision[a] > 0]
    log_determinant = np.log(values).sum() + 2 * np.log(scale).sum()
    value = offset - 0.5 * square + 0.5 * np.log(held).sum() - 0.5 * log_determinant
    full_step, covariance = np.zeros(len(z)), np.zeros((len(z), len(z)))
    full_step[a] = step
    covariance[np.ix_(a, a)] = inverse
    for k in np.nonzero(pushed)[0]:
        cross = gram[1:, 1:][a, k]
        bend = max(gram[1 + k, 1 + k] + precision[k] - float(cross @ inverse @ cross), _TINY)
        mass, covariance[k, k] = _beyond(abs(slope[k] - float(cross @ full_step[a])), bend)
        width = np.log(precision[k]) if precision[k] > 0 else 0.0  # without a prior, as of `held`
        value += mass + 0.5 * (width - np.log(2 * np.pi)) - 0.5 * precision[k] * (z[k] - mean[k]) ** 2
    value -= _cut_off_prior(mean, precision, lower)
    value += _mass_inside(z + full_step, covariance, lower, bounds, active & ~pushed)
    return Laplace(float(value) if np.isfinite(value) else -np.inf, full_step, covariance, promised)


def _beyond(slope: float, bend: float) -> tuple[float, float]:
    """Log of the integral of exp(-slope u - bend u^2 / 2) over all positive u, and about the variance of u."""
    mass = 0.5 * np.log(np.pi / (2 * bend)) + np.log(erfcx(slope / np.sqrt(2 * bend)))
    return float(mass), 1.0 / (slope**2 + bend)


def _cut_off_prior(mean: np.ndarray, precision: np.ndarray, lower: dict[int, float]) -> float:
    """Log prior mass of the region that signs allow."""
    places, low = np.array(list(lower), int), np.array(list(lower.values()))
    return float(log_ndtr((mean[places] - low) * np.sqrt(precision[places])).sum())


def _mass_inside(
    centre: np.ndarray, covariance: np.ndarray, lower: dict[int, float], bounds: tuple[np.ndarray, np.ndarray],
    free: np.ndarray,
) -> float:  # fmt: skip
    """Log posterior mass of the region that signs allow, and of what is free between the bounds that no fit leaves; a
    fit on its way beyond one of these will stay at it."""
    sd = np.sqrt(np.diag(covariance))
    signs = np.full(len(sd), -np.inf)
    signs[list(lower)] = list(lower.values())
    below, above = (np.where(free, np.maximum(gap, 0.0), np.inf) for gap in (centre - bounds[0], bounds[1] - centre))
    below = np.minimum(below, centre - signs)
    some = np.nonzero((sd > 0) & (np.minimum(below, above) < _CERTAIN * sd))[0]
    if not len(some):
        return 0.0
    side = np.where(above < below, -1.0, 1.0)[some]
    reach = np.minimum(below, above)[some] / sd[some]
    if len(some) == 1:
        return float(log_ndtr(reach[0]))
    scale = side * sd[some]
    return _orthant(reach, covariance[np.ix_(some, some)] / np.outer(scale, scale) + 1e-10 * np.eye(len(some)))


def _orthant(reach: np.ndarray, correlation: np.ndarray) -> float:
    """Log probability that correlated standard normals all lie above minus `reach`.

    Far out, where a cubature returns zero, one after the other given that those before are inside (Mendell and
    Elston 1974).
    """
    if reach.min() >= _FAR:
        joint = _quadrant(reach, correlation) if len(reach) == 2 else _cubature(reach, correlation)
        if joint > _LOST:
            return float(np.log(joint))
    return float(orthants(reach, correlation))


def _quadrant(reach: np.ndarray, correlation: np.ndarray) -> float:
    """Probability that two are above minus `reach`, exactly (Owen 1956)."""
    a, b = np.where(reach == 0, _AT_THE_BOUND, reach) / np.sqrt(np.diag(correlation))
    rho = correlation[0, 1] / np.sqrt(correlation[0, 0] * correlation[1, 1])
    root = np.sqrt(max(1.0 - rho**2, _TINY))
    beside = owens_t(a, (b / a - rho) / root) + owens_t(b, (a / b - rho) / root)
    return float(0.5 * (ndtr(a) + ndtr(b) - ((a < 0) != (b < 0))) - beside)


def _cubature(reach: np.ndarray, correlation: np.ndarray) -> float:
    """The same of any number of them."""
    from scipy.stats import multivariate_normal  # slow to import, and not always needed

    some = _POINTS * len(reach)
    return float(
        multivariate_normal.cdf(reach, cov=correlation, allow_singular=True, maxpts=some, rng=np.random.default_rng(0))
    )


def orthants(
    centre: Float[np.ndarray, "*lane n"], covariance: Float[np.ndarray, "*lane n n"]
) -> Float[np.ndarray, "*lane"]:
    """Log probabilities that correlated normals are all positive, one after the other given that those before are.

    Exact for one and for independent ones, a good approximation for others (Mendell and Elston 1974).
    """
    return cut_off(centre, covariance, np.ones(centre.shape[-1], bool))[0]


def cut_off(
    centre: Float[np.ndarray, "*lane n"], covariance: Float[np.ndarray, "*lane n n"], some: Bool[np.ndarray, " n"]
) -> tuple[Float[np.ndarray, "*lane"], Float[np.ndarray, "*lane n"], Float[np.ndarray, "*lane n n"]]:
    """The same of some of them, and mean and covariance of all given that those are positive."""
    mean, covariance, total = centre.copy(), covariance.copy(), np.zeros(centre.shape[:-1])
    diagonal = np.arange(centre.shape[-1])
    least = _ROUND_OFF * covariance[..., diagonal, diagonal]
    for i in np.nonzero(some)[0]:
        spread = np.sqrt(np.maximum(covariance[..., i, i], _TINY))
        r = mean[..., i] / spread
        mass = log_ndtr(r)
        total, shift = total + mass, np.exp(log_density(r) - mass)
        with_i = covariance[..., i] / spread[..., None]
        mean = mean + with_i * shift[..., None]
        less = (shift * (shift + r))[..., None, None]
        covariance = covariance - with_i[..., :, None] * with_i[..., None, :] * less
        covariance[..., diagonal, diagonal] = np.maximum(covariance[..., diagonal, diagonal], least)
    return np.asarray(total), mean, covariance


def variance_inflation(scores: Float[np.ndarray, "time z"], blocks: tuple[int, ...] = (12, 24, 48)) -> float:
    """How much larger the variance of the summed score is over blocks of time than whitened rows would have it.

    One where the remainder was whitened rightly; large where it is not white on the scale of the motion, so that
    Bayes factors claim more than the data hold (a batch-means estimate of the long-run variance; Geyer 1992). The
    block length that tells most counts, each estimate lowered by what so few blocks show by chance; at least one.
    """
    scores = scores[:, np.abs(scores).sum(0) > 0]
    found = [1.0]
    for number in blocks:
        size = len(scores) // number
        if size < 4 or scores.shape[1] == 0:
            continue
        sums = scores[: size * number].reshape(number, size, -1).sum(1)
        within = np.maximum((scores**2).mean(0), _TINY)
        chance = 1.0 + _CHANCE * np.sqrt(2.0 / (number * scores.shape[1]))
        found.append(float(np.median(sums.var(0, ddof=1) / size / within) / chance))
    return max(found)
