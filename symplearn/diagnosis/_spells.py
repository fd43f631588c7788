"""A missing force that acts for a while and not before or after: where it may have acted, and paths under it."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from .._effects import IMPULSE
from ._calibrate import calibrate
from ._noisy import PathFit, fit_paths
from ._outlook import Outlook
from ._problem import Combination
from ._prospects import Prospects
from ._score import Start, Unit
from ._trajectory import Stepper
from ._weighed import Estimate

# How long it may act, as shares of the longest recording, and how strong it may be, of the forces already there.
_LENGTHS, _STRENGTHS = (1 / 16, 1 / 8, 1 / 4, 1 / 2), np.geomspace(1e-3, 1.0, 4)
# Places of a spell that are told apart, per length of it.
_OVERLAP = 2
# Single effects that are tried beside a spell, those whose own spells are looked for, places at which an effect is
# tried, and nats that one must promise.
_TRIED, _OWN, _PLACES, _WORTH = 4, 2, 60, 2.0
# Steps after which a fit is given up, and how many nats it then lies behind the best of all with all that it promises.
_STEPS, _HOPELESS = 4, 50.0
# Blows that are tried in a spell, of all coordinates together, the steps of each, and how many are weighed then.
_BLOWS, _BLOW_STEPS, _LIKELIEST = 48, 12, 4


class Spells:
    """Weighs forces that act for a while: beside nothing, beside the best combination and what it is without one of its
    members, and, where nothing with one is near the best, beside the single effects that promise most along its path.
    """

    def __init__(self, prospects: Prospects, typical: Float[np.ndarray, " d"]):
        self.prospects, self.typical = prospects, typical
        self.weigher = prospects.weigher

    def weigh(self, best: Combination, reach: float) -> None:
        """Add what was found; `reach` is how many nats nothing may lie behind the best of all for more to be tried."""
        w = self.weigher
        pulls = [pull for c in dict.fromkeys([w.base, best]) if (pull := w.found.of(c, "force"))]
        fits = self._add([start for pull in pulls for start in self._about(pull)])
        self._add(self._with_less([fit for fit in fits if fit.combination == best]))
        alone = [fit for fit in fits if fit.combination == w.base and np.isfinite(fit.log_evidence)]
        if not alone or w.found.odds(w.base) < w.found.odds(best) - reach:
            return
        path = max(alone, key=lambda fit: fit.log_evidence - fit.choices)
        chosen = replace(path, laplace=None, choices=path.choices + float(np.log(len(alone))))
        likely = self._promising(path)
        self._add([replace(chosen, combination=one.combination, z=one.z) for one in likely])
        ranked = [one.combination for one in likely if w.found.of(one.combination, "spell")]
        ranked.sort(key=w.found.odds, reverse=True)
        self._add([start for c in ranked[:_OWN] if (own := w.found.of(c, "spell")) for start in self._about(own)])

    def weigh_blows(self) -> None:
        """Blows within the force that acts for a while beside the best answer, where it is the likeliest remainder.

        A blow is such a force, too, and its time has an optimum in every swing of what it sets going: a score about a
        trajectory without it sees few of them.
        """
        w = self.weigher
        best = max(w.found.estimates, key=w.found.odds)
        spell = w.found.of(best, "spell")
        others = [one.log_evidence for one in w.found.estimates[best] if one.kind != "spell"]
        if spell is None or spell.log_evidence < max(others, default=-np.inf) + _WORTH or len(best) >= w.most:
            return
        if not (starts := self._struck(spell)):
            return
        z, combinations = np.stack([one.z for one in starts]), [one.combination for one in starts]
        fits = calibrate(w.stepper, z, combinations, w.found.priors, w.rows, _BLOW_STEPS)
        likeliest = np.argsort(np.where(np.isnan(fits.cost), np.inf, fits.cost))[:_LIKELIEST]
        w.weigh([Start(combinations[k], fits.z[k], 0.0) for k in likeliest], whole=True)

    def _struck(self, spell: Estimate) -> list[Start]:
        """Its combination with a blow at times in it, on one coordinate or another."""
        assert spell.exposures is not None  # it acts for a while
        problem = self.weigher.problem
        ((r, acting),) = [(r, np.flatnonzero(each)) for r, each in enumerate(spell.exposures) if each.any()]
        beside = [c for c in problem.searched if problem.is_possible((*spell.combination, c))]
        blows = [c for c in beside if problem.candidate(c).effect is IMPULSE]
        some = acting[:: max(1, -(-len(acting) * len(blows) // _BLOWS))]
        units = [Unit(c, float(problem.rows[r].times[k])) for c in blows for k in some]
        starts, mine = self.prospects.at_each(spell, units), set(spell.combination)
        return [one for one in starts if all(problem.members[m].recordings == (r,) for m in {*one.combination} - mine)]

    def _with_less(self, fits: list[PathFit]) -> list[PathFit]:
        """The best of some fits with a member less beside the same force, which may do what that was needed for."""
        some = [fit for fit in fits if np.isfinite(fit.log_evidence)]
        if not some:
            return []
        path, w = max(some, key=lambda fit: fit.log_evidence - fit.choices), self.weigher
        less = [tuple(m for m in path.combination if m != out) for out in path.combination if out not in w.base]
        return [replace(path, combination=c, z=w.problem.carried(path.z, path.combination, c), laplace=None)
                for c in less if c != w.base and w.found.of(c, "white")]  # fmt: skip

    def _about(self, pull: Estimate) -> list[PathFit]:
        return spells(self.weigher.stepper, pull, self.typical, self.weigher.rows)

    def _add(self, starts: list[PathFit]) -> list[PathFit]:
        w = self.weigher
        fits = fit_paths(w.stepper, starts, w.found.priors, w.rows, min(_STEPS, w.path_steps))
        near = [k for k, fit in enumerate(fits) if not fit.converged and w.may_matter(fit, _HOPELESS)]
        again = fit_paths(w.stepper, [fits[k] for k in near], w.found.priors, w.rows, w.path_steps)
        for k, fit in zip(near, again, strict=True):
            fits[k] = fit
        w.add_paths(fits)
        return fits

    def _promising(self, path: PathFit) -> list[Start]:
        """Single effects, each at its best place, that promise most along a path under a spell."""
        promised = sorted(self.prospects.along(path, _PLACES), key=lambda start: start.gain)
        # Every combination that is weighed at all is weighed under white noise.
        likely = {one.combination: one for one in promised if self.weigher.found.of(one.combination, "white")}
        ranked = sorted(likely.values(), key=lambda start: -start.gain)[:_TRIED]
        return [one for one in ranked if one.gain > _WORTH]


def spells(stepper: Stepper, pull: Estimate, typical: Float[np.ndarray, " d"], rows: Sequence[int]) -> list[PathFit]:
    """Where fits of a combination beside a force that acts for a while begin: for every length of it where `pull`, a
    force that always acts, is strained most."""
    assert pull.intensity is not None and pull.paths is not None  # it is an estimate beside a force
    outlooks = [Outlook(stepper, pull, r, pull.intensity) for r in range(len(rows))]
    if not all(o.ok for o in outlooks):
        return []
    strain = [(o.strain() ** 2).sum(1)[: n - 1] for o, n in zip(outlooks, rows, strict=True)]
    out, most = [], max(rows) - 1
    for width in dict.fromkeys(max(2, round(share * most)) for share in _LENGTHS):
        r, begin = _most_strained(strain, width)
        exposures = tuple(np.zeros(n) for n in rows)
        exposures[r][begin : begin + width] = 1.0
        times = stepper.problem.rows[r].times
        length = times[min(begin + width, len(times) - 1)] - times[begin]
        choices = float(np.log(sum(max(1.0, _OVERLAP * len(each) / width) for each in strain)))
        first = PathFit(
            pull.combination, pull.intensity, pull.z, pull.noise, pull.paths, exposures=exposures, choices=choices
        )
        forces = [share * np.maximum(typical, 1e-300) for share in _STRENGTHS]
        out += [replace(first, intensity=force**2 * length) for force in forces]
    return out


def _most_strained(strain: Sequence[Float[np.ndarray, " _"]], width: int) -> tuple[int, int]:
    """The recording, and the first span in it, of the stretch of this many spans that is strained most."""
    sums = []
    for each in strain:
        total = np.concatenate([[0.0], np.cumsum(np.nan_to_num(each))])
        sums.append(total[width:] - total[:-width] if len(total) > width else total[-1:])
    r = int(np.argmax([one.max() for one in sums]))
    return r, int(np.argmax(sums[r]))
