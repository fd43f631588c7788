"""What is in the rows that are kept from every fit: an effect of a late time or place shows in none of the others.

The answer is of the fitted rows alone (contract, section 4). Where it is that nothing was left out, and one effect
promises more than it costs when all rows are asked, all are searched, and what they say is told beside the answer.
"""

from typing import Any

import numpy as np

from ._document import alternative
from ._found import Found
from ._prospects import MANY, Prospects
from ._score import Start
from ._trajectory import Stepper
from ._verdict import judged
from ._weigher import Weigher


def promises_more(stepper: Stepper, found: Found) -> bool:
    """Whether one effect promises more than it costs on the rows of a stepper, about the simulation as it is, which
    was found on fewer of them."""
    weigher, white = Weigher(stepper, Found(stepper.problem, found.priors)), found.of((), "white")
    assert white is not None  # the simulation as it is is weighed first
    weigher.weigh([Start((), white.z, 0.0)], whole=True)
    starts = Prospects(weigher).about((), MANY)
    return bool(max((one.gain + found.prices.log(one.combination) for one in starts), default=-np.inf) > 0.0)


def of_all_rows(stepper: Stepper, found: Found) -> dict[str, Any] | None:
    """What is said of the rows of a stepper where it is not that nothing was left out: the probability of that, and the
    likeliest of all else."""
    odds, chosen, verdict = judged(stepper, found)
    if verdict == "consistent":
        return None
    likeliest = (chosen.combination, False, chosen.probability) if chosen else ((), True, odds.unexplained)
    return {"as_it_is": odds.as_it_is, "likeliest": alternative(found.problem, *likeliest)}
