"""A loop as machine code, of one lane or of many side by side, yields what XLA's does; what it cannot do is XLA's."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from machine_operations import NAMES, OF_ONE, POINT

import integrators as ig
import symplearn as sl
from benchmarks._cases import cherry, henon_heiles
from experiments._calibration_models import Pendulum
from symplearn import _filter, _lane_loops, _machine_lanes, _native
from symplearn._filter import SEQUENTIAL
from symplearn._lane_loops import left_to_xla, with_lane_loops
from symplearn._log_posterior import gradient, guarded
from symplearn._objectives import prepare
from symplearn._parameters import flatten, resolve
from symplearn._sampler import whitened
from symplearn._transforms import STANDARD
from symplearn._whitening import Whitening

# Sums in another order, fused or not, and a C library's functions against XLA's.
ROUND_OFF = 1e-12


def lanes_of(number, size=3, seed=0):
    return POINT[:size] + 0.05 * np.random.default_rng(seed).normal(size=(number, size))


def counted(monkeypatch):
    """The names by which loops are known to XLA, as they are written; None where one cannot be."""
    names, write = [], _lane_loops.code_of
    monkeypatch.setattr(_lane_loops, "code_of", lambda *args: names.append(write(*args)) or names[-1])
    return names


def same(found, expected, tolerance=ROUND_OFF):
    """Of the same size as the largest entry, and no number where the other is none."""
    for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        scale = max(1.0, float(np.max(np.abs(np.nan_to_num(other)), initial=0.0)))
        # Each caller's tolerance is relative to the largest entry: small ones are what is left of sums of large ones.
        np.testing.assert_allclose(one, other, rtol=0.0, atol=tolerance * scale)
        assert one.dtype == other.dtype


def check(function, number, monkeypatch):
    """Mapped over so many lanes, and alone; and every loop of it was written."""
    names, x = counted(monkeypatch), jnp.asarray(lanes_of(number))
    same(jax.jit(jax.vmap(with_lane_loops(function)))(x), jax.jit(jax.vmap(function))(x))
    same(jax.jit(with_lane_loops(function))(x[0]), jax.jit(function)(x[0]))
    assert names and None not in names


@pytest.mark.parametrize("name", NAMES)
def test_every_operation_is_that_of_xla(name, monkeypatch):
    """Each operation that is known, as a step of a loop of eleven lanes and of one."""
    one = OF_ONE[name]

    def function(x):
        return lax.scan(
            lambda c, row: (0.5 * c + one(x + 0.1 * jnp.tanh(row)), c.sum()), jnp.zeros(3), jnp.arange(20.0)
        )

    assert name in str(jax.make_jaxpr(function)(jnp.asarray(POINT)))
    check(function, 11, monkeypatch)


TABLE = np.random.default_rng(1).normal(size=(20, 2))


def turned(d, k, by):
    """One entry changed, at a place that is counted."""
    one = lax.dynamic_index_in_dim(d, k, keepdims=False)
    return lax.dynamic_update_index_in_dim(d, one * by + d[0], k, 0)


LOOPS = {
    "backwards": lambda x: lax.scan(lambda c, row: (c * row[1] + jnp.sin(c), c), x, TABLE, reverse=True),
    "of integers": lambda x: lax.scan(
        lambda c, k: ((c[0] + k, c[1] | (x[0] > 0.7), c[2] * 0.5 + k), c[0] * k), (0, False, x), np.arange(20)
    ),
    "one of two": lambda x: lax.scan(
        lambda c, row: (lax.cond(c[0] + row[0] > 0.7, lambda: jnp.sin(c), lambda: c**2), c[0] > 0), x, TABLE
    )[0],
    "one of three": lambda x: lax.scan(
        lambda c, k: (lax.switch(k + (c[0] > 0.7), [lambda: c, lambda: 0.5 * c, lambda: c**2]), None),
        x, np.arange(20) % 2,
    )[0],
    "in a loop": lambda x: lax.scan(
        lambda c, row: lax.scan(lambda d, n: (d * 0.9 + n * row[0], d[1]), c, np.arange(30.0)), x, TABLE
    ),
    "step by step": lambda x: lax.scan(
        lambda c, row: (lax.fori_loop(0, 3, lambda k, d: turned(d, k, row[0]), c), row[0] * c[0]), x, TABLE
    ),
    "rows": lambda x: lax.scan(
        lambda c, row: (jnp.outer(c, c)[np.array([2, 0, 0])][:, 1] * row[0], jnp.outer(c, row)[np.array([1, 2])].sum()),
        x, TABLE,
    ),
    "added to": lambda x: jax.grad(
        lambda y: lax.scan(lambda c, row: (jnp.sin(c[np.array([1, 2, 1])]) * row[0] + y, None), y, TABLE)[0].sum()
    )(x),
    "at their ends": lambda x: lax.scan(
        lambda c, row: (lax.pad(c, row[0], [(-1, 1, 0)]) + lax.pad(c[:2], 0.0, [(0, 0, 1)]), jnp.any(c > 0)), x, TABLE
    ),
    "what is no number": lambda x: lax.scan(
        lambda c, row: (jnp.where(c > 10, jnp.nan, 1.3 * c + row[0]), jnp.isnan(c)), x, TABLE
    ),
    "slopes": lambda x: jax.grad(
        lambda y: lax.scan(jax.checkpoint(lambda c, row: (jnp.sin(c * row[0]) + y, None)), y, TABLE)[0].sum()
    )(x),
}  # fmt: skip


@pytest.mark.parametrize("number", [2, 8, 13])
@pytest.mark.parametrize("name", LOOPS)
def test_loops_are_those_of_xla(name, number, monkeypatch):
    """What changes, what is told on the way, branches that lanes take on their own, and loops in loops."""
    check(LOOPS[name], number, monkeypatch)


@pytest.mark.parametrize(("outer", "inner"), [(5, 1), (3, 2), (2, 7), (3, 8)])
def test_lanes_of_lanes_are_beside_each_other(outer, inner, monkeypatch):
    """A function that is mapped twice, over numbers of lanes that fill no register."""
    names, x = counted(monkeypatch), jnp.asarray(lanes_of(outer * inner)).reshape(outer, inner, 3)
    y = jnp.linspace(0.5, 1.5, outer)

    def function(x, y):
        return lax.scan(lambda c, row: (jnp.sin(c * row[0]) + y * x, c[1]), x, TABLE)

    def twice(one):
        return jax.jit(jax.vmap(jax.vmap(one, (0, None))))

    same(twice(with_lane_loops(function))(x, y), twice(function)(x, y))
    assert names and None not in names


def test_lanes_of_lanes_of_which_one_alone_can_be_written(monkeypatch):
    """Of one lane any entry is read at a place that is known while it runs, of several it is not: mapped once more, the
    loop is XLA's."""
    names, x, places = counted(monkeypatch), jnp.asarray(lanes_of(4)).reshape(4, 1, 3), jnp.array([2, 0, 1, 1])

    def function(x, places):
        return lax.scan(lambda c, k: (jnp.sin(c) + lax.dynamic_index_in_dim(c, k, keepdims=False), c[0]), x, places)

    def twice(one):
        return jax.jit(jax.vmap(jax.vmap(one, (0, None)), (0, None)))

    same(twice(with_lane_loops(function))(x, places), twice(function)(x, places))
    assert names[0] is not None and names[-1] is None


