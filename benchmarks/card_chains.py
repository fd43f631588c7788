"""Value and gradient of 10,000 chains at once on a graphics card: Henon-Heiles, n 20, 20 substeps, 11 parameters.

    python -m benchmarks.card_chains quick|whole FILE

In double and in single precision, and on one core of the same machine's processor, some of them.
"""

import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from ._card import PRECISIONS, elsewhere, limits, seconds_of, told
from ._figures import seconds_told
from ._row import Effort, Line

CHAINS, QUICK, BESIDE, ROUNDS = 10_000, 256, 64, 10


def measure(effort: Effort) -> dict[str, Any]:
    """Both precisions, and the processor."""
    with tempfile.TemporaryDirectory(prefix="benchmarks-") as folder:
        files = {precision: Path(folder) / f"{precision}.npz" for precision in PRECISIONS}
        found = {precision: elsewhere("card_chains", effort, precision, str(file)) for precision, file in files.items()}
        double, single = (np.load(files[precision]) for precision in PRECISIONS)
        error = _error(double, single)
        core = elsewhere("card_chains", effort, "float64", str(Path(folder) / "core.npz"), platform="cpu")
    lines = [_line(precision, one, core, error) for precision, one in found.items()]
    return {"lines": lines, "precisions": found, "processor": core, "error_of_float32": error}


def _error(double: Any, single: Any) -> dict[str, float]:
    """Of single precision: in nats, and of a gradient by its largest entry."""
    value = np.abs(double["value"] - single["value"])
    scale = np.max(np.abs(double["gradient"]), axis=1)
    gradient = np.max(np.abs(double["gradient"] - single["gradient"]), axis=1) / scale
    return {
        "value_median": float(np.median(value)),
        "value_largest": float(np.max(value)),
        "gradient_median": float(np.median(gradient)),
        "gradient_largest": float(np.max(gradient)),
    }


def _line(precision: str, found: dict[str, Any], core: dict[str, Any], error: dict[str, float]) -> Line:
    share = found["operations"] / found["gradient_seconds"] / found["limits"]["operations_a_second"]
    said = f"{seconds_told(found['value_seconds'])} for values, {100 * share:.2g} % of the card's operations"
    if precision == "float32":
        said += (
            f"; off by {error['value_median']:.1g} nats in the median, {error['value_largest']:.1g} at most, gradients "
            f"by {error['gradient_median']:.1g} and {error['gradient_largest']:.1g} of their largest entry"
        )
    ours, other = found["gradient_seconds"] / found["chains"], core["gradient_seconds"] / core["chains"]
    return Line(
        f"value and gradient of {found['chains']} Henon-Heiles chains, n 20, 20 substeps, {precision}",
        "one core of the same machine, float64, machine code",
        f"{seconds_told(found['gradient_seconds'])}; a chain {other / ours:.3g}x; {said}",
        ours=seconds_told(ours),
        other=seconds_told(other),
        compiling=f"{seconds_told(found['compiling_seconds'])} / {seconds_told(core['compiling_seconds'])}",
    )


def _in_process(quick: bool, file: Path) -> dict[str, Any]:
    import jax
    import jax.numpy as jnp

    from ._cases import henon_heiles, learnt_gradient
    from ._contest import compiled
    from ._operations import operations

    case, on_card = henon_heiles(20, 5.0, 20), jax.default_backend() == "gpu"
    count = QUICK if quick else CHAINS if on_card else BESIDE
    # Half a standard deviation of the posterior apart, about.
    spread = 1e-3 * np.random.default_rng(0).normal(size=(count, case.free.size))
    at = case.free + jnp.asarray(spread, case.free.dtype), case.series.readings
    both = jax.vmap(learnt_gradient(case.score), (0, None))
    gradient, value = compiled(both, *at), compiled(jax.vmap(case.score, (0, None)), *at)
    values, slopes = gradient()
    np.savez(file, value=np.asarray(values, float), gradient=np.asarray(slopes, float))
    return {
        "chains": count,
        "gradient_seconds": seconds_of(gradient.call, ROUNDS),
        "value_seconds": seconds_of(value.call, ROUNDS),
        "compiling_seconds": gradient.compiling,
        "operations": count * operations(jax.value_and_grad(case.score), case.free, case.series.readings),
        "limits": limits(),
    }


if __name__ == "__main__":
    told(_in_process(sys.argv[1] == "quick", Path(sys.argv[2])))
