"""Rough sizes of noise and of errors are the same whatever order recordings come in, and whatever is held out."""

from dataclasses import replace

import engine_cases as cases
import numpy as np
import pytest

from symplearn.diagnosis._missed import rough_noise
from symplearn.diagnosis._weighed import largest

TIMES = np.linspace(0.0, 10.0, 201)
SWING = np.stack([np.cos(TIMES), -np.sin(TIMES)], axis=1)


def problem(readings, counts, holdout=0.0):
    """Recordings of a swing's two columns, each row an average of so many readings where there is one."""
    file = cases.simulation("p**2/2 + q**2/2", observe={"a": "q", "b": "p"})
    runs = [cases.recorded(TIMES, y, number=k + 1, columns=("a", "b")) for k, y in enumerate(readings)]
    p = cases.problem(file, runs, 0.05, holdout)
    return replace(p, rows=tuple(replace(r, counts=counts * r.counts) for r in p.rows))


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_the_rough_noise_is_that_of_the_rows_that_are_read(order):
    """Averages of 25 readings of noise 0.05, of which one recording lacks a column."""
    rng = np.random.default_rng(3)
    readings = [SWING + 0.01 * rng.normal(size=SWING.shape) for _ in range(2)]
    readings[1][:, 1] = np.nan
    p = problem([readings[k] for k in order], 25.0)
    # Of two hundred third differences, neighbours of which have three readings in common: known to a fifth.
    np.testing.assert_allclose(rough_noise(p, [len(TIMES)] * 2), 0.05, rtol=0.3)


def test_what_is_held_out_bounds_no_error():
    """Rows that no fit sees, fifty times as large, leave what an error of the sensor may be as it is."""
    p, wild = problem([SWING], 1.0, 0.25), SWING.copy()
    wild[p.rows[0].fitted :] *= 50.0
    other = problem([wild], 1.0, 0.25)
    assert largest(other, 0) == largest(p, 0) == pytest.approx(0.3 * np.std(SWING[: p.rows[0].fitted, 0]))
