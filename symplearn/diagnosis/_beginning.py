"""Where a search begins: the simulation as it is, and what its motion makes the prior of every effect."""

from collections.abc import Callable
from dataclasses import replace
from functools import cached_property

import numpy as np

from ._calibrate import Priors
from ._effect_priors import with_effects
from ._found import Found
from ._motion import extent, motion_along
from ._noisy import PathFit, fit_paths
from ._null_paths import null_paths
from ._score import Start
from ._sizes import is_read
from ._start import with_states
from ._stochastic import trajectories
from ._weigher import Weigher

# From how many seeds, and how many paths under a missing force, the simulation as it is is fitted.
STARTS = 4


class Beginning:
    """The simulation without effects.

    `paths` are its motions beside missing forces of several intensities, the weakest first; `likely` is a motion like
    the recorded one, with its unknowns, and `typical` are the forces along it; `seed` is the start, of `seeds` and
    paths, that is nearest to its best fit. No reading is taken out of the columns that are `spared`.
    """

    def __init__(
        self, weigher: Weigher, seeds: np.ndarray, progress: Callable[[str], None], spared: frozenset[int] = frozenset()
    ):
        self.weigher, self.progress, self.spared = weigher, progress, spared
        self.seeds, self.seed = seeds, seeds[0]
        self.paths: list[PathFit] = []

    def run(self) -> None:
        """Weigh the simulation without effects under every remainder, with outliers taken out."""
        w = self.weigher
        bare = w.found.priors
        self._follow(bare)
        # From trajectories, too: a path that needs a strong force to follow the recording goes through outliers.
        if w.take_out_outliers(self.paths, w.found.priors, self.spared):
            w.found = Found(w.problem, bare)
            self._follow(bare)
        w.add_paths(self.paths)

    def _follow(self, bare: Priors) -> None:
        """Paths and trajectories of the simulation as it is, and the priors of effects that its motion sets."""
        w = self.weigher
        self.progress("following the recording with a missing force")
        paths = null_paths(w.stepper, self.seed, w.rows, bare, w.path_steps)
        self.paths = [replace(fit, combination=w.base) for fit in paths]
        self.likely = z, likely = self._likely_paths()
        motion = motion_along(w.problem, z, likely)
        self.typical = motion.forces
        w.found.priors = with_effects(w.problem, with_states(w.problem, bare, likely), motion)
        self.progress("weighing the simulation as it is")
        self._weigh_nothing()
        self.paths = self._paths_again()

    def _paths_again(self) -> list[PathFit]:
        """Paths under the priors of effects; for each intensity the better of two, from the path it had and from the
        trajectory: a weak force is hard to reach from a path that no force could have."""
        w = self.weigher
        white, paths = w.found.of(w.base, "white"), self.paths
        again = fit_paths(w.stepper, paths, w.found.priors, w.rows, 3)
        if white is None or not white.converged:
            return again
        states = trajectories(w.stepper, white.z, w.base, w.rows)
        starts = [replace(fit, z=white.z, noise=white.noise, paths=states, laplace=None) for fit in paths]
        near = fit_paths(w.stepper, starts, w.found.priors, w.rows, w.path_steps)
        return [max(pair, key=lambda fit: fit.log_evidence) for pair in zip(again, near, strict=True)]

    def _likely_paths(self) -> tuple[np.ndarray, list[np.ndarray]]:
        """A motion like the recorded one, with its unknowns: the best path; where that has not settled, the smaller of
        it and of the best trajectory: near a singularity a missing force throws a path far out."""
        best, w = self.best, self.weigher
        ways = [(best.z, best.paths)]
        if not best.converged:
            ways.append((self.seeds[0], trajectories(w.stepper, self.seeds[0], w.base, w.rows)))
        some = [way for way in ways if all(np.isfinite(path).all() for path in way[1])]
        return min(some or ways[:1], key=lambda way: extent(way[1]))

    def _weigh_nothing(self) -> None:
        """The simulation as it is, from many starts: a local optimum here would look like physics left out."""
        w = self.weigher
        ways = [fit.z for fit in self.paths if np.isfinite(fit.log_evidence)]
        starts = [*self.seeds[:STARTS], *ways[-STARTS:]]
        w.weigh([Start(w.base, self.bare(z), 0.0) for z in starts])
        best = w.found.of(w.base, "white")
        if best is not None and np.isfinite(best.log_evidence):
            head = w.problem.head
            spread = np.ptp(np.stack(starts)[:, :head], axis=0) + 1e-300
            self.seed = min(starts, key=lambda z: float((((z - best.z)[:head] / spread) ** 2).sum()))

    @property
    def best(self) -> PathFit:
        """The best path of the simulation without effects."""
        return max(self.paths, key=lambda fit: fit.log_evidence)

    @cached_property
    def unread(self) -> list[int]:
        """Coordinates of which no recording reads anything, be it their speed."""
        problem, mean = self.weigher.problem, self.weigher.found.priors.mean
        read = np.any([is_read(problem, mean, r) for r in range(len(problem.rows))], axis=0)
        width = problem.equations.width
        return [i for i in range(problem.equations.declared) if not (read[i] or read[width + i])]

    def from_seed(self) -> np.ndarray:
        """Where a fit begins that knows nothing better."""
        return self.bare(self.seed)

    def bare(self, z: np.ndarray) -> np.ndarray:
        """Unknowns without effects."""
        return np.where(np.arange(len(z)) < self.weigher.problem.slots, z, 0.0)
