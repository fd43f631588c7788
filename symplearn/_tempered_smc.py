"""Tempered sequential Monte Carlo: particles that are led from a wide density to the posterior, with its evidence."""

import math
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import gammaln, logsumexp
from jaxtyping import Array, Float, PRNGKeyArray

from ._blackjax import blackjax
from ._blocks import Course, run_blocks
from ._errors import InputError
from ._sampler import AbstractBlockSampler, Drawn, LogDensity, refuse_counts, whitened
from ._whitening import Whitening

# The best share of accepted steps in many dimensions. Roberts, Gelman and Gilks (1997).
_ACCEPTED = 0.234
# How many steps go the whole way from one particle to another, which may lie in another mode.
_JUMPS = 0.1


class TemperedSMC(AbstractBlockSampler):
    """Tempered sequential Monte Carlo, for posteriors with several modes. Del Moral et al. (2006), JRSS B 68, 411.

    Independent `runs`, as one vmapped program, each lead `lines` times `length` particles from a Student density, of
    `dof` degrees of freedom and `reach` times the whitening's scale about the start, to the density, along the powers
    between the two; each power is chosen so that the effective size falls to the share `keep`. **The prior is not the
    first density**: it may be improper. A mode that no particle of the first density leads to is not found: then take a
    larger `reach`.

    At each power `lines` particles are resampled, and each walks `length` - 1 times `thin` steps, of which every
    `thin`-th makes a particle (waste-free: Dau and Chopin 2022, JRSS B 84); None is as many as there are parameters.
    **Walks that are too short leave all runs the same error, which R-hat does not see**: the evidence then moves with
    `length`. A step is the difference of two particles, scaled to an acceptance of 23.4 %, or whole,
    which leads from mode to mode (ter Braak 2006, Stat. Comput. 16). Particles of one line stay side by side, so that
    the effective sample size knows their kinship, and R-hat compares the runs. The evidence is the mean of the runs',
    its standard error their spread's.

    **Raises:** `InputError` where a number is out of its range, no first particle has a finite density, or `powers`
    do not lead to the density.
    """

    runs: int = 8
    lines: int = 128
    length: int = 16
    thin: int | None = None
    keep: float = 0.5
    reach: float = 4.0
    dof: float = 4.0
    powers: int = 200

    def __check_init__(self):
        refuse_counts(self, runs=2, lines=4, length=2, powers=1)
        if self.thin is not None:
            refuse_counts(self, thin=1)
        if not 0 < self.keep < 1:
            raise InputError(f"`TemperedSMC` needs `keep` between 0 and 1, but was given {self.keep}.")
        if not (self.reach > 0 and self.dof > 0):
            raise InputError(
                f"`TemperedSMC` needs `reach` and `dof` above 0, but was given {self.reach} and {self.dof}."
            )

    def draw_in(self, course: Course, density: LogDensity, start: Whitening, key: PRNGKeyArray) -> Drawn:
        end = _led(self, course, density, Whitening(start.centre, start.root), key)
        possible, power = np.asarray(end.possible), np.asarray(end.power)
        if not np.all(possible > 0):
            raise InputError(
                f"None of the first {self.lines * self.length} particles has a finite log density; lower the `reach`, "
                "or start nearer to the mode."
            )
        if not np.all(power == 1.0):
            raise InputError(f"{self.powers} powers led to {np.min(power):.2g} of 1; take more, or a lower `reach`.")
        evidences, rounds = np.asarray(end.log_evidence), np.asarray(end.rounds)
        moves = self.lines * (self.length - 1) * (self.thin or start.centre.size)
        return Drawn(
            start.free(end.z),
            end.log_density - start.log_volume,
            evaluations=int(self.runs * self.lines * self.length + rounds.sum() * moves),
            accepted=float(jnp.mean(end.accepted)),
            log_evidence=float(logsumexp(end.log_evidence)) - math.log(self.runs),
            log_evidence_sd=float(np.std(evidences, ddof=1) / self.runs**0.5),
            remarks=(
                f"{self.runs} runs of {self.lines * self.length} particles through {rounds.min()} to {rounds.max()} "
                f"powers, from a Student density {self.reach:g} times as wide as the whitening.",
            ),
        )


