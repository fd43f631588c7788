"""A guard for derivatives: what is not finite in a tangent or a cotangent becomes zero.

Where a step fails its result is not used, so its derivative is 0. But 0 times an infinite partial derivative is NaN,
in reverse mode even inside the step that failed. The guard stands at the step's inputs and puts back the 0.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jaxtyping import PyTree


def _finite_or_zero(x):
    return jnp.where(jnp.isfinite(x), x, jnp.zeros_like(x))


# A primitive, because it must count as linear in both directions, which no composition of JAX's own does.
_clean = Primitive("finite_or_zero")
_clean.def_impl(_finite_or_zero)
_clean.def_abstract_eval(lambda x: x)
mlir.register_lowering(_clean, mlir.lower_fun(_finite_or_zero, multiple_results=False))
ad.deflinear2(_clean, lambda cotangent, x: [cotangent if type(cotangent) is ad.Zero else _clean.bind(cotangent)])
batching.defvectorized(_clean)


@jax.custom_jvp
def _guarded(x):
    return x


@_guarded.defjvp
def _(primals, tangents):
    return primals[0], _clean.bind(tangents[0])


def guard(tree: PyTree) -> PyTree:
    """The same tree; derivatives that pass through its floating arrays lose their non-finite entries, in both modes."""
    return jax.tree.map(lambda leaf: _guarded(leaf) if eqx.is_inexact_array(leaf) else leaf, tree)
