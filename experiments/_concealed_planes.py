"""Nature's systems of two coordinates, separable and not, with their closed forms. NumPy alone."""

from typing import Any

import numpy as np

from ._concealed_systems import LINE, Generator, Reading, System, Values, log_uniform, position


def _henon_start(rng: Generator, P: Values) -> np.ndarray:
    """Bounded and far from chaos: an energy below a third of the escape energy 1/(6 lam^2)."""
    x = rng.normal(size=4)
    energy = rng.uniform(0.08, 0.3) / (6 * P["lam"] ** 2)
    return x * np.sqrt(2 * energy / np.sum(x**2))


HENON_HEILES = System(
    "henon_heiles",
    "Star in a galactic potential after Henon and Heiles",
    ("q1", "q2"),
    ("p1", "p2"),
    "(p1**2 + p2**2)/2 + (q1**2 + q2**2)/2 + lam*(q1**2*q2 - q2**3/3)",
    energy=lambda q, p, P: (
        (p[0] ** 2 + p[1] ** 2 + q[0] ** 2 + q[1] ** 2) / 2 + P["lam"] * (q[0] ** 2 * q[1] - q[1] ** 3 / 3)
    ),
    velocity=lambda q, p, P: [p[0] + 0.0, p[1] + 0.0],
    force=lambda q, p, P: [-q[0] - 2 * P["lam"] * q[0] * q[1], -q[1] - P["lam"] * (q[0] ** 2 - q[1] ** 2)],
    draw=lambda rng: {"lam": rng.uniform(0.5, 1.2)},
    start=_henon_start,
    period=lambda P: 2 * np.pi,
    readings=(
        position(0, "q1", "q1_kpc"),
        position(1, "q2", "q2_kpc"),
        Reading("v1", "p1", lambda q, p, P: p[0] + 0.0, (0,), "velocity"),
        Reading("v2", "p2", lambda q, p, P: p[1] + 0.0, (1,), "velocity"),
    ),
    varied=("lam",),
    quick=1.3,
)


def _coupled_parameters(rng: Generator) -> dict[str, float]:
    k1 = log_uniform(rng, 2.0, 10.0)
    k2 = k1 * rng.uniform(0.6, 1.7)
    kc = k1 * rng.uniform(0.2, 0.8)
    return {"m1": rng.uniform(0.6, 1.6), "m2": rng.uniform(0.6, 1.6), "k1": k1, "k2": k2, "kc": kc}


def _coupled_energy(q: Any, p: Any, P: Values) -> Any:
    kinetic = p[0] ** 2 / (2 * P["m1"]) + p[1] ** 2 / (2 * P["m2"])
    return kinetic + (P["k1"] * q[0] ** 2 + P["k2"] * q[1] ** 2 + P["kc"] * (q[0] - q[1]) ** 2) / 2


COUPLED = System(
    "coupled",
    "Two carts on springs",
    ("x1", "x2"),
    ("p1", "p2"),
    "p1**2/(2*m1) + p2**2/(2*m2) + k1*x1**2/2 + k2*x2**2/2 + kc*(x1 - x2)**2/2",
    energy=_coupled_energy,
    velocity=lambda q, p, P: [p[0] / P["m1"], p[1] / P["m2"]],
    force=lambda q, p, P: [
        -P["k1"] * q[0] - P["kc"] * (q[0] - q[1]),
        -P["k2"] * q[1] + P["kc"] * (q[0] - q[1]),
    ],
    draw=_coupled_parameters,
    start=lambda rng, P: np.array([rng.uniform(0.3, 1.0), rng.uniform(-0.8, 0.8), 0.0, 0.0]),
    period=lambda P: 2 * np.pi * np.sqrt(P["m1"] / (P["k1"] + P["kc"])),
    readings=(
        position(0, "x1", "x1_m"),
        position(1, "x2", "x2_m"),
        Reading("v1", "p1/m1", lambda q, p, P: p[0] / P["m1"], (0,), "velocity"),
        Reading("v2", "p2/m2", lambda q, p, P: p[1] / P["m2"], (1,), "velocity"),
        Reading("gap_m", "x2 - x1", lambda q, p, P: q[1] - q[0], (0, 1), "nonlinear"),
    ),
    varied=("k1", "k2", "kc"),
    always_known=("m1", "m2"),
    quick=1.5,
)


