"""An effect's strength is of unknown order of magnitude: nothing is paid for being small, or for the unit."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from posterior_cases import found, made, place
from scipy import integrate, stats

from symplearn.diagnosis import _magnitude, _mixture
from symplearn.diagnosis._magnitude import strength_gain, strength_gains, turning_gain
from symplearn.diagnosis._squares import log_product_of_squares
from symplearn.diagnosis._strength import FAINT, FAINT_WIDTHS, WIDTHS, mixture_gain, mixture_gains

NONE = -np.inf


def posterior(told, likelihood):
    """Centre and covariance under priors about zero of sd one."""
    precision = np.linalg.inv(likelihood)
    spread = np.linalg.inv(precision + np.eye(len(told)))
    return spread @ precision @ told, spread


@pytest.mark.parametrize(
    ("sd", "told", "lowest"),
    [(0.01, 0.05, NONE), (0.1, 0.3, NONE), (1e-3, 0.004, 0.0), (0.1, -0.1, 0.0), (0.1, 0.1, -0.2)],
)  # fmt: skip
def test_one_amplitude_is_integrated_as_quadrature_does(sd, told, lowest):
    """The gain of the mixture, each width with the amplitude's square, is the ratio of two integrals over the
    amplitude, each by SciPy's quadrature."""
    widths = np.geomspace(4.0 * sd, 1.0, WIDTHS)

    def evidence(width, squared):
        prior = stats.truncnorm(lowest / width, np.inf, scale=width)
        square = (lambda a: a**2 / (prior.var() + prior.mean() ** 2)) if squared else (lambda a: 1.0)
        low, high = max(lowest, told - 12 * sd), max(told, lowest) + 12 * sd
        density = lambda a: stats.norm.pdf(told, a, sd) * prior.pdf(a) * square(a)  # noqa: E731
        value, _ = integrate.quad(density, low, high, epsabs=0, limit=300)
        return value

    centre, spread = posterior(np.array([told]), np.array([[sd**2]]))
    gain = mixture_gain(centre, spread, np.zeros(1, int), np.array([lowest]))
    expected = np.log(np.mean([evidence(w, True) for w in widths]) / evidence(1.0, False))
    assert gain == pytest.approx(expected, abs=1e-7)  # quadrature's own 1.5e-8, relative, of either integral


def test_alone_an_effect_may_be_too_weak_to_be_seen():
    """Widths go down to the same share of the widest whatever the recording shows: of a poor recording most of them are
    too narrow to be told from nothing, of a good one few, and so much of nothing's evidence an absent effect keeps."""
    for sd, least, most in ((0.1, 0.7, 0.9), (1e-5, 0.0, 0.1)):
        centre, spread = posterior(np.array([0.0]), np.array([[sd**2]]))
        gain = mixture_gain(centre, spread, np.zeros(1, int), np.full(1, NONE), alone=True)
        widths = np.geomspace(FAINT, 1.0, FAINT_WIDTHS)
        expected = np.mean(stats.norm.pdf(0.0, scale=np.hypot(widths, sd))) / stats.norm.pdf(
            0.0, scale=np.hypot(1.0, sd)
        )
        assert gain == pytest.approx(
            np.log(expected), abs=1e-9
        )  # round-off, of a likelihood 1e5 narrower than the prior
        nothing = stats.norm.pdf(0.0, scale=sd) / stats.norm.pdf(0.0, scale=np.hypot(1.0, sd))
        assert least < np.exp(gain) / nothing < most


@pytest.mark.parametrize("correlated", [0.0, 6e-4, -1.9e-3])
def test_two_effects_have_a_width_each(correlated):
    """Every pair of widths counts, with both squares: densities of what is told by SciPy, times the mean of both
    squares under what is then known (Isserlis 1918)."""
    told = np.array([0.2, -0.03])
    likelihood = np.array([[4e-3, correlated], [correlated, 1e-3]])
    centre, spread = posterior(told, likelihood)
    shares = []
    for k in range(2):
        information = 1.0 / spread[k, k] - 1.0  # one entry, the other one left open
        shares.append(np.geomspace(4.0 / np.sqrt(information), 1.0, WIDTHS))
    density = lambda a, b: stats.multivariate_normal.pdf(told, cov=likelihood + np.diag([a**2, b**2]))  # noqa: E731

    def squares(a, b):
        C = np.linalg.inv(np.linalg.inv(likelihood) + np.diag([a**-2, b**-2]))
        m = C @ np.linalg.solve(likelihood, told)
        both = (m[0] ** 2 + C[0, 0]) * (m[1] ** 2 + C[1, 1]) + 4 * m[0] * m[1] * C[0, 1] + 2 * C[0, 1] ** 2
        return both / (a * b) ** 2

    each = [density(*pair) * squares(*pair) for pair in product(*shares)]
    gain = mixture_gain(centre, spread, np.arange(2), np.full(2, NONE))
    # Round-off of inverses, with condition numbers of some thousand. Seen: 3e-13.
    assert gain == pytest.approx(np.log(np.mean(each) / density(1.0, 1.0)), abs=1e-10)


