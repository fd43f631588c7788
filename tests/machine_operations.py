"""Functions of a vector of three, each with one operation that machine code has to know."""

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from symplearn._guard import guard
from symplearn._machine_rules import RULES

POINT = np.array([0.7, -0.4, 1.3])

OF_ONE = {
    "abs": jnp.abs, "asinh": jnp.arcsinh, "atan": jnp.arctan, "cos": jnp.cos, "cosh": jnp.cosh, "exp": jnp.exp,
    "sign": jnp.sign, "sin": jnp.sin, "sinh": jnp.sinh, "tan": jnp.tan, "tanh": jnp.tanh, "neg": lambda x: -x,
    "square": lax.square, "copy": jnp.copy,
    "acos": lambda x: jnp.arccos(0.5 * x), "asin": lambda x: jnp.arcsin(0.5 * x),
    "atanh": lambda x: jnp.arctanh(0.5 * x),
    "acosh": lambda x: jnp.arccosh(2 + x), "log": lambda x: jnp.log(2 + x), "sqrt": lambda x: jnp.sqrt(2 + x),
    "logistic": jax.nn.sigmoid,
    "integer_pow": lambda x: x**5 + x**-3 + x**1,
    "pow": lambda x: (2 + x) ** (1.5 + x) + (2 + x) ** 0.3,
    "atan2": lambda x: jnp.arctan2(x, x[::-1] - 0.2) + jnp.arctan2(1.0, x) + jnp.arctan2(x, 2.0),
    "add": lambda x: x + x[::-1] + 1.0, "add_any": lambda x: jax.jvp(lambda y: y * y, (x,), (2 * x,))[1],
    "sub": lambda x: x - x[::-1] + (1.0 - x), "mul": lambda x: x * x[::-1] * 3.0,
    "div": lambda x: x / x[::-1] + 1.0 / x + x / 3.0,
    "max": lambda x: jnp.maximum(x, 0.1) + jnp.maximum(x[::-1], x), "min": lambda x: jnp.minimum(0.1, x) * x,
    "clamp": lambda x: lax.clamp(-0.2, x, 1.0),
    "select_n": lambda x: jnp.where(x > 0, x**2, 3 * x) + jnp.where(x < 1, 2.0, x),
    "gt": lambda x: jnp.where(x > x[::-1], x, 1.0), "lt": lambda x: jnp.where(x < 0.7, x, 1.0),
    "ge": lambda x: jnp.where(x >= 0.7, x, 1.0), "le": lambda x: jnp.where(x <= 0.7, x, 1.0),
    "eq": lambda x: jnp.where(x == 0.7, x, 1.0), "ne": lambda x: jnp.where(x != 0.7, x, 1.0),
    "and": lambda x: jnp.where((x > 0) & (x < 1), x, 2 * x), "or": lambda x: jnp.where((x < 0) | (x > 1), x, 2 * x),
    "not": lambda x: jnp.where(~(x > 0), x, 2 * x),
    "finite_or_zero": lambda x: jax.grad(lambda y: jnp.sum(guard(y) ** 2))(x) + 1.0,
    "stop_gradient": lambda x: x * lax.stop_gradient(x),
    "floor": lambda x: jnp.floor(3.0 * x) * x,
    "is_finite": lambda x: jnp.where(jnp.isfinite(1 / (x - 0.7)), x, 2.0),
    "convert_element_type": lambda x: x * (x > 0) + (x > 0).astype(int).astype(float) + (3 * x).astype(int),
}  # fmt: skip
# An operation of its own from JAX 0.11 on.
if hasattr(lax, "one_minus_square"):
    OF_ONE["one_minus_square"] = lax.one_minus_square
# Those that this version of JAX has.
NAMES = [name for name in RULES if name in OF_ONE or name != "one_minus_square"]
