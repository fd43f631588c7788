"""The verb: from a simulation and its recordings to what the simulation left out."""

import time
from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np

from .._errors import InputError, shown
from .._recording import Recording
from .._simulation_records import SimulationFile
from .._small_arrays import on_one_thread
from ._answer import Answer
from ._find import searched
from ._forecast import forecast_times
from ._options import Options
from ._record import Diagnosis
from ._turns import unwrapped
from ._usable import check_readings

_AS_USUAL = Options()


@on_one_thread
def diagnose(file: SimulationFile, recordings: Sequence[Recording], options: Options = _AS_USUAL) -> Diagnosis:
    """Locate what differs between a simulation and its recordings, name what was left out, and show the fit without
    and with it.

    It computes where JAX does, and is made for a processor: on a graphics card it takes more than four times as long.
    The command line sees to that; here `jax.config.update("jax_platforms", "cpu")` does, before anything is computed.

    `InputError` where something else is given, as a path, where simulation and recordings do not fit together, and
    where JAX computes in single precision.
    """
    _refuse_paths(file, recordings, options)
    if jnp.zeros(()).dtype != np.float64:
        raise InputError(
            "`diagnose` computes in double precision, and JAX is set to single; call "
            '`jax.config.update("jax_enable_x64", True)` before it'
        )
    with np.errstate(all="ignore"):  # what is not finite is told in the answer
        return _diagnosed(file, recordings, options)


def _refuse_paths(file: Any, recordings: Any, options: Any) -> None:
    """Refuse what only the command line takes: names of files, and options one by one."""
    if not isinstance(file, SimulationFile):
        raise InputError(f"`diagnose` needs what `read_simulation` gives, not {shown(file)}; read the file first")
    is_list = isinstance(recordings, list | tuple)
    wrong = [one for one in recordings if not isinstance(one, Recording)] if is_list else [recordings]
    if wrong or not recordings:
        other = shown(wrong[0]) if wrong else "an empty list"
        raise InputError(f"`diagnose` needs the list that `read_recordings` gives, not {other}; read them first")
    if not isinstance(options, Options):
        raise InputError(f"`diagnose` needs `Options(...)`, not {shown(options)}; name in it what is to be changed")


def _diagnosed(file: SimulationFile, recordings: Sequence[Recording], options: Options) -> Diagnosis:
    begin = time.monotonic()
    options.progress("reading the equations of motion")
    check_readings(file, recordings)
    times = _times_ahead(file, recordings[0], options)
    recordings, notes = unwrapped(file, recordings)
    found, stepper, told, all_rows = searched(file, recordings, options, begin + options.time_limit)
    options.progress("comparing before and after on the held-out rows")
    answer = Answer(file, recordings, stepper, found, options, times, [*told, *notes], all_rows)
    return answer.diagnosis(begin)


def _times_ahead(file: SimulationFile, recording: Recording, options: Options) -> np.ndarray | None:
    """Times to forecast; asked before the long work, so that a wrong wish, or a missing input, is said at once."""
    if options.forecast_until is None:
        return None
    times = forecast_times(recording, options.forecast_until, options.forecast_step)
    if recording.inputs is not None:
        recording.inputs.at(times)
        for t in recording.inputs.missing[recording.inputs.missing > recording.times[-1]]:
            if t <= times[-1]:
                raise InputError(
                    f"{recording.name}, {file.recording.time} = {t:.10g}: an input is missing that the forecast needs; "
                    "give inputs in every row up to --forecast-until"
                )
    return times
