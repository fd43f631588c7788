"""Forces without a name, weighed beside what was found with one: simple laws, and expressions of the missing force."""

from collections.abc import Container, Sequence

import numpy as np
import sympy
from jaxtyping import Float

from .._effects import UNNAMED, Nameless
from .._recording import Recording
from .._simulation_records import SimulationFile
from ._build import augmented_equations, build
from ._effect_priors import STRENGTH, with_nameless
from ._found import Found
from ._laws import laws, priced
from ._locate import strained_coordinates
from ._options import Options
from ._outlook import Outlook
from ._posterior import CONSISTENT, Posterior, posterior
from ._problem import MOST, Combination
from ._score import Start
from ._search import Search
from ._trajectory import Stepper
from ._unnamed import Proposal, along_path, proposals
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
# Remainders that are not weighed for every combination.
_LATER = ("clock", "static", "force", "spell")


def weigh_nameless(file: SimulationFile, recordings: Sequence[Recording], options: Options, search: Search) -> None:
    """Where something is missing, weigh forces that have no word beside those that do: simple laws; and where nothing
    fits then, expressions that were fitted to the missing force. None on a coordinate that a term of the file without a
    name pushes already (contract, section 4)."""
    if not options.restriction.has(UNNAMED) or not search.in_time() or _odds(search).as_it_is >= CONSISTENT:
        return
    options.progress("weighing laws of force without a name")
    taken = {file.coordinates.index(term.target[0]) for term in file.terms if term.effect == UNNAMED.name}
    begun = _Extended(file, recordings, options, search)
    if known := priced(begun.usable(laws(file), taken)):
        begun.extend(known)
        _weigh_laws(search, begun.members(len(known)))
    pull = search.found.of(search.base, "force")
    if pull is None or pull.intensity is None or not search.in_time() or not _is_open(_odds(search), search.found):
        return
    options.progress("looking for an expression of the missing force")
    outlooks = [Outlook(search.stepper, pull, r, pull.intensity) for r in range(len(recordings))]
    if not all(o.ok for o in outlooks):
        return
    some = proposals(file, outlooks, strained_coordinates(outlooks))[: MOST - len(search.base)]
    usable = begun.usable([one.force for one in some], taken)
    if proposed := [one for one in some if one.force in usable]:
        begun.extend([*known, *(one.force for one in proposed)])
        _weigh_proposals(search, begun, proposed)


class _Extended:
    """The problem of a search with forces without a name behind its candidates."""

    def __init__(self, file: SimulationFile, recordings: Sequence[Recording], options: Options, search: Search):
        self.file, self.recordings, self.options, self.search = file, recordings, options, search

    def usable(self, forces: Sequence[Nameless], taken: Container[int]) -> list[Nameless]:
        """Those that are a number along the recorded motion, and somewhere not zero, on coordinates that are free."""
        if not forces:
            return []
        scales = zip(forces, self._scales(forces), strict=True)
        return [one for one, scale in scales if np.isfinite(scale).all() and not any(i in taken for i in one.places)]

    def extend(self, forces: Sequence[Nameless]) -> None:
        """Let the search go on with these, of which the first ones may be known to it."""
        search, times = self.search, self.recordings[0].times
        first, middle = float(times[0]), float(np.mean(times[[0, -1]]))
        restriction, problem = self.options.restriction, search.problem
        built = augmented_equations(self.file, first, restriction, middle, forces)
        longest = float(np.max(problem.rows[0].spans.step)) * (1 + 1e-9)
        problem = build(self.file, built, self.recordings, self.options.holdout, longest, restriction)
        scales = [float(x) for each in self._scales(forces) for x in each]
        search.goes_on(Stepper(problem, self.options.jobs), with_nameless(problem, search.found.priors, scales))

    def members(self, number: int) -> range:
        """Of the last so many forces that the search was extended by."""
        every = len(self.search.problem.equations.candidates)
        return range(every - number, every)

    def _scales(self, forces: Sequence[Nameless]) -> list[Float[np.ndarray, " amplitude"]]:
        """Prior scales of their amplitudes: as strong as every other effect where it is strongest."""
        sizes = iter(self._sizes([term for force in forces for terms in force.pushes for term in terms]))
        out = []
        with np.errstate(divide="ignore"):
            for force in forces:
                each = [[self.search.typical[i] / next(sizes) for _ in terms]
                        for i, terms in zip(force.places, force.pushes, strict=True)]  # fmt: skip
                out.append(STRENGTH * np.min(each, axis=0))
        return out

    def _sizes(self, terms: Sequence[sympy.Expr]) -> Float[np.ndarray, " term"]:
        """Root mean squares of terms along the motion that every prior of an effect comes from."""
        problem, (z, paths), columns = self.search.problem, self.search.likely, []
        d, width = len(self.file.coordinates), problem.equations.width
        for r, (path, rows) in enumerate(zip(paths, problem.rows, strict=True)):
            points = np.concatenate([path[:, :d], path[:, width : width + d]], axis=1)
            fixed, n = problem.parameter_values(r, z)[: len(self.file.parameters)], len(path)
            columns.append(along_path(self.file, terms, fixed, points, rows.inputs[:n], rows.times[:n]))
        return np.sqrt((np.concatenate(columns) ** 2).mean(0))


