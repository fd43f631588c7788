"""Rigs of a student's laboratory, in which as many as five effects act at once: what `diagnose` says of them.

    python -m experiments.rigs [--quick] [--out DIR] [--seed N]

Seven rigs, each drawn four times (once in a quick run): a pendulum on an encoder, a cart between springs, a torsion
pendulum, a circuit, a bob that swings in two directions, two joined pendulums, a driven spring. Each has losses of
several kinds, forces that are slightly bent, a zero or a scale that is off; lenses, jitter and converters spoil the
readings besides. `symplearn diagnose` is given two files, in a process of its own, with a quarter of the rows held out;
beside it stands SciPy's least squares of the true form on the same rows.

`within` is the share of the cases whose held-out error is within 1.5 times that fit's. `not_there` counts effects that
are told at 0.9 and more and do not act, of those that have a time, a frequency or a threshold or an unseen coordinate.

What is done is kept in DIR and not done again.
"""

import json
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ._command import Run, command, print_table
from ._rigs_fit import held_out, sizes
from ._rigs_nature import RIGS, Rig, recorded

EACH, HELD_OUT, NEAR, TOLD = {True: 1, False: 4}, 0.25, 1.5, 0.9
PLACED = {
    "periodic_forcing", "impulse", "parametric_modulation", "regime_change", "contact_stop", "hidden_oscillator",
}  # fmt: skip


def measured(run: Run, name: str, k: int) -> dict[str, Any]:
    """One case, drawn, fitted and diagnosed; from its folder where that is done."""
    folder = run.out / f"{name}_{k}"
    kept = folder / "measured.json"
    if not kept.exists():
        folder.mkdir(parents=True, exist_ok=True)
        found = _measure(run, name, k, folder)
        kept.write_text(json.dumps(found, indent=1, allow_nan=False), encoding="utf-8")
    return dict(json.loads(kept.read_text(encoding="utf-8")))


def _measure(run: Run, name: str, k: int, folder: Path) -> dict[str, Any]:
    rng = np.random.default_rng([run.seed, k, *name.encode()])
    rig = RIGS[name](rng)
    readings = recorded(rig, rng)
    _write(rig, readings, folder)
    document = _diagnosed(folder)
    best = held_out(rig, readings, len(readings) - round(HELD_OUT * len(readings)))
    after = np.array(list(document["fit"]["after"]["holdout_rmse"].values()))
    told = {f"{one['effect']} {_target(one)}": one["probability"] for one in document["findings"]}
    return {
        "acts": {" ".join(rig.effects[effect]): size for effect, size in sizes(rig).items()},
        "told": told, "verdict": document["verdict"], "probability": document["probability"],
        "over_the_true_form": float(np.sqrt(np.sum((after / rig.noise) ** 2) / np.sum((best / rig.noise) ** 2))),
        "seconds": document["seconds"],
    }  # fmt: skip


def _target(finding: dict[str, Any]) -> str:
    return finding["target"] if isinstance(finding["target"], str) else ",".join(finding["target"])


def _write(rig: Rig, readings: np.ndarray, folder: Path) -> None:
    """The two files that a user would have."""
    lines = ["[system]", f"coordinates = {json.dumps(rig.coordinates)}", f"momenta = {json.dumps(rig.momenta)}",
             f'hamiltonian = "{rig.hamiltonian}"', "", "[parameters]"]  # fmt: skip
    lines += [f"{k} = {{ value = {m:.8g}, sd = {sd:.3g}, positive = true }}" for k, (m, sd) in rig.given.items()]
    lines += [f"{k} = {value:.8g}" for k, value in rig.known.items()]
    lines += ["", "[recording]", 'time = "t_s"']
    lines += [f"inputs = {json.dumps(list(rig.inputs))}", 'interpolation = "linear"'] if rig.inputs else []
    lines += ["", "[recording.observe]", *(f'{column} = "{h}"' for column, h in rig.observe.items())]
    (folder / "simulation.toml").write_text("\n".join(lines) + "\n", encoding="utf-8")
    table = np.column_stack([rig.times, readings, *rig.inputs.values()])
    header = ",".join(["t_s", *rig.observe, *rig.inputs])
    np.savetxt(folder / "recording.csv", table, "%.9g", ",", header=header, comments="")


def _diagnosed(folder: Path) -> dict[str, Any]:
    """The answer of a process that is given the two files."""
    out = folder / "diagnosis"
    asked = [sys.executable, "-m", "symplearn", "diagnose", "simulation.toml", "recording.csv", "--out", out.name,
             "--holdout", str(HELD_OUT)]  # fmt: skip
    done = subprocess.run(asked, cwd=folder, check=False, capture_output=True, text=True)
    if done.returncode:
        raise OSError(f"{folder}: the diagnosis ended with {done.returncode}: {done.stderr.strip()[-300:]}")
    return dict(json.loads((out / "diagnosis.json").read_text(encoding="utf-8")))


def rigs(run: Run) -> None:
    """Measure all cases, and write and print what was found."""
    cases = [(name, k) for k in range(EACH[run.quick]) for name in RIGS]
    found = {f"{name}_{k}": measured(run, name, k) for name, k in run.each("rigs", cases)}
    ratios = [one["over_the_true_form"] for one in found.values()]
    run.write({
        "cases": found,
        "within": float(np.mean([ratio <= NEAR for ratio in ratios])),
        "median_over_the_true_form": float(np.median(ratios)),
        "not_there": sum(len(_not_there(one)) for one in found.values()),
        "median_seconds": float(np.median([one["seconds"] for one in found.values()])),
    })  # fmt: skip
    print_table(["case", "acts, sd of the noise", "told", "over the true form", "s"],
                *[_row(name, one) for name, one in found.items()])  # fmt: skip
    print(f"within {NEAR} times the true form's error: {sum(r <= NEAR for r in ratios)} of {len(ratios)}")


def _not_there(one: dict[str, Any]) -> list[str]:
    """Effects at a place, or unseen, that are told with certainty and do not act."""
    told = [name for name, probability in one["told"].items() if probability >= TOLD and name not in one["acts"]]
    return [name for name in told if name.split()[0] in PLACED]


def _row(name: str, one: dict[str, Any]) -> Sequence[Any]:
    acts = ", ".join(f"{effect} {size:.1f}" for effect, size in one["acts"].items())
    told = ", ".join(f"{effect} {probability:.2f}" for effect, probability in one["told"].items())
    return [name, acts, told or one["verdict"], one["over_the_true_form"], round(one["seconds"])]


def main(arguments: Sequence[str] | None = None) -> None:
    command("rigs", "What `symplearn diagnose` says of rigs in which several effects act at once.", rigs, arguments)


if __name__ == "__main__":
    main()
