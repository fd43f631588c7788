"""The contract's coefficients of what was found, with their uncertainty."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from scipy.special import betaincinv, gammaincinv, ndtr, ndtri

from .._effects import NOISE, Candidate
from ._calibrate import Priors
from ._found import within_bounds
from ._problem import Problem
from ._weighed import Estimate, Mode

_DRAWS = 4000
# Standard deviations of the noise beyond which an outlier shows as one.
_STANDS_OUT = 3.0


def values_of(problem: Problem, estimate: Estimate, member: int) -> dict[str, float]:
    """Most probable coefficients of one member of a combination, by the contract's names."""
    one = problem.candidate(member)
    if one.effect.amplitudes == 0:
        return dict(_scatter(problem, estimate, one))
    place = dict(problem.placed(estimate.combination))[member]
    named = one.effect.named(estimate.z[place], problem.origin(member))
    return {name: float(value) for name, value in named.items()}


def coefficients(
    problem: Problem, priors: Priors, estimate: Estimate, member: int, inflation: float
) -> dict[str, dict[str, Any]]:
    """Mean, sd and 95 % interval of every coefficient, cut off where a sign is physical."""
    one = problem.candidate(member)
    values = values_of(problem, estimate, member)
    if one.effect.amplitudes == 0:
        number = sum(float((r.counts[: r.fitted, one.place] > 0).sum()) for r in problem.rows)
        noise = float(estimate.noise[one.place])
        return {name: _counted(name, values, max(number, 1.0), noise) for name in values}
    place = dict(problem.placed(estimate.combination))[member]
    if one.effect.size == 1:
        return {one.effect.coefficients[0]: _single(problem, estimate, place.start, inflation)}
    draws = _drawn(problem, priors, estimate, place, inflation)
    named = one.effect.named(draws, problem.origin(member))
    if within_bounds(problem, priors, estimate) is not estimate:  # a step about a fit may end beyond
        values = _in_the_middle(named)
    return {name: _summary(values[name], named[name], circular=name == "phi") for name in values}


def _scatter(problem: Problem, estimate: Estimate, one: Candidate) -> dict[str, float]:
    if one.effect is NOISE:
        return {"s": float(estimate.noise[one.place] / problem.noise[one.place])}
    return dict(zip(("e", "sd"), estimate.outliers[one.place], strict=True))


def _counted(name: str, values: dict[str, Any], number: float, noise: float = 1.0) -> dict[str, Any]:
    """A factor of the noise, a share of outliers or their size, from so many readings; few of them leave it skewed.

    The interval of a share is that of Jeffreys' prior (Brown, Cai and DasGupta 2001), that of a standard deviation by
    the chi-square law of its square. Of outliers only those count that stand out of the noise.
    """
    value, share, told = values[name], values.get("e", 1.0), number
    if "e" in values:
        told = number * 2 * ndtr(-_STANDS_OUT / np.hypot(1.0, values["sd"] / noise))
    some = max(told * share, 1.0)
    if name == "e":
        sd = np.sqrt(value * (1 - value) / told)
        low, high = betaincinv(some + 0.5, max(told - some, 0.0) + 0.5, [0.025, 0.975])
    else:
        sd = value / np.sqrt(2 * some)
        low, high = value * np.sqrt(0.5 * some / gammaincinv(0.5 * some, [0.975, 0.025]))
    return {"mean": value, "sd": float(sd), "interval95": [float(low), float(high)]}


def _single(problem: Problem, estimate: Estimate, place: int, inflation: float) -> dict[str, Any]:
    mean = float(estimate.z[place])
    sd = float(np.sqrt(estimate.covariance[place, place] * inflation))
    lower = problem.lower_bounds(estimate.combination).get(place)
    if lower is None or mean - lower > 5 * sd:
        low, high = (float(mean + x * sd) for x in ndtri([0.025, 0.975]))
    else:
        from scipy.stats import truncnorm  # slow to import, and not always needed

        law = truncnorm((lower - mean) / sd, np.inf, mean, sd)
        low, high = (float(x) for x in law.ppf([0.025, 0.975]))
        mean, sd = float(law.mean()), float(law.std())
    return {"mean": mean, "sd": sd, "interval95": [low, high]}


def _drawn(problem: Problem, priors: Priors, estimate: Estimate, place: slice, inflation: float) -> np.ndarray:
    """Draws of an effect's values from all modes, inside where they may lie."""
    modes = estimate.modes or (Mode(0.0, estimate.z, estimate.covariance),)
    top = max(mode.log_evidence for mode in modes)
    share = np.exp([(mode.log_evidence - top) / inflation for mode in modes])
    numbers = np.round(_DRAWS * share / share.sum()).astype(int)
    rng = np.random.default_rng(0)
    draws = np.concatenate([
        rng.multivariate_normal(mode.z[place], mode.covariance[place, place] * inflation, number, method="eigh")
        for mode, number in zip(modes, numbers, strict=True)
    ])  # fmt: skip
    lower, upper = priors.bounds_of(problem, estimate.combination)
    signed = problem.lower_bounds(estimate.combination)
    bound = np.array([signed.get(k, -np.inf) for k in range(place.start, place.stop)])
    draws = np.clip(draws, lower[place], upper[place])
    allowed = (draws >= bound).all(1)
    return draws[allowed] if allowed.sum() > _DRAWS // 20 else draws


def _in_the_middle(named: Mapping[str, np.ndarray]) -> dict[str, float]:
    """The draw that lies nearest to the medians of all; an angle belongs to its frequency, and has no median."""
    plain = np.array([draws for name, draws in named.items() if name != "phi"])
    off = (plain - np.median(plain, axis=1, keepdims=True)) / np.maximum(plain.std(axis=1, keepdims=True), 1e-300)
    nearest = int(np.argmin((off**2).sum(0)))
    return {name: float(draws[nearest]) for name, draws in named.items()}


def _summary(value: float, draws: np.ndarray, circular: bool) -> dict[str, Any]:
    """The value, sd and interval; of an angle about that value. A mean of an angle by itself would not belong to the
    frequency that stands beside it: far from t = 0 the two hang together."""
    about = value if circular else 0.0
    off = np.angle(np.exp(1j * (draws - value))) if circular else draws
    low, high = np.quantile(off, [0.025, 0.975]) + about
    return {"mean": value, "sd": float(off.std()), "interval95": [float(low), float(high)]}
