"""Which recording would tell apart what the present one cannot."""

from collections.abc import Iterator, Sequence

from .._effects import UNNAMED
from ._impostors import OVER_TIME, SHOWS, UNMASK

_Key = tuple[str, tuple[str, ...]]  # effect and targets
_Keys = frozenset[_Key]

NOTHING_SHOWN = "one in which the simulated motion is seen: larger than the noise, and for longer than it takes to turn"
ASK_AGAIN = "nothing before these rows are asked again with --holdout 0: the held-out ones hold what the others do not"
_ANOTHER = "a recording at another amplitude, to test the law outside the range it was found in"
_HARDER = "none is needed; a longer recording at another amplitude would test the simulation harder"
_CLOSER = "more channels and a faster sampling where the strain is largest, to see what acts there"
_REPEATED = (
    "a repeat of each recording under its own conditions, several times: whether the effect belongs to one recording "
    "alone is open"
)
_FORM = "recordings at other amplitudes and speeds: which form the force without a name has is open"
# Where the simulation as it is, or a remainder without a name, has more than this, it is a rival itself.
_OPEN, _SETTLED = 0.05, 0.9
_MOST = 2
# Below this probability of an answer the rows that were kept from it may tell more of its names.
_SURE = 0.9


def all_rows(holdout: float, probability: float) -> str:
    """That held-out rows may tell more of names that are in doubt, to stand behind what is to be recorded; else
    nothing."""
    if holdout <= 0 or probability >= _SURE:
        return ""
    return f"; but first ask these rows again with --holdout 0: a share of {holdout:g} of them was kept from the names"


def next_measurement(
    rivals: Sequence[Sequence[tuple[str, tuple[str, ...]]]], verdict: str, as_it_is: float, unexplained: float
) -> str:
    """Which recording would tell the likeliest combinations apart, without a full stop.

    **Arguments:** - `rivals`: combinations of (effect, targets), likeliest first; one that stands there twice is the
    same effects in different recordings, or a force without a name in different forms. - `as_it_is`, `unexplained`:
    probabilities of the simulation with nothing left out, and of a remainder without a name.
    """
    if verdict == "consistent" and (not rivals or as_it_is > _SETTLED):
        return _HARDER
    advice = [_CLOSER] if verdict == "unexplained" or unexplained > _OPEN else []
    sets = [frozenset(one) for one in rivals]
    if verdict == "mismatch" and as_it_is <= _OPEN:
        advice = [*_disputes(sets), *advice]
    elif sets:
        # Whether anything is left out at all comes first: show the likeliest effect as large as it gets.
        advice = [*advice, *(_where_it_shows(key) for key in sorted(sets[0])[:1]), *_disputes(sets)]
    return "; also ".join(list(dict.fromkeys(advice))[:_MOST]) or _tested(sets)


def _tested(sets: Sequence[_Keys]) -> str:
    """What would test an answer that nothing disputes."""
    if sets and all(name.startswith("sensor_") for name, _ in sets[0]):
        return _where_it_shows(min(sets[0]))
    return _ANOTHER


def _disputes(sets: Sequence[_Keys]) -> Iterator[str]:
    """What tells the likeliest combination from each of the others."""
    for other in sets[1:]:
        top = sets[0]
        if top == other:
            yield _FORM if any(name == UNNAMED.name for name, _ in top) else _REPEATED
            continue
        # Where one is the other and more, the surplus is what is open, and it may stand in for what both have.
        mine, yours = (top - other) or top, (other - top) or other
        found = _unmasked(mine, yours) or _elsewhere(mine, yours)
        yield found or _where_it_shows(min((top ^ other) - top or top - other))


def _unmasked(mine: _Keys, yours: _Keys) -> str | None:
    """The first pair of kinds of which one side has one and the other side the other."""
    for kind, other, text in UNMASK:
        for left, right in ((mine, yours), (yours, mine)):
            a = sorted(key for key in left if key[0] in kind)
            b = sorted(key for key in right if key[0] in other)
            pair = next(((x, y) for x in a for y in b if x[0] != y[0]), None)
            if pair is not None:
                return text.format(a=_named(pair[0]), b=_named(pair[1]))
    return None


def _elsewhere(mine: _Keys, yours: _Keys) -> str | None:
    """The same effect on other targets."""
    for name, targets in sorted(mine):
        others = [key for key in sorted(yours) if key[0] == name and key[1] != targets]
        if not others:
            continue
        here, there = _named((name, targets)), _named(others[0])
        if name.startswith("sensor_"):
            return (
                f"a recording of {here} and {there} beside a sensor that can be trusted: which of them is wrong is open"
            )
        if name in OVER_TIME or name == "parameter_error":
            return f"a measurement of {here} and of {there} by themselves: which of them is meant is open"
        return f"recordings in which {here} alone moves and in which {there} alone moves: where it acts is open"
    return None


def _where_it_shows(key: _Key) -> str:
    return SHOWS[key[0]].format(a=_named(key))


def _named(key: _Key) -> str:
    return " and ".join(key[1])
