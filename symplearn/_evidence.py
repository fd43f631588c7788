"""Laplace's approximation of the evidence, and of the posterior around its mode."""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ._fit import Estimate
from ._log_posterior import gradient, negative_log_posterior
from ._parameters import flatten, named_parameters, value_of
from ._prior import Flat, Laplace, Prior


class LaplaceApproximation(eqx.Module):
    """The posterior of the free coordinates as a Gaussian at the MAP.

    `log_evidence` in nats is log p(readings), or None where the approximation does not hold; `statement`
    says why. `hessian` (parameter, parameter) is that of minus the log posterior, `covariance` its inverse,
    in free coordinates: log v for a `Positive` v. Under a `Flat` prior evidences compare only models with
    the same flat leaves.
    """

    log_evidence: float | None
    hessian: Float[Array, "parameter parameter"] | None
    covariance: Float[Array, "parameter parameter"] | None
    sds: dict[str, Array] | None
    statement: str

    @property
    def valid(self) -> bool:
        """Whether the approximation holds at all."""
        return self.log_evidence is not None

    def __str__(self) -> str:
        number = "none" if self.log_evidence is None else f"{self.log_evidence:.3f} nats"
        return f"Laplace log evidence: {number}. {self.statement}"


def laplace_evidence(estimate: Estimate) -> LaplaceApproximation:
    """log posterior at the MAP + d/2 log 2 pi - 1/2 log det Hessian. Tierney and Kadane (1986).

    Exact where the posterior is Gaussian in the free coordinates. It does not hold where the fit did not
    converge, at the kink of a Laplace prior, or where the Hessian is not positive definite, as on a ridge or
    at the edge of a parameter's range; the result then says so instead of giving a number. `sds` are standard
    deviations of the learnt values, by name, to first order.
    """
    if not estimate.converged:
        return _invalid("the fit did not converge")
    kinks = _at_a_kink(estimate)
    if kinks:
        return _invalid(f"{', '.join(kinks)} is at the kink of its Laplace prior, where there is no Hessian")
    hessian, slopes = _hessian(estimate, estimate.prior), _value_slopes(estimate.model)
    fault = _indefinite(hessian)
    if fault:
        return _invalid(fault)
    size = hessian.shape[0]
    covariance = jnp.linalg.inv(hessian)
    log_det = float(jnp.linalg.slogdet(hessian)[1])
    evidence = estimate.log_posterior + 0.5 * size * math.log(2 * math.pi) - 0.5 * log_det
    sds = _by_name(estimate, jnp.sqrt(jnp.diagonal(slopes @ covariance @ slopes.T)))
    return LaplaceApproximation(evidence, hessian, covariance, sds, _statement(estimate))


def _invalid(reason: str) -> LaplaceApproximation:
    return LaplaceApproximation(None, None, None, None, f"Not valid: {reason}.")


def _indefinite(hessian: Array) -> str:
    """What is wrong with a Hessian that is not positive definite; nothing with one that is."""
    if not bool(jnp.all(jnp.isfinite(hessian))):
        return "the Hessian at the MAP is not finite"
    eigenvalues = np.linalg.eigvalsh(hessian)
    # Differences of gradients do not resolve eigenvalues below a relative 1e-10.
    if not eigenvalues[0] > 1e-10 * eigenvalues[-1]:
        return f"the Hessian at the MAP is not positive definite: an eigenvalue is {eigenvalues[0]:.3g}"
    return ""


def _at_a_kink(estimate: Estimate) -> list[str]:
    """The leaves with an entry that a Laplace prior holds at zero."""
    held = []
    for name, value in estimate.values().items():
        density = estimate.prior.density_of(name)
        # BFGS stops within this share of the scale around a kink; other optima are there by accident only.
        if isinstance(density, Laplace) and bool(jnp.any(jnp.abs(value) < 1e-6 * density.scale)):
            held.append(name)
    return held


def likelihood_hessian(estimate: Estimate) -> Float[Array, "parameter parameter"]:
    """The Hessian of minus the log likelihood at the estimate, in free coordinates: the observed information."""
    return _hessian(estimate, None)


def _hessian(estimate: Estimate, prior: Prior | None) -> Array:
    """The Hessian of minus the log posterior: central differences of its exact gradient.

    Steps of a thousandth of a standard deviation leave a relative error of about 1e-7. A second automatic
    derivative of the filter is exact but takes five times as long to compile.
    """
    size = flatten(estimate.model)[0].size
    crude = jnp.diagonal(_differences(estimate, prior, jnp.full(size, 1e-4)))
    steps = jnp.where(crude > 0, 1e-3 / jnp.sqrt(jnp.where(crude > 0, crude, 1.0)), 1e-4)
    hessian = _differences(estimate, prior, steps)
    return 0.5 * (hessian + hessian.T)


def _differences(estimate: Estimate, prior: Prior | None, steps: Array) -> Array:
    gradients = _gradients(
        estimate.model,
        estimate.recording,
        estimate.objective,
        prior,
        jnp.concatenate([jnp.diag(steps), -jnp.diag(steps)]),
    )
    return (gradients[: steps.size] - gradients[steps.size :]) / (2 * steps[:, None])


@eqx.filter_jit
def _gradients(model, series, objective, prior, offsets):
    """Gradients of minus the log posterior beside the MAP, one per row of `offsets`."""
    free, rebuild = flatten(model)

    def score(free):
        return negative_log_posterior(rebuild(free), series, objective, prior)

    derivative = gradient(score, free.size)
    # One after the other: a batch of gradients takes twice as long to compile.
    return jax.lax.map(lambda offset: derivative(free + offset), offsets)


@eqx.filter_jit
def _value_slopes(model):
    """The derivative of the learnt values by the free coordinates."""
    free, rebuild = flatten(model)

    def values(free):
        leaves = named_parameters(rebuild(free)).values()
        return jnp.concatenate([jnp.ravel(value_of(leaf)) for leaf in leaves])

    return jax.jacfwd(values)(free)


def _by_name(estimate: Estimate, numbers: Array) -> dict[str, Array]:
    """Cut one number per learnt entry into the shapes of the leaves."""
    shapes = {name: np.shape(value) for name, value in estimate.values().items()}
    ends = np.cumsum([math.prod(shape) for shape in shapes.values()])
    pieces = jnp.split(numbers, ends[:-1])
    return {name: piece.reshape(shape) for (name, shape), piece in zip(shapes.items(), pieces, strict=True)}


def _statement(estimate: Estimate) -> str:
    flat = [name for name in estimate.values() if isinstance(estimate.prior.density_of(name), Flat)]
    if not flat:
        return "The Hessian is positive definite."
    return f"Relative to the improper flat prior of {', '.join(flat)}."
