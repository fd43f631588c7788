"""What the cases of a trial are meant to be: ways of hiding and words are dealt so that all of them come up."""

from typing import NamedTuple

import numpy as np

from ._concealed_effects import FAMILY, SENSOR
from ._concealed_hiding import WAYS

DYNAMICS = tuple(w for w in FAMILY if w not in SENSOR)
TRACED = tuple(w for w in FAMILY if w not in ("sensor_noise", "sensor_outliers"))
_SINGLE = tuple(w for w in DYNAMICS if FAMILY[w] in ("dissipation", "activity", "conservative", "forcing"))
_ON_ONE = tuple(w for w in _SINGLE if w not in ("relative_damping", "coupling_spring", "central_correction"))
# What each way of hiding can hide.
ALLOWED = {
    "open": (*FAMILY, "outside"),
    "noise": (*TRACED, "outside"),
    "absorbed": (
        "linear_stiffness", "quadratic_stiffness", "cubic_stiffness", "constant_force", "coupling_spring",
        "gyroscopic_coupling", "central_correction", "hidden_oscillator", "parameter_error", "sensor_gain",
        "sensor_bias", "parameter_drift", "contact_stop", "viscous_damping",
    ),
    "unread": (*_ON_ONE, "hidden_oscillator", "outside"),
    "masked": (*(w for w in DYNAMICS), "sensor_delay"),
    "confined": ("impulse", "contact_stop", "sensor_outliers", "burst"),
    "one_of_several": (*TRACED, "outside"),
}  # fmt: skip
REMAINDERS = ("ripple", "geometry", "jitter")


class Plan(NamedTuple):
    """What a case is meant to be."""

    number: int
    healthy: bool
    way: str
    word: str
    second: bool
    remainder: str


def plan(cases: int, seed: int) -> list[Plan]:
    """A quarter healthy; the other cases deal the ways in turn, each the word it may hide that came up least."""
    rng = np.random.default_rng([seed, 1])
    healthy = cases // 4
    ways = [WAYS[k % len(WAYS)] for k in range(cases - healthy)]
    count = dict.fromkeys((*FAMILY, "burst", "outside"), 0)
    count["outside"] = -(cases // 40)  # a class of many forces
    found = []
    # The ways with few words choose first, so that no word waits for a way that cannot hide it.
    for way in sorted(ways, key=lambda w: (len(ALLOWED[w]), w)):
        least = min(count[w] for w in ALLOWED[way])
        word = str(rng.choice([w for w in ALLOWED[way] if count[w] == least]))
        count[word] += 1
        second = way in ("open", "unread", "one_of_several") and rng.random() < 0.25
        found.append((False, way, word, second))
    found = [found[k] for k in rng.permutation(len(found))]
    # A quarter of all cases carry a remainder; the healthy ones carry none.
    remainders = [REMAINDERS[k % 3] if k < cases // 4 else "" for k in range(len(found))]
    every = [(*one, r) for one, r in zip(found, rng.permutation(remainders), strict=True)]
    every += [(True, "", "", False, "")] * healthy
    order = rng.permutation(len(every))
    return [Plan(n, *every[k][:4], str(every[k][4])) for n, k in enumerate(order, 1)]
