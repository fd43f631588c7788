"""Filtering on the doubled phase space of Tao's method: the state [q, p, x, y] is stepped and never projected.

Dissertation (5.18) projects after every data interval, which is not symplectic (specification E40). Here the hidden
state is the integrator's own, two phase points end to end as its `lift` makes them; only the readings are projected.
docs/tao-filtering.md says what was measured, and when it pays.
"""

import abc
import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

import integrators as ig

from ._counts import refuse_count
from ._errors import InputError
from ._model import AbstractAffine, Gaussian, Interval, Propagator, StateSpaceModel
from ._noise import AbstractNoise, Multiplicative, enter
from ._parameters import AbstractKnown
from ._transforms import Moments, UnscentedTransform, with_noise
from ._triangular import semidefinite_cholesky


class DoubledPropagator(eqx.Module):
    """A system stepped on the doubled phase space over one data interval: symplectic there, (5.8) without (5.18).

    **Arguments:** `system` - as for `Propagator`; `integrator` - one of two copies, as `integrators.Tao()` or a
    composition of it; `substeps` - integrator steps per data interval, a whole number of at least 1.

    **Raises:** `InputError` where the integrator has no doubled space; `TypeError` where it cannot step the system.
    """

    system: Any
    integrator: Any
    substeps: int = eqx.field(static=True, default=1)

    def __check_init__(self):
        refuse_count("DoubledPropagator", "substeps", self.substeps)
        _require_two_copies(self.integrator)
        self.integrator.accepts(self.system)

    def __call__(self, state: Float[Array, " doubled"], interval: Interval) -> Float[Array, " doubled"]:
        return ig.advance(self.system, self.integrator, state, interval.start, interval.end, self.substeps)


class DoubledObservation(eqx.Module):
    """A reading of a doubled state: h(projection(copies), context). Made by `doubled_observation`.

    For an h or a projection that is not linear; the other kind is `AffineDoubledObservation`.
    """

    observation: Any
    projection: ig.AbstractProjection

    def __call__(self, state: Float[Array, " doubled"], context: Any = None) -> Float[Array, " channel"]:
        return self.observation(_point(self.projection, state), context)


class AffineDoubledObservation(AbstractAffine):
    """The same for an affine h and a linear projection: a filter treats it exactly. Made by `doubled_observation`.

    **Raises:** `InputError` where the observation or the projection is not known to be affine.
    """

    observation: Any
    projection: ig.AbstractProjection

    def __check_init__(self):
        if not _is_affine(self.observation, self.projection):
            raise InputError(
                "`AffineDoubledObservation` needs an `AbstractAffine` and `FirstCopy` or `MeanOfCopies`, but was given "
                f"`{type(self.observation).__name__}` and `{type(self.projection).__name__}`; use "
                "`doubled_observation`."
            )

    def slope(self, x: Float[Array, " doubled"]) -> Float[Array, "channel doubled"]:
        matrix = jax.vmap(lambda axis: _point(self.projection, axis), out_axes=1)(jnp.eye(x.shape[0], dtype=x.dtype))
        return self.observation.slope(_point(self.projection, x)) @ matrix

    def __call__(self, x: Float[Array, " doubled"], context: Any = None) -> Float[Array, " channel"]:
        return self.observation(_point(self.projection, x), context)


def doubled_observation(
    observation: Any, projection: ig.AbstractProjection
) -> DoubledObservation | AffineDoubledObservation:
    """An observation of the phase point read through `projection`; an `AbstractAffine` only where both are affine."""
    kind = AffineDoubledObservation if _is_affine(observation, projection) else DoubledObservation
    return kind(observation, projection)


class AbstractDraws(eqx.Module):
    """How a noise of the phase point enters its two copies."""

    @abc.abstractmethod
    def __call__(self, root: Float[Array, "two_d column"]) -> Float[Array, "doubled _"]:
        """A square root of the doubled covariance, from a square root of Q."""


class SharedDraw(AbstractDraws):
    """One draw for both copies: [[Q, Q], [Q, Q]], which is singular and keeps equal copies equal.

    The phase point, first copy or mean, then has the noise Q, as the projected model has.
    """

    def __call__(self, root):
        return jnp.concatenate([root, root])


class IndependentDraws(AbstractDraws):
    """A draw for each copy: [[Q, 0], [0, Q]]. The copies part: their difference has 2 Q, their mean only Q / 2."""

    def __call__(self, root):
        return jax.scipy.linalg.block_diag(root, root)


class DoubledNoise(AbstractNoise):
    """An added noise of the phase point, put into both copies as `draws` says.

    `noise` is an `AdditiveGaussian`, `Additive` or `WienerIncrement`, or any module with `covariance(interval)`.

    **Raises:** `InputError` for `Multiplicative` noise.
    """

    noise: Any
    draws: AbstractDraws = eqx.field(default_factory=SharedDraw)

    def __check_init__(self):
        if isinstance(self.noise, Multiplicative):
            raise InputError(
                "A doubled model needs process noise that is added, but was given `Multiplicative`; keep the "
                "projected model, or use `AdditiveGaussian`."
            )

    def covariance(self, interval: Any = None) -> Float[Array, "doubled doubled"]:
        """The covariance of one draw."""
        factor = self.draws(semidefinite_cholesky(self.noise.covariance(interval)))
        return factor @ factor.T

    def enter(self, moments: Moments, interval: Any = None) -> Moments:
        # Mean and factor of the noise itself: what it makes of a phase point that is known to be 0.
        size = moments.mean.shape[0] // 2
        nothing = jnp.zeros((size, 0))
        alone = enter(self.noise, Moments(jnp.zeros(size), nothing, nothing), interval)
        shifted = moments._replace(mean=moments.mean + jnp.tile(alone.mean, 2))
        return with_noise(shifted, self.draws(alone.factor))


