"""The pendulums of sections 3.3.1 and 3.3.2: truth, recordings, the linear model, its posterior and its predictions."""

from collections.abc import Callable
from functools import cache, partial
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import PRNGKeyArray
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from symplearn._dynamic_modes import dmd, total_dmd
from symplearn._fit import Estimate
from symplearn._importance import AdaptiveImportance
from symplearn._learn import learn
from symplearn._model import FullState, Gaussian, LinearDynamics, StateSpaceModel
from symplearn._noise import AdditiveGaussian, ScaledIdentity
from symplearn._objectives import TimeSeries
from symplearn._parameters import Positive
from symplearn._posterior import Posterior
from symplearn._prior import HalfNormal, Laplace, Prior
from symplearn._sample import sample
from symplearn._tempered_smc import TemperedSMC

from ._command import Run
from ._realisations import kept, realisations

GRAVITY, READ_UNTIL, HORIZON = 9.81, 4.0, 8.0
# The released code's: 0.1 |A|_1 in nats, and half-normal variances (specification 5.3).
PRIOR = Prior({"dynamics": Laplace(10.0), "process_noise": HalfNormal(1.0), "measurement_noise": HalfNormal(1.0)})
DRAWS = 1000
SAMPLER = AdaptiveImportance(draws=DRAWS, target=1000, batch=1000, rounds=20)
# For posteriors that importance sampling says it cannot do: few readings in much noise, of which tails are heavy.
FALLBACK, TRUSTED = TemperedSMC(runs=2, lines=64, length=16), 0.7


class Pendulum(NamedTuple):
    """A true pendulum: where it starts, and its states (time, 2) at times up to the horizon."""

    name: str
    start: np.ndarray
    states: Callable[[np.ndarray], np.ndarray]


def _linear(times: np.ndarray) -> np.ndarray:
    """(3.16), by the matrix exponential."""
    generator = np.array([[0.0, 1.0], [-GRAVITY, 0.0]])
    return np.array([expm(generator * t) @ LINEAR.start for t in times])


@cache
def _orbit() -> Any:
    def motion(t, x):
        return [x[1], -GRAVITY * np.sin(x[0])]

    span = (0.0, HORIZON)
    return solve_ivp(motion, span, NONLINEAR.start, method="DOP853", rtol=1e-12, atol=1e-13, dense_output=True).sol


def _nonlinear(times: np.ndarray) -> np.ndarray:
    """(3.19), by SciPy."""
    return _orbit()(times).T


LINEAR = Pendulum("linear", np.array([0.1, -0.5]), _linear)
NONLINEAR = Pendulum("nonlinear", np.array([2.5, 0.0]), _nonlinear)


class Cell(NamedTuple):
    """n readings in four seconds after the one at time 0, with noise of standard deviation sigma."""

    n: int
    sigma: float

    @property
    def name(self) -> str:
        return f"n{self.n}_sigma{self.sigma:g}"

    def times(self, until: float = READ_UNTIL) -> np.ndarray:
        """The times of the readings, and as many intervals more as `until` takes."""
        return np.arange(round(until / READ_UNTIL * self.n) + 1) * (READ_UNTIL / self.n)


def recording(pendulum: Pendulum, cell: Cell, seed: int, k: int) -> TimeSeries:
    """Data set k of a cell: the whole state with noise at n + 1 times, the first of them 0."""
    times = cell.times()
    random = np.random.default_rng([seed, k, cell.n, round(1e6 * cell.sigma)])
    return TimeSeries(times, pendulum.states(times) + cell.sigma * random.normal(size=(len(times), 2)))


def model(
    start: np.ndarray | None, A: Any, process_noise: float = 0.1, measurement_noise: float = 0.1
) -> StateSpaceModel:
    """(3.17): every entry of A and two variances learn; the state at time 0 is known, or, for None, only read."""
    return StateSpaceModel(
        dynamics=LinearDynamics(jnp.asarray(A)),
        observation=FullState(),
        process_noise=AdditiveGaussian(ScaledIdentity(Positive(process_noise), 2)),
        measurement_noise=AdditiveGaussian(ScaledIdentity(Positive(measurement_noise), 2)),
        initial=None if start is None else Gaussian(jnp.asarray(start), jnp.zeros((2, 2))),
    )


