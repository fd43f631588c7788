"""Pathfinder and variational inference are exact where they can be, and say where they are not."""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from symplearn._errors import InputError
from symplearn._mclmc import MCLMC
from symplearn._pathfinder import Pathfinder
from symplearn._sample import sample_density
from symplearn._variational import FullRank, MeanField, VariationalInference

MEAN_FIELD = VariationalInference(MeanField())
FULL_RANK = VariationalInference(FullRank())
APPROXIMATIONS = [MEAN_FIELD, FULL_RANK, Pathfinder()]
NAMES = ["mean field", "full rank", "Pathfinder"]


class Bent(eqx.Module):
    """x0 ~ N(0, 1) and x1 ~ N(slope x0 + bend (x0^2 - 1), sd^2) given x0."""

    slope: jax.Array
    bend: jax.Array
    sd: jax.Array

    def __call__(self, x):
        return -0.5 * (x[0] ** 2 + ((x[1] - self.slope * x[0] - self.bend * (x[0] ** 2 - 1)) / self.sd) ** 2)


def bent(slope, bend, sd):
    return Bent(*map(jnp.asarray, (slope, bend, sd)))


def drawn(density, sampler, start=(0.5, -0.5), seed=0):
    return sample_density(density, jnp.asarray(start), sampler=sampler, key=jax.random.key(seed))


@pytest.mark.parametrize("sampler", APPROXIMATIONS, ids=NAMES)
def test_a_banana_is_no_normal_density(sampler):
    """Of a strongly bent density no normal approximation is passed off as exact: Pareto k is above 0.7 and says so."""
    posterior = drawn(bent(0.0, 2.0, 0.3), sampler)
    assert posterior.diagnostics.pareto_k > 0.7
    assert not posterior.converged
    assert "misses a part of the density; sample with `AdaptiveImportance`" in str(posterior)


def test_mean_field_misses_correlation_by_its_divergence():
    """Mean field stays below the evidence by -log(1 - r^2) / 2 nats for a normal density of correlation r = 0.8."""
    posterior = drawn(bent(0.8, 0.0, 0.6), MEAN_FIELD)
    gap = math.log(2 * math.pi * 0.6) - posterior.drawn.elbo
    # 4000 draws whose log ratios scatter by 0.8 nats: a standard error of 0.013.
    assert abs(gap + 0.5 * math.log(1 - 0.8**2)) < 0.04
    assert f"{posterior.drawn.elbo:.3f}" in str(posterior)
    assert posterior.diagnostics.pareto_k > 0.7 and not posterior.converged


@pytest.mark.parametrize("sampler", [FULL_RANK, Pathfinder()], ids=NAMES[1:])
def test_a_normal_density_is_found(sampler):
    """A normal density is its own approximation: weights nearly equal, evidence exact."""
    posterior = drawn(bent(0.8, 0.0, 0.6), sampler)
    assert posterior.converged, str(posterior)
    # Full rank ends at Adam's last step, Pathfinder at L-BFGS's tolerance of 1e-5.
    assert abs(posterior.log_evidence - math.log(2 * math.pi * 0.6)) < 0.02
    assert posterior.log_evidence_sd < 0.01


def test_a_path_cut_short_is_centred_by_its_slope():
    """Pathfinder stopped before the mode takes Newton's step up to it, where blackjax 1.7.1 steps down."""
    posterior = drawn(bent(0.8, 0.0, 0.6), Pathfinder(steps=2, paths=1, reach=6.0))
    mean = np.asarray(posterior.values["x"]).mean(axis=(0, 1))
    # Two steps learn little of the curvature: 0.14 is left of a start some six away. A step down leaves 1.2.
    np.testing.assert_allclose(mean, 0.0, atol=0.4)


def test_impossible_draws_make_the_bound_useless():
    """Where a normal density puts draws on impossible places the ELBO is minus infinity, and the remark counts them."""
    posterior = drawn(lambda x: jnp.where(x[0] > 0, -0.5 * jnp.sum((x - 1.0) ** 2), -jnp.inf), FULL_RANK, (1.0, 1.0))
    assert posterior.drawn.elbo == -math.inf
    assert "minus infinity" in str(posterior) and "of its draws are impossible" in str(posterior)
    assert np.all(np.asarray(posterior.values["x"])[..., 0] > 0)


def test_bad_options_are_one_sentence():
    """Options that cannot work are refused before anything is computed."""
    for wrong, sentence in (
        (lambda: Pathfinder(reach=0.0), "`Pathfinder` needs a `reach` above 0, but was given 0.0."),
        (lambda: VariationalInference(rate=-1.0), "`VariationalInference` needs a `rate` above 0, but was given -1.0."),
        (lambda: VariationalInference(batch=0), "`batch` of at least 1, a whole number, but was given 0"),
        (lambda: MCLMC(acceptance=1.0), "`MCLMC` needs `acceptance` between 0 and 1, but was given 1.0."),
        (lambda: drawn(lambda x: -0.5 * x[0] ** 2, MCLMC(), (0.0,)), "needs two parameters .* sample with `NUTS`"),
    ):
        with pytest.raises(InputError, match=sentence):
            wrong()
