"""Paths under a white missing force: on a linear oscillator, one dense Gaussian that everything is read from."""

from dataclasses import replace

import engine_cases as cases
import numpy as np
import pytest
from scipy.linalg import expm
from scipy.optimize import minimize_scalar
from scipy.stats import multivariate_normal, norm, t

from symplearn.diagnosis._calibrate import calibrate, residuals, weights
from symplearn.diagnosis._magnitude import strength_gain
from symplearn.diagnosis._noisy import PathFit, fit_paths
from symplearn.diagnosis._scan import on_path, scan
from symplearn.diagnosis._score import Unit
from symplearn.diagnosis._start import priors_without_effects
from symplearn.diagnosis._trajectory import Stepper
from symplearn.diagnosis._weighed import weigh_white

MASS, STIFFNESS, NOISE = 2.0, 3.0, 0.05
X0_MEAN, X0_SD = np.array([0.9, 0.1]), np.array([0.3, 0.5])
PULL_MEAN, PULL_SD = 0.2, 0.4
SCALE = 0.25  # prior sd of every effect
N, SHORT = 25, 18  # rows of the two runs
ROWS = [N, SHORT]
# Where both initial states, f, the force and the bias stand among the unknowns, and q and p in a phase point; the
# others are an oscillator that nothing asks for.
UNKNOWN, STATE = np.array([0, 2, 4, 6, 8, 9, 10]), np.array([0, 2])
INTENSITY = 0.02

FILE = f"""
[parameters]
k = {STIFFNESS}
f = {{ value = {PULL_MEAN}, sd = {PULL_SD} }}

[initial]
q = {{ value = {X0_MEAN[0]}, sd = {X0_SD[0]} }}
p = {{ value = {X0_MEAN[1]}, sd = {X0_SD[1]} }}

[recording.noise]
y = {NOISE}
"""


def made(seed, number=N):
    """Irregular times, some readings missing, of a motion that a force unknown to anyone disturbs."""
    rng = np.random.default_rng(seed)
    times = np.cumsum(rng.uniform(0.15, 0.25, number))
    rates = lambda t, x: [x[1] / MASS, -STIFFNESS * x[0] + 0.3 + 0.2 * np.sin(3.1 * t + seed)]  # noqa: E731
    readings = cases.solved(rates, [1.0, 0.0], times)[:, 0] + 0.1 + NOISE * rng.normal(size=number)
    readings[[4, 5, 11]] = np.nan
    return cases.recorded(times, readings)


@pytest.fixture(scope="module")
def stepper():
    file = cases.simulation(f"p**2/(2*{MASS}) + k*q**2/2 - f*q", more=FILE)
    # Suzuki's method at a thirtieth of the period over 2 pi is exact to 1e-8 over these times.
    return Stepper(cases.problem(file, [made(0), made(1, SHORT)], 0.02))


@pytest.fixture(scope="module")
def priors(stepper):
    return replace(priors_without_effects(stepper.problem), scales=np.full(stepper.problem.equations.size, SCALE))


def place(problem, effect):
    return next(i for i, c in enumerate(problem.equations.candidates) if c.effect.name == effect)


def effects(problem):
    """A force and a bias: both linear, so that nothing is approximated."""
    return (place(problem, "constant_force"), place(problem, "sensor_bias"))


