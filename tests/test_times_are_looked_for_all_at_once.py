"""What a blow, a periodic force or a change of a parameter would gain at any time follows from one tangent flow."""

from dataclasses import replace

import engine_cases as cases
import numpy as np
import pytest

from symplearn.diagnosis import _tangent as tangent
from symplearn.diagnosis._calibrate import calibrate
from symplearn.diagnosis._scan import spacing
from symplearn.diagnosis._start import priors_without_effects
from symplearn.diagnosis._trajectory import Stepper

GRAVITY, NOISE, SCALE, X0_SD = 4.0, 0.02, 0.3, 0.5
BLOW = (-0.1, 7.27)
TIMES = (np.linspace(0.0, 16.0, 110), np.linspace(3.0, 12.0, 70))
STARTS = ((1.2, 0.3), (-0.8, 0.9))
SMALL = 1e-4  # of a difference quotient: its error is the square of that

FILE = f"""
[parameters]
g = {GRAVITY}

[initial]
q = {{ value = 0.0, sd = {X0_SD} }}
p = {{ value = 0.0, sd = {X0_SD} }}

[recording.noise]
y = {NOISE}
"""


def angles(times, start, push=lambda t: 0.0, gravity=lambda t: GRAVITY, blow=(0.0, 0.0)):
    """A pendulum by DOP853 with a push, a gravity that changes, and a blow (size, time)."""
    rates = lambda t, x: [x[1], -gravity(t) * np.sin(x[0]) + push(t)]  # noqa: E731
    size, when = blow
    if not (size and times[0] < when < times[-1]):
        return cases.solved(rates, start, times)[:, 0]
    return cases.struck(rates, start, times, [0.0, size], when)[:, 0]


def joined(times, start, omega, strength):
    """The same with an unseen oscillator of that frequency, at rest at first, by the force w on the pendulum."""
    rates = lambda t, x: [x[1], -GRAVITY * np.sin(x[0]) + x[2], x[3], strength * x[0] - omega**2 * x[2]]  # noqa: E731
    return cases.solved(rates, [*start, 0.0, 0.0], times)[:, 0]


@pytest.fixture(scope="module")
def stepper():
    rng = np.random.default_rng(5)
    runs = [cases.recorded(t, angles(t, start, blow=BLOW if r else (0.0, 0.0)) + NOISE * rng.normal(size=len(t)))
            for r, (t, start) in enumerate(zip(TIMES, STARTS, strict=True))]  # fmt: skip
    return Stepper(cases.problem(cases.simulation("p**2/2 - g*cos(q)", more=FILE), runs, 0.05))


@pytest.fixture(scope="module")
def priors(stepper):
    size = stepper.problem.equations.size
    bare = priors_without_effects(stepper.problem)
    return replace(bare, scales=np.full(size, SCALE), lower=np.full(size, 0.4), upper=np.full(size, 3.0))


@pytest.fixture(scope="module")
def fits(stepper, priors):
    begin = priors.mean.copy()
    for r, start in enumerate(STARTS):
        begin[starts_at(stepper, r)] = start
    return calibrate(stepper, begin[None], [()], priors, [len(t) for t in TIMES], tolerance=1e-12)


