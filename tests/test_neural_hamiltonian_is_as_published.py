"""The neural Hamiltonian is the published NSSNN: its size, its start, its derivatives and its symplectic steps."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import integrators as ig
from symplearn._errors import InputError
from symplearn._neural_hamiltonian import NSSNN, AuthorsInitialisation, Xavier
from symplearn._parameters import flatten


def forward(network, z):
    """H and its gradient at z by plain loops of numpy: the chain rule, layer by layer."""
    slopes = []
    for layer in network.layers[:-1]:
        W, b = np.asarray(layer.weights), np.asarray(layer.biases)
        z = 1.0 / (1.0 + np.exp(-(W @ z + b)))
        slopes.append((z * (1.0 - z))[:, None] * W)
    last = network.layers[-1]
    gradient = np.asarray(last.weights)
    for slope in reversed(slopes):
        gradient = gradient @ slope
    return float((np.asarray(last.weights) @ z + np.asarray(last.biases))[0]), gradient[0]


@pytest.mark.parametrize(("dim", "width", "count"), [(1, 64, 16_897), (2, 64, 17_025), (1, 3, 61)])
def test_number_of_parameters(dim, width, count):
    """With one degree of freedom and 64 units there are 16,897 numbers, and all of them learn."""
    network = NSSNN(dim, width, key=jax.random.key(0))
    plain = (2 * dim + 1) * width + 4 * (width + 1) * width + width + 1
    assert flatten(network)[0].size == plain == count
    assert len(network.layers) == 6
    assert {leaf.dtype for leaf in jax.tree.leaves(network)} == {jnp.dtype("float64")}


@pytest.mark.parametrize(
    ("drawn", "weight", "bias"),
    [
        (AuthorsInitialisation(), lambda m, n: np.sqrt(6 / m), lambda m: 1 / np.sqrt(m)),
        (Xavier(), lambda m, n: np.sqrt(6 / (m + n)), lambda m: 0.0),
    ],
)
def test_initial_ranges(drawn, weight, bias):
    """Weights start uniform in the published range of each layer, up to its ends; Xavier's biases are 0."""
    network = NSSNN(1, 64, key=jax.random.key(1), initialisation=drawn)
    for layer in network.layers:
        n, m = layer.weights.shape
        bound = weight(m, n)
        assert np.abs(layer.weights).max() <= bound and np.abs(layer.biases).max() <= bias(m)
        if m * n > 1000:
            # The largest of 4096 uniform draws falls short of the bound by 1/4096 on average; the variance of draws is
            # bound^2 / 3 within 5 of its standard errors, 2 / sqrt(5 * 4096).
            assert np.abs(layer.weights).max() > 0.99 * bound
            assert np.var(layer.weights) == pytest.approx(bound**2 / 3, rel=0.07)
    assert not np.array_equal(network.layers[1].weights, network.layers[2].weights)


def test_energy_and_derivatives_are_the_chain_rule():
    """H, dH/dq, dH/dp and the vector field are those of plain numpy loops to 1e-12."""
    network = NSSNN(2, 16, key=jax.random.key(2))
    for x in np.random.default_rng(0).normal(size=(5, 4)):
        q, p = jnp.asarray(x[:2]), jnp.asarray(x[2:])
        H, gradient = forward(network, x)
        # Round-off of six matrix products of numbers of order 1.
        assert float(network.energy(q, p)) == pytest.approx(H, abs=1e-12)
        assert np.allclose(network.slope(q, p), gradient[:2], atol=1e-12, rtol=0)
        assert np.allclose(network.velocity(q, p), gradient[2:], atol=1e-12, rtol=0)
        field = np.concatenate([gradient[2:], -gradient[:2]])
        assert np.allclose(network.vector_field(jnp.asarray(x)), field, atol=1e-12, rtol=0)


def test_tao_steps_of_a_network_are_symplectic():
    """On the doubled phase space a Tao step of any network keeps the symplectic form, to round-off."""
    network = NSSNN(1, 8, key=jax.random.key(3))
    tao = ig.Tao(20.0, ig.FirstCopy())
    states = jnp.asarray(np.random.default_rng(1).normal(size=(4, 4)))
    J = jax.jit(jax.vmap(jax.jacfwd(lambda state: tao.step(network, state, 0.0, 0.05))))(states)
    form = np.zeros((4, 4))
    for q, p in ((0, 1), (2, 3)):  # [q, p, x, y]
        form[q, p], form[p, q] = 1.0, -1.0
    defect = np.swapaxes(J, 1, 2) @ form @ np.asarray(J) - form
    # Some twenty products of matrices near 1, each with an error of 1e-16.
    assert np.abs(defect).max() < 1e-14
    # The step is no identity: it moves, and it turns the copies.
    assert np.abs(np.asarray(J) - np.eye(4)).max() > 0.1


@pytest.mark.parametrize("sizes", [{"dim": 0}, {"dim": 1, "width": 0}, {"dim": 1, "depth": 1}])
def test_sizes_that_make_no_network_are_refused(sizes):
    """A size that makes no network is named in one sentence."""
    with pytest.raises(InputError, match="`NSSNN` needs `(dim|width|depth)` of at least"):
        NSSNN(**sizes, key=jax.random.key(0))