class Dense:
    """Everything by one Gaussian over [x_0 of both runs, f, constant force, bias, all white forces]; `acting` says in
    which share of each span, by run, they act."""

    def __init__(self, problem, intensity, named, noise=NOISE, acting=None):
        runs, unknowns = problem.rows, 2 * len(problem.rows) + (3 if named else 1)
        columns = unknowns + sum(2 * (len(r.times) - 1) for r in runs)
        mean, variance = np.zeros(columns), np.zeros((columns, columns))
        mean[:4], mean[4] = np.tile(X0_MEAN, 2), PULL_MEAN
        variance[range(4), range(4)] = np.tile(X0_SD**2, 2)
        variance[4, 4] = PULL_SD**2
        if named:
            variance[5, 5] = variance[6, 6] = SCALE**2
        first, rows, states, ys = unknowns, [], [], []
        for r, run in enumerate(runs):
            x = np.zeros((2, columns))
            x[:, 2 * r : 2 * r + 2] = np.eye(2)
            for k, y in enumerate(run.readings[:, 0]):
                states.append(x)
                if not np.isnan(y):
                    row = x[0].copy()
                    row[6 : 7 if named else 6] += 1.0
                    rows.append(row)
                    ys.append(y)
                if k + 1 < len(run.times):
                    gap = run.times[k + 1] - run.times[k]
                    A, b = _flow(gap)
                    x = A @ x
                    x[:, 4] += b
                    if named:
                        x[:, 5] += b
                    x[:, first : first + 2] = np.eye(2)
                    here = intensity * (1.0 if acting is None else acting[r][k])
                    variance[first : first + 2, first : first + 2] = _simpson(A, here, gap)
                    first += 2
        H, states = np.array(rows), np.array(states)
        S = H @ variance @ H.T + noise**2 * np.eye(len(ys))
        self.log_evidence = multivariate_normal.logpdf(ys, H @ mean, S)
        gain = variance @ H.T @ np.linalg.inv(S)
        self.mean = mean + gain @ (ys - H @ mean)
        self.covariance = variance - gain @ H @ variance
        forced = H[:, unknowns:] @ variance[unknowns:, unknowns:] @ H[:, unknowns:].T + noise**2 * np.eye(len(ys))
        held, prior = variance[:unknowns, :unknowns], self.mean[:unknowns] - mean[:unknowns]
        self.profile_likelihood = multivariate_normal.logpdf(
            ys, H[:, :unknowns] @ self.mean[:unknowns], forced
        ) + multivariate_normal.logpdf(prior, cov=held)
        self.paths = np.split(states @ self.mean, [len(runs[0].times)])


def _flow(gap):
    """x' = M x + (0, 1) f over a gap, exactly: the matrix exponential of the enlarged system."""
    M = np.array([[0, 1 / MASS, 0], [-STIFFNESS, 0, 1], [0, 0, 0]])
    whole = expm(M * gap)
    return whole[:2, :2], whole[:2, 2]


def _simpson(A, intensity, gap):
    """The integral of F e e' F' intensity over the gap by Simpson, with F = A, (1 + A) / 2 and 1."""
    e = np.array([0.0, 1.0])
    ends = [A @ e, 0.5 * (e + A @ e), e]
    return gap / 6 * intensity * sum(w * np.outer(x, x) for w, x in zip((1, 4, 1), ends, strict=True))


def start(problem, intensity, combination, seed=0):
    """A path that is wrong everywhere, to start from."""
    rng = np.random.default_rng(seed)
    z = np.zeros(problem.size)
    z[UNKNOWN[:5]] = [0.8, 0.3, 0.7, -0.2, -0.1]
    paths = [np.zeros((n, problem.state)) for n in ROWS]
    for r, path in enumerate(paths):
        path[:, STATE] = rng.normal(size=(len(path), 2))
        path[0] = z[problem.local(r)[: problem.state]]
    return PathFit(combination, np.array([intensity]), z, np.array([NOISE]), paths)


@pytest.fixture(scope="module")
def fits(stepper, priors):
    """Two intensities, without and with effects, side by side."""
    p = stepper.problem
    starts = [start(p, q, c) for q in (INTENSITY, 1.0) for c in ((), effects(p))]
    return fit_paths(stepper, starts, priors, ROWS)


LANES = pytest.mark.parametrize(
    ("lane", "intensity", "named"), [(0, INTENSITY, False), (1, INTENSITY, True), (2, 1.0, False), (3, 1.0, True)]
)


@LANES
def test_the_log_evidence_is_the_dense_marginal_likelihood(stepper, fits, lane, intensity, named):
    """Readings of two runs, priors of states, parameter and effects included, missing readings left out."""
    expected = Dense(stepper.problem, intensity, named).log_evidence
    # The composed leapfrog is off by 1e-8 a step, a thousandth of a nat at the very most.
    np.testing.assert_allclose(fits[lane].log_evidence, expected, atol=1e-4)
    assert fits[lane].converged