@pytest.mark.parametrize("told", [(0.2, 0.03), (0.1, 0.01), (0.004, 0.05)])
def test_of_two_rivals_with_a_sign_what_one_is_the_other_is_not(told):
    """Two dampings do nearly the same, so that the one is the smaller the larger the other is, and neither is below
    zero: the mean of both squares, as by SciPy's quadrature over both."""
    told, likelihood = np.array(told), np.array([[4e-3, -1.6e-3], [-1.6e-3, 1e-3]])
    centre, spread = posterior(told, likelihood)
    shares = [np.geomspace(4.0 / np.sqrt(1.0 / spread[k, k] - 1.0), 1.0, WIDTHS) for k in range(2)]
    seen = stats.multivariate_normal(told, likelihood)
    nodes, weights = np.polynomial.legendre.leggauss(200)
    a, b = np.meshgrid(0.3 * (1 + nodes), 0.15 * (1 + nodes), indexing="ij")
    mass = seen.pdf(np.stack([a, b], axis=-1)) * np.outer(0.3 * weights, 0.15 * weights)

    def evidence(u, v, square):
        return (mass * 4 * stats.norm.pdf(a, scale=u) * stats.norm.pdf(b, scale=v) * square).sum()

    each = [evidence(u, v, (a * b / (u * v)) ** 2) for u, v in product(*shares)]
    gain = mixture_gain(centre, spread, np.arange(2), np.zeros(2))
    # What is cut off is taken for a Gaussian of its mean and covariance. Seen: 0.06, 0.18 and 0.23; where both were
    # taken for independent 0.60, 1.46 and 1.63.
    assert gain == pytest.approx(np.log(np.mean(each) / evidence(1.0, 1.0, 1.0)), abs=0.25)


@pytest.mark.parametrize(
    "own", [[0], [0, 1], [0, 1, 2], [0, 0, 1, 2, 2], [0, 1, 1, 2, 3], [0, 1, 2, 3, 4]],
    ids=["one", "two", "three", "of vectors", "four", "five"],
)  # fmt: skip
def test_the_mean_of_squares_is_that_of_a_quadrature(own):
    """The mean of |x|^2 |y|^2 |z|^2 ... is Gauss' and Hermite's, whose nodes are exact to the degree of the product."""
    own, rng = np.array(own), np.random.default_rng(3)
    root, mean = rng.normal(size=(len(own), len(own))), rng.normal(size=len(own))
    nodes, weights = np.polynomial.hermite_e.hermegauss(6)
    grid = np.stack(np.meshgrid(*[nodes] * len(own)), axis=-1).reshape(-1, len(own))
    mass = np.prod(np.stack(np.meshgrid(*[weights] * len(own)), axis=-1).reshape(-1, len(own)), axis=1)
    points = mean + grid @ root.T
    squares = np.prod([(points[:, own == k] ** 2).sum(1) for k in range(own[-1] + 1)], axis=0)
    expected = np.log((mass * squares).sum() / mass.sum())
    assert log_product_of_squares(mean, root @ root.T, own) == pytest.approx(expected, abs=1e-12)  # round-off


