"""A step about a fit may end where a friction drives or no frequency is; the most probable that may be is run."""

import engine_cases as cases
import numpy as np
import pytest
from scipy.optimize import lsq_linear

from symplearn.diagnosis._calibrate import Priors
from symplearn.diagnosis._found import within_bounds
from symplearn.diagnosis._weighed import Estimate

TIMES = np.linspace(0.0, 10.0, 50)
LAWS = ("coulomb_friction", "constant_force", "viscous_damping")


@pytest.fixture(scope="module")
def known():
    p = cases.problem(cases.simulation("p**2/2 + q**2/2"), [cases.recorded(TIMES, np.cos(TIMES))], 0.05)
    names = {p.candidate(m).effect.name: m for m in p.searched}
    return p, tuple(sorted(names[name] for name in LAWS))


def bounded(p, member=None, low=-np.inf, high=np.inf):
    """Priors that know nothing but between which numbers the last value of one effect is."""
    size = max(p.candidate(m).values.stop for m in p.searched)
    wide, lower, upper = np.full(size, np.inf), np.full(size, -np.inf), np.full(size, np.inf)
    if member is not None:
        last = p.candidate(member).values.stop - 1
        lower[last], upper[last] = low, high
    return Priors(
        np.zeros(p.size),
        np.zeros(p.size),
        np.zeros(size),
        wide,
        lower,
        upper,
        np.full((p.equations.declared, 2), np.inf),
    )


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
    low = np.full(p.size, -np.inf)
    for m, place in p.placed(c):
        if p.candidate(m).effect.name != "constant_force":
            low[place] = 0.0
    expected = by_scipy(one, free, low, np.full(p.size, np.inf))
    # SciPy's method stays inside the bounds and comes within 1e-7 of them; entries of z are of order one.
    np.testing.assert_allclose(within_bounds(p, bounded(p), one).z[free], expected, atol=1e-5)


def by_scipy(one, free, low, high):
    """What of the free entries between these bounds is the nearest, in the estimate's own widths."""
    root = np.linalg.inv(np.linalg.cholesky(one.covariance[np.ix_(free, free)]))
    return lsq_linear(root, root @ one.z[free], (low[free], high[free]), tol=1e-14).x


@pytest.mark.parametrize(("low", "high"), [(0.7, 2.0), (-3.0, -0.5)], ids=["below", "above"])
@pytest.mark.parametrize("seed", [0, 1])
def test_it_stays_where_frequencies_are_looked_for(low, high, seed, known):
    """A frequency that a step has carried beyond its bounds ends at the bound, and all else follows."""
    p, _ = known
    forcing = next(m for m in p.searched if p.candidate(m).effect.name == "periodic_forcing")
    friction = next(m for m in p.searched if p.candidate(m).effect.name == "viscous_damping")
    c = tuple(sorted((forcing, friction)))
    values = {"periodic_forcing": [0.3, -0.2, 0.1], "viscous_damping": -0.1}
    one, free = estimated(p, c, values, seed)
    place = dict(p.placed(c))
    bottom, top = np.full(p.size, -np.inf), np.full(p.size, np.inf)
    bottom[place[friction]], bottom[place[forcing].stop - 1], top[place[forcing].stop - 1] = 0.0, low, high
    expected = by_scipy(one, free, bottom, top)
    found = within_bounds(p, bounded(p, forcing, low, high), one).z
    assert found[place[forcing].stop - 1] == (low if low > 0 else high)
    np.testing.assert_allclose(found[free], expected, atol=1e-5)  # as above


def test_what_is_allowed_stays(known):
    """Where no friction drives nothing is changed, the estimate itself is returned."""
    p, c = known
    one, _ = estimated(p, c, dict(zip(LAWS, (0.3, -1.0, 0.1), strict=True)), 0)
    assert within_bounds(p, bounded(p), one) is one