def _orbit_start(rng: Generator, P: Values) -> np.ndarray:
    """At pericentre or apocentre of an orbit with semi-major axis near 1, turned by any angle."""
    a, e, turn = rng.uniform(0.8, 1.2), rng.uniform(0.05, 0.4), rng.uniform(-np.pi, np.pi)
    e = e if rng.random() < 0.5 else -e
    r = a * (1 - e)
    v = np.sqrt(P["mu"] * (2 / r - 1 / a))
    c, s = np.cos(turn), np.sin(turn)
    return np.array([r * c, r * s, -v * s, v * c])


ORBIT = System(
    "orbit",
    "Satellite around a planet",
    ("x", "y"),
    ("px", "py"),
    "(px**2 + py**2)/2 - mu/sqrt(x**2 + y**2)",
    energy=lambda q, p, P: (p[0] ** 2 + p[1] ** 2) / 2 - P["mu"] / np.sqrt(q[0] ** 2 + q[1] ** 2),
    velocity=lambda q, p, P: [p[0] + 0.0, p[1] + 0.0],
    force=lambda q, p, P: [-P["mu"] * q[i] * (q[0] ** 2 + q[1] ** 2) ** -1.5 for i in (0, 1)],
    draw=lambda rng: {"mu": rng.uniform(0.6, 1.8)},
    start=_orbit_start,
    period=lambda P: 2 * np.pi / np.sqrt(P["mu"]),
    readings=(
        position(0, "x", "x_Mm"),
        position(1, "y", "y_Mm"),
        Reading("vx", "px", lambda q, p, P: p[0] + 0.0, (0,), "velocity"),
        Reading("vy", "py", lambda q, p, P: p[1] + 0.0, (1,), "velocity"),
        Reading("range", "sqrt(x**2 + y**2)", lambda q, p, P: np.hypot(q[0], q[1]), (0, 1), "nonlinear"),
    ),
    varied=("mu",),
    quick=2.4,
    around_origin=True,
)


def _elastic_parameters(rng: Generator) -> dict[str, float]:
    length, m = rng.uniform(0.4, 1.2), rng.uniform(0.2, 1.0)
    return {"m": m, "g": 9.81, "l": length, "k": m * 9.81 / length * rng.uniform(6.0, 14.0)}


def _elastic_start(rng: Generator, P: Values) -> np.ndarray:
    rest = P["l"] + P["m"] * P["g"] / P["k"]
    theta = rng.uniform(0.25, 0.7) * rng.choice([-1.0, 1.0])
    return np.array([rest * (1 + rng.uniform(-0.06, 0.06)), theta, 0.0, 0.0])


def _elastic_energy(q: Any, p: Any, P: Values) -> Any:
    kinetic = p[0] ** 2 / (2 * P["m"]) + p[1] ** 2 / (2 * P["m"] * q[0] ** 2)
    return kinetic + P["k"] * (q[0] - P["l"]) ** 2 / 2 - P["m"] * P["g"] * q[0] * np.cos(q[1])


def _elastic_force(q: Any, p: Any, P: Values) -> list[Any]:
    radial = p[1] ** 2 / (P["m"] * q[0] ** 3) - P["k"] * (q[0] - P["l"]) + P["m"] * P["g"] * np.cos(q[1])
    return [radial, -P["m"] * P["g"] * q[0] * np.sin(q[1])]


ELASTIC = System(
    "elastic_pendulum",
    "Ball on a spring that swings",
    ("r", "theta"),
    ("p_r", "p_theta"),
    "p_r**2/(2*m) + p_theta**2/(2*m*r**2) + k*(r - l)**2/2 - m*g*r*cos(theta)",
    energy=_elastic_energy,
    velocity=lambda q, p, P: [p[0] / P["m"], p[1] / (P["m"] * q[0] ** 2)],
    force=_elastic_force,
    draw=_elastic_parameters,
    start=_elastic_start,
    period=lambda P: 2 * np.pi * np.sqrt((P["l"] + P["m"] * P["g"] / P["k"]) / P["g"]),
    readings=(
        position(0, "r", "r_m"),
        position(1, "theta", "angle_rad"),
        Reading("x_m", "r*sin(theta)", lambda q, p, P: q[0] * np.sin(q[1]), (0, 1), "nonlinear"),
    ),
    varied=("k", "l", "g"),
    always_known=("m", "g"),
    quick=4.0,
    diagonal=False,
    alike=False,
)


