"""What many recordings say together is inverted in blocks: the same numbers as of the whole matrix."""

import engine_cases as cases
import numpy as np
import pytest

from symplearn.diagnosis import _score, _strength
from symplearn.diagnosis._arrow import Arrow
from symplearn.diagnosis._strength import mixture_gains

COUNT, STATE, COMMON = 9, 4, 3
SIZE = COUNT * STATE + COMMON


def drawn(seed):
    """Information of nine recordings on four unknowns of their own and three in common, of very different sizes."""
    random = np.random.default_rng(seed)
    columns = random.normal(size=(COUNT, 30, STATE + COMMON)) * 10.0 ** random.uniform(-3, 3, STATE + COMMON)
    return columns.swapaxes(1, 2) @ columns


def assembled(grams):
    """The same as one matrix, recording by recording."""
    whole = np.zeros((SIZE, SIZE))
    for k, gram in enumerate(grams):
        place = np.concatenate([np.arange(k * STATE, (k + 1) * STATE), np.arange(COUNT * STATE, SIZE)])
        whole[np.ix_(place, place)] += gram
    return whole


@pytest.mark.parametrize("seed", range(3))
def test_blocks_are_inverted_as_the_whole(seed):
    """Inverse and determinant are NumPy's for the whole matrix with the priors, where some unknowns are known."""
    random = np.random.default_rng([1, seed])
    grams, precision = drawn(seed), 10.0 ** random.uniform(-2, 2, SIZE)
    active = random.random(SIZE) > 0.2
    inverse, log_determinant = Arrow.of(grams, STATE).held(precision, active).inverse()
    expected = np.linalg.inv((assembled(grams) + np.diag(precision))[np.ix_(active, active)])
    scale = np.sqrt(np.diag(expected))
    # In units of each one's error the two differ by 5e-14 at most: round-off of NumPy's inverse, whose matrix has a
    # condition of up to 6e9. A block in the wrong place is an error of order one.
    np.testing.assert_allclose(
        inverse[np.ix_(active, active)] / np.outer(scale, scale), expected / np.outer(scale, scale), atol=1e-10
    )
    # A sum of some thirty logarithms: round-off, 2e-16 here, and what that of the inverse leaves in its determinant.
    assert log_determinant == pytest.approx(np.linalg.slogdet(expected)[1], rel=1e-10)


def test_what_nothing_holds_stays_finite():
    """Of two common unknowns that do the same only the sum is known: each has a wide, finite spread."""
    grams, precision = drawn(0), np.ones(SIZE)
    grams[:, -1] = grams[:, -2]
    grams[:, :, -1] = grams[:, :, -2]
    precision[-2:] = 0.0
    inverse, log_determinant = Arrow.of(grams, STATE).held(precision, np.ones(SIZE, bool)).inverse()
    known = np.linalg.inv(assembled(grams)[:-1, :-1] + np.diag(precision[:-1]))
    assert np.isfinite(inverse).all() and np.isfinite(log_determinant)
    assert min(inverse[-1, -1], inverse[-2, -2]) > 1e6 * known[-1, -1]


def test_what_is_not_finite_is_told():
    """A trajectory that ran away makes all of it NaN."""
    grams = drawn(0)
    grams[2, 1, 1] = np.inf
    inverse, log_determinant = Arrow.of(grams, STATE).held(np.ones(SIZE), np.ones(SIZE, bool)).inverse()
    assert np.isnan(inverse).all() and np.isnan(log_determinant)


@pytest.mark.parametrize("alone", [False, True])
def test_the_strength_of_many_starts_needs_no_inverse(alone, monkeypatch):
    """What an unseen oscillator with forty starts gains for being of any strength is the same in the axes of its
    covariance as by the inverse of every width's matrix."""
    random, a = np.random.default_rng(0), 41
    columns = random.normal(size=(3, a, 2 * a)) * np.linspace(0.2, 3.0, 2 * a)
    spread = np.linalg.inv(columns @ columns.mT + np.eye(a))
    centre = np.einsum("lab,lb->la", spread, 5.0 * random.normal(size=(3, a)))
    lowest, own = np.append(0.0, np.full(a - 1, -np.inf)), np.zeros(a, int)
    found = mixture_gains(centre, spread, own, lowest, alone)
    monkeypatch.setattr(_strength, "_MANY", a)
    # By inverses correlations have 1e-13 added to their diagonal, `_ROUND_OFF`, which may be 1e-11 of gains of some
    # hundred; 4e-14 of them was seen.
    np.testing.assert_allclose(found, mixture_gains(centre, spread, own, lowest, alone), rtol=1e-10)


def test_a_scan_of_many_recordings_is_that_of_the_whole(monkeypatch):
    """What a scan of nine recordings inverts, for two effects at once, is the same in blocks and as a whole, where the
    start of an unseen oscillator is not looked for; so is what the errors push."""
    times = np.linspace(0.0, 1.0, 5)
    rows = [cases.recorded(times, np.sin(times)) for _ in range(COUNT)]
    p = cases.problem(
        cases.simulation("p**2/2 + k*q**2/2", more="[parameters]\nk = { value = 1.0, sd = 0.1 }"), rows, 0.25
    )
    local = 1 + p.state + p.size - p.head
    columns = np.random.default_rng(0).normal(size=(2, COUNT, 40, local + 2))
    lanes, active = [list(lane) for lane in columns.swapaxes(2, 3) @ columns], p.active(())
    precision = np.random.default_rng(1).uniform(0.1, 10.0, p.size)
    blocks = _score._inverted(p, lanes, precision, active)
    monkeypatch.setattr(_score, "MANY", COUNT + 1)
    # Round-off of two ways to invert a matrix whose columns are alike in size: 6e-17 was seen of its inverse, 1e-14 of
    # its determinant's logarithm; entries that are zero are so to 1e-12.
    for one, other in zip(blocks, _score._inverted(p, lanes, precision, active), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-12)
