"""A damped pendulum, diagnosed by hand: the record that the report is made of, without a search."""

import dataclasses

import numpy as np
from scipy.integrate import solve_ivp

from symplearn._simulation_file import parse_simulation
from symplearn.diagnosis._record import Diagnosis, Forecast, Series

J, F, C = 0.006, 0.15, 0.0009
SIMULATION = """
title = "Pendulum without friction"
[system]
coordinates = ["theta"]
momenta = ["p"]
hamiltonian = "p**2/(2*J) - F*cos(theta)"
[parameters]
J = 0.006
F = { value = 0.15, sd = 0.002 }
[recording]
time = "t_s"
[recording.observe]
angle_deg = "theta*180/pi"
[units]
angle_deg = "°"
theta = "rad"
p = "kg m²/s"
t = "s"
"""
SENTENCE = (
    "A force against the motion of theta, proportional to its speed, was left out: "
    "c = 0.0009 kg m²/s per rad, between 0.00086 and 0.00094."
)


def motion(times, start, damping):
    """Angle and momentum of the pendulum, by SciPy."""
    flow = solve_ivp(
        lambda t, x: [x[1] / J, -F * np.sin(x[0]) - damping * x[1] / J],
        (times[0], times[-1]),
        start,
        t_eval=times,
        method="DOP853",
        rtol=1e-9,  # far below a picture's resolution
        atol=1e-11,
    )
    return flow.y


