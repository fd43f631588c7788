"""Errors of the readings that last, beside the white noise of an estimate."""

import numpy as np
from jaxtyping import Float

from ._weighed import Estimate


def colour_ratio(estimate: Estimate) -> Float[np.ndarray, " channel"]:
    """Variance of the reading error that lasts, by memory or by place, over the white one; zero where there is none."""
    unknown = [(bend.spread / noise) ** 2 for bend, noise in zip(estimate.bends, estimate.noise, strict=False)]
    kinds = [[c.ratio for c in estimate.colours], [c.ratio for c in estimate.clocks], unknown or estimate.bent]
    return sum((np.array(each) for each in kinds if each), np.zeros(len(estimate.noise)))


def total_noise(estimate: Estimate) -> Float[np.ndarray, " channel"]:
    """White reading noise and errors that last together, so that a filter without these does not trust too much."""
    return estimate.scatter * np.sqrt(1.0 + colour_ratio(estimate))