def _weigh_laws(search: Search, members: Sequence[int]) -> None:
    """Combinations of what was found and one law, from where regressions about the best ones put them; a second effect
    beside the best law; and what is like the best of them beside every remainder."""
    found, near = search.found, _is_near(search)
    starts = _promising(search, members)
    alone = [s.combination for s in starts if len(s.combination) == len(search.base) + 1]
    if alone and not near:  # a regression about what is far off says little of where a fit begins
        search.weigher.weigh([Start(c, search.from_seed(), 0.0) for c in alone])
    if starts:
        search.weigher.weigh(starts, whole=True)
    best = max(found.estimates, key=found.odds)
    if set(best) & set(members) and len(best) < MOST and search.in_time():
        further = sorted(search.prospects.about(best, _PLACES), key=lambda s: -s.gain - found.prices.log(s.combination))
        more = [s for s in further if s.gain > _WORTH and s.combination not in found.estimates][:_BESIDE]
        if more:
            search.weigher.weigh(more, whole=True)
        search.refinement.weigh_subsets()
    _weigh_beside_remainders(search, members)


def _promising(search: Search, members: Sequence[int]) -> list[Start]:
    """Where combinations with a law begin that promise nearly as much as the best one."""
    found, promises = search.found, dict[Combination, tuple[float, Start]]()
    for c in _leaders(search):
        white = found.of(c, "white")
        assert white is not None  # every combination is weighed under white noise first
        for size in range(1, min(len(c) + 1, MOST) - len(search.base) + 1):
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
    sizes = [[c for c in ranked if len(c) == size] for size in range(len(base), MOST + 1)]
    near = [c for some in sizes for c in some[:_BASES] if found.odds(c) > found.odds(ranked[0]) - _REACH]
    return [c for c in near if found.of(c, "white")]


def _is_near(search: Search) -> bool:
    """Whether some trajectory nearly follows the recording."""
    found = search.found
    return max(_white_odds(found, c) for c in found.estimates) > max(map(found.odds, found.estimates)) - _REACH


def _white_odds(found: Found, combination: Combination) -> float:
    """What a combination's probability goes with under white noise alone."""
    white = found.of(combination, "white")
    return -np.inf if white is None else white.log_evidence + found.prices.log(combination)


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
        search.weigher.weigh_clocks(near)
    if "static" in kinds:
        search.weigher.weigh_static(near)
    search.add_forces(near[:1], 2)


def _weigh_proposals(search: Search, begun: _Extended, listed: Sequence[Proposal]) -> None:
    """All expressions together, alone and beside a missing force."""
    members = begun.members(len(listed))
    combination, z = tuple(sorted((*search.base, *members))), search.from_seed()
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
    has_law = any(found.problem.candidate(m).nameless for m in best.combination)
    return not has_law and (len(best.combination) == MOST or is_clear(found, best))


def is_clear(found: Found, best: Estimate) -> bool:
    """Whether a clear remainder is left beside an answer."""
    white = found.of(best.combination, "white")
    return white is None or best.log_evidence > white.log_evidence + _CLEAR
