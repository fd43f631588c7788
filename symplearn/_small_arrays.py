"""NumPy's linear algebra on small arrays, on one thread.

OpenBLAS hands products of some thousands of rows with ten columns to all cores, and waits for them: 3 ms on two idle
cores, 7 ms on busy ones, where one thread takes 0.1 ms.
"""

from collections.abc import Callable
from functools import cache, wraps
from typing import ParamSpec, TypeVar

from threadpoolctl import ThreadpoolController

_Given = ParamSpec("_Given")
_Told = TypeVar("_Told")


def on_one_thread(function: Callable[_Given, _Told]) -> Callable[_Given, _Told]:
    """The same function, during which the process's BLAS has one thread."""

    @wraps(function)
    def limited(*args: _Given.args, **options: _Given.kwargs) -> _Told:
        with _libraries().limit(limits=1, user_api="blas"):
            return function(*args, **options)

    return limited


@cache
def _libraries() -> ThreadpoolController:
    """The libraries that are loaded; NumPy's and SciPy's are by the time of the first call."""
    return ThreadpoolController()