@pytest.mark.parametrize("lowest", [NONE, 0.0])
def test_of_many_effects_widths_are_summed_line_by_line(monkeypatch, lowest):
    """Of four correlated effects the sum along the lines through a likely choice of widths is that of all 2401 choices,
    to a tenth of a nat."""
    rng, some = np.random.default_rng(5), []
    for _ in range(12):
        axes = np.linalg.qr(rng.normal(size=(4, 4)))[0]
        precision = axes @ np.diag(10 ** rng.uniform(2, 8, 4)) @ axes.T
        spread = np.linalg.inv(precision + np.eye(4))
        size = np.minimum(np.sqrt(np.diagonal(spread)) * 10 ** rng.uniform(0.2, 2, 4), 0.8)
        some.append((np.abs(spread @ precision @ size), spread))
    centres, spreads = map(np.stack, zip(*some, strict=True))
    lines = mixture_gains(centres, spreads, np.arange(4), np.full(4, lowest))
    monkeypatch.setattr(_mixture, "_TOGETHER", 4)
    every = mixture_gains(centres, spreads, np.arange(4), np.full(4, lowest))
    assert np.ptp(every) > 3  # they differ by what they gain
    # A tenth of a nat moves no probability by more than 0.025; of independent effects both are the same. Seen: 0.014.
    assert lines == pytest.approx(every, abs=0.1)


@pytest.mark.parametrize("alone", [False, True])
@pytest.mark.parametrize("lowest", [NONE, 0.0, -0.3])
def test_one_amplitude_gains_what_it_gains_beside_one_that_nothing_is_known_of(lowest, alone):
    """A second effect whose posterior is its prior, all of it wide, changes nothing."""
    for sd in (1e-5, 1e-3, 0.1, 0.7):
        for told in (0.0, 2 * sd, 0.5):
            centre, spread = posterior(np.array([told]), np.array([[sd**2]]))
            one = mixture_gain(centre, spread, np.zeros(1, int), np.array([lowest]), alone)
            both = mixture_gain(
                np.append(centre, 0.0), np.diag([spread[0, 0], 1.0]), np.arange(2), np.array([lowest, NONE]), alone
            )
            # Of what nothing is known, a billionth counts as known, so that it has an inverse.
            assert one == pytest.approx(both, abs=1e-8)


@pytest.mark.parametrize("alone", [False, True])
@pytest.mark.parametrize("lowest", [NONE, 0.0])
def test_of_many_each_gains_what_it_gains_by_itself(lowest, alone):
    """Many posteriors at once gain what each does by itself, whatever the others are; one that round-off left without
    meaning gains nothing and takes nothing from them."""
    rng = np.random.default_rng(4)
    some = [posterior(rng.normal(size=2) * sd, sd**2 * np.array([[1.0, 0.4], [0.4, 2.0]])) for sd in (1e-4, 0.01, 0.3)]
    some += [(np.full(2, np.nan), np.eye(2)), (np.zeros(2), np.zeros((2, 2)))]
    bounds = np.full(2, lowest)
    for own in (np.zeros(2, int), np.arange(2)):
        each = [mixture_gain(*one, own, bounds, alone) for one in some]
        many = mixture_gains(*map(np.stack, zip(*some, strict=True)), own, bounds, alone)
        np.testing.assert_allclose(many, each, rtol=1e-12)  # round-off of other products
        assert (np.abs(many[:3]) > 0.01).all() and (many[3:] == 0.0).all()


def test_combinations_side_by_side_gain_what_they_gain_alone(monkeypatch):
    """Combinations of any effects, of one bound or number and of others, with a self-excitation, an unseen oscillator
    or a wrong noise, gain together what each gains by itself; more of a kind than are taken at once, too."""
    monkeypatch.setattr(_magnitude, "_LANES", 2)
    problem, rng = made(2), np.random.default_rng(8)
    names = [("viscous_damping", "q1"), ("quadratic_drag", "q2"), ("sensor_gain", "b"), ("constant_force", "q1"),
             ("self_excitation", "q2"), ("hidden_oscillator", "q1"), ("periodic_forcing", "q2"),
             ("sensor_noise", "a")]  # fmt: skip
    damping, drag, gain, push, activity, unseen, wave, noise = (place(problem, *name) for name in names)
    some = [(), (noise,), (damping,), (drag,), (gain,), (damping, drag), (push, wave), (damping, activity), (activity,),
            (damping, drag, gain), (drag, gain, push), (unseen, push), (damping, drag, gain, push)]  # fmt: skip
    combinations, size = [tuple(sorted(c)) for c in 2 * some], problem.size
    priors = replace(found(problem).priors, precision=np.ones(size))
    z = [0.03 * (1.0 + rng.random(size)) for _ in combinations]
    roots = [0.01 * np.eye(size) + 0.001 * rng.normal(size=(size, size)) for _ in combinations]
    covariances = [root @ root.T for root in roots]
    together = strength_gains(problem, combinations, priors, z, covariances)
    each = zip(combinations, z, covariances, strict=True)
    # Round-off, where a processor multiplies stacks of matrices otherwise than single ones. Seen here: 0.
    np.testing.assert_allclose(together, [strength_gain(problem, c, priors, *one) for c, *one in each], rtol=1e-12)
    told = together[[bool(set(c) - {noise}) for c in combinations]]
    assert np.count_nonzero(together) == len(told) == len(set(told)) == 2 * (len(some) - 2)
    assert (np.abs(told) > 0.01).all()


