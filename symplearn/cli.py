"""The `symplearn` command."""

import atexit
import os
import shutil
import signal
import sys
import tempfile
import time
from importlib import resources
from pathlib import Path
from types import TracebackType
from typing import Annotated, Any, NoReturn

import typer
from rich.console import Console
from typer.exceptions import TyperException

from ._errors import InputError, printable

app = typer.Typer(
    name="symplearn",
    help="Say what physics a simulation left out, from recordings that disagree with it.",
    add_completion=False,
    pretty_exceptions_enable=False,
)
_CORES = os.cpu_count() or 1
_STOPPED = 130  # by Ctrl-C, as a shell says it
_Positive = Annotated[int, typer.Option(min=1, help="Threads; the answer does not depend on it.")]


@app.command()
def diagnose(
    simulation: Annotated[Path, typer.Argument(help="The simulation file (TOML).", show_default=False)],
    recordings: Annotated[list[Path], typer.Argument(help="Recordings (CSV, .csv.gz).", show_default=False)],
    out: Annotated[Path, typer.Option(help="Folder that the report is written to.")] = Path("diagnosis"),
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
    if not 0 <= holdout < 1:
        raise InputError(f"--holdout: is {holdout}; give a share from 0 up to, but not including, 1")
    if time_limit is not None and not time_limit > 0:
        raise InputError(f"--time-limit: is {time_limit}; give a positive number of seconds")
    if forecast_step is not None and forecast_until is None:
        raise InputError("--forecast-step: needs --forecast-until; give the time to forecast to")
    _prepare(cache)
    from ._effects import EFFECTS
    from ._recording import read_recordings
    from ._simulation_file import read_simulation
    from .diagnosis import Options, restriction_of
    from .diagnosis import diagnose as run
    from .report import prepare_directory, summary, write_outputs

    restriction = restriction_of(effects, sensor_only, dynamics_only)
    sensors = {EFFECTS[name].family == "sensor" for name in restriction.effects or ()}
    if sensors == {dynamics_only} and sensor_only != dynamics_only:
        flag = "--sensor-only" if sensor_only else "--dynamics-only"
        raise InputError(f"{flag}: leaves none of the --effects to search; drop one of the two")
    file = read_simulation(simulation)
    read = read_recordings(file, recordings)
    folder = prepare_directory(out)
    with _Progress() as progress:
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
            ),
        )
        progress.say("writing the report")
        write_outputs(found, folder)
    console = Console()
    console.print(summary(found, folder), soft_wrap=not console.is_terminal)
    if fail_on_mismatch and found.document["verdict"] != "consistent":
        raise typer.Exit(3)


@app.command()
def demo(
    out: Annotated[Path, typer.Option(help="Folder that the report is written to.")] = Path("diagnosis"),
) -> None:
    """Diagnose the case that ships with symplearn: an effect concealed below the reading noise."""
    with resources.as_file(resources.files("symplearn") / "demo") as folder:
        diagnose(folder / "simulation.toml", [folder / "recording.csv"], out=out)


class _Progress:
    """What is being done, on stderr, from the second second on."""

    def __init__(self) -> None:
        self._console = Console(stderr=True)
        self._begin = time.monotonic()
        self._status = self._console.status("", spinner="line") if self._console.is_terminal else None
        self._stopped = False

    def __enter__(self) -> "_Progress":
        self._handler = signal.signal(signal.SIGINT, self._stop)
        if self._status:
            self._status.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        signal.signal(signal.SIGINT, self._handler)
        if self._status:
            self._status.stop()

    def _stop(self, number: int, frame: Any) -> NoReturn:
        self._stopped = True
        raise KeyboardInterrupt

    def say(self, message: str) -> None:
        """Tell what comes next; a Ctrl-C that a destructor or a callback swallowed is noticed here."""
        if self._stopped:
            raise KeyboardInterrupt
        passed = time.monotonic() - self._begin
        if self._status:
            self._status.update(f"{passed:4.0f} s  {message}")
        elif passed > 1.0:
            self._console.print(f"{passed:6.1f} s  {message}", markup=False, highlight=False)


def _prepare(cache: bool) -> None:
    """Double precision; compiled programs and the plots' font list in a private folder of the user's cache."""
    import jax

    jax.config.update("jax_enable_x64", True)
    folder = _private_folder() if cache else None
    # Left to itself matplotlib keeps its font list in a folder of its own.
    if "MPLCONFIGDIR" not in os.environ:
        os.environ["MPLCONFIGDIR"] = str(folder / "matplotlib") if folder else _passing_folder()
    jax.config.update("jax_enable_compilation_cache", cache)  # $JAX_COMPILATION_CACHE_DIR may name one, too
    if folder is not None:
        jax.config.update("jax_compilation_cache_dir", str(folder / "jax"))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.2)


def _passing_folder() -> str:
    """A folder that goes when the command ends."""
    folder = tempfile.mkdtemp(prefix="symplearn-")
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder


def _private_folder() -> Path | None:
    """The cache folder, readable by its owner alone; None where there can be none: what lies in it is executed."""
    folder = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "symplearn"
    try:
        for part in (folder, folder / "jax", folder / "matplotlib"):
            part.mkdir(mode=0o700, parents=True, exist_ok=True)
            if part.is_symlink() or part.stat().st_uid != os.getuid():
                return None
            part.chmod(0o700)
    except OSError:
        return None
    return folder


def main() -> None:
    """Run the command; wrong input is one line on stderr and exit code 2, a failure one line and exit code 1."""
    try:
        code = app(sys.argv[1:] or ["--help"], prog_name="symplearn", standalone_mode=False)
    except InputError as error:
        _leave(2, str(error))
    except TyperException as error:
        _leave(2, _usage_sentence(error))
    except (KeyboardInterrupt, typer.Abort):
        code = _STOPPED
    except Exception as error:
        if os.environ.get("SYMPLEARN_TRACEBACK"):
            raise
        _leave(1, f"failed: {type(error).__name__}: {printable(str(error))[:500]}")
    if code == _STOPPED:
        _leave(_STOPPED, "stopped; nothing was written")
    sys.exit(code)


def _leave(code: int, sentence: str) -> NoReturn:
    print(f"symplearn: {sentence}", file=sys.stderr)
    sys.exit(code)


def _usage_sentence(error: Any) -> str:
    """An error of the command line's own on one line."""
    command = error.ctx.command_path if getattr(error, "ctx", None) else "symplearn"
    return f"{printable(error.format_message().rstrip('.'))}; `{command} --help` tells what can be given"


if __name__ == "__main__":
    main()
