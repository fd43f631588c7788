"""The Kalman filter of linear models with all readings side by side, by an associative scan, in square-root form.

Sarkka and Garcia-Fernandez (2021), "Temporal parallelization of Bayesian smoothers", IEEE TAC 66(1), section IV; with
square roots as in Yaghoobi, Corenflos, Hassan and Sarkka (2022), "Parallel square-root statistical linear regression
for inference in general state space models". Its depth grows as log n.
"""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ._errors import InputError
from ._faults import IMPOSSIBLE, Fault, is_fatal
from ._filter_step import AbstractPassage, Carry, begin, measure, unscored
from ._guard import guard
from ._model import AbstractAffine, StateSpaceModel, slice_at
from ._noise import Additive, AdditiveGaussian, WienerIncrement
from ._small_products import product
from ._transforms import Taylor
from ._triangular import forward_substitution, triangularise

_ADDED = AdditiveGaussian | WienerIncrement | Additive
# Affine parts are exact whatever the transform.
_EXACT = Taylor()


class ParallelInTime(AbstractPassage):
    """All readings side by side: the same numbers as `Sequential`, in a number of rounds that grows with log n.

    For models with affine dynamics and observation and noise that is added; the moments' transform does not matter. It
    does far more work in all than `Sequential`, so it pays for long recordings on a GPU. A channel that is read without
    error has to be reached by the process noise of each single interval: the filter fails with `Fault.SINGULAR`
    otherwise, even where `Sequential` would go on from what it knew before. Sarkka and Garcia-Fernandez (2021).

    **Raises:** `InputError`, at the first use, for any other model.
    """

    def run(self, model, readings, intervals, contexts, transform, keep):
        _refuse_nonlinear(model)
        model, readings, intervals, contexts = guard((model, readings, intervals, contexts))
        first, one = begin(model, _EXACT, readings[0], slice_at(contexts, 0))
        later = readings[1:], intervals, jax.tree.map(lambda leaf: leaf[1:], contexts)
        elements, good = jax.vmap(lambda *data: _element(model, *data))(*later)
        elements = jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), _known(first), elements)
        filtered = _prefixes(elements)
        before = filtered.mean[:-1], filtered.root[:-1]
        steps = jax.vmap(jax.checkpoint(lambda *data: _step(model, *data)))
        after, records = steps(*before, good, *later, np.arange(1, len(readings)))
        carry, increments = _added_up(jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), first, after))
        records = jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), one, records)
        return carry, records._replace(increment=increments)


class _Element(NamedTuple):
    """What some neighbouring readings y say of the states x before and z after them, as functions of both.

    p(z | x, y) = N(z; slope x + mean, root root') and p(y | x) = exp(score' x - x' precision x / 2) but for a factor,
    with precision = information information'.
    """

    slope: Array
    mean: Array
    root: Array
    score: Array
    information: Array


def _prefixes(elements):
    """The elements of all readings up to each one, by the scan of Hillis and Steele (1986), CACM 29(12).

    In round i each takes in what the one 2^i places before it has gathered: ceil(log2 n) rounds of n combinations, and
    one program for every round. `jax.lax.associative_scan` has fewer combinations in twice the rounds, each a program
    of its own: its gradient over 40 readings took 73 s to compile, where this one's took 20.
    """
    count, size = elements.mean.shape
    # What changes nothing stands before the first one.
    still = jax.tree.map(jnp.zeros_like, elements)._replace(slope=jnp.tile(jnp.eye(size), (count, 1, 1)))

    # Only what enters a round is kept for its derivative.
    @functools.partial(jax.checkpoint, prevent_cse=False)
    def join(gathered, reach):
        longer = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), still, gathered)
        before = jax.tree.map(lambda leaf: jax.lax.dynamic_slice_in_dim(leaf, count - reach, count), longer)
        return jax.vmap(_together)(before, gathered), None

    return jax.lax.scan(join, elements, 2 ** np.arange((count - 1).bit_length()))[0]


def _known(carry):
    """The element up to a state whose distribution is known: what was before does not matter."""
    nothing = jnp.zeros_like(carry.root)
    return _Element(nothing, carry.mean, carry.root, jnp.zeros_like(carry.mean), nothing)


def _element(model, reading, interval, context):
    """The element of one data interval and the reading at its end; and whether there is one."""
    size = jnp.asarray(model.initial.mean).shape[0]
    shift, F, Q_root = _parts(model.predict, size, interval)
    offset, H, R_root = _parts(model.read, size, context)
    seen = ~jnp.isnan(reading)
    H, R_root = (jnp.where(seen[:, None], rows, 0.0) for rows in (H, R_root))
    r = jnp.where(seen, jnp.where(seen, reading, 0.0) - offset - product(H, shift), 0.0)
    channels = len(reading)
    above = jnp.concatenate([product(H, Q_root), R_root], axis=1)
    below = jnp.concatenate([Q_root, jnp.zeros((size, R_root.shape[1]))], axis=1)
    triangle, good = triangularise(jnp.concatenate([above, below]))
    S_root, G = triangle[:channels, :channels], triangle[channels:, :channels]
    e, V = forward_substitution(S_root, r), _solved(S_root, product(H, F))
    element = _Element(
        F - product(G, V), shift + product(G, e), triangle[channels:, channels:], product(V.T, e), _square(V.T)
    )
    return element, jnp.all(good[:channels] | ~seen)


