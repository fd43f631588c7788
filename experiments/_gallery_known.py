"""What a diagnosis says held against what is known: one line for each fact, all numbers from diagnosis.json."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from ._gallery_page_file import Known

CERTAIN = 0.95  # a family this probable is called certain


@dataclass(frozen=True)
class Compared:
    """One fact, what was found of it, and whether the two agree."""

    about: str
    expected: str
    found: str
    agrees: bool


def compared(known: Known, document: Mapping[str, Any]) -> Compared:
    """A known fact against a `diagnosis.json`."""
    way = next(way for name, way in WAYS.items() if getattr(known, name))
    expected, found, agrees = way(known, document)
    return Compared(known.about, expected, found, agrees)


def effect_name(finding: Mapping[str, Any]) -> str:
    """`effect(target)`."""
    target = finding["target"]
    return f"{finding['effect']}({target if isinstance(target, str) else ', '.join(target)})"


def number(value: float | None, digits: int = 3) -> str:
    """A number as the pages write it; a dash where it is not known."""
    return "–" if value is None else f"{value:.{digits}g}"


def _verdict(known: Known, document: Mapping[str, Any]) -> tuple[str, str, bool]:
    verdict, wanted = document["verdict"], str(known.verdict)
    agrees = verdict != wanted.removeprefix("not ") if wanted.startswith("not ") else verdict == wanted
    return wanted, f"{verdict} with probability {document['probability']:.3f}", agrees


def _family(known: Known, document: Mapping[str, Any]) -> tuple[str, str, bool]:
    probability = document["family_probability"].get(known.family, 0.0)
    agrees = probability < 1 - CERTAIN if known.absent else probability >= CERTAIN
    expected = f"{'no ' if known.absent else ''}{known.family}"
    return expected, f"{known.family} with probability {probability:.3f}", agrees


def _open(known: Known, document: Mapping[str, Any]) -> tuple[str, str, bool]:
    laws = [f for f in document["findings"] if f["family"] == known.open]
    told = ", ".join(f"`{f['effect']}` {f['probability']:.3f}" for f in laws) or f"no {known.open} named"
    return f"no law of {known.open} above {CERTAIN}", told, all(f["probability"] <= CERTAIN for f in laws)


def _effects(known: Known, document: Mapping[str, Any]) -> tuple[str, str, bool]:
    names = {name for f in document["findings"] for name in (f["effect"], effect_name(f))}
    hits = [name for name in known.effects if name in names]
    met = len(hits) == len(known.effects) if known.all else bool(hits)
    told = ", ".join(f"`{effect_name(f)}` {f['probability']:.3f}" for f in document["findings"]) or "no finding"
    return (" and " if known.all else " or ").join(f"`{name}`" for name in known.effects), told, met


def _only(known: Known, document: Mapping[str, Any]) -> tuple[str, str, bool]:
    told = ", ".join(f"`{effect_name(f)}`" for f in document["findings"]) or "no finding"
    allowed = " or ".join(f"`{name}`" for name in known.only)
    return f"{allowed}, or no name", told, {f["effect"] for f in document["findings"]} <= set(known.only)


def _moment(known: Known, document: Mapping[str, Any]) -> tuple[str, str, bool]:
    windows = document["location"]["time_windows"]
    told = "; ".join(f"{number(w[0], 4)} to {number(w[1], 4)}" for w in windows) or "no time"
    met = any(w[0] <= known.moment <= w[1] and w[1] - w[0] <= known.value for w in windows)
    return f"{number(known.moment, 4)}, in a window of at most {number(known.value, 4)}", told, met


def _coefficient(known: Known, document: Mapping[str, Any]) -> tuple[str, str, bool]:
    effect, _, name = str(known.coefficient).partition(".")
    for finding in document["findings"]:
        if effect in (finding["effect"], effect_name(finding)):
            found = finding["coefficients"][name]
            return _range(known), *_inside(known, found["mean"], found["interval95"])
    return _range(known), "not reported", False


def _range(known: Known) -> str:
    return number(known.value, 4) + ("" if known.upper is None else f" to {number(known.upper, 4)}")


def _inside(known: Known, mean: float, interval: Sequence[float]) -> tuple[str, bool]:
    """A mean and its interval in words, and whether the interval meets the known value or range."""
    low, high = interval
    least, most = known.value, known.value if known.upper is None else known.upper
    meets = low <= most and high >= least
    nearest = least if mean < least else most
    off = "" if meets else f"; off by {abs(mean / nearest - 1):.1%}"
    return f"{number(mean, 4)}, 95 % between {number(low, 4)} and {number(high, 4)}{off}", meets


def _parameter(known: Known, document: Mapping[str, Any]) -> tuple[str, str, bool]:
    found = document["parameters"]["after"].get(known.parameter)
    if found is None:
        return _range(known), "not calibrated", False
    mean, sd = found["mean"], found["sd"]
    return _range(known), *_inside(known, mean, (mean - 1.96 * sd, mean + 1.96 * sd))


def _column(known: Known, document: Mapping[str, Any]) -> tuple[str, str, bool]:
    held_out = document["fit"]["after"]["holdout_rmse"] or {}
    error = held_out.get(known.column)
    expected = f"{number(known.value)}, within a factor of {known.factor:g}"
    if error is None:
        return expected, "no held-out error", False
    return expected, f"{number(error)}, a factor of {error / known.value:.2f}", error <= known.factor * known.value


# How a fact is asked, by the key that it is given with.
WAYS: dict[str, Callable[[Known, Mapping[str, Any]], tuple[str, str, bool]]] = {
    "verdict": _verdict,
    "family": _family,
    "open": _open,
    "effects": _effects,
    "only": _only,
    "moment": _moment,
    "coefficient": _coefficient,
    "parameter": _parameter,
    "column": _column,
}
