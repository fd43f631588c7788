"""The way to ArviZ: imported when it is first needed, because that takes seconds."""

import warnings
from typing import Any

import numpy as np


def arviz() -> Any:
    """The module `arviz`, without the word on its refactoring that it greets with."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FutureWarning)
        import arviz
    return arviz


def pareto_k(log_weights: Any) -> float:
    """The shape of the tail of importance weights: below 0.7 their means can be trusted. Vehtari et al. (2024).

    Infinite where fewer than five weights stand out; they are then either all alike or next to all zero.
    """
    log_weights = np.array(log_weights, dtype=float)
    if np.ptp(log_weights) < 1e-9:
        return -np.inf  # equal weights have no tail
    return float(arviz().psislw(log_weights)[1])


def inference_data(posterior: dict[str, Any], sample_stats: dict[str, Any], attributes: dict[str, Any]) -> Any:
    """An `arviz.InferenceData` of arrays with leading axes (chain, draw)."""
    with warnings.catch_warnings():
        # ArviZ takes more chains than draws for a mistake.
        warnings.filterwarnings("ignore", message="More chains")
        return arviz().from_dict(
            posterior=posterior,
            sample_stats=sample_stats,
            dims={"free": ["free_coordinate"]},
            posterior_attrs=attributes,
        )