@pytest.mark.parametrize(
    "step",
    [lambda c, row: (jnp.sort(c), None), lambda c, row: (lax.while_loop(lambda d: d[0] < 1, lambda d: d + 1, c), None),
     lambda c, row: (jnp.cumsum(c), None),
     lambda c, row: (c * jnp.outer(jnp.tile(c, 70), jnp.tile(jnp.sin(c), 70)).mean(), None),
     lambda c, row: (lax.scan(lambda d, n: (jnp.sin(d), jnp.outer(d, d) > 0), c, None, length=5000)[1].sum(0)[0] * c,
                     None)],
    ids=["order", "while", "sums on the way", "much", "much that is kept"],
)  # fmt: skip
def test_what_cannot_be_written_is_left_to_xla(step, monkeypatch):
    """An operation that is not known, and a function that would be too long, give the same result."""
    monkeypatch.setattr(_machine_lanes, "_MOST", {8: 5000})
    names, x = counted(monkeypatch), jnp.asarray(lanes_of(9))
    function = lambda y: lax.scan(step, y, TABLE)[0]  # noqa: E731
    same(jax.vmap(with_lane_loops(function))(x), jax.vmap(function)(x))
    assert names[0] is None  # a long loop inside of it may be written


def test_slopes_are_left_to_xla():
    """What is written is differentiated as what it stands for, twice and in both modes."""
    function = lambda x: lax.scan(lambda c, row: (jnp.sin(c) * row[0] + x, None), x, TABLE)[0].sum()  # noqa: E731
    for twice in (jax.hessian, lambda f: jax.jacrev(jax.jacrev(f)), lambda f: jax.jacfwd(jax.jacfwd(f))):
        same(twice(with_lane_loops(function))(jnp.asarray(POINT)), twice(function)(jnp.asarray(POINT)))