def starts_at(stepper, r):
    """Where a recording's q and p at its first row stand in z; behind each there is an unseen one."""
    return stepper.problem.state * r + np.array([0, stepper.problem.state // 2])


def one_of(problem, name):
    return next(m for m in problem.searched if problem.candidate(m).effect.name == name)


def columns(effect, place, times, start):
    """What a unit of an effect's amplitudes does to one recording, by difference quotients."""

    def quotient(change):
        return (change(SMALL) - change(-SMALL)) / (2 * SMALL)

    if effect == "impulse":
        return [quotient(lambda a: angles(times, start, blow=(a, place)))]
    if effect == "regime_change":
        later = lambda a: lambda t: GRAVITY * (1 + a * (t > place))  # noqa: E731
        return [quotient(lambda a: angles(times, start, gravity=later(a)))]
    if effect == "hidden_oscillator":
        return [quotient(lambda a: joined(times, start, place, a))]
    waves = [lambda t: np.cos(place * t), lambda t: np.sin(place * t)]
    if effect == "periodic_forcing":
        return [quotient(lambda a, w=w: angles(times, start, push=lambda t: a * w(t))) for w in waves]
    return [quotient(lambda a, w=w: angles(times, start, gravity=lambda t: GRAVITY * (1 + a * w(t)))) for w in waves]


def gain(stepper, z, effect, place, recordings):
    """Log evidence that the amplitudes earn, by NumPy's least squares with Gaussian priors."""
    blocks, errors = [], []
    for r, run in enumerate(stepper.problem.rows):
        start = z[starts_at(stepper, r)]
        own = [(angles(run.times, start + h) - angles(run.times, start - h)) / (2 * SMALL) for h in SMALL * np.eye(2)]
        further = columns(effect, place, run.times, start) if r in recordings else None
        width = 1 if effect in ("impulse", "regime_change", "hidden_oscillator") else 2
        block = np.zeros((len(run.times), 4 + width))
        block[:, 2 * r : 2 * r + 2] = np.transpose(own)
        if further:
            block[:, 4:] = np.transpose(further)
        blocks.append(block)
        errors.append(run.readings[:, 0] - angles(run.times, start))
    J, e = np.concatenate(blocks) / NOISE, np.concatenate(errors) / NOISE
    starts = np.concatenate([z[starts_at(stepper, r)] for r in range(2)])

    def evidence(size):
        sd = np.array([X0_SD] * 4 + [SCALE] * (size - 4))
        A = np.vstack([J[:, :size], np.diag(1 / sd)])
        b = np.concatenate([e, -starts / sd[:4], np.zeros(size - 4)])
        x, *_ = np.linalg.lstsq(A, b, rcond=None)
        return -0.5 * ((b - A @ x) ** 2).sum() - 0.5 * np.linalg.slogdet(A.T @ A)[1] - np.log(sd).sum()

    return evidence(J.shape[1]) - evidence(4)


@pytest.mark.parametrize(
    ("effect", "places"),
    [
        ("impulse", TIMES[1][[5, 33, 60]]),
        ("regime_change", TIMES[1][[0, 33, 50]]),
        ("periodic_forcing", [0.7, 1.9]),
        ("parametric_modulation", [0.7, 1.9]),
        ("hidden_oscillator", [0.7, 1.9]),
    ],
)
def test_the_gain_is_that_of_trajectories(stepper, priors, fits, effect, places):
    """About a swinging pendulum's fit, of a blow to the second recording and of all else in both, an unseen oscillator
    begun at rest: as least squares on difference quotients of trajectories by SciPy have it."""
    p = stepper.problem
    m = one_of(p, effect)
    one = p.candidate(m)
    recordings = tangent._recordings(stepper, fits, [len(t) for t in TIMES], priors)
    sums = [tangent._sums(p, own, m, np.asarray(places), False) for own in recordings]
    which = (1,) if effect == "impulse" else (0, 1)
    total = sums[1] if effect == "impulse" else sums[0] + sums[1]
    found = total.gains(priors.scales[one.first : one.first + one.effect.amplitudes])
    expected = [gain(stepper, fits.z[0], effect, place, which) for place in places]
    # A wave is taken as even over each row's gap of 0.14: (1.9 0.14)^2 / 24 of it; a change at a time is exact there,
    # but for the substep of 0.05 that it is spread over.
    assert found == pytest.approx(expected, rel=0.02, abs=0.05) and np.ptp(expected) > 1


def test_the_best_time_is_that_of_the_blow(stepper, priors, fits):
    """Within a row, however long the recording; and a periodic force is tried where it gains most."""
    p, rows = stepper.problem, [len(t) for t in TIMES]
    found = tangent.sharp_units(stepper, fits, rows, priors)
    assert found[one_of(p, "impulse")][0].place == pytest.approx(BLOW[1], abs=np.diff(TIMES[1])[0])
    assert {p.candidate(m).effect.name for m in found} == {
        "impulse", "regime_change", "periodic_forcing", "parametric_modulation", "hidden_oscillator"}  # fmt: skip
    for m, units in found.items():
        one = p.candidate(m)
        ends = (priors.lower[one.values.stop - 1], priors.upper[one.values.stop - 1])
        assert 0 < len(units) <= 8
        # None is the slope of another's peak: as far apart as neighbours on a grid, and half as far again.
        assert (np.diff(sorted(u.place for u in units)) >= 1.5 * spacing(one, *ends) * (1 - 1e-9)).all()


def test_blows_are_looked_for_alone(stepper, priors, fits):
    """A search restricted to blows finds the same best time, though nothing that acts all the time is searched."""
    m, rows = one_of(stepper.problem, "impulse"), [len(t) for t in TIMES]
    (best, *_) = tangent.sharp_units(stepper, fits, rows, priors)[m]
    alone = tangent.sharp_units(stepper.on(replace(stepper.problem, searched=(m,))), fits, rows, priors)
    assert set(alone) == {m} and alone[m][0] == best


def test_what_ran_away_is_not_drawn_back(stepper, priors, fits):
    """Nothing is said of times about a trajectory that is not finite."""
    lost = replace(fits, z=np.full_like(fits.z, np.nan))
    assert tangent.sharp_units(stepper, lost, [len(t) for t in TIMES], priors) == {}
