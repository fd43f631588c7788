"""`symplearn diagnose` on a hundred recordings of a pendulum whose damping was left out, on a machine with a card.

As it is started it computes on the processor; some recordings with `JAX_PLATFORMS=cuda` as well, on the card: the
answer must be the same.
"""

import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from ._figures import seconds_told
from ._row import Disagreement, Effort, Line, tell

# Seconds after which a diagnosis on the card is not waited for, and one on the processor.
RECORDINGS, FEW, LIMIT, LONGEST = 100, 2, 200.0, 1800.0
_SIMULATION = """title = "A pendulum"
[system]
coordinates = ["theta"]
momenta = ["p"]
hamiltonian = "p**2/(2*m*l**2) - m*g*l*cos(theta)"
[parameters]
m = 0.1
g = 9.81
l = { value = 0.30, sd = 0.01 }
[recording]
time = "t"
[recording.observe]
angle = "theta"
"""


def measure(effort: Effort) -> dict[str, Any]:
    """All as it is started, and few in both ways."""
    with tempfile.TemporaryDirectory(prefix="benchmarks-") as name:
        folder, counts = Path(name), [FEW] if effort.quick else [FEW, RECORDINGS]
        _write(folder, max(counts))
        processor = {count: _run(folder, count, "") for count in counts}
        card = _run(folder, FEW, "cuda")
    lines = [_line(count, found) for count, found in processor.items()]
    lines[0] = _beside(lines[0], processor[FEW], card)
    return {"lines": lines, "processor": processor, "card": card}


def _line(count: int, found: dict[str, Any]) -> Line:
    said = f"{', '.join(found['effects'])} at {found['probability']:.3f}"
    work = f"`symplearn diagnose`, cold, {count} recordings of a pendulum, 200 rows each"
    return Line(work, "none", said, ours=seconds_told(found["seconds"]))


def _beside(line: Line, processor: dict[str, Any], card: dict[str, Any]) -> Line:
    """The same with what the card took, which may be more than the limit."""
    if not card["done"]:
        ratio = f"more than {LIMIT / processor['seconds']:.3g}x"
        return line._replace(against="JAX_PLATFORMS=cuda", figure=f"{ratio}; {line.figure}", other=f"over {LIMIT:g} s")
    if card["effects"] != processor["effects"]:
        raise Disagreement(f"the card names {card['effects']}, the processor {processor['effects']}")
    ratio = f"{card['seconds'] / processor['seconds']:.3g}x"
    other = seconds_told(card["seconds"])
    return line._replace(against="JAX_PLATFORMS=cuda", figure=f"{ratio}; {line.figure}", other=other)


def _write(folder: Path, count: int) -> None:
    """The simulation, and recordings by SciPy."""
    import numpy as np
    from scipy.integrate import solve_ivp

    (folder / "simulation.toml").write_text(_SIMULATION, encoding="utf-8")
    times, chance = 0.02 * np.arange(200), np.random.default_rng(0)
    damping, length, inertia = 1e-4, 0.302, 0.1 * 0.302**2

    def motion(t: float, x: Any) -> list[float]:
        return [x[1], -damping / inertia * x[1] - 9.81 / length * np.sin(x[0])]

    for k in range(count):
        start = chance.uniform(0.3, 1.2), 0.0
        angle = solve_ivp(motion, (0.0, times[-1]), start, "DOP853", times, rtol=1e-10, atol=1e-12).y[0]
        rows = np.column_stack([times, angle + 0.01 * chance.normal(size=len(times))])
        np.savetxt(folder / f"run_{k + 1}.csv", rows, delimiter=",", header="t,angle", comments="")


def _run(folder: Path, count: int, platform: str) -> dict[str, Any]:
    tell(f"card_diagnosis: {count} recordings{' on the card' if platform else ''}")
    out = folder / f"out_{count}_{platform}"
    files = [str(folder / f"run_{k + 1}.csv") for k in range(count)]
    command = [
        sys.executable,
        "-m",
        "symplearn",
        "diagnose",
        str(folder / "simulation.toml"),
        *files,
        "--out",
        str(out),
    ]
    chosen = {"XDG_CACHE_HOME": f"{out}_cache"} | ({"JAX_PLATFORMS": platform} if platform else {})
    began, limit = time.perf_counter(), LIMIT if platform else LONGEST
    try:
        one = subprocess.run(command, env=os.environ | chosen, capture_output=True, text=True, timeout=limit)
    except subprocess.TimeoutExpired as late:
        said = (late.stderr or b"").decode(errors="replace").strip().splitlines()[-1:]
        if platform:
            return {"done": False, "last_line": said}
        raise RuntimeError(f"the diagnosis took longer than {limit:g} s; its last line was {said}") from None
    if one.returncode != 0:
        raise RuntimeError(f"`symplearn diagnose` ended with {one.returncode}: {one.stderr[-500:]}")
    seconds = time.perf_counter() - began
    answer = json.loads((out / "diagnosis.json").read_text(encoding="utf-8"))
    effects = [finding["effect"] for finding in answer["findings"]]
    return {"done": True, "seconds": seconds, "effects": effects, "probability": answer["probability"]}