def missing(case):
    """The recording with empty cells and an empty row."""
    readings = np.array(case.series.readings)
    readings[3, 1], readings[7] = np.nan, np.nan
    return jnp.asarray(readings)


@pytest.mark.parametrize("case", [henon_heiles(20, 5.0, 20), cherry()], ids=["leapfrog", "Tao"])
def test_a_likelihood_and_its_gradient_are_those_of_xla(case, monkeypatch):
    """Marginal likelihood and gradient of a batch of nine models, with readings that are missing, to 1e-10."""
    names, readings = counted(monkeypatch), missing(case)
    places = case.free + 1e-3 * np.random.default_rng(2).normal(size=(9, case.free.size))
    both = jax.value_and_grad(lambda free: case.score(free, readings))
    # Issue 7 asks for 1e-10 of every fast path, relative to the largest entry.
    same(jax.jit(jax.vmap(with_lane_loops(both)))(places), jax.jit(jax.vmap(both))(places), 1e-10)
    assert any(names)


def test_slopes_of_the_likelihood_are_those_of_the_filter():
    """Whichever way the likelihood is differentiated, once or twice, one model or several, it is the filter's slope."""
    case = henon_heiles(5, 1.0, 2)

    def plain(free):
        parts = prepare(resolve(flatten(case.model)[1](free)), case.series)
        return -SEQUENTIAL.run(*parts, STANDARD, keep=False)[0].log_likelihood

    def swift(free):
        return case.score(free, case.series.readings)

    places = case.free + 1e-3 * np.random.default_rng(2).normal(size=(3, case.free.size))
    slopes = jax.jit(jax.jacfwd(plain))
    expected = slopes(case.free)
    # As above; second derivatives are what Laplace's approximation takes.
    for way in (jax.grad, jax.jacfwd):
        same(jax.jit(way(swift))(case.free), expected, 1e-10)
    same(jax.jit(jax.vmap(jax.grad(swift)))(places), jnp.stack([slopes(one) for one in places]), 1e-10)
    same(jax.jit(jax.hessian(swift))(case.free), jax.jit(jax.hessian(plain))(case.free), 1e-10)


def test_stretches_of_a_long_recording_are_written(monkeypatch):
    """Where a gradient keeps only some states, the loops over the readings in between are written, and agree."""
    monkeypatch.setattr(_filter, "_KEPT", 100)
    monkeypatch.setattr(_lane_loops, "_LONG", 4)
    case = henon_heiles(30, 1.0, 2)
    both = jax.value_and_grad(lambda free: case.score(free, case.series.readings))
    with left_to_xla():
        expected = jax.jit(lambda free: both(free))(case.free)
    names = counted(monkeypatch)
    same(jax.jit(both)(case.free), expected, 1e-10)  # as above
    assert sum(name is not None for name in names) >= 3  # there, there again, and back


def test_a_lane_that_fails_spoils_no_other():
    """A model whose filter fails says so, and its neighbours' likelihoods are what they are alone."""
    case = henon_heiles(20, 5.0, 20)
    places = np.tile(np.asarray(case.free), (8, 1))
    places[3, :9] = 1e3  # thrown out at once
    score = with_lane_loops(lambda free: case.score(free, case.series.readings))
    found = np.asarray(jax.jit(jax.vmap(score))(places))
    assert found[3] == 1e15
    # One lane's sums are in the order of eight lanes', but fused in other places: they differ by round-off, whose bound
    # has its reason at ROUND_OFF.
    np.testing.assert_allclose(np.delete(found, 3), case.score(case.free, case.series.readings), rtol=ROUND_OFF)


