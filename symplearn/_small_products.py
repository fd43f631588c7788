"""Products of small matrices, written so that XLA puts them into the loop around them.

On a CPU each `@` is a call of a library, of a microsecond or so, and a loop with a call in it is not compiled as one
function (see `_loops`). Sums of products have neither, and for the few numbers of a filter's step they are the faster
ones by far; for large matrices the library is.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

# The largest side of a matrix that is small; measured on a filter's gradient with 2 to 64 states.
SMALL = 32


def product(left: Float[Array, "... inner"], right: Float[Array, " inner *columns"]) -> Float[Array, "..."]:
    """left @ right, of vectors or matrices."""
    if max(left.shape + right.shape) > SMALL:
        return left @ right
    if right.ndim == 1:
        return jnp.sum(left * right, axis=-1)
    return jnp.sum(left[..., None] * right, axis=-2)
