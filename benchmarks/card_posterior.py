"""The posterior of Henon-Heiles by 10,000 chains of random-walk Metropolis at once on a graphics card.

    python -m benchmarks.card_posterior quick|whole

On one core of the same machine's processor 64 chains, as the library runs them there.
"""

import sys
import time
from typing import Any

from ._card import elsewhere, told
from ._figures import seconds_told
from ._row import Effort, Line

# Chains on the card, in a quick run, and on the processor; steps, every hundredth of which is kept.
CHAINS, QUICK, BESIDE = 10_000, 64, 64
STEPS, THIN, QUICK_STEPS = 2_000, 100, 400


def measure(effort: Effort) -> dict[str, Any]:
    """Double precision."""
    found = {
        where: elsewhere("card_posterior", effort, "float64", platform=platform)
        for where, platform in (("card", ""), ("processor", "cpu"))
    }
    one, other = found["card"], found["processor"]
    line = Line(
        f"posterior of Henon-Heiles, 11 parameters, {one['chains']} chains of {one['steps']} steps, float64",
        f"{other['chains']} chains on one core of the same machine",
        f"{one['effective'] / one['seconds']:.3g} effective draws a second in the worst direction, "
        f"{one['effective'] / one['seconds'] / (other['effective'] / other['seconds']):.3g}x; "
        f"R-hat {one['r_hat']:.3f} and {other['r_hat']:.3f}",
        ours=seconds_told(one["seconds"]),
        other=seconds_told(other["seconds"]),
        compiling=f"first {seconds_told(one['first_seconds'])}",
    )
    return {"lines": [line], "places": found}


def _in_process(quick: bool) -> dict[str, Any]:
    import jax

    import symplearn as sl
    from experiments import _henon_heiles_case as case

    chains = QUICK if quick else CHAINS if jax.default_backend() == "gpu" else BESIDE
    estimate = sl.learn(case.model("symplectic"), case.recording(0, 0), prior=case.PRIOR, key=jax.random.key(0))
    walk = sl.RandomWalk(chains=chains, steps=QUICK_STEPS if quick else STEPS, thin=THIN)
    times = []
    for k in range(2):
        began = time.perf_counter()
        posterior = sl.sample(estimate, sampler=walk, key=jax.random.key(k))
        times.append(time.perf_counter() - began)
    return {
        "chains": chains,
        "steps": walk.steps,
        "first_seconds": times[0],
        "seconds": times[1],
        "effective": posterior.diagnostics.least_ess,
        "r_hat": posterior.diagnostics.worst_r_hat,
    }


if __name__ == "__main__":
    told(_in_process(sys.argv[1] == "quick"))
