"""Calibration is nonlinear least squares with priors: the same answer as SciPy's, on SciPy's own trajectories."""

from dataclasses import replace

import engine_cases as cases
import numpy as np
import pytest
from scipy.optimize import least_squares

from symplearn.diagnosis._calibrate import calibrate, estimate_noise, grow, normal_equations, residuals, weights
from symplearn.diagnosis._start import priors_without_effects
from symplearn.diagnosis._trajectory import Stepper

NOISE = 0.02
PRIOR = {"g": (9.0, 1.0), "c": (0.1, 0.2), "start": (0.9, 0.5)}
MASS, LENGTH = 0.5, 0.8
# Where both initial states, g and c stand among the unknowns; the others are two oscillators that nothing asks for.
SEEN = np.array([0, 2, 4, 6, 8, 9])

PENDULUM = f"""
[parameters]
m = {MASS}
l = {LENGTH}
g = {{ value = 9.0, sd = 1.0, lower = 7.0, upper = 20.0 }}

[initial]
theta = {{ value = 0.9, sd = 0.5 }}

[recording.noise]
angle = {NOISE}

[[terms]]
effect = "viscous_damping"
target = "theta"
c = {{ value = 0.1, sd = 0.2 }}
"""


def rates(g, c):
    """The damped pendulum by hand; F = -c v with v the rate of the angle."""
    inertia = MASS * LENGTH**2
    return lambda t, x: [x[1] / inertia, -MASS * g * LENGTH * np.sin(x[0]) - c * x[1] / inertia]


def made(number, span, start, seed):
    """A recording of two channels, the angle and the momentum, with a few readings missing."""
    rng = np.random.default_rng(seed)
    times = np.sort(rng.uniform(0, span, number))
    x = cases.solved(rates(9.81, 0.05), start, times)
    readings = x + rng.normal(size=x.shape) * [NOISE, 0.05]
    readings[rng.random(readings.shape) < 0.15] = np.nan
    return cases.recorded(times, readings, columns=("angle", "momentum"))


@pytest.fixture(scope="module")
def stepper():
    file = cases.simulation(
        "p**2/(2*m*l**2) - m*g*l*cos(theta)", ["theta"], observe={"angle": "theta", "momentum": "p"}, more=PENDULUM
    )
    runs = [made(40, 4.0, [1.0, 0.1], 0), made(30, 3.0, [-0.8, 0.3], 1)]
    return Stepper(cases.problem(file, runs, 0.02))


@pytest.fixture(scope="module")
def fits(stepper):
    """Calibrated without effects, and with a quadratic drag beside the damping."""
    p = stepper.problem
    priors = with_scale(p)
    start = np.tile(priors.mean, (2, 1))
    # Away from the truth by much more than the noise, and momenta, which are not read alone, by their size.
    start[:, SEEN[:4]] = [0.9, 0.0, -0.9, 0.0]
    combinations = [(), (place(p, "quadratic_drag"),)]
    return calibrate(stepper, start, combinations, priors, rows(p), tolerance=1e-9)


def rows(problem):
    return [len(r.times) for r in problem.rows]


def place(problem, effect):
    return next(i for i, c in enumerate(problem.equations.candidates) if c.effect.name == effect)


def with_scale(problem, scale=0.3):
    bare = priors_without_effects(problem)
    return replace(bare, scales=np.full(problem.equations.size, scale))


def scipy_fit(problem, noise):
    """SciPy's least squares over [x_0 of both runs, g, c] on DOP853 trajectories."""

    def errors(z):
        out = [(z[4:] - [PRIOR["g"][0], PRIOR["c"][0]]) / [PRIOR["g"][1], PRIOR["c"][1]]]
        for r, run in enumerate(problem.rows):
            start = z[2 * r : 2 * r + 2]
            out.append((start[:1] - PRIOR["start"][0]) / PRIOR["start"][1])
            error = (run.readings - cases.solved(rates(*z[4:]), start, run.times)) / noise
            out.append(error[~np.isnan(run.readings)])
        return np.concatenate(out)

    return least_squares(errors, [1.0, 0.0, -0.8, 0.2, 9.5, 0.08], x_scale="jac", xtol=1e-12, ftol=1e-12)