def test_fits_and_draws_have_it():
    """What an optimiser walks on, and what is drawn from, has loops that are written."""
    case, start = henon_heiles(20, 5.0, 20), Whitening(jnp.zeros(11), jnp.eye(11))
    score = lambda free: case.score(free, case.series.readings)  # noqa: E731
    for function in (guarded(score, 11), jax.value_and_grad(guarded(score, 11)), gradient(score, 11),
                     whitened(score, start), jax.value_and_grad(whitened(score, start, slopes=True))):  # fmt: skip
        assert "loop_of_lanes" in str(jax.make_jaxpr(function)(case.free))


@pytest.fixture
def cache_folder(tmp_path):
    """A folder that is JAX's cache for one test."""
    usual = jax.config.jax_compilation_cache_dir
    jax.config.update("jax_compilation_cache_dir", str(tmp_path / "kept"))
    yield tmp_path / "kept"
    jax.config.update("jax_compilation_cache_dir", usual)


def test_a_model_of_ones_own_that_reads_one_coordinate_is_written():
    """The filter of a Hamiltonian that a user wrote, where one coordinate is read, is machine code there and back."""
    noise = sl.AdditiveGaussian(sl.ScaledIdentity(0.01, 2)), sl.AdditiveGaussian(sl.ScaledIdentity(0.01, 1))
    start, recording = sl.Gaussian(jnp.ones(2), jnp.eye(2)), sl.TimeSeries(0.2 * np.arange(60), jnp.ones((60, 1)))

    def score(gravity):
        dynamics = sl.Propagator(Pendulum(gravity), ig.Leapfrog(), substeps=4)
        model = sl.StateSpaceModel(dynamics, sl.Coordinates((0,)), *noise, start)
        return sl.MarginalLikelihood().score(model, recording)

    there_and_back = sl.loops_of(jax.value_and_grad(score), jnp.asarray(9.0))
    assert [one.reason for one in there_and_back if one.steps == 60] == ["", ""]


def test_how_loops_are_compiled_is_told():
    """On request it is said of every loop whether it is machine code, and why not."""
    case = henon_heiles(20, 5.0, 20)
    score = lambda free: case.score(free, case.series.readings)  # noqa: E731
    assert [one.reason for one in sl.loops_of(score, case.free) if one.steps == 20] == [""]
    there_and_back = sl.loops_of(jax.value_and_grad(score), case.free)
    assert [one.reason for one in there_and_back if one.steps == 20] == ["", ""]
    (told,) = sl.loops_of(lambda x: lax.scan(lambda c, row: (jnp.sort(c), None), x, TABLE)[0], jnp.asarray(POINT))
    assert str(told) == "a loop of 20 steps: by XLA, for the operation sort"


def test_code_is_kept_beside_compiled_programs(cache_folder):
    """Where JAX keeps compiled programs machine code is kept too, and found again by what it says; what is damaged is
    made anew, and where nothing can be kept, it is made."""
    made = []

    def kept(text, code):
        return _native._kept(text, lambda: made.append(code) or code)

    assert [kept("a", b"1"), kept("b", b"2"), kept("a", b"3")] == [b"1", b"2", b"1"]
    assert made == [b"1", b"2"]
    kept_files = sorted(cache_folder.iterdir())
    assert len(kept_files) == 2
    for path in kept_files:
        path.write_bytes(path.read_bytes()[:-1] + b"x")
    assert [kept("a", b"5"), kept("a", b"6")] == [b"5", b"5"]
    (cache_folder / "file").write_text("")
    jax.config.update("jax_compilation_cache_dir", str(cache_folder / "file"))
    assert kept("a", b"4") == b"4"


@pytest.mark.parametrize("mapped", [False, True])
def test_what_is_compiled_for_another_platform_is_xlas(mapped):
    """A program for CUDA, which needs no GPU to be written, holds no call of machine code."""
    function = with_lane_loops(LOOPS["slopes"])
    x = jnp.asarray(lanes_of(9)) if mapped else jnp.asarray(POINT)
    program = jax.export.export(jax.jit(jax.vmap(function) if mapped else function), platforms=["cuda"])(x)
    assert "symplearn_lanes" not in program.mlir_module()
