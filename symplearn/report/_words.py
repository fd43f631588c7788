"""Numbers and names as they are said: four digits, per cent, a dash for what is not known."""

import math
from collections.abc import Mapping
from typing import Any

from .._errors import printable

DASH = "–"


def plain(text: object) -> str:
    """Text of a file on one line, without anything that could steer a terminal or turn the reading order."""
    return printable(" ".join(str(text).split()))


def number(value: float | None, digits: int = 4) -> str:
    """Four significant digits; a dash for `None`."""
    if value is None or not math.isfinite(value):
        return DASH
    return f"{value:.{digits}g}"


def probability(value: float | None) -> str:
    """A probability in per cent; never a flat 0 or 100."""
    if value is None:
        return DASH
    if value > 0.999:
        return "more than 99.9 %"
    if value < 0.001:
        return "less than 0.1 %"
    return f"{100 * value:.3g} %"


def interval(ends: tuple[float, float] | list[float] | None) -> str:
    """`a to b`."""
    return DASH if ends is None else f"{number(ends[0])} to {number(ends[1])}"


def estimate(value: Mapping[str, Any] | None) -> str:
    """Mean and standard deviation, `a ± b`."""
    if value is None:
        return DASH
    spread = value.get("sd")
    return number(value.get("mean")) + ("" if spread is None else f" ± {number(spread, 2)}")


def ratio(before: float | None, after: float | None) -> str:
    """How many times smaller `after` is."""
    if before is None or after is None or after <= 0:
        return DASH
    return number(before / after, 3)


def effect(finding: Mapping[str, Any]) -> str:
    """`viscous damping on theta`: an effect and its target, in words."""
    target = finding["target"]
    places = [target] if isinstance(target, str) else list(target)
    return f"{plain(finding['effect']).replace('_', ' ')} on {' and '.join(map(plain, places))}"


def combination(findings: list[Mapping[str, Any]], unexplained: bool = False) -> str:
    """A combination of effects in words, or one of the two without any."""
    if findings:
        return ", ".join(map(effect, findings))
    return "something without a name (process noise alone)" if unexplained else "nothing left out"
