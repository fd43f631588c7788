"""A simulation written as text is read back as the same simulation."""

import dataclasses
import math
import pickle

import numpy as np
import pytest

from symplearn._errors import InputError
from symplearn._simulation_file import Quantity, Term, parse_simulation
from symplearn._simulation_text import simulation_text

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
