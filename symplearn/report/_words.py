"""Numbers and names as they are said: four digits, per cent, a dash for what is not known."""

import math
from collections.abc import Mapping
from typing import Any

from .. import _effects as effects
from .._effects import EFFECTS
from .._errors import printable
from .._vocabulary import COLUMN, PARAMETER, VOCABULARY

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


def targets(finding: Mapping[str, Any]) -> list[str]:
    """The names an effect acts on: one, or two."""
    target = finding["target"]
    return [target] if isinstance(target, str) else list(target)


def side(finding: Mapping[str, Any]) -> str | None:
    """The side of a stop, `upper` or `lower`; it stands beside the coefficients or among them."""
    return finding.get("side") or finding.get("coefficients", {}).get("side")


def takes_back(finding: Mapping[str, Any]) -> bool:
    """Whether it takes from a loss that a known term has too much of."""
    known = EFFECTS.get(finding["effect"])
    return known is not None and effects.takes_back(known, finding.get("coefficients") or {})


def effect(finding: Mapping[str, Any], recordings: int = 1) -> str:
    """`viscous damping on theta`: an effect and its target, in words; with its recordings where not in all."""
    name, places = plain(finding["effect"]), [plain(target) for target in targets(finding)]
    where = f"between {' and '.join(places)}" if len(places) > 1 else f"{_preposition(name)} {places[0]}"
    which = f"{plain(side(finding))} " if side(finding) else "too much " if takes_back(finding) else ""
    return f"{which}{name.replace('_', ' ')} {where}{_only(finding, recordings)}"


def _preposition(name: str) -> str:
    return "of" if name in VOCABULARY and VOCABULARY[name].target in (PARAMETER, COLUMN) else "on"


def _only(finding: Mapping[str, Any], recordings: int) -> str:
    """` in recording 2 only`."""
    mine = finding.get("recordings") or []
    if not mine or len(mine) >= recordings:
        return ""
    return f" in recording{'s' if len(mine) > 1 else ''} {' and '.join(map(str, mine))} only"


def combination(findings: list[Mapping[str, Any]], unexplained: bool = False, recordings: int = 1) -> str:
    """A combination of effects in words, or one of the two without any."""
    if findings:
        return ", ".join(effect(one, recordings) for one in findings)
    return "something without a name (process noise alone)" if unexplained else "nothing left out"
