"""The normal distribution in closed form: SciPy's own checks of shapes and bounds cost a search seconds."""

from typing import Any

import numpy as np


def log_density(x: Any, sd: Any = 1.0) -> Any:
    """Of a normal about zero."""
    return -0.5 * (x / sd) ** 2 - np.log(sd) - 0.5 * np.log(2 * np.pi)
