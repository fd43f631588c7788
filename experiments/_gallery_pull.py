"""From a missing force along a path to where on the sky the body stood that pulled."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.optimize import least_squares

OBLIQUITY = np.radians(23.4392911)  # of the ecliptic to the equator, J2000
_STARTS = (1.3, 1.6, 2.0)  # radii of the sought orbit to start from, in those of the path


class Strongest(NamedTuple):
    """When a pull was strongest, how strong it was, and its direction, a unit vector."""

    place: int
    size: float
    direction: np.ndarray


@dataclass(frozen=True)
class CircularOrbit:
    """A circle about the Sun: `radius`, angle `phase` at time 0, plane by the unit vectors `first` and `second`."""

    radius: float
    rate: float
    phase: float
    first: np.ndarray
    second: np.ndarray

    def at(self, times: Float[np.ndarray, " time"]) -> Float[np.ndarray, "time 3"]:
        """Heliocentric positions."""
        angle = self.phase + self.rate * times
        return self.radius * (np.outer(np.cos(angle), self.first) + np.outer(np.sin(angle), self.second))


def strongest(
    times: Float[np.ndarray, " time"], force: Float[np.ndarray, "time 3"], width: float, edge: float
) -> Strongest:
    """The strongest pull of the force averaged over `width`; the first and last `edge` of the path are left out."""
    mean = averaged(times, force, width)
    size = np.linalg.norm(mean, axis=1)
    best = int(np.argmax(np.where((times >= times[0] + edge) & (times <= times[-1] - edge), size, 0.0)))
    return Strongest(best, float(size[best]), mean[best] / size[best])


def averaged(
    times: Float[np.ndarray, " time"], force: Float[np.ndarray, "time 3"], width: float
) -> Float[np.ndarray, "time 3"]:
    """The mean of the force around every time, with the weights of a Hann window of this width."""
    return np.array([_hann(times - t, width) @ force for t in times])


def _hann(apart: Float[np.ndarray, " time"], width: float) -> Float[np.ndarray, " time"]:
    weights = np.where(np.abs(apart) < 0.5 * width, np.cos(np.pi * apart / max(width, 1e-300)) ** 2, 0.0)
    weights[np.argmin(np.abs(apart))] = 1.0  # its own time counts, however narrow the window is
    return weights / weights.sum()


def lines(times: Float[np.ndarray, " time"], force: Float[np.ndarray, "time 3"], count: int) -> list[float]:
    """Periods of the strongest lines in the spectrum of the force (Hann window, even times), shortest first."""
    window = np.hanning(len(times))[:, None]
    power = (np.abs(np.fft.rfft((force - force.mean(0)) * window, n=8 * len(times), axis=0)) ** 2).sum(1)
    rate = np.fft.rfftfreq(8 * len(times), float(np.median(np.diff(times))))
    apart = 4.0 / (times[-1] - times[0])  # the main lobe of the window: what is nearer is the same line
    found: list[float] = []
    for k in np.argsort(power)[::-1]:
        if len(found) < count and rate[k] > apart and all(abs(rate[k] - f) > apart for f in found):
            found.append(float(rate[k]))
    return sorted(1 / f for f in found)


def seen_period(period: float, step: float) -> float:
    """The period at which a faster one appears when it is read every `step` (aliasing)."""
    cycles = step / period
    return step / abs(cycles - round(cycles))


def on_the_sky(direction: Float[np.ndarray, "3"]) -> tuple[float, float]:
    """Right ascension and declination of an equatorial direction, in degrees."""
    x, y, z = direction / np.linalg.norm(direction)
    return float(np.degrees(np.arctan2(y, x)) % 360), float(np.degrees(np.arcsin(z)))


def ecliptic_longitude(direction: Float[np.ndarray, "3"]) -> float:
    """Ecliptic longitude of an equatorial direction, in degrees."""
    x, y, z = direction
    return float(np.degrees(np.arctan2(y * np.cos(OBLIQUITY) + z * np.sin(OBLIQUITY), x)) % 360)


def degrees_between(a: Float[np.ndarray, "3"], b: Float[np.ndarray, "3"]) -> float:
    """The angle between two directions, in degrees."""
    return float(np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b)))


def unseen_body(
    times: Float[np.ndarray, " time"],
    force: Float[np.ndarray, "time 3"],
    path: Float[np.ndarray, "time 3"],
    gm_sun: float,
) -> tuple[CircularOrbit, float]:
    """The circular orbit and the GM of a body whose pull on the heliocentric `path` is `force`, by least squares.

    Newton's law alone: force = GM d / d^3, where d leads from the path to the body. Equations are weighed alike.
    """
    peak = strongest(times, force, 0.0, 0.0)
    frame = _frame(path, peak.place)
    scale = float(np.sqrt((force**2).mean()))

    def orbit(z: np.ndarray) -> CircularOrbit:
        return _orbit(z, frame, times[peak.place], gm_sun)

    def missed(z: np.ndarray) -> np.ndarray:
        d = orbit(z).at(times) - path
        pull = np.exp(z[4]) * d / np.linalg.norm(d, axis=1, keepdims=True) ** 3
        return ((pull - force) / scale).ravel()

    radius = float(np.linalg.norm(path[peak.place]))
    starts = [[np.log(k * radius), 0.0, 0.0, 0.0, np.log(peak.size * ((k - 1) * radius) ** 2)] for k in _STARTS]
    best = min((least_squares(missed, z, x_scale=0.1) for z in starts), key=lambda fit: fit.cost)
    return orbit(best.x), float(np.exp(best.x[4]))


def _frame(path: np.ndarray, place: int) -> np.ndarray:
    """Rows: outward at the place, along the motion, and across the plane of the path."""
    outward = path[place] / np.linalg.norm(path[place])
    across = np.cross(path[max(place - 1, 0)], path[min(place + 1, len(path) - 1)])
    across /= np.linalg.norm(across)
    return np.stack([outward, np.cross(across, outward), across])


def _orbit(z: np.ndarray, frame: np.ndarray, time: float, gm_sun: float) -> CircularOrbit:
    """z: log radius, angle ahead of the path at `time`, and two tilts of the plane about outward and along."""
    normal = frame[2] + z[2] * frame[0] + z[3] * frame[1]
    normal /= np.linalg.norm(normal)
    first = np.cross(frame[1], normal)
    first /= np.linalg.norm(first)
    radius = float(np.exp(z[0]))
    rate = float(np.sqrt(gm_sun / radius**3))
    return CircularOrbit(radius, rate, float(z[1]) - rate * time, first, np.cross(normal, first))