class LiftedGaussian(AbstractKnown):
    """The initial distribution of a doubled state whose copies are equal: N([m, m], [[P, P], [P, P]]).

    `point` is the `Gaussian` of the phase point; what learns in it, learns here.
    """

    point: Gaussian

    @property
    def mean(self) -> Float[Array, " doubled"]:
        return jnp.tile(jnp.asarray(self.point.mean), 2)

    @property
    def covariance(self) -> Float[Array, "doubled doubled"]:
        return self.root @ self.root.T

    @property
    def root(self) -> Float[Array, "doubled doubled"]:
        """Lower triangular, root root' = covariance; exact, where a Cholesky factor of a singular matrix is not."""
        root = self.point.root
        return jnp.concatenate([jnp.tile(root, (2, 1)), jnp.zeros((2 * root.shape[0], root.shape[0]))], axis=1)


def doubled(
    model: StateSpaceModel,
    projection: ig.AbstractProjection | None = None,
    draws: AbstractDraws | None = None,
) -> StateSpaceModel:
    """The twin of a projected model on the doubled phase space: same system, noises, readings and initial law.

    Its states are [q, p, x, y]; `doubled_observation(FullState(), projection)` reads their phase points, and its slope
    turns their covariances into those of the phase points. Filter it with `doubled_transform(transform)`, or its sigma
    points lie farther out than the projected model's.

    **Arguments:** `model` - its dynamics a `Propagator` with `integrators.Tao` or a composition of it; `projection` -
    how the doubled state is read, by default as the integrator does; `draws` - how the process noise enters,
    `SharedDraw()` by default, or `IndependentDraws()`.

    **Raises:** `InputError` where the model is no `StateSpaceModel`, its dynamics is no `Propagator`, its integrator
    has no doubled space, its process noise is multiplied, or its initial distribution is missing.
    """
    if not isinstance(model, StateSpaceModel) or not isinstance(model.dynamics, Propagator):
        given = type(getattr(model, "dynamics", model)).__name__
        raise InputError(f"`doubled` needs a `StateSpaceModel` whose dynamics is a `Propagator`, but found `{given}`.")
    _require_two_copies(model.dynamics.integrator)
    if model.initial is None:
        raise InputError("`doubled` needs a model with an `initial` distribution, but it is None; give a `Gaussian`.")
    step = model.dynamics
    several = isinstance(model.initial, tuple)
    return StateSpaceModel(
        DoubledPropagator(step.system, step.integrator, step.substeps),
        doubled_observation(model.observation, _own_projection(step.integrator) if projection is None else projection),
        DoubledNoise(model.process_noise, SharedDraw() if draws is None else draws),
        model.measurement_noise,
        tuple(map(LiftedGaussian, model.initial)) if several else LiftedGaussian(model.initial),
    )


def doubled_transform(transform: UnscentedTransform) -> UnscentedTransform:
    """The unscented transform that has on the doubled space the moments `transform` has on the phase space.

    Sigma points lie sqrt(alpha^2 (d + kappa)) standard deviations out, so twice the dimension alone would move them and
    with them the likelihood, which is no merit of either filter. Where the copies are equal, the moments are the same.
    """
    alpha, beta, kappa = transform.alpha, transform.beta, transform.kappa
    return UnscentedTransform(alpha / math.sqrt(2.0), beta - 0.5 * alpha**2, 2.0 * kappa)


def _require_two_copies(integrator: Any) -> None:
    copies = getattr(integrator, "copies", None)
    if copies != 2:
        raise InputError(
            f"A doubled model needs an integrator that steps two copies of the phase point, but `"
            f"{type(integrator).__name__}` has no doubled space; use `integrators.Tao()`, or keep the projected model."
        )


def _own_projection(integrator: Any) -> ig.AbstractProjection:
    """How an integrator reads its own doubled state; a composition reads as its base does."""
    while isinstance(integrator, ig.Composition):
        integrator = integrator.base
    projection = getattr(integrator, "projection", None)
    if projection is None:
        raise InputError(
            f"`{type(integrator).__name__}` does not say how its copies are read; give `doubled` a `projection`, as "
            "`integrators.MeanOfCopies()`."
        )
    return projection


def _is_affine(observation: Any, projection: Any) -> bool:
    """Of projections only the two known ones count: another may be anything."""
    return isinstance(observation, AbstractAffine) and isinstance(projection, ig.FirstCopy | ig.MeanOfCopies)


def _point(projection: ig.AbstractProjection, state: Float[Array, " doubled"]) -> Float[Array, " two_d"]:
    return projection(state.reshape(2, -1))
