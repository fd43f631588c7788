"""Laws of left-out physics as text: one effect's law, and the equations of motion with the effects in place."""

import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from .._effects import EFFECTS, RELAXING, SLIPPING, UNNAMED, YIELDING, Candidate, Memory
from .._simulation_records import Term
from .._vocabulary import COLUMN, PAIR, PARAMETER, symbol

# What each effect adds to the force on its first and second coordinate (contract, section 3).
_FORCES: dict[str, tuple[str, ...]] = {
    "viscous_damping": ("- {c} {v}",),
    "quadratic_drag": ("- {c} |{v}| {v}",),
    "coulomb_friction": ("- {f} sign({v})",),
    "relative_damping": ("- {c} ({v} - {v2})", "+ {c} ({v} - {v2})"),
    "self_excitation": ("+ {c} (1 - {q}^2/{a}^2) {v}",),
    "constant_force": ("+ {f}",),
    "linear_stiffness": ("- {k} {q}",),
    "quadratic_stiffness": ("- {k} {q}^2",),
    "cubic_stiffness": ("- {k} {q}^3",),
    "coupling_spring": ("- {k} ({q} - {q2})", "+ {k} ({q} - {q2})"),
    "contact_stop": ("- {k} max({q} - {a}, 0)",),
    "contact_stop, lower": ("+ {k} max({a} - {q}, 0)",),
    "central_correction": (
        "- {three_b} {q} / ({q}^2 + {q2}^2)^(5/2)",
        "- {three_b} {q2} / ({q}^2 + {q2}^2)^(5/2)",
    ),
    "gyroscopic_coupling": ("+ {b} {v2}", "- {b} {v}"),
    "periodic_forcing": ("+ {a} cos({omega} t + {phi})",),
    "hidden_oscillator": ("+ {kappa} {z}",),
    "unnamed_force": ("+ ({expression})",),
}
# What multiplies a parameter.
_FACTORS = {
    "parametric_modulation": "(1 + {a} cos({omega} t + {phi}))",
    "parameter_drift": "(1 + {r} (t - t_0))",
    "regime_change": "(1 + {d} step(t - {t_star}))",
    "parameter_error": "(1 + {d})",
}
# Laws that are not `F = ..` of the forces above and no factor of a parameter.
_LAWS = {
    "relative_damping": "F_{q} = -{c} ({v} - {v2}), F_{q2} = -F_{q}",
    "coupling_spring": "V = {k} ({q} - {q2})^2 / 2",
    "central_correction": "V = -{b} / ({q}^2 + {q2}^2)^(3/2)",
    "gyroscopic_coupling": "F_{q} = {b} {v2}, F_{q2} = -{b} {v}",
    "impulse": "the momentum jumps by {j} at t = {t_star}",
    "hidden_oscillator": "H gains P^2/2 + {omega}^2 {z}^2/2 - {kappa} {q} {z}",
    "regime_change": "{q} -> {q} (1 + {d}) from t = {t_star} on",
    "unnamed_force": "F = {expression}",
    "sensor_noise": "sd -> {s} sd",
    "sensor_bias": "y = h(x) + {b}",
    "sensor_gain": "y = (1 + {g}) h(x)",
    "sensor_drift": "y = h(x) + {r} (t - t_0)",
    "sensor_delay": "y(t) = h(x(t - {tau}))",
    "sensor_outliers": "a fraction {e} of the readings is off, with standard deviation {sd}",
}
# What forces that fade change by.
_FADING = {
    RELAXING: "{kappa} {v} - {w} / {tau}",
    SLIPPING: "{kappa} {v} - |{v}| {w} / {a}",
    YIELDING: "{kappa} {v} - (|{v}| {w} + {v} |{w}|) / (2 {a})",
}


def number(value: float) -> str:
    """A number with four significant digits."""
    return f"{value:.4g}"


def moment(time: float) -> str:
    """A time, of a clock that may have run for years: to three decimals where four digits would say less."""
    return number(time) if abs(time) < 1000 else f"{time:.3f}".rstrip("0").rstrip(".")


def law_text(one: Candidate, coefficients: Mapping[str, Any]) -> str:
    """The law of one effect with its numbers, `F = -0.03 v`.

    **Arguments:** - `coefficients`: those of the contract by name; for `unnamed_force` its `expression`, a text.
    """
    return _law(one, {name: _shown(name, value) for name, value in coefficients.items()})


def symbolic_law(one: Candidate, memory: str = "w") -> str:
    """The law of one effect with the symbols of its coefficients, `F = -c v`; `memory` is what a force that fades is
    called."""
    return _law(one, symbols(one) | {"w": memory})


