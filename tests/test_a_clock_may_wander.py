"""Errors of the clock are integrated out exactly, and while a phase wanders the amplitudes still tell laws apart."""

import itertools
from dataclasses import replace

import engine_cases as cases
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import solve_triangular
from test_coloured_errors_are_whitened import autocovariance, irregular_times

from symplearn.diagnosis._calibrate import calibrate
from symplearn.diagnosis._clock import weigh_clock
from symplearn.diagnosis._clock_errors import Piece, _on_grid, cleared
from symplearn.diagnosis._coloured import Colour, filled
from symplearn.diagnosis._found import Found
from symplearn.diagnosis._start import priors_without_effects
from symplearn.diagnosis._trajectory import Stepper
from symplearn.diagnosis._weighed import weigh_coloured, weigh_white

NOISE, TIMES = 0.002, np.linspace(0.0, 50.0, 400)
BOTH = (Colour(40.0, 2.0, 1.001, 0.0), Colour(300.0, 0.5, 30.0, 0.0))


def problem(readings, spans=((0, 400),)):
    """A spring without losses, its stiffness calibrated."""
    more = "[parameters]\nk = { value = 1.0, sd = 0.1 }\n"
    recordings = [cases.recorded(TIMES[a:b], readings[a:b]) for a, b in spans]
    return cases.problem(cases.simulation("p**2/2 + k*q**2/2", more=more), recordings, 0.05)


def test_sensor_and_clock_are_integrated_out_together():
    """Gram matrix and determinant of irregular rows, a quarter of them missing, are those of the dense Gaussian process
    whose covariance is the sensor's plus the clock's, scaled by the rates on both sides."""
    p, rng, times = problem(np.cos(TIMES)), np.random.default_rng(1), irregular_times()
    weight, rates = rng.uniform(0.5, 20.0, len(times)), rng.normal(size=len(times))
    weight[::4] = 0.0
    columns = rng.normal(size=(1 + len(p.local(0)), len(times)))
    series, log = cleared(Piece(columns, rates, weight, times), BOTH)
    seen, lags = weight > 0, times[:, None] - times
    sensor, clock = (one.ratio * autocovariance(lags, one.frequency, one.damping) for one in BOTH)
    S = (sensor + np.outer(rates, rates) * clock)[np.ix_(seen, seen)] + np.diag(1 / weight[seen])
    expected = columns[:, seen] @ np.linalg.solve(S, columns[:, seen].T)
    # Covariances of condition up to 1e5 cost the dense solution five of sixteen digits, here and in the determinant.
    np.testing.assert_allclose(series.T @ series, expected, rtol=1e-8, atol=1e-8 * np.abs(expected).max())
    assert log == pytest.approx(np.linalg.slogdet(S)[1], rel=1e-8)


def test_many_errors_at_once_are_each_the_cholesky_factors():
    """A column's whitened innovations beside three pairs of errors are the dense covariance's Cholesky factor solved,
    and the logs are its determinant's; a quarter of the irregular rows is missing."""
    rng, times = np.random.default_rng(3), irregular_times()
    weight, rates, y = rng.uniform(0.5, 20.0, len(times)), rng.normal(size=len(times)), rng.normal(size=len(times))
    weight[::4] = 0.0
    other = (Colour(2.0, 0.7, 30.0, 0.0), Colour(5.0, 3.0, 0.3, 0.0))
    pairs = [BOTH, other, (Colour(0.0, 1.0, 1.001, 0.0), BOTH[1])]
    shapes = np.array([[(one.ratio, one.frequency, one.damping) for one in pair] for pair in pairs])
    piece = Piece(y[None], rates, weight, times)
    found, logs = _on_grid(filled(y), *piece.rows, tuple(jnp.asarray(part) for part in np.moveaxis(shapes, 2, 0)))
    seen, lags = weight > 0, times[:, None] - times
    for pair, ours, log in zip(pairs, np.asarray(found), np.asarray(logs), strict=True):
        sensor, clock = (one.ratio * autocovariance(lags, one.frequency, one.damping) for one in pair)
        S = (sensor + np.outer(rates, rates) * clock)[np.ix_(seen, seen)] + np.diag(1 / weight[seen])
        root = np.linalg.cholesky(S)
        expected = solve_triangular(root, y[seen], lower=True)
        # Covariances of condition up to 1e5 cost the dense factor five of sixteen digits, here and in the determinant.
        np.testing.assert_allclose(ours[: len(times)][seen], expected, rtol=1e-8, atol=1e-8 * np.abs(expected).max())
        assert log == pytest.approx(2 * np.log(np.diag(root)).sum(), rel=1e-8)


def late(seed):
    """Lateness of each row (row,): Ornstein-Uhlenbeck's process of sd 0.02 and memory 3, a hundredth of a cycle."""
    rng, keep = np.random.default_rng(seed), np.exp(-(TIMES[1] - TIMES[0]) / 3)
    x = [rng.normal()]
    for e in rng.normal(size=len(TIMES) - 1):
        x.append(keep * x[-1] + np.sqrt(1 - keep**2) * e)
    return 0.02 * np.array(x)


