"""Bands of 90 %, what a system is whose true motion they shall hold, and the priors of a process noise that is not."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Bool, Float, PRNGKeyArray

from symplearn._noise import AdditiveGaussian, LogVariance, ScaledIdentity
from symplearn._parameters import Learnt, Positive
from symplearn._posterior import Posterior
from symplearn._prior import AbstractDensity, HalfNormal, Normal, Prior

LEVEL = 0.9
DRAWS = 500
Paths = dict[str, Float[np.ndarray, "draw time channel"]]


class System(NamedTuple):
    """A true motion, and a function from seed, repeat and key to a posterior and to its draws' paths, by ways to
    predict.

    `times` are those at which the bands are held against `truth` (time, channel); the readings end at `read_until`.
    """

    times: Float[np.ndarray, " time"]
    read_until: float
    truth: Callable[[], Float[np.ndarray, "time channel"]]
    predicted: Callable[[int, int, PRNGKeyArray], tuple[Posterior, Paths]]
    ways: tuple[str, ...]
    settings: str


def inside(
    paths: Float[np.ndarray, "draw time channel"], true: Float[np.ndarray, "time channel"]
) -> Bool[np.ndarray, "time channel"]:
    """Whether the middle 90 % of the draws hold the truth.

    Quantiles of Weibull, k / (n + 1): a truth that is one more draw is held with a probability of 90 % exactly.
    """
    low, high = band(paths)
    return (low <= true) & (true <= high)


def band(paths: Float[np.ndarray, "draw time channel"]) -> Float[np.ndarray, "2 time channel"]:
    """The 5 % and the 95 % quantile."""
    return np.quantile(paths, [0.5 - 0.5 * LEVEL, 0.5 + 0.5 * LEVEL], axis=0, method="weibull")


class Disturbance(NamedTuple):
    """A process noise with its prior: its variance as it is written, and the density of it, None where it is known.

    Both are made when they are asked for: numbers of JAX that are made at import are of single precision.
    """

    variance: Callable[[], Any]
    density: Callable[[], AbstractDensity | None]

    def noise(self, dim: int) -> AdditiveGaussian:
        """The noise of a state."""
        return AdditiveGaussian(ScaledIdentity(self.variance(), dim))

    def prior(self, dynamics: AbstractDensity) -> Prior:
        """The prior, with that of the readings' variance as in the dissertation."""
        densities, own = {"dynamics": dynamics, "measurement_noise": HalfNormal(1.0)}, self.density()
        return Prior(densities if own is None else {**densities, "process_noise": own})


PUBLISHED = Disturbance(lambda: Positive(1e-3), lambda: HalfNormal(1.0))
# From 4e-11 to 2e-2 within two standard deviations.
LOGARITHM = Disturbance(lambda: LogVariance(Learnt(-8.0)), lambda: Normal(-14.0, 25.0))
NONE = Disturbance(lambda: 0.0, lambda: None)


def process_noise(posterior: Posterior) -> float:
    """The median of the process noise's variance; 0 where it is known to be."""
    for name, value in posterior.values.items():
        if name.startswith("process_noise"):
            return float(np.median(np.exp(value) if name.endswith("log_variance") else value))
    return 0.0


def told(*parts: Any) -> str:
    """Densities and samplers with all their numbers, to six digits: what a file hangs on."""
    # A prior that is made at import is of single precision, or of double where that is on already: one to the file.
    numbers = jax.tree.map(lambda leaf: np.vectorize(lambda x: float(f"{x:.6g}"))(leaf).tolist(), parts)
    return eqx.tree_pformat(numbers, width=1000)
