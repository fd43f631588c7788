"""What no trajectory has is left out of the work, and nothing else changes; loops are asked to be whole ones."""

import jax.numpy as jnp
import numpy as np
import pytest
from augmented_cases import CURVED, LEAPFROG, MASS, SOFT, START, TAO, A, vector, widened

from symplearn import _loops
from symplearn._augmented_flow import SimulatedFlow, SimulatedReading, Span
from symplearn._augmented_system import Switches

SPAN = Span(jnp.asarray(0.2), jnp.asarray(0.02), jnp.zeros((1, 0)), jnp.asarray(50))
WITHOUT = Switches(friction=False, impulses=False, delays=False, forcing=False, changes=False, stops=False)


@pytest.mark.parametrize(("built", "method"), [(SOFT, LEAPFROG), (CURVED, TAO)], ids=["separable", "nonseparable"])
def test_switching_off_what_is_absent_changes_nothing(built, method):
    """With drag alone, flow and readings are the same with everything else that has a switch worked out or left out."""
    numbers = jnp.array([MASS, A]), jnp.asarray(vector(built, "quadratic_drag", {"c": 0.4}))
    x = jnp.asarray(widened(START))
    full, less = (SimulatedFlow(built, method, *numbers, *s)(x, SPAN) for s in ((), (WITHOUT,)))
    # The compiler may add in another order: round-off of fifty substeps.
    np.testing.assert_allclose(less, full, rtol=1e-12)
    assert np.abs(full - x).max() > 0.1
    context = jnp.asarray(1.2), jnp.zeros(0)
    full, less = (SimulatedReading(built, *numbers, *s)(x, context) for s in ((), (WITHOUT,)))
    # A delay of nothing goes back by nothing: round-off.
    np.testing.assert_allclose(less, full, rtol=1e-12)


@pytest.mark.parametrize(
    ("effect", "target", "values"),
    [
        ("coulomb_friction", "q", {"f": 0.3}),
        ("impulse", "q", {"j": 0.4, "t_star": 0.5}),
        ("periodic_forcing", "q", {"a": 0.3, "omega": 2.0, "phi": 0.4}),
        ("parametric_modulation", "a", {"a": 0.3, "omega": 2.0, "phi": 0.4}),
        ("regime_change", "a", {"d": 0.3, "t_star": 0.5}),
        ("contact_stop", "q", {"k": 3.0, "a": 0.5}),
    ],
)
def test_what_is_switched_off_is_not_there(effect, target, values):
    """A switch does leave its effects out: the flow is that of the plain simulation."""
    plain, on = np.zeros(SOFT.size), vector(SOFT, effect, values, target)
    run = lambda c, *s: SimulatedFlow(SOFT, LEAPFROG, jnp.array([MASS, A]), jnp.asarray(c), *s)(  # noqa: E731
        jnp.asarray(widened(START)), SPAN
    )
    # Only the compiled order of additions may differ: round-off of fifty substeps.
    np.testing.assert_allclose(run(on, WITHOUT), run(plain), rtol=1e-12)
    assert np.abs(run(on) - run(plain)).max() > 0.05


@pytest.mark.parametrize(
    ("given", "jaxlib", "asked"),
    [("", "0.10.2", True), ("--xla_cpu_max_isa=AVX2", "0.10.2", True), ("", "0.11.0", True), ("", "0.12.0", False),
     ("--xla_backend_extra_options=mine", "0.10.2", False)],
)  # fmt: skip
def test_the_users_own_flags_stay(monkeypatch, given, jaxlib, asked):
    """Flags that are set stay; the option is added once, and to versions of jaxlib only that know it."""
    monkeypatch.setenv("XLA_FLAGS", given)
    monkeypatch.setattr(_loops, "version", lambda name: jaxlib)
    _loops.ask_for_whole_loops()
    _loops.ask_for_whole_loops()
    flags = _loops.os.environ["XLA_FLAGS"]
    assert flags.startswith(given) and flags.count("small_while_loop") == int(asked)
