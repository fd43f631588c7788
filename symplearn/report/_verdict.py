"""The verdict, its place and its times in plain sentences."""

from collections.abc import Mapping
from typing import Any

from ..diagnosis._law_text import moment
from ..diagnosis._record import Diagnosis
from ._units import time_unit
from ._words import combination, plain, probability, takes_back

_CUT_SHORT = "The search was cut short by the time limit: what it did not come to may be likelier than what is told."
_PROBLEM = "The fit did not converge: the numbers here are where it stopped, not an answer to rely on."


def caution(document: Mapping[str, Any]) -> str:
    """What keeps an answer from being one to rely on; empty where nothing does."""
    cut, problem = not document["complete"], not document["converged"]
    return " ".join([_CUT_SHORT] * cut + [_PROBLEM] * problem)


def verdict_sentence(diagnosis: Diagnosis) -> str:
    """One sentence with the probability of the reported combination."""
    document = diagnosis.document
    chance = f"probability {probability(document['probability'])}"
    if document["all_rows"] is not None:
        return f"The simulation agrees with the rows that were fitted, and not with all of them ({chance})."
    if document["verdict"] == "consistent" and document["probability"] < 0.5:
        return f"The recording rules out neither the simulation as it is nor that it lacks something ({chance})."
    if document["verdict"] == "consistent":
        return f"The simulation agrees with the recording; nothing needs to be added ({chance})."
    if document["verdict"] == "unexplained":
        return f"The simulation and the recording differ, and no effect with a name explains it ({chance})."
    found = combination(document["findings"], recordings=len(diagnosis.series))
    less = [takes_back(one) for one in document["findings"]]
    if all(less):
        return f"The simulation has {found} ({chance})."
    return f"The simulation left something out{' or has too much' if any(less) else ''}: {found} ({chance})."


def where_and_when(diagnosis: Diagnosis) -> list[tuple[str, str]]:
    """Pairs of a word and what it says: where it lives, on what, in which recordings, and when."""
    place, count = diagnosis.document["location"], len(diagnosis.series)
    lines = [("Part", plain(place["kind"])), ("On", ", ".join(map(_target, place["targets"])))]
    if count > 1:
        lines.append(("Recordings", ", ".join(str(r) for r in place["recordings"])))
    lines.append(("Time", "; ".join(_window(window, diagnosis) for window in place["time_windows"])))
    return [(word, says) for word, says in lines if says]


def _target(target: str | list[str]) -> str:
    """A name, or a pair of them."""
    return plain(target) if isinstance(target, str) else " and ".join(map(plain, target))


def _window(window: list[Any], diagnosis: Diagnosis) -> str:
    unit = time_unit(diagnosis)
    span = f"{moment(window[0])} to {moment(window[1])}" + (f" {plain(unit)}" if unit else "")
    return f"{span} in recording {int(window[2])}" if len(window) > 2 else span
