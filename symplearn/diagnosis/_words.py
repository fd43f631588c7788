"""What an engineer would write about a finding."""

import math
import re
from collections.abc import Mapping, Sequence
from typing import Any

from .._effects import DELAY, Candidate
from .._vocabulary import PAIR, VOCABULARY
from ._consequences import Said, consequence
from ._law_text import law_text, symbolic_law, symbols

_OPENINGS = {
    "viscous_damping": "A force against the motion of {q}, proportional to its speed, was left out",
    "quadratic_drag": "A force against the motion of {q}, as the square of its speed, was left out",
    "coulomb_friction": "Dry friction on {q}, of constant size against the motion, was left out",
    "relative_damping": "A damping between {q} and {q2}, against their motion relative to each other, was left out",
    "self_excitation": "A force along the velocity of {q}, which changes sign with its amplitude, was left out",
    "constant_force": "A constant force on {q} was left out",
    "linear_stiffness": "A force proportional to {q} was left out",
    "quadratic_stiffness": "A force as the square of {q}, uneven on its two sides, was left out",
    "cubic_stiffness": "A force that grows with the cube of {q} was left out",
    "coupling_spring": "A spring between {q} and {q2} was left out",
    "contact_stop": "An elastic stop that {q} runs into from {side} was left out",
    "central_correction": "A central force in the plane of {q} and {q2}, as 1/r^4, was left out",
    "gyroscopic_coupling": "A gyroscopic force between {q} and {q2} was left out",
    "periodic_forcing": "A periodic force on {q} was left out",
    "impulse": "A blow to {q} was left out",
    "parametric_modulation": "The parameter {q} is not constant but swings",
    "parameter_drift": "The parameter {q} is not constant but drifts",
    "regime_change": "The parameter {q} changes suddenly during the recording",
    "hidden_oscillator": "An oscillator z that nobody reads is coupled to {q}",
    "parameter_error": "The value of {q} given as known does not fit the recording",
    "sensor_noise": "The readings of {q} do not scatter as the noise given as known says",
    "sensor_bias": "The sensor of {q} reads off by a constant",
    "sensor_gain": "The sensor of {q} reads in a wrong scale",
    "sensor_drift": "The reading of {q} drifts away from what it should show",
    "sensor_delay": "The sensor of {q} is late",
    "sensor_outliers": "Some readings of {q} are off by far more than the noise",
    "unnamed_force": "A force on {q} that has no name in the vocabulary was left out",
}
# Where a known term takes out too much: what is found is added to it, and negative.
_TOO_STRONG = {
    "viscous_damping": "The viscous damping of {q} that the simulation has is too strong",
    "quadratic_drag": "The quadratic drag on {q} that the simulation has is too strong",
    "coulomb_friction": "The dry friction on {q} that the simulation has is too strong",
    "relative_damping": "The damping between {q} and {q2} that the simulation has is too strong",
}
# As of a delay that is known.
_TOO_LATE = "The sensor of {q} is less late than the simulation has it"
# Plain words for an effect that a finding is hard to tell from.
_NOUNS = {
    "viscous_damping": "a viscous damping",
    "quadratic_drag": "a quadratic drag",
    "coulomb_friction": "dry friction",
    "relative_damping": "a relative damping",
    "self_excitation": "a self-excitation",
    "constant_force": "a constant force",
    "linear_stiffness": "a linear stiffness",
    "quadratic_stiffness": "a quadratic stiffness",
    "cubic_stiffness": "a cubic stiffness",
    "coupling_spring": "a spring",
    "contact_stop": "an elastic stop",
    "central_correction": "a central force as 1/r^4",
    "gyroscopic_coupling": "a gyroscopic coupling",
    "periodic_forcing": "a periodic force",
    "impulse": "a blow",
    "parametric_modulation": "a periodic change",
    "parameter_drift": "a slow drift",
    "regime_change": "a sudden change",
    "hidden_oscillator": "a hidden oscillator",
    "parameter_error": "a wrong value",
    "sensor_noise": "another noise",
    "sensor_bias": "a constant error",
    "sensor_gain": "a wrong scale",
    "sensor_drift": "a drift",
    "sensor_delay": "a delay",
    "sensor_outliers": "outliers",
    "unnamed_force": "a force without a name",
}
_PREPOSITIONS = {
    "impulse": "to",
    "hidden_oscillator": "coupled to",
    "contact_stop": "for",
    **dict.fromkeys(("parametric_modulation", "parameter_drift", "regime_change", "parameter_error"), "of"),
    **{name: "in the readings of" for name in _NOUNS if name.startswith("sensor_")},
    **dict.fromkeys(("relative_damping", "coupling_spring", "gyroscopic_coupling"), "between"),
    "central_correction": "in the plane of",
}
# Their amplitudes are measured otherwise than by the force along the motion, so their strength is no ratio of forces: a
# stop by its stiffness, a blow by its momentum, a hidden oscillator by its coupling, a self-excitation by two forces
# against each other.
_NO_RATIO = ("contact_stop", "impulse", "hidden_oscillator", "self_excitation")


