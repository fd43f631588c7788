"""State-space models: dynamics, observation, noises and the initial state. Dissertation (2.1), (2.5)."""

import abc
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PyTree

import integrators as ig

from ._counts import refuse_count
from ._errors import InputError
from ._model_checks import length_of, refuse_asymmetric, refuse_matrix, refuse_misfit, shape_of
from ._noise import AdditiveGaussian, WienerIncrement, enter
from ._parameters import AbstractKnown, number
from ._small_products import product
from ._transforms import AbstractTransform, Images, Moments
from ._triangular import semidefinite_cholesky


class Gaussian(AbstractKnown):
    """A normal distribution: `mean` of shape (d,) and `covariance` of shape (d, d), which may be singular.

    Bare arrays are known; `Gaussian(Learnt(mean), covariance)` learns the mean.

    **Raises:** `InputError` where the covariance is not square, not symmetric, or not of the mean's length.
    """

    mean: Any = eqx.field(converter=number)
    covariance: Any = eqx.field(converter=number)

    def __check_init__(self):
        refuse_asymmetric("Gaussian", "covariance", self.covariance)
        mean, covariance = shape_of(self.mean), shape_of(self.covariance)
        if mean is not None and covariance is not None and mean != covariance[:-1]:
            raise InputError(
                f"`Gaussian` needs a mean (d,) and a covariance (d, d), but was given the shapes {mean} and "
                f"{covariance}; make them of one length."
            )

    @property
    def size(self) -> int | None:
        """d, or None where it cannot be told."""
        return length_of(self.mean)

    @property
    def root(self) -> Float[Array, "d d"]:
        """Lower triangular, root root' = covariance."""
        return semidefinite_cholesky(jnp.asarray(self.covariance))


class Interval(eqx.Module):
    """The data interval between two readings: its `start` and its `end`, in the recording's time unit.

    `input` (input,) is u_k, known and held from `start` on; None where nothing drives the model.
    """

    start: Float[Array, "..."]
    end: Float[Array, "..."]
    input: Float[Array, "... input"] | None = None

    @property
    def length(self) -> Float[Array, "..."]:
        """The interval's duration."""
        return self.end - self.start


class Instant(eqx.Module):
    """The moment of a reading: its `time`, and the known `input` (input,) then, or None."""

    time: Float[Array, "..."]
    input: Float[Array, "... input"] | None = None


def intervals_between(times: Float[Array, " time"], inputs: Float[Array, "time input"] | None = None) -> Interval:
    """The data intervals of n times, one record with leading axis n - 1; u_k is held from time k on."""
    times = jnp.asarray(times)
    return Interval(times[:-1], times[1:], None if inputs is None else inputs[:-1])


class AbstractAffine(eqx.Module):
    """A map that is affine in the state, x -> slope x + (terms in the input).

    Filters treat it exactly, whatever their transform.
    """

    @abc.abstractmethod
    def slope(self, x: Float[Array, " state"]) -> Float[Array, "output state"]:
        """The matrix that multiplies the state; `x` gives the state's size only."""

    def carried(self, root: Float[Array, "state column"]) -> Float[Array, "output column"]:
        """The matrix times a square root of the state's covariance."""
        return product(self.slope(root[:, 0]), root)

    @abc.abstractmethod
    def __call__(self, x: Float[Array, " state"], context: Any = None) -> Float[Array, " output"]:
        """The map itself."""


class LinearDynamics(AbstractAffine):
    """x' = A x + B u, the dynamics of (3.1): A (state, state), B (state, input) or None. One step per data interval.

    **Raises:** `InputError` where A is not square or B has not as many rows; and, in use, where B is given and the
    recording has no inputs.
    """

    A: Any
    B: Any = None

    def __check_init__(self):
        refuse_matrix("LinearDynamics", "A", self.A, is_square=True)
        _refuse_rows("LinearDynamics", ("A", self.A), ("B", self.B))

    def slope(self, x: Float[Array, " state"]) -> Float[Array, "state state"]:
        return jnp.asarray(self.A, dtype=float)

    def __call__(self, x: Float[Array, " state"], interval: Any = None) -> Float[Array, " state"]:
        return product(self.slope(x), x) + _driven(self.B, interval, x.shape[0], "LinearDynamics")


def _refuse_rows(owner: str, first: tuple[str, Any], second: tuple[str, Any]) -> None:
    """Refuse two matrices whose products would be added, but whose rows are not as many."""
    refuse_matrix(owner, *second)
    (a, one), (b, other) = ((name, shape_of(given)) for name, given in (first, second))
    if one and other and one[-2] != other[-2]:
        raise InputError(
            f"`{owner}` needs {a} and {b} of as many rows, but was given the shapes {one} and {other}; give {b} "
            f"{one[-2]} rows."
        )


