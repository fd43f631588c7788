"""What is asked of a diagnosis from Python is checked as the command checks it, before any work."""

import math

import engine_cases as cases
import jaxtyping
import numpy as np
import pytest

from symplearn import InputError, Options, diagnose, restriction_of
from symplearn._effects import EFFECTS
from symplearn.diagnosis import Restriction

SIMULATION = cases.simulation("p**2/2 + q**2/2")


@pytest.fixture(autouse=True)
def _as_users_have_it(monkeypatch):
    """The tests' own check of annotations, which a user does not have, would speak first."""
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)


WRONG = {
    "holdout": [1.5, 1, -0.1, math.nan, "0.2", None, True],
    "seed": [0.5, "0", None, True, 2**63, -(2**63) - 1],
    "restriction": [["quadratic_drag"], "quadratic_drag", None],
    "jobs": [0, -1, 1.5, "2", True],
    "time_limit": [0, -1.0, math.nan, "60", None],
    "forecast_until": [math.inf, math.nan, "30"],
    "progress": [None, "say"],
}


@pytest.mark.parametrize("name, given", [(name, given) for name, several in WRONG.items() for given in several])
def test_wrong_options(name, given):
    """A field that is out of range, or of another kind, is named with what it was and what is needed."""
    with pytest.raises(InputError, match=f"^{name}: is .*; give "):
        Options(**{name: given})


@pytest.mark.parametrize("step", [0.0, -1.0, math.inf, math.nan, "1"])
def test_wrong_steps_of_a_forecast(step):
    """A forecast's step is positive and finite, and needs a time to forecast to."""
    with pytest.raises(InputError, match="^forecast_step: is .*; give a positive number"):
        Options(forecast_until=30.0, forecast_step=step)
    with pytest.raises(InputError, match="needs `forecast_until`"):
        Options(forecast_step=0.1)


def test_what_is_allowed():
    """The ends of every range, and NumPy's numbers, are taken."""
    Options(holdout=0, seed=-(2**63), jobs=1, time_limit=math.inf)
    Options(holdout=np.float64(0.5), seed=np.int64(3), time_limit=1, forecast_until=3, forecast_step=np.float32(0.1))


def test_restrictions_are_made_of_names():
    """Effects to search are given in a list or as the command takes them, and nothing else need be said."""
    names = ("quadratic_drag", "sensor_bias")
    assert restriction_of("unnamed_force").effects == ("unnamed_force",)  # a word of the contract as the others are
    assert restriction_of(list(names)) == restriction_of(" quadratic_drag, sensor_bias") == Restriction(names)
    assert restriction_of() == Restriction()
    assert restriction_of(dynamics_only=True) == Restriction(sensor=False)


def test_unknown_effects_are_told_all_that_are_known():
    """An effect that is near none is answered with every one there is."""
    with pytest.raises(InputError) as refused:
        restriction_of(["zzz"])
    assert all(f"`{name}`" in str(refused.value) for name in EFFECTS) and "..." not in str(refused.value)


@pytest.mark.parametrize(
    "given, said",
    [
        (("s.toml", ["a.csv"]), "what `read_simulation` gives, not `s.toml`"),
        ((SIMULATION, ["a.csv"]), "list that `read_recordings` gives, not `a.csv`"),
        ((SIMULATION, "a.csv"), "not `a.csv`"),
        ((SIMULATION, []), "not an empty list"),
    ],
)
def test_files_are_read_first(given, said):
    """A path where what was read from it is needed is told how to be read."""
    with pytest.raises(InputError, match=said):
        diagnose(*given)
