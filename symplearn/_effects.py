"""The vocabulary of left-out physics as it is searched: what each effect's values are inside a fit.

Inside, every effect is given by values of which the first ones are amplitudes: at zero they are the simulation itself,
to which the effect adds in proportion. The others place it (a frequency, a time, a threshold). The coefficients of
the contract (section 3) are functions of them.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import sympy
from jaxtyping import Float

from ._vocabulary import COLUMN as COLUMN
from ._vocabulary import COORDINATE as COORDINATE
from ._vocabulary import PAIR as PAIR
from ._vocabulary import PARAMETER as PARAMETER
from ._vocabulary import VOCABULARY

Values = Float[np.ndarray, "... value"]


@dataclass(frozen=True)
class Effect:
    """One word of the vocabulary.

    **Arguments:** - `amplitudes`: how many of its values are amplitudes. - `places`: names of the values that follow.
    - `positive`: whether only positive amplitudes are physical. - `switched`: whether a further entry of the
    coefficient vector is 1 where the effect is present, which its amplitudes cannot tell.
    """

    name: str
    amplitudes: int = 1
    places: tuple[str, ...] = ()
    positive: bool = False
    switched: bool = False

    @property
    def kept_as(self) -> str:
        """What its values are kept under."""
        return self.name

    @property
    def family(self) -> str:
        return VOCABULARY[self.name].family

    @property
    def acts_on(self) -> str:
        """Coordinate, pair of coordinates, parameter or observed column."""
        return VOCABULARY[self.name].target

    @property
    def coefficients(self) -> tuple[str, ...]:
        """Names of the contract's coefficients."""
        return VOCABULARY[self.name].coefficients

    @property
    def size(self) -> int:
        """How many values it has inside a fit."""
        return self.amplitudes + len(self.places)

    @property
    def entries(self) -> int:
        """How many entries of the coefficient vector are its own."""
        return self.size + self.switched

    @property
    def is_additive(self) -> bool:
        """Whether a known effect and a found one simply add up, in one value."""
        return self.size == 1

    @property
    def is_dynamics(self) -> bool:
        return self.acts_on != COLUMN

    @property
    def swings(self) -> bool:
        """Whether it swings by itself, at a frequency among its values."""
        return "omega" in self.places

    def named(self, values: Values, origin: float) -> dict[str, Any]:
        """The contract's coefficients; `origin` is the time that phases inside are counted from."""
        return {name: values[..., k] for k, name in enumerate(self.coefficients)}

    def inner(self, named: Mapping[str, float], origin: float) -> np.ndarray:
        """The values inside, from the contract's coefficients."""
        return np.array([named[name] for name in self.coefficients], float)


@dataclass(frozen=True)
class PowerForce(Effect):
    """A conservative force that is a power of the coordinate: F = sign * c q^power."""

    power: int = 0
    sign: int = -1

    @property
    def acts_on(self) -> str:
        return COORDINATE

    def potential(self, q: sympy.Expr) -> sympy.Expr:
        """Potential energy per unit coefficient, so that the force is minus its slope."""
        return sympy.Rational(-self.sign, self.power + 1) * q ** (self.power + 1)


@dataclass(frozen=True)
class Drag(Effect):
    """A force against the velocity: F = -c |v|^(power - 1) v; power 0 is dry (Coulomb) friction."""

    power: int = 1


@dataclass(frozen=True)
class Oscillating(Effect):
    """a cos(omega t + phi), inside A cos(omega (t - origin)) + B sin(omega (t - origin)), omega.

    A further entry of the coefficient vector tells by how much its origin is later than that of all phases: where
    clocks lie far apart a phase counts from what the effect is in, or it hangs on the last digits of the frequency.
    """

    @property
    def entries(self) -> int:
        return self.size + 1

    def named(self, values: Values, origin: float) -> dict[str, Any]:
        cosine, sine, omega = np.moveaxis(np.asarray(values), -1, 0)
        # A negative frequency is the same cosine with the phase reversed.
        phase = np.sign(omega) * (np.arctan2(-sine, cosine) - omega * origin)
        wrapped = np.pi - np.mod(np.pi - phase, 2 * np.pi)
        # A phase a last digit above -pi is rounded to -pi, which is told as pi (contract).
        return {"a": np.hypot(cosine, sine), "omega": np.abs(omega), "phi": np.where(wrapped > -np.pi, wrapped, np.pi)}

    def inner(self, named: Mapping[str, float], origin: float) -> np.ndarray:
        phase = named["phi"] + named["omega"] * origin
        return np.array([named["a"] * np.cos(phase), -named["a"] * np.sin(phase), named["omega"]])


@dataclass(frozen=True)
class Drifting(Effect):
    """Grows evenly with t - t_0. A further entry of the coefficient vector tells by how much a recording's own t_0, its
    first row used, is later than the first recording's."""

    @property
    def entries(self) -> int:
        return self.size + 1


