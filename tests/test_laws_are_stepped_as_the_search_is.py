"""A search that goes on with more laws is laid out in the substeps that it had, whatever rows its recordings have."""

import engine_cases as cases
import numpy as np
import pytest

from symplearn.diagnosis import Options, Restriction, diagnose
from symplearn.diagnosis._extended import Extended


def pieces(problem):
    """Substeps in every span, by recording."""
    return [int(np.asarray(r.spans.pieces)[0]) for r in problem.rows]


@pytest.mark.slow
def test_laws_are_laid_out_in_the_same_substeps(monkeypatch):
    """Of two recordings one has rows five times as far apart as the other, and as many substeps in each of its spans. A
    damping that goes with the square of the place has no name, so that laws are asked for."""
    rates = lambda t, x: [x[1], -4 * x[0] - 0.4 * x[0] ** 2 * x[1]]  # noqa: E731
    close, wide, rng = np.linspace(0.0, 12.0, 160), np.linspace(0.0, 4.0, 12), np.random.default_rng(1)
    runs = [cases.recorded(t, cases.solved(rates, [1.0, 0.0], t)[:, 0] + 0.01 * rng.normal(size=len(t)), number=k)
            for k, t in enumerate((close, wide), start=1)]  # fmt: skip
    plain, seen = Extended.extend, []

    def extend(self, forces):
        before = pieces(self.search.problem)
        plain(self, forces)
        seen.append((before, pieces(self.search.problem)))

    monkeypatch.setattr(Extended, "extend", extend)
    some = Restriction(("viscous_damping", "unnamed_force"))
    (found,) = diagnose(cases.simulation("p**2/2 + 2*q**2"), runs, Options(restriction=some)).document["findings"]
    assert found["effect"] == "unnamed_force" and seen
    assert all(before == after for before, after in seen)
