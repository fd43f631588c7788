"""The two public files of a case, and its answer as JSON, from which the case can be computed again."""

from typing import Any

import numpy as np

from ._concealed_drawing import Public
from ._concealed_effects import FAMILY, SENSOR, Effect, Inputs
from ._concealed_fit import Free
from ._concealed_nature import Case
from ._concealed_planes import ZOO
from ._concealed_sensors import Recorded, Setup

TIME, RUN, INPUT = "t_s", "run", "u"


def simulation_file(case: Case) -> str:
    """`simulation.toml`: the simulation that left the effects out."""
    setup, public, system = case.setup, case.public, case.setup.system
    free = {f.name: f for f in public.free}
    lines = [f'title = "{system.title}"', "", "[system]"]
    lines += [f"coordinates = {_names(system.coordinates)}", f"momenta = {_names(system.momenta)}"]
    lines += [f'hamiltonian = "{system.hamiltonian}"', "", "[parameters]"]
    for name, value in setup.values.items():
        lines.append(f"{name} = {_table(free[name]) if name in free else repr(value)}")
    if public.initial:
        lines += ["", "[initial]"]
        for name, (mean, sd) in public.initial.items():
            lines.append(f"{name} = {{ value = {mean!r}, sd = {sd!r} }}" if sd else f"{name} = {mean!r}")
    if system.forces:
        lines += ["", "[forces]", *(f'{p} = "{text}"' for p, text in system.forces.items())]
    lines += ["", "[recording]", f'time = "{TIME}"']
    if system.forces:
        linear = setup.records[0].inputs is not None and setup.records[0].inputs.linear
        lines += [f'inputs = ["{INPUT}"]', f'interpolation = "{"linear" if linear else "hold"}"']
    if len(setup.records) > 1:
        lines.append(f'group = "{RUN}"')
    lines += ["", "[recording.observe]", *(f'{r.column} = "{r.text}"' for r in setup.readings)]
    if public.noise:
        lines += ["", "[recording.noise]", *(f"{column} = {sd!r}" for column, sd in public.noise.items())]
    return "\n".join(lines) + "\n"


def _names(names: tuple[str, ...]) -> str:
    return "[" + ", ".join(f'"{n}"' for n in names) + "]"


def _table(free: Free) -> str:
    sd = "" if free.sd is None else f", sd = {free.sd!r}"
    return f"{{ value = {free.mean!r}{sd} }}"


def recording_file(case: Case) -> str:
    """`recording.csv`: rows of all recordings; rows of the input after the last reading have empty cells."""
    setup, several = case.setup, len(case.setup.records) > 1
    driven = setup.system.drive is not None
    digits = [int(np.ceil(-np.log10(setup.noise[r.column]))) + 3 for r in setup.readings]
    head = [*([RUN] if several else []), TIME, *([INPUT] if driven else []), *(r.column for r in setup.readings)]
    lines = [",".join(head)]
    for record, seen in zip(setup.records, case.noisy, strict=True):
        blank = np.full((len(record.forecast), seen.shape[1]), np.nan)
        times = np.concatenate([record.times, record.forecast]) if driven else record.times
        rows = np.concatenate([seen, blank]) if driven else seen
        for k, (t, row) in enumerate(zip(times, rows, strict=True)):
            cells = [str(record.number)] if several else []
            cells.append(f"{t:.10g}")
            if record.inputs is not None and driven:
                cells.append(f"{record.inputs.values[k]:.10g}")
            cells += ["" if np.isnan(y) else f"{y:.{max(n, 0)}f}" for y, n in zip(row, digits, strict=True)]
            lines.append(",".join(cells))
    return "\n".join(lines) + "\n"


def answer(case: Case) -> dict[str, Any]:
    """Everything that the public files do not say."""
    setup, item = case.setup, case.plan
    return {
        "case": item.number,
        "way": item.way or "healthy",
        "system": setup.system.name,
        "effects": [_effect(e) for e in case.effects],
        "remainder": [_effect(e) for e in case.remainder],
        "jitter": case.jitter,
        "kind": kind(case.effects),
        "parameters": dict(setup.values),
        "free": [list(f) for f in case.public.free],
        "initial": {name: list(one) for name, one in case.public.initial.items()},
        "stated_noise": case.public.noise,
        "noise": setup.noise,
        "noise_kind": setup.kind,
        "columns": [r.column for r in setup.readings],
        "records": [_record(r) for r in setup.records],
        "clean": [c.tolist() for c in case.clean],
        "forecast": [c.tolist() for c in case.forecast],
        "claim": case.claim._asdict(),
        "attempts": case.attempts,
    }


def kind(effects: tuple[Effect, ...]) -> str:
    """Where the effects live."""
    sensor = {e.word in SENSOR for e in effects}
    return "none" if not sensor else "both" if len(sensor) == 2 else "sensor" if True in sensor else "dynamics"


def _effect(effect: Effect) -> dict[str, Any]:
    target = effect.target if isinstance(effect.target, str) else list(effect.target)
    return {
        "effect": effect.word,
        "target": target,
        "family": FAMILY.get(effect.word, "outside"),
        "values": dict(effect.values),
        "recordings": list(effect.recordings),
    }


def _record(record: Recorded) -> dict[str, Any]:
    inputs = record.inputs
    return {
        "number": record.number,
        "times": record.times.tolist(),
        "begin": record.begin,
        "start": record.start.tolist(),
        "after": record.forecast.tolist(),
        "inputs": None if inputs is None else {"values": inputs.values.tolist(), "linear": inputs.linear},
    }


def read_effects(rows: list[dict[str, Any]]) -> tuple[Effect, ...]:
    """Effects from an answer."""
    return tuple(
        Effect(
            row["effect"],
            row["target"] if isinstance(row["target"], str) else tuple(row["target"]),
            row["values"],
            tuple(row["recordings"]),
        )
        for row in rows
    )


def read_setup(document: dict[str, Any]) -> tuple[Setup, Public]:
    """The setting, from an answer."""
    system = ZOO[document["system"]]
    by_column = {r.column: r for r in system.readings}
    records = []
    for row in document["records"]:
        times, after = np.array(row["times"]), np.array(row["after"])
        given = row["inputs"]
        inputs = given and Inputs(np.concatenate([times, after]), np.array(given["values"]), given["linear"])
        records.append(Recorded(row["number"], times, row["begin"], np.array(row["start"]), inputs, after))
    readings = tuple(by_column[c] for c in document["columns"])
    setup = Setup(
        system, document["parameters"], readings, document["noise"], document["noise_kind"], 8.0, tuple(records)
    )
    free = tuple(Free(*one) for one in document["free"])
    initial = {name: (one[0], one[1]) for name, one in document["initial"].items()}
    return setup, Public(free, document["stated_noise"], initial, ())
