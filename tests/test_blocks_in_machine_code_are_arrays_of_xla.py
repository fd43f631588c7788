"""Arrays of many numbers, which machine code has in memory, are what XLA's are: moved, joined, summed, multiplied."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from test_lanes_are_the_loops_of_xla import ROUND_OFF, counted, same

import integrators as ig
import symplearn as sl
from benchmarks._cases import nssnn
from symplearn import _machine_lanes, _machine_memory, _machine_sizes, _native
from symplearn._lane_loops import left_to_xla, with_lane_loops
from symplearn._small_products import product

SIZE = 40
RNG = np.random.default_rng(4)
W, B = RNG.normal(size=(SIZE, SIZE)) / np.sqrt(SIZE), RNG.normal(size=SIZE)
LEAST = RNG.normal(size=(2, 3, SIZE)) / np.sqrt(SIZE)
PLACES = np.arange(7)
TIMES = np.linspace(0.5, 1.5, 7)


def points(c):
    """Five points beside each other, as a filter has them."""
    return jnp.stack([c, 0.5 * c, c - 1.0, c * c, -c], 1)


def network(z):
    return jnp.sum(jax.nn.sigmoid(W @ jax.nn.sigmoid(W @ z + B) + B))


STEPS = {
    "matrix times vector": lambda c: jnp.tanh(W @ c),
    "vector times matrix": lambda c: jnp.tanh(c @ W),
    "matrices": lambda c: jnp.tanh((W @ jnp.outer(c, B) @ W.T)[:, 3]),
    "matrices, turned": lambda c: jnp.tanh((W.T @ jnp.outer(c, B).T @ W)[3]),
    "sums of products": lambda c: jnp.tanh((W @ jnp.outer(c, B) + jnp.outer(B, c) @ W + (W.T @ jnp.outer(c, B)).T)[1]),
    "products that are shared": lambda c: 0.1 * jnp.einsum("ij,jk,ji->i", W, points(c), W) * c,
    "products over two axes": lambda c: 0.1 * jnp.tensordot(LEAST, jnp.tensordot(LEAST, c, 1), ((0, 1), (0, 1))),
    "small product": lambda c: 0.1 * product(product(points(c), jnp.eye(5)[:, :4]), jnp.ones((4, 2)))[:, 0],
    "outer products": lambda c: 0.01 * jnp.outer(c, c).sum(0) + 0.01 * jnp.outer(c, B).sum(1),
    "sums": lambda c: jnp.tanh(0.1 * (jnp.outer(c, B).sum() + points(c).sum(0)[2] + points(c).sum(1))),
    "parts": lambda c: jnp.concatenate([c[5:], c[:3] * 2, c[3:5][::-1]]),
    "rims": lambda c: jnp.pad(c[5:], (2, 3)) * 1.01 + jnp.pad(c, (1, 1))[1:-1],
    "other shapes": lambda c: ((c.reshape(8, 5).T * 0.5 + 1.0)[::-1]).reshape(SIZE),
    "spread": lambda c: jnp.mean(jnp.broadcast_to(c[:, None], (SIZE, 3)) * jnp.ones((1, 3)), 1) * 0.9,
    "one of two": lambda c: jnp.where(c[0] > 0, c, 0.5 * c) + jnp.where(c > 0.3, 0.1, c),
    "a branch": lambda c: lax.cond(c[0] > 0, lambda: jnp.tanh(W @ c), lambda: 0.5 * c),
    "a loop inside": lambda c: lax.scan(lambda d, k: (0.5 * d + jnp.tanh(W @ d) * k, d[:2]), c, jnp.arange(3.0))[0],
    "a loop inside that tells": lambda c: lax.scan(lambda d, k: (0.5 * d, (k * d, d[0])), c, PLACES)[1][0].sum(0) * 0.1,
    "step by step": lambda c: lax.scan(lambda d, k: (0.5 * d, k * d), c, jnp.arange(2.0), unroll=2)[1].sum(0),
    "rows that are looked up": lambda c: lax.fori_loop(0, 3, lambda k, d: 0.9 * d + 0.1 * jnp.asarray(W)[k] * d[k], c),
    "exchanged": lambda c: lax.fori_loop(0, 3, lambda k, d: (d[1] * 0.9, jnp.tanh(d[0])), (c, 2 * c))[0],
    "points": lambda c: 0.1 * jax.vmap(lambda z: jnp.tanh(W @ z + B), 1, 1)(points(c)).sum(1),
    "slopes at points": lambda c: 0.1 * jax.vmap(jax.grad(network), 1, 1)(points(c)).sum(1),
}  # fmt: skip


@pytest.fixture(autouse=True)
def blocks_wherever_they_can_be(monkeypatch):
    """Blocks are written even where XLA would do as well."""
    monkeypatch.setattr(_machine_sizes, "_WORTH", 0.0)
    monkeypatch.setattr(_machine_sizes, "_WORTH_COPIES", 0.0)


def along(step):
    return lambda x: lax.scan(lambda c, row: (step(c) + 0.1 * row * x, c[3]), x, np.linspace(0.5, 1.5, 7))


@pytest.mark.parametrize("lanes", [1, 5])
@pytest.mark.parametrize("way", ["there", "back"])
@pytest.mark.parametrize("name", STEPS)
def test_steps_are_those_of_xla(name, way, lanes, monkeypatch):
    """What a loop of one lane or of five comes to, and its slopes, all of which are written."""
    function = along(STEPS[name])
    if way == "back":
        plain = function
        function = jax.grad(lambda x: sum(jnp.sum(jnp.sin(one)) for one in plain(x)))
    names, x = counted(monkeypatch), jnp.asarray(RNG.normal(size=(lanes, SIZE)))
    mapped = jax.vmap if lanes > 1 else (lambda one: lambda some: one(some[0]))
    # Sums of forty products, seven steps long, in an order of their own.
    same(jax.jit(mapped(with_lane_loops(function)))(x), jax.jit(mapped(function))(x), 10 * ROUND_OFF)
    assert names and None not in names


@pytest.mark.parametrize("way", [(1, 8), (1, 4), (8, 8)], ids=["alone", "alone, four at once", "lanes beside lanes"])
def test_a_networks_likelihood_and_gradient_are_those_of_xla(way, monkeypatch):
    """Of three trainings at once, with readings that are missing, whatever registers hold, to 1e-10."""
    width, span = way
    monkeypatch.setattr(_machine_lanes, "span", lambda: span)
    monkeypatch.setattr(_machine_lanes, "_LARGE", 100 if width == 1 else 10**9)
    monkeypatch.setattr(_machine_lanes, "_MOST", dict.fromkeys((1, 4, 8), 5000))
    cases = [nssnn(6, 9, seed) for seed in range(3)]
    readings = np.stack([case.series.readings for case in cases])
    readings[1, 2], readings[2, 3, 0] = np.nan, np.nan
    at = jnp.stack([case.free for case in cases]), jnp.asarray(readings)
    both = jax.value_and_grad(cases[0].score)
    names = counted(monkeypatch)
    found = jax.jit(jax.vmap(lambda *some: both(*some)))(*at)
    assert names and None not in names
    with left_to_xla():
        expected = jax.jit(jax.vmap(lambda *some: both(*some)))(*at)
    same(found, expected, 1e-10)  # issue 7 asks for 1e-10 of every fast path


@pytest.mark.parametrize("size", [1, 7, 31, 33, 61, 64, 70])
def test_products_of_every_width_are_those_of_xla(size, monkeypatch):
    """Matrices whose rows fill their last register in part, or end within one of several that are held at once; what is
    given lies end to end, with nothing behind it."""
    left, right = RNG.normal(size=(9, 11)), RNG.normal(size=(11, size)) / np.sqrt(max(size, 11))
    monkeypatch.setattr(_machine_lanes, "_LARGE", 0)

    def function(given, x):
        return lax.scan(lambda c, k: (jnp.sin(k * (c @ x) @ x.T), (c @ x)[2] * k), given, TIMES)

    names, x = counted(monkeypatch), jnp.asarray(right)
    # As above: sums in an order of their own, over seven steps.
    same(jax.jit(with_lane_loops(function))(left, x), jax.jit(function)(left, x), 10 * ROUND_OFF)
    assert names and None not in names


def test_a_network_of_ones_own_is_written():
    """The filter of a user's own network is machine code there and back, and that of a chain of springs is left to XLA,
    which does it as well."""

    class Own(ig.AbstractHamiltonian):
        weights: jax.Array

        def energy(self, q, p):
            return jnp.sum(jnp.tanh(self.weights @ jnp.tanh(self.weights[:, :2] @ jnp.concatenate([q, p]))))

    noise = [sl.AdditiveGaussian(sl.ScaledIdentity(0.01, 2)) for _ in range(2)]
    recording = sl.TimeSeries(0.2 * np.arange(12), jnp.ones((12, 2)))

    def score(weights):
        dynamics = sl.Propagator(Own(weights), ig.Tao(ig.as_parameter(1.0)))
        model = sl.StateSpaceModel(dynamics, sl.FullState(), *noise, sl.Gaussian(jnp.ones(2), jnp.eye(2)))
        return sl.MarginalLikelihood().score(model, recording)

    told = [one for one in sl.loops_of(jax.value_and_grad(score), jnp.asarray(W)) if one.steps == 12]
    assert [one.reason for one in told] == ["", ""]


def test_matrices_that_are_changed_a_little_are_left_to_xla(monkeypatch):
    """A step that changes one entry of a large matrix would spend its time on copies."""
    monkeypatch.setattr(_machine_sizes, "_WORTH_COPIES", 8)
    step = lambda c, k: (c - jnp.outer(c[:, 0], c[0]) * 0.1, None)  # noqa: E731
    (told,) = sl.loops_of(lambda x: lax.scan(step, x, None, length=20)[0], jnp.asarray(W))
    assert told.reason == "many numbers of which no matrices are made"


@pytest.mark.parametrize("lanes", [1, 8])
def test_exponentials_are_right_everywhere(lanes, monkeypatch):
    """Of all sizes, of what is not finite, and of what is no number; XLA's library is the oracle."""
    ends = [0.0, -0.0, 709.78, 709.79, np.inf, -np.inf, np.nan, 1e-300, 1e300]
    x = np.concatenate([np.linspace(-720, 711, 400), ends])
    x = np.resize(x, (lanes, 409))
    function = lambda y: lax.scan(lambda c, k: (jnp.exp(c + 0.0 * k), None), y, np.arange(1.0))[0]  # noqa: E731
    names = counted(monkeypatch)
    found = np.asarray(jax.jit(jax.vmap(with_lane_loops(function)))(x))
    with np.errstate(over="ignore"):
        expected = np.exp(x)
    tiny = expected < 1e-307  # below the smallest normal number zero will do
    # Two units in the last place: the series' and the last product's rounding, against the library's own.
    np.testing.assert_allclose(np.where(tiny, 0.0, found), np.where(tiny, 0.0, expected), rtol=4e-16)
    assert np.all(found[tiny] <= 1e-307)
    assert names and None not in names


def test_registers_are_as_wide_as_the_processor_has_them(monkeypatch):
    """Eight numbers where it has AVX-512, four elsewhere."""
    for features, width in (("+avx2,+avx512f", 8), ("+avx2,-avx512f", 4)):
        monkeypatch.setattr(_native, "_features", lambda features=features: features)
        assert _native.span.__wrapped__() == width


def test_operations_that_have_no_blocks_are_worked_out_in_registers(monkeypatch):
    """What is asked of entries one by one is, up to a number of them; beyond it the loop is XLA's."""
    function, x = along(lambda c: 0.5 * jnp.where(c > 0.3, 0.1, W @ c) + jnp.max(c)), jnp.asarray(RNG.normal(size=SIZE))
    monkeypatch.setattr(_machine_lanes, "_LARGE", 0)
    names = counted(monkeypatch)
    same(jax.jit(with_lane_loops(function))(x), jax.jit(function)(x))
    assert names and None not in names
    monkeypatch.setattr(_machine_memory, "_FEW", SIZE - 1)
    (told,) = sl.loops_of(function, x)
    assert told.reason == "an operation on many numbers"