@pytest.mark.parametrize("sd", [1e-3, 0.01, 0.1])
def test_with_another_beside_it_an_effect_is_no_likelier(sd):
    """A clear effect, alone of any strength down to what no recording shows, gains nothing by a second one that is as
    clear: it has the same share of its prior there, and the other one's mixture is what it is by itself."""
    problem = made(1)
    drag, gain = place(problem, "viscous_damping", "q1"), place(problem, "sensor_gain", "b")
    empty = found(problem).priors  # scales of one, about zero
    z, covariance = np.zeros(problem.size), np.zeros((problem.size, problem.size))

    def gained(*members):
        combination, full = tuple(sorted(members)), covariance.copy()
        for _, entries in problem.placed(combination):
            z[entries], full[entries, entries] = 8 * sd, sd**2 / (1 + sd**2)
        return strength_gain(problem, combination, empty, z, full)

    several = mixture_gain(np.array([8 * sd]), np.array([[sd**2 / (1 + sd**2)]]), np.zeros(1, int), np.full(1, NONE))
    # Alone the widths are thirteen over four decades, with another seven from four standard errors on, and squares.
    # Seen: 0.12 at most; without that share 0.5, 0.9 and 2.4.
    assert gained(drag, gain) - several == pytest.approx(gained(drag), abs=0.2)


def test_the_two_parts_of_one_effect_share_a_width():
    """A cosine and a sine are as wide as one another: one width for both in every term of the mean, and the square is
    of both together."""
    told, sd = np.array([0.1, 0.05]), 0.01
    centre, spread = posterior(told, sd**2 * np.eye(2))
    widths = np.geomspace(4.0 * sd, 1.0, WIDTHS)
    density = lambda w: stats.norm.pdf(told, scale=np.hypot(w, sd)).prod()  # noqa: E731
    known = lambda w: w**2 / (w**2 + sd**2)  # noqa: E731
    square = lambda w: np.mean((known(w) * told) ** 2 + known(w) * sd**2) / w**2  # noqa: E731
    expected = np.log(np.mean([density(w) * square(w) for w in widths]) / density(1.0))
    gain = mixture_gain(centre, spread, np.zeros(2, int), np.full(2, NONE))
    assert gain == pytest.approx(expected, abs=1e-10)  # round-off


def evidence_beside_nothing(sd, told):
    """Log evidence of one amplitude less that of zero, from Gaussians by hand and the gain under test."""
    centre, spread = posterior(np.array([told]), np.array([[sd**2]]))
    widest = stats.norm.logpdf(told, scale=np.hypot(1.0, sd)) - stats.norm.logpdf(told, scale=sd)
    return widest + mixture_gain(centre, spread, np.zeros(1, int), np.full(1, NONE))


def test_the_same_evidence_whatever_the_unit():
    """Six standard deviations earn nearly the same in an effect of which the widest is 30 or 30,000 times the error.

    With the widest alone the difference would be ln 1000 = 6.9 nats.
    """
    coarse, fine = (evidence_beside_nothing(sd, 6 * sd) for sd in (1 / 30, 1 / 30_000))
    assert abs(coarse - fine) < 2.0
    assert min(coarse, fine) > 10.0


def test_what_is_not_there_still_pays():
    """An effect estimated at nothing is a fiftieth as likely as nothing, however small it may be; at two standard
    deviations it is still the less likely one, at four it no longer is."""
    for sd in (1 / 30, 1 / 30_000):
        assert evidence_beside_nothing(sd, 0.0) < -3.9 and evidence_beside_nothing(sd, 2 * sd) < -1.0
        assert evidence_beside_nothing(sd, 4 * sd) > 2.0