def _driven(matrix: Any, context: Any, size: int, owner: str) -> Array:
    """The matrix times the context's input; 0 without a matrix."""
    if matrix is None:
        return jnp.zeros(size)
    given = getattr(context, "input", None)
    if given is None:
        raise InputError(
            f"`{owner}` has an input matrix, but the recording has no inputs; give `TimeSeries` its `inputs`."
        )
    return product(jnp.asarray(matrix, dtype=float), given)


class Propagator(eqx.Module):
    """A system stepped by an integrator over one data interval: Psi in (2.5).

    The state is lifted once per data interval, stepped `substeps` times and projected back (5.18).

    **Arguments:** `system` - a Hamiltonian or a forced system of `integrators`; `integrator` - for example
    `integrators.Leapfrog()`; `substeps` - integrator steps per data interval, a whole number of at least 1.

    **Raises:** `InputError` where `substeps` is no such number; `TypeError` where the integrator cannot step the
    system.
    """

    system: Any
    integrator: Any
    substeps: int = eqx.field(static=True, default=1)

    def __check_init__(self):
        refuse_count("Propagator", "substeps", self.substeps)
        self.integrator.accepts(self.system)

    def __call__(self, x: Float[Array, " state"], interval: Interval) -> Float[Array, " state"]:
        return ig.propagate(self.system, self.integrator, x, interval.start, interval.end, self.substeps)

    def side_by_side(self, points: Float[Array, "state point"], interval: Interval) -> Float[Array, "state point"]:
        """Many states over the same data interval."""
        prepared = self.system.prepared()
        if getattr(prepared, "side_by_side", False):
            return ig.propagate(prepared, self.integrator, points, interval.start, interval.end, self.substeps)
        return jax.vmap(self, in_axes=(1, None), out_axes=1)(points, interval)


class FullState(AbstractAffine):
    """The whole state is read: h(x) = x."""

    def slope(self, x: Float[Array, " state"]) -> Float[Array, "state state"]:
        return jnp.eye(x.shape[0])

    def carried(self, root: Float[Array, "state column"]) -> Float[Array, "state column"]:
        return root

    def __call__(self, x: Float[Array, " state"], context: Any = None) -> Float[Array, " state"]:
        return x


def _as_tuple(indices: Any) -> Any:
    if not isinstance(indices, list | tuple | np.ndarray) or len(np.shape(indices)) != 1 or not len(indices):
        raise InputError(f"`Coordinates` needs a tuple of indices, such as (0,), but was given {indices!r}.")
    return tuple(indices.tolist() if isinstance(indices, np.ndarray) else indices)


class Coordinates(AbstractAffine):
    """Some entries of the state are read: h(x) = x[indices]; `Coordinates((0,))` reads q_0 of [q, p].

    **Raises:** `InputError` where an index is no whole number of at least 0; and, as soon as the size of the state is
    known, where the state has no such entry.
    """

    indices: tuple[int, ...] = eqx.field(static=True, converter=_as_tuple)

    def __check_init__(self):
        for index in self.indices:
            refuse_count("Coordinates", "indices", index, least=0)

    def refuse_beyond(self, state: int) -> None:
        """Refuse, with `InputError`, an index that a state of this size has not: JAX would read its last entry."""
        if self.indices and max(self.indices) >= state:
            raise InputError(
                f"`Coordinates` reads entry {max(self.indices)}, counted from 0, but the state has {state} numbers; "
                f"give indices from 0 to {state - 1}."
            )

    def slope(self, x: Float[Array, " state"]) -> Float[Array, "channel state"]:
        self.refuse_beyond(x.shape[0])
        return jnp.eye(x.shape[0])[np.asarray(self.indices)]

    def __call__(self, x: Float[Array, " state"], context: Any = None) -> Float[Array, " channel"]:
        self.refuse_beyond(x.shape[0])
        # Known places, which a machine's registers need.
        return x[np.asarray(self.indices)]


class LinearObservation(AbstractAffine):
    """A linear reading: h(x, u) = matrix x + feedthrough u, the H (channel, state) and D (channel, input) of (3.1).

    **Raises:** `InputError` where `matrix` is none or the feedthrough has not as many rows; and, in use, where a
    feedthrough is given and the recording has no inputs.
    """

    matrix: Any
    feedthrough: Any = None

    def __check_init__(self):
        refuse_matrix("LinearObservation", "matrix", self.matrix)
        _refuse_rows("LinearObservation", ("matrix", self.matrix), ("feedthrough", self.feedthrough))

    def slope(self, x: Float[Array, " state"]) -> Float[Array, "channel state"]:
        return jnp.asarray(self.matrix, dtype=float)

    def __call__(self, x: Float[Array, " state"], context: Any = None) -> Float[Array, " channel"]:
        reading = product(self.slope(x), x)
        return reading + _driven(self.feedthrough, context, reading.shape[0], "LinearObservation")


