"""The section of the page on Uranus: from the pull that the diagnosis found to where the missing planet stood."""

import tomllib
from datetime import date, timedelta
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from symplearn.report._palette import AFTER, BEFORE, LAW, READING
from symplearn.report._panel import legend, limits, render

from ._gallery_page_file import Page
from ._gallery_prepare import read_table
from ._gallery_pull import (
    OBLIQUITY,
    CircularOrbit,
    Strongest,
    averaged,
    degrees_between,
    ecliptic_longitude,
    lines,
    on_the_sky,
    seen_period,
    strongest,
    unseen_body,
)
from ._gallery_results import Result, Source
from ._gallery_words import table

YEAR = 365.25  # days
WIDTH, EDGE = 8 * YEAR, 5 * YEAR  # of the average over the pull, and what is left out at its ends
ARROWS = 25
GM_NEPTUNE = 1.52436e-8  # au^3/day^2, from the recording's README; for comparison alone


class _Sky:
    """The found pull along the heliocentric path of Uranus, and where Neptune was."""

    def __init__(self, page: Page, result: Result, source: Source):
        folder = source.recordings / page.name
        self.times, self.force = result.series["1/fitted_times"], result.series["1/force_before"]
        sun, neptune = (_positions(folder / f"{file}.csv", name, self.times) for file, name in
                        (("known_bodies", "sun"), ("truth_neptune", "neptune")))  # fmt: skip
        self.path, self.neptune = result.series["1/position"] - sun, neptune - sun
        self.gm_sun = float(tomllib.loads(result.simulation)["parameters"]["gm_sun"])
        self.inner = (self.times >= self.times[0] + EDGE) & (self.times <= self.times[-1] - EDGE)
        self.peak: Strongest = strongest(self.times, self.force, WIDTH, EDGE)
        self.mean = averaged(self.times, self.force, WIDTH)
        inner = self.times[self.inner], self.force[self.inner], self.path[self.inner]
        found: tuple[CircularOrbit, float] = unseen_body(*inner, self.gm_sun)
        self.orbit, self.gm = found

    @property
    def gap(self) -> np.ndarray:
        """From Uranus to Neptune."""
        return self.neptune - self.path


def uranus_section(page: Page, result: Result, source: Source, out: Path) -> str:
    """When and where the pull was strongest, where the body must have stood, and where Neptune was."""
    sky = _Sky(page, result, source)
    (out / f"{page.name}-sky.png").write_bytes(render(lambda figure: _draw(figure, sky), (9.0, 4.2), dpi=100))
    section = _SECTION.format(width=WIDTH / YEAR, edge=EDGE / YEAR)
    return "\n\n".join([section, _table(sky), f"![The pull, and where it points]({page.name}-sky.png)", _CAPTION,
                        _remainder(sky)])  # fmt: skip


_SECTION = """\
## Where the missing body must have stood

The diagnosis follows Uranus with a missing force, a vector at every time. The table holds what follows from that force
alone, without any knowledge of what pulled: the time at which it was strongest (in its mean under a window of
{width:.0f} years, without the {edge:.0f} years at either end), its direction then, which is that from Uranus to the
body, and the circular orbit about the Sun and the mass with which Newton's law reproduces the force best (five
numbers, least squares). Beside it stands Neptune, whose file neither the diagnosis nor this fit has seen."""
_CAPTION = (
    "*Left: size of the missing force, with Neptune's pull. Right: the plane of the ecliptic, the Sun in the middle; "
    "the path of Uranus with the missing force along it, the circle that was found, and the path of Neptune.*"
)


_MOONS = {"Oberon": 13.463234, "Titania": 8.705867}  # days, sidereal; the heaviest moons of Uranus
_REMAINDER = """\
What the circle leaves of the missing force swings fast. Its strongest lines have periods of {found} days. The recording
is of the planet's centre, which moves about by its moons: {moons}. Read every {step:.0f} days, these periods appear as
{seen} days."""


def _remainder(sky: _Sky) -> str:
    """The lines that are left beside the body's pull, and those that the moons would make."""
    d = sky.orbit.at(sky.times) - sky.path
    rest = sky.force - sky.gm * d / np.linalg.norm(d, axis=1, keepdims=True) ** 3
    step = float(np.median(np.diff(sky.times)))
    return _REMAINDER.format(
        step=step,
        found=_and([f"{period:.1f}" for period in lines(sky.times, rest, len(_MOONS))]),
        moons=_and([f"{name} goes round in {period:.3f} days" for name, period in _MOONS.items()]),
        seen=_and([f"{seen_period(period, step):.1f}" for period in _MOONS.values()]),
    )


def _and(words: list[str]) -> str:
    return " and ".join(words)


def _positions(path: Path, body: str, times: np.ndarray) -> np.ndarray:
    """Positions of a body at the given times, from rows at even times."""
    header, rows = read_table(path)
    values = np.array(rows, float)
    at = values[:, header.index("t_day")]
    return np.stack([np.interp(times, at, values[:, header.index(f"{body}_{x}_au")]) for x in "xyz"], axis=1)


