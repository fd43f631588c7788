"""What a simulation file says, as frozen records (contract, section 1)."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import sympy

from ._expression import Expression, symbol


@dataclass(frozen=True)
class Quantity:
    """A number that is known, or calibrated from a starting value and what is known of it.

    With `sd` the prior is Gaussian of mean `value`; without, it is flat and `value` is the starting guess.
    """

    value: float
    known: bool = True
    sd: float | None = None
    positive: bool = False
    lower: float | None = None
    upper: float | None = None


@dataclass(frozen=True)
class Term:
    """Physics already added: one of the effects of the contract's section 3 on its targets.

    `target` has two names for an effect between two coordinates, otherwise one. `recordings` is `None` where
    the term is in all of them. `memory` is what an unnamed force remembers: the rate of change of every further name
    that its expression uses.
    """

    effect: str
    target: tuple[str, ...]
    coefficients: Mapping[str, Quantity]
    side: str | None = None
    expression: Expression | None = None
    recordings: tuple[int, ...] | None = None
    memory: Mapping[str, Expression] = field(default_factory=dict)


@dataclass(frozen=True)
class RecordingSection:
    """Which rows and columns of a recording are used, and what they show."""

    time: str
    observe: Mapping[str, Expression]
    noise: Mapping[str, float] = field(default_factory=dict)
    inputs: tuple[str, ...] = ()
    interpolation: str = "hold"
    start: float | Mapping[str, float] | None = None
    end: float | Mapping[str, float] | None = None
    group: tuple[str, ...] = ()
    where: Mapping[str, str | float] = field(default_factory=dict)


@dataclass(frozen=True)
class IntegratorSection:
    """`name` is auto, leapfrog or tao; `step` the largest step, in the unit of time."""

    name: str = "auto"
    step: float | None = None


@dataclass(frozen=True)
class SimulationFile:
    """Everything a simulation file says, checked, with its expressions parsed.

    `name` is the file's name for sentences and takes no part in comparisons.
    """

    name: str = field(compare=False)
    coordinates: tuple[str, ...]
    momenta: tuple[str, ...]
    hamiltonian: Expression
    recording: RecordingSection
    title: str = ""
    parameters: Mapping[str, Quantity] = field(default_factory=dict)
    initial: Mapping[str, Quantity] = field(default_factory=dict)
    forces: Mapping[str, Expression] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)
    integrator: IntegratorSection = IntegratorSection()
    terms: tuple[Term, ...] = ()

    @property
    def states(self) -> tuple[str, ...]:
        """Coordinates, then momenta."""
        return self.coordinates + self.momenta

    @property
    def names(self) -> tuple[str, ...]:
        """Every declared name, in the order state, parameters, inputs."""
        return self.states + tuple(self.parameters) + self.recording.inputs

    @property
    def symbols(self) -> dict[str, sympy.Symbol]:
        """The symbol of every declared name and of `t`."""
        return {name: symbol(name) for name in (*self.names, "t")}

    @property
    def unknowns(self) -> int:
        """How many numbers of parameters and terms are calibrated."""
        coefficients = [c for term in self.terms for c in term.coefficients.values()]
        return sum(not q.known for q in [*self.parameters.values(), *coefficients])

    @property
    def unknown_states(self) -> int:
        """How many initial states of one recording are not known exactly."""
        return sum(not (s in self.initial and self.initial[s].known) for s in self.states)
