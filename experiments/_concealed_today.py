"""The practice of today on the same files: smooth, differentiate, subtract the simulation, SINDy on the rest.

Where the positions of all coordinates are read, smoothing splines give velocities and momenta; what the recalibrated
simulation's equations leave of the momenta's slope is regressed by PySINDy on powers of position and velocity. Three
ways: plain, weak form, ensemble; each with the sparsest threshold within a standard error of the least cross-validated
one. A small network of the same residual stands beside. Much is given away: the splines are told the true noise,
recalibration starts at the truth, and the repaired simulation predicts from the true state.
"""

import json
import warnings
from collections.abc import Callable, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from ._command import print_table
from ._concealed_network import network_force
from ._concealed_oracle import HELD_OUT, seen_rows
from ._concealed_repair import Force, Smoothed, free_run_errors, smoothed
from ._concealed_results import middle, share
from ._concealed_run import fingerprint
from ._concealed_seal import opened, put
from ._concealed_workers import cores, each

WAYS = ("sindy", "weak", "ensemble", "network")
THRESHOLDS = np.geomspace(0.01, 1.0, 10)
_BLOCKS = 5


def library(q: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, list[str]]:
    """Terms for each row: powers, drags, and what self-excitation needs. Shapes (coordinate, row)."""
    terms, names = [np.ones(q.shape[1])], ["1"]
    for i, (x, w) in enumerate(zip(q, v, strict=True)):
        terms += [x, x**2, x**3, w, w * np.abs(w), np.sign(w), x**2 * w]
        names += [f"{n}{i}" for n in ("q", "qq", "qqq", "v", "vv", "s", "qqv")]
    return np.stack(terms, axis=1), names


def right_terms(answer: dict[str, Any]) -> set[tuple[int, str]] | None:
    """(equation, term) of the truth; None where no set of terms is the truth."""
    coordinates = sorted({r for e in answer["effects"] for r in _listed(e["target"])})
    order = {name: i for i, name in enumerate(_coordinates(answer))}
    own = {"viscous_damping": ["v"], "quadratic_drag": ["vv"], "coulomb_friction": ["s"], "constant_force": ["1"],
           "linear_stiffness": ["q"], "quadratic_stiffness": ["qq"], "cubic_stiffness": ["qqq"],
           "self_excitation": ["v", "qqv"]}  # fmt: skip
    pairs = {"relative_damping": ("v", True), "coupling_spring": ("q", True), "gyroscopic_coupling": ("v", False)}
    found: set[tuple[int, str]] = set()
    for e in answer["effects"]:
        if e["effect"] in own and not e["recordings"] and set(coordinates) <= set(order):
            i = order[e["target"]]
            found |= {(i, n if n == "1" else f"{n}{i}") for n in own[e["effect"]]}
        elif e["effect"] in pairs and not e["recordings"]:
            term, itself = pairs[e["effect"]]
            found |= {(i, f"{term}{j}") for i in (0, 1) for j in (0, 1) if itself or i != j}
        else:
            return None
    return found


def _listed(target: str | list[str]) -> list[str]:
    return [target] if isinstance(target, str) else target


def _coordinates(answer: dict[str, Any]) -> tuple[str, ...]:
    from ._concealed_planes import ZOO

    return ZOO[answer["system"]].coordinates


def weak(theta: np.ndarray, one: Smoothed, span: float) -> tuple[np.ndarray, np.ndarray]:
    """Integrals with bumps of half-width `span`: -int(phi' p) - int(phi f) against int(phi theta)."""
    times, momenta, force = one.times, one.p, one.force
    rows, goals = [], []
    for centre in np.arange(times[0] + span, times[-1] - span, span):
        z = (times - centre) / span
        inside = np.abs(z) < 1
        bump = np.where(inside, (1 - z**2) ** 4, 0.0)
        slope = np.where(inside, -8 * z * (1 - z**2) ** 3, 0.0) / span
        goals.append(-np.trapezoid(slope[:, None] * momenta.T + bump[:, None] * force.T, times, axis=0))
        rows.append(np.trapezoid(bump[:, None] * theta, times, axis=0))
    return np.array(rows), np.array(goals)


def _optimiser(way: str, threshold: float) -> Any:
    import pysindy as ps

    plain = ps.STLSQ(threshold=threshold, alpha=1e-6, normalize_columns=False)
    return ps.EnsembleOptimizer(plain, bagging=True, n_models=20) if way == "ensemble" else plain


