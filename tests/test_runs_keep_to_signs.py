"""A step about a fit may end where a friction would drive; what is run is the most probable of what signs allow."""

import engine_cases as cases
import numpy as np
import pytest
from scipy.optimize import lsq_linear

from symplearn.diagnosis._found import within_signs
from symplearn.diagnosis._weighed import Estimate

TIMES = np.linspace(0.0, 10.0, 50)
LAWS = ("coulomb_friction", "constant_force", "viscous_damping")


@pytest.fixture(scope="module")
def known():
    p = cases.problem(cases.simulation("p**2/2 + q**2/2"), [cases.recorded(TIMES, np.cos(TIMES))], 0.05)
    names = {p.candidate(m).effect.name: m for m in p.searched}
    return p, tuple(sorted(names[name] for name in LAWS))


def estimated(p, c, values, seed):
    """Effects with these values, and start and values correlated by chance."""
    z, rng = np.zeros(p.size), np.random.default_rng(seed)
    free = np.nonzero(p.active(c))[0]
    root = rng.normal(size=(len(free), len(free) + 3))
    spread = np.zeros((p.size, p.size))
    spread[np.ix_(free, free)] = root @ root.T
    z[free] = rng.normal(size=len(free))
    for m, place in p.placed(c):
        z[place] = values[p.candidate(m).effect.name]
    return Estimate(c, "white", z, spread, np.ones(1), 0.0, True), free


@pytest.mark.parametrize(
    "values",
    [(-1.0, -2.0, 30.0), (30.0, -2.0, -0.5), (-3.0, 1.0, -4.0)],
    ids=["a dry friction", "a damping", "both"],
)
@pytest.mark.parametrize("seed", [0, 1])
def test_it_is_the_most_probable_of_what_is_allowed(values, seed, known):
    """The start and whatever has no sign follow as they are correlated: SciPy's bounded least squares."""
    p, c = known
    one, free = estimated(p, c, dict(zip(LAWS, values, strict=True)), seed)
    root = np.linalg.inv(np.linalg.cholesky(one.covariance[np.ix_(free, free)]))
    low = np.full(p.size, -np.inf)
    for m, place in p.placed(c):
        if p.candidate(m).effect.name != "constant_force":
            low[place] = 0.0
    expected = lsq_linear(root, root @ one.z[free], (low[free], np.inf), tol=1e-14)
    # SciPy's method stays inside the bounds and comes within 1e-7 of them.
    np.testing.assert_allclose(within_signs(p, one).z[free], expected.x, atol=1e-5)


def test_what_is_allowed_stays(known):
    """Where no friction drives nothing is changed, the estimate itself is returned."""
    p, c = known
    one, _ = estimated(p, c, dict(zip(LAWS, (0.3, -1.0, 0.1), strict=True)), 0)
    assert within_signs(p, one) is one
