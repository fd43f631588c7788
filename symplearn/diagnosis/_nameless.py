"""Forces without a name, weighed beside what was found with one: simple laws, and expressions of the missing force."""

from collections.abc import Sequence

import numpy as np

from .._effects import UNNAMED, Nameless
from .._recording import Recording
from .._simulation_records import SimulationFile
from ._clocks import weigh_later_clocks
from ._extended import Extended
from ._found import Found
from ._laws import laws, priced
from ._locate import strained_coordinates
from ._memories import memories
from ._options import Options
from ._outlook import Outlook
from ._posterior import CONSISTENT, Posterior, posterior
from ._problem import USUAL, Combination
from ._prospects import promising
from ._score import Start
from ._search import Search
from ._shapes import Shapes
from ._unnamed import Proposal, proposals
from ._weighed import Estimate
from ._weigher import KEPT

# A remainder is clear that stands this many nats above white noise.
_CLEAR = 5.0
# Combinations with a law that a regression sees within so many nats of the best, or so large a share of what the best
# gains, are fitted, so many at most; and those within so many nats of the best are weighed beside every remainder.
_BEHIND, _VAGUE, _MOST, _NEAR = 10.0, 0.3, 12, 8.0
# Combinations of each size that laws are tried with, no farther behind the best.
_BASES, _REACH = 2, 30.0
# Second effects that are tried beside a law, at how many places each, and what they must promise.
_BESIDE, _PLACES, _WORTH = 12, 60, 2.0
# How many laws' shapes are moved that are no farther behind the best, and by how many steps each time: whatever is
# added is compiled with all that was there.
_SHAPED, _BLUNT, _SHARPER = 2, 15.0, ((3.0, 2.0, 1.0), (1.0, 0.5), (0.25,))
# Remainders that are not weighed for every combination.
_LATER = ("clock", "static", "force", "spell")


def weigh_nameless(
    file: SimulationFile, recordings: Sequence[Recording], options: Options, search: Search, longest: float
) -> None:
    """Where something is missing, weigh forces that have no word beside those that do: simple laws; and where nothing
    fits then, expressions that were fitted to the missing force. None on a coordinate that a term of the file without a
    name pushes already (contract, section 4)."""
    if not options.restriction.has(UNNAMED) or not search.in_time() or _odds(search).as_it_is >= CONSISTENT:
        return
    options.progress("weighing laws of force without a name")
    begun, outlooks = Extended(file, recordings, options, search, longest), _outlooks(search)
    shapes = Shapes(file, outlooks)
    known = [*priced(begun.usable(laws(file))), *begun.usable(shapes.first())]
    number, known = len(known), [*known, *(_that_fade(search, begun, outlooks) if _is_doubtful(search) else [])]
    if known:
        begun.extend(known)
        members = begun.members(len(known))
        _weigh_laws(search, members[:number])
        if len(known) > number and _is_doubtful(search):
            _weigh_memories(search, members[number:])
        known = _sharpened(search, begun, shapes, known)
        _weigh_beside_laws(search, begun.members(len(known)))
    if not outlooks or not search.in_time() or not _is_open(_odds(search), search.found):
        return
    options.progress("looking for an expression of the missing force")
    some = proposals(file, outlooks, strained_coordinates(outlooks))[: USUAL - len(search.base)]
    usable = begun.usable([one.force for one in some])
    if proposed := [one for one in some if one.force in usable]:
        begun.extend([*known, *(one.force for one in proposed)])
        _weigh_proposals(search, begun, proposed)


def _outlooks(search: Search) -> list[Outlook]:
    """The force that the simulation without effects misses, by recording; none where it is not known."""
    pull = search.found.of(search.base, "force")
    if pull is None or pull.intensity is None or not search.in_time():
        return []
    outlooks = [Outlook(search.stepper, pull, r, pull.intensity) for r in range(len(search.problem.rows))]
    return outlooks if all(o.ok for o in outlooks) else []


def _weigh_laws(search: Search, members: Sequence[int]) -> None:
    """Combinations of what was found and one law, from where regressions about the best ones put them, or alone; and
    what is like the best of them beside every remainder."""
    found, near = search.found, _is_near(search)
    starts = _promising(search, members)
    alone = [s.combination for s in starts if len(s.combination) == len(search.base) + 1]
    if alone and not near:  # a regression about what is far off says little of where a fit begins
        search.weigher.weigh([Start(c, search.beginning.from_seed(), 0.0) for c in alone])
    if starts:
        search.weigher.weigh(starts, whole=True)
    if _is_open(_odds(search), found):  # what was found may hide what a law does alone
        first = [s for s in promising(search.along(members), _REACH) if s.combination not in found.estimates]
        if first:
            search.weigher.weigh(first)
    _weigh_beside_remainders(search, members)


