"""`[[terms]]` of a simulation file: physics already added, in the words of the contract's section 3."""

from collections.abc import Collection, Mapping
from dataclasses import replace
from typing import Any

from ._errors import InputError, nearest, shown
from ._expression import NAME, RESERVED, Expression, parse_expression
from ._simulation_records import Quantity, Term
from ._simulation_schema import SimulationTable, checked_quantity
from ._vocabulary import COLUMN, COORDINATE, FORBIDDEN, PAIR, PARAMETER, VOCABULARY, Word

_SIDES = ("upper", "lower")


class TermReader:
    """Reads the terms of one file."""

    def __init__(self, table: SimulationTable, names: Collection[str], file: str):
        self.table, self.names, self.file = table, names, file
        self.choices: dict[str, Collection[str]] = {
            COORDINATE: table.system.coordinates,
            PAIR: table.system.coordinates,
            PARAMETER: list(table.parameters),
            COLUMN: list(table.recording.observe),
        }

    def terms(self) -> tuple[Term, ...]:
        return tuple(self.term(data, number) for number, data in enumerate(self.table.terms, start=1))

    def term(self, data: Mapping[str, Any], number: int) -> Term:
        where = f"{self.file}, [[terms]] {number}"
        word = self.word(data, where)
        self.check_keys(data, word, where)
        memory = self.memory(data, where) if word.expression else {}
        return Term(
            effect=word.name,
            target=self.target(data, word, where),
            coefficients={name: self.coefficient(data, name, word, where) for name in word.coefficients},
            side=self.side(data, word, where),
            expression=self.expression(data["expression"], memory, f"{where} expression") if word.expression else None,
            recordings=_recordings(data, where),
            memory=memory,
        )

    def word(self, data: Mapping[str, Any], where: str) -> Word:
        effect = data.get("effect")
        if effect is None:
            raise InputError(f"{where} effect: missing; name one of the effects, such as `viscous_damping`")
        if not isinstance(effect, str) or effect not in VOCABULARY:
            raise InputError(
                f"{where} effect: unknown effect {shown(effect)}; {nearest(str(effect), VOCABULARY, len(VOCABULARY))}"
            )
        return VOCABULARY[effect]

    def check_keys(self, data: Mapping[str, Any], word: Word, where: str) -> None:
        needed = ["target", *word.coefficients, *(["expression"] if word.expression else [])]
        known = [
            "effect",
            *needed,
            *(["side"] if word.sides else []),
            *(["memory"] if word.expression else []),
            "recordings",
        ]
        for key in data:
            if key not in known:
                raise InputError(f"{where} {shown(key)[1:-1]}: unknown key for {word.name}; {nearest(key, known)}")
        for key in needed:
            if key not in data:
                raise InputError(f"{where} {key}: missing; {word.name} needs {', '.join(needed)}")

    def target(self, data: Mapping[str, Any], word: Word, where: str) -> tuple[str, ...]:
        given, where = data["target"], f"{where} target"
        targets = [given] if isinstance(given, str) else given
        count = 2 if word.target == PAIR else 1
        if not isinstance(targets, list) or len(targets) != count or not all(isinstance(t, str) for t in targets):
            needed = 'two coordinates, ["q1", "q2"]' if count == 2 else f"one name, that of a {word.target}"
            raise InputError(f"{where}: {shown(given)} was given where {needed}, is needed")
        choices = self.choices[word.target]
        for target in targets:
            if target not in choices:
                kind = COORDINATE if word.target == PAIR else word.target
                raise InputError(f"{where}: {shown(target)} is not a {kind}; {nearest(target, choices)}")
        if word.target == PAIR:
            self.check_pair(targets, word, where)
        if word.name == "sensor_noise" and targets[0] not in self.table.recording.noise:
            raise InputError(
                f"{where}: {shown(targets[0])} has no known noise to multiply; give it in [recording.noise]"
            )
        return tuple(targets)

    def check_pair(self, targets: list[str], word: Word, where: str) -> None:
        """Sorted into the order of the coordinates, except where the order has a meaning."""
        first, second = map(self.table.system.coordinates.index, targets)
        if first == second:
            raise InputError(f"{where}: {shown(targets[0])} is named twice; name two different coordinates")
        if first > second and word.name == "gyroscopic_coupling":
            raise InputError(f"{where}: is not in the order of `coordinates`; swap the two names and the sign of b")
        targets.sort(key=self.table.system.coordinates.index)

    def coefficient(self, data: Mapping[str, Any], name: str, word: Word, where: str) -> Quantity:
        where = f"{where} {name}"
        result = checked_quantity(data[name], where)
        if name in word.positive and (result.value < 0 or result.value == 0 and not result.known):
            raise InputError(
                f"{where}: {result.value:g} was given, but {name} of {word.name} is positive by convention"
            )
        forbidden, needed = FORBIDDEN.get((word.name, name), (None, ""))
        if forbidden is not None and forbidden(result.value):
            raise InputError(f"{where}: {result.value:g} was given, but {name} of {word.name} must {needed}")
        # What is calibrated stays so: a friction that is not there must not come back as one that drives.
        return result if result.known else replace(result, positive=result.positive or name in word.positive)

    def side(self, data: Mapping[str, Any], word: Word, where: str) -> str | None:
        if not word.sides:
            return None
        side = data.get("side", "upper")
        if side not in _SIDES:
            raise InputError(f"{where} side: unknown word {shown(side)}; write `upper` or `lower`")
        return side

    def memory(self, data: Mapping[str, Any], where: str) -> dict[str, Expression]:
        """Further names of an expression, each with its rate of change."""
        given = data.get("memory", {})
        if not isinstance(given, Mapping):
            raise InputError(
                f'{where} memory: {shown(given)} was given where a table such as {{ w = "2*v - w" }} is needed, '
                "which tells what each name changes by in a unit of time"
            )
        for name in given:
            if not NAME.fullmatch(name) or name in RESERVED or name in self.names:
                raise InputError(
                    f"{where} memory: {shown(name)} cannot be a name here; use letters, digits and _, starting with a "
                    "letter or _, and no name that is declared already or has a fixed meaning"
                )
        return {name: self.expression(text, given, f"{where} memory.{name}") for name, text in given.items()}

    def expression(self, text: Any, further: Collection[str], where: str) -> Expression:
        if not isinstance(text, str):
            raise InputError(f"{where}: {shown(text)} was given where text in quotes is needed")
        return Expression(text, parse_expression(text, [*self.names, *further], where=where))


def _recordings(data: Mapping[str, Any], where: str) -> tuple[int, ...] | None:
    if "recordings" not in data:
        return None
    given = data["recordings"]
    is_list = isinstance(given, list) and len(given) > 0
    if not is_list or not all(type(n) is int and n >= 1 for n in given) or len(set(given)) != len(given):
        raise InputError(
            f"{where} recordings: {shown(given)} was given where a list such as [1, 3], counted from 1, is needed"
        )
    return tuple(given)
