"""How readings scatter is weighed as its integrals say: heavy tails, a wrongly given noise, outliers."""

import engine_cases as cases
import numpy as np
import pytest
from scipy.integrate import quad
from scipy.optimize import minimize_scalar
from scipy.special import logsumexp
from scipy.stats import norm, t

from symplearn.diagnosis import Options, Restriction, diagnose
from symplearn.diagnosis._scatter import factor_evidence, law_gain, outlier_evidence, suspects

GIVEN = 0.1  # noise of the first column; that of the second is estimated


@pytest.fixture(scope="module")
def problem():
    file = cases.simulation("p**2/2 + q**2/2", observe={"a": "q", "b": "p"}, more=f"[recording.noise]\na = {GIVEN}")
    return cases.problem(file, [cases.recorded(np.arange(10.0), np.ones((10, 2)))], 1.0)


def member(problem, effect, column=0):
    return next(m for m in problem.searched
                if problem.candidate(m).effect.name == effect and problem.candidate(m).place == column)  # fmt: skip


def alone(e, column):
    """Errors of one column, the other without readings."""
    out = np.full((len(e), 2), np.nan)
    out[:, column] = e
    return out


DRAWS = {"gaussian": lambda rng, n: rng.normal(size=n), "student": lambda rng, n: rng.standard_t(5, n) * np.sqrt(0.6)}


@pytest.mark.parametrize("draw", DRAWS.values(), ids=DRAWS)
def test_the_law_of_a_given_noise_is_a_mixture_of_two(problem, draw):
    """Beside a noise that is given, Student's t of unit variance and the Gaussian are each half likely."""
    e = draw(np.random.default_rng(0), 200)
    logs = [norm.logpdf(e).sum(), t.logpdf(e, 5, scale=np.sqrt(0.6)).sum()]
    expected = logsumexp(logs) - np.log(2) - logs[0]
    found = law_gain(problem, (), alone(e, 0))
    assert found == pytest.approx(expected, abs=1e-9)  # round-off of 200 logarithms


@pytest.mark.parametrize("draw", DRAWS.values(), ids=DRAWS)
def test_the_law_of_an_estimated_noise_has_its_own_best_scale(problem, draw):
    """Where the noise is estimated, each law has the scale that is best for it, found here by search."""
    e = draw(np.random.default_rng(1), 200)
    e /= np.sqrt((e**2).mean())  # the Gaussian's best scale, by which errors are standardised
    best = minimize_scalar(lambda s: -t.logpdf(e, 5, scale=np.exp(s)).sum(), bounds=(-2, 1), method="bounded",
                           options={"xatol": 1e-8})  # fmt: skip
    gain = -best.fun - norm.logpdf(e).sum()
    found = law_gain(problem, (), alone(e, 1))
    # Thirty steps of its iteration leave less than 1e-6 of the scale.
    assert found == pytest.approx(np.logaddexp(0.0, gain) - np.log(2), abs=1e-6)


def test_columns_are_weighed_apart_and_no_reading_says_nothing(problem):
    """The gain of two columns is the sum of each one's; a column without readings has none."""
    rng = np.random.default_rng(2)
    both = rng.standard_t(3, size=(100, 2))
    apart = sum(law_gain(problem, (), alone(both[:, j], j)) for j in range(2))
    assert law_gain(problem, (), both) == pytest.approx(apart)
    assert law_gain(problem, (), np.full((5, 2), np.nan)) == 0.0


def test_a_tail_that_is_heavy_is_worth_its_evidence_and_a_light_one_costs_a_bit(problem):
    """Gaussian readings lose at most log 2; readings of Student's t gain many nats."""
    rng = np.random.default_rng(3)
    assert -np.log(2) <= law_gain(problem, (), alone(rng.normal(size=2000), 0)) < 0
    assert law_gain(problem, (), alone(DRAWS["student"](rng, 2000), 0)) > 20


@pytest.mark.parametrize("factor", [0.5, 1.0, 3.0])
def test_a_wrong_noise_owes_what_its_integral_says(problem, factor):
    """Likelihood at the best factor times what it owes is the integral over factors, their logarithm N(0, 1)."""
    r = factor * GIVEN * np.random.default_rng(4).normal(size=120)
    best = np.sqrt((r**2).mean())
    top = norm.logpdf(r, scale=best).sum()
    integral = quad(lambda s: np.exp(norm.logpdf(r, scale=GIVEN * np.exp(s)).sum() - top + norm.logpdf(s)),
                    np.log(best / GIVEN) - 1, np.log(best / GIVEN) + 1, epsabs=0, epsrel=1e-10)[0]  # fmt: skip
    chosen = (member(problem, "sensor_noise"),)
    found = factor_evidence(problem, chosen, np.array([best, 1.0]), np.array([120, 50]))
    # Laplace's error is of order 1 / readings.
    assert found == pytest.approx(np.log(integral), abs=0.02)
    assert factor_evidence(problem, (), np.array([best, 1.0]), np.array([120, 50])) == 0.0