def finding_sentence(
    one: Candidate,
    coefficients: Mapping[str, Any],
    strength: float | None,
    units: Mapping[str, str | None],
    rivals: Sequence[str],
    only: Sequence[int] | None,
) -> str:
    """What was left out and where, its law with numbers, how strong it is, what it does, what it is hard to tell from.

    **Arguments:** - `coefficients`: mean, sd and interval95 by name; for `unnamed_force` its `expression`, a text.
    - `strength`: size of the effect's amplitudes in units of those that its prior takes to be as strong as the forces
    already there; `None` where it is no force.
    - `units`: by coefficient, `None` where unknown. - `rivals`: effects such as `quadratic_drag(theta)`.
    - `only`: the recordings, from 1, that it is in; `None` for all.
    """
    said = Said(one, coefficients, units)
    openings = _TOO_STRONG if said.takes_back else _OPENINGS
    too_late = one.effect is DELAY and said.mean("tau") < 0
    opening = (_TOO_LATE if too_late else openings[one.effect.name]).format(
        q=one.targets[0], q2=one.targets[-1], side=_side(one)
    )
    if one.nameless is not None and one.nameless.words:
        opening += f"; it {one.nameless.words}"
    words = [f"{opening}: {_law_with_numbers(said)}."]
    if only:
        words.append(f"It is in recording{'s' if len(only) > 1 else ''} {_listed([str(r) for r in only], 'and')} only.")
    share = _share_of_forces(one.effect.name, strength)
    if share is not None:
        words.append(f"Its force is about {100 * share:.2g} % of the forces already there.")
    words.append(consequence(said))
    if rivals:
        words.append(f"This recording hardly tells it from {_listed([in_words(rival) for rival in rivals], 'or')}.")
    return " ".join(words)


def _share_of_forces(effect: str, strength: float | None) -> float | None:
    """Root mean square of an effect's force over that of the forces already there; `None` where it is not known."""
    if strength is None or not math.isfinite(strength) or effect in _NO_RATIO:
        return None
    # As strong as the forces already there is a cosine whose amplitude is their root mean square.
    return strength / math.sqrt(2) if effect == "periodic_forcing" else strength


def _law_with_numbers(said: Said) -> str:
    """`F = -c v, where c = 0.03 +- 0.002 N`."""
    names = symbols(said.one)
    if not names:
        return law_text(said.one, {"expression": said.coefficients["expression"]})
    values = [f"{shown} = {said.value(name)}" for name, shown in names.items()]
    law = symbolic_law(said.one, said.coefficients.get("expression", "-w").removeprefix("-"))
    return f"{law}, where {_listed(values, 'and')}"


def in_words(rival: str) -> str:
    """`quadratic_drag(theta)` as `a quadratic drag on theta`; what has another form stays as it is."""
    match = re.fullmatch(r"(\w+)\((.*)\)([^)]*)", rival)
    if match is None or match[1] not in _NOUNS:
        return rival
    name, targets, rest = match.groups()
    if VOCABULARY[name].target == PAIR:
        targets = targets.replace(", ", " and ")
    return f"{_NOUNS[name]} {_PREPOSITIONS.get(name, 'on')} {targets}{rest}"


def _side(one: Candidate) -> str:
    """Where a body comes from that runs into a stop."""
    return "above" if one.side == "lower" else "below"


def _listed(words: Sequence[str], joint: str) -> str:
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} {joint} {words[-1]}"
