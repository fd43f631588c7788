"""Units of an effect's coefficients, from the units of coordinates, momenta, time and columns."""

import re
from collections.abc import Mapping, Sequence

from .._effects import EFFECTS, Drag, PowerForce
from .._vocabulary import COLUMN, VOCABULARY

_SYMBOL = re.compile(r"([^\W\d_]+|[°%])\^?(-?\d|⁻?[¹²³⁴])?")
_RAISED = str.maketrans("⁻¹²³⁴", "-1234")
# A coefficient's unit as powers: of the momentum p and the coordinate q it acts on, of its partner's coordinate q2,
# of the column y, of time t, of an angle. An empty one is a pure number.
_Powers = Mapping[str, int]
_UNITS: dict[tuple[str, str], _Powers] = {
    ("relative_damping", "c"): {"p": 1, "q": -1},
    ("self_excitation", "c"): {"p": 1, "q": -1},
    ("self_excitation", "a"): {"q": 1},
    ("coupling_spring", "k"): {"p": 1, "q": -1, "t": -1},
    ("contact_stop", "k"): {"p": 1, "q": -1, "t": -1},
    ("contact_stop", "a"): {"q": 1},
    ("central_correction", "b"): {"p": 1, "q": 4, "t": -1},
    ("gyroscopic_coupling", "b"): {"p": 1, "q2": -1},
    ("periodic_forcing", "a"): {"p": 1, "t": -1},
    ("periodic_forcing", "omega"): {"angle": 1, "t": -1},
    ("periodic_forcing", "phi"): {"angle": 1},
    ("impulse", "j"): {"p": 1},
    ("impulse", "t_star"): {"t": 1},
    ("parametric_modulation", "a"): {},
    ("parametric_modulation", "omega"): {"angle": 1, "t": -1},
    ("parametric_modulation", "phi"): {"angle": 1},
    ("parameter_drift", "r"): {"t": -1},
    ("regime_change", "d"): {},
    ("regime_change", "t_star"): {"t": 1},
    ("hidden_oscillator", "omega"): {"angle": 1, "t": -1},
    ("unnamed_force", "kappa"): {"p": 1, "q": -1, "t": -1},
    ("unnamed_force", "tau"): {"t": 1},
    ("unnamed_force", "a"): {"q": 1},
    ("parameter_error", "d"): {},
    ("sensor_noise", "s"): {},
    ("sensor_bias", "b"): {"y": 1},
    ("sensor_gain", "g"): {},
    ("sensor_drift", "r"): {"y": 1, "t": -1},
    ("sensor_delay", "tau"): {"t": 1},
    ("sensor_outliers", "e"): {},
    ("sensor_outliers", "sd"): {"y": 1},
}
# The hidden coordinate has unit mass, so its unit is the root of energy times time: kappa^2 is p / (q t^3).
_KAPPA_SQUARED: _Powers = {"p": 1, "q": -1, "t": -3}
# Between two coordinates, these laws say what they say only where both have one unit.
_ALIKE = ("relative_damping", "coupling_spring", "central_correction")


def coefficient_units(
    effect: str,
    targets: Sequence[str],
    units: Mapping[str, str],
    momenta: Mapping[str, str],
    time: str | None,
) -> dict[str, str | None]:
    """The unit of every coefficient by name: `""` for a pure number, `None` where a unit it is made of is unknown.

    **Arguments:** - `units`: of states and columns, by name. - `momenta`: the momentum of every coordinate.
    - `time`: the unit of time.
    """
    if effect not in VOCABULARY:
        return {}
    first, second = targets[0], targets[-1]
    known = {"t": time, "angle": "rad"}
    if VOCABULARY[effect].target == COLUMN:
        known["y"] = units.get(first)
    else:
        known |= {"q": units.get(first), "q2": units.get(second), "p": units.get(momenta.get(first, ""))}
    alike = effect not in _ALIKE or known["q"] == known["q2"]
    names = VOCABULARY[effect].coefficients or [name for one, name in _UNITS if one == effect]
    return {name: _unit(effect, name, known) if alike else None for name in names}


def time_unit(units: Mapping[str, str], column: str) -> str | None:
    """The unit of `t`, or of the column of times."""
    return units.get("t", units.get(column))


def _unit(effect: str, name: str, known: Mapping[str, str | None]) -> str | None:
    if (effect, name) == ("hidden_oscillator", "kappa"):
        inside = _product(_KAPPA_SQUARED, known)
        return inside and f"√({inside})"
    return _product(_powers(effect, name), known)


def _powers(effect: str, name: str) -> _Powers:
    """Force is p / t and speed q / t."""
    law = EFFECTS.get(effect)
    if isinstance(law, Drag):
        return {"p": 1, "t": law.power - 1, "q": -law.power}
    if isinstance(law, PowerForce):
        return {"p": 1, "q": -law.power, "t": -1}
    return _UNITS[effect, name]


def _product(powers: _Powers, known: Mapping[str, str | None]) -> str | None:
    """`a·b²/(c·d)`; `None` where one of the factors is unknown."""
    factors = {name: power for name, power in powers.items() if power}
    if any(known.get(name) is None for name in factors):
        return None
    named = [(known[name] or "", power) for name, power in factors.items()]
    if len(named) == 1 and named[0][1] == 1:
        return "" if named[0][0] == "1" else named[0][0]  # as the user wrote it
    total: dict[str, int] = {}
    for unit, power in named:
        for symbol, inside in _symbols(unit).items():
            total[symbol] = total.get(symbol, 0) + inside * power
    above = [_power(symbol, power) for symbol, power in total.items() if power > 0]
    below = [_power(symbol, -power) for symbol, power in total.items() if power < 0]
    text = "·".join(above) or ("1" if below else "")
    return text + (f"/{below[0]}" if len(below) == 1 else f"/({'·'.join(below)})" if below else "")


def _symbols(unit: str) -> dict[str, int]:
    """`kg m²/s` as kg 1, m 2, s -1; a unit written in another way is one symbol, in brackets."""
    out: dict[str, int] = {}
    for place, side in enumerate(unit.split("/")):
        pieces = [piece for piece in re.split(r"[ ·*]+", side.strip().replace("**", "^")) if piece not in ("", "1")]
        found = [_SYMBOL.fullmatch(piece) for piece in pieces]
        # What stands after two symbols below the bar, or after a second bar, is anyone's guess.
        if place > 1 or not all(found) or (place == 1 and len(found) != 1):
            return {f"({unit})": 1}
        for match in found:
            assert match is not None
            power = int((match[2] or "1").translate(_RAISED)) * (-1 if place else 1)
            out[match[1]] = out.get(match[1], 0) + power
    return out


def _power(symbol: str, power: int) -> str:
    return symbol + {1: "", 2: "²", 3: "³"}.get(power, f"^{power}")
