"""A force that remembers, as of a Maxwell element or a friction that gives before it slips, is found and told."""

import engine_cases as cases
import numpy as np
import pytest
from augmented_cases import LEAPFROG, LENGTH, MASS, START, TAO, A, K, M, P, Q, flow, widened
from engine_cases import solved

from symplearn._augmented import equations
from symplearn._effects import MEMORIES, RELAXING, SLIPPING, Nameless
from symplearn._errors import InputError
from symplearn._expression import symbol
from symplearn._terms import Mechanics
from symplearn.diagnosis import Options, diagnose
from symplearn.diagnosis._build import Restriction
from symplearn.diagnosis._memories import memories, written_memory

SOFT, CURVED = P**2 / (2 * M) + K * Q**4 / 4, (Q**2 + 1) * (P**2 + 1) / (2 * M) * K
KINDS = pytest.mark.parametrize("memory", MEMORIES, ids=["by time", "by way", "while loaded"])
# Effects that a spring with a loss of some kind is searched for.
FEW = ("viscous_damping", "quadratic_drag", "coulomb_friction", "linear_stiffness", "cubic_stiffness", "unnamed_force")


def spring(kappa, tau=np.inf, way=np.inf, c=0.0, cubic=0.0):
    """Rates of x'' = -20 x - 5 cubic x^3 - c v - w and of w, of mass one."""
    return lambda t, s: [s[1], -20 * s[0] - cubic * s[0] ** 3 - c * s[1] - s[2],
                         kappa * s[1] - s[2] / tau - abs(s[1]) * s[2] / way]  # fmt: skip


def swung(rates, start=(0.3, 0.0, 0.1), seed=0, rows=240):
    """Readings of the place with a noise of 0.003, a hundredth of the swing."""
    times = np.linspace(0.0, 16.0, rows)
    q = solved(rates, start, times)[:, 0]
    return cases.recorded(times, q + 0.003 * np.random.default_rng(seed).normal(size=rows))


def told(run):
    file = cases.simulation("p**2/2 + k*q**2/2", more="[parameters]\nk = 20.0")
    return diagnose(file, [run], Options(restriction=Restriction(FEW), jobs=2))


def lost(memory, v, w):
    """What fades, by hand."""
    if memory is RELAXING:
        return w
    return abs(v) * w if memory is SLIPPING or v * w > 0 else 0.0


@KINDS
@pytest.mark.parametrize(("hamiltonian", "method"), [(SOFT, LEAPFROG), (CURVED, TAO)], ids=["separable", "not"])
def test_it_moves_as_its_rates_say(memory, hamiltonian, method):
    """The flow with F = -w and dw/dt = kappa v - w / tau, or - |v| w / a always or while it is loaded, is DOP853's with
    a third state, begun with some w; a momentum is not a velocity."""
    nothing = Mechanics([Q], [P], hamiltonian, [0 * Q], {"y": Q}, start=0.0)
    built = equations(nothing, (M, K), (), nameless=[Nameless((0,), (), memory=one) for one in MEMORIES])
    one = next(c for c in built.candidates if c.effect is memory)
    values, lasting = np.zeros(built.size), 0.4
    values[one.values.start : one.values.stop + 1] = 0.8, 1 / lasting, 1.0
    x = widened(START, (0.0, 0.25))

    def rates(t, s):
        q, p, w = s
        slope, v = (
            (A * q**3, p / MASS) if method is LEAPFROG else (A / MASS * q * (p**2 + 1), A / MASS * p * (q**2 + 1))
        )
        return [v, -slope - w, 0.8 * v - lost(memory, v, w) / lasting]

    found = np.asarray(flow(built, method, values, x, 0.0, LENGTH / 300, 300))
    expected = solved(rates, [*START, 0.25], np.array([0.0, LENGTH]), 1e-12)[-1]
    # Splitting at order two at dt = 0.01: 1e-4 times some constants.
    np.testing.assert_allclose(found[[0, 2, 3]], expected, atol=4e-5)
    bare = np.asarray(flow(built, method, 0 * values, x, 0.0, LENGTH / 300, 300))
    assert np.abs(bare[[0, 2]] - expected[:2]).max() > 1e-2


