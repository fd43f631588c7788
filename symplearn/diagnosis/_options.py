"""How to diagnose."""

import math
import os
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from .._counts import is_count
from .._errors import InputError, shown
from ._build import Restriction


@dataclass(frozen=True)
class Options:
    """How to diagnose.

    **Arguments:**

    - `holdout`: share of the used rows of each recording that no fit sees, from 0 up to, but not including, 1.
    - `seed`: same seed, same files: same answer.
    - `restriction`: which effects are searched, as `restriction_of(["viscous_damping", "quadratic_drag"])`.
    - `jobs`: threads; the answer does not depend on them.
    - `time_limit`: seconds after which the search is cut short.
    - `forecast_until`: the time that a forecast runs to; None for no forecast.
    - `forecast_step`: spacing of the forecast's rows, by default the first recording's median one.
    - `progress`: told what is being done.
    - `notice`: told during the work what a person may want to stop it for.

    **Raises:** `InputError` where one of them is none of these.
    """

    holdout: float = 0.25
    seed: int = 0
    restriction: Restriction = Restriction()
    jobs: int = os.cpu_count() or 1
    time_limit: float = np.inf
    forecast_until: float | None = None
    forecast_step: float | None = None
    progress: Callable[[str], None] = lambda message: None
    notice: Callable[[str], None] = lambda message: None

    def __post_init__(self) -> None:
        _need("holdout", self.holdout, _is_number(self.holdout) and 0 <= self.holdout < 1,
              "give a share from 0 up to, but not including, 1")  # fmt: skip
        _need("seed", self.seed, is_count(self.seed, -(2**63)) and self.seed < 2**63,
              "give a whole number of at most 64 bits")  # fmt: skip
        _need("restriction", self.restriction, isinstance(self.restriction, Restriction),
              "give what `restriction_of` makes of names of effects")  # fmt: skip
        _need("jobs", self.jobs, is_count(self.jobs), "give a whole number of threads, at least 1")
        _need("time_limit", self.time_limit, _is_number(self.time_limit) and self.time_limit > 0,
              "give a positive number of seconds")  # fmt: skip
        _need("progress", self.progress, callable(self.progress), "give a function of a message")
        _need("notice", self.notice, callable(self.notice), "give a function of a message")
        self._check_forecast()

    def _check_forecast(self) -> None:
        until, step = self.forecast_until, self.forecast_step
        _need("forecast_until", until, until is None or (_is_number(until) and math.isfinite(until)),
              "give the time to forecast to, or None")  # fmt: skip
        _need("forecast_step", step, step is None or (_is_number(step) and math.isfinite(step) and step > 0),
              "give a positive number in the recording's unit of time, or None")  # fmt: skip
        _need("forecast_step", step, step is None or until is not None,
              "needs `forecast_until`; give the time to forecast to")  # fmt: skip


def _is_number(given: Any) -> bool:
    return isinstance(given, int | float | np.integer | np.floating) and not isinstance(given, bool)


def _need(name: str, given: Any, holds: bool, remedy: str) -> None:
    if not holds:
        raise InputError(f"{name}: is {shown(given)[1:-1]}; {remedy}")
