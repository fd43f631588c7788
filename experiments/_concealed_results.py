"""The scored rows as numbers: for each way of hiding and in all; calibration, false alarms, and the printed tables."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from ._command import print_table
from ._concealed_hiding import WAYS

Row = Mapping[str, Any]
BINS = (0.0, 0.3, 0.5, 0.7, 0.85, 0.95, 1.0 + 1e-9)
ALARMS = 0.02


def groups(rows: Sequence[Row]) -> dict[str, list[Row]]:
    """Rows with an effect, by way of hiding; then all of them, those with a remainder, those without a word."""
    concealed = [r for r in rows if r["way"] != "healthy"]
    found = {way: [r for r in concealed if r["way"] == way] for way in WAYS}
    found["all"] = concealed
    found["with a remainder"] = [r for r in concealed if r["remainder"]]
    found["outside the vocabulary"] = [r for r in concealed if r["outside"]]
    found["oracle can name"] = [r for r in concealed if nameable(r)]
    found["of the fitted rows"] = [r for r in concealed if nameable(r, "early")]
    return {name: members for name, members in found.items() if members}


def nameable(r: Row, part: str | None = None) -> bool:
    """Whether the oracle itself can name the truth, of all rows or of a part of them."""
    told = (r["oracle"] or {}).get(part, {}) if part else r["oracle"] or {}
    return bool(told.get("nameable")) and not r["outside"]


def share(values: Iterable[bool]) -> float | None:
    """Part that is true; None of nothing."""
    values = list(values)
    return float(np.mean(values)) if values else None


def middle(values: Iterable[float | None]) -> float | None:
    """Median of what is there."""
    there = [v for v in values if v is not None]
    return float(np.median(there)) if there else None


def summary(rows: Sequence[Row]) -> dict[str, Any]:
    """One line of the table."""
    coefficients = [c for r in rows for c in r["coefficients"]]
    return {
        "cases": len(rows),
        "detected": share(r["detected"] for r in rows),
        "located": share(r["located"] for r in rows),
        "exact": share(r["exact"] for r in rows),
        "inside_95": share(r["inside"] for r in rows),
        "set_size": middle(r["size"] for r in rows),
        "coefficient_inside": share(c["inside"] for c in coefficients),
        "width_over_oracle": middle(_over(c["width"], _oracle_width(r, c)) for r in rows for c in r["coefficients"]),
        "holdout_over_oracle": middle(_over(r["holdout_after"], _of(r, "holdout")) for r in rows),
        "forecast_over_oracle": middle(_over(r["forecast_after"], _of(r, "forecast")) for r in rows),
        "forecast_over_before": middle(_over(r["forecast_after"], r["forecast_before"]) for r in rows),
        "seconds": middle(r["seconds"] for r in rows),
    }


def _of(r: Row, what: str) -> float | None:
    return r["oracle"].get(what) if r["oracle"] else None


def _over(one: float | None, other: float | None) -> float | None:
    return None if one is None or not other else one / other


def _oracle_width(r: Row, c: Mapping[str, Any]) -> float | None:
    widths = (r["oracle"] or {}).get("widths", {})
    return widths.get("|".join([*c["effect"], c["name"]]))


def calibration(pairs: Sequence[tuple[float, bool]]) -> list[dict[str, Any]]:
    """Bins of probability against the frequency of being right."""
    found = []
    for low, high in zip(BINS[:-1], BINS[1:], strict=True):
        inside = [(p, hit) for p, hit in pairs if low <= p < high]
        if inside:
            mean, hits = float(np.mean([p for p, _ in inside])), int(sum(hit for _, hit in inside))
            found.append({"from": low, "to": min(high, 1.0), "number": len(inside), "mean": mean, "right": hits})
    return found


def brier(pairs: Sequence[tuple[float, bool]]) -> dict[str, float] | None:
    """Brier score, what it would be if the probabilities were right, and that expectation's sampling error."""
    if not pairs:
        return None
    p, hit = np.array([x for x, _ in pairs]), np.array([float(y) for _, y in pairs])
    error = np.sqrt(np.sum(p * (1 - p) * (1 - 2 * p) ** 2)) / len(p)
    return {
        "score": float(np.mean((p - hit) ** 2)),
        "expected": float(np.mean(p * (1 - p))),
        "sampling_error": float(error),
    }


