"""Rigs of a student's laboratory: several effects act at once, of which the simulation has none; sensors err a little.

A motion loses some 0.3 to 1.6 e-folds of its amplitude over the recording, in a mixture of ways; springs are slightly
bent, zeros off, scales uneven. Shares no code with the package. Dry friction turns within a five-hundredth of the
greatest speed.
"""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from scipy.integrate import solve_ivp

Values = dict[str, float]
Rates = Callable[[float, np.ndarray], list[float]]


@dataclass(frozen=True)
class Rig:
    """A simulation as it is given, what acts in truth, and how it is read.

    `effects` tells for each of `values`, coefficients of accelerations or of readings, the word and the target that the
    contract has for it; `given` has mean and sd of each of the `parameters`; `scale` is of the positions.
    """

    hamiltonian: str
    coordinates: list[str]
    momenta: list[str]
    observe: dict[str, str]
    effects: dict[str, tuple[str, str]]
    values: Values
    parameters: Values
    given: dict[str, tuple[float, float]]
    start: np.ndarray
    times: np.ndarray
    noise: np.ndarray
    rates: Callable[[Values, Values], Rates]
    shown: Callable[[np.ndarray, np.ndarray, Values, Values], np.ndarray]
    spoilt: Callable[[np.ndarray, np.random.Generator], np.ndarray]
    scale: float = 1.0
    jitter: float = 0.0
    known: Values = field(default_factory=dict)
    inputs: dict[str, np.ndarray] = field(default_factory=dict)


def motion(
    rig: Rig, values: Values, parameters: Values, start: np.ndarray, times: np.ndarray, quickly: bool = False
) -> np.ndarray:
    """States (time, 2 d) by SciPy's DOP853, or a hundred times as coarse by LSODA; very large where it gives up."""
    method, tolerance = ("LSODA", 1e-8) if quickly else ("DOP853", 1e-10)
    found = solve_ivp(rig.rates(values, parameters), (times[0], times[-1]), start, method, times, rtol=tolerance,
                      atol=0.01 * tolerance * rig.scale, max_step=np.ptp(times) / 200)  # fmt: skip
    done = found.success and found.y.shape[1] == len(times)
    return found.y.T if done else np.full((len(times), len(start)), 1e3 * rig.scale)


def recorded(rig: Rig, rng: np.random.Generator) -> np.ndarray:
    """Readings (time, column): of times that jitter, spoilt and noisy."""
    moved = rig.times + rig.jitter * rng.normal(size=len(rig.times))
    moved = np.maximum.accumulate(np.append(rig.times[0], moved[1:]))
    moved += 1e-9 * np.ptp(rig.times) * np.arange(len(moved)) / len(moved)  # each later than the one before
    states = motion(rig, rig.values, rig.parameters, rig.start, moved)
    return rig.spoilt(rig.shown(states, rig.times, rig.values, rig.parameters), rng)


def _losses(rng: np.random.Generator, size: float, frequency: float, span: float) -> Values:
    """Viscous, quadratic and dry, of random shares, which together take some 0.5 to 1.3 e-folds of the amplitude."""
    rate, (viscous, quadratic, dry) = rng.uniform(0.5, 1.3) / span, rng.dirichlet([1.0, 0.7, 0.8])
    return {"viscous": 2 * rate * viscous, "quadratic": 3.4 * rate * quadratic / (size * frequency),
            "dry": 0.95 * rate * dry * size * frequency}  # fmt: skip


def _lost(c: Values, v: float, fastest: float) -> float:
    """The acceleration that they make."""
    return -c["viscous"] * v - c.get("quadratic", 0.0) * abs(v) * v - c["dry"] * np.tanh(500 * v / fastest)


def _priors(rng: np.random.Generator, parameters: Values, share: float) -> dict[str, tuple[float, float]]:
    """Mean and sd of each, the mean as wrong as the sd tells."""
    return {k: (v * (1 + share * rng.normal()), share * v) for k, v in parameters.items()}


def _times(
    rng: np.random.Generator, frequency: float, periods: tuple[float, float], rows: tuple[int, int]
) -> np.ndarray:
    n, span = int(rng.integers(*rows)), rng.uniform(*periods) * 2 * np.pi / frequency
    return np.arange(n) * span / n


LOSSES = {"viscous": "viscous_damping", "quadratic": "quadratic_drag", "dry": "coulomb_friction"}