@LANES
def test_unknowns_and_their_covariance_are_the_dense_posterior(stepper, fits, lane, intensity, named):
    """Initial states, parameter and effects, and how well they are known, equal Gaussian conditioning."""
    dense, n = Dense(stepper.problem, intensity, named), 7 if named else 5
    where = UNKNOWN[:n]
    np.testing.assert_allclose(fits[lane].z[where], dense.mean[:n], atol=1e-5)
    np.testing.assert_allclose(fits[lane].laplace.covariance[np.ix_(where, where)], dense.covariance[:n, :n], atol=1e-6)


@LANES
def test_the_path_is_the_dense_smoothers(stepper, fits, lane, intensity, named):
    """The most probable path equals the mean of every phase point given all readings, even across missing ones."""
    dense = Dense(stepper.problem, intensity, named)
    for found, expected in zip(fits[lane].paths, dense.paths, strict=True):
        np.testing.assert_allclose(found[:, STATE], expected, atol=1e-5)


def test_a_force_that_acts_for_a_while_is_dense_too(stepper, priors):
    """A force in a few spans of the second run: evidence, unknowns and path equal one Gaussian's."""
    p = stepper.problem
    acting = (np.zeros(N), np.zeros(SHORT))
    acting[1][6:10], acting[1][10] = 1.0, 0.5
    begin = replace(start(p, 1.0, effects(p)), exposures=acting)
    (found,) = fit_paths(stepper, [begin], priors, ROWS)
    dense = Dense(p, 1.0, True, acting=acting)
    # Off by 3e-8 nats, and by 3e-9 in every number: the composed leapfrog's error of 1e-8 a step.
    np.testing.assert_allclose(found.log_evidence, dense.log_evidence, atol=1e-6)
    np.testing.assert_allclose(found.z[UNKNOWN], dense.mean[:7], atol=1e-7)
    for path, expected in zip(found.paths, dense.paths, strict=True):
        np.testing.assert_allclose(path[:, STATE], expected, atol=1e-7)
    # That it acts there and nowhere else matters: the same force always at work is 6.7 nats away.
    assert abs(dense.log_evidence - Dense(p, 1.0, True).log_evidence) > 1.0


def errors_of(problem, fits):
    """Errors of the readings there are, by their noise, recordings end to end."""
    weight = weights(problem, ROWS)
    left = residuals(problem, fits.predictions, weight)
    return np.concatenate([x[:, w > 0] for x, w in zip(left, weight, strict=True)], 1) / NOISE


def gaussian(problem, fits, priors):
    """Log evidences of `weigh_white` without what it grants a sensor whose noise may have heavier tails, and effects
    of unknown strength."""
    e = errors_of(problem, fits)
    # Student's t of five degrees of freedom and variance one, beside the Gaussian, each half likely.
    gain = (t.logpdf(e, 5, scale=np.sqrt(3 / 5)) - norm.logpdf(e)).sum(1)
    return [
        one.log_evidence
        - np.logaddexp(0.0, g)
        + np.log(2.0)
        - strength_gain(problem, one.combination, priors, one.z, one.covariance)
        for one, g in zip(weigh_white(problem, fits, priors, ROWS), gain, strict=True)
    ]


def test_without_a_force_it_is_the_trajectory_fit(stepper, priors):
    """As the intensity goes to zero, evidence, unknowns, covariance and innovations tend to those of the trajectory
    fit."""
    p = stepper.problem
    combinations = [(), effects(p)]
    begin = np.stack([start(p, 0.0, c).z for c in combinations])
    trajectories = calibrate(stepper, begin, combinations, priors, ROWS, tolerance=1e-10)
    white = weigh_white(p, trajectories, priors, ROWS)
    quiet = fit_paths(stepper, [start(p, 1e-14, c) for c in combinations], priors, ROWS)
    for errors, found in zip(errors_of(p, trajectories), quiet, strict=True):
        np.testing.assert_allclose(found.errors[~np.isnan(found.errors)], errors, atol=1e-5)
    for expected, value, found in zip(white, gaussian(p, trajectories, priors), quiet, strict=True):
        # What the force adds to the readings' variance is 1e-14 times some time cubed, over 2.5e-3.
        np.testing.assert_allclose(found.log_evidence, value, atol=1e-6)
        np.testing.assert_allclose(found.z, expected.z, atol=1e-6)
        np.testing.assert_allclose(found.laplace.covariance, expected.covariance, atol=1e-7)