def _double_terms(q: Any, p: Any, P: Values) -> tuple[Any, ...]:
    c, s = np.cos(q[0] - q[1]), np.sin(q[0] - q[1])
    m1, m2, l1, l2 = P["m1"], P["m2"], P["l1"], P["l2"]
    mass = m1 + m2 * s**2
    top = l2**2 * m2 * p[0] ** 2 + l1**2 * (m1 + m2) * p[1] ** 2 - 2 * m2 * l1 * l2 * p[0] * p[1] * c
    return c, s, mass, top


def _double_energy(q: Any, p: Any, P: Values) -> Any:
    m1, m2, l1, l2 = P["m1"], P["m2"], P["l1"], P["l2"]
    _, _, mass, top = _double_terms(q, p, P)
    height = (m1 + m2) * l1 * np.cos(q[0]) + m2 * l2 * np.cos(q[1])
    return top / (2 * m2 * l1**2 * l2**2 * mass) - P["g"] * height


def _double_velocity(q: Any, p: Any, P: Values) -> list[Any]:
    m1, m2, l1, l2 = P["m1"], P["m2"], P["l1"], P["l2"]
    c, _, mass, _ = _double_terms(q, p, P)
    first = (l2 * p[0] - l1 * p[1] * c) / (l1**2 * l2 * mass)
    return [first, (l1 * (m1 + m2) * p[1] - l2 * m2 * p[0] * c) / (m2 * l1 * l2**2 * mass)]


def _double_force(q: Any, p: Any, P: Values) -> list[Any]:
    m1, m2, l1, l2 = P["m1"], P["m2"], P["l1"], P["l2"]
    c, s, mass, top = _double_terms(q, p, P)
    turn = p[0] * p[1] * s / (l1 * l2 * mass) - top * s * c / (l1**2 * l2**2 * mass**2)
    return [-turn - (m1 + m2) * P["g"] * l1 * np.sin(q[0]), turn - m2 * P["g"] * l2 * np.sin(q[1])]


def _double_parameters(rng: Generator) -> dict[str, float]:
    size = rng.uniform(0.15, 0.5)
    lengths = {"l1": size * rng.uniform(0.8, 1.2), "l2": size * rng.uniform(0.8, 1.2)}
    return {"m1": rng.uniform(0.1, 0.5), "m2": rng.uniform(0.1, 0.3), "g": 9.81} | lengths


DOUBLE_PENDULUM = System(
    "double_pendulum",
    "Double pendulum",
    ("a", "b"),
    ("pa", "pb"),
    "(l2**2*m2*pa**2 + l1**2*(m1 + m2)*pb**2 - 2*m2*l1*l2*pa*pb*cos(a - b))"
    "/(2*m2*l1**2*l2**2*(m1 + m2*sin(a - b)**2)) - (m1 + m2)*g*l1*cos(a) - m2*g*l2*cos(b)",
    energy=_double_energy,
    velocity=_double_velocity,
    force=_double_force,
    draw=_double_parameters,
    start=lambda rng, P: np.array([rng.uniform(0.1, 0.45), rng.uniform(-0.45, 0.45), 0.0, 0.0]),
    period=lambda P: 2 * np.pi * np.sqrt(P["l1"] / P["g"]),
    readings=(position(0, "a", "a_rad"), position(1, "b", "b_rad")),
    varied=("l1", "l2", "m2"),
    always_known=("m1", "g"),
    quick=2.0,
    diagonal=False,
)

PLANE = (HENON_HEILES, COUPLED, ORBIT, ELASTIC, DOUBLE_PENDULUM)
ZOO = {system.name: system for system in (*LINE, *PLANE)}