def _is_doubtful(search: Search) -> bool:
    """Whether the likeliest answer has more than one effect, or is open."""
    best = max(search.found.estimates, key=search.found.odds)
    return search.in_time() and (len(best) > len(search.base) + 1 or _is_open(_odds(search), search.found))


def _that_fade(search: Search, begun: Extended, outlooks: Sequence[Outlook]) -> list[Nameless]:
    """Forces that fade: on every coordinate of the file, or on none, where one is taken already."""
    listed = memories(begun.file)
    usable = bool(outlooks) and len(begun.usable(listed)) == len(listed)
    return listed if usable and search.problem.equations.hidden else []


def _weigh_memories(search: Search, members: Sequence[int]) -> None:
    """Combinations of what was found and a force that fades, from where scores put them, or alone."""
    search.progress("weighing forces that remember")
    found, promises = search.found, dict[Combination, tuple[float, Start]]()
    bases = [c for c in _leaders(search) if len(c) < USUAL]
    for c in bases:
        white = found.of(c, "white")
        assert white is not None  # leaders are weighed under white noise
        for s in search.prospects.with_placed(c, members):
            promise = white.log_evidence + s.gain + found.prices.log(s.combination)
            if promise > promises.get(s.combination, (-np.inf, s))[0]:
                promises[s.combination] = promise, s
    starts = [s for _, s in sorted(promises.values(), key=lambda one: -one[0])[:_MOST]]
    if starts:
        search.weigher.weigh(starts, whole=True)
    if alone := promising(search.along(members), _REACH):
        search.weigher.weigh(alone)
    best = max(found.estimates, key=found.odds)
    if set(best) & set(members):
        search.refinement.move_places()
        search.refinement.weigh_subsets()
    _weigh_beside_remainders(search, members)


def _weigh_beside_laws(search: Search, members: Sequence[int]) -> None:
    """A second effect beside the best answer, if that has a law."""
    found = search.found
    best = max(found.estimates, key=found.odds)
    if set(best) & set(members) and len(best) < USUAL and search.in_time():
        further = sorted(search.prospects.about(best, _PLACES), key=lambda s: -s.gain - found.prices.log(s.combination))
        more = [s for s in further if s.gain > _WORTH and s.combination not in found.estimates][:_BESIDE]
        if more:
            search.weigher.weigh(more, whole=True)
        search.refinement.weigh_subsets()
    _weigh_beside_remainders(search, members)


def _sharpened(search: Search, begun: Extended, shapes: Shapes, known: list[Nameless]) -> list[Nameless]:
    """Let the shapes of the best laws go where they do best; the laws that are known then, in their order."""
    for steps in _SHARPER:
        laws = [search.problem.candidate(member).nameless for _, member in _shaped(search, shapes)]
        beside = [begun.usable(shapes.near(law, steps)) for law in laws if law]
        if not any(beside) or not search.in_time():
            continue
        known = [*known, *(one for some in beside for one in some)]
        begun.extend(known)
        first = begun.members(len(known)).start
        starts = list[Start]()
        for (c, member), some in zip(_shaped(search, shapes), beside, strict=True):
            starts += _in_its_place(search, c, member, [first + known.index(one) for one in some])
        search.weigher.weigh(starts, whole=True)
        _weigh_beside_remainders(search, range(first, first + len(known)))
    return known


def _shaped(search: Search, shapes: Shapes) -> list[tuple[Combination, int]]:
    """The best combinations that have a law with a shape, each of another one, and which member that is."""
    found, chosen = search.found, dict[int, Combination]()
    ranked = sorted(found.estimates, key=found.odds, reverse=True)
    for c in ranked:
        for m in c:
            if shapes.has(found.problem.candidate(m).nameless) and found.odds(c) > found.odds(ranked[0]) - _BLUNT:
                chosen.setdefault(m, c)
    return [(c, law) for law, c in list(chosen.items())[:_SHAPED]]