def test_what_the_recording_cannot_show_gains_nothing():
    """Where the estimate is nearly as wide as its prior there are no narrower priors to speak of, and being near zero
    counts against it."""
    centre, spread = posterior(np.array([0.3]), np.array([[0.5]]))
    expected = np.log(centre[0] ** 2 + spread[0, 0])
    gain = mixture_gain(centre, spread, np.zeros(1, int), np.full(1, NONE))
    assert gain == pytest.approx(expected, abs=1e-10) and gain < 0


@pytest.mark.parametrize("told", [(0.05, 0.09), (0.0, 0.1), (0.1, 0.02)], ids=["drives", "only damps", "turns far out"])
def test_a_self_excitation_turns_where_the_motion_is(told):
    """Its c is of any order of magnitude, its ln a within ln 2 of the motion's: SciPy's densities over both."""
    scales, sd, correlation = np.array([0.3, 0.5]), np.array([0.02, 0.03]), 0.6
    likelihood = np.outer(sd, sd) * np.array([[1.0, correlation], [correlation, 1.0]])
    spread = np.linalg.inv(np.linalg.inv(likelihood) + np.diag(scales**-2.0))
    centre = spread @ np.linalg.solve(likelihood, np.array(told))
    widths = np.geomspace(4 * np.sqrt(spread[0, 0]) / scales[0], 1.0, WIDTHS)
    seen = stats.multivariate_normal(np.array(told), likelihood)

    def integral(prior, low, high):
        """Over c, and e in its logarithm, by midpoints. Seen: within 1e-5 nats of SciPy's dblquad."""
        c, y = (a + (b - a) * (np.arange(1200) + 0.5) / 1200 for a, b in ((0.0, 0.3), (low, high)))
        c, y = np.meshgrid(c, y)
        return (high - low) * np.mean(seen.pdf(np.stack([c, np.exp(y)], axis=-1)) * prior(c, np.exp(y)) * np.exp(y))

    def independent(c, e):
        return 4 * stats.norm.pdf(c, scale=scales[0]) * stats.norm.pdf(e, scale=scales[1])

    def turning(c, e):
        size = [c / (width * scales[0]) for width in widths]
        strength = 2 * sum(one**2 * stats.norm.pdf(one) * one / c for one in size) / len(size)
        a, motion = np.sqrt(c / e), np.sqrt(scales[0] / scales[1])
        within = (a > 0.4 * motion) / stats.lognorm.sf(0.4, np.log(2))
        return strength * within * stats.lognorm.pdf(a, np.log(2), scale=motion) * a / (2 * e)

    expected = np.log(integral(turning, np.log(1e-4), np.log(0.4)) / integral(independent, np.log(1e-7), np.log(0.4)))
    # The grid of the gain is a twelfth of a standard deviation wide and the density has an edge at c = 0.
    assert turning_gain(centre, spread, scales) == pytest.approx(expected, abs=0.05)


def test_what_turns_far_inside_the_motion_is_no_self_excitation():
    """A damping that grows with the square of the position and drives below a tenth of the swing is impossible as a
    self-excitation, however well it is known; one that turns at the size of the motion is not."""
    scales, e = np.array([0.3, 0.5]), 0.1
    for share, possible in ((0.1, False), (0.8, True)):
        c = e * share**2 * scales[0] / scales[1]
        gain = turning_gain(np.array([c, e]), np.diag([0.01 * c, 0.01 * e]) ** 2, scales)
        assert np.isfinite(gain) == possible


def test_what_is_not_known_to_be_a_spread_gains_nothing():
    """Posteriors of failed fits, singular ones, and ones that round-off left indefinite give numbers and no error."""
    scales, nothing = np.array([0.3, 0.5]), np.full(2, NONE)
    for spread in (np.zeros((2, 2)), np.full((2, 2), np.nan), np.array([[1.0, 1 + 1e-12], [1 + 1e-12, 1.0]]) * 1e-4):
        for alone in (False, True):
            assert np.isfinite(turning_gain(np.array([0.01, 0.02]), spread, scales, alone))
            assert np.isfinite(mixture_gain(np.array([0.01, 0.02]), spread, np.arange(2), nothing, alone))