def test_the_answer_is_that_of_scipy(stepper, fits):
    """Initial states of two recordings, a shared parameter and a shared term equal SciPy's to 1 % of their sd."""
    solution = scipy_fit(stepper.problem, fits.noise[0])
    sd = np.sqrt(np.diag(np.linalg.inv(solution.jac.T @ solution.jac)))
    assert fits.converged[0]
    # The noise of the second channel is estimated with the rest, so SciPy is given what was found; the trajectories
    # differ by the substep's error, well below 1 % of the noise.
    np.testing.assert_array_less(np.abs(fits.z[0, SEEN] - solution.x), 0.01 * sd)
    np.testing.assert_allclose(fits.cost[0], 2 * solution.cost, rtol=1e-4)


def test_an_unknown_noise_is_the_residuals_root_mean_square(stepper, fits):
    """The given noise is kept; the other is the root of the mean squared residual of what was read."""
    p = stepper.problem
    left = residuals(p, fits.predictions, weights(p, rows(p)))
    seen = np.concatenate([~np.isnan(r.readings[:, 1]) for r in p.rows])
    squares = np.concatenate([x[0, :, 1] for x in left])[seen] ** 2
    assert fits.noise[0, 0] == NOISE
    np.testing.assert_allclose(fits.noise[0, 1], np.sqrt(squares.mean()), rtol=1e-6)


CHOSEN = {
    "size": {"quadratic_drag": [0.2], "cubic_stiffness": [0.03], "sensor_gain": [-0.02]},
    "place": {"periodic_forcing": [0.3, -0.2, 1.9], "parametric_modulation": [0.1, 0.2, 2.3],
              "hidden_oscillator": [0.4, 1.6]},
    "time": {"self_excitation": [0.1, 0.2], "sensor_delay": [0.05], "regime_change": [0.2, 1.1]},
}  # fmt: skip


@pytest.mark.parametrize("values", CHOSEN.values(), ids=CHOSEN)
def test_slopes_are_central_differences(stepper, values):
    """`predict` gives the slopes of the readings in initial state, parameters, terms, and every value of effects."""
    p = stepper.problem
    z, chosen = np.zeros(p.size), tuple(sorted(place(p, effect) for effect in values))
    z[SEEN] = [1.0, 0.1, -0.8, 0.3, 9.5, 0.06]
    for member, where in p.placed(chosen):
        z[where] = values[p.candidate(member).effect.name]
    found = stepper.predict(z[None], [chosen], rows(p))
    step, free = 1e-5, np.nonzero(p.active(chosen))[0]
    shifts = step * np.eye(p.size)[free]
    ends = stepper.predict(np.concatenate([z + shifts, z - shifts]), [chosen] * (2 * len(free)), rows(p))
    for r in range(2):
        difference = (ends[r].readings[: len(free)] - ends[r].readings[len(free) :]) / (2 * step)
        for k, entry in enumerate(p.local(r)):
            expected = difference[free == entry]
            expected = expected[0] if len(expected) else np.zeros_like(found[r].readings[0])
            # Third derivatives times 1e-10 / 6, of readings whose slopes reach some tens; drag bends at v = 0.
            np.testing.assert_allclose(found[r].slopes[0, k], expected, atol=2e-7 * max(1, np.abs(expected).max()))


def test_no_slot_without_an_effect_moves_anything(stepper):
    """The slots of a smaller combination change no reading, whatever they hold."""
    p = stepper.problem
    z = np.zeros(p.size)
    z[SEEN] = [1.0, 0.1, -0.8, 0.3, 9.5, 0.06]
    other = z.copy()
    other[p.slots + 1 :] = np.linspace(-0.7, 0.7, p.size - p.slots - 1)
    one, two = (stepper.predict(a[None], [(0,)], rows(p))[0].readings for a in (z, other))
    np.testing.assert_array_equal(one, two)


