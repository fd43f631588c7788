"""The words of `[[terms]]`: every effect of the contract, its target and its coefficients."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

COORDINATE, PAIR, PARAMETER, COLUMN = "coordinate", "pair of coordinates", "parameter", "observed column"


@dataclass(frozen=True)
class Word:
    """One effect's name. `positive` are the coefficients that are never negative by convention."""

    name: str
    family: str
    target: str
    coefficients: tuple[str, ...]
    positive: tuple[str, ...] = ()
    sides: bool = False
    expression: bool = False


_WORDS = (
    Word("viscous_damping", "dissipation", COORDINATE, ("c",), ("c",)),
    Word("quadratic_drag", "dissipation", COORDINATE, ("c",), ("c",)),
    Word("coulomb_friction", "dissipation", COORDINATE, ("f",), ("f",)),
    Word("relative_damping", "dissipation", PAIR, ("c",), ("c",)),
    Word("self_excitation", "activity", COORDINATE, ("c", "a")),
    Word("constant_force", "conservative", COORDINATE, ("f",)),
    Word("linear_stiffness", "conservative", COORDINATE, ("k",)),
    Word("quadratic_stiffness", "conservative", COORDINATE, ("k",)),
    Word("cubic_stiffness", "conservative", COORDINATE, ("k",)),
    Word("coupling_spring", "conservative", PAIR, ("k",)),
    Word("contact_stop", "conservative", COORDINATE, ("k", "a"), sides=True),
    Word("central_correction", "conservative", PAIR, ("b",)),
    Word("gyroscopic_coupling", "gyroscopic", PAIR, ("b",)),
    Word("periodic_forcing", "forcing", COORDINATE, ("a", "omega", "phi"), ("a", "omega")),
    Word("impulse", "forcing", COORDINATE, ("j", "t_star")),
    Word("parametric_modulation", "time variation", PARAMETER, ("a", "omega", "phi"), ("a", "omega")),
    Word("parameter_drift", "time variation", PARAMETER, ("r",)),
    Word("regime_change", "time variation", PARAMETER, ("d", "t_star")),
    Word("hidden_oscillator", "hidden degree of freedom", COORDINATE, ("omega", "kappa"), ("omega", "kappa")),
    Word("parameter_error", "calibration", PARAMETER, ("d",)),
    Word("sensor_noise", "sensor", COLUMN, ("s",), ("s",)),
    Word("sensor_bias", "sensor", COLUMN, ("b",)),
    Word("sensor_gain", "sensor", COLUMN, ("g",)),
    Word("sensor_drift", "sensor", COLUMN, ("r",)),
    Word("sensor_delay", "sensor", COLUMN, ("tau",), ("tau",)),
    Word("sensor_outliers", "sensor", COLUMN, ("e", "sd"), ("e", "sd")),
    Word("unnamed_force", "any", COORDINATE, (), expression=True),
)
VOCABULARY: dict[str, Word] = {word.name: word for word in _WORDS}

_ABOVE_ZERO: tuple[Callable[[float], bool], str] = (lambda value: value == 0, "be greater than zero")
# What a coefficient may not be, besides negative where it is positive by convention.
FORBIDDEN: dict[tuple[str, str], tuple[Callable[[float], bool], str]] = {
    ("self_excitation", "a"): (lambda value: value == 0, "be other than zero"),
    ("periodic_forcing", "omega"): _ABOVE_ZERO,
    ("parametric_modulation", "omega"): _ABOVE_ZERO,
    ("hidden_oscillator", "omega"): _ABOVE_ZERO,
    ("sensor_noise", "s"): _ABOVE_ZERO,
    ("sensor_outliers", "sd"): _ABOVE_ZERO,
    ("sensor_outliers", "e"): (lambda value: value > 1, "lie between 0 and 1"),
}


def symbol(name: str, targets: Sequence[str]) -> str:
    """What a law calls a coefficient: its name, with an index where a target is called so."""
    return f"{name}_0" if name in targets else name
