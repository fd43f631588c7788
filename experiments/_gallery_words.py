"""One diagnosis in Markdown: what was found, before and after. Every number comes from its diagnosis.json."""

import re
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from ._gallery_known import effect_name, number
from ._gallery_results import Result

ALTERNATIVES = 5  # most that a page lists
WINDOWS = 6


def escaped(text: str) -> str:
    """Text of a diagnosis as Markdown shows it letter by letter."""
    return re.sub(r"([\\`*<>|\[\]])", r"\\\1", text)


def table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A Markdown table."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(cells) + " |" for cells in lines)


def found_section(result: Result) -> str:
    """Verdict, findings with their coefficients, location, alternatives, what to record next, warnings."""
    document = result.document
    total = len({name.split("/")[0] for name in result.series if "/" in name})
    findings = [_finding(one, total) for one in document["findings"]]
    parts = [_verdict_line(document), *findings, _location(document["location"])]
    parts += [_alternatives(document), _next(document), *_warnings(document)]
    return "\n\n".join(part for part in parts if part)


def before_after(result: Result) -> str:
    """Held-out error of every column, log density, and the noises that are needed, before and after."""
    fit = result.document["fit"]
    before, after = fit["before"], fit["after"]
    rows = [_error_row(column, value, (after["holdout_rmse"] or {}).get(column), result) for column, value in
            (before["holdout_rmse"] or {}).items()]  # fmt: skip
    densities = before["holdout_log_density"], after["holdout_log_density"]
    rows.append(["log density of the held-out rows, nats", *(number(x, 4) for x in densities), _difference(*densities)])
    for kind, words in (("process_noise_sd", "random force needed on"), ("noise_sd", "reading noise of")):
        rows += [[f"{words} `{name}`", number(value), number(after[kind][name]), ""]
                 for name, value in before[kind].items()]  # fmt: skip
    return table(["", "before", "after", ""], rows)


def summary_cells(result: Result) -> list[str]:
    """Verdict, findings, dissipation or the likeliest family, errors before and after, ratio, seconds: one row."""
    if result.failure:
        return ["failed", escaped(result.failure), "–", "–", "–", "–"]
    document = result.document
    return [f"`{document['verdict']}`", findings_line(document), *error_cells(document), f"{document['seconds']:.0f}"]


def findings_line(document: Mapping[str, Any]) -> str:
    """The findings with their probabilities, and the likeliest family's."""
    named = "; ".join(f"{effect_name(f)} {f['probability']:.2f}" for f in document["findings"]) or "nothing named"
    family = max(document["family_probability"].items(), key=lambda item: item[1], default=None)
    told = f" ({family[0]} {family[1]:.3f})" if family and document["findings"] else ""
    return escaped(named + told)


def error_cells(document: Mapping[str, Any]) -> list[str]:
    """Held-out error before, after and the ratio, each over all columns (root of the mean of squares)."""
    before, after = pooled_errors(document)
    return [number(before), number(after), ratio(before, after)]


def pooled_errors(document: Mapping[str, Any]) -> tuple[float | None, float | None]:
    """Held-out error over all columns, before and after; `None` where no row was held out."""
    return _pooled(document["fit"]["before"]["holdout_rmse"]), _pooled(document["fit"]["after"]["holdout_rmse"])


def ratio(before: float | None, after: float | None) -> str:
    """How many times smaller the error has become; a dash where nothing was added."""
    if before is None or after is None or after <= 0 or after == before:
        return "–"
    return f"{before / after:.3g} ×"


def _pooled(errors: Mapping[str, float | None] | None) -> float | None:
    values = [value for value in (errors or {}).values() if value is not None]
    return (sum(value**2 for value in values) / len(values)) ** 0.5 if values else None


def _error_row(column: str, before: float | None, after: float | None, result: Result) -> list[str]:
    unit = _units(result).get(column)
    name = f"held-out error of `{column}`" + (f", {unit}" if unit else "")
    return [name, number(before), number(after), _smaller(before, after)]


def _smaller(before: float | None, after: float | None) -> str:
    told = ratio(before, after)
    return f"{told} smaller" if told != "–" else ""


def _units(result: Result) -> Mapping[str, str]:
    return tomllib.loads(result.simulation).get("units", {})


def _difference(before: float | None, after: float | None) -> str:
    return "" if before is None or after is None or after == before else f"{after - before:+.4g}"


def _verdict_line(document: Mapping[str, Any]) -> str:
    evidence = document["log_bayes_factor"]
    line = f"Verdict: **{document['verdict']}**, probability {document['probability']:.3f}"
    line += f", {number(evidence, 4)} nats above the simulation without effects" if document["findings"] else ""
    families = document["family_probability"].items()
    told = ", ".join(f"{family} {probability:.3f}" for family, probability in families if probability >= 0.001)
    return line + "." + (f" By kind: {told}." if told else "")


def _finding(finding: Mapping[str, Any], total: int) -> str:
    places = finding["recordings"]
    where = f" in recording {', '.join(map(str, places))} of {total}" if len(places) < total else ""
    sentence = f"* **{escaped(effect_name(finding))}**{where}, probability {finding['probability']:.3f}. "
    return sentence + escaped(finding["sentence"]) + "".join(map(_coefficient, finding["coefficients"].items()))


def _coefficient(item: tuple[str, Any]) -> str:
    name, value = item
    if not isinstance(value, Mapping):
        return f"\n  * `{name}`: {escaped(str(value))}"
    low, high = value["interval95"]
    return f"\n  * `{name}` = {number(value['mean'], 4)}, 95 % between {number(low, 4)} and {number(high, 4)}"


def _location(location: Mapping[str, Any]) -> str:
    if location["kind"] == "none":
        return ""
    targets = ", ".join(f"`{x if isinstance(x, str) else ', '.join(x)}`" for x in location["targets"])
    windows = "; ".join(map(_window, location["time_windows"][:WINDOWS]))
    more = len(location["time_windows"]) - WINDOWS
    windows += f"; and {more} more" if more > 0 else ""
    return f"Where: {escaped(location['where'])} ({location['kind']}; {targets}). When: {windows}."


def _window(window: Sequence[float]) -> str:
    recording = f" in recording {window[2]:.0f}" if len(window) > 2 else ""
    return f"{number(window[0], 4)} to {number(window[1], 4)}{recording}"


def _alternatives(document: Mapping[str, Any]) -> str:
    rows = [[_alternative(row), f"{row['probability']:.3f}"] for row in document["alternatives"][:ALTERNATIVES]
            if row["probability"] >= 0.001]  # fmt: skip
    if not rows:
        return "No alternative has a probability of 0.001 or more."
    return table(["what else it could be", "probability"], rows)


def _alternative(row: Mapping[str, Any]) -> str:
    if row["findings"]:
        return escaped(" and ".join(effect_name(f) for f in row["findings"]))
    return "something without a name" if row["unexplained"] else "the simulation as it is"


def _next(document: Mapping[str, Any]) -> str:
    wish = document["next_measurement"]
    return f"To record next: {escaped(wish).rstrip('.')}." if wish else ""


def _warnings(document: Mapping[str, Any]) -> list[str]:
    notes = [f"Warning: {escaped(warning).rstrip('.')}." for warning in document["warnings"]]
    return notes + ([] if document["converged"] else ["Warning: the fit did not converge."])