def pendulum(rng: np.random.Generator) -> Rig:
    """On an encoder: three losses, a zero that is off, a slightly bent restoring force."""
    w2, size = rng.uniform(8, 40), rng.uniform(0.5, 1.2)
    w, step = np.sqrt(w2), rng.choice([2 * np.pi / 2000, 2 * np.pi / 4096])
    times = _times(rng, w, (15, 40), (350, 800))
    values = _losses(rng, size, w, np.ptp(times)) | {"bias": 0.008 * rng.normal(), "cubic": 0.006 * w2 * rng.normal()}
    words = {k: (word, "theta") for k, word in LOSSES.items()}
    return Rig(
        "p**2/2 - w2*cos(theta)", ["theta"], ["p"], {"angle_rad": "theta"},
        words | {"bias": ("sensor_bias", "angle_rad"), "cubic": ("cubic_stiffness", "theta")},
        values, {"w2": w2}, _priors(rng, {"w2": w2}, 0.015), np.array([size, 0.0]), times,
        np.array([step / np.sqrt(12)]),
        lambda c, p: lambda t, y: [y[1], -p["w2"] * np.sin(y[0]) - c["cubic"] * y[0] ** 3 + _lost(c, y[1], size * w)],
        lambda y, t, c, p: y[:, :1] + c["bias"], lambda y, g: np.round(y / step) * step, jitter=rng.uniform(0, 4e-4),
    )  # fmt: skip


def cart(rng: np.random.Generator) -> Rig:
    """Between springs, filmed: three losses, springs that are bent, a lens whose scale goes with the place."""
    k, size = rng.uniform(4, 60), rng.uniform(0.05, 0.3)
    w, lens, noise = np.sqrt(k), 0.01 * rng.normal() / size**2, size * rng.uniform(0.003, 0.01)
    times = _times(rng, w, (8, 25), (200, 600))
    values = _losses(rng, size, w, np.ptp(times))
    values |= {"cubic": 0.06 * k / size**2 * rng.normal(), "square": 0.05 * k / size * rng.normal()}
    words = {name: (word, "x") for name, word in LOSSES.items()}
    return Rig(
        "p**2/2 + k*x**2/2", ["x"], ["p"], {"x_m": "x"},
        words | {"cubic": ("cubic_stiffness", "x"), "square": ("quadratic_stiffness", "x")},
        values, {"k": k}, _priors(rng, {"k": k}, 0.03), np.array([size, 0.0]), times, np.array([noise]),
        lambda c, p: lambda t, y: [y[1], -p["k"] * y[0] - c["square"] * y[0] ** 2 - c["cubic"] * y[0] ** 3
                                   + _lost(c, y[1], size * w)],
        lambda y, t, c, p: y[:, :1], lambda y, g: y * (1 + lens * y**2) + noise * g.normal(size=y.shape),
        jitter=rng.uniform(0, 0.003) * 2 * np.pi / w,
    )  # fmt: skip


def torsion(rng: np.random.Generator) -> Rig:
    """On a wire: three losses, a zero that drifts, and in half of the draws a second swing that nobody reads."""
    w, size = rng.uniform(0.2, 3), rng.uniform(0.2, 1.5)
    times, noise = _times(rng, w, (10, 25), (250, 700)), size * rng.uniform(0.003, 0.012)
    values = _losses(rng, size, w, np.ptp(times)) | {"drift": 0.02 * size / np.ptp(times) * rng.normal()}
    joined, other = 0.06 * w * w * rng.uniform(0.5, 1.2) * rng.choice([0, 1]), w * rng.uniform(0.35, 0.7)
    words = {name: (word, "a") for name, word in LOSSES.items()} | {"drift": ("sensor_drift", "u")}
    words |= {"joined": ("hidden_oscillator", "a")} if joined else {}
    return Rig(
        "L**2/2 + k*a**2/2", ["a"], ["L"], {"u": "a"}, words,
        values | {"joined": joined, "other": other}, {"k": w * w}, _priors(rng, {"k": w * w}, 0.015),
        np.array([size, 0.0, 0.3 * size * rng.normal(), 0.0]), times, np.array([noise]),
        lambda c, p: lambda t, y: [y[1], -p["k"] * y[0] + c["joined"] * y[2] + _lost(c, y[1], size * w),
                                   y[3], -(c["other"] ** 2) * y[2] + c["joined"] * y[0]],
        lambda y, t, c, p: y[:, :1] + c["drift"] * t[: len(y), None], lambda y, g: y + noise * g.normal(size=y.shape),
    )  # fmt: skip


