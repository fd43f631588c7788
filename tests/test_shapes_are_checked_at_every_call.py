"""In the tests shapes and types are checked at every call, but of what writes machine code."""

import inspect
import sys

import jaxtyping
import numpy as np
import pytest

import symplearn  # noqa: F401 (its modules are looked at)
from symplearn.diagnosis._evidence import orthants


def test_arrays_that_do_not_fit_are_refused():
    """A covariance of three numbers beside a mean of two."""
    with pytest.raises(jaxtyping.TypeCheckError):
        orthants(np.zeros(2), np.eye(3))


def test_no_function_is_left_out():
    """Every function of both packages is wrapped; `_machine...` is not, and is some of them."""
    plain = {name for name, module in sys.modules.items() if name.startswith(("symplearn.", "integrators."))
             for one in vars(module).values()
             if inspect.isfunction(one) and one.__module__ == name and not hasattr(one, "__wrapped__")}  # fmt: skip
    assert plain and all(name.startswith("symplearn._machine") for name in plain)