class _Particles(NamedTuple):
    """The particles of one run, (line, place on it) in one row, and what it has found.

    `log_ratio` is the log density less that of the first density, -inf where impossible.
    """

    z: Float[Array, "particle parameter"]
    log_density: Float[Array, " particle"]
    log_ratio: Float[Array, " particle"]
    power: Array
    log_evidence: Array
    log_scale: Array
    accepted: Array
    rounds: Array
    possible: Array  # share of first particles with a finite density


def _led(
    options: TemperedSMC, course: Course, density: LogDensity, whitening: Whitening, key: PRNGKeyArray
) -> _Particles:
    """The particles of all runs at power 1, or where `powers` were not enough."""

    def done(particles: _Particles) -> int:
        return int(jnp.max(particles.rounds)) if bool(jnp.any(_going(particles))) else options.powers

    def line(particles: _Particles) -> str:
        return f"{int(jnp.max(particles.rounds))} powers, at {float(jnp.min(particles.power)):.2g} of 1"

    first_key, key = jax.random.split(key)
    state = course.resumed(lambda: eqx.filter_eval_shape(_begun, options, density, whitening, first_key))
    state = run_blocks(
        course,
        lambda particles, count: _advance(options, density, whitening, particles, key, count),
        _begun(options, density, whitening, first_key) if state is None else state,
        done,
        options.powers,
        line,
    )
    if course.interrupted:
        raise KeyboardInterrupt  # particles on their way stand for nothing yet
    return state


@eqx.filter_jit
def _begun(options, density, whitening, key):
    log_density = whitened(density, whitening)
    keys = jax.random.split(key, options.runs)
    particles = jax.vmap(lambda key: _first(options, log_density, whitening.centre.size, key))(keys)
    # Strong types: with weak ones a state from a file would compile anew.
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, leaf.dtype), particles)


@eqx.filter_jit
def _advance(options, density, whitening, particles, key, count):
    """Some powers more, of the runs that have not come to 1."""
    log_density = whitened(density, whitening)

    def one(particles, key):
        new = _advanced(options, log_density, particles, jax.random.fold_in(key, particles.rounds))
        return jax.tree.map(lambda new, old: jnp.where(_going(particles), new, old), new, particles)

    def unfinished(carry):
        return (carry[0] < count) & jnp.any(_going(carry[1]))

    def all_runs(carry):
        return carry[0] + 1, jax.vmap(one)(carry[1], jax.random.split(key, options.runs))

    return jax.lax.while_loop(unfinished, all_runs, (jnp.zeros_like(count), particles))[1]


def _going(particles):
    return (particles.power < 1.0) & (particles.possible > 0)


def _first(options, log_density, size, key):
    """Draws of the first density."""
    normal_key, stretch_key = jax.random.split(key)
    count = options.lines * options.length
    normal = jax.random.normal(normal_key, (count, size))
    chi2 = 2.0 * jax.random.gamma(stretch_key, 0.5 * options.dof, (count, 1))
    z = options.reach * normal * jnp.sqrt(options.dof / chi2)
    heights = jax.vmap(log_density)(z)
    log_ratio = heights - _student(options, z)
    start = jnp.asarray(math.log(2.38 / math.sqrt(2 * size)))
    zero = jnp.zeros(())
    rounds, possible = jnp.zeros((), int), jnp.mean(jnp.isfinite(log_ratio))
    return _Particles(z, heights, log_ratio, zero, zero, start, zero, rounds, possible)


def _student(options: TemperedSMC, z: Array) -> Array:
    """The log of the first density."""
    size, dof = z.shape[-1], options.dof
    norm = gammaln(0.5 * (dof + size)) - gammaln(0.5 * dof) - 0.5 * size * math.log(dof * math.pi * options.reach**2)
    return norm - 0.5 * (dof + size) * jnp.log1p(jnp.sum((z / options.reach) ** 2, axis=-1) / dof)