def circuit(rng: np.random.Generator) -> Rig:
    """A coil and a condenser on a converter: resistance, a loss like dry friction, an uneven condenser, a zero."""
    inductance, capacity, volts = 10 ** rng.uniform(-3, -1), 10 ** rng.uniform(-9, -7), rng.uniform(1, 5)
    w, size, step = (inductance * capacity) ** -0.5, capacity * volts, volts / 2 ** rng.integers(7, 10)
    times = _times(rng, w, (8, 25), (200, 600))
    rate = rng.uniform(0.6, 1.6) / np.ptp(times)
    values = {"viscous": 2 * rate * rng.uniform(0.6, 1), "dry": rate * rng.uniform(0, 0.15) * w * size,
              "square": 0.03 * w * w / size * rng.normal(), "bias": 0.01 * volts * rng.normal()}  # fmt: skip
    words = {"viscous": ("viscous_damping", "q"), "dry": ("coulomb_friction", "q")}
    return Rig(
        "p**2/(2*L) + q**2/(2*C)", ["q"], ["p"], {"u_V": "q/C"},
        words | {"square": ("quadratic_stiffness", "q"), "bias": ("sensor_bias", "u_V")},
        values, {"C": capacity}, _priors(rng, {"C": capacity}, 0.03), np.array([size, 0.0]), times,
        np.array([np.hypot(step / np.sqrt(12), 0.003 * volts)]),
        lambda c, p: lambda t, y: [y[1], -y[0] / (inductance * p["C"]) - c["square"] * y[0] ** 2
                                   + _lost(c, y[1], size * w)],
        lambda y, t, c, p: y[:, :1] / p["C"] + c["bias"],
        lambda y, g: np.round((y + 0.003 * volts * g.normal(size=y.shape)) / step) * step,
        scale=size, known={"L": inductance},
    )  # fmt: skip


def plane(rng: np.random.Generator) -> Rig:
    """A bob that swings in two directions, filmed askew: two dampings, one direction stiffer, a turn, a scale."""
    w2, size = rng.uniform(2, 12), rng.uniform(0.1, 0.4)
    w, askew, noise = np.sqrt(w2), 0.01 * rng.normal(), size * rng.uniform(0.004, 0.012)
    times = _times(rng, w, (10, 25), (250, 450))
    rate = rng.uniform(0.3, 0.9) / np.ptp(times)
    along, across = 2 * rate * rng.uniform(0.3, 1, 2)
    values = {"along": along, "across": across, "stiffer": 0.015 * w2 * rng.normal(), "turn": 0.02 * w * rng.normal(),
              "gain": 0.015 * rng.normal()}  # fmt: skip
    start = np.array([size, 0.4 * size * rng.normal(), 0.0, 0.4 * size * w * rng.normal()])
    return Rig(
        "(px**2 + py**2)/2 + w2*(x**2 + y**2)/2", ["x", "y"], ["px", "py"], {"x_m": "x", "y_m": "y"},
        {"along": ("viscous_damping", "x"), "across": ("viscous_damping", "y"), "stiffer": ("linear_stiffness", "x"),
         "turn": ("gyroscopic_coupling", "x,y"), "gain": ("sensor_gain", "x_m")},
        values, {"w2": w2}, _priors(rng, {"w2": w2}, 0.015), start, times, np.array([noise, noise]),
        lambda c, p: lambda t, y: [y[2], y[3], -(p["w2"] + c["stiffer"]) * y[0] - c["along"] * y[2] + c["turn"] * y[3],
                                   -p["w2"] * y[1] - c["across"] * y[3] - c["turn"] * y[2]],
        lambda y, t, c, p: y[:, :2] * [1 + c["gain"], 1.0],
        lambda y, g: y + askew * y[:, ::-1] * [1, -1] + noise * g.normal(size=y.shape),
        jitter=rng.uniform(0, 0.003) * 2 * np.pi / w,
    )  # fmt: skip


