"""The `symplearn` command."""

import contextlib
import math
import os
import signal
import sys
from collections.abc import Iterator
from importlib import metadata, resources
from pathlib import Path
from typing import Annotated, Any, NoReturn

import typer
from rich.console import Console
from typer.exceptions import TyperException

from ._errors import InputError, printable
from ._private_cache import prepare
from ._progress import STOPPED, Progress, Terminated, interrupt

app = typer.Typer(
    name="symplearn",
    help="Say what physics a simulation left out, from recordings that disagree with it.",
    add_completion=False,
    pretty_exceptions_enable=False,
)
_CORES = os.cpu_count() or 1


def _folder_at(name: str | Path) -> Path:
    """An empty name, as of a variable that was never set, is not the folder that the command runs in. A default is a
    path already."""
    if not str(name).strip():
        raise InputError("--out: is empty; name the folder that the report is to be written to")
    return Path(name)


_Out = Annotated[
    Path, typer.Option(parser=_folder_at, metavar="<path>", help="Folder of the report, or of the reports.")
]
_Positive = Annotated[int, typer.Option(min=1, help="Threads; the answer does not depend on it.")]


def _tell_version(asked: bool) -> bool:
    if asked:
        print(f"symplearn {metadata.version('symplearn')}")
        raise typer.Exit
    return asked


@app.callback()
def _symplearn(
    version: Annotated[
        bool, typer.Option("--version", callback=_tell_version, is_eager=True, help="Print the version and leave.")
    ] = False,
) -> None: ...


@app.command()
def diagnose(
    simulation: Annotated[Path, typer.Argument(help="The simulation file (TOML).", show_default=False)],
    recordings: Annotated[list[Path], typer.Argument(help="Recordings (CSV, .csv.gz).", show_default=False)],
    out: _Out = Path("diagnosis"),
    seed: Annotated[int, typer.Option(min=-(2**63), max=2**63 - 1, help="Same seed, same files: same answer.")] = 0,
    holdout: Annotated[float, typer.Option(help="Last part of each recording, kept from every fit.")] = 0.25,
    forecast_until: Annotated[float | None, typer.Option(help="Forecast up to this time.")] = None,
    forecast_step: Annotated[float | None, typer.Option(help="Spacing of the forecast.")] = None,
    effects: Annotated[str | None, typer.Option(help="Search these effects only (comma separated).")] = None,
    sensor_only: Annotated[bool, typer.Option("--sensor-only", help="Search effects of the sensors only.")] = False,
    dynamics_only: Annotated[
        bool, typer.Option("--dynamics-only", help="Search effects of the dynamics only.")
    ] = False,
    jobs: _Positive = _CORES,
    time_limit: Annotated[float | None, typer.Option(help="Cut the search short after these seconds.")] = None,
    fail_on_mismatch: Annotated[
        bool, typer.Option("--fail-on-mismatch", help="Exit with 3 unless the verdict is `consistent`.")
    ] = False,
    cache: Annotated[bool, typer.Option(help="Keep compiled programs under the user's cache folder.")] = True,
) -> None:
    """Locate what differs, name what was left out, and show the fit without and with it."""
    _check(holdout, time_limit)
    _check_forecast(forecast_until, forecast_step)
    prepare(cache)
    from ._recording import read_recordings
    from ._simulation_file import read_simulation
    from .diagnosis import Options
    from .diagnosis import diagnose as run
    from .report import summary, write_outputs

    restriction = _restriction(effects, sensor_only, dynamics_only)
    file = read_simulation(simulation)
    read = read_recordings(file, recordings)
    with Progress() as progress, _folder(out) as folder:
        found = run(
            file,
            read,
            Options(
                holdout=holdout,
                seed=seed,
                restriction=restriction,
                jobs=jobs,
                time_limit=time_limit if time_limit is not None else float("inf"),
                forecast_until=forecast_until,
                forecast_step=forecast_step,
                progress=progress.say,
                notice=progress.notice,
            ),
        )
        progress.say("writing the report")
        write_outputs(found, folder)
    console = Console()
    console.print(summary(found, folder), soft_wrap=not console.is_terminal)
    if fail_on_mismatch and found.document["verdict"] != "consistent":
        raise typer.Exit(3)


