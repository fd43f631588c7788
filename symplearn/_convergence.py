"""Whether draws can be trusted: R-hat, effective sample sizes and what Hamiltonian trajectories say, as values."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from ._arviz import arviz, inference_data
from ._sampler import NEGLIGIBLE, Drawn

# Vehtari et al. (2021), Bayesian Analysis 16, 667.
_R_HAT = 1.01
_ESS = 400
# Above it the error of an importance sampling mean has no useful bound. Vehtari et al. (2024), JMLR 25, 72.
_PARETO_K = 0.7
# Betancourt (2016), arXiv:1604.00695.
_E_BFMI = 0.3
# A larger share of divergent trajectories leaves out a part of the posterior that matters.
_DIVERGENT = 0.01


@dataclass(frozen=True)
class Diagnostics:
    """What says whether draws stand for their density; None where the sampler has no such thing.

    `r_hat`, `ess_bulk` and `ess_tail` hold, by name, a number for each entry of a value, of ranks. `stuck` is the
    number of chains that stayed where they were. `divergences` counts trajectories that left the energy's
    surface, `e_bfmi` is the energy's mixing of each chain, `pareto_k` the tail of importance weights.
    `problems` holds a sentence for each fault, with what to try.
    """

    r_hat: dict[str, np.ndarray]
    ess_bulk: dict[str, np.ndarray]
    ess_tail: dict[str, np.ndarray]
    stuck: int
    accepted: float | None
    divergences: int | None
    e_bfmi: np.ndarray | None
    pareto_k: float | None
    problems: tuple[str, ...]

    @property
    def converged(self) -> bool:
        """Whether nothing speaks against the draws."""
        return not self.problems

    @property
    def worst_r_hat(self) -> float:
        """The largest R-hat; NaN where one is not a number."""
        return float(np.max(_flat(self.r_hat)))

    @property
    def least_ess(self) -> float:
        """The smallest effective sample size, of bulk and tail."""
        return float(min(np.min(_flat(self.ess_bulk)), np.min(_flat(self.ess_tail))))

    def __str__(self) -> str:
        head = f"R-hat at most {self.worst_r_hat:.3f}, effective sample size at least {self.least_ess:.0f}"
        extra = [] if self.pareto_k is None else [f"Pareto k {self.pareto_k:.2f}"]
        if self.divergences is not None:
            extra.append(f"{self.divergences} divergences")
        if self.e_bfmi is not None:
            extra.append(f"E-BFMI at least {np.min(self.e_bfmi):.2f}")
        verdict = "Converged." if self.converged else "NOT CONVERGED: " + " ".join(self.problems)
        return f"{', '.join([head, *extra])}. {verdict}"


def diagnose_draws(values: Mapping[str, Any], drawn: Drawn) -> Diagnostics:
    """The diagnostics of values (chain, draw, ...) by name, through ArviZ."""
    arrays = {name: np.asarray(value) for name, value in values.items()}
    data = inference_data(arrays, {}, {}).posterior
    with np.errstate(all="ignore"):
        r_hat, bulk, tail = (
            {name: np.asarray(one[name]) for name in arrays}
            for one in (arviz().rhat(data), arviz().ess(data), arviz().ess(data, method="tail"))
        )
    free = np.asarray(drawn.free)
    stuck = int(np.sum(np.all(free == free[:, :1], axis=(1, 2))))
    divergences = None if drawn.divergent is None else int(np.sum(drawn.divergent))
    e_bfmi = None if drawn.energy is None else np.asarray(arviz().bfmi(np.asarray(drawn.energy)))
    facts = Diagnostics(r_hat, bulk, tail, stuck, drawn.accepted, divergences, e_bfmi, drawn.pareto_k, ())
    return Diagnostics(**vars(facts) | {"problems": _problems(facts, drawn)})


def _flat(by_name: Mapping[str, np.ndarray]) -> np.ndarray:
    return np.concatenate([np.ravel(value) for value in by_name.values()])


def _problems(facts: Diagnostics, drawn: Drawn) -> tuple[str, ...]:
    chains, draws = drawn.free.shape[:2]
    found = []
    if facts.stuck:
        found.append(f"{facts.stuck} of {chains} chains never moved: start nearer to the mode, or take shorter steps.")
    # Not `>`: NaN is a fault.
    if not facts.worst_r_hat <= _R_HAT:
        found.append(
            f"The chains disagree: R-hat of {_worst(facts.r_hat)} is {facts.worst_r_hat:.3f}, above {_R_HAT}; draw "
            "more, or look for a second mode with a wide `TemperedSMC`."
        )
    if not facts.least_ess >= _ESS:
        found.append(f"The draws are worth {facts.least_ess:.0f} independent ones, fewer than {_ESS}; draw more.")
    heavy = facts.pareto_k is not None and not facts.pareto_k <= _PARETO_K
    if heavy and (drawn.largest_weight or 0.0) > NEGLIGIBLE:
        found.append(
            f"A few draws carry the weight (Pareto k {facts.pareto_k:.2f}, above {_PARETO_K}): what they were drawn "
            "from misses a part of the density; sample with `AdaptiveImportance`, there with more `rounds` or a larger "
            "`batch`, or with `RandomWalk` or `NUTS`."
        )
    if facts.divergences is not None and facts.divergences > _DIVERGENT * chains * draws:
        found.append(
            f"{facts.divergences} of {chains * draws} trajectories diverged: raise the `acceptance` towards 1, or "
            "sample with `RandomWalk`."
        )
    if facts.e_bfmi is not None and not np.min(facts.e_bfmi) >= _E_BFMI:
        found.append(
            f"The energy mixes slowly (E-BFMI {np.min(facts.e_bfmi):.2f}, below {_E_BFMI}): the tails are heavy; draw "
            "more, or sample with `AdaptiveImportance`."
        )
    return tuple(found)


def _worst(r_hat: Mapping[str, np.ndarray]) -> str:
    # NaN is the worst: `argmax` finds it first.
    names, flat = labels(r_hat), _flat(r_hat)
    return f"`{names[int(np.argmax(flat))]}`"


def labels(values: Mapping[str, Any], leading: int = 0) -> list[str]:
    """A name for each number in values by name, past their leading axes: `a[0]`, `a[1]`, `b`."""
    found = []
    for name, value in values.items():
        shape = np.shape(value)[leading:]
        found += [name + (f"[{','.join(map(str, at))}]" if at else "") for at in np.ndindex(*shape)]
    return found