def _parts(part, size, record):
    """Offset, slope and square root of the noise of an affine part of the model."""
    moments = part(_EXACT, jnp.zeros(size), jnp.eye(size), record)
    return moments.mean, moments.factor[:, :size], moments.factor[:, size:]


def _together(i, j):
    """The element of the readings of i and then of j.

    With C = U U' of i and J = Z Z' of j and M = U' Z: [M, 1; Z, 0] -> [W, 0; X, Y], W W' = 1 + M M'. Then T = U W'^-1
    has T T' = (1 + C J)^-1 C, and Y Y' = (1 + J C)^-1 J. No difference of large numbers is taken where either is large.
    """
    size, U, Z = len(i.mean), i.root, j.information
    joint = jnp.concatenate([product(U.T, Z), Z])
    joint = jnp.concatenate([joint, jnp.asarray(np.eye(2 * size, size))], axis=1)
    triangle, _ = triangularise(joint)
    W, X, Y = triangle[:size, :size], triangle[size:, :size], triangle[size:, size:]
    T = _solved(W, U.T).T
    left = j.score - product(Z, product(Z.T, i.mean))
    pulled = product(T.T, left)
    return _Element(
        product(j.slope, i.slope - product(T, product(X.T, i.slope))),
        product(j.slope, i.mean + product(T, pulled)) + j.mean,
        _square(jnp.concatenate([product(j.slope, T), j.root], axis=1)),
        product(i.slope.T, left - product(X, pulled)) + i.score,
        _square(jnp.concatenate([product(i.slope.T, Y), i.information], axis=1)),
    )


def _solved(L, columns):
    """L^-1 columns; a zero on the diagonal counts as 1."""
    return jax.vmap(forward_substitution, in_axes=(None, 1), out_axes=1)(L, columns)


def _square(wide):
    """A square root of as many columns as rows."""
    return triangularise(wide)[0]


def _step(model, mean, root, good, reading, interval, context, k):
    """What the sequential filter does from the state before a data interval on."""
    model, mean, root = guard((model, mean, root))
    predicted = model.predict(_EXACT, mean, root, interval)
    carry, record = measure(model, _EXACT, unscored(mean, root), predicted, reading, context, k)
    missing = good | is_fatal(carry.fault)
    fault = jnp.where(missing, carry.fault, int(Fault.SINGULAR))
    return carry._replace(fault=fault, fault_step=jnp.where(missing, carry.fault_step, k)), record


def _added_up(carries):
    """The last carry with the score of all readings and the fault that the sequential filter reports; the increments.

    That is the first fatal one, or where there is none the first.
    """
    wrong = is_fatal(carries.fault)
    so_far = jnp.cumsum(jnp.where(wrong, 0.0, carries.log_likelihood))
    faults = jnp.where(wrong | (so_far > IMPOSSIBLE), carries.fault, int(Fault.UNREACHED))
    fatal, noted = is_fatal(faults), faults != int(Fault.NONE)
    failed = jnp.any(fatal)
    k = jnp.where(failed, jnp.argmax(fatal), jnp.argmax(noted))
    total = jnp.sum(jnp.where(fatal, 0.0, carries.log_likelihood))
    last = jax.tree.map(lambda leaf: leaf[-1], carries)
    score = guard(jnp.where(failed, IMPOSSIBLE, total))
    step = jnp.where(jnp.any(noted), k, -1)
    running = jnp.where(np.arange(len(faults)) < k, so_far, IMPOSSIBLE)
    increments = jnp.where(failed, jnp.diff(running, prepend=0.0), carries.log_likelihood)
    return Carry(last.mean, last.root, score, faults[k], step), increments


def _refuse_nonlinear(model: Any) -> None:
    if not isinstance(model, StateSpaceModel):
        raise InputError(
            f"`ParallelInTime` is for a linear `StateSpaceModel`, not `{type(model).__name__}`; use `Sequential`."
        )
    for name in ("dynamics", "observation"):
        part = getattr(model, name)
        if not isinstance(part, AbstractAffine):
            raise InputError(
                f"`ParallelInTime` is for linear models, but the {name} is `{type(part).__name__}`; use `Sequential`, "
                "or make it a subclass of `AbstractAffine`."
            )
    for name in ("process_noise", "measurement_noise"):
        noise = getattr(model, name)
        if hasattr(noise, "enter") and not isinstance(noise, _ADDED):
            raise InputError(
                f"`ParallelInTime` is for noise that is added, but the {name.replace('_', ' ')} is "
                f"`{type(noise).__name__}`; use `Sequential`, or `AdditiveGaussian`."
            )