def at_fixed_alarms(rows: Sequence[Row]) -> dict[str, Any]:
    """Detection with the threshold on 1 - P(nothing) that at most 2 % of the healthy cases pass."""
    healthy = sorted((r["score"] for r in rows if r["way"] == "healthy"), reverse=True)
    concealed = [r["score"] for r in rows if r["way"] != "healthy"]
    threshold = healthy[int(ALARMS * len(healthy))] if healthy else 0.0
    return {"threshold": threshold, "detected": share(s > threshold for s in concealed), "healthy": len(healthy)}


def metrics(rows: Sequence[Row]) -> dict[str, Any]:
    """Everything that is measured."""
    healthy = [r for r in rows if r["way"] == "healthy"]
    told = [(r["probability"], r["exact"]) for r in rows if r["probability"] is not None]
    findings = [pair for r in rows for pair in r["findings"]]
    return {
        "groups": {name: summary(members) for name, members in groups(rows).items()},
        "healthy": len(healthy),
        "false_alarms": sum(r["detected"] for r in healthy),
        "failed": sum(r["status"] != "done" for r in rows),
        "calibration": calibration(told),
        "calibration_of_findings": calibration(findings),
        "brier": brier(told),
        "brier_of_findings": brier(findings),
        "at_2_percent_alarms": at_fixed_alarms(rows),
        "median_seconds": middle(r["seconds"] for r in rows),
    }


_COLUMNS = ("cases", "detected", "located", "exact", "inside_95", "set_size", "coefficient_inside", "width_over_oracle",
            "holdout_over_oracle", "forecast_over_oracle", "forecast_over_before", "seconds")  # fmt: skip


def _cell(value: Any) -> Any:
    return "-" if value is None else round(value, 3) if isinstance(value, float) else value


def report(found: Mapping[str, Any]) -> None:
    """The tables."""
    print_table(["hidden", *_COLUMNS], *([n, *(_cell(g[c]) for c in _COLUMNS)] for n, g in found["groups"].items()))
    print(f"\nFalse alarms: {found['false_alarms']} of {found['healthy']} healthy; failed: {found['failed']}")
    fixed = found["at_2_percent_alarms"]
    print(f"Detection at 2 % false alarms (1 - P(nothing) > {fixed['threshold']:.3g}): {_cell(fixed['detected'])}")
    for what, name in (("", "reported combinations"), ("_of_findings", "single findings")):
        score = found["brier" + what]
        if score:
            print(f"\nProbability against frequency, {name}; Brier score {score['score']:.3f}, expected "
                  f"{score['expected']:.3f} +- {score['sampling_error']:.3f}")  # fmt: skip
            rows = [[f"{b['from']:.2f} to {b['to']:.2f}", b["number"], round(b["mean"], 3),
                     round(b["right"] / b["number"], 3)] for b in found["calibration" + what]]  # fmt: skip
            print_table(["probability", "number", "mean", "right"], *rows)


def table_of_cases(rows: Sequence[Row], write: Callable[[str], Any] = print) -> None:
    """A line for a case: what was hidden how, and what came back."""
    for r in rows:
        truth = " + ".join(f"{w}({t})" for w, t in r["truth"]) or "nothing"
        said = " + ".join(f"{w}({t})" for w, t in r["reported"]) or r["verdict"]
        p = "" if r["probability"] is None else f" {r['probability']:.2f}"
        mark = "right" if r["exact"] else "in set" if r["inside"] else "WRONG"
        write(f"{r['case']}  {r['way']:<14} {mark:<6} D {r['detectable']:6.1f}  {truth}  ->  {said}{p}")