@KINDS
def test_as_it_is_written_it_is_the_same(memory):
    """The expression and the rate that the augmented simulation gets have the numbers, dH/dp for the velocity, and a
    name that nothing else has; of any coordinate it is one choice of all."""
    file = cases.simulation(
        "p**2/(2*m) + q**2/2 + w**2/2 + r**2/2", ["q", "w"], ["p", "r"], more="[parameters]\nm = 2.0"
    )
    force, rates = written_memory(file, memory, "q", [0.8, 0.4])
    ((name, rate),) = rates.items()
    assert name not in file.names and force.text == f"-{name}"
    numbers = {symbol("m"): 2.0, symbol(name): 0.7}
    for p in (-3.0, 3.0):
        there = float(rate.tree.subs(numbers | {symbol("p"): p}))
        assert there == pytest.approx(0.8 * p / 2 - lost(memory, p / 2, 0.7) / 0.4, rel=1e-6)
    shares = [np.exp(-law.choices) for law in memories(file)]
    assert len(shares) == 6 and sum(shares) < 0.2  # the rest is for laws, and for none


@pytest.mark.parametrize(
    "memory",
    ["'2*w'", "{ w = 2 }", "{ q = '1', w = '1' }", "{ sin = '1', w = '1' }", "{ w = 'nobody' }", "{ v = '1' }"],
    ids=["no table", "a number", "declared already", "a function", "of nothing known", "another name"],
)
def test_a_memory_that_is_none_is_refused_in_one_sentence(memory):
    """What is no table of rates, a name that is taken, and one that nothing declares: file and place are told."""
    term = f'[[terms]]\neffect = "unnamed_force"\ntarget = "q"\nexpression = "-w"\nmemory = {memory}'
    with pytest.raises(InputError) as told:
        cases.simulation("p**2/2 + q**2/2", more=term)
    assert "case.toml, [[terms]] 1" in str(told.value) and "\n" not in str(told.value)


@pytest.mark.slow
def test_a_maxwell_element_is_told_by_its_spring_and_its_damper():
    """A spring of 4 and a damper of 2 in series beside a spring of 20, with a force of 0.1 in them at first: one force
    without a name, its kappa and tau inside their intervals, its law in words; with it nothing is left out."""
    run = swung(spring(4.0, tau=0.5))
    first = told(run)
    finding = the_force(first, kappa=4.0, tau=0.5)
    assert "a spring and a damper in series" in finding["sentence"] and "dw/dt" in finding["coefficients"]["memory"]
    (term,) = first.augmented.terms
    assert term.expression.text == "-w" and list(term.memory) == ["w"]
    assert any(line.startswith("dw/dt = ") for line in first.equation_after)
    fit = first.document["fit"]
    assert fit["after"]["holdout_rmse"]["y"] < 0.1 * fit["before"]["holdout_rmse"]["y"]
    assert told_again(first, run) == "consistent"


def the_force(told, **truths):
    """The one finding: a force without a name, every coefficient in its interval, which is narrow."""
    (finding,) = told.document["findings"]
    assert finding["effect"] == "unnamed_force" and finding["probability"] > 0.95
    for name, truth in truths.items():
        low, high = finding["coefficients"][name]["interval95"]
        assert low < truth < high and high - low < 0.2 * truth
    return finding


def told_again(first, run):
    """The verdict on the simulation that has what was found."""
    return diagnose(first.augmented, [run], Options(restriction=Restriction(FEW), jobs=2)).document["verdict"]


@pytest.mark.slow
def test_a_friction_that_gives_before_it_slips_is_told_by_where_it_slips():
    """A force that grows as a spring of 4 and turns into a friction of 0.24 within ways of 0.06 (Dahl): no dry
    friction, but a force that fades with the way, its kappa and a inside their intervals; with it nothing is left out.
    """
    run = swung(spring(4.0, way=0.06))
    first = told(run)
    finding = the_force(first, kappa=4.0, a=0.06)
    assert "hysteresis" in finding["sentence"]
    assert told_again(first, run) == "consistent"


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_what_has_names_is_not_remembered(seed):
    """Where a viscous damping and a cubic stiffness are missing these are told, and no force that remembers."""
    document = told(swung(spring(0.0, c=0.15, cubic=30.0), (0.3, 0.0, 0.0), seed)).document
    assert {one["effect"] for one in document["findings"]} == {"viscous_damping", "cubic_stiffness"}
