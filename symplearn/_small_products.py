"""Products of small matrices, written so that XLA puts them into the loop around them.

On a CPU each `@` is a call of a library, of a microsecond or so, and a loop with a call in it is not compiled as one
function (see `_loops`). For the few numbers of a filter's step sums are the faster way by far; for large matrices the
library is.
"""

import jax
import jax.numpy as jnp
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jaxtyping import Array, Float

# The largest side of a matrix that is small; measured on a filter's gradient with 2 to 8 states.
SMALL = 32


def product(left: Float[Array, "... inner"], right: Float[Array, " inner *columns"]) -> Float[Array, "..."]:
    """left @ right, of vectors or matrices."""
    if max(left.shape + right.shape) > SMALL:
        return left @ right
    if right.ndim == 1:
        return jnp.sum(left * right, axis=-1)
    if left.ndim == 1:
        return jnp.sum(left[:, None] * right, axis=0)
    dtype = jnp.result_type(left, right)
    return _product.bind(left.astype(dtype), right.astype(dtype))


def _written(left, right):
    """A sum along an axis for two matrices; term by term for as many on either side.

    XLA makes a sum an own loop for each entry. Of one pair that is unrolled and fast; of a batch it waits for every
    addition, eight times as long as a term's products of all pairs together.
    """
    if left.ndim == 2:
        return jnp.sum(left[:, :, None] * right, axis=1)
    total = left[..., :1] * right[..., :1, :]
    for k in range(1, left.shape[-1]):
        total = total + left[..., k : k + 1] * right[..., k : k + 1, :]
    return jax.lax.optimization_barrier(total)


def _transposed(matrix):
    return jnp.swapaxes(matrix, -1, -2)


def _batched(arguments, axes):
    """Batch axes first, on both sides."""
    size = next(one.shape[axis] for one, axis in zip(arguments, axes, strict=True) if axis is not None)
    pairs = zip(arguments, axes, strict=True)
    both = [
        jnp.broadcast_to(one, (size, *one.shape)) if axis is None else jnp.moveaxis(one, axis, 0) for one, axis in pairs
    ]
    return _product.bind(*both), 0


# A primitive, because it is written in another way in a batch, and JAX's own derivative of terms is a sum along axes.
_product = Primitive("small_product")
_product.def_impl(jax.jit(_written))
_product.def_abstract_eval(lambda left, right: jax.core.ShapedArray((*left.shape[:-1], right.shape[-1]), left.dtype))
mlir.register_lowering(_product, mlir.lower_fun(_written, multiple_results=False))
ad.defbilinear(
    _product,
    lambda cotangent, left, right: _product.bind(cotangent, _transposed(right)),
    lambda cotangent, left, right: _product.bind(_transposed(left), cotangent),
)
batching.primitive_batchers[_product] = _batched
