"""Henon-Heiles as chapter V records it, made by SciPy, and the model that is to learn it."""

from functools import cache

import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp

import integrators as ig
from symplearn._hamiltonians import PolynomialPotential
from symplearn._model import FullState, Gaussian, Propagator, StateSpaceModel
from symplearn._noise import AdditiveGaussian, ScaledIdentity
from symplearn._objectives import TimeSeries
from symplearn._parameters import Positive
from symplearn._prior import HalfNormal, Laplace, Prior

START = np.array([0.2, -0.25, 0.3, -0.25])
# q1, q2, q1^2, q1 q2, q2^2, q1^3, q1^2 q2, q1 q2^2, q2^3 in (5.19).
TRUTH = np.array([0.0, 0.0, 0.5, 0.0, 0.5, 0.0, 1.0, 0.0, -1 / 3])
TIMES = np.arange(0.0, 101.0, 5.0)
PRIOR = Prior({"dynamics": Laplace(0.1), "process_noise": HalfNormal(1.0), "measurement_noise": HalfNormal(1.0)})


def _motion(t, x):
    q1, q2, p1, p2 = x
    return [p1, p2, -q1 - 2 * q1 * q2, -q2 - q1**2 + q2**2]


@cache
def orbit():
    """The true states at the times of the readings."""
    # SciPy's own error bounds, nine digits below the readings' noise.
    return solve_ivp(_motion, (0, TIMES[-1]), START, method="DOP853", rtol=1e-11, atol=1e-12, t_eval=TIMES).y.T


def recording(seed, sd=0.05):
    """Twenty readings of the full state; at time 0, where the state is known, there is none."""
    readings = orbit() + sd * np.random.default_rng(seed).normal(size=(len(TIMES), 4))
    readings[0] = np.nan
    return TimeSeries(TIMES, readings)


def henon_heiles(coefficients=None, process=1e-3, measurement=1e-3, substeps=20):
    """The nine coefficients of a cubic potential and two variances learn."""
    return StateSpaceModel(
        dynamics=Propagator(PolynomialPotential(2, 3, coefficients), ig.Leapfrog(), substeps),
        observation=FullState(),
        process_noise=AdditiveGaussian(ScaledIdentity(Positive(process), 4)),
        measurement_noise=AdditiveGaussian(ScaledIdentity(Positive(measurement), 4)),
        initial=Gaussian(jnp.asarray(START), 1e-8 * jnp.eye(4)),
    )
