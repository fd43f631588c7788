"""Figures of the concealed trial: confusion matrix, reliability diagram, strength against detection."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from ._concealed_effects import OUTSIDE

Row = Mapping[str, Any]
GREY, BLUE, RED = "0.55", "#2c6fbb", "#c23b22"


def _families(keys: Sequence[Any]) -> str:
    return " + ".join(sorted({word for word, _ in keys}))


def confusion(rows: Sequence[Row]) -> Figure:
    """True words against reported words; combinations that occur once or more."""
    pairs = [(_families(r["truth"]) or "nothing", _said(r)) for r in rows if len(r["truth"]) < 2]
    truths = sorted({a for a, _ in pairs}, key=lambda a: (a != "nothing", a))
    found = sorted({b for _, b in pairs}, key=lambda b: (b not in truths, truths.index(b) if b in truths else 0, b))
    counts = np.zeros((len(truths), len(found)))
    for a, b in pairs:
        counts[truths.index(a), found.index(b)] += 1
    figure = Figure(figsize=(2.8 + 0.32 * len(found), 2.8 + 0.26 * len(truths)), layout="constrained")
    axes = figure.subplots()
    part = counts / np.maximum(counts.sum(axis=1, keepdims=True), 1)
    axes.imshow(part, cmap="Blues", vmin=0, vmax=1.3, aspect="auto")
    for a, b in np.argwhere(counts):
        same = truths[a] == found[b] or (truths[a] in OUTSIDE and found[b] in ("unexplained", "unnamed_force"))
        axes.text(b, a, f"{counts[a, b]:.0f}", ha="center", va="center", fontsize=7, weight="bold" if same else None)
    axes.set_xticks(range(len(found)), [f.replace("_", " ") for f in found], rotation=90, fontsize=7)
    axes.set_yticks(range(len(truths)), [t.replace("_", " ") for t in truths], fontsize=7)
    axes.set_xlabel("reported")
    axes.set_ylabel("hidden (cases of one effect or none)")
    return figure


def _said(r: Row) -> str:
    if len(r["reported"]) > 1:
        return "two effects or more"
    return _families(r["reported"]) or ("nothing" if r["verdict"] == "consistent" else r["verdict"])


def reliability(found: Mapping[str, Any]) -> Figure:
    """Probability against frequency with two standard errors, for combinations and for single findings."""
    figure = Figure(figsize=(4.2, 4.2), layout="constrained")
    axes = figure.subplots()
    axes.plot([0, 1], [0, 1], color=GREY, linewidth=1)
    for what, label, colour, marker in (
        ("calibration", "reported combination", BLUE, "o"),
        ("calibration_of_findings", "single finding", RED, "s"),
    ):
        bins = found[what]
        if not bins:
            continue
        mean, n = np.array([b["mean"] for b in bins]), np.array([b["number"] for b in bins])
        beside = mean + (0.008 if marker == "s" else -0.008)  # so that neither covers the other
        right = np.array([b["right"] for b in bins]) / n
        # The expected spread of the frequency if the probability were right.
        axes.errorbar(beside, right, 2 * np.sqrt(mean * (1 - mean) / n), color=colour, marker=marker, linestyle="none",
                      capsize=2, label=label)  # fmt: skip
        for x, y, k in zip(beside, right, n, strict=True):
            axes.annotate(str(k), (x, y), xytext=(4, -9), textcoords="offset points", fontsize=7, color=colour)
    axes.set(xlim=(0, 1.02), ylim=(-0.02, 1.05), xlabel="reported probability", ylabel="frequency of being right")
    figure.legend(frameon=False, fontsize=8, loc="outside upper center", ncols=2)  # inside it would cover a point
    return figure


def strength(rows: Sequence[Row], threshold: float) -> Figure:
    """1 - P(nothing left out) against how much the effect adds to the recalibrated simulation's chi-square."""
    figure = Figure(figsize=(6.0, 3.6), layout="constrained")
    axes = figure.subplots()
    concealed = [r for r in rows if r["way"] != "healthy"]
    for mark, colour, shape, label in ((True, BLUE, "o", "named exactly"), (False, RED, "+", "not named")):
        some = [r for r in concealed if r["exact"] is mark]
        x = [max(r["detectable"], 0.3) for r in some]
        axes.plot(x, [r["score"] for r in some], shape, color=colour, fillstyle="none", markersize=6, label=label)
    healthy = [r["score"] for r in rows if r["way"] == "healthy"]
    axes.plot(np.full(len(healthy), 0.2), healthy, "x", color=GREY, markersize=4, label="nothing hidden")
    axes.axhline(threshold, color=GREY, linewidth=0.8, linestyle="--")
    axes.set(xscale="log", xlabel="strength: root of the chi-square the effect adds after recalibration",
             ylabel="1 - P(nothing left out)", ylim=(-0.03, 1.05))  # fmt: skip
    axes.legend(frameon=False, fontsize=8, loc="center right")
    return figure
