"""What a diagnosis is: the answer as the contract words it, and the series behind its pictures."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from .._simulation_records import SimulationFile


@dataclass(frozen=True, eq=False)
class Series:
    """One recording as the simulation before and after sees it; rows after thinning, fitted and held out.

    `readings`, `before`, `after` are (time, channel) in the columns' units, NaN where nothing was read. `before` is
    the calibrated simulation as it is, `after` has the findings; both run freely after `boundary`. `force_before` and
    `force_after` (time, coordinate) are the smoothed missing force over the fitted rows, `strain_*` its standardised
    disturbances; `position` and `velocity` (time, coordinate) are the smoothed motion they belong to. `energy_*`
    (time,) is the Hamiltonian along the smoothed motion.
    """

    name: str
    boundary: float
    times: Float[np.ndarray, " time"]
    readings: Float[np.ndarray, "time channel"]
    before: Float[np.ndarray, "time channel"]
    after: Float[np.ndarray, "time channel"]
    fitted_times: Float[np.ndarray, " fitted"]
    position: Float[np.ndarray, "fitted coordinate"]
    velocity: Float[np.ndarray, "fitted coordinate"]
    force_before: Float[np.ndarray, "fitted coordinate"]
    force_after: Float[np.ndarray, "fitted coordinate"]
    strain_before: Float[np.ndarray, "fitted coordinate"]
    strain_after: Float[np.ndarray, "fitted coordinate"]
    innovations_before: Float[np.ndarray, "fitted channel"]
    innovations_after: Float[np.ndarray, "fitted channel"]
    energy_before: Float[np.ndarray, " fitted"]
    energy_after: Float[np.ndarray, " fitted"]


@dataclass(frozen=True)
class Forecast:
    """Readings to come: mean and sd before and after by column, each (time,)."""

    times: Float[np.ndarray, " time"]
    columns: Mapping[str, Mapping[str, Float[np.ndarray, " time"]]]  # column -> before, before_sd, after, after_sd


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """The answer of `diagnose`.

    `document` is `diagnosis.json` (contract, section 4): plain dicts, lists, strings, finite numbers, None.
    `equation_before` and `equation_after` are the equations of motion, one line of text per momentum and reading.
    `augmented` is the simulation with the findings put back.
    """

    title: str
    document: Mapping[str, Any]
    columns: tuple[str, ...]
    coordinates: tuple[str, ...]
    units: Mapping[str, str]
    equation_before: tuple[str, ...]
    equation_after: tuple[str, ...]
    series: tuple[Series, ...]
    augmented: SimulationFile
    forecast: Forecast | None = None

    def __str__(self) -> str:
        d = self.document
        lines = [f"{d['verdict']}: {d['location']['where']}"]
        lines += [f"  {f['sentence']}" for f in d["findings"]]
        return "\n".join(lines)
