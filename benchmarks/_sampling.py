"""What a posterior costs: processor time to so many effective draws, of symplearn and of corrected DRAM."""

import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PRNGKeyArray

import symplearn as sl
from symplearn._parameters import flatten
from symplearn._posterior import log_posterior_of, posterior_of
from symplearn._sampler import Drawn
from symplearn._whitening import whiten

from ._contest import Contender, Spread, compiled, compiled_by_xla
from ._figures import seconds_told
from ._row import Effort, Line, tell

EFFECTIVE = 400.0
# The dissertation's chain. A shorter one is run, and its time and its effective draws are scaled to this.
STEPS, SHORT, QUICK = 200_000, 20_000, 2_000
_PARETO_K = 0.7


def measured(what: str, estimate: sl.Estimate, sampler: Any, goal: float, effort: Effort) -> dict[str, Any]:
    """Both on the posterior around an estimate, after it and after compilation. For JSON, with lines.

    Ours has all that `sample` does, the chain of DRAM only its own steps: the covariance of its first proposals is
    given to it.
    """
    ours = _ours(what, estimate, sampler, 2 if effort.quick else 5)
    steps = QUICK if effort.quick else SHORT
    theirs = _theirs(what, estimate, steps, compiled_by_xla)
    swift = _theirs(what, estimate, steps, compiled)
    lines = [*_lines(what, ours, theirs, goal), _line_of_swift(what, ours, swift)]
    return {"lines": lines, "symplearn": ours, "dram": theirs, "dram by machine code": swift}


def _ours(what: str, estimate: sl.Estimate, sampler: Any, rounds: int) -> dict[str, Any]:
    times, draws = [], []
    for k in range(rounds + 1):
        tell(f"{what}: {type(sampler).__name__}, {'with compiling' if k == 0 else f'round {k}'}")
        worked = time.process_time()
        posterior = sl.sample(estimate, sampler=sampler, key=jax.random.key(k))
        times.append(time.process_time() - worked)
        draws.append(posterior)
    effective = [one.diagnostics.least_ess for one in draws[1:]]
    return {
        "sampler": draws[0].sampler,
        "first_cpu_seconds": times[0],
        "cpu_seconds": Spread.of(times[1:])._asdict(),
        "effective": Spread.of(effective)._asdict(),
        # Those of fewer than asked for are charged for the rest, those of more are not given it back.
        "to_effective": Spread.of(
            [t * max(1.0, EFFECTIVE / e) for t, e in zip(times[1:], effective, strict=True)]
        )._asdict(),
        "pareto_k": max((one.drawn.pareto_k or 0.0) for one in draws[1:]),
        "evaluations": int(np.median([one.drawn.evaluations for one in draws[1:]])),
        "converged": [one.converged for one in draws[1:]],
    }


def _theirs(what: str, estimate: sl.Estimate, steps: int, way: Callable[..., Contender]) -> dict[str, Any]:
    """One chain from the mode, its second half kept, as the dissertation's; by symplearn's corrected kernel."""
    density = log_posterior_of(estimate)
    start = whiten(density, flatten(estimate.model)[0])
    kernel = sl.dram(density, start.root @ start.root.T)

    def chain(key: PRNGKeyArray) -> tuple[Array, Array]:
        def step(state: Any, key: PRNGKeyArray) -> tuple[Any, tuple[Array, Array]]:
            state, _ = kernel.step(key, state)
            return state, (state.position, state.log_density)

        return jax.lax.scan(step, kernel.init(start.centre), jax.random.split(key, steps))[1]

    tell(f"{what}: compiling DRAM")
    program = way(chain, jax.random.key(1))
    tell(f"{what}: DRAM, {steps} steps for {STEPS}")
    worked = time.process_time()
    kept = [rows[steps // 2 :] for rows in program()]
    seconds = (time.process_time() - worked) * STEPS / steps
    # Its halves as two chains: a drift between them costs effective draws, as it should.
    free, log_density = (jnp.reshape(rows, (2, -1, *rows.shape[1:])) for rows in kept)
    drawn = Drawn(free, log_density, evaluations=2 * steps)
    effective = posterior_of(estimate, drawn, "DRAM").diagnostics.least_ess * STEPS / steps
    return {
        "steps": steps,
        "scaled_to_steps": STEPS,
        "cpu_seconds": seconds,
        "effective": effective,
        "to_effective": seconds * EFFECTIVE / effective,
    }


def _line_of_swift(what: str, ours: dict[str, Any], swift: dict[str, Any]) -> Line:
    """Against a chain whose likelihoods are machine code as well."""
    own, seconds = ours["to_effective"]["median"], swift["to_effective"]
    return Line(
        f"{what} to {EFFECTIVE:g} effective draws, processor time after mode and compilation",
        f"corrected DRAM to {EFFECTIVE:g}, its likelihoods machine code as well, scaled from {swift['steps']} steps",
        f"{seconds / own:.3g}x",
        "",
        None,
        ours=seconds_told(own),
        other=seconds_told(seconds),
    )


def _lines(what: str, ours: dict[str, Any], theirs: dict[str, Any], goal: float) -> list[Line]:
    own, fine = ours["to_effective"]["median"], ours["converged"]
    told = f"Pareto k up to {ours['pareto_k']:.2f}; {sum(fine)} of {len(fine)} posteriors converged"
    lines: list[Line] = []
    for against, seconds in (
        (f"corrected DRAM to {EFFECTIVE:g}, scaled from {theirs['steps']} steps", theirs["to_effective"]),
        (f"corrected DRAM, all {STEPS} steps ({theirs['effective']:.0f} effective), scaled", theirs["cpu_seconds"]),
    ):
        first = not lines
        lines.append(
            Line(
                f"{what} to {EFFECTIVE:g} effective draws, processor time after mode and compilation",
                against,
                f"{seconds / own:.3g}x; {told}",
                f"{goal:g}x" if first else "",
                (seconds / own >= goal and ours["pareto_k"] < _PARETO_K) if first else None,
                ours=seconds_told(own),
                other=seconds_told(seconds),
                compiling=f"first {seconds_told(ours['first_cpu_seconds'])}",
            )
        )
    return lines