def swing(delay, seed=2):
    """A spring with quadratic drag, read late: SciPy's."""
    rates = lambda t, x: [x[1], -x[0] - 0.03 * abs(x[1]) * x[1]]  # noqa: E731
    q = cases.solved(rates, [1.0, 0.0], np.append(-1.0, TIMES + delay))[1:, 0]
    return q + NOISE * np.random.default_rng(seed).normal(size=len(q))


def weighed(delay, cuts=(0, 400)):
    """Drag, which is true, and a viscous damping, under noise alone, an error of the sensor, and one of its clock; the
    rows from one cut to the next are a recording."""
    q, spans = swing(delay), list(itertools.pairwise(cuts))
    p = problem(q, spans)
    priors = replace(priors_without_effects(p), scales=np.full(p.equations.size, 0.3), precision=np.full(p.size, 1e-2))
    names = [p.candidate(m).effect.name for m in p.searched]
    laws = [(p.searched[names.index(name)],) for name in ("quadratic_drag", "viscous_damping")]
    begin = np.zeros((2, p.size))
    begin[:, p.head], begin[:, p.slots] = 1.0, 0.01
    for k, (a, _) in enumerate(spans):
        begin[:, p.local(k)[:2]] = q[a], (q[a + 1] - q[a]) / (TIMES[1] - TIMES[0])
    rows = [b - a for a, b in spans]
    fits = calibrate(Stepper(p), begin, laws, priors, rows)
    assert fits.converged.all()
    coloured, found = weigh_coloured(p, fits, priors, rows), Found(p, priors)
    clock = weigh_clock(p, fits, priors, rows, [one.colours for one in coloured])
    for one in (*weigh_white(p, fits, priors, rows), *coloured, *clock):
        found.add(one)
    return found, laws


def test_amplitudes_tell_laws_apart_beside_a_wandering_clock():
    """Where rows are read up to a hundredth of a cycle too early or too late, the clock is the likeliest remainder, and
    under it the true law is ahead of another by more than under an error of the sensor that remembers itself."""
    found, laws = weighed(late(0))
    values = {kind: [found.of(law, kind).log_evidence for law in laws] for kind in ("white", "coloured", "clock")}
    assert values["clock"][0] > values["coloured"][0] + 20 > values["white"][0] + 20
    (drag, viscous), (other, worse) = values["clock"], values["coloured"]
    assert drag - viscous > other - worse + 10
    # It names the law; a run goes on from what does not excuse the phase.
    clock = found.of(laws[0], "clock")
    assert found.shown(laws[0], clock) is found.of(laws[0], "coloured")
    assert found.told(laws[0], clock) is clock
    # One that did not converge runs nowhere, whatever its evidence.
    lost = replace(found.of(laws[0], "coloured"), converged=False)
    found.estimates[laws[0]] = [lost if one.kind == "coloured" else one for one in found.estimates[laws[0]]]
    assert found.shown(laws[0], clock) is found.of(laws[0], "white")


def test_recordings_of_unequal_length_have_a_clock_each():
    """So they do where the rows are two recordings, a short one and a long one."""
    found, laws = weighed(late(0), (0, 150, 400))
    drag, viscous = (found.of(law, "clock").log_evidence for law in laws)
    assert drag > found.of(laws[0], "coloured").log_evidence + 20 and drag > viscous + 10


def test_a_clock_that_keeps_time_explains_nothing():
    """No evidence is gained where rows are read when they say."""
    found, (drag, _) = weighed(np.zeros(len(TIMES)))
    assert found.of(drag, "clock").log_evidence < found.of(drag, "white").log_evidence + 1.0


def test_a_camera_reads_its_rows_one_after_the_other_besides():
    """Where a reading is the later the farther out it is, on top of a wandering clock, that error is found for what it
    is, and the true law stays far ahead; the clock alone would leave it."""
    q = swing(np.zeros(len(TIMES)))
    later = 0.05 * q
    found, laws = weighed(late(0) + later)
    (drag, viscous), (coloured, _) = ([found.of(law, kind) for law in laws] for kind in ("clock", "coloured"))
    assert drag.log_evidence > viscous.log_evidence + 10
    assert drag.log_evidence > coloured.log_evidence + 20
    shift, speeds = drag.bends[0](q, TIMES), np.gradient(q, TIMES)
    # To first order it is the lateness times the speed; the clock, which is as free, takes a part (seen: 0.35 is left).
    expected = later * speeds
    assert np.sqrt(np.mean((shift - expected) ** 2)) < 0.5 * np.sqrt(np.mean(expected**2))
    assert drag.reading_noise[0] > 3 * drag.noise[0]