def _table(sky: _Sky) -> str:
    k = sky.peak.place
    truth = sky.gap[k]
    nearest = int(np.argmin(np.where(sky.inner, np.linalg.norm(sky.gap, axis=1), np.inf)))
    body = sky.orbit.at(sky.times[[k]])[0]
    pull = GM_NEPTUNE / truth.dot(truth)
    rows = [
        ["when the pull was strongest", _day(sky.times[k]), _day(sky.times[nearest]), _years(sky, k, nearest)],
        ["how strong it then was, au/day²", f"{sky.peak.size:.3g}", f"{pull:.3g}", f"{sky.peak.size / pull - 1:+.1%}"],
        _direction_row("direction from Uranus, right ascension and declination", sky.peak.direction, truth),
        _direction_row("direction from the Sun, by the circle", body, sky.neptune[k]),
        ["ecliptic longitude from the Sun, by the circle", *_longitudes(body, sky.neptune[k])],
        _ratio_row("distance from the Sun, au", np.linalg.norm(body), np.linalg.norm(sky.neptune[k])),
        _ratio_row("mass of the Sun, in that of the body", sky.gm_sun / sky.gm, sky.gm_sun / GM_NEPTUNE),
    ]
    angles = [degrees_between(f, g) for f, g in zip(sky.mean[sky.inner], sky.gap[sky.inner], strict=True)]
    rows.append(["direction from Uranus, median over all years", "", "", f"{np.median(angles):.1f}°"])
    return table(["", "found", "Neptune", "apart"], rows)


def _direction_row(words: str, found: np.ndarray, truth: np.ndarray) -> list[str]:
    told = ["{:.1f}°, {:+.1f}°".format(*on_the_sky(one)) for one in (found, truth)]
    return [words, *told, f"{degrees_between(found, truth):.1f}°"]


def _longitudes(found: np.ndarray, truth: np.ndarray) -> list[str]:
    a, b = ecliptic_longitude(found), ecliptic_longitude(truth)
    return [f"{a:.1f}°", f"{b:.1f}°", f"{(a - b + 180) % 360 - 180:+.1f}°"]


def _ratio_row(words: str, found: float, truth: float) -> list[str]:
    return [words, f"{found:.4g}", f"{truth:.4g}", f"{found / truth - 1:+.1%}"]


def _day(days: float) -> str:
    return (date(1900, 1, 1) + timedelta(days=float(days))).isoformat()


def _years(sky: _Sky, found: int, truth: int) -> str:
    return f"{(sky.times[found] - sky.times[truth]) / YEAR:+.1f} years"


def _draw(figure: Figure, sky: _Sky) -> None:
    over_time, plane = figure.subplots(1, 2)
    years = 1900 + sky.times / YEAR
    size, truth = np.linalg.norm(sky.mean, axis=1), GM_NEPTUNE / (sky.gap**2).sum(1)
    unit = 1e-10
    over_time.plot(
        years, size / unit, color=BEFORE, linewidth=1.0, label=f"missing force, window of {WIDTH / YEAR:.0f} years"
    )
    over_time.plot(years, truth / unit, color=LAW, linewidth=1.4, linestyle="--", label="Neptune's pull")
    over_time.set_ylim(*limits(truth / unit, size[sky.inner] / unit))
    over_time.set_xlabel("year")
    over_time.set_ylabel("pull on Uranus [1e-10 au/day²]")
    legend(over_time)
    _plane(plane, sky)


def _plane(axes: Axes, sky: _Sky) -> None:
    path, force, neptune, circle = (_ecliptic(x) for x in (sky.path, sky.mean, sky.neptune, sky.orbit.at(sky.times)))
    axes.plot(*path.T, color=READING, linewidth=1.0, label="Uranus")
    axes.plot(*circle[sky.inner].T, color=AFTER, linewidth=1.2, label="found")
    axes.plot(*neptune.T, color=LAW, linewidth=1.2, linestyle="--", label="Neptune")
    some = np.flatnonzero(sky.inner)
    some = some[np.linspace(0, len(some) - 1, ARROWS).astype(int)]
    arrows = 12 * force[some] / sky.peak.size
    axes.quiver(*path[some].T, *arrows.T, color=BEFORE, angles="xy", scale_units="xy", scale=1, width=0.004)
    axes.plot([0], [0], "o", color="#000000", markersize=3)
    axes.set_aspect("equal")
    axes.set_xlabel("au")
    legend(axes)


def _ecliptic(positions: np.ndarray) -> np.ndarray:
    """The two components in the plane of the ecliptic."""
    x, y, z = positions.T
    return np.stack([x, y * np.cos(OBLIQUITY) + z * np.sin(OBLIQUITY)], axis=1)