class AbstractStateSpaceModel(eqx.Module):
    """What a Gaussian filter asks of a hidden Markov model: where it starts, and two kinds of moments."""

    if TYPE_CHECKING:  # an `AbstractVar` here reads, to type checkers, as a field before those of the subclass

        @property
        def initial(self) -> Any:
            """A `Gaussian` for the state at the first reading."""

    @property
    @abc.abstractmethod
    def reads_exactly(self) -> bool:
        """Whether `read` is exact and takes any square root of the covariance, of any number of columns."""

    @abc.abstractmethod
    def predict(
        self,
        transform: AbstractTransform,
        mean: Float[Array, " state"],
        root: Float[Array, "state state"],
        interval: Any,
    ) -> Moments:
        """Moments of the state after a data interval (2.6), noise included, for x with `mean` and root root'."""

    @abc.abstractmethod
    def read(
        self, transform: AbstractTransform, mean: Float[Array, " state"], root: Float[Array, "state _"], context: Any
    ) -> Moments:
        """Moments of a reading (2.7), noise included, for x with `mean` and root root'."""


class StateSpaceModel(AbstractStateSpaceModel):
    """A hidden Markov model with noise that is added or multiplied. Dissertation (2.5), (2.9).

    x_{k+1} = dynamics(x_k, interval_k) + xi_k,  y_k = observation(x_k, context_k) + eta_k,  x_0 ~ initial.

    **Arguments:**
    - `dynamics`: a module `(x, interval) -> x'`. `interval` is one slice of a pytree whose leading axis
      counts the data intervals, as an `Interval` or the caller's own record.
    - `observation`: a module `(x, context) -> y`. `context` is one slice of a pytree over the readings, as an
      `Instant`, or None. What is affine in x (`AbstractAffine`) is treated exactly, here and in the dynamics.
    - `process_noise`: a noise of the state, such as `AdditiveGaussian`, or any module with `covariance(interval)`.
    - `measurement_noise`: a noise of the readings, or any module with `covariance(context)`.
    - `initial`: a `Gaussian` for the state at the first reading, or one for each of several recordings, in a tuple.
      None means a flat prior, which only a model that reads its `FullState` can have: the first reading is then
      conditioned on (Remark 1 after Theorem 2).

    **Raises:** `InputError` where a part is not for a state of the initial distribution's size.
    """

    dynamics: Callable[[Any, Any], Any]
    observation: Callable[[Any, Any], Any]
    process_noise: Any
    measurement_noise: Any
    initial: Any = None

    def __check_init__(self):
        for one in self.initial if isinstance(self.initial, tuple) else (self.initial,):
            if isinstance(one, Gaussian) and one.size is not None:
                self._refuse_misfits(one.size)

    def _refuse_misfits(self, state: int) -> None:
        if isinstance(self.dynamics, LinearDynamics):
            refuse_misfit("dynamics", length_of(self.dynamics.A), state)
        if isinstance(self.observation, LinearObservation):
            refuse_misfit("observation", length_of(self.observation.matrix), state)
        if isinstance(self.observation, Coordinates):
            self.observation.refuse_beyond(state)
        refuse_misfit("process noise", _size_of(self.process_noise), state)

    @property
    def reads_exactly(self) -> bool:
        return isinstance(self.observation, AbstractAffine)

    def predict(self, transform, mean, root, interval) -> Moments:
        moved = _pass(transform, self.dynamics, mean, root, interval)
        refuse_misfit("process noise", _size_of(self.process_noise), moved.mean.shape[0])
        return enter(self.process_noise, moved, interval)

    def read(self, transform, mean, root, context) -> Moments:
        return enter(self.measurement_noise, _pass(transform, self.observation, mean, root, context), context)


def _size_of(noise: Any) -> int | None:
    """How many numbers a noise is of, or None where that cannot be told."""
    known = isinstance(noise, AdditiveGaussian | WienerIncrement)
    return getattr(noise.structure, "size", None) if known else None


def _pass(transform: AbstractTransform, part: Any, mean: Array, root: Array, record: Any) -> Moments:
    """Moments of one part of a model, exact where it is affine."""
    if isinstance(part, AbstractAffine):
        return Moments(part(mean, record), part.carried(root), root)
    images = getattr(part, "side_by_side", None)
    return transform(Images(lambda x: part(x, record), images and (lambda points: images(points, record))), mean, root)


def slice_at(records: PyTree, k: int | Int[Array, ""]) -> PyTree:
    """Slice k of a pytree along its leading axis."""
    return jax.tree.map(lambda leaf: leaf[k], records)
