"""The vocabulary of left-out physics: what each effect adds, its coefficient, its family.

Every effect here is linear in its one coefficient, so a zero coefficient is the simulation itself and one
compiled model serves every combination (contract, section 3).
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass

import sympy


@dataclass(frozen=True)
class AbstractEffect(ABC):
    """One word of the vocabulary. `positive` says that only a positive coefficient is physical."""

    name: str
    family: str
    coefficient: str
    positive: bool = False

    @property
    @abstractmethod
    def acts_on(self) -> str:
        """`coordinate` for an effect of the dynamics, `column` for an effect of the sensor."""


@dataclass(frozen=True)
class PowerForce(AbstractEffect):
    """A conservative force that is a power of the coordinate: F = sign * c q^power."""

    power: int = 0
    sign: int = -1

    @property
    def acts_on(self) -> str:
        return "coordinate"

    def force(self, q: sympy.Expr) -> sympy.Expr:
        """Force per unit coefficient."""
        return sympy.Integer(self.sign) * q**self.power

    def potential(self, q: sympy.Expr) -> sympy.Expr:
        """Potential energy per unit coefficient, so that the force is minus its slope."""
        return sympy.Rational(-self.sign, self.power + 1) * q ** (self.power + 1)


@dataclass(frozen=True)
class Drag(AbstractEffect):
    """A force against the velocity: F = -c |v|^(power - 1) v; power 0 is dry (Coulomb) friction."""

    power: int = 1

    @property
    def acts_on(self) -> str:
        return "coordinate"


@dataclass(frozen=True)
class SensorError(AbstractEffect):
    """An error of the reading: `bias` adds b, `gain` multiplies by 1 + g."""

    @property
    def acts_on(self) -> str:
        return "column"


VISCOUS = Drag("viscous_damping", "dissipation", "c", positive=True, power=1)
QUADRATIC = Drag("quadratic_drag", "dissipation", "c", positive=True, power=2)
COULOMB = Drag("coulomb_friction", "dissipation", "f", positive=True, power=0)
DRAGS = (VISCOUS, QUADRATIC, COULOMB)
POWERS = (
    PowerForce("constant_force", "conservative", "f", power=0, sign=1),
    PowerForce("linear_stiffness", "conservative", "k", power=1),
    PowerForce("quadratic_stiffness", "conservative", "k", power=2),
    PowerForce("cubic_stiffness", "conservative", "k", power=3),
)
BIAS = SensorError("sensor_bias", "sensor", "b")
GAIN = SensorError("sensor_gain", "sensor", "g")
SENSORS = (BIAS, GAIN)
EFFECTS: dict[str, AbstractEffect] = {e.name: e for e in (*DRAGS, *POWERS, *SENSORS)}


@dataclass(frozen=True)
class Candidate:
    """An effect on a target: one entry of the coefficient vector of the augmented model."""

    effect: AbstractEffect
    target: str
    place: int  # which coordinate or column the target is

    @property
    def key(self) -> tuple[str, str]:
        """Effect name and target, as they stand in the answer."""
        return self.effect.name, self.target

    def __str__(self) -> str:
        return f"{self.effect.name}({self.target})"


def vocabulary(coordinates: Sequence[str], columns: Sequence[str]) -> tuple[Candidate, ...]:
    """Every effect on every target of a system, in the order of the coefficient vector."""
    moving = [Candidate(e, q, i) for i, q in enumerate(coordinates) for e in (*POWERS, *DRAGS)]
    reading = [Candidate(e, c, j) for j, c in enumerate(columns) for e in SENSORS]
    return (*moving, *reading)


def prices(candidates: Sequence[Candidate], families: Sequence[str]) -> dict[int, float]:
    """Prior price of each candidate: shared by families, then effects, then targets (contract, section 4).

    **Arguments:** - `candidates`: those that are weighed. - `families`: the families that share the prior;
    one that holds no candidate (the unexplained) keeps its share to itself.
    """
    price = {}
    for index, one in enumerate(candidates):
        kin = {c.effect.name for c in candidates if c.effect.family == one.effect.family}
        targets = sum(c.effect is one.effect for c in candidates)
        price[index] = 1.0 / (len(families) * len(kin) * targets)
    return price