def series(rows=800, end=20.0, start=(1.1, 0.0), name="recording.csv", seed=0, columns=1):
    """One recording as the filter would leave it: close to the readings, then running freely."""
    rng = np.random.default_rng(seed)
    t = np.linspace(0.0, end, rows)
    q, p = motion(t, start, C)
    held = t > 0.75 * end
    fitted = ~held
    free = motion(t[held], (q[fitted][-1], p[fitted][-1]), 0.0)[0]
    degrees = np.degrees(q)
    readings = degrees + rng.normal(0, 0.6, rows)
    readings[rows // 3 : rows // 3 + rows // 40] = np.nan
    before = degrees + 0.25 * np.gradient(degrees, t) * 0.02
    before[held] = np.degrees(free)
    after = degrees + 0.1 * np.sin(t)
    v = p[fitted] / J
    force = -C * v + rng.normal(0, 3e-4, v.size)
    energy = p**2 / (2 * J) - F * np.cos(q)

    def channels(x):
        return np.tile(x[:, None], (1, columns))

    return Series(
        name=name,
        boundary=float(t[fitted][-1]),
        times=t,
        readings=channels(readings),
        before=channels(before),
        after=channels(after),
        fitted_times=t[fitted],
        position=q[fitted, None],
        velocity=v[:, None],
        force_before=force[:, None],
        force_after=(rng.normal(0, 3e-4, v.size))[:, None],
        strain_before=(force / 3e-4)[:, None],
        strain_after=rng.normal(size=(v.size, 1)),
        innovations_before=channels(rng.normal(size=v.size)),
        innovations_after=channels(rng.normal(size=v.size)),
        energy_before=energy[fitted],
        energy_after=energy[fitted] * 1.001,
    )


def document():
    """`diagnosis.json` of the damped pendulum."""
    return {
        "schema": "symplearn.diagnosis/1",
        "verdict": "mismatch",
        "probability": 0.9312,
        "log_bayes_factor": 221.4,
        "location": {
            "kind": "dynamics",
            "targets": ["theta"],
            "recordings": [1],
            "time_windows": [[0.0, 20.0]],
            "where": "grows with speed: explains 91 % of the missing force, 3 % is explained by position",
        },
        "findings": [
            {
                "effect": "viscous_damping",
                "target": "theta",
                "family": "dissipation",
                "recordings": [1],
                "probability": 0.9423,
                "log_bayes_factor": 219.7,
                "coefficients": {"c": {"mean": 0.00090321, "sd": 0.0000213, "interval95": [0.00086, 0.00094]}},
                "sentence": SENTENCE,
            }
        ],
        "alternatives": [
            {
                "findings": [
                    {"effect": "quadratic_drag", "target": "theta"},
                    {"effect": "coulomb_friction", "target": "theta"},
                ],
                "unexplained": False,
                "probability": 0.0512,
            },
            {"findings": [], "unexplained": True, "probability": 0.0101},
            {"findings": [], "unexplained": False, "probability": 0.0},
        ],
        "other": 0.0075,
        "family_probability": {"dissipation": 0.9898, "conservative": 0.0021},
        "parameters": {
            "before": {"F": {"mean": 0.14871, "sd": 0.0012}},
            "after": {"F": {"mean": 0.15012, "sd": 0.0004}},
        },
        "fit": {
            "before": {
                "holdout_rmse": {"angle_deg": 14.532},
                "holdout_misfit": {"angle_deg": 23.021},
                "holdout_log_density": -310.24,
                "process_noise_sd": {"p": 0.001132},
                "noise_sd": {"angle_deg": 0.6312},
            },
            "after": {
                "holdout_rmse": {"angle_deg": 0.61234},
                "holdout_misfit": {"angle_deg": 1.0177},
                "holdout_log_density": 142.93,
                "process_noise_sd": {"p": 0.0000171},
                "noise_sd": {"angle_deg": 0.6017},
            },
        },
        "next_measurement": "Release theta from a larger angle: quadratic drag outgrows viscous damping.",
        "warnings": [],
        "all_rows": None,
        "thinning": {"rows": 800, "used": 800},
        "converged": True,
        "complete": True,
        "version": "0.1.0",
        "seed": 0,
        "seconds": 24.8123,
    }


def forecast():
    """Two seconds beyond the end."""
    t = np.linspace(20.0, 22.0, 9)
    wave = 20 * np.cos(5 * t)
    spread = 0.5 + 0.3 * (t - 20)
    column = {"before": 1.4 * wave, "before_sd": 3 * spread, "after": wave, "after_sd": spread}
    return Forecast(times=t, columns={"angle_deg": column})


def damped_pendulum(**changed):
    """The whole record; fields may be changed by name."""
    record = Diagnosis(
        title="Pendulum without friction",
        document=document(),
        columns=("angle_deg",),
        coordinates=("theta",),
        units={"angle_deg": "°", "theta": "rad", "p": "kg m²/s", "t": "s"},
        equation_before=("d(p)/dt = -F*sin(theta)", "angle_deg = 180*theta/pi"),
        equation_after=("d(p)/dt = -F*sin(theta) - 0.0009032*p/J", "angle_deg = 180*theta/pi"),
        series=(series(),),
        augmented=parse_simulation(SIMULATION, "simulation.toml"),
    )
    return dataclasses.replace(record, **changed)


def consistent():
    """The same pendulum where nothing was left out: before and after are one, nothing is held out."""
    answer = document()
    answer |= {"verdict": "consistent", "probability": 0.9876, "log_bayes_factor": None, "findings": []}
    answer["location"] = {
        "kind": "none",
        "targets": [],
        "recordings": [],
        "time_windows": [],
        "where": "no part of the motion needs a force that is not there",
    }
    answer["fit"]["after"] = answer["fit"]["before"]
    answer["fit"]["before"]["holdout_rmse"] = answer["fit"]["before"]["holdout_misfit"] = {"angle_deg": None}
    answer["fit"]["before"]["holdout_log_density"] = None
    answer["parameters"]["before"] = answer["parameters"]["after"]
    one = series()
    one = dataclasses.replace(one, before=one.after, force_before=one.force_after, boundary=float(one.times[-1]))
    equations = ("d(p)/dt = -F*sin(theta)", "angle_deg = 180*theta/pi")
    return damped_pendulum(document=answer, series=(one,), equation_after=equations)


TWO_MASSES = """
title = "Two masses"
[system]
coordinates = ["x", "y"]
momenta = ["p_x", "p_y"]
hamiltonian = "(p_x**2 + p_y**2)/(2*m) + x**2 + y**2"
[parameters]
m = 1.0
[recording]
time = "t_s"
[recording.observe]
left = "x"
[units]
left = "m"
x = "m"
y = "m"
p_x = "N s"
p_y = "N s"
t = "s"
"""


def _estimates(**numbers):
    """Coefficients from their means and standard deviations."""
    return {
        name: {"mean": m, "sd": s, "interval95": [round(m - 2 * s, 9), round(m + 2 * s, 9)]}
        for name, (m, s) in numbers.items()
    }


def _found(effect, target, coefficients, recordings=(1, 2)):
    """A finding as the document has it."""
    return document()["findings"][0] | {
        "effect": effect,
        "target": target,
        "recordings": list(recordings),
        "coefficients": coefficients,
        "sentence": f"{effect} was left out.",
    }


def two_masses():
    """Two coordinates in two recordings: a pair, a side, several coefficients, and an effect that is in one only."""
    answer = document()
    answer["findings"] = [
        _found("coupling_spring", ["x", "y"], _estimates(k=(3.1, 0.1))),
        _found("contact_stop", "y", _estimates(k=(40.0, 2.0), a=(0.7, 0.01)) | {"side": "lower"}, (2,)),
        _found("periodic_forcing", "x", _estimates(a=(0.2, 0.02), omega=(2.1, 0.01), phi=(0.3, 0.05))),
        _found("unnamed_force", "x", {"expression": "-0.1*x**3"}),
    ]
    answer["location"] |= {
        "targets": [["x", "y"], "y", "x"],
        "recordings": [1, 2],
        "time_windows": [[0.0, 3.0, 1], [1.5, 3.0, 2]],
    }
    rivals = [_found("parameter_drift", "m", {}), _found("sensor_bias", "left", {}, (1,))]
    answer["alternatives"][0]["findings"] = rivals
    return damped_pendulum(
        document=answer,
        columns=("left",),
        coordinates=("x", "y"),
        units={"left": "m", "x": "m", "y": "m", "p_x": "N s", "p_y": "N s", "t": "s"},
        series=tuple(_doubled(series(rows=80, end=4.0, seed=k)) for k in range(2)),
        augmented=parse_simulation(TWO_MASSES, "simulation.toml"),
    )


def _doubled(one):
    """A recording with a second coordinate that lags behind the first."""
    names = ("position", "velocity", "force_before", "force_after", "strain_before", "strain_after")
    both = {name: np.hstack([getattr(one, name), np.roll(getattr(one, name), 7)]) for name in names}
    return dataclasses.replace(one, **both)
