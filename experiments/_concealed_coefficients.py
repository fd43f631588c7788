"""Coefficients of an effect in a given setting: of natural size, so that strengths compare between effects."""

from typing import NamedTuple

import numpy as np

from ._concealed_drawing import Unsuitable
from ._concealed_effects import OUTSIDE, PAIRED, PARAMETRIC, SENSOR, Effect
from ._concealed_motion import true_motion
from ._concealed_sensors import Setup
from ._concealed_systems import Generator, System, log_uniform


class Sizes(NamedTuple):
    """Of the motion without effects in the first recording: states, velocities, forces; periods and span."""

    q: np.ndarray  # (coordinate, row)
    p: np.ndarray
    v: np.ndarray
    force: np.ndarray  # rms by coordinate
    omega: float
    times: np.ndarray


def sizes(setup: Setup) -> Sizes:
    """What the coefficients are scaled by."""
    record, d = setup.records[0], setup.system.dof
    x = true_motion(setup.world(record, ()), record.start, record.begin, float(record.times[-1])).at(record.times)
    q, p = x[:d], x[d:]
    v = np.array([np.broadcast_to(one, q.shape[1]) for one in setup.system.velocity(q, p, setup.values)])
    force = np.array([np.sqrt(np.mean(np.square(one))) for one in setup.system.force(q, p, setup.values)])
    force = np.maximum(force, [np.ptp(one) * 2 * np.pi / setup.system.period(setup.values) / 4 for one in p])
    return Sizes(q, p, v, force, 2 * np.pi / setup.system.period(setup.values), record.times)


def rms(x: np.ndarray) -> float:
    """Root of the mean square."""
    return float(np.sqrt(np.mean(np.square(x))))


def targets(word: str, setup: Setup) -> list[str | tuple[str, ...]]:
    """Everything that an effect may act on in a setting; empty where it makes no sense."""
    system = setup.system
    if word in SENSOR or word == "ripple":
        return [r.column for r in setup.readings]
    if word in PARAMETRIC:
        return [n for n in system.varied if not any(system.mentions(n, r) for r in setup.readings)]
    if word in PAIRED:
        fits = system.dof == 2 and system.alike and (word != "central_correction" or system.around_origin)
        return [system.coordinates] if fits else []
    if word == "coulomb_friction" and not system.diagonal:
        return []
    return list(system.coordinates)


def suits(word: str, system: System) -> bool:
    """Whether a system can carry an effect at all."""
    if word in PAIRED:
        return system.dof == 2 and system.alike and (word != "central_correction" or system.around_origin)
    if word == "sensor_delay" and system.drive is not None:
        return False
    return word != "coulomb_friction" or system.diagonal


def unit_effect(rng: Generator, word: str, target: str | tuple[str, ...], setup: Setup, at: Sizes) -> Effect:
    """An effect about as strong as what is there already (a forcing as large as the forces, a gain of one ...)."""
    if word in SENSOR or word == "ripple":
        return Effect(word, target, _of_sensor(rng, word, str(target), setup, at))
    if word in PARAMETRIC:
        return Effect(word, target, _of_parameter(rng, word, at))
    if word in PAIRED:
        return Effect(word, target, _of_pair(rng, word, at))
    i = setup.system.coordinates.index(str(target))
    return Effect(word, target, _of_coordinate(rng, word, i, at))


def _sign(rng: Generator) -> float:
    return float(rng.choice([-1.0, 1.0]))


def _when(rng: Generator, at: Sizes) -> float:
    """A time between rows, early enough that three quarters of the rows show it."""
    span = at.times[-1] - at.times[0]
    return float(np.round(at.times[0] + span * rng.uniform(0.12, 0.62), 6)) + 1.37e-7


def _of_sensor(rng: Generator, word: str, column: str, setup: Setup, at: Sizes) -> dict:
    (reading,) = (r for r in setup.readings if r.column == column)
    size, sd = rms(reading.see(at.q, at.p, setup.values)), setup.noise[column]
    if word == "sensor_noise":
        return {"s": float(rng.uniform(0.5, 0.8) if rng.random() < 0.5 else rng.uniform(1.25, 2.2))}
    if word == "sensor_outliers":
        return {"e": float(rng.uniform(0.015, 0.05)), "sd": float(sd * rng.uniform(6, 20))}
    if word == "sensor_delay":
        return {"tau": 1.0 / at.omega}
    if word == "ripple":
        return {"a": sd, "w": size * float(rng.uniform(0.4, 1.5)), "phi": float(rng.uniform(-np.pi, np.pi))}
    if word == "sensor_drift":
        return {"r": _sign(rng) * size / (at.times[-1] - at.times[0])}
    return {"b": _sign(rng) * size} if word == "sensor_bias" else {"g": _sign(rng)}


