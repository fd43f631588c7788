"""What each diagnosis got right: a row for a case, from its answer and what came back. Only this opens the answers."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from scipy.interpolate import make_interp_spline

from ._concealed_effects import OUTSIDE
from ._concealed_equivalent import Key, equivalent, same, swallowed

CREDIBLE = 0.95


def key(one: Mapping[str, Any]) -> Key:
    """Word and target as one text."""
    target = one["target"]
    return one["effect"], target if isinstance(target, str) else ",".join(target)


def entries(document: Mapping[str, Any]) -> list[tuple[tuple[Key, ...], bool, float]]:
    """Every combination that was weighed and is told: its keys, whether it is the unexplained one, its probability."""
    first = (tuple(key(f) for f in document["findings"]), document["verdict"] == "unexplained", document["probability"])
    rest = [
        (tuple(key(f) for f in row["findings"]), row["unexplained"], row["probability"])
        for row in document["alternatives"]
    ]
    return sorted([first, *rest], key=lambda e: -e[2])


def nothing(document: Mapping[str, Any]) -> float:
    """Probability that nothing was left out."""
    return sum(p for keys, unexplained, p in entries(document) if not keys and not unexplained)


def right(answer: Mapping[str, Any], keys: Sequence[Key], unexplained: bool) -> bool:
    """Whether a combination is the truth, or cannot be told from it.

    An effect without a word is right as `unexplained` or as `unnamed_force`, beside any named one that is there.
    """
    truth = [key(e) for e in answer["effects"]]
    named = [k for k in truth if k[0] not in OUTSIDE]
    if len(named) < len(truth):
        rest = [k for k in keys if k[0] != "unnamed_force"]
        return unexplained or (len(rest) < len(keys) and (same(answer, named, rest) or not rest))
    if unexplained:
        return False
    owned = [k for k in truth if swallowed(answer, k)]
    return same(answer, truth, keys) or (bool(owned) and same(answer, [k for k in truth if k not in owned], keys))


def credible_set(answer: Mapping[str, Any], document: Mapping[str, Any]) -> tuple[bool, int]:
    """Whether the truth is among the likeliest combinations that make up 95 %, and how many these are."""
    total, size, inside = 0.0, 0, False
    for keys, unexplained, p in entries(document):
        if total >= CREDIBLE:
            break
        total, size = total + p, size + 1
        inside |= right(answer, keys, unexplained)
    return inside, size


def located(answer: Mapping[str, Any], document: Mapping[str, Any]) -> bool:
    """Kind, targets and recordings of the mismatch are the truth's; of targets, equivalent ones count."""
    place, effects = document["location"], answer["effects"]
    if document["verdict"] == "consistent":
        return False
    if document["findings"] and right(answer, [key(f) for f in document["findings"]], False):
        return recordings_right(answer, document)
    truth = {t for e in effects for t in ([e["target"]] if isinstance(e["target"], str) else e["target"])}
    found = {t for name in place["targets"] for t in name.split(",")}
    return place["kind"] == answer["kind"] and found == truth and recordings_right(answer, document)


def recordings_right(answer: Mapping[str, Any], document: Mapping[str, Any]) -> bool:
    """The recordings that are named are those that hold an effect."""
    every = [r["number"] for r in answer["records"]]
    truth = {n for e in answer["effects"] for n in (e["recordings"] or every)}
    return set(document["location"]["recordings"]) == truth


