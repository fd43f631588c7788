"""What can go wrong in a filter's step, as a value that passes through compiled code."""

import enum
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

# The log density, in nats, of a recording that a model cannot have made: lower than any other, and finite.
IMPOSSIBLE = -1e15
# An innovation of more standard deviations than this is worth a word; no honest model has one.
_REMOTE = 1e4


class Fault(enum.IntEnum):
    """Why a filter's result is not to be trusted; NONE where it is.

    REMOTE alone leaves the result valid: a reading more than 10,000 standard deviations away from its prediction. After
    any other fault the log density is -1e15 nats, with derivative 0, and later moments mean nothing.
    """

    NONE = 0
    REMOTE = 1
    STATE = 2
    COVARIANCE = 3
    READING = 4
    SINGULAR = 5
    UNREACHED = 6


SENTENCES = {
    Fault.NONE: "no fault",
    Fault.REMOTE: "the reading lies more than 10,000 standard deviations from its prediction",
    Fault.STATE: "the dynamics gave a state that is not finite: the trajectory escaped",
    Fault.COVARIANCE: "the state's covariance is not finite, or a noise's or the initial covariance is not positive "
    "semi-definite",
    Fault.READING: "the observation of the state, or its noise, is not finite",
    Fault.SINGULAR: "the covariance of the innovation is singular: a channel without noise repeats what is known",
    Fault.UNREACHED: "the recording lies so far from its prediction that its log density is below -1e15 nats",
}


def first_fault(*checks: tuple[Array, Fault]) -> Int[Array, ""]:
    """The code of the first check that is false."""
    code = jnp.asarray(int(Fault.NONE))
    for holds, fault in reversed(checks):
        code = jnp.where(holds, code, int(fault))
    return code


def is_remote(standardised: Float[Array, " channel"]) -> Array:
    """Whether a reading is farther away than any honest model's."""
    return jnp.any(jnp.abs(standardised) > _REMOTE)


def is_fatal(code: Int[Array | np.ndarray, "..."]) -> Any:
    """Whether a code makes the result invalid."""
    return code > int(Fault.REMOTE)