def coupled(rng: np.random.Generator) -> Rig:
    """Two pendulums on a spring, read in counts: a damping of each, dry friction, a scale and a zero, a lens."""
    w2, size = rng.uniform(10, 60), rng.uniform(0.1, 0.4)
    w, lens, noise = np.sqrt(w2), 0.006 * rng.normal() / size, 500 * size * rng.uniform(0.004, 0.012)
    times = _times(rng, w, (10, 20), (200, 450))
    rate = rng.uniform(0.4, 1.0) / np.ptp(times)
    first, second = 2 * rate * rng.uniform(0.2, 1, 2)
    values = {"first": first, "second": second, "dry": rate * rng.uniform(0, 0.3) * size * w,
              "gain": 0.03 * rng.normal(), "bias": 10 * size * rng.normal()}  # fmt: skip
    spring = w2 * rng.uniform(0.03, 0.2)
    return Rig(
        "(pa**2 + pb**2)/2 - w2*(cos(a) + cos(b)) + kc*(a - b)**2/2", ["a", "b"], ["pa", "pb"],
        {"a_counts": "500*a", "b_counts": "500*b"},
        {"first": ("viscous_damping", "a"), "second": ("viscous_damping", "b"), "dry": ("coulomb_friction", "a"),
         "gain": ("sensor_gain", "a_counts"), "bias": ("sensor_bias", "b_counts")},
        values, {"w2": w2, "kc": spring}, _priors(rng, {"w2": w2}, 0.015) | _priors(rng, {"kc": spring}, 0.05),
        np.array([size, 0.0, 0.0, 0.0]), times, np.array([noise, noise]),
        lambda c, p: lambda t, y: [
            y[2], y[3], -p["w2"] * np.sin(y[0]) - p["kc"] * (y[0] - y[1]) - c["first"] * y[2]
            - c["dry"] * np.tanh(500 * y[2] / (size * w)),
            -p["w2"] * np.sin(y[1]) - p["kc"] * (y[1] - y[0]) - c["second"] * y[3]],
        lambda y, t, c, p: 500 * y[:, :2] * [1 + c["gain"], 1.0] + [0.0, c["bias"]],
        lambda y, g: np.round(y * (1 + lens * y / 500) + noise * g.normal(size=y.shape)),
        jitter=rng.uniform(0, 0.003) * 2 * np.pi / w,
    )  # fmt: skip


def driven(rng: np.random.Generator) -> Rig:
    """A spring under a known push: a damping, dry friction, a spring that is bent, a zero."""
    w2 = rng.uniform(4, 100)
    w, noise = np.sqrt(w2), 0.004
    times = _times(rng, w, (12, 30), (300, 600))
    tones, phases, sizes = w * np.array([0.6, 0.83, 1.21, 1.7]), rng.uniform(0, 6, 4), 0.1 * w2 * rng.uniform(0.3, 1, 4)

    def push(t: float | np.ndarray) -> np.ndarray:
        return np.asarray((sizes * np.cos(np.multiply.outer(t, tones) + phases)).sum(-1))

    values = {"viscous": w * rng.uniform(0.03, 0.1), "dry": 0.01 * w2 * rng.uniform(),
              "cubic": 0.1 * w2 * rng.normal(), "bias": 0.02 * rng.normal()}  # fmt: skip
    given = _priors(rng, {"w2": w2}, 0.02) | _priors(rng, {"b": 1.0}, 0.03)
    return Rig(
        "p**2/2 + w2*q**2/2 - b*u*q", ["q"], ["p"], {"x": "q"},
        {"viscous": ("viscous_damping", "q"), "dry": ("coulomb_friction", "q"), "cubic": ("cubic_stiffness", "q"),
         "bias": ("sensor_bias", "x")},
        values, {"w2": w2, "b": 1.0}, given, np.zeros(2), times, np.array([noise]),
        lambda c, p: lambda t, y: [y[1], -p["w2"] * y[0] - c["cubic"] * y[0] ** 3 + _lost(c, y[1], 0.5 * w)
                                   + p["b"] * float(push(t))],
        lambda y, t, c, p: y[:, :1] + c["bias"], lambda y, g: y + noise * g.normal(size=y.shape),
        inputs={"u": push(times)},
    )  # fmt: skip


RIGS: dict[str, Callable[[np.random.Generator], Rig]] = {
    "pendulum": pendulum, "cart": cart, "torsion": torsion, "circuit": circuit, "plane": plane, "coupled": coupled,
    "driven": driven,
}  # fmt: skip