def test_the_trajectory_fits_evidence_is_the_dense_one(stepper, priors):
    """`weigh_white` is the dense marginal likelihood without any process noise, but for the law of the noise."""
    p = stepper.problem
    combinations = [(), effects(p)]
    begin = np.stack([start(p, 0.0, c).z for c in combinations])
    fits = calibrate(stepper, begin, combinations, priors, ROWS, tolerance=1e-10)
    for value, named in zip(gaussian(p, fits, priors), (False, True), strict=True):
        np.testing.assert_allclose(value, Dense(p, 0.0, named).log_evidence, atol=1e-4)


def test_a_nonlinear_path_is_a_fixed_point(stepper, priors):
    """With viscous damping, which multiplies the state, the fit still settles, and settles at one place."""
    p = stepper.problem
    chosen = (place(p, "viscous_damping"),)
    one, other = fit_paths(stepper, [start(p, INTENSITY, chosen, s) for s in (1, 2)], priors, ROWS, 20)
    assert one.converged and other.converged
    # Evidence settles to 0.02; what is left of a Gauss-Newton step is its square.
    np.testing.assert_allclose(one.log_evidence, other.log_evidence, atol=0.02)
    np.testing.assert_allclose(one.z, other.z, atol=0.01)


def test_a_path_begins_where_its_unknowns_say(stepper, priors, fits):
    """A path that comes from another fit, and begins elsewhere than z does, ends at the same answer all the same."""
    p = stepper.problem
    one = start(p, INTENSITY, ())
    elsewhere = replace(one, z=fits[0].z + 0.1 * p.active(()), paths=[path + 0.3 for path in one.paths])
    (found,) = fit_paths(stepper, [elsewhere], priors, ROWS)
    np.testing.assert_allclose(found.z, fits[0].z, atol=1e-5)
    np.testing.assert_allclose(found.log_evidence, fits[0].log_evidence, atol=1e-4)
    for r, path in enumerate(found.paths):
        np.testing.assert_allclose(path[0], found.z[p.local(r)[: p.state]], atol=1e-12)


def test_a_scan_of_a_path_predicts_what_its_refit_gains(stepper, priors, fits):
    """About a path under a missing force, one linear effect more gains exactly what fitting it gains, and the mean
    square of its strength: it is of one order of magnitude, and the recording hardly shows it."""
    p = stepper.problem
    chosen = effects(p)
    refits = fit_paths(stepper, [start(p, INTENSITY, (m,)) for m in chosen], priors, ROWS)
    found = scan(p, on_path(stepper, fits[0], ROWS), fits[0].z, (), priors, [Unit(m, None) for m in chosen])
    gains = {s.combination: s.gain for s in found}
    for one in refits:
        (_, place), scale = p.placed(one.combination)[0], priors.scales[p.candidate(one.combination[0]).first]
        square = (one.z[place] ** 2 + np.diag(one.laplace.covariance)[place]) / scale**2
        expected = one.log_evidence - fits[0].log_evidence + np.log(square.mean())
        # Both are off by what is left of a step, the square of what settles to 0.05 nats.
        assert gains[one.combination] == pytest.approx(expected, abs=2e-4)


def test_an_unknown_noise_is_the_likeliest(stepper, priors):
    """A noise that the file does not give becomes that of the largest dense likelihood, unknowns at their best."""
    p = replace(stepper.problem, noise=np.array([np.nan]))
    first = replace(start(p, INTENSITY, ()), noise=np.array([0.2]))
    (found,) = fit_paths(stepper.on(p), [first], priors, ROWS, 40)
    best = minimize_scalar(
        lambda log: -Dense(p, INTENSITY, False, np.exp(log)).profile_likelihood,
        bounds=(np.log(0.01), np.log(0.2)), method="bounded", options={"xatol": 0.01},
    )  # fmt: skip
    # The fit settles to 0.05 nats, some 4 % of the noise of 37 readings.
    np.testing.assert_allclose(found.noise[0], np.exp(best.x), rtol=0.06)
