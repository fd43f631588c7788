"""What a left-out effect does to energy, frequency, amplitude or readings, as far as its coefficients say."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from .._effects import Candidate, takes_back
from ._law_text import moment, number


@dataclass(frozen=True)
class Said:
    """A finding's coefficients as they are spoken of."""

    one: Candidate
    coefficients: Mapping[str, Any]
    units: Mapping[str, str | None]

    def mean(self, name: str) -> float:
        return float(self.coefficients[name]["mean"])

    @property
    def takes_back(self) -> bool:
        """Whether it takes from a loss that a known term has too much of."""
        return takes_back(self.one.effect, self.coefficients)

    def value(self, name: str) -> str:
        """`0.03 +- 0.002 N/m`."""
        return _with_unit(self._spread(name, 1.0), self.units.get(name))

    def plain(self, name: str) -> str:
        """The mean's size alone, with its unit."""
        return _with_unit(number(abs(self.mean(name))), self.units.get(name))

    def percent(self, name: str) -> str:
        """A pure number's size, `20 +- 1.5 %`."""
        return f"{self._spread(name, math.copysign(100.0, self.mean(name)))} %"

    def by_sign(self, name: str, positive: str, negative: str) -> str:
        """One of two words, by the sign of the mean."""
        return positive if self.mean(name) > 0 else negative

    def _spread(self, name: str, factor: float) -> str:
        mean, sd = (self.coefficients[name].get(key) for key in ("mean", "sd"))
        shown = moment(mean) if name == "t_star" else number(factor * mean)
        return shown + ("" if sd is None else f" +- {number(abs(factor) * sd)}")

    @property
    def period(self) -> str:
        """2 pi / omega, `2.99 s`."""
        omega = self.mean("omega")
        if omega <= 0:
            return "unknown"
        relative = (self.coefficients["omega"].get("sd") or 0.0) / omega
        spread = f" +- {number(relative * 2 * math.pi / omega)}" if relative else ""
        return _with_unit(number(2 * math.pi / omega) + spread, self._time("omega", "rad/"))

    def per_time(self, name: str) -> str:
        """`per s`, of a rate in `1/s`."""
        return f"per {self._time(name, '1/') or 'unit of time'}"

    def _time(self, name: str, start: str) -> str | None:
        """The unit of time that stands below a fraction bar."""
        unit = self.units.get(name) or ""
        return unit.removeprefix(start) if unit.startswith(start) else None


def consequence(said: Said) -> str:
    """One sentence on what the effect does."""
    if said.takes_back:
        return "It is added to what the simulation has, so that less energy is taken out."
    return _DOES[said.one.effect.name](said)


def _stiffens(said: Said) -> str:
    way = said.by_sign("k", "pulls back and raises", "pushes away and lowers")
    return f"It {way} the frequency at every amplitude; no energy is lost."


def _uneven(said: Said) -> str:
    stiffer, softer = said.by_sign("k", "positive", "negative"), said.by_sign("k", "negative", "positive")
    q = said.one.targets[0]
    return f"It makes the motion uneven: stiffer towards {stiffer} {q}, softer towards {softer}; it takes no energy."


def _hardens(said: Said) -> str:
    way = said.by_sign("k", "rises", "falls")
    return f"The frequency {way} with the amplitude; no energy is lost."


def _excites(said: Said) -> str:
    inside = said.by_sign("c", "feeds energy in", "takes energy out")
    outside = said.by_sign("c", "takes it out", "feeds it in")
    a, q = said.plain("a"), said.one.targets[0]
    return f"It {inside} while {q} stays within a = {a} and {outside} beyond, on either side."


def _bends_orbits(said: Said) -> str:
    way = said.by_sign("b", "attracts", "repels")
    return f"It {way}, strongly at small r alone, so orbits precess; it changes neither energy nor angular momentum."


def _couples(said: Said) -> str:
    q, q2, way = *said.one.targets, said.by_sign("k", "raises", "lowers")
    return (
        f"It {way} the frequency at which {q} and {q2} move against each other, lets energy pass between them, "
        "and leaves their common motion alone."
    )


def _stops(said: Said) -> str:
    side = "below" if said.one.side == "lower" else "above"
    q, a = said.one.targets[0], _with_unit(number(said.mean("a")), said.units.get("a"))
    return f"It acts only while {q} is {side} {a}, and gives back the energy it takes."


def _pushes(said: Said) -> str:
    return (
        f"It repeats with a period of {said.period} and pumps energy in and out; its amplitude is {said.plain('a')} "
        "whatever the motion does."
    )


def _strikes(said: Said) -> str:
    way = said.by_sign("j", "up", "down")
    return (
        f"The momentum jumps {way} by {said.plain('j')} at t = {said.value('t_star')}; before and after "
        "that, it adds nothing."
    )


def _swings(said: Said) -> str:
    return f"It swings by {said.percent('a')} to either side, with a period of {said.period}."


def _creeps(said: Said) -> str:
    way = said.by_sign("r", "grows", "shrinks")  # in size: the value itself may be negative
    return f"It {way} by {said.percent('r')} {said.per_time('r')} of its value at the first row."


