"""Simulation-based calibration: the ranks of truths among draws of their posteriors, and whether they are uniform.

Talts, Betancourt, Simpson, Vehtari and Gelman (2018), arXiv:1804.06788. Beside the parameters the log density itself is
ranked, which sees what no parameter alone does (Modrak et al. 2023, Bayesian Analysis).
"""

from collections.abc import Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float
from scipy.stats import chisquare, kstest

from symplearn._convergence import labels
from symplearn._infer import infer
from symplearn._parameters import flatten, named_parameters, value_of
from symplearn._posterior import Posterior, log_posterior_of

from ._calibration_models import Study

# A truth's rank is from 0 to `RANKED`; twenty ranks are a bin of the histogram.
RANKED, BINS = 199, 10
# The draws of a posterior drawn together about their mean, to see what the test can see.
NARROWED = (0.7, 0.8, 0.9)
# Of a uniform histogram this share is refused, whatever the number of quantities tested.
LEVEL = 0.01


def ranks_of(truth: Float[np.ndarray, " quantity"], draws: Float[np.ndarray, "draw quantity"]) -> list[int]:
    """How many draws of each quantity lie below its truth."""
    return np.sum(draws < truth, axis=0).tolist()


def narrowed(draws: Float[np.ndarray, "draw quantity"], share: float) -> np.ndarray:
    """Draws moved towards their mean, so that their spread is that share of what it was."""
    centre = draws.mean(axis=0)
    return centre + share * (draws - centre)


def simulated(study: Study, name: str, seed: int, k: int) -> dict[str, Any]:
    """One truth, its recording, its posterior, and the ranks: of the draws as they are and narrowed."""
    rng = np.random.default_rng([seed, k, *name.encode()])
    truth = study.draw(rng)
    series = study.recording(truth, rng)
    begin, key = study.model(study.begin, truth), jax.random.key(int(rng.integers(2**31)))
    posterior = infer(begin, series, prior=study.prior, key=key, samplers=study.samplers)
    ranked = _ranked(posterior, np.asarray(flatten(study.model(truth, truth))[0]), rng)
    return ranked | {"converged": posterior.converged, "sampler": posterior.sampler.split("(")[0]}


def _ranked(posterior: Posterior, truth: np.ndarray, rng: np.random.Generator) -> dict[str, Any]:
    """Ranks in free coordinates, which are those of the values: each is a monotone function of its value."""
    free = np.asarray(posterior.free)
    free, heights = free.reshape(-1, free.shape[-1]), np.ravel(posterior.log_posterior)
    # A tenth or less of the draws, at random, of which hardly two are neighbours.
    picked = rng.choice(len(free), size=RANKED, replace=False)
    height = float(_log_density(log_posterior_of(posterior.estimate), truth))  # type: ignore[arg-type]
    # In the order of the free coordinates, which that of `values` is not.
    leaves = named_parameters(posterior.estimate.model)  # type: ignore[union-attr]
    names = [*labels({name: value_of(leaf) for name, leaf in leaves.items()}), "log density"]
    draws = np.column_stack([free[picked], heights[picked]])
    found = {"ranks": dict(zip(names, ranks_of(np.append(truth, height), draws), strict=True))}
    for share in NARROWED:
        moved = ranks_of(truth, narrowed(free[picked], share))
        found[f"narrowed_{share:g}"] = dict(zip(names[:-1], moved, strict=True))
    return found


@eqx.filter_jit
def _log_density(density, free):
    return density(free)


def batch_of(study: Study, name: str, seed: int, numbers: Sequence[int]) -> dict[str, Any]:
    """Several simulations, each entry a list over them."""
    found = [simulated(study, name, seed, k) for k in numbers]
    nested = [key for key in found[0] if isinstance(found[0][key], dict)]
    lists = {key: {q: [one[key][q] for one in found] for q in found[0][key]} for key in nested}
    return lists | {key: [one[key] for one in found] for key in ("converged", "sampler")}


def joined(batches: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """The batches of one study as one."""
    found: dict[str, Any] = {}
    for key, first in batches[0].items():
        if isinstance(first, dict):
            found[key] = {quantity: sum((one[key][quantity] for one in batches), []) for quantity in first}
        elif isinstance(first, list):
            found[key] = sum((one[key] for one in batches), [])
    return found


def p_values(ranks: Sequence[int]) -> dict[str, float]:
    """Of uniform ranks: by chi-square over 10 bins, and by the largest deviation of the ranks' distribution function
    (Kolmogorov and Smirnov), which sees what moves all bins a little."""
    ranked = np.asarray(ranks)
    counts = np.bincount(ranked * BINS // (RANKED + 1), minlength=BINS)
    # Ranks are 200 numbers, not the unit interval: half a rank is 0.0025, a twentieth of the deviation that is told.
    ecdf = kstest((ranked + 0.5) / (RANKED + 1), "uniform").pvalue
    return {"chi_square": float(chisquare(counts).pvalue), "ecdf": float(ecdf)}


def corrected(by_quantity: Mapping[str, Mapping[str, float]]) -> float:
    """The smallest p-value times the number of p-values, at most 1: Bonferroni's correction, which needs no
    independence."""
    every = [p for one in by_quantity.values() for p in one.values()]
    return min(1.0, len(every) * min(every))


def uniformity(ranks: Mapping[str, Sequence[int]]) -> dict[str, Any]:
    """The p-values of every quantity, and the corrected one by which all of them together are judged."""
    found = {quantity: p_values(each) for quantity, each in ranks.items()}
    smallest = corrected(found)
    return {"p_values": found, "corrected": smallest, "uniform": bool(smallest >= LEVEL)}
