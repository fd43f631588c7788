"""Keys of random numbers, as `jax.random.key` makes them."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ._errors import InputError


def refuse_key(given: Any) -> None:
    """Refuse, with `InputError`, what is no key: a bare seed, from which JAX would say that it lacks attributes."""
    is_array = isinstance(given, jax.Array | np.ndarray)
    if not is_array or not (jnp.issubdtype(given.dtype, jax.dtypes.prng_key) or given.dtype == jnp.uint32):
        raise InputError(f"Random numbers need a `key`, such as `jax.random.key(0)`, but {str(given):.60} was given.")
