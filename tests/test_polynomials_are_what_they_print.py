"""Polynomial Hamiltonians: their terms, their printed equation and their gradients agree."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.polynomial import legendre

import integrators as ig
from symplearn._hamiltonians import Legendre, Polynomial, PolynomialPotential

RNG = np.random.default_rng(0)
CASES = {
    "potential": PolynomialPotential(2, 3, RNG.normal(size=9)),
    "general": Polynomial(2, 3, RNG.normal(size=34)),
    "legendre potential": PolynomialPotential(2, 4, RNG.normal(size=14), Legendre((1.5, 0.7))),
    "legendre": Polynomial(1, 5, RNG.normal(size=20), Legendre(2.0)),
}


@pytest.mark.parametrize("name", CASES)
def test_analytic_gradients_are_automatic_ones(name):
    """Velocity and slope equal derivatives of the energy, at random points and where coordinates are zero."""
    H = CASES[name]
    energy = jax.jit(jax.grad(H.energy, argnums=(0, 1)))
    analytic = jax.jit(lambda q, p: (H.slope(q, p), H.velocity(q, p)))
    for scale in (1.0, 0.0):
        q, p = scale * RNG.normal(size=(2, H.dim))
        for found, expected in zip(analytic(q, p), energy(q, p), strict=True):
            # Sums of up to 34 terms of size up to 1e2.
            np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize(("dim", "degree", "terms"), [(2, 3, 34), (1, 2, 5), (2, 1, 4)])
def test_all_monomials_are_there_once(dim, degree, terms):
    """The general polynomial has every monomial of total degree 1..n in 2d variables, once: 34 for (2, 3)."""
    names = Polynomial(dim, degree).terms
    assert len(names) == len(set(names)) == terms


@pytest.mark.parametrize("name", ["potential", "general"])
def test_the_printed_equation_is_the_energy(name):
    """Evaluated by hand from its words, the printed equation gives the energy up to printed digits."""
    H = CASES[name]
    q, p = RNG.normal(size=(2, 2))
    numbers = dict(zip(("q0", "q1", "p0", "p1"), (*q, *p), strict=True))
    total, coefficient = 0.0, 1.0
    words = str(H).removeprefix("H(q, p) = ").split()
    for k, word in enumerate(words + ["+0"]):
        if word == "p'p/2":
            total += 0.5 * p @ p
        elif word[0] in "+-":
            total += coefficient if k and words[k - 1] != "p'p/2" else 0.0
            coefficient = float(word)
        else:
            base, _, power = word.partition("^")
            coefficient *= numbers[base] ** int(power or 1)
    # Coefficients are printed with six digits, and there are up to 34 terms.
    assert total == pytest.approx(float(H.energy(jnp.asarray(q), jnp.asarray(p))), abs=1e-4)


def test_legendre_products_are_scipys():
    """In one variable the Legendre potential is numpy's Legendre series of q / box."""
    H = PolynomialPotential(1, 5, RNG.normal(size=5), Legendre(1.7))
    expected = legendre.legval(0.9 / 1.7, np.concatenate([[0.0], H.coefficients]))
    assert float(H.potential(jnp.array([0.9]))) == pytest.approx(expected, rel=1e-13)
    assert H.terms[1] == "P2(q)"


def test_henon_heiles_is_a_polynomial_potential():
    """With its nine coefficients set, the potential moves as the zoo's Henon-Heiles does."""
    H = PolynomialPotential(2, 3, jnp.array([0, 0, 0.5, 0, 0.5, 0, 1.0, 0, -1 / 3]))
    assert H.terms[6] == "q0^2 q1"
    x0, ts = jnp.array([0.0, 0.1, 0.35, -0.25]), jnp.linspace(0.0, 10.0, 11)
    ours = ig.integrate(H, ig.Leapfrog(), x0, ts, substeps=20).xs
    zoo = ig.integrate(ig.problems.HenonHeiles(1.0), ig.Leapfrog(), x0, ts, substeps=20).xs
    # The same steps; only round-off, grown over 200 of them, differs.
    np.testing.assert_allclose(ours, zoo, atol=1e-12)


def test_systems_side_by_side_print_a_line_each():
    """Coefficients with a leading axis, as `vmap` takes them, print as the equations of their rows."""
    rows = np.array([[1.0, 2.0], [0.0, -3.0]])
    assert str(PolynomialPotential(1, 2, rows)) == "\n".join(str(PolynomialPotential(1, 2, row)) for row in rows)
