"""Pathfinder: normal approximations along the way up to the mode, weighed against the density."""

import dataclasses
import math
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray
from scipy.special import logsumexp

from ._blackjax import blackjax
from ._blocks import Course, run_blocks
from ._errors import InputError
from ._importance import WeightedSample, densities, refuse_nothing, resampled
from ._sampler import AbstractBlockSampler, Drawn, LogDensity, generator, refuse_counts, whitened
from ._whitening import Whitening

# Pairs of steps and slopes that L-BFGS keeps, and evaluations in one of its line searches.
_LIMITS = {"maxcor": 10, "maxls": 20}
# Draws on which the normals of a path are compared.
_COMPARED = 20


class Pathfinder(AbstractBlockSampler):
    """Draws of normal approximations found on the way to the mode. Zhang et al. (2022), JMLR 23, 306.

    `paths` runs of at most `steps` of L-BFGS, by blackjax, start at normal draws about the mode of `reach` times its
    scale. On each the normal with the largest ELBO is taken, and `draws` are drawn of their mixture and **importance
    resampled**: with a Pareto k below 0.7 they stand for the density, above it the diagnostics say that they do not. A
    first look, and a check of the Laplace approximation. A mode that no path leads to, or a tail much heavier than a
    normal one, is missed, and no number here tells.

    **Raises:** `InputError` where a number is too small, or no draw has a finite density.
    """

    draws: int = 4000
    paths: int = 4
    steps: int = 40
    reach: float = 2.0

    def __check_init__(self):
        refuse_counts(self, draws=16, paths=1, steps=2)
        if not self.reach > 0:
            raise InputError(f"`Pathfinder` needs a `reach` above 0, but was given {self.reach}.")

    def draw_in(self, course: Course, density: LogDensity, start: Whitening, key: PRNGKeyArray) -> Drawn:
        path_key, draw_key = jax.random.split(key)
        found = _found(self, course, density, Whitening(start.centre, start.root), path_key)
        random, mixture = generator(draw_key), _mixture(found)
        z = mixture.sample(random, self.draws)
        log_density = densities(density, start, z)
        log_weights = log_density - mixture.log_density(z)
        refuse_nothing(log_weights)
        positions = self.paths * (self.steps + 1)
        spent = self.draws + positions * (_COMPARED + 1)
        drawn = resampled(WeightedSample(z, log_density, log_weights, spent), start, self.draws, random)
        remark = f"Importance resampled from the normal densities that {len(mixture.means)} paths of Pathfinder met."
        # blackjax does not tell how many slopes the line searches took; a position has one at least.
        return dataclasses.replace(drawn, gradients=positions, remarks=(remark,))


@dataclasses.dataclass(frozen=True)
class _Normals:
    """Normal densities of equal share."""

    means: np.ndarray
    roots: np.ndarray

    def sample(self, random: np.random.Generator, count: int) -> np.ndarray:
        which = random.permutation(np.arange(count) % len(self.means))
        normal = random.normal(size=(count, self.means.shape[1]))
        return self.means[which] + np.einsum("nij,nj->ni", self.roots[which], normal)

    def log_density(self, z: np.ndarray) -> np.ndarray:
        parts = []
        for mean, root in zip(self.means, self.roots, strict=True):
            white = np.linalg.solve(root, (z - mean).T)
            norm = 0.5 * len(mean) * math.log(2 * math.pi) + np.sum(np.log(np.diagonal(root)))
            parts.append(-0.5 * np.sum(white**2, axis=0) - norm)
        return logsumexp(parts, axis=0) - math.log(len(parts))


class _Paths(NamedTuple):
    """The best normal density of each path, in whitened coordinates, and the paths done."""

    elbo: Float[Array, " path"]
    mean: Float[Array, "path parameter"]
    covariance: Float[Array, "path parameter parameter"]
    done: Int[Array, ""]


def _found(options: Pathfinder, course: Course, density: LogDensity, start: Whitening, key: PRNGKeyArray) -> _Paths:
    def begin() -> _Paths:
        count, size = options.paths, start.centre.size
        none = jnp.zeros((count, size)), jnp.zeros((count, size, size))
        return _Paths(jnp.full(count, -jnp.inf), *none, jnp.zeros((), int))

    state = course.resumed(begin)
    state = run_blocks(
        course,
        lambda state, count: _more(options, density, start, state, key, count),
        begin() if state is None else state,
        lambda state: int(state.done),
        options.paths,
        lambda state: f"path {int(state.done)} of {options.paths}",
    )
    if course.interrupted:
        raise KeyboardInterrupt
    return state


def _mixture(found: _Paths) -> _Normals:
    useful = np.isfinite(np.asarray(found.elbo)) & np.isfinite(np.asarray(found.covariance)).all(axis=(1, 2))
    if not useful.any():
        raise InputError(f"None of {len(useful)} paths met a finite log density; start nearer to the mode.")
    return _Normals(np.asarray(found.mean)[useful], np.linalg.cholesky(np.asarray(found.covariance)[useful]))


@eqx.filter_jit
def _more(options, density, whitening, paths, key, count):
    """Some paths more, one after the other: side by side each would wait for the longest line search."""
    log_density = whitened(density, whitening, slopes=True)

    def one(_, paths):
        begin_key, walk_key, elbo_key = jax.random.split(jax.random.fold_in(key, paths.done), 3)
        begin = options.reach * jax.random.normal(begin_key, whitening.centre.shape)
        limits = {"num_samples": 1, "maxiter": options.steps, **_LIMITS}
        _, info = blackjax().vi.pathfinder.approximate(walk_key, log_density, begin, **limits)
        elbo, mean, covariance = _best(log_density, info.path, elbo_key)
        at = paths.done
        return _Paths(
            paths.elbo.at[at].set(elbo), paths.mean.at[at].set(mean), paths.covariance.at[at].set(covariance), at + 1
        )

    return jax.lax.fori_loop(0, count, one, paths)


def _best(log_density, path, key):
    """The normal density with the largest ELBO on a path: that, its mean and its covariance."""

    # blackjax 1.7.1 steps from each position along the slope of minus the log density, away from the mode, so that its
    # means are wrong wherever the slope is not zero, and with them its ELBOs; and it leaves out the last position. Its
    # path and its factors of the inverse Hessian are right: here they are scored again.
    def elbo(data):
        key, state = data
        z, log_q = blackjax().optimizers.lbfgs.bfgs_sample(
            key, _COMPARED, state.position, -state.grad_position, state.alpha, state.beta, state.gamma
        )
        return jnp.mean(jax.vmap(log_density)(z) - log_q)

    elbos = jax.vmap(elbo)((jax.random.split(key, len(path.elbo)), path))
    best = jnp.argmax(jnp.where(jnp.isfinite(elbos), elbos, -jnp.inf))
    state = jax.tree.map(lambda one: one[best], path)
    covariance = blackjax().optimizers.lbfgs.lbfgs_inverse_hessian_formula_1(state.alpha, state.beta, state.gamma)
    return elbos[best], state.position - covariance @ state.grad_position, 0.5 * (covariance + covariance.T)
