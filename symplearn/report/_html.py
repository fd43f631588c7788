"""A diagnosis -> one HTML file that needs nothing else."""

import re
from collections.abc import Mapping
from typing import Any

import jinja2
from markupsafe import Markup, escape

from .._errors import printable
from .._vocabulary import symbol
from ..diagnosis._record import Diagnosis
from ._equation import equation_pairs
from ._figures import not_drawn, plates
from ._units import coefficient_unit
from ._verdict import caution, verdict_sentence, where_and_when
from ._words import DASH, combination, effect, estimate, interval, number, plain, probability, ratio, targets


def html_report(diagnosis: Diagnosis) -> str:
    """The text of `report.html`: pictures and style inside, no script; all text of files is escaped."""
    document = diagnosis.document
    changed, all_rows = document["verdict"] != "consistent", document["all_rows"]
    return _template().render(
        title=diagnosis.title or "Diagnosis",
        document=document,
        changed=changed,
        verdict=verdict_sentence(diagnosis),
        problem=caution(document),
        location=where_and_when(diagnosis),
        held_back=combination(all_rows["likeliest"]["findings"], unexplained=True) if all_rows else None,
        findings=[_finding(finding, diagnosis) for finding in document["findings"]],
        equations=equation_pairs(diagnosis.equation_before, diagnosis.equation_after),
        plates=plates(diagnosis),
        not_drawn=not_drawn(diagnosis),
        fit=_fit_rows(diagnosis),
        parameters=_parameter_rows(document["parameters"], diagnosis.units),
        remaining=_remaining(document["fit"], changed),
        alternatives=_alternatives(document, len(diagnosis.series)),
        recordings=[f"{i}: {plain(series.name)}" for i, series in enumerate(diagnosis.series, 1)],
    )


def _template() -> jinja2.Template:
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("symplearn.report", ""),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        finalize=_said,
    )
    environment.filters |= {
        "number": number,
        "probability": probability,
        "exactly": _exactly,
        "inside": Markup,
    }
    return environment.get_template("template.html")


def _said(value: object) -> object:
    """What is printed of a value: a dash for what is not known, a text on one line."""
    if value is None:
        return DASH
    return plain(value) if isinstance(value, str) and not isinstance(value, Markup) else value


def _exactly(text: str) -> Markup:
    """A piece of an equation with its spaces, escaped."""
    return escape(printable(re.sub(r"\s", " ", text)))


def _finding(finding: Mapping[str, Any], diagnosis: Diagnosis) -> dict[str, Any]:
    coefficients = [
        {
            "name": symbol(name, targets(finding)),
            "mean": number(value["mean"]) if isinstance(value, Mapping) else str(value),
            "sd": number(value["sd"], 2) if isinstance(value, Mapping) else DASH,
            "interval": interval(value["interval95"]) if isinstance(value, Mapping) else DASH,
            "unit": coefficient_unit(finding, diagnosis, name) or "",
        }
        for name, value in finding["coefficients"].items()
    ]
    units = any(coefficient["unit"] for coefficient in coefficients)
    said = effect(finding, len(diagnosis.series))
    return {"effect": said, "record": finding, "coefficients": coefficients, "units": units}


def _fit_rows(diagnosis: Diagnosis) -> list[tuple[str, str, str, str]]:
    """Rows of the table of fit numbers: what, before, after, how many times smaller."""
    before, after = diagnosis.document["fit"]["before"], diagnosis.document["fit"]["after"]
    rows = _row_each("Held-out rmse", before["holdout_rmse"], after["holdout_rmse"], diagnosis.units)
    rows += _row_each("Held-out misfit by what is expected", before["holdout_misfit"], after["holdout_misfit"], {})
    density = before["holdout_log_density"], after["holdout_log_density"]
    rows.append(("Held-out log density [nats]", number(density[0]), number(density[1]), DASH))
    rows += _row_each("Process noise", before["process_noise_sd"], after["process_noise_sd"], {})
    return rows + _row_each("Reading noise", before["noise_sd"], after["noise_sd"], diagnosis.units)


def _row_each(
    what: str, before: Mapping[str, Any] | None, after: Mapping[str, Any] | None, units: Mapping[str, str]
) -> list[tuple[str, str, str, str]]:
    before, after = before or {}, after or {}
    rows = []
    for name in dict.fromkeys([*before, *after]):
        old, now = before.get(name), after.get(name)
        rows.append((f"{what}, {_named(name, units)}", number(old), number(now), ratio(old, now)))
    return rows


def _parameter_rows(parameters: Mapping[str, Any], units: Mapping[str, str]) -> list[tuple[str, str, str]]:
    """Calibrated parameters: name, before, after."""
    before, after = parameters["before"], parameters["after"]
    return [
        (_named(name, units), estimate(before.get(name)), estimate(after.get(name)))
        for name in dict.fromkeys([*before, *after])
    ]


def _named(name: str, units: Mapping[str, str]) -> str:
    return f"{name} [{units[name]}]" if name in units else name


def _remaining(fit: Mapping[str, Any], changed: bool) -> list[str]:
    """How much process noise the last fit still needs, by equation, in sentences."""
    before = fit["before"]["process_noise_sd"] or {}
    return [
        f"d({name})/dt: {number(now)} per square root of time"
        + (f", {number(before.get(name))} before" if changed else "")
        for name, now in (fit["after"]["process_noise_sd"] or {}).items()
    ]


def _alternatives(document: Mapping[str, Any], recordings: int) -> list[tuple[str, str]]:
    """What else was weighed, with its probability; the last row is all the rest."""
    unexplained = document["verdict"] == "unexplained"
    reported = combination(document["findings"], unexplained, recordings) + " (reported)"
    rows = [(reported, probability(document["probability"]))]
    rows += [
        (combination(one["findings"], one.get("unexplained", False), recordings), probability(one["probability"]))
        for one in document["alternatives"]
    ]
    return [*rows, ("all other combinations together", probability(document["other"]))]
