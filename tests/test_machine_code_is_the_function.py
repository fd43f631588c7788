"""Machine code written from a traced function gives its values and its slopes; what it cannot write, it says."""

import ctypes

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from llvmlite import ir
from machine_operations import NAMES, OF_ONE, POINT

from symplearn._machine_arithmetic import DOUBLE, Dual, Unsupported
from symplearn._machine_code import Code
from symplearn._native import compiled
from symplearn.diagnosis._row_loop import _array

WIDTH = 8
DIRECTIONS = np.random.default_rng(0).normal(size=(3, WIDTH))
# A few additions in another order, fused or not, and a C library's functions against XLA's: 1e-12 of the largest.
ROUND_OFF = 1e-12


def run(function, point):
    """Values and slopes (entry, direction) of a function of a vector, by machine code."""
    program = jax.make_jaxpr(function)(point)
    module = ir.Module("test")
    kind = ir.FunctionType(ir.VoidType(), [DOUBLE.as_pointer()] * 4)
    written = ir.Function(module, kind, "test")
    build = ir.IRBuilder(written.append_basic_block("entry"))
    code = Code(build, WIDTH)
    values, slopes, out, along = written.args

    def at(pointer, k):
        return build.gep(pointer, [ir.Constant(ir.IntType(64), k)])

    def register(pointer, k):
        return build.bitcast(at(pointer, WIDTH * k), code.register.as_pointer())

    given = [Dual(build.load(at(values, k)), build.load(register(slopes, k), align=8)) for k in range(len(point))]
    (found,) = code.evaluated(program, [_array(given)])
    for k, dual in enumerate(found):
        build.store(dual.value, at(out, k))
        build.store(code.slope(dual), register(along, k), align=8)
    build.ret_void()
    engine = compiled(module)
    arrays = np.array(point), DIRECTIONS[: len(point)].copy(), np.empty(len(found)), np.empty((len(found), WIDTH))
    ctypes.CFUNCTYPE(None, *[ctypes.c_void_p] * 4)(engine.get_function_address("test"))(
        *(array.ctypes.data for array in arrays)
    )
    return arrays[2:]


def check(function, point=POINT):
    """The machine's values and slopes are JAX's, and some slope is not nothing where JAX has one."""
    value, slopes = run(function, jnp.asarray(point))
    along = lambda t: jax.jvp(function, (jnp.asarray(point),), (t,))[1]  # noqa: E731
    expected = jax.vmap(along, 1, 1)(jnp.asarray(DIRECTIONS[: len(point)]))
    # Round-off of values about one; of slopes, whose products may cancel, relative to the largest.
    np.testing.assert_allclose(value, function(jnp.asarray(point)), rtol=ROUND_OFF, atol=ROUND_OFF)
    np.testing.assert_allclose(slopes, expected, rtol=ROUND_OFF, atol=ROUND_OFF * max(1.0, np.abs(expected).max()))


@pytest.mark.parametrize("name", NAMES)
def test_every_operation_is_that_of_jax(name):
    """Each operation that is known gives JAX's values and slopes, on both sides of what it depends on."""
    assert name in str(jax.make_jaxpr(OF_ONE[name])(jnp.asarray(POINT)))
    check(OF_ONE[name])


@pytest.mark.parametrize(
    "function",
    [
        lambda x: jnp.concatenate([x[1:], x[:1]]) * jnp.stack([x[0], x[2], x[1]]),
        lambda x: jnp.pad(x[:2], (1, 0)) + x.reshape(3, 1).T[0] + jnp.broadcast_to(x[1], (3,)),
        lambda x: jnp.sum(x[:, None] * x[None], axis=0) + jnp.max(x) + x[np.array([2, 0, 0])] + jnp.arange(3),
        lambda x: jnp.concatenate(jnp.split(x, [1])) * jnp.flip(x),
    ],
    ids=["joined", "spread", "summed", "split"],
)
def test_entries_are_moved_as_they_are_told_to(function):
    """Arrays are put together, taken apart, turned and summed."""
    check(function)


TABLE = np.array([[0.3, 1.0], [-0.2, 0.5], [0.7, -1.0]])


@pytest.mark.parametrize(
    "function",
    [
        lambda x: lax.scan(lambda c, row: (c * row[1] + row[0] * x, None), x, TABLE)[0],
        lambda x: lax.scan(lambda c, row: (c * row[1] + jnp.sin(c), None), x, TABLE, reverse=True)[0],
        lambda x: lax.fori_loop(0, (10 * x[0]).astype(int), lambda k, c: c * 0.9 + k * x, x),
        lambda x: lax.while_loop(lambda c: c[0] < 5.0, lambda c: c * 1.3 + x**2, x),
        lambda x: lax.cond(x[1] < 0, lambda: jnp.sin(x), lambda: x**2),
        lambda x: lax.switch((4 * x[0]).astype(int), [lambda: x, lambda: 2 * x, lambda: x**3]),
        lambda x: lax.cond(x[0] > 0, lambda: jnp.ones(3), lambda: jnp.zeros(3)) * x,
        lambda x: jax.vmap(lambda y: lax.fori_loop(0, 3, lambda k, c: c * y, y + 1))(x),
    ],
    ids=["along a table", "backwards", "so often", "while", "one of two", "one of three", "without slopes", "batched"],
)
def test_loops_and_branches_carry_slopes(function):
    """Loops of a number that is data, loops along numbers that are known, and branches."""
    check(function)


def test_a_function_with_its_own_derivative_keeps_it():
    """A derivative that was given is used, not that of the operations inside."""

    @jax.custom_jvp
    def mine(x, y):
        return x * y

    mine.defjvp(lambda values, slopes: (mine(*values), 7.0 * slopes[0] + 3.0 * values[0] * slopes[1]))
    check(lambda x: jnp.stack([mine(x[0], x[1]), mine(x[2], 2.0), mine(2.0, x[1])]))
    # One product, rounded once by both: the last digit at most.
    assert run(lambda x: mine(x[:1], 1.0), jnp.asarray(POINT))[1][0] == pytest.approx(7.0 * DIRECTIONS[0], rel=1e-15)


def test_what_is_no_number_stays_so():
    """NaN goes through larger and smaller of two from either side, as in JAX."""
    for pair in ((np.nan, 1.0, 0.0), (1.0, np.nan, 0.0)):
        for function in (jnp.maximum, jnp.minimum):
            assert np.isnan(run(lambda x, f=function: f(x[0], x[1])[None], jnp.asarray(pair))[0][0])


@pytest.mark.parametrize(
    "function",
    [jnp.sort, jax.scipy.special.erf, lambda x: x[(x[0] > 0).astype(int)][None], lambda x: jnp.cumsum(x),
     lambda x: lax.scan(lambda c, row: (c, row), x, x)[1]],
    ids=["order", "an integral", "a place that moves", "sums on the way", "a loop that tells"],
)  # fmt: skip
def test_what_it_cannot_write_it_says(function):
    """An operation that is not known is refused, and not left out."""
    with pytest.raises(Unsupported):
        run(function, jnp.asarray(POINT))
