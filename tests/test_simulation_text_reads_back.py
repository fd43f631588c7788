"""A simulation written as text is read back as the same simulation."""

import dataclasses
import math
import pickle

import numpy as np
import pytest

from symplearn._effects import RELAXING
from symplearn._errors import InputError
from symplearn._expression import symbol
from symplearn._simulation_file import Quantity, Term, parse_simulation
from symplearn._simulation_text import simulation_text
from symplearn._symbolic import derivative
from symplearn.diagnosis._memories import written_memory
from symplearn.diagnosis._unnamed import written

FULL = r'''
title = "A \"quoted\" title\nof two lines, ünïcode \u0007 and \\"
[system]
coordinates = ["x", "y"]
momenta = ["p", "r"]
hamiltonian = """p**2/2 + r**2/(2*m)
  + k*x**2"""
[parameters]
m = 1
k = { value = 0.1, sd = 1e-300, positive = true, lower = 0.05, upper = 3e10 }
free = { value = -2.5 }
[initial]
x = { value = 1.0 }
p = 0
[forces]
p = "gain*u"
[recording]
time = "t [s]"
inputs = ["u", "gain"]
interpolation = "linear"
start = { "1" = 0.5, "2 b" = 1 }
end = 3
group = ["run", "day"]
where = { ball = "ten\tnis", n = 3 }
[recording.observe]
"angle (deg)" = "x*180/pi"
b = "y"
[recording.noise]
b = 0.1
[units]
t = "s"
"angle (deg)" = "°"
[integrator]
name = "tao"
step = 0.01
[[terms]]
effect = "gyroscopic_coupling"
target = ["x", "y"]
b = { value = 1, sd = 0.3 }
recordings = [1, 3]
[[terms]]
effect = "unnamed_force"
target = "x"
expression = "-x**3 + sin(t)"
[[terms]]
effect = "contact_stop"
target = "x"
side = "lower"
k = 1
a = 2
[[terms]]
effect = "coupling_spring"
target = ["y", "x"]
k = 2
[[terms]]
effect = "unnamed_force"
target = "y"
expression = "-w"
memory = { w = "2*x - w" }
'''
SHORT = """
[system]
coordinates = ["q"]
momenta = ["p"]
hamiltonian = "p**2/2 + q**2/2"
[recording]
time = "t"
[recording.observe]
q = "q"
"""


@pytest.mark.parametrize("text", [FULL, SHORT])
def test_text_reads_back_as_an_equal_record(text):
    """Reading what was written gives an equal record, twice over."""
    simulation = parse_simulation(text, "a.toml")
    written = simulation_text(simulation)
    assert parse_simulation(written, "b.toml") == simulation
    assert simulation_text(parse_simulation(written, "b.toml")) == written


def test_every_section_is_read():
    """What the file says is what the record holds."""
    simulation = parse_simulation(FULL, "a.toml")
    assert simulation.states == ("x", "y", "p", "r")
    assert simulation.names == ("x", "y", "p", "r", "m", "k", "free", "u", "gain")
    assert simulation.parameters["m"] == Quantity(1.0)
    assert simulation.parameters["k"] == Quantity(0.1, False, 1e-300, True, 0.05, 3e10)
    assert simulation.initial == {"x": Quantity(1.0, known=False), "p": Quantity(0.0)}
    assert simulation.recording.start == {"1": 0.5, "2 b": 1.0} and simulation.recording.end == 3.0
    assert simulation.recording.group == ("run", "day")
    assert simulation.recording.where == {"ball": "ten\tnis", "n": 3.0}
    assert [t.effect for t in simulation.terms][::3] == ["gyroscopic_coupling", "coupling_spring"]
    assert simulation.terms[0].recordings == (1, 3) and simulation.terms[2].side == "lower"
    assert simulation.terms[3].target == ("x", "y")  # sorted into the order of the coordinates
    assert simulation.terms[4].memory["w"].text == "2*x - w" and not simulation.terms[1].memory
    assert simulation.unknowns == 3 and simulation.unknown_states == 3
    assert simulation.hamiltonian.text.startswith("p**2/2 + r**2/(2*m)\n")


def test_the_users_words_are_repeated():
    """The augmented file repeats every expression as the user wrote it."""
    assert 'hamiltonian = "p**2/2 + r**2/(2*m)\\n  + k*x**2"' in simulation_text(parse_simulation(FULL, "a.toml"))


def test_a_changed_record_is_written():
    """New values and terms, NumPy numbers among them, are written exactly."""
    simulation = parse_simulation(SHORT, "a.toml")
    found = np.float64(0.1) * 3
    term = Term("viscous_damping", ("q",), {"c": Quantity(found)})
    changed = dataclasses.replace(simulation, terms=(term,), parameters={"k": Quantity(math.pi, False, 0.1)})
    again = parse_simulation(simulation_text(changed), "b.toml")
    assert again == changed
    assert again.terms[0].coefficients["c"].value == 0.1 * 3  # to the last bit


def test_a_record_travels_to_another_process():
    """Records are pickled whole, parsed trees included."""
    simulation = parse_simulation(FULL, "a.toml")
    assert pickle.loads(pickle.dumps(simulation)) == simulation


def test_gyroscopic_order_has_a_meaning():
    """A pair written against the order of the coordinates is refused where that changes a sign."""
    with pytest.raises(InputError, match="swap the two names and the sign of b"):
        parse_simulation(FULL.replace('target = ["x", "y"]', 'target = ["y", "x"]'), "a.toml")


def test_a_force_along_a_kink_is_read_back():
    """Where the energy has a kink, here H = p^3/2 above zero and 0 below, a force that was found and goes with the
    velocity is written in words that are read back, as is what one that fades remembers: as numbers they are those of
    v = 3 p^2/2 and 0, worked out by hand."""
    file = parse_simulation(SHORT.replace("p**2/2 + q**2/2", "p**2/2*max(p, 0) + q**2/2"), "short.toml")
    force = written([derivative(file.hamiltonian.tree, file.symbols["p"])], [-0.4])
    faded, rates = written_memory(file, RELAXING, "q", [0.8, 2.0])
    terms = (Term("unnamed_force", ("q",), {}, expression=force),
             Term("unnamed_force", ("q",), {}, expression=faded, memory=rates))  # fmt: skip
    again = parse_simulation(simulation_text(dataclasses.replace(file, terms=terms)), "augmented.toml").terms
    for p, v in ((-1.0, 0.0), (0.5, 0.375), (2.0, 6.0)):
        at = {"p": p, "w": 0.3}
        found = [one.tree.subs({symbol(name): value for name, value in at.items()})
                 for one in (again[0].expression, again[1].memory["w"])]  # fmt: skip
        np.testing.assert_allclose(np.array(found, float), [-0.4 * v, 0.8 * v - 0.15], rtol=1e-14)  # rounding