def _wave(rng: Generator, at: Sizes) -> dict:
    """A frequency with at least two cycles in the recording, below a third of the sampling rate's half."""
    low = 2 * np.pi * 2 / (at.times[-1] - at.times[0])
    high = min(np.pi / np.median(np.diff(at.times)) / 3, 2.5 * at.omega)
    if low >= high:
        raise Unsuitable("too short for a frequency")
    return {"omega": log_uniform(rng, max(low, 0.15 * at.omega), high), "phi": float(rng.uniform(-3.1, 3.1))}


def _of_parameter(rng: Generator, word: str, at: Sizes) -> dict:
    if word == "parametric_modulation":
        return {"a": 1.0, **_wave(rng, at)}
    if word == "parameter_drift":
        return {"r": _sign(rng) / (at.times[-1] - at.times[0])}
    return {"d": _sign(rng)} | ({"t_star": _when(rng, at)} if word == "regime_change" else {})


def _of_pair(rng: Generator, word: str, at: Sizes) -> dict:
    force = float(np.mean(at.force))
    if word == "relative_damping":
        return {"c": force / rms(at.v[0] - at.v[1])}
    if word == "coupling_spring":
        return {"k": _sign(rng) * force / rms(at.q[0] - at.q[1])}
    if word == "gyroscopic_coupling":
        return {"b": _sign(rng) * force / rms(at.v)}
    return {"b": _sign(rng) * force * float(np.mean(np.hypot(*at.q))) ** 4 / 3}


def _of_coordinate(rng: Generator, word: str, i: int, at: Sizes) -> dict:
    q, v, force, omega = at.q[i], at.v[i], float(at.force[i]), at.omega
    q_size, v_size, largest = rms(q), rms(v), float(np.max(np.abs(q)))
    if word == "contact_stop":
        return _stop(rng, q, force)
    if word == "self_excitation":
        return {"c": force / v_size, "a": largest * float(rng.uniform(0.4, 1.3))}
    if word == "periodic_forcing":
        return {"a": force, **_wave(rng, at)}
    if word == "hidden_oscillator":
        own = omega * log_uniform(rng, 0.3, 2.0)
        start = {"z_0": rng.normal() / own**2 * q_size, "w_0": rng.normal() / own * q_size}
        return {"omega": own, "kappa": own * np.sqrt(force / q_size)} | {k: float(s) for k, s in start.items()}
    if word in OUTSIDE:
        return _outside(rng, word, q, v, force, at)
    signed = _sign(rng) * force
    return {
        "viscous_damping": {"c": force / v_size},
        "quadratic_drag": {"c": force / v_size**2},
        "coulomb_friction": {"f": force},
        "constant_force": {"f": signed},
        "linear_stiffness": {"k": signed / q_size},
        "quadratic_stiffness": {"k": signed / q_size**2},
        "cubic_stiffness": {"k": signed / q_size**3},
        "impulse": {"j": signed / omega, "t_star": _when(rng, at)},
    }[word]


def _stop(rng: Generator, q: np.ndarray, force: float) -> dict:
    side = str(rng.choice(["upper", "lower"]))
    share = float(rng.uniform(0.03, 0.18))
    a = float(np.quantile(q, 1 - share if side == "upper" else share))
    depth = np.max(q) - a if side == "upper" else a - np.min(q)
    return {"k": force / max(float(depth), 1e-6), "a": float(f"{a:.5g}"), "side": side}


def _outside(rng: Generator, word: str, q: np.ndarray, v: np.ndarray, force: float, at: Sizes) -> dict:
    if word == "burst":
        begin, span = _when(rng, at), at.times[-1] - at.times[0]
        return {"f": _sign(rng) * force, "t_on": begin, "t_off": begin + float(span * rng.uniform(0.02, 0.08))}
    return {
        "cubic_damping": {"c": force / rms(v) ** 3},
        "saturating_friction": {"c": force, "w": rms(v) * float(rng.uniform(0.3, 0.6))},
        "quintic_stiffness": {"k": _sign(rng) * force / rms(q) ** 5},
        "position_damping": {"c": force / (rms(q) ** 2 * rms(v))},
        "hysteresis": {"k": force / rms(q), "w": rms(q) * float(rng.uniform(0.3, 1.0))},
        "delayed_force": {"k": _sign(rng) * force / rms(q), "tau": float(rng.uniform(0.1, 0.4) * 2 * np.pi / at.omega)},
    }[word]
