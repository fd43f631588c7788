"""A value that the readings would have beyond its bound is said to be there, and all else follows what is moved to a
bound; a column that never changes is said to."""

import engine_cases as cases
import numpy as np
import pytest

from symplearn.diagnosis._forecast import _within
from symplearn.diagnosis._warnings import at_bounds, stuck
from symplearn.diagnosis._weighed import Estimate

TIMES = np.linspace(0.0, 10.0, 60)
SWING = cases.recorded(TIMES, np.cos(2 * TIMES))


def bounded(lower):
    file = cases.simulation(
        "p**2/2 + k*q**2/2", more=f"[parameters]\nk = {{ value = 4.3, lower = {lower}, upper = 6.0 }}"
    )
    return cases.problem(file, [SWING], 0.05)


@pytest.mark.parametrize(("value", "said"), [(4.2, "4.2"), (4.1, "4.2"), (4.21, ""), (5.0, ""), (6.0, "6"), (6.5, "6")])
def test_a_value_at_its_bound_or_beyond_is_said(value, said):
    """Within a hundredth of its standard deviation of 0.1, or where a step has led beyond; the bound is named."""
    p = bounded(4.2)
    z = np.zeros(p.size)
    z[p.head] = value
    one = Estimate((), "white", z, np.diag(np.where(p.active(()), 0.01, 0.0)), np.ones(1), 0.0, True)
    told = at_bounds(p, one)
    assert [f"k is at its bound, {said}:" in sentence for sentence in told] == ([True] if said else [])


def test_nothing_is_no_bound_to_be_told():
    """A friction that is not there stands at zero, where it may."""
    p = bounded(0.0)
    one = Estimate((), "white", np.zeros(p.size), np.diag(np.where(p.active(()), 0.01, 0.0)), np.ones(1), 0.0, True)
    assert at_bounds(p, one) == []


def test_what_follows_a_value_follows_it_to_its_bound():
    """Draws of a Gaussian moved to the bound of one value lie where that Gaussian has its mean, given the value: by
    the formula of conditional means; draws within the bounds stay."""
    p = bounded(4.2)
    rng = np.random.default_rng(1)
    size = p.state + p.calibrated.size
    root = rng.normal(size=(size, size))
    spread, mean, k = root @ root.T, np.full(size, 4.0), p.state
    draws = mean + rng.normal(size=(50, size)) @ root.T
    found = _within(p, draws, root)
    held = np.clip(draws[:, k], 4.2, 6.0)
    assert 0 < (held == draws[:, k]).sum() < 50
    # The part of everything that does not go with k is as it was drawn.
    expected = draws + (held - draws[:, k])[:, None] * spread[k] / spread[k, k]
    np.testing.assert_allclose(found, expected, atol=1e-12 * np.abs(expected).max())


def test_a_column_that_never_changes_is_said():
    """Beside one that does, and only there; cells that are empty do not count."""
    y = np.stack([np.cos(TIMES), np.full(60, 0.37)], axis=1)
    y[3:9, 1] = np.nan
    (told,) = stuck([cases.recorded(TIMES, y, columns=("x", "v"))])
    assert told.startswith("v reads 0.37 in every row")
    assert stuck([SWING]) == []
    y[40, 1] = 0.38
    assert stuck([cases.recorded(TIMES, y, columns=("x", "v"))]) == []