@dataclass(frozen=True)
class SelfExcitation(Effect):
    """F = c (1 - q^2/a^2) v, inside c v - e q^2 v."""

    def named(self, values: Values, origin: float) -> dict[str, Any]:
        c, e = np.moveaxis(np.asarray(values), -1, 0)
        with np.errstate(divide="ignore", invalid="ignore"):
            return {"c": c, "a": np.sqrt(np.maximum(c / e, 0.0))}

    def inner(self, named: Mapping[str, float], origin: float) -> np.ndarray:
        return np.array([named["c"], named["c"] / named["a"] ** 2])


@dataclass(frozen=True)
class HiddenOscillator(Effect):
    """An unseen coordinate, inside scaled to the force w that it exerts: w'' = -omega^2 w + kappa^2 q.

    At strength zero nothing hangs on the square root of anything, so the score there is regular.
    """

    def named(self, values: Values, origin: float) -> dict[str, Any]:
        strength, omega = np.moveaxis(np.asarray(values), -1, 0)
        return {"omega": np.abs(omega), "kappa": np.sqrt(np.maximum(strength, 0.0))}

    def inner(self, named: Mapping[str, float], origin: float) -> np.ndarray:
        return np.array([named["kappa"] ** 2, named["omega"]])


@dataclass(frozen=True)
class Memory(Effect):
    """A force w against the motion that fades: dw/dt = kappa v - w / tau, or - |v| w / a where it fades `by_way`, or
    - (|v| w + v |w|) / 2a where only while it is loaded, and is `elastic` when it is let go.

    With time it is a spring and a damper in series (Maxwell 1867), with the way a friction that gives at first (Dahl
    1968) or a part that yields (Bouc 1967 and Wen 1976, of order one). Inside, the last value is 1 / tau or 1 / a. w
    takes the place of an unseen oscillator's momentum, and its start is as open.
    """

    by_way: bool = False
    elastic: bool = False

    @property
    def coefficients(self) -> tuple[str, ...]:
        return "kappa", "a" if self.by_way else "tau"

    def named(self, values: Values, origin: float) -> dict[str, Any]:
        return dict(zip(self.coefficients, (values[..., 0], 1 / values[..., 1]), strict=True))

    @property
    def kept_as(self) -> str:
        return f"{self.name}, {'loaded' if self.elastic else 'by way' if self.by_way else 'by time'}"

    def lost(self, speed: Any, absolute: Any, force: Any, size: Any) -> Any:
        """What fades of a force of some size, where one over tau or a is one, at a speed and its absolute value."""
        if self.elastic:
            return (absolute * force + speed * size) / 2
        return absolute * force if self.by_way else force


VISCOUS = Drag("viscous_damping", positive=True, power=1)
QUADRATIC = Drag("quadratic_drag", positive=True, power=2)
COULOMB = Drag("coulomb_friction", positive=True, power=0)
POWERS = (
    PowerForce("constant_force", power=0, sign=1),
    PowerForce("linear_stiffness", power=1),
    PowerForce("quadratic_stiffness", power=2),
    PowerForce("cubic_stiffness", power=3),
)
EXCITATION = SelfExcitation("self_excitation", amplitudes=2, positive=True)  # else no a is real, or it is a damping
STOP = Effect("contact_stop", places=("a",), positive=True)
FORCING = Oscillating("periodic_forcing", amplitudes=2, places=("omega",))
IMPULSE = Effect("impulse", places=("t_star",))
HIDDEN = HiddenOscillator("hidden_oscillator", places=("omega",), positive=True, switched=True)
RELATIVE = Effect("relative_damping", positive=True)
SPRING = Effect("coupling_spring")
CENTRAL = Effect("central_correction")
GYROSCOPIC = Effect("gyroscopic_coupling")
ERROR = Effect("parameter_error")
DRIFTING = Drifting("parameter_drift")
REGIME = Effect("regime_change", places=("t_star",))
MODULATION = Oscillating("parametric_modulation", amplitudes=2, places=("omega",))
BIAS = Effect("sensor_bias")
GAIN = Effect("sensor_gain")
DRIFT = Drifting("sensor_drift")
DELAY = Effect("sensor_delay", positive=True)
# These two change how readings scatter and not where they lie, so they have no value in the model.
NOISE = Effect("sensor_noise", amplitudes=0)
OUTLIERS = Effect("sensor_outliers", amplitudes=0)

# Beside the powers these shape a force of place that has no word; they are never reported.
SHAPES = (PowerForce("quartic_stiffness", power=4), PowerForce("quintic_stiffness", power=5))
UNNAMED = Effect("unnamed_force")  # its amplitudes are as many as its terms
RELAXING, SLIPPING, YIELDING = MEMORIES = (
    Memory("unnamed_force", places=("fading",), positive=True, switched=True),
    Memory("unnamed_force", places=("fading",), positive=True, switched=True, by_way=True),
    Memory("unnamed_force", places=("fading",), positive=True, switched=True, by_way=True, elastic=True),
)