def symbols(one: Candidate) -> dict[str, str]:
    """What a law calls the coefficients of the contract, by their names."""
    return {name: symbol(name, one.targets) for name in one.effect.coefficients}


def equation_lines(
    coordinates: Sequence[str],
    momenta: Sequence[str],
    columns: Sequence[str],
    hamiltonian: str,
    forces: Mapping[str, str],
    readings: Mapping[str, str],
    chosen: Iterable[tuple[Candidate, Mapping[str, Any]]],
) -> tuple[str, ...]:
    """The equations of motion and the readings, one line each, with the chosen effects' numbers in place.

    A hidden oscillator brings two more equations, what a force remembers one; a jump, a changed parameter and a changed
    scatter have a line of their own.

    **Arguments:** - `forces`: known forces by momentum. - `readings`: what the columns show. - `chosen`: effects with
    the contract's coefficients, and with `recordings`, a text, where they are not in all.
    """
    chosen = list(chosen)
    added: dict[str, list[str]] = {q: [] for q in coordinates}
    further: list[str] = []
    unseen = _free_names({*coordinates, *momenta, *columns}, [one for one, _ in chosen])
    for number_, (one, coefficients) in enumerate(chosen):
        values = {name: _shown(name, value) for name, value in coefficients.items()}
        names = _names(one, f"d{one.targets[0]}/dt", f"d{one.targets[-1]}/dt") | {"z": unseen.get(number_, "z")}
        for q, template in zip(one.targets, _FORCES.get(_key(one), ()), strict=False):
            added[q].append(_filled(template, names | values | _composed(coefficients)) + _only(coefficients))
        further += _own_lines(one, coefficients, names["z"], dict(zip(coordinates, momenta, strict=True)))
    lines = [f"H = {hamiltonian}"]
    for q, p in zip(coordinates, momenta, strict=True):
        known = [_appended(forces[p].strip())] if p in forces else []
        lines += [f"d{q}/dt = dH/d{p}", " ".join([f"d{p}/dt = -dH/d{q}", *known, *added[q]])]
    return (*lines, *further, *_parameter_lines(chosen), *_reading_lines(columns, readings, chosen))


def stated(terms: Iterable[Term]) -> list[tuple[Candidate, dict[str, Any]]]:
    """Terms of a simulation file as effects with their values, as the equations are written from."""
    out = []
    for term in terms:
        values: dict[str, Any] = {name: quantity.value for name, quantity in term.coefficients.items()}
        if term.expression is not None:
            values["expression"] = term.expression.text
        if term.memory:
            values["memory"] = ", ".join(f"d{name}/dt = {rate.text}" for name, rate in term.memory.items())
        if term.recordings is not None:
            values["recordings"] = ", ".join(map(str, term.recordings))
        out.append((Candidate(EFFECTS.get(term.effect, UNNAMED), term.target, (), term.side), values))
    return out


def _only(coefficients: Mapping[str, Any]) -> str:
    """In which recordings it acts, where not in all."""
    some = coefficients.get("recordings")
    return f" (recording{'s' if ',' in some else ''} {some} only)" if some else ""


def _appended(terms: str) -> str:
    """A sum, as it continues another."""
    return f"- {terms[1:].lstrip()}" if terms.startswith("-") else f"+ {terms}"


def _law(one: Candidate, values: Mapping[str, str]) -> str:
    first, second = one.targets[0], one.targets[-1]
    pair = one.effect.acts_on == PAIR
    names = _names(one, f"v_{first}" if pair else "v" if first != "v" else "dv/dt", f"v_{second}")
    names |= {"z": "z" if first != "z" else "z_hidden"} | dict(values)
    name = one.effect.name
    if isinstance(one.effect, Memory):
        return _filled(f"F = -{{w}}, d{{w}}/dt = {_FADING[one.effect]}", names)
    if name in _LAWS:
        return _filled(_LAWS[name], names)
    if one.effect.acts_on == PARAMETER:
        return f"{first} -> {first} {_filled(_FACTORS[name], names)}"
    sign, term = _filled(_FORCES[_key(one)][0], names).split(" ", 1)
    return f"F = {sign.replace('+', '')}{term}"


def _names(one: Candidate, speed: str, other: str) -> dict[str, str]:
    """What a template calls its targets and their velocities."""
    return {"q": one.targets[0], "q2": one.targets[-1], "v": speed, "v2": other}