def coefficients(answer: Mapping[str, Any], document: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Of the findings that have their true name: each coefficient, whether its interval holds the truth, the width."""
    found = []
    truths = {key(e): e for e in answer["effects"]}
    for finding in document["findings"]:
        truth = truths.get(key(finding))
        if truth is None:
            continue
        for name, one in finding["coefficients"].items():
            if name in truth["values"] and isinstance(truth["values"][name], float) and "interval95" in one:
                low, high = one["interval95"]
                at = truth["values"][name]
                turns = [at - 2 * np.pi, at, at + 2 * np.pi] if name == "phi" else [at]
                inside = any(low <= t <= high for t in turns)
                found.append({"effect": key(finding), "name": name, "inside": inside, "width": high - low})
    return found


def forecast_error(answer: Mapping[str, Any], forecast: Mapping[str, Any] | None, what: str) -> float | None:
    """Rms of a forecast's error over the first recording's future, in sd of the noise; None where there is none."""
    if forecast is None or "t" not in forecast or not answer["records"][0]["after"][0] <= forecast["t"][-1]:
        return None
    times, truth = np.array(answer["records"][0]["after"]), np.array(answer["forecast"][0])
    # Where cells are empty, what is asked reaches a few rows less far than the truth that was kept.
    there = times <= forecast["t"][-1] * (1 + 1e-9)
    times, truth = times[there], truth[there]
    errors = []
    for k, column in enumerate(answer["columns"]):
        if f"{column}_{what}" not in forecast:
            return None
        # Its rows lie beside the true ones where times are jittered, and are few over a bend of an orbit.
        shown = make_interp_spline(forecast["t"], forecast[f"{column}_{what}"], k=min(3, len(forecast["t"]) - 1))(times)
        errors.append((shown - truth[:, k]) / answer["noise"][column])
    return float(np.sqrt(np.mean(np.square(errors))))


def scaled(answer: Mapping[str, Any], rmse: Mapping[str, float] | None) -> float | None:
    """Held-out errors by column as one number in sd of the noise."""
    if not rmse:
        return None
    return float(np.sqrt(np.mean([(rmse[c] / answer["noise"][c]) ** 2 for c in answer["columns"]])))


def row(name: str, answer: Mapping[str, Any], result: Mapping[str, Any], oracle: Mapping[str, Any] | None) -> dict:
    """Everything that is scored of one case. A diagnosis that failed has got nothing right."""
    truth = [key(e) for e in answer["effects"]]
    found = {
        "case": name,
        "way": answer["way"],
        "system": answer["system"],
        "truth": truth,
        "outside": any(k[0] in OUTSIDE for k in truth),
        "remainder": bool(answer["remainder"] or answer["jitter"]),
        "detectable": answer["claim"]["detectable"],
        "swallowed": bool(truth) and all(swallowed(answer, k) for k in truth),
        "status": result["status"],
        "seconds": result["seconds"],
        "oracle": oracle,
    }
    document = result["document"]
    return found | (_judged(answer, document, result) if document else dict(_FAILED))


def _of_class(answer: Mapping[str, Any], document: Mapping[str, Any], keys: Sequence[Key]) -> float:
    """Probability of the reported combination and of those that no recording can tell from it."""
    flag = document["verdict"] == "unexplained"
    return min(1.0, sum(p for k, unexplained, p in entries(document) if unexplained == flag and same(answer, keys, k)))


_FAILED = {"verdict": "failed", "score": 0.0, "detected": False, "located": False, "exact": False, "inside": False,
           "size": 0, "probability": None, "reported": [], "findings": [], "coefficients": [], "holdout_after": None,
           "holdout_before": None, "forecast_after": None, "forecast_before": None}  # fmt: skip


def _present(answer: Mapping[str, Any], found: Key) -> bool:
    return any(equivalent(answer, found, key(e)) for e in answer["effects"])


def _judged(answer: Mapping[str, Any], document: Mapping[str, Any], result: Mapping[str, Any]) -> dict[str, Any]:
    keys = [key(f) for f in document["findings"]]
    inside, size = credible_set(answer, document)
    return {
        "verdict": document["verdict"],
        "score": 1.0 - nothing(document),
        "detected": document["verdict"] != "consistent",
        "located": located(answer, document),
        "exact": right(answer, keys, document["verdict"] == "unexplained"),
        "inside": inside,
        "size": size,
        "probability": _of_class(answer, document, keys),
        "reported": keys,
        "findings": [(f["probability"], _present(answer, key(f))) for f in document["findings"]],
        "coefficients": coefficients(answer, document),
        "holdout_after": scaled(answer, document["fit"]["after"]["holdout_rmse"]),
        "holdout_before": scaled(answer, document["fit"]["before"]["holdout_rmse"]),
        "forecast_after": forecast_error(answer, result["forecast"], "after"),
        "forecast_before": forecast_error(answer, result["forecast"], "before"),
    }  # fmt: skip