@app.command()
def diagnose_each(
    simulation: Annotated[Path, typer.Argument(help="The simulation file (TOML).", show_default=False)],
    recordings: Annotated[list[Path], typer.Argument(help="Recordings (CSV, .csv.gz).", show_default=False)],
    out: _Out = Path("diagnoses"),
    seed: Annotated[int, typer.Option(min=-(2**63), max=2**63 - 1, help="Same seed, same files: same answer.")] = 0,
    holdout: Annotated[float, typer.Option(help="Last part of each recording, kept from every fit.")] = 0.25,
    effects: Annotated[str | None, typer.Option(help="Search these effects only (comma separated).")] = None,
    sensor_only: Annotated[bool, typer.Option("--sensor-only", help="Search effects of the sensors only.")] = False,
    dynamics_only: Annotated[
        bool, typer.Option("--dynamics-only", help="Search effects of the dynamics only.")
    ] = False,
    jobs: Annotated[int | None, typer.Option(min=1, help="Threads of a diagnosis (every core; 1 on workers).")] = None,
    time_limit: Annotated[float | None, typer.Option(help="Cut each search short after these seconds.")] = None,
    scheduler: Annotated[
        str | None, typer.Option(metavar="ADDRESS", help="Diagnose on the workers of this Dask scheduler.")
    ] = None,
    cache: Annotated[bool, typer.Option(help="Keep compiled programs under the user's cache folder.")] = True,
) -> None:
    """Diagnose every recording by itself, not all of them as one question; what is done is kept."""
    _check(holdout, time_limit)
    prepare(cache)
    from . import _each_recording as each
    from ._places import place
    from ._simulation_file import read_simulation

    threads = jobs or (_CORES if scheduler is None else 1)
    limit = time_limit if time_limit is not None else float("inf")
    settings = each.Settings(holdout, seed, _restriction(effects, sensor_only, dynamics_only), threads, limit, cache)
    read_simulation(simulation)  # for all of them, what is wrong with it is said once
    console, failed = Console(), 0
    with place(scheduler, lambda line: print(line, file=sys.stderr)) as workers, Progress() as progress:
        for one in each.diagnose_each(workers, simulation, recordings, out, settings):
            failed += one.failure is not None
            said = "kept from before" if one.kept else one.verdict or f"failed: {one.failure}"
            console.print(f"{printable(one.name)}: {said}", markup=False, highlight=False, soft_wrap=True)
            progress.say(f"{printable(one.name)} is done")
    if failed:
        rest = f"; the others' reports are in {out}" if failed < len(recordings) else ""
        _leave(1, f"{failed} of {len(recordings)} recordings could not be diagnosed{rest}")


def _check(holdout: float, time_limit: float | None) -> None:
    if not 0 <= holdout < 1:
        raise InputError(f"--holdout: is {holdout}; give a share from 0 up to, but not including, 1")
    if time_limit is not None and not time_limit > 0:
        raise InputError(f"--time-limit: is {time_limit}; give a positive number of seconds")


def _check_forecast(until: float | None, step: float | None) -> None:
    if until is not None and not math.isfinite(until):
        raise InputError(f"--forecast-until: is {until}; give the time to forecast to")
    if step is not None and not (math.isfinite(step) and step > 0):
        raise InputError(f"--forecast-step: is {step}; give a positive number in the recording's unit of time")
    if step is not None and until is None:
        raise InputError("--forecast-step: needs --forecast-until; give the time to forecast to")


def _restriction(effects: str | None, sensor_only: bool, dynamics_only: bool) -> Any:
    from ._effects import EFFECTS
    from .diagnosis import restriction_of

    restriction = restriction_of(effects, sensor_only, dynamics_only)
    sensors = {name in EFFECTS and EFFECTS[name].family == "sensor" for name in restriction.effects or ()}
    if sensors == {dynamics_only} and sensor_only != dynamics_only:
        flag = "--sensor-only" if sensor_only else "--dynamics-only"
        raise InputError(f"{flag}: leaves none of the --effects to search; drop one of the two")
    return restriction


@app.command()
def demo(
    out: _Out = Path("diagnosis"),
) -> None:
    """Diagnose the case that ships with symplearn: an effect concealed below the reading noise."""
    with resources.as_file(resources.files("symplearn") / "demo") as folder:
        diagnose(folder / "simulation.toml", [folder / "recording.csv"], out=out)


@contextlib.contextmanager
def _folder(out: Path) -> Iterator[Path]:
    """The output folder. Where it was made for a report that then is not written, it is taken away again."""
    from .report import prepare_directory

    made = [folder for folder in (out, *out.parents) if not os.path.lexists(folder)]
    try:
        yield prepare_directory(out)
    except BaseException:
        for folder in made:
            with contextlib.suppress(OSError, ValueError):  # what is not empty stays
                folder.rmdir()
        raise


def main() -> None:
    """Run the command; wrong input is one line on stderr and exit code 2, a failure one line and exit code 1."""
    handler = signal.signal(signal.SIGTERM, interrupt)
    try:
        _main()
    finally:
        signal.signal(signal.SIGTERM, handler)


def _main() -> None:
    try:
        code = app(sys.argv[1:] or ["--help"], prog_name="symplearn", standalone_mode=False)
    except InputError as error:
        _leave(2, str(error))
    except TyperException as error:
        _leave(2, _usage_sentence(error))
    except (KeyboardInterrupt, typer.Abort):
        _leave_stopped(signal.SIGINT)
    except Terminated:
        _leave_stopped(signal.SIGTERM)
    except Exception as error:
        if os.environ.get("SYMPLEARN_TRACEBACK"):
            raise
        _leave(1, f"failed: {type(error).__name__}: {printable(str(error))[:500]}")
    if code == STOPPED + signal.SIGINT:  # typer's own word for a Ctrl-C that it has caught
        _leave_stopped(signal.SIGINT)
    sys.exit(code)


def _leave_stopped(number: int) -> NoReturn:
    each = sys.argv[1:2] == ["diagnose-each"]
    left = "what is done is kept, and the same command goes on" if each else "nothing was written"
    _leave(STOPPED + number, f"stopped; {left}")


def _leave(code: int, sentence: str) -> NoReturn:
    print(f"symplearn: {sentence}", file=sys.stderr)
    sys.exit(code)


def _usage_sentence(error: Any) -> str:
    """An error of the command line's own on one line."""
    command = error.ctx.command_path if getattr(error, "ctx", None) else "symplearn"
    return f"{printable(error.format_message().rstrip('.'))}; `{command} --help` tells what can be given"


if __name__ == "__main__":
    main()