def _key(one: Candidate) -> str:
    return f"{one.effect.name}, lower" if one.side == "lower" else one.effect.name


def _shown(name: str, value: float | str) -> str:
    if isinstance(value, str):
        return value
    return moment(value) if name == "t_star" else number(value)


def _filled(template: str, names: Mapping[str, str]) -> str:
    """A template with its names and numbers; an expression of the user's stands as it is."""
    expression = names.get("expression", "")
    return _signs(template.format(**(dict(names) | {"expression": "\0"}))).replace("\0", expression)


def _signs(text: str) -> str:
    """Two signs in a row made one: `+ -0.3` is `- 0.3`."""
    text = re.sub(r"\+ -(?=[\d.])", "- ", text)
    return re.sub(r"--(?=[\d.])", "", re.sub(r"- -(?=[\d.])", "+ ", text))


def _composed(coefficients: Mapping[str, Any]) -> dict[str, str]:
    """Numbers that a force is written with besides the coefficients."""
    return {"three_b": number(3 * coefficients["b"])} if "b" in coefficients else {}


def _free_names(taken: set[str], chosen: Sequence[Candidate]) -> dict[int, str]:
    """A name for each hidden coordinate, by its effect's number, that nothing else has."""
    out: dict[int, str] = {}
    for k, one in enumerate(chosen):
        if one.effect.name == "hidden_oscillator":
            tries = ["z", "z_hidden", *(f"z_hidden{n}" for n in range(2, len(taken) + len(chosen) + 3))]
            out[k] = next(name for name in tries if name not in taken and f"P_{name}" not in taken)
            taken = taken | {out[k], f"P_{out[k]}"}
    return out


def _own_lines(one: Candidate, coefficients: Mapping[str, Any], unseen: str, momentum: Mapping[str, str]) -> list[str]:
    """Lines that an effect of the dynamics adds to the equations."""
    if one.effect.name == "impulse":
        jump, when = number(coefficients["j"]), moment(coefficients["t_star"])
        return [f"{momentum[one.targets[0]]} jumps by {jump} at t = {when}{_only(coefficients)}"]
    if one.effect.name == "hidden_oscillator":
        square, kappa = number(coefficients["omega"] ** 2), number(coefficients["kappa"])
        return [f"d{unseen}/dt = P_{unseen}", f"dP_{unseen}/dt = -{square} {unseen} + {kappa} {one.targets[0]}"]
    return [coefficients["memory"]] if "memory" in coefficients else []


def _parameter_lines(chosen: Sequence[tuple[Candidate, Mapping[str, Any]]]) -> list[str]:
    """Every changed parameter as a function of time; changes of one parameter multiply."""
    factors: dict[str, list[str]] = {}
    for one, coefficients in chosen:
        if one.effect.acts_on == PARAMETER:
            values = {name: _shown(name, value) for name, value in coefficients.items()}
            factors.setdefault(one.targets[0], []).append(_filled(_FACTORS[one.effect.name], values))
    constant = {one.targets[0] for one, _ in chosen if one.effect.name == "parameter_error"}
    return [
        f"{name} -> {name} {factor[0]}" if name in constant and len(factor) == 1 else f"{name}(t) = {name} {product}"
        for name, factor in factors.items()
        for product in [" ".join(factor)]
    ]


def _reading_lines(
    columns: Sequence[str],
    readings: Mapping[str, str],
    chosen: Sequence[tuple[Candidate, Mapping[str, Any]]],
) -> list[str]:
    """What each column shows, (1 + g) h(x(t - tau)) + b + r (t - t_0), and how it scatters where that changed."""
    lines, scatter = [], []
    for column in columns:
        mine = {
            one.effect.name: (one, c) for one, c in chosen if one.effect.acts_on == COLUMN and one.targets[0] == column
        }
        c = {name: value for _, coefficients in mine.values() for name, value in coefficients.items()}
        text = readings[column]
        if "tau" in c:
            text = f"[{text} at t - {number(c['tau'])}]"
        if "g" in c:
            text = f"{number(1 + c['g'])} {text if 'tau' in c else f'({text})'}"
        text += f" {_signs('+ ' + number(c['b']))}" if "b" in c else ""
        text += f" {_signs('+ ' + number(c['r']))} (t - t_0)" if "r" in c else ""
        lines.append(f"{column} = {text}")
        noisy = [name for name in ("sensor_noise", "sensor_outliers") if name in mine]
        scatter += [f"scatter of {column}: {law_text(*mine[name])}" for name in noisy]
    return [*lines, *scatter]