ON_COORDINATES = (*POWERS, VISCOUS, QUADRATIC, COULOMB, EXCITATION, STOP, FORCING, IMPULSE, HIDDEN)
ON_PAIRS = (RELATIVE, SPRING, CENTRAL, GYROSCOPIC)
ON_PARAMETERS = (ERROR, DRIFTING, REGIME, MODULATION)
ON_COLUMNS = (NOISE, BIAS, GAIN, DRIFT, DELAY, OUTLIERS)
EFFECTS: dict[str, Effect] = {e.name: e for e in (*ON_COORDINATES, *ON_PAIRS, *ON_PARAMETERS, *ON_COLUMNS)}
SIDES = ("upper", "lower")
# What happens at one time.
AT_ONCE = (IMPULSE, REGIME)


def takes_back(effect: Effect, coefficients: Mapping[str, Any]) -> bool:
    """Whether an effect with these coefficients, as they are told, takes from a loss that a known term has too much of:
    losses are positive otherwise."""
    first = coefficients.get(effect.coefficients[0]) if effect.family == "dissipation" else None
    return first is not None and (first.get("mean") or 0.0) < 0


@dataclass(frozen=True)
class Nameless:
    """A force that has no word: a sum of terms, each of a size of its own.

    **Arguments:** - `places`: numbers of the coordinates that it acts on. - `pushes`: its terms on each of them; terms
    of one number have one size. - `choices`: the logarithm of how many forces it was chosen from. - `words`: what it
    does, as in "goes with ..."; empty where only its expression tells. - `kind`: the family of the vocabulary that it
    would be of where its size is positive; empty where of none. - `memory`: what it is where it has one, instead of
    terms.
    """

    places: tuple[int, ...]
    pushes: tuple[tuple[sympy.Expr, ...], ...]
    choices: float = 0.0
    words: str = ""
    kind: str = ""
    memory: Memory | None = None

    def on(self, place: int) -> "Nameless":
        """What it is on one of its coordinates."""
        return self if self.memory else replace(self, places=(place,), pushes=(self.pushes[self.places.index(place)],))


@dataclass(frozen=True)
class Candidate:
    """An effect on a target. Its values start at `first` of the coefficient vector of the augmented model.

    `places` are the numbers of its coordinates, parameter or column.
    """

    effect: Effect
    targets: tuple[str, ...]
    places: tuple[int, ...]
    side: str | None = None
    first: int = field(default=0, compare=False)
    nameless: Nameless | None = None  # what an unnamed force is

    @property
    def target(self) -> str | list[str]:
        """The target as it stands in the answer."""
        return self.targets[0] if len(self.targets) == 1 else list(self.targets)

    @property
    def place(self) -> int:
        """Number of the first coordinate, or of the parameter or column."""
        return self.places[0]

    @property
    def key(self) -> tuple[str, tuple[str, ...]]:
        """Effect name and targets, by which findings are told apart."""
        return self.effect.name, self.targets

    def told(self) -> "list[Candidate]":
        """What it is in an answer, where a force without a name has one coordinate."""
        if self.nameless is None:
            return [self]
        pairs = zip(self.targets, self.places, strict=True)
        return [replace(self, targets=(q,), places=(i,), nameless=self.nameless.on(i)) for q, i in pairs]

    @property
    def values(self) -> slice:
        """Where its values stand in the coefficient vector."""
        return slice(self.first, self.first + self.effect.size)

    def __str__(self) -> str:
        return f"{self.effect.name}({', '.join(self.targets)})"


def vocabulary(
    coordinates: Sequence[str],
    columns: Sequence[str],
    parameters: Mapping[str, int] | None = None,
    nameless: Sequence[Nameless] = (),
) -> tuple[Candidate, ...]:
    """Every effect on every target of a system, in the order of the coefficient vector.

    `parameters` are the names and numbers of those that may vary; `nameless` are forces without a word.
    """
    pairs = [(i, j) for j in range(len(coordinates)) for i in range(j)]
    listed: list[Candidate] = []
    for effect in ON_COORDINATES:
        sides: tuple[str | None, ...] = SIDES if effect is STOP else (None,)
        listed += [Candidate(effect, (q,), (i,), side) for side in sides for i, q in enumerate(coordinates)]
    for effect in ON_PAIRS:
        listed += [Candidate(effect, (coordinates[i], coordinates[j]), (i, j)) for i, j in pairs]
    for effect in ON_PARAMETERS:
        listed += [Candidate(effect, (name,), (k,)) for name, k in (parameters or {}).items()]
    for effect in ON_COLUMNS:
        listed += [Candidate(effect, (c,), (j,)) for j, c in enumerate(columns)]
    listed += [Candidate(effect, (q,), (i,)) for effect in SHAPES for i, q in enumerate(coordinates)]
    for force in nameless:
        effect = force.memory or replace(UNNAMED, amplitudes=len(force.pushes[0]))
        targets = tuple(coordinates[i] for i in force.places)
        listed.append(Candidate(effect, targets, force.places, nameless=force))
    first = np.cumsum([0, *(one.effect.entries for one in listed)])
    return tuple(replace(one, first=int(k)) for one, k in zip(listed, first, strict=False))


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
