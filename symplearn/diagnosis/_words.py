"""What an engineer would write about a finding, and which recording would tell rivals apart."""

from collections.abc import Iterable, Mapping, Sequence

from .._effects import Candidate
from ._posterior import Posterior
from ._problem import Combination, Problem

_OPENINGS = {
    "viscous_damping": "A force against the motion of {target}, proportional to its speed, was left out: {law}.",
    "quadratic_drag": "A force against the motion of {target}, as the square of its speed, was left out: {law}.",
    "coulomb_friction": "Dry friction on {target}, of constant size against the motion, was left out: {law}.",
    "constant_force": "A constant force on {target} was left out: {law}.",
    "linear_stiffness": "A restoring force proportional to {target} was left out: {law}.",
    "quadratic_stiffness": "A force as the square of {target}, uneven on its two sides, was left out: {law}.",
    "cubic_stiffness": "A force that grows with the cube of {target} was left out: {law}.",
    "sensor_bias": "The sensor of {target} reads off by a constant: {law}.",
    "sensor_gain": "The sensor of {target} reads in a wrong scale: {law}.",
}
_LAWS = {
    "viscous_damping": "-{c} v",
    "quadratic_drag": "-{c} |v| v",
    "coulomb_friction": "-{c} sign(v)",
    "constant_force": "{c}",
    "linear_stiffness": "-{c} q",
    "quadratic_stiffness": "-{c} q^2",
    "cubic_stiffness": "-{c} q^3",
}
_DOES = {
    "viscous_damping": "It takes energy out of every swing in proportion, so the amplitude decays exponentially.",
    "quadratic_drag": "It takes more out of large swings than of small ones.",
    "coulomb_friction": "The amplitude falls by the same amount every swing until the motion stops.",
    "constant_force": "It moves the point of rest and leaves the energy alone.",
    "linear_stiffness": "It shifts the frequency at every amplitude.",
    "quadratic_stiffness": "It makes the motion uneven about its point of rest.",
    "cubic_stiffness": "It makes the frequency depend on the amplitude.",
    "sensor_bias": "The motion itself is as simulated.",
    "sensor_gain": "The motion itself is as simulated.",
}
# Which recording unmasks rivals: pairs of effect sets that are taken for each other, and what tells them apart.
_UNMASK: tuple[tuple[frozenset[str], str], ...] = (
    (
        frozenset({"viscous_damping", "quadratic_drag", "coulomb_friction"}),
        "a recording that starts at twice the amplitude and goes on until the motion has nearly died: the laws of "
        "friction differ most between fast and slow motion",
    ),
    (
        frozenset({"constant_force", "sensor_bias"}),
        "a reading of the sensor at a place known otherwise, or the apparatus turned round: a force changes sign, a "
        "bias does not",
    ),
    (
        frozenset({"constant_force", "quadratic_stiffness", "sensor_bias"}),
        "a recording at a very different amplitude, and one at rest: a force and a bias stay, an uneven stiffness "
        "fades with the amplitude",
    ),
    (
        frozenset({"sensor_gain", "cubic_stiffness", "linear_stiffness"}),
        "a recording at half the amplitude, and the sensor held against a ruler: a gain scales both alike, a "
        "stiffness changes the frequency",
    ),
    (
        frozenset({"linear_stiffness", "quadratic_stiffness", "cubic_stiffness"}),
        "recordings at several amplitudes: the frequency's dependence on amplitude tells the powers apart",
    ),
    (
        frozenset({"viscous_damping", "sensor_bias", "constant_force"}),
        "a longer recording: a bias stays where a decay ends",
    ),
)


def number(value: float) -> str:
    """A number with four significant digits."""
    return f"{value:.4g}"


def symbol_of(candidate: Candidate) -> str:
    """The equation of one effect, with its coefficient's name."""
    law, name = _LAWS.get(candidate.effect.name), candidate.effect.coefficient
    if law is None:
        return f"y + {name}" if candidate.effect.name == "sensor_bias" else f"(1 + {name}) y"
    return f"F = {law.format(c=name)}".replace("--", "")


def finding_sentence(
    candidate: Candidate, mean: float, sd: float, share: float, unit: str, rivals: Sequence[str]
) -> str:
    """Cause, law with its number, how strong, what it does, what it cannot be told from."""
    name = candidate.effect.coefficient
    known = f"{symbol_of(candidate)} with {name} = {number(mean)} +- {number(sd)}{' ' + unit if unit else ''}"
    words = [_OPENINGS[candidate.effect.name].format(target=candidate.target, law=known)]
    if candidate.effect.acts_on == "coordinate":
        words.append(f"It is about {100 * share:.2g} % of the forces already there.")
    words.append(_DOES[candidate.effect.name])
    if rivals:
        words.append(f"This recording hardly tells it from {_listed(rivals)}.")
    return " ".join(words)


def next_measurement(problem: Problem, posterior: Posterior, chosen: Combination | None) -> str:
    """Which recording would tell the remaining alternatives apart."""
    likeliest = max((w.probability for w in posterior.named), default=0.0)
    rivals = [w.combination for w in posterior.named if w.probability > max(0.02, 0.1 * likeliest)][:6]
    if chosen is None and posterior.as_it_is > 0.05:
        if not rivals or posterior.as_it_is > 0.9:
            return "none is needed; a longer recording at another amplitude would test the simulation harder"
    names = [{problem.equations.candidates[c].effect.name for c in rival} for rival in rivals]
    shared = frozenset[str]().union(*names[:1]).intersection(*names)
    disputed = frozenset[str]().union(*names) - shared
    advice = [text for kin, text in _UNMASK if len(kin & disputed) >= 2 or (len(kin & disputed) == 1 and len(kin) == 2)]
    if chosen is None and posterior.unexplained > 0.5:
        advice.append("more channels and a faster sampling where the strain is largest, to see what acts there")
    if not advice:
        return "a recording at another amplitude, to test the law outside the range it was found in"
    return "; also ".join(dict.fromkeys(advice[:2]))


def equation_lines(problem: Problem, hamiltonian: str, forces: Mapping[str, str], readings: Mapping[str, str],
                   chosen: Iterable[tuple[Candidate, float]]) -> tuple[str, ...]:  # fmt: skip
    """The equations of motion and readings as text, with the chosen effects' numbers in place."""
    chosen, eq = list(chosen), problem.equations
    lines = [f"H = {hamiltonian}"]
    for i, (q, p) in enumerate(zip(eq.coordinates, eq.momenta, strict=True)):
        right = f"-dH/d{q}"
        right += f" + {forces[p]}" if p in forces else ""
        for one, value in chosen:
            if one.effect.acts_on == "coordinate" and one.place == i:
                right += _added(_LAWS[one.effect.name], value).replace("q", q).replace("v", f"d{q}/dt")
        lines += [f"d{q}/dt = dH/d{p}", f"d{p}/dt = {right}"]
    for j, (column, h) in enumerate(readings.items()):
        mine = {one.effect.name: value for one, value in chosen if one.effect.family == "sensor" and one.place == j}
        text = f"{number(1 + mine['sensor_gain'])} ({h})" if "sensor_gain" in mine else h
        text += _added("{c}", mine["sensor_bias"]) if "sensor_bias" in mine else ""
        lines.append(f"{column} = {text}")
    return tuple(lines)


def _added(law: str, value: float) -> str:
    """A term with its sign: ` - 0.03 v`."""
    negative = law.startswith("-") != (value < 0)
    return f" {'-' if negative else '+'} {law.lstrip('-').format(c=number(abs(value)))}"


def _listed(words: Sequence[str]) -> str:
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} or {words[-1]}"
