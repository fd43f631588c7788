"""Concealed cases drawn by hand: a system with the noise and the effects that a test asks for."""

import numpy as np

from experiments._concealed_drawing import Public, Wish, _records
from experiments._concealed_effects import Effect
from experiments._concealed_files import answer
from experiments._concealed_hiding import Claim, weights
from experiments._concealed_nature import Case
from experiments._concealed_plan import Plan
from experiments._concealed_planes import ZOO
from experiments._concealed_sensors import Setup, expected, moved

NOTHING = Claim(0.0, 0.0, 1.0, 0.0, 0.0, 0.0)


def setting(name, columns=None, rows=120, noise=0.02, **wish):
    """A setup of a system with the noise a part of one, and all parameters known."""
    system, rng = ZOO[name], np.random.default_rng(0)
    values = system.draw(rng)
    records = tuple(
        r._replace(times=r.times[:rows], forecast=r.forecast[:10])
        for r in _records(rng, system, values, Wish(name, **wish), 1)
    )
    readings = tuple(r for r in system.readings if (r.kind == "position" if columns is None else r.column in columns))
    setup = Setup(system, values, readings, {r.column: noise for r in readings}, "gaussian", 5.0, records)
    return setup, Public((), {}, {}, ((),) * len(records))


def case_of(setup, public, *effects):
    """A case with these effects and Gaussian noise."""
    rng, clean, after = np.random.default_rng(1), [], []
    for record in setup.records:
        motion = moved(setup, record, effects)
        clean.append(expected(setup, record, effects, motion, record.times))
        after.append(expected(setup, record, effects, motion, record.forecast))
    noisy = [c + weights(setup) * rng.normal(size=c.shape) for c in clean]
    item = Plan(1, not effects, "open", "", False, "")
    return Case(item, setup, public, effects, (), 0.0, tuple(noisy), tuple(clean), tuple(after), NOTHING, 1)


def damped_duffing():
    """A damped Duffing oscillator with hardly any noise, 13 rows in a period: its answer and readings."""
    setup, public = setting("duffing", rows=160, noise=0.0001)
    size = setup.values["m"] * 2 * np.pi / setup.system.period(setup.values)
    case = case_of(setup, public, Effect("viscous_damping", "q", {"c": float(0.02 * size)}))
    return answer(case), case.noisy
