"""However few unknowns a start has, it is found in rows that show the motion turn, so that no stiffness is lost."""

import engine_cases as cases
import numpy as np
from engine_cases import Restriction, augmented_equations, build

from symplearn.diagnosis._start import first_fits, priors_without_effects
from symplearn.diagnosis._trajectory import Stepper

MASS, STIFFNESS, DAMPING = 0.8, 280.0, 6.0
TIMES = np.arange(0.0, 1.12, 0.01)


def test_a_spring_keeps_its_stiffness():
    """A mass on a spring that is damped fast, read 34 times in a period, whose stiffness nobody knows, and no unseen
    oscillator looked for: in eight rows a straight line would do as well, and a start without any stiffness."""
    rates = lambda t, x: [x[1], -(STIFFNESS * x[0] + DAMPING * x[1]) / MASS]  # noqa: E731
    readings = np.round(cases.solved(rates, [-105.0, 2000.0], TIMES)[:, 0])
    unknown = f"[parameters]\nm = {MASS}\nk = {{ value = 250.0, positive = true }}\n"
    file, only = cases.simulation("p**2/(2*m) + k*q**2/2", more=unknown), Restriction(("viscous_damping",))
    p = build(file, augmented_equations(file, 0.0, only), [cases.recorded(TIMES, readings)], 0.3, 0.01, only)
    assert p.state == 2
    fits = first_fits(Stepper(p, 1), priors_without_effects(p), [p.rows[0].fitted])
    assert 0.5 * STIFFNESS < fits.z[0, p.head] < 2 * STIFFNESS
