"""A problem that grows: forces without a name behind its candidates."""

from collections.abc import Sequence

import numpy as np
import sympy
from jaxtyping import Float

from .._effects import UNNAMED, Nameless
from .._recording import Recording
from .._simulation_records import SimulationFile
from ._build import build, equations_for
from ._effect_priors import STRENGTH, with_nameless
from ._memories import Span, fading, stiffness
from ._options import Options
from ._search import Search
from ._trajectory import Stepper
from ._unnamed import along_path


class Extended:
    """The problem of a search with forces without a name behind its candidates."""

    def __init__(
        self, file: SimulationFile, recordings: Sequence[Recording], options: Options, search: Search, longest: float
    ):
        self.file, self.recordings, self.options, self.search = file, recordings, options, search
        self.longest = longest  # substep that the problem was laid out with
        # Coordinates that a term of the file without a name pushes already.
        self._taken = {file.coordinates.index(term.target[0]) for term in file.terms if term.effect == UNNAMED.name}

    def usable(self, forces: Sequence[Nameless]) -> list[Nameless]:
        """Those that are a number along the recorded motion, and somewhere not zero, on coordinates that are free."""
        if not forces:
            return []
        scales = zip(forces, self._scales(forces), strict=True)
        return [one for one, scale in scales if np.isfinite(scale).all() and self._taken.isdisjoint(one.places)]

    def extend(self, forces: Sequence[Nameless]) -> None:
        """Let the search go on with these, of which the first ones may be known to it."""
        search, restriction = self.search, self.options.restriction
        built = equations_for(self.file, self.recordings, restriction, forces)
        problem = build(self.file, built, self.recordings, self.options.holdout, self.longest, restriction)
        priors = with_nameless(problem, search.found.priors, self._scales(forces), [self._span(one) for one in forces])
        search.goes_on(Stepper(problem, self.options.jobs), priors)

    def members(self, number: int) -> range:
        """Of the last so many forces that the search was extended by."""
        every = len(self.search.problem.equations.candidates)
        return range(every - number, every)

    def _scales(self, forces: Sequence[Nameless]) -> list[Float[np.ndarray, " _"]]:
        """Prior scales of their amplitudes: as strong as every other effect where it is strongest; what fades, as if it
        did not."""
        sizes = iter(self._sizes([term for force in forces for terms in force.pushes for term in terms]))
        out = []
        with np.errstate(divide="ignore"):
            for force in forces:
                if force.memory is not None:
                    (i,) = force.places
                    out.append(np.array([STRENGTH * stiffness(self.search.beginning.typical[i], self._along(i))]))
                    continue
                each = [[self.search.beginning.typical[i] / next(sizes) for _ in terms]
                        for i, terms in zip(force.places, force.pushes, strict=True)]  # fmt: skip
                out.append(STRENGTH * np.min(each, axis=0))
        return out

    def _span(self, force: Nameless) -> Span | None:
        if force.memory is None:
            return None
        q, rows = self._along(force.places[0]), self.search.problem.rows
        return fading(force.memory, q, [r.times[: len(one)] for r, one in zip(rows, q, strict=True)])

    def _along(self, i: int) -> list[Float[np.ndarray, " row"]]:
        """A coordinate along the motion that every prior of an effect comes from, by recording."""
        return [path[:, i] for path in self.search.beginning.likely[1]]

    def _sizes(self, terms: Sequence[sympy.Expr]) -> Float[np.ndarray, " term"]:
        """Root mean squares of terms along the motion that every prior of an effect comes from."""
        if not terms:
            return np.zeros(0)
        problem, (z, paths), columns = self.search.problem, self.search.beginning.likely, []
        d, width = len(self.file.coordinates), problem.equations.width
        for r, (path, rows) in enumerate(zip(paths, problem.rows, strict=True)):
            points = np.concatenate([path[:, :d], path[:, width : width + d]], axis=1)
            fixed, n = problem.parameter_values(r, z)[: len(self.file.parameters)], len(path)
            columns.append(along_path(self.file, terms, fixed, points, rows.inputs[:n], rows.times[:n]))
        return np.sqrt((np.concatenate(columns) ** 2).mean(0))