def learnt(series: TimeSeries, start: np.ndarray) -> Estimate:
    """The most probable model, begun at DMD's A and with noises of the size of its residuals.

    A wrong A with much process noise is an optimum too: with n = 24 and sigma = 0.001 `learn` ends there in 3 data sets
    of 50, and in 6 from variances of 0.1. The draws mostly find the way out.
    """
    A = np.asarray(dmd(series).A)
    readings = np.asarray(series.readings)
    # A reading's noise enters a residual directly, and once more through A, whose square is about 1.
    size = float(np.mean((readings[1:] - readings[:-1] @ A.T) ** 2)) / 3
    return learn(model(start, A, size, size), series, prior=PRIOR)


def posterior(estimate: Estimate, key: PRNGKeyArray) -> Posterior:
    """A thousand draws, or those of tempered SMC where importance sampling says that it has failed."""
    found = sample(estimate, sampler=SAMPLER, key=key)
    k = found.drawn.pareto_k
    return found if k is not None and k < TRUSTED else sample(estimate, sampler=FALLBACK, key=key)


def matrices(found: Posterior) -> np.ndarray:
    """A thousand evenly spaced draws of A (draw, 2, 2)."""
    every = np.asarray(found.values["dynamics.A"]).reshape(-1, 2, 2)
    return every[np.arange(DRAWS) * len(every) // DRAWS]


def variances(found: Posterior) -> np.ndarray:
    """A thousand evenly spaced draws of the variances of process and measurement noise (draw, 2)."""
    names = ("process_noise.structure.variance", "measurement_noise.structure.variance")
    every = np.stack([np.ravel(found.values[name]) for name in names], axis=1)
    return every[np.arange(DRAWS) * len(every) // DRAWS]


def decompositions(series: TimeSeries) -> dict[str, np.ndarray]:
    """A by dynamic mode decomposition, and by its total least squares."""
    return {"dmd": np.asarray(dmd(series).A), "tdmd": np.asarray(total_dmd(series).A)}


def pushed(A: Any, start: np.ndarray, steps: int) -> np.ndarray:
    """The states A^k start, k = 0 .. steps, of one A or many: (..., steps + 1, 2)."""
    A = np.asarray(A)
    states = [np.broadcast_to(start, (*A.shape[:-2], 2))]
    for _ in range(steps):
        states.append(np.einsum("...ij,...j->...i", A, states[-1]))
    return np.stack(states, axis=-2)


def squared_error(states: np.ndarray, true: np.ndarray) -> float:
    """The mean squared error over both states at the given times, without the first one, which is known."""
    return float(np.mean((states - true)[1:] ** 2))


def each_block(
    run: Run, cells: list[Cell], datasets: int, size: int, settings: str, one: Callable[[Cell, int], dict[str, Any]]
) -> dict[Cell, list[dict[str, Any]]]:
    """What `one` finds of every data set of every cell; blocks of data sets are kept, and a block of every cell is
    done before the next. `one` can be pickled where `run` has a scheduler."""
    found: dict[Cell, list[dict[str, Any]]] = {cell: [] for cell in cells}
    todo = [(block, cell) for block in range(datasets // size) for cell in cells]
    words = f"{settings}, {size} data sets"
    jobs = [partial(_block, cell=cell, number=block, size=size, settings=words, one=one) for block, cell in todo]
    made = realisations(run, jobs, threads=1)
    for (_, cell), block in zip(run.each(f"blocks of {size} data sets", todo), made, strict=True):
        found[cell] += block["datasets"]
    return found


def _block(
    run: Run, cell: Cell, number: int, size: int, settings: str, one: Callable[[Cell, int], dict[str, Any]]
) -> dict[str, Any]:
    """A block of data sets of a cell, from its file if there is one."""
    rows = range(number * size, (number + 1) * size)
    return kept(run, cell.name, number, settings, lambda: {"datasets": [one(cell, k) for k in rows]})
