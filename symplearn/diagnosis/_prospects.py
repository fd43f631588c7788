"""Where fits with one effect more begin: what promises most about a fit that was made."""

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float

from ._calibrate import Fits, estimate_noise, residuals, weights
from ._exchange import Regression
from ._noisy import PathFit
from ._problem import Combination
from ._scan import grid, noise_starts, on_path, on_trajectory, scan
from ._score import Start, Unit
from ._tangent import sharp_units
from ._weighed import Estimate
from ._weigher import Weigher
from ._whitening import whitening

# Places at which an effect is tried beside the best of a size.
MANY = 160
# Effects of the highest scores that may take another's part, beside all those without a place.
_EXCHANGED = 24
# Starts about one motion that are fitted first, and the share of a promise that may be wrong.
_FIRST, _VAGUE = 16, 0.3
# Places at which an effect is tried at most; fewer where a trajectory costs more than one of so many leapfrog
# substeps; how much more a substep of a nonseparable system costs.
_LEAST = 10
_CHEAP, _NONSEPARABLE = 600, 5


class Prospects:
    """What promises to help beside what a weigher has weighed."""

    def __init__(self, weigher: Weigher):
        self.weigher = weigher
        self._known: dict[tuple[Combination, float, int], list[Start]] = {}
        self._last: tuple[Combination, Estimate, Fits] | None = None

    def about(self, combination: Combination, most: int) -> list[Start]:
        """Starts with one effect more than a fitted combination, each of at most so many places; none about one that
        ran away."""
        white = self.weigher.found.of(combination, "white")
        assert white is not None  # every combination is weighed under white noise first
        if len(combination) >= self.weigher.most:
            return []
        key = combination, white.log_evidence, most
        if key not in self._known:
            fits = self._fitted(combination)
            self._known[key] = [] if fits is None else self._scanned(fits, most)
        return self._known[key]

    def along(self, path: PathFit, most: int, members: Sequence[int] | None = None) -> list[Start]:
        """Starts of single effects about a path that a missing force bends: of all, or of some."""
        w = self.weigher
        if not np.isfinite(path.log_evidence):
            return []
        units = self._units(most) if members is None else self._grids(members)
        grams = on_path(w.stepper, path, w.rows)
        return scan(w.problem, grams, path.z, w.base, w.found.priors, units)

    def with_placed(self, combination: Combination, members: Sequence[int]) -> list[Start]:
        """Starts of a fitted combination with one of some members, each of which is tried at all its places."""
        w, fits = self.weigher, self._fitted(combination)
        if fits is None:
            return []
        grams = on_trajectory(w.stepper, fits, 0, w.rows)
        return scan(w.problem, grams, fits.z[0], combination, w.found.priors, self._grids(members))

    def at_each(self, estimate: Estimate, units: Sequence[Unit]) -> list[Start]:
        """Starts of an estimate's combination with one effect more, at every one of some places, about its trajectory
        without what is missing beside it."""
        w, c = self.weigher, estimate.combination
        fits = self._about(c, estimate.z)
        if fits is None:
            return []
        grams = on_trajectory(w.stepper, fits, 0, w.rows)
        return [one for unit in units for one in scan(w.problem, grams, estimate.z, c, w.found.priors, [unit])]

    def _grids(self, members: Sequence[int]) -> list[Unit]:
        return [unit for m in members for unit in grid(self.weigher.problem, self.weigher.found.priors, m)]

    def exchanged(
        self, combination: Combination, most: int, size: int, number: int, beside: Estimate | None = None,
        plainly: bool = False,
    ) -> list[Start]:  # fmt: skip
        """Combinations of a size, at most so many, that may do as well as a fitted one, whose members they need not
        have: of all effects without a place, in all recordings or in the same as one of its members, and of others
        where one more of them helps most. `beside` the remainder of an estimate, if any: those too that were weighed
        without it. `plainly`: of none at a place."""
        w, fits = self.weigher, self._fitted(combination)
        if fits is None:
            return []
        problem = w.problem
        units = {m: Unit(problem.whole(m), None) for m in self._without_a_place(combination)}
        placed = [] if plainly else self.about(combination, most)
        for start in sorted(placed, key=lambda start: -start.gain)[:_EXCHANGED]:
            (member,) = set(start.combination) - set(combination)
            place = dict(problem.placed(start.combination))[member].stop - 1
            is_placed = bool(problem.candidate(member).effect.places)
            units.setdefault(member, Unit(problem.whole(member), float(start.z[place]) if is_placed else None))
        some = {m: unit for m, unit in units.items() if problem.candidate(m).effect.amplitudes and m not in combination
                and not problem.candidate(m).effect.switched}  # fmt: skip
        if not some:
            return []
        whiten = whitening(problem, fits, w.rows, beside) if beside else None
        regression = Regression(w.stepper, fits, w.rows, w.found.priors, some, whiten)
        known = [c for c in w.found.estimates if beside is None or w.found.of(c, beside.kind)]
        among = (lambda m: problem.is_plain((m,))) if plainly else None
        return regression.subsets(size + len(w.base), set(known).__contains__, number, among)

    def _without_a_place(self, combination: Combination) -> list[int]:
        """Effects without a place, in all recordings or in the same as one of a combination's members."""
        problem = self.weigher.problem
        plain = [m for m in problem.searched if not problem.candidate(m).effect.places]
        same = {problem.members[m].recordings for m in combination}
        return [*plain, *(v for m in plain for v in problem.variants(m) if problem.members[v].recordings in same)]

    def with_one_of(self, combination: Combination, members: Sequence[int], size: int, number: int) -> list[Start]:
        """The same of effects of a fitted one with one of some members, in all recordings or in some, that have no
        place."""
        w, fits = self.weigher, self._fitted(combination)
        if fits is None:
            return []
        every = [m for one in members for m in (one, *w.problem.variants(one)) if m not in combination]
        units = {m: Unit(w.problem.whole(m), None) for m in every}
        regression = Regression(w.stepper, fits, w.rows, w.found.priors, units)
        return regression.with_one_more(size + len(w.base), set(w.found.estimates).__contains__, number)

    def _scanned(self, fits: Fits, most: int) -> list[Start]:
        w, (combination,), (z,) = self.weigher, fits.combinations, fits.z
        grams = on_trajectory(w.stepper, fits, 0, w.rows)
        able = {m for m in w.problem.searched if w.problem.is_possible((*combination, m))}
        placed = any(w.problem.candidate(m).effect.places for m in able)
        sharp = sharp_units(w.stepper, fits, w.rows, w.found.priors) if placed else {}
        wrong = noise_starts(w.problem, fits, w.rows)
        units = [one for one in self._units(most, sharp) if one.candidate in able]
        return wrong + scan(w.problem, grams, z, combination, w.found.priors, units, sharp)

    def _fitted(self, combination: Combination) -> Fits | None:
        """A combination as it was fitted; None where it ran away."""
        white = self.weigher.found.of(combination, "white")
        assert white is not None
        if self._last is not None and self._last[0] == combination and self._last[1] is white:
            return self._last[2]
        fits = self._about(combination, white.z)
        if fits is not None:
            self._last = combination, white, fits
        return fits

    def _about(self, combination: Combination, z: Float[np.ndarray, " z"]) -> Fits | None:
        """Unknowns of a combination with what they leave of the readings; None where they run away."""
        w = self.weigher
        weight = weights(w.problem, w.rows)
        predictions = w.stepper.predict(z[None], [combination], w.rows)
        noise = estimate_noise(w.problem, [combination], residuals(w.problem, predictions, weight), weight)
        if not np.isfinite(noise).all():
            return None
        return Fits([combination], z[None], noise, predictions, np.zeros(1), np.ones(1, bool))

    def _units(self, most: int, sharp: Mapping[int, list[Unit]] | None = None) -> list[Unit]:
        """What is tried: every effect and target at its `sharp` places, or at all, thinned to so many at most."""
        problem, out = self.weigher.problem, list[Unit]()
        substeps = sum(self.weigher.rows) * int(np.asarray(problem.rows[0].spans.pieces)[0])
        load = substeps * (1 if problem.equations.separable else _NONSEPARABLE) / _CHEAP
        most = max(_LEAST, int(most / max(1.0, load)))
        for c in problem.searched:
            units = (sharp or {}).get(c) or grid(problem, self.weigher.found.priors, c)
            out += units[:: max(1, -(-len(units) // most))]
        return out


def promising(scanned: Sequence[Start], reach: float) -> list[Start]:
    """Of what was looked at about one motion, what promises nearly as much as the best: within `reach` nats, or a
    share, since the farther off that motion is, the less exact are promises."""
    ranked = sorted(scanned, key=lambda start: -start.gain)[:_FIRST]
    return [s for s in ranked if s.gain > ranked[0].gain - max(reach, _VAGUE * ranked[0].gain)]