def _solved(way: str, threshold: float, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Coefficients of one equation; both sides have unit size, so that a threshold is a part of the residual."""
    if threshold == np.inf:  # no term at all
        return np.zeros(x.shape[1])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = _optimiser(way, threshold).fit(x, y[:, None])
    return np.ravel(found.coef_)


def sparse(way: str, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Terms of one equation with the threshold of least error over contiguous blocks left out."""
    np.random.seed(0)  # PySINDy's bagging draws from NumPy's global generator
    size, level = np.sqrt(np.mean(x**2, axis=0)), max(float(np.sqrt(np.mean(y**2))), 1e-300)
    size = np.where(size > 0, size, 1.0)
    a, b = x / size, y / level
    if len(b) < 2 * _BLOCKS:  # a recording of few periods has too few weak rows
        return np.zeros(len(size))
    block = np.arange(len(b)) * _BLOCKS // len(b)
    errors = []
    for threshold in (*THRESHOLDS, np.inf):
        each = [(b[block == k] - a[block == k] @ _solved("sindy", threshold, a[block != k], b[block != k])) ** 2
                for k in range(_BLOCKS)]  # fmt: skip
        errors.append([float(np.mean(e)) for e in each])
    mean, spread = np.mean(errors, axis=1), np.std(errors, axis=1) / np.sqrt(_BLOCKS - 1)
    least = int(np.argmin(mean))
    # The sparsest within a standard error of the least.
    best = int(np.max(np.flatnonzero(mean <= mean[least] + spread[least])))
    return _solved(way, (*THRESHOLDS, np.inf)[best], a, b) * level / size


def found_terms(way: str, data: Sequence[Smoothed], period: float) -> tuple[np.ndarray, list[str]]:
    """Coefficients, shape (equation, term), and the terms' names."""
    sides = []
    for one in (d.inside() for d in data):
        theta, names = library(one.q, one.v)
        pair = weak(theta, one, period / 2) if way == "weak" else (theta, (one.slope - one.force).T)
        sides.append(pair)
    x, y = np.concatenate([a for a, _ in sides]), np.concatenate([b for _, b in sides])
    return np.stack([sparse(way, x, y[:, i]) for i in range(y.shape[1])]), names


def practised(answer: dict[str, Any], seen: tuple[np.ndarray, ...], ways: Sequence[str]) -> dict[str, Any] | None:
    """What each way finds in one case, and the errors of its repair; None where velocities cannot be had."""
    early = smoothed(answer, seen, HELD_OUT)
    if early is None:
        return None
    whole = smoothed(answer, seen, 0.0)
    assert whole is not None
    found: dict[str, Any] = {"none": free_run_errors(answer, seen, early, whole, None)}
    for way in ways:
        if way == "network":
            found[way] = free_run_errors(answer, seen, early, whole, network_force(early.runs))
            continue
        terms, names = found_terms(way, early.runs, early.setup.system.period(early.setup.values))
        there = {(int(i), names[k]) for i, k in np.argwhere(terms != 0)}
        errors = free_run_errors(answer, seen, early, whole, _force(terms))
        truth = right_terms(answer)
        found[way] = {
            "terms": sorted(f"{i}:{n}" for i, n in there),
            "exact": truth is not None and there == truth,
        } | errors
    return found


def _force(terms: np.ndarray) -> Force:
    return lambda q, v: (library(q, v)[0] @ terms.T).T


def compared(out: Path, names: Sequence[str], rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """All cases, kept one by one; the table, and its numbers."""
    ways = WAYS if find_spec("pysindy") else ("network",)
    if "sindy" not in ways:
        print("\nPySINDy is not installed here, so its columns are missing; `make proof` has it.")
    found = each("today's practice", _one, [(out, name, ways) for name in names], cores())
    return _told(dict(zip(names, found, strict=True)), rows, ways)


def _one(out: Path, name: str, ways: Sequence[str]) -> dict[str, Any] | None:
    path, mark = out / "today" / f"{name}.json", fingerprint(out / "public" / name) + ",".join(ways)
    if path.exists():
        kept = json.loads(path.read_text(encoding="utf-8"))
        if kept["of"] == mark:
            return kept["found"]
    answer = opened(out / "sealed", name)
    with np.errstate(all="ignore"):
        found = practised(answer, seen_rows(out / "public" / name / "recording.csv", answer), ways)
    put(path, json.dumps({"of": mark, "found": found}).encode())
    return found


def _told(found: dict[str, Any], rows: Sequence[dict[str, Any]], ways: Sequence[str]) -> dict[str, Any]:
    """The same lines for every way and for the diagnosis, on the cases where today's practice applies."""
    some = [r for r in rows if found.get(r["case"])]
    lines = {"diagnosis": _line(some, lambda r: (r["detected"], r["exact"], r["holdout_after"], r["forecast_after"]))}
    for way in ways:
        lines[way] = _line(some, lambda r, way=way: _of(found[r["case"]][way]))
    lines["no repair"] = _line(some, lambda r: (None, None, *_of(found[r["case"]]["none"])[2:]))
    print(f"\nToday's practice, on the {len(some)} cases that read all positions (errors over the oracle's, medians)")
    columns = list(lines["diagnosis"])
    print_table(
        ["way", *columns], *([way, *("-" if v is None else v for v in line.values())] for way, line in lines.items())
    )
    return {"cases": len(some), "lines": lines}


def _of(one: dict[str, Any]) -> tuple[Any, ...]:
    there = one.get("terms")
    return None if there is None else bool(there), one.get("exact"), one["holdout"], one["forecast"]


def _line(rows: Sequence[dict[str, Any]], told: Callable[[dict[str, Any]], tuple[Any, ...]]) -> dict[str, Any]:
    healthy = [told(r) for r in rows if r["way"] == "healthy"]
    hidden = [(r, told(r)) for r in rows if r["way"] != "healthy"]
    return {
        "healthy": len(healthy),
        "false_alarms": share(t[0] for t in healthy if t[0] is not None),
        "detected": share(t[0] for _, t in hidden if t[0] is not None),
        "exact": share(t[1] for _, t in hidden if t[1] is not None),
        "holdout": middle(_over(t[2], (r["oracle"] or {}).get("holdout", 1.0)) for r, t in hidden),
        "forecast": middle(_over(t[3], (r["oracle"] or {}).get("forecast", 1.0)) for r, t in hidden),
    }


def _over(one: float | None, other: float) -> float | None:
    return None if one is None else one / other