def _in_its_place(search: Search, combination: Combination, mine: int, members: Sequence[int]) -> list[Start]:
    """A fitted combination with each of some laws in place of one, and each of them alone."""
    problem, white = search.problem, search.found.of(combination, "white")
    assert white is not None  # every combination is weighed under white noise first
    values, starts = dict(problem.placed(combination)), list[Start]()
    for new in (m + mine - problem.whole(mine) for m in members):
        for c in {tuple(sorted({*combination, new} - {mine})), tuple(sorted((*search.base, new)))}:
            z = np.where(np.arange(len(white.z)) < problem.slots, white.z, 0.0)
            for m, place in problem.placed(c):
                z[place] = white.z[values[mine if m == new else m]]
            starts.append(Start(c, z, 0.0))
    return starts


def _promising(search: Search, members: Sequence[int]) -> list[Start]:
    """Where combinations with a law begin that promise nearly as much as the best one."""
    found, promises = search.found, dict[Combination, tuple[float, Start]]()
    for c in _leaders(search):
        white = found.of(c, "white")
        assert white is not None  # every combination is weighed under white noise first
        for size in range(1, min(len(c) + 1, USUAL) - len(search.base) + 1):
            for s in search.prospects.with_one_of(c, members, size, _MOST):
                promise = white.log_evidence + s.gain + found.prices.log(s.combination)
                if promise > promises.get(s.combination, (-np.inf, s))[0]:
                    promises[s.combination] = promise, s
    ranked = sorted(promises.values(), key=lambda one: -one[0])[:_MOST]
    top = max([_white_odds(found, c) for c in found.estimates] + [promise for promise, _ in ranked])
    reach = max(_BEHIND, _VAGUE * max((s.gain for _, s in ranked), default=0.0))
    return [s for promise, s in ranked if promise > top - reach]


def _leaders(search: Search) -> list[Combination]:
    """The likeliest combinations of each size."""
    found, base = search.found, search.base
    ranked = sorted((c for c in found.estimates if set(base) <= set(c)), key=found.odds, reverse=True)
    sizes = [[c for c in ranked if len(c) == size] for size in range(len(base), search.weigher.most + 1)]
    near = [c for some in sizes for c in some[:_BASES] if found.odds(c) > found.odds(ranked[0]) - _REACH]
    return [c for c in near if found.of(c, "white")]


def _is_near(search: Search) -> bool:
    """Whether some trajectory nearly follows the recording."""
    found = search.found
    return max(_white_odds(found, c) for c in found.estimates) > max(map(found.odds, found.estimates)) - _REACH


def _white_odds(found: Found, combination: Combination) -> float:
    """What a combination's probability goes with under white noise alone."""
    return found.white(combination) + found.prices.log(combination)


def _weigh_beside_remainders(search: Search, members: Sequence[int]) -> None:
    """What has a law and is near the best, beside the remainders that are not weighed for all."""
    found = search.found
    plain = {c: max((e.log_evidence for e in es if e.kind not in _LATER), default=-np.inf) + found.prices.log(c)
             for c, es in found.estimates.items()}  # fmt: skip
    mine = sorted((c for c in plain if set(c) & set(members)), key=lambda c: -plain[c])
    near = [c for c in mine if plain[c] > max(plain.values()) - _NEAR][:KEPT]
    if not near:
        return
    kinds = {e.kind for es in found.estimates.values() for e in es}
    if "clock" in kinds:
        weigh_later_clocks(search.weigher, near)
    if "static" in kinds:
        search.weigher.weigh_static(near)
    search.add_forces(near[:1], 2)


def _weigh_proposals(search: Search, begun: Extended, listed: Sequence[Proposal]) -> None:
    """All expressions together, alone and beside a missing force."""
    members = begun.members(len(listed))
    combination, z = tuple(sorted((*search.base, *members))), search.beginning.from_seed()
    sizes = {m: one.sizes for m, one in zip(members, listed, strict=True)}
    for member, place in search.problem.placed(combination):
        if member in sizes:
            z[place] = sizes[member]
    search.weigher.weigh([Start(combination, z, 0.0)])
    search.add_forces([combination], 1)


def _odds(search: Search) -> Posterior:
    return posterior(search.problem, search.found, 1.0)


def _is_open(odds: Posterior, found: Found) -> bool:
    """Whether no name fits and no law, or the best ones are many or leave a clear remainder beside them."""
    if odds.as_it_is >= CONSISTENT:
        return False
    if not odds.named or odds.unexplained >= odds.named[0].probability:
        return True
    best = odds.named[0].best
    return not found.has_law(best.combination) and (len(best.combination) >= USUAL or is_clear(found, best))


def is_clear(found: Found, best: Estimate) -> bool:
    """Whether a clear remainder is left beside an answer."""
    white = found.of(best.combination, "white")
    return white is None or best.log_evidence > white.log_evidence + _CLEAR
