"""The Kalman filter with all readings side by side, and one after the other, on a graphics card: a damped oscillator.

    python -m benchmarks.card_kalman quick|whole PASSAGE

The parallel filter's depth grows as log n, the other's as n. The same on one core of the same machine's processor.
"""

import sys
from typing import Any

from ._card import elsewhere, seconds_of, told
from ._figures import seconds_told
from ._row import Disagreement, Effort, Line

SIZES, QUICK = (1_000, 10_000, 100_000, 1_000_000), (100, 1_000)
# On a card the sequential filter's gradient takes minutes for more.
LONGEST, NEAR = 10_000, 1e-10


def measure(effort: Effort) -> dict[str, Any]:
    """Both passages on the card, and the sequential one on the processor."""
    found = {
        "parallel": elsewhere("card_kalman", effort, "float64", "parallel"),
        "sequential": elsewhere("card_kalman", effort, "float64", "sequential"),
        "processor": elsewhere("card_kalman", effort, "float64", "sequential", platform="cpu"),
    }
    for size, one in found["parallel"].items():
        for way in ("sequential", "processor"):
            if size in found[way]:
                _agree(size, one, found[way][size])
    return {"lines": [_line(size, found) for size in found["parallel"]], "passages": found}


def _agree(size: str, ours: dict[str, Any], other: dict[str, Any]) -> None:
    """**Raises:** `Disagreement` where value or gradient differ."""
    for what in ("value", "slope"):
        off = abs(ours[what] - other[what]) / abs(other[what])
        if not off <= NEAR:
            raise Disagreement(f"the {what} of n {size} is off by {off:.2g}, more than {NEAR:g}")


def _line(size: str, found: dict[str, Any]) -> Line:
    one = found["parallel"][size]
    said = f"{seconds_told(one['gradient_seconds'])} with the gradient, {seconds_told(one['value_seconds'])} without"
    for way, name in (("sequential", "one after the other"), ("processor", "on a core of the processor")):
        other = found[way].get(size)
        if other is not None:
            ratio = other["gradient_seconds"] / one["gradient_seconds"]
            said += f"; {name} {seconds_told(other['gradient_seconds'])}, {ratio:.3g}x"
    return Line(f"Kalman filter with n {size} side by side, 2 states, float64", "itself in other ways", said,
                compiling=seconds_told(one["compiling_seconds"]))  # fmt: skip


def _in_process(quick: bool, passage: str) -> dict[str, Any]:
    import jax

    from ._contest import compiled

    by_size: dict[str, Any] = {}
    most = LONGEST if passage == "sequential" and jax.default_backend() == "gpu" else max(SIZES)
    for n in QUICK if quick else [n for n in SIZES if n <= most]:
        score, at = _oscillator(n, passage)
        gradient, value = compiled(jax.value_and_grad(score), *at), compiled(score, *at)
        found = [float(one) for one in gradient()]
        by_size[str(n)] = {
            "value": found[0],
            "slope": found[1],
            "gradient_seconds": seconds_of(gradient.call, 3),
            "value_seconds": seconds_of(value.call, 3),
            "compiling_seconds": gradient.compiling,
        }
    return by_size


def _oscillator(n: int, passage: str) -> tuple[Any, Any]:
    """Minus the log likelihood of the frequency, and a frequency with readings of the place every 0.1 s."""
    import jax
    import jax.numpy as jnp
    import numpy as np

    import symplearn as sl

    rate, noise, every = 0.05, 0.1, 0.1
    chance, times = np.random.default_rng([0, n]), every * np.arange(n)
    readings = np.sin(times) + noise * chance.normal(size=n)
    by = sl.MarginalLikelihood(passage=sl.ParallelInTime() if passage == "parallel" else sl.Sequential())

    def score(frequency: Any, readings: Any) -> Any:
        field = jnp.array([[0.0, 1.0], [0.0, -2.0 * rate]]) - frequency**2 * jnp.array([[0.0, 0.0], [1.0, 0.0]])
        model = sl.StateSpaceModel(
            sl.LinearDynamics(jax.scipy.linalg.expm(every * field)),
            sl.LinearObservation(jnp.eye(2)[:1]),
            sl.AdditiveGaussian(sl.Dense(1e-2 * jnp.eye(2))),
            sl.AdditiveGaussian(sl.ScaledIdentity(noise**2, 1)),
            sl.Gaussian(jnp.array([0.0, 1.0]), 0.1 * jnp.eye(2)),
        )
        return by.score(model, sl.TimeSeries(jnp.asarray(times), readings))

    return score, (jnp.asarray(1.0), jnp.asarray(readings[:, None]))


if __name__ == "__main__":
    told(_in_process(sys.argv[1] == "quick", sys.argv[2]))
