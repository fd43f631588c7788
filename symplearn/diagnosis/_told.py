"""The numbers and expressions of what was found, as they are told."""

from collections.abc import Mapping
from functools import cached_property
from typing import Any

import numpy as np

from .._effects import Candidate
from .._expression import Expression
from .._simulation_records import SimulationFile
from ._calibrate import Priors
from ._coefficients import coefficients
from ._memories import written_memory
from ._problem import Problem
from ._unnamed import written
from ._weighed import Estimate


class Told:
    """What an estimate says of its combination; `spread` multiplies its covariance."""

    def __init__(self, file: SimulationFile, problem: Problem, priors: Priors, estimate: Estimate, spread: float):
        self.file, self.problem, self.priors, self.estimate, self.spread = file, problem, priors, estimate, spread

    @cached_property
    def coefficients(self) -> dict[int, dict[str, Any]]:
        """Those of every finding that has a name, or fades, by member."""
        named = [m for m in self.estimate.combination if self._has_numbers(self.problem.candidate(m))]
        return {m: coefficients(self.problem, self.priors, self.estimate, m, self.spread) for m in named}

    @cached_property
    def values(self) -> dict[int, dict[str, float]]:
        """Point values of the coefficients of what has a name."""
        named = {m: told for m, told in self.coefficients.items() if self.problem.candidate(m).nameless is None}
        return {m: {name: one["mean"] for name, one in told.items()} for m, told in named.items()}

    @cached_property
    def expressions(self) -> dict[int, dict[Candidate, Expression]]:
        """Forces without a name, by member and what is told of it on each coordinate."""
        places = self.problem.placed(self.estimate.combination)
        ones = [(m, self.problem.candidate(m).told(), self.estimate.z[place]) for m, place in places]
        found = {m: {one: written(one.nameless.pushes[0], sizes) for one in told if one.nameless}
                 for m, told, sizes in ones if told[0].nameless and not told[0].nameless.memory}  # fmt: skip
        return found | {m: {self.problem.candidate(m): force} for m, (force, _) in self._fading.items()}

    @cached_property
    def memories(self) -> dict[int, Mapping[str, Expression]]:
        """What those that fade remember, by member: the rate of change of every name that is not the simulation's."""
        return {m: rates for m, (_, rates) in self._fading.items()}

    def of(self, member: int, one: Candidate) -> dict[str, Any]:
        """Coefficients of a finding on one coordinate; of a force without a name its expression, and how well its size
        is known where it has one."""
        if one.nameless is None:
            return self.coefficients[member]
        texts = self.coefficients.get(member, {}) | self._texts(member, one)
        if one.effect.amplitudes > 1 or member in self.memories:
            return texts
        place = dict(self.problem.placed(self.estimate.combination))[member]
        sd = np.sqrt(self.estimate.covariance[place, place].item() * self.spread)
        return texts | {"relative_sd": float(sd / max(abs(self.estimate.z[place].item()), 1e-300))}

    @cached_property
    def _fading(self) -> dict[int, tuple[Expression, Mapping[str, Expression]]]:
        out = {}
        for m in self.estimate.combination:
            if (force := self.problem.candidate(m).nameless) and force.memory:
                sizes = [self.coefficients[m][name]["mean"] for name in force.memory.coefficients]
                out[m] = written_memory(self.file, force.memory, self.file.coordinates[force.places[0]], sizes)
        return out

    def _texts(self, member: int, one: Candidate) -> dict[str, Any]:
        """A force without a name, and what it remembers, if anything."""
        rates = [f"d{name}/dt = {rate.text}" for name, rate in self.memories.get(member, {}).items()]
        return {"expression": self.expressions[member][one].text} | ({"memory": ", ".join(rates)} if rates else {})

    @staticmethod
    def _has_numbers(one: Candidate) -> bool:
        """Whether a finding is told by its coefficients, and not by an expression alone."""
        return one.nameless is None or one.nameless.memory is not None
