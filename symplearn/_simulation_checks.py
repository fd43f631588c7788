"""From the table of a simulation file to its record: names, expressions, numbers and terms are checked."""

from collections.abc import Collection, Mapping
from typing import Any

from ._errors import InputError, nearest, shown
from ._expression import NAME, RESERVED, Expression, parse_expression, symbol
from ._simulation_records import IntegratorSection, Quantity, RecordingSection, SimulationFile
from ._simulation_schema import (
    CalibratedTable,
    IntegratorTable,
    RecordingTable,
    SimulationTable,
    SystemSection,
    checked_table,
    place,
    quantity,
)
from ._simulation_terms import TermReader


def checked_simulation(data: Mapping[str, Any], file: str) -> SimulationFile:
    """The record of a parsed TOML table, or `InputError`."""
    table = checked_table(data, file)
    system, recording = table.system, table.recording
    _check_names(table, file)
    states = [*system.coordinates, *system.momenta]
    names = [*states, *table.parameters, *recording.inputs]
    return SimulationFile(
        name=file,
        title=table.title,
        coordinates=tuple(system.coordinates),
        momenta=tuple(system.momenta),
        hamiltonian=_hamiltonian(system, names, states, file),
        parameters=_quantities(table.parameters, "parameters", file),
        initial=_initial(table, states, file),
        forces=_forces(table, names, file),
        recording=_recording(recording, names, states, file),
        units=dict(table.units),
        integrator=_integrator(table.integrator, file),
        terms=TermReader(table, names, file).terms(),
    )


def _check_names(table: SimulationTable, file: str) -> None:
    system = table.system
    if len(system.coordinates) != len(system.momenta):
        raise InputError(
            f"{file}, [system]: {len(system.coordinates)} coordinates but {len(system.momenta)} momenta; "
            "every coordinate needs its momentum, in the same order"
        )
    declared = [("[system] coordinates", n) for n in system.coordinates]
    declared += [("[system] momenta", n) for n in system.momenta]
    declared += [("[parameters]", n) for n in table.parameters]
    declared += [("[recording] inputs", n) for n in table.recording.inputs]
    seen: dict[str, str] = {}
    for section, name in declared:
        _check_name(name, f"{file}, {section}")
        if name in seen:
            raise InputError(
                f"{file}, {section}: {shown(name)} is declared already in {seen[name]}; declare every name once"
            )
        seen[name] = section


def _check_name(name: str, where: str) -> None:
    if not NAME.fullmatch(name):
        raise InputError(
            f"{where}: {shown(name)} cannot be a name; use letters, digits and _, starting with a letter or _"
        )
    if name in RESERVED:
        raise InputError(f"{where}: {shown(name)} has a fixed meaning in expressions; choose another name")


def _expression(text: str, names: Collection[str], where: str) -> Expression:
    return Expression(text, parse_expression(text, names, where=where))


def _hamiltonian(system: SystemSection, names: Collection[str], states: list[str], file: str) -> Expression:
    where = f"{file}, [system] hamiltonian"
    hamiltonian = _expression(system.hamiltonian, names, where)
    if not hamiltonian.tree.free_symbols & set(map(symbol, states)):
        raise InputError(f"{where}: depends on no coordinate and no momentum; write the energy as a function of them")
    return hamiltonian


def _quantities(entries: Mapping[str, float | CalibratedTable], section: str, file: str) -> dict[str, Quantity]:
    return {n: quantity(e, f"{file}, {place([section, n])}") for n, e in entries.items()}


def _initial(table: SimulationTable, states: list[str], file: str) -> dict[str, Quantity]:
    for name in table.initial:
        if name not in states:
            raise InputError(
                f"{file}, {place(['initial', name])}: not a coordinate or momentum; {nearest(name, states)}"
            )
    return _quantities(table.initial, "initial", file)


def _forces(table: SimulationTable, names: Collection[str], file: str) -> dict[str, Expression]:
    forces, system = {}, table.system
    for name, text in table.forces.items():
        where = f"{file}, {place(['forces', name])}"
        if name in system.coordinates:
            momentum = system.momenta[system.coordinates.index(name)]
            raise InputError(f"{where}: a force changes a momentum, not a coordinate; use {shown(momentum)}")
        if name not in system.momenta:
            raise InputError(f"{where}: not a momentum; {nearest(name, system.momenta)}")
        forces[name] = _expression(text, names, where)
    return forces


def _recording(table: RecordingTable, names: Collection[str], states: list[str], file: str) -> RecordingSection:
    group = () if table.group is None else (table.group,) if isinstance(table.group, str) else tuple(table.group)
    _check_columns(table, group, file)
    _check_window(table, group, file)
    return RecordingSection(
        time=table.time,
        observe={column: _observed(column, text, names, states, file) for column, text in table.observe.items()},
        noise=_noise(table, file),
        inputs=tuple(table.inputs),
        interpolation=table.interpolation,
        start=table.start,
        end=table.end,
        group=group,
        where=dict(table.where),
    )


def _observed(column: str, text: str, names: Collection[str], states: list[str], file: str) -> Expression:
    where = f"{file}, {place(['recording', 'observe', column])}"
    expression = _expression(text, names, where)
    if not expression.tree.free_symbols & set(map(symbol, states)):
        raise InputError(f"{where}: does not depend on the state; use a coordinate or a momentum in it")
    return expression


def _check_columns(table: RecordingTable, group: tuple[str, ...], file: str) -> None:
    """A column serves one purpose."""
    if len(set(group)) != len(group):
        raise InputError(f"{file}, [recording] group: a column is named twice; name every column once")
    uses = {table.time: "the column of times"} | dict.fromkeys(table.inputs, "an input")
    for key, columns in (("observe", list(table.observe)), ("group", list(group))):
        for column in columns:
            if column in uses:
                raise InputError(
                    f"{file}, [recording] {key}: {shown(column)} is already {uses[column]}; use another column"
                )
            uses[column] = "observed"
    if table.time in table.inputs:
        raise InputError(f"{file}, [recording] inputs: {shown(table.time)} is the column of times; write t for it")


def _check_window(table: RecordingTable, group: tuple[str, ...], file: str) -> None:
    for key, bound in (("start", table.start), ("end", table.end)):
        if isinstance(bound, Mapping) and not group:
            raise InputError(
                f"{file}, [recording] {key}: a table by group value needs `group`; "
                "give a number or name the group column"
            )
    start, end = table.start, table.end
    if isinstance(start, float) and isinstance(end, float) and not start < end:
        raise InputError(f"{file}, [recording] end: {end:g} is not after start = {start:g}; give a later time")


def _noise(table: RecordingTable, file: str) -> dict[str, float]:
    for column, sd in table.noise.items():
        where = f"{file}, {place(['recording', 'noise', column])}"
        if column not in table.observe:
            raise InputError(f"{where}: the column is not observed; {nearest(column, table.observe)}")
        if not sd > 0:
            raise InputError(f"{where}: {sd:g} is not a standard deviation; give a number above zero")
    return dict(table.noise)


def _integrator(table: IntegratorTable, file: str) -> IntegratorSection:
    if table.step is not None and not table.step > 0:
        raise InputError(f"{file}, [integrator] step: {table.step:g} is not a step; give a number above zero")
    return IntegratorSection(table.name, table.step)