def contaminated(seed, number=400, share=0.06, size=12.0):
    """Standardised errors of two columns, some of the first column's off by far more than the noise."""
    rng = np.random.default_rng(seed)
    e = rng.normal(size=(number, 2))
    off = rng.random(number) < share
    e[off, 0] += np.sign(rng.normal(size=off.sum())) * size * (1 + rng.random(off.sum()))
    return e, off


def test_what_lies_far_off_is_suspected():
    """Every outlier of 12 to 24 standard deviations, in its own recording, and nothing else."""
    e, off = contaminated(5)
    parts = suspects([e[:150], e[150:]])
    assert [len(part) for part in parts] == [150, 250]
    found = np.concatenate(parts)
    np.testing.assert_array_equal(found[:, 0], off)
    assert not found[:, 1].any()


quantised = lambda x: 1.6 * np.round(x / 1.6)  # noqa: E731
NOISES = {
    "gaussian": lambda rng, n: rng.normal(size=n),
    "uniform": lambda rng, n: rng.uniform(-np.sqrt(3), np.sqrt(3), n),
    "student": lambda rng, n: np.sqrt(0.6) * rng.standard_t(5, n),
    "quantised": lambda rng, n: quantised(30 * np.sin(np.arange(n)) + rng.normal(size=n)) - 30 * np.sin(np.arange(n)),
}


@pytest.mark.parametrize("noise", NOISES)
def test_a_noise_of_two_scales_is_told_from_any_of_one(noise):
    """Of 30 columns with a few errors drawn with seven times the noise's sd nearly all are suspected, wherever the
    errors come to lie; of 30 without, next to none beyond those that Student's t sends out by itself."""
    rng = np.random.default_rng(7)
    both = [0, 0]
    for _ in range(30):
        e = NOISES[noise](rng, 200)
        off = np.zeros(200)
        off[rng.choice(200, 6, replace=False)] = 7.0 * rng.normal(size=6)
        both = [k + bool(suspects([column[:, None]])[0].any()) for k, column in zip(both, (e, e + off), strict=True)]
    # One of 1000 of Student's errors lies six robust standard deviations off, a fifth of the columns have one.
    assert both[0] <= (12 if noise == "student" else 1) and both[1] >= 27


def test_a_motion_that_is_missed_for_a_while_is_no_outlier():
    """Errors of seven standard deviations that stand in rows are left where they are; single ones beside them are
    suspected if they are more, and so are neighbours where one reading in seven is off."""
    rng = np.random.default_rng(8)
    e = rng.normal(size=(300, 2))
    e[100:106, 0] += 7.0
    single = [20, 40, 60, 80, 150, 200, 250, 280]
    e[single, 0] += 12.0
    off = rng.random(300) < 1 / 7
    e[off, 1] += 15.0 * np.sign(rng.normal(size=off.sum()))
    (found,) = suspects([e])
    assert np.nonzero(found[:, 0])[0].tolist() == single
    assert (off[1:] & off[:-1]).any() and np.array_equal(found[:, 1], off)
    e[106:120, 0] += 7.0
    assert not suspects([e])[0][:, 0].any()


def test_a_noise_that_is_often_wide_has_no_outliers():
    """Where a third of the errors are five times as wide as the others, that is the sensor's own way."""
    rng = np.random.default_rng(9)
    e = rng.normal(size=(2000, 1)) * np.where(rng.random((2000, 1)) < 0.33, 5.0, 1.0)
    assert (np.abs(e) > 9.0).any() and not suspects([e])[0].any()


@pytest.mark.parametrize("seed", range(3))
def test_gaussian_readings_are_not_suspected(seed):
    """None of ten thousand, missing ones among them: six standard deviations are passed once in 5e8."""
    e = np.random.default_rng(seed).normal(size=(10_000, 1))
    e[::7] = np.nan
    assert not suspects([e])[0].any()


def test_what_most_readings_do_is_no_outlier():
    """A share beyond the prior's is the sensor's own way, and nothing of it is taken out."""
    e, _ = contaminated(6, share=0.3)
    assert not suspects([e])[0].any()


