"""How to diagnose."""

import os
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ._build import Restriction


@dataclass(frozen=True)
class Options:
    """How to diagnose.

    **Arguments:** - `holdout`: share of the used rows of each recording that no fit sees. - `restriction`: which
    effects are searched. - `jobs`: threads. - `time_limit`: seconds after which the search is cut short. - `progress`:
    told what is being done.
    """

    holdout: float = 0.25
    seed: int = 0
    restriction: Restriction = Restriction()
    jobs: int = os.cpu_count() or 1
    time_limit: float = np.inf
    forecast_until: float | None = None
    forecast_step: float | None = None
    progress: Callable[[str], None] = lambda message: None
