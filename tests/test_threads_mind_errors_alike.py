"""Work on threads minds floating-point errors as its caller does."""

import numpy as np
import pytest

from symplearn.diagnosis._lanes import Threads


@pytest.mark.parametrize("jobs", [1, 2])
@pytest.mark.parametrize("way", ["each", "ahead"])
def test_what_is_ignored_here_is_ignored_on_threads(jobs, way):
    """An overflow is no warning on a thread where its caller ignores it, and is an error where the caller says so."""
    large = [np.array([1e300, 2e300])] * 4
    do = getattr(Threads(jobs), way)
    with np.errstate(all="ignore"):
        assert all(np.isinf(one).all() for one in do(np.square, large))
    with np.errstate(over="raise"), pytest.raises(FloatingPointError):
        list(do(np.square, large))
