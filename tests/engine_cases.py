"""Small simulations, and recordings made by SciPy, shared by the tests of the diagnosis engine's parts."""

from collections.abc import Callable, Sequence

import numpy as np
from scipy.integrate import solve_ivp

from symplearn._inputs import Inputs
from symplearn._recording import Recording
from symplearn._simulation_file import parse_simulation
from symplearn._simulation_records import SimulationFile
from symplearn.diagnosis._build import Restriction, augmented_equations, build
from symplearn.diagnosis._effect_priors import with_effects
from symplearn.diagnosis._found import Found
from symplearn.diagnosis._motion import motion_along
from symplearn.diagnosis._problem import Problem
from symplearn.diagnosis._start import priors_without_effects
from symplearn.diagnosis._trajectory import Stepper
from symplearn.diagnosis._weigher import Weigher


def simulation(
    hamiltonian: str,
    coordinates: Sequence[str] = ("q",),
    momenta: Sequence[str] = ("p",),
    observe: dict[str, str] | None = None,
    more: str = "",
    recording: str = "",
) -> SimulationFile:
    """A simulation file; `more` is further TOML at its end, `recording` further keys of that section."""
    listed = "\n".join(f'{column} = "{h}"' for column, h in (observe or {"y": coordinates[0]}).items())
    text = f"""
[system]
coordinates = {list(coordinates)}
momenta = {list(momenta)}
hamiltonian = "{hamiltonian}"

[recording]
time = "t_s"
{recording}
[recording.observe]
{listed}
{more}
"""
    return parse_simulation(text, "case.toml")


def recorded(times, readings, inputs: Inputs | None = None, number: int = 1, columns=None) -> Recording:
    """A recording of given readings (time, channel)."""
    readings = np.asarray(readings, float).reshape(len(times), -1)
    columns = columns or tuple(f"y{j}" for j in range(readings.shape[1]))
    return Recording(
        number, f"run{number}.csv", columns, np.asarray(times), readings, np.arange(len(times)) + 2, inputs
    )


def problem(file: SimulationFile, recordings: Sequence[Recording], substep: float, holdout: float = 0.0) -> Problem:
    """What is fitted, with every effect searched."""
    return build(file, augmented_equations(file), recordings, holdout, substep, Restriction())


def weigher(p: Problem, q: np.ndarray, momentum: np.ndarray) -> Weigher:
    """With priors of effects from a motion of one coordinate, and nothing weighed yet."""
    bare, still = priors_without_effects(p), np.zeros_like(q)
    path = np.stack([q, still, momentum, still], axis=1)
    return Weigher(Stepper(p), Found(p, with_effects(p, bare, motion_along(p, bare.mean, [path]))))


def solved(rates: Callable, start: Sequence[float], times: np.ndarray, tolerance: float = 1e-10) -> np.ndarray:
    """SciPy's DOP853 (time, state), its tolerance far below what any test that uses it asks for."""
    span = (float(times[0]), float(times[-1]))
    found = solve_ivp(rates, span, start, "DOP853", times, rtol=tolerance, atol=tolerance * 1e-2)
    assert found.success, found.message
    return found.y.T


def autocovariance(lag, frequency, damping):
    """Of x'' + 2 z w x' + w^2 x = white noise, at unit variance: the textbook's free decay from rest."""
    lag, rate = np.abs(lag), damping * frequency
    if damping == 1:
        return np.exp(-rate * lag) * (1 + rate * lag)
    if damping < 1:
        turn = frequency * np.sqrt(1 - damping**2)
        return np.exp(-rate * lag) * (np.cos(turn * lag) + rate / turn * np.sin(turn * lag))
    split = frequency * np.sqrt(damping**2 - 1)
    slow, fast = rate - split, rate + split
    return (fast * np.exp(-slow * lag) - slow * np.exp(-fast * lag)) / (fast - slow)


def attracted(mu: float) -> Callable[[float, np.ndarray], list[float]]:
    """The rates of (x, y, px, py) of a unit mass in the potential -mu/r."""

    def rates(t, s):
        cubed = np.hypot(s[0], s[1]) ** 3
        return [s[2], s[3], -mu * s[0] / cubed, -mu * s[1] / cubed]

    return rates


def struck(
    rates: Callable, start: Sequence[float], times: np.ndarray, jump: Sequence[float], when: float
) -> np.ndarray:
    """The same (time, state) with a jump of the state at `when`, inside the times; a row there shows it just after."""
    now = solved(rates, start, np.append(times[times < when], when))
    after = solved(rates, now[-1] + jump, np.append(when, times[times > when]))
    return np.concatenate([now[:-1], after[0 if (times == when).any() else 1 :]])
