"""The answer as the contract words it: diagnosis.json (section 4) as plain data."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float

from .._effects import Candidate
from .._recording import Recording
from ._calibrate import Priors
from ._found import within_bounds
from ._outlook import Outlook
from ._posterior import Posterior, Weighed
from ._problem import Problem
from ._weighed import Estimate

# Alternatives listed one by one; the rest is `other`.
_LISTED = 12
_LEAST = 5e-4
# Share of the held-out rows, the worst, of which a misfit knows nothing.
_TRIMMED = 0.05
# A bound cuts what comes nearer to it than so many standard deviations.
_FAR = 5.0
# What is left of it is looked at so many widths from where it is highest, at so many nodes.
_REACH, _NODES = 40.0, 200


def parameters(problem: Problem, priors: Priors, estimate: Estimate, inflation: float) -> dict[str, Any]:
    """Posterior of everything calibrated, as far as bounds allow."""
    c, part = problem.calibrated, slice(problem.head, problem.head + problem.calibrated.size)
    z, within = estimate.z[part], within_bounds(problem, priors, estimate).z[part]
    # One that is beyond its bounds is cut off there; the others have followed it.
    mean = np.where((c.lower <= z) & (z <= c.upper), within, z)
    sd = np.minimum(np.sqrt(np.diag(estimate.covariance)[part] * inflation), c.sd)
    each = zip(c.names, mean, sd, c.lower, c.upper, strict=True)
    return {name: _between(*map(float, values)) for name, *values in each}


def _between(mean: float, sd: float, lower: float, upper: float) -> dict[str, float]:
    """Mean and standard deviation of a Gaussian, or of its part between bounds where they cut it.

    By quadrature: far beyond a bound, and between close ones, SciPy's `truncnorm` has no standard deviation.
    """
    if not 0 < sd < np.inf or min(mean - lower, upper - mean) >= _FAR * sd:
        return {"mean": mean, "sd": sd}
    peak = min(max(mean, lower), upper)
    width = sd / max(1.0, abs(peak - mean) / sd)  # beyond a bound the density falls off as an exponential
    low, high = max(lower - peak, -_REACH * width), min(upper - peak, _REACH * width)
    nodes, share = np.polynomial.legendre.leggauss(_NODES)
    off = low + 0.5 * (high - low) * (nodes + 1.0)  # from the peak, so that none of a narrow part is lost in rounding
    share = share * np.exp(-off * (0.5 * off + (peak - mean)) / sd**2)
    middle = float(share @ off / share.sum())
    return {"mean": peak + middle, "sd": float(np.sqrt(share @ (off - middle) ** 2 / share.sum()))}


def fit(
    problem: Problem, needed: Estimate, outlooks: Sequence[Outlook], recordings: Sequence[Recording], inflation: float
) -> dict[str, Any]:
    """Held-out error of the free run in the columns' units and by what was expected of it, its log density, and the
    noises.

    Free run and density are those of `outlooks`. `needed` holds the process noise and the reading noise that it takes
    to follow the fitted rows; a force that acts for a while counts in the mean over them. `inflation` multiplies the
    posterior covariance of the unknowns.
    """
    columns, momenta = problem.equations.columns, problem.equations.momenta
    squares, numbers, density = np.zeros(len(columns)), np.zeros(len(columns)), 0.0
    against: list[np.ndarray] = []
    for outlook, recording in zip(outlooks, recordings, strict=True):
        held = recording.times > outlook.rows.boundary
        if held.any():
            error = outlook.held_out_errors(recording.times[held], recording.readings[held])
            squares += np.nansum(error**2, axis=0)
            numbers += (~np.isnan(error)).sum(0)
            told = outlook.held_out(inflation)
            density += told.log_density
            against.append(told.squares)
    with np.errstate(invalid="ignore", divide="ignore"):
        rmse = np.sqrt(squares / numbers)
    misfit = [_root_mean(column) for column in np.concatenate(against).T] if against else []
    held_out = any((r.times > o.rows.boundary).any() for o, r in zip(outlooks, recordings, strict=True))
    exposed = 1.0 if needed.exposures is None else float(np.mean(np.concatenate(needed.exposures)))
    intensity = np.zeros(len(momenta)) if needed.intensity is None else np.sqrt(needed.intensity * exposed)
    return {
        "holdout_rmse": {c: finite(x) for c, x in zip(columns, rmse, strict=True)} if held_out else None,
        "holdout_misfit": {c: finite(x) for c, x in zip(columns, misfit, strict=True)} if held_out else None,
        "holdout_log_density": finite(density) if held_out else None,
        "process_noise_sd": {p: float(x) for p, x in zip(momenta, intensity, strict=True)},
        "noise_sd": {c: finite(x) for c, x in zip(columns, needed.reading_noise, strict=True)},
    }


def _root_mean(squares: Float[np.ndarray, " row"]) -> float:
    """Without the largest, which may be outliers; NaN where nothing was read."""
    seen = np.sort(squares[~np.isnan(squares)])
    return float(np.sqrt(seen[: len(seen) - int(_TRIMMED * len(seen))].mean())) if len(seen) else np.nan


def finite(value: float) -> float | None:
    """A number, or None where it is not one."""
    return float(value) if np.isfinite(value) else None


def told_apart(problem: Problem, named: Sequence[Weighed]) -> list[Weighed]:
    """One for every set of effects and targets, likeliest first: with the probability of all choices of recordings and
    sides together, of which the likeliest speaks for it."""
    groups: dict[tuple[Any, ...], Weighed] = {}
    for w in named:
        keys = tuple(sorted(one.key for m in w.combination for one in problem.candidate(m).told()))
        first = groups.get(keys)
        groups[keys] = replace(first, probability=first.probability + w.probability) if first else w
    return sorted(groups.values(), key=lambda w: -w.probability)


def alternatives(
    problem: Problem, posterior: Posterior, verdict: str, chosen: Weighed | None
) -> tuple[list[Any], float]:
    """Everything weighed beside the reported combination, likeliest first, and what is left over."""
    rows = [alternative(problem, w.combination, False, w.probability) for w in told_apart(problem, posterior.named)
            if chosen is None or w.combination != chosen.combination]  # fmt: skip
    rows = [row for row in rows if row["probability"] > _LEAST][:_LISTED]
    if verdict != "unexplained":
        rows.append(alternative(problem, (), True, posterior.unexplained))
    if verdict != "consistent":
        rows.append(alternative(problem, (), False, posterior.as_it_is))
    rows.sort(key=lambda row: -row["probability"])
    reported = {"consistent": posterior.as_it_is, "unexplained": posterior.unexplained}.get(verdict)
    reported = chosen.probability if reported is None and chosen is not None else reported
    return rows, max(0.0, 1.0 - float(reported or 0.0) - sum(row["probability"] for row in rows))


def alternative(problem: Problem, combination, unexplained: bool, probability: float) -> dict[str, Any]:
    """What else it could be: effects, or none of them, as a row of the document."""
    found = [one for member in combination for one in problem.candidate(member).told()]
    return {
        "findings": [{"effect": one.effect.name, "target": one.target} for one in found],
        "unexplained": unexplained,
        "probability": float(probability),
    }


def family_probability(problem: Problem, posterior: Posterior) -> dict[str, float]:
    """Probability that an effect of each family is present; a force without a name is of any and of what it does."""
    total: dict[str, float] = {}
    for w in posterior.named:
        places = problem.placed(w.combination)
        for family in {family for m, place in places for family in _families(problem.candidate(m), w.best.z[place])}:
            total[family] = min(1.0, total.get(family, 0.0) + w.probability)
    return dict(sorted(total.items(), key=lambda item: -item[1]))


def _families(one: Candidate, sizes: Float[np.ndarray, " value"]) -> list[str]:
    kind = one.nameless.kind if one.nameless else ""
    if kind == "dissipation" and sizes[0] < 0:
        kind = "activity"
    return [one.effect.family, kind] if kind else [one.effect.family]


def presence(problem: Problem, posterior: Posterior, told: Candidate) -> float:
    """Probability that one effect and target is present in any combination, in whichever recordings."""
    having = (w for w in posterior.named
              if told.key in {one.key for m in w.combination for one in problem.candidate(m).told()})  # fmt: skip
    return min(1.0, sum(w.probability for w in having))