def test_missing_readings_are_ignored(stepper, fits):
    """Normal equations are those of the rows that were read alone."""
    p, weight = stepper.problem, weights(stepper.problem, rows(stepper.problem))
    matrix, vector = normal_equations(p, fits, weight)
    expected, right = np.zeros((p.size, p.size)), np.zeros(p.size)
    for r, run in enumerate(p.rows):
        for k, reading in enumerate(run.readings):
            for j in np.nonzero(~np.isnan(reading))[0]:
                row = np.zeros(p.size)
                row[p.local(r)] = fits.predictions[r].slopes[0, :, k, j] / fits.noise[0, j]
                expected += np.outer(row, row)
                right += row * (reading[j] - fits.predictions[r].readings[0, k, j]) / fits.noise[0, j]
    np.testing.assert_allclose(matrix[0], expected, rtol=1e-9, atol=1e-6)
    # Round-off of sums of products of some hundreds.
    np.testing.assert_allclose(vector[0], right, atol=1e-8 * np.abs(right).max() + 1e-7)


def test_one_more_coefficient_fits_better(stepper, fits):
    """With an effect beside it the log posterior is higher, and its slope in the coefficient is zero."""
    p, free, slot = stepper.problem, fits.combinations[1], stepper.problem.slots
    weight = weights(p, rows(p))
    number = sum((w > 0).sum(0) for w in weight)
    # Minus twice the log posterior, with the noise that was estimated.
    value = fits.cost + 2 * (number * np.log(fits.noise)).sum(1)
    assert free and fits.converged[1] and fits.z[0, slot] == 0.0 and value[1] < value[0]
    matrix, vector = normal_equations(p, fits, weight)
    precision = with_scale(p).precision_of(p, free)[slot]
    # What is left of the slope moves the coefficient by less than 1 % of its sd.
    left = vector[1, slot] - precision * fits.z[1, slot]
    assert abs(left) < 0.01 * np.sqrt(matrix[1, slot, slot] + precision)


def test_bounds_are_kept(stepper):
    """A parameter that the readings want below its lower bound ends on it, and the others at their best there."""
    p = stepper.problem
    c = replace(p.calibrated, lower=np.array([11.0, -np.inf]))
    bounded = replace(p, calibrated=c)
    priors = with_scale(bounded)
    start = priors.mean[None].copy()
    start[:, SEEN] = [1.0, 0.1, -0.8, 0.3, 11.5, 0.05]
    found = calibrate(stepper.on(bounded), start, [()], priors, rows(p))
    assert found.z[0, SEEN[4]] == 11.0 and np.isfinite(found.cost[0])


@pytest.mark.parametrize(
    "poor", [[-2.0, 1.0, 2.5, -1.0, 19.0, 0.0], [0.0, 0.0, 0.0, 0.0, 19.9, 1.0]], ids=["wrong side", "at rest"]
)
def test_growing_windows_end_at_the_least_squares(stepper, fits, poor):
    """From states of the wrong sign, or of rest, and a pull twice too strong, the windows end at the same answer."""
    p, priors = stepper.problem, with_scale(stepper.problem)
    start = priors.mean[None].copy()
    start[:, SEEN] = poor
    grown = grow(stepper, start, [()], priors, [[6, 6], [12, 12], [24, 24], rows(p)])
    matrix, _ = normal_equations(p, grown, weights(p, rows(p)))
    sd = np.sqrt(np.diag(np.linalg.inv(matrix[0][np.ix_(SEEN, SEEN)] + np.diag(priors.precision[SEEN]))))
    # The fit ends where a step would gain less than 1e-3 of minus twice the log posterior: a thirtieth of an sd.
    assert grown.converged[0]
    np.testing.assert_array_less(np.abs(grown.z[0, SEEN] - fits.z[0, SEEN]), 0.05 * sd)


def test_noise_of_repeated_readings_is_not_zero(stepper):
    """Residuals of exactly nothing still leave a noise that may be divided by."""
    p = stepper.problem
    weight = weights(p, rows(p))
    nothing = [np.zeros((1, len(w), 2)) for w in weight]
    assert (estimate_noise(p, [()], nothing, weight) > 0).all()