def _switches(said: Said) -> str:
    way = said.by_sign("d", "larger", "smaller")
    return f"From t = {said.value('t_star')} on it is {said.percent('d')} {way} than before."


def _exchanges(said: Said) -> str:
    return (
        f"Its own period is {said.period}; energy that {said.one.targets[0]} loses to it comes back, "
        "and none is lost in all."
    )


def _corrects(said: Said) -> str:
    way = said.by_sign("d", "larger", "smaller")
    return f"It should be {said.percent('d')} {way} than given; the form of the equations stays as it is."


def _scatters(said: Said) -> str:
    way = "larger" if said.mean("s") > 1 else "smaller"
    size = number(100 * abs(said.mean("s") - 1))
    return f"The noise is {size} % {way} than given; {_ALONE}"


def _offsets(said: Said) -> str:
    way = said.by_sign("b", "high", "low")
    return f"It reads {said.plain('b')} too {way} throughout; {_ALONE}"


def _scales(said: Said) -> str:
    if said.mean("g") < -1.0:
        return f"It shows everything with the opposite sign, {number(-1.0 - said.mean('g'))} times as large; {_ALONE}"
    way = said.by_sign("g", "large", "small")
    return f"It shows everything {said.percent('g')} too {way}; {_ALONE}"


def _wanders(said: Said) -> str:
    unit, way = said.units.get("r"), said.by_sign("r", "up", "down")
    rate = number(abs(said.mean("r"))) + (f" {unit}" if unit else " per unit of time")
    return f"It creeps {way} by {rate}, counted from the first row; {_ALONE}"


def _lags(said: Said) -> str:
    unit = said.units.get("tau") or "units of time"
    if said.mean("tau") < 0:  # beside a known delay
        return f"It is so by {number(-said.mean('tau'))} {unit}; {_ALONE}"
    return f"It shows what was {number(said.mean('tau'))} {unit} before; {_ALONE}"


def _errs(said: Said) -> str:
    return (
        f"{said.percent('e')} of the readings are off, by errors with a standard deviation of {said.value('sd')}; "
        f"{_ALONE}"
    )


def _is_nameless(said: Said) -> str:
    if "tau" in said.coefficients or "a" in said.coefficients:
        return _fades(said)
    sd = said.coefficients.get("relative_sd")
    known = "" if sd is None else f"Its size is known to {number(100 * sd)} % (one standard deviation). "
    if said.one.nameless is not None and said.one.nameless.words:
        return f"{known}It is the likeliest of the simple laws that were tried, and holds where the motion has been."
    return f"{known}Its form was fitted to the missing force and holds where the motion has been, not beyond."


def _fades(said: Said) -> str:
    """What it is at first, and in the long run."""
    if "tau" in said.coefficients:
        return (
            f"What takes much less time than tau feels a spring of kappa, what takes longer a damper of kappa tau = "
            f"{number(said.mean('kappa') * said.mean('tau'))}; most energy is lost where omega tau = 1."
        )
    return (
        "On ways much shorter than a it is a spring of kappa, on longer ones a friction of "
        f"kappa a = {number(said.mean('kappa') * said.mean('a'))}: it runs through a loop (hysteresis)."
    )


def _same(text: str) -> Callable[[Said], str]:
    return lambda said: text.format(q=said.one.targets[0], q2=said.one.targets[-1])


_ALONE = "the motion itself is not touched."
_DOES: dict[str, Callable[[Said], str]] = {
    "viscous_damping": _same("It takes out energy at the rate c v^2, so a free swing decays exponentially."),
    "quadratic_drag": _same("It takes out energy at the rate c |v|^3: far more of large swings than of small ones."),
    "coulomb_friction": lambda said: (
        "It takes out energy at the rate f |v|: a free swing loses about the same amplitude every time, and the motion "
        f"sticks where the other forces stay below {said.plain('f')}."
    ),
    "relative_damping": _same("It takes out energy where {q} and {q2} move apart or together; common motion is free."),
    "self_excitation": _excites,
    "constant_force": lambda said: (
        f"It always pushes towards {said.by_sign('f', 'positive', 'negative')} {said.one.targets[0]}, so that a "
        "point of rest moves that way; no energy is lost."
    ),
    "linear_stiffness": _stiffens,
    "quadratic_stiffness": _uneven,
    "cubic_stiffness": _hardens,
    "coupling_spring": _couples,
    "contact_stop": _stops,
    "central_correction": _bends_orbits,
    "gyroscopic_coupling": _same("It turns motion along {q} into motion along {q2} and back, and does no work."),
    "periodic_forcing": _pushes,
    "impulse": _strikes,
    "parametric_modulation": _swings,
    "parameter_drift": _creeps,
    "regime_change": _switches,
    "hidden_oscillator": _exchanges,
    "parameter_error": _corrects,
    "sensor_noise": _scatters,
    "sensor_bias": _offsets,
    "sensor_gain": _scales,
    "sensor_drift": _wanders,
    "sensor_delay": _lags,
    "sensor_outliers": _errs,
    "unnamed_force": _is_nameless,
}


def _with_unit(text: str, unit: str | None) -> str:
    return f"{text} {unit}" if unit else text