def _advanced(options, log_density, particles, key):
    """The particles at the next power."""
    # Not blackjax's `adaptive_tempered_smc`: it chooses the power by particles without their weights, evaluates the
    # density of each two times more (for the choice and for the weights), which for waste-free lines triples the cost,
    # leaves the last particles weighted and not moved, and makes NaN of an impossible particle at power 0.
    possible = jnp.isfinite(particles.log_ratio)
    least = jnp.log(options.keep * jnp.maximum(jnp.sum(possible), 1))
    ratio = jnp.where(possible, particles.log_ratio, 0.0)

    def log_weights(step):
        return jnp.where(possible, step * ratio, -jnp.inf)

    left = 1.0 - particles.power
    smc = blackjax().smc
    step = smc.solver.dichotomy(lambda step: smc.ess.log_ess(log_weights(step)) - least, jnp.zeros(()), left)
    weights = log_weights(step)
    total = logsumexp(weights)
    # The last step is exact, whatever rounding does to the sum.
    power = jnp.where(step >= left, 1.0, particles.power + step)
    resample_key, move_key = jax.random.split(key)
    moved = _moved(options, log_density, particles, power, jnp.exp(weights - total), resample_key, move_key)
    return moved._replace(power=power, log_evidence=particles.log_evidence + total - math.log(len(weights)))


def _moved(options, log_density, particles, power, weights, resample_key, move_key):
    """Lines that start at resampled particles and walk at a power."""
    pool_key, line_key = jax.random.split(resample_key)
    # The steps' differences are of particles of the past power: a walk that looked at itself would not be reversible.
    pool = particles.z[blackjax().smc.resampling.systematic(pool_key, weights, len(weights))]
    rows = blackjax().smc.resampling.systematic(line_key, weights, options.lines)
    size, scale = pool.shape[1], jnp.exp(particles.log_scale)

    def difference(key, _):
        pair_key, jump_key, jitter_key = jax.random.split(key, 3)
        one, other = jax.random.randint(pair_key, (2,), 0, len(pool))
        jump = jax.random.uniform(jump_key) < _JUMPS
        # The jitter makes every point reachable.
        jitter = 1e-4 * jax.random.normal(jitter_key, (size,))
        return jnp.where(jump, 1.0, scale) * (pool[one] - pool[other]) + jitter

    def tempered(z):
        height = log_density(z)
        return power * height + (1.0 - power) * _student(options, z)

    kernel = blackjax().additive_step_random_walk(tempered, difference)

    def walk(state, key):
        def once(state, key):
            state, info = kernel.step(key, state)
            return state, info.acceptance_rate

        state, accepted = jax.lax.scan(once, state, jax.random.split(key, options.thin or size))
        return state, (state.position, state.logdensity, jnp.mean(accepted))

    def line(z, height, key):
        _, (positions, heights, accepted) = jax.lax.scan(
            walk, _walker(z, height), jax.random.split(key, options.length - 1)
        )
        return jnp.concatenate([z[None], positions]), jnp.concatenate([height[None], heights]), jnp.mean(accepted)

    begin = particles.z[rows]
    heights = power * particles.log_density[rows] + (1.0 - power) * _student(options, begin)
    z, heights, accepted = jax.vmap(line)(begin, heights, jax.random.split(move_key, options.lines))
    z, heights, rate = z.reshape(-1, size), heights.reshape(-1), jnp.mean(accepted)
    student = _student(options, z)
    found = (heights - (1.0 - power) * student) / power
    return particles._replace(
        z=z,
        log_density=found,
        log_ratio=found - student,
        log_scale=particles.log_scale + 2.0 * (rate - _ACCEPTED),
        accepted=rate,
        rounds=particles.rounds + 1,
    )


def _walker(z: Array, height: Array) -> Any:
    """blackjax's state of a walk, of a density known already."""
    return blackjax().mcmc.random_walk.RWState(z, height)