def two_scales(e, off):
    """Log likelihood of a noise of two scales over a Gaussian's for the readings that are not suspected, by the share
    and the wider one's standard deviation."""

    plain, likely = norm.logpdf(e), norm.logpdf(e[~off]).sum()

    def log_likelihood(share, size):
        wide = np.log(share) - 0.5 * e**2 / (size**2 + 1) - 0.5 * np.log(2 * np.pi * (size**2 + 1))
        return np.logaddexp(wide, np.log1p(-share) + plain).sum() - likely

    return log_likelihood


@pytest.mark.parametrize("share", [0.03, 0.1])
@pytest.mark.parametrize("more", [0, 4])
def test_outliers_owe_what_their_integral_says(problem, share, more):
    """Their evidence is the integral of a noise of two scales over its share, even below 0.2, and over the size,
    whose logarithm is within 1.5 of the best; readings that are suspected wrongly change nothing of it."""
    e, off = contaminated(7, share=share)
    off[np.argsort(np.where(off, 0.0, np.abs(e[:, 0])))[len(e) - more :]] = True
    log_likelihood = two_scales(e[:, 0], off)
    flagged = np.stack([off, np.zeros_like(off)], 1)
    shares, logs = np.linspace(1e-3, 0.2, 150), np.linspace(-2.0, 3.5, 150)
    values = np.array([[log_likelihood(s, np.exp(x)) for x in logs] for s in shares])
    best = logs[np.unravel_index(np.argmax(values), values.shape)[1]]
    cell = (shares[1] - shares[0]) / 0.2 * (logs[1] - logs[0])
    expected = logsumexp(values + norm.logpdf(logs - best, 0, 1.5)) + np.log(cell)
    found = outlier_evidence((member(problem, "sensor_outliers"),), problem, e, flagged)
    # Laplace's error is of order 1 / outliers, of which there are a dozen at least; which readings are wide is less
    # certain than it takes them for, which costs about as much again.
    assert off.sum() - more >= 10 and found == pytest.approx(expected, abs=0.5)


def test_a_few_far_readings_are_likelier_outliers_than_a_heavy_tail(problem):
    """Of 150 readings four lie 6, 6, 6 and 13 standard deviations off, and four at about 2.5 are suspected with them:
    outliers are three nats likelier than Student's t of 5 degrees of freedom."""
    e = np.random.default_rng(10).normal(size=150)
    far = [10, 50, 90, 130]
    e[far] = [6.0, -6.0, 6.0, 13.0]
    off = np.isin(np.arange(150), far) | (np.abs(e) > np.sort(np.abs(e))[-9])
    flagged = np.stack([off, np.zeros_like(off)], 1)
    found = outlier_evidence((member(problem, "sensor_outliers", 1),), problem, alone(e, 1), flagged[:, ::-1])
    student = t.fit(e, fdf=5, floc=0)
    assert found + norm.logpdf(e[~off]).sum() > t.logpdf(e, *student).sum() + 3


def test_outliers_that_are_not_there_have_no_evidence(problem):
    """Nothing suspected: the effect is impossible, and without the effect nothing is owed."""
    e = np.random.default_rng(8).normal(size=(100, 2))
    none = np.zeros((100, 2), bool)
    assert outlier_evidence((member(problem, "sensor_outliers"),), problem, e, none) == -np.inf
    assert outlier_evidence((), problem, e, none) == 0.0


def test_a_column_with_outliers_has_no_other_heavy_tail(problem):
    """What lies far off is excused once: beside outliers of a column its law gains nothing, the other column's does."""
    both = np.random.default_rng(9).standard_t(3, size=(100, 2))
    for column in range(2):
        found = law_gain(problem, (member(problem, "sensor_outliers", column),), both)
        assert found == law_gain(problem, (), alone(both[:, 1 - column], 1 - column)) > 1


def test_a_noise_that_is_given_too_small_is_no_error_with_a_memory():
    """An oscillator with a damping that is missing, read with a Gaussian noise a quarter larger than what is given as
    known: it is the noise that is told, as an error of the sensor that does not last is nothing else."""
    times = np.linspace(0.0, 30.0, 300)
    x = cases.solved(lambda t, x: [x[1], -x[0] - 0.05 * x[1]], [1.0, 0.0], times)[:, 0]
    readings = x + 0.025 * np.random.default_rng(3).normal(size=300)
    file = cases.simulation("p**2/2 + q**2/2", more="[recording.noise]\ny = 0.02\n")
    some = Options(restriction=Restriction(("viscous_damping", "sensor_noise", "coulomb_friction")))
    document = diagnose(file, [cases.recorded(times, readings, columns=("y",))], some).document
    told = {one["effect"]: one for one in document["findings"]}
    assert told.keys() == {"viscous_damping", "sensor_noise"}
    low, high = told["sensor_noise"]["coefficients"]["s"]["interval95"]
    assert low < 1.25 < high
