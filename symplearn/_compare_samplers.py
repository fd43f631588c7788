"""Which sampler to use for a posterior: measured on it, not chosen by fashion."""

import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass

import jax
import numpy as np
from jaxtyping import PRNGKeyArray

from ._errors import InputError
from ._fit import Estimate
from ._keys import refuse_key
from ._posterior import Posterior
from ._sample import sample
from ._sampler import AbstractSampler


@dataclass(frozen=True)
class Trial:
    """One sampler on one posterior: CPU `seconds` without compiling, `first` those of the first run, with it.

    `ess` is the least effective sample size of any number, bulk or tail; `evaluations` counts log densities, a gradient
    as two more (reverse mode costs two to four). `distance` is the largest difference of a mean from that of all
    trusted draws, in posterior standard deviations.
    """

    posterior: Posterior
    seconds: float
    first: float
    evaluations: int
    distance: float

    @property
    def ess(self) -> float:
        """The least effective sample size; 0 where it is not a number."""
        least = self.posterior.diagnostics.least_ess
        return least if least > 0 else 0.0

    @property
    def name(self) -> str:
        """The sampler with its options, on one line."""
        return " ".join(self.posterior.sampler.split())

    @property
    def per_second(self) -> float:
        """Effective draws per CPU second."""
        return self.ess / self.seconds

    @property
    def per_evaluation(self) -> float:
        """Effective draws per evaluation of the log density."""
        return self.ess / max(1, self.evaluations)


@dataclass(frozen=True)
class Comparison:
    """Samplers on the same posterior, in one run. `print` gives the table, the choice, and why."""

    trials: tuple[Trial, ...]

    @property
    def best(self) -> Trial | None:
        """The trusted sampler with the most effective draws per second; None where none can be trusted."""
        trusted = [one for one in self.trials if one.posterior.converged]
        return max(trusted, key=lambda one: one.per_second) if trusted else None

    def __str__(self) -> str:
        rows: list[tuple[str, ...]] = [
            ("sampler", "ESS", "CPU s", "with compiling", "ESS/s", "ESS/1000 evaluations", "off by", "trusted")
        ]
        rows += [_row(one) for one in self.trials]
        widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
        lines = ["  ".join(map(str.ljust, row, widths)).rstrip() for row in rows]
        return "\n".join([*lines, self._choice()])

    def _choice(self) -> str:
        best = self.best
        if best is None:
            return "No sampler can be trusted on this posterior; see `trials[k].posterior` for what each one lacks."
        others = [one for one in self.trials if one is not best and one.posterior.converged]
        if not others:
            return f"Choose {best.name}: the only one whose draws can be trusted here."
        next_best = max(others, key=lambda one: one.per_second)
        factor = best.per_second / next_best.per_second
        return (
            f"Choose {best.name}: {factor:.1f} times the effective draws per second of the next that can "
            f"be trusted, {next_best.name}."
        )


def compare_samplers(estimate: Estimate, samplers: Sequence[AbstractSampler], *, key: PRNGKeyArray) -> Comparison:
    """Draw from one posterior by each sampler, twice: once to compile, once on the clock of the processor.

    **Raises:** `InputError` where no sampler is given, and as `sample`.
    """
    if not isinstance(samplers, Sequence) or not samplers:
        raise InputError("`compare_samplers` needs a list of samplers, of at least one.")
    refuse_key(key)
    timed = []
    for k, sampler in enumerate(samplers):
        print(f"comparing: {type(sampler).__name__}, {k + 1} of {len(samplers)}", file=sys.stderr, flush=True)
        _, first = _clocked(estimate, sampler, jax.random.fold_in(key, 2 * k))
        timed.append((*_clocked(estimate, sampler, jax.random.fold_in(key, 2 * k + 1)), first))
    centre, sd = _pooled([posterior for posterior, _, _ in timed])
    trials = [
        Trial(p, seconds, first, p.drawn.evaluations + 2 * p.drawn.gradients, _distance(p, centre, sd))
        for p, seconds, first in timed
    ]
    return Comparison(tuple(trials))


def _clocked(estimate: Estimate, sampler: AbstractSampler, key: PRNGKeyArray) -> tuple[Posterior, float]:
    began = time.process_time()
    posterior = sample(estimate, sampler=sampler, key=key)
    return posterior, time.process_time() - began


def _pooled(posteriors: Sequence[Posterior]) -> tuple[np.ndarray, np.ndarray]:
    """Mean and standard deviation of the free coordinates over all trusted draws, or all draws where none are."""
    trusted = [one for one in posteriors if one.converged] or posteriors
    draws = [np.asarray(one.free).reshape(-1, one.free.shape[-1]) for one in trusted]
    # Each sampler counts as much as any other, however many draws it kept.
    mean = np.mean([one.mean(axis=0) for one in draws], axis=0)
    variance = np.mean([one.var(axis=0) for one in draws], axis=0)
    return mean, np.sqrt(variance)


def _distance(posterior: Posterior, centre: np.ndarray, sd: np.ndarray) -> float:
    mean = np.asarray(posterior.free).reshape(-1, len(centre)).mean(axis=0)
    return float(np.max(np.abs(mean - centre) / sd))


def _row(one: Trial) -> tuple[str, ...]:
    return (
        one.name.split("(")[0],
        f"{one.ess:.0f}",
        f"{one.seconds:.2f}",
        f"{one.first:.2f}",
        f"{one.per_second:.1f}",
        f"{1000 * one.per_evaluation:.2f}",
        f"{one.distance:.2f} sd",
        "yes" if one.posterior.converged else "NO",
    )
