"""What every experiment shares: its options, its folder with `metrics.json` and figures, its progress and its table."""

import argparse
import json
import os
import sys
import time
from collections.abc import Callable, Collection, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

import jax
from matplotlib.figure import Figure

from symplearn._errors import InputError, printable
from symplearn._places import check_address


class Run(NamedTuple):
    """One run of an experiment: the folder `out` that it fills, the `seed` of its noise, and whether it is `quick`.

    `scheduler` is the address of a Dask scheduler whose workers do the parts of a sweep, or None; `looking` asks for
    what is there already, and to make nothing.
    """

    out: Path
    seed: int = 0
    quick: bool = False
    scheduler: str | None = None
    looking: bool = False

    def each(self, what: str, items: Collection[Any]) -> Iterator[Any]:
        """The items one by one, with a line on stderr after two seconds and then every ten."""
        due = time.monotonic() + 2.0
        for done, item in enumerate(items, 1):
            yield item
            if time.monotonic() > due:
                due = time.monotonic() + 10.0
                print(f"{what}: {done} of {len(items)}", file=sys.stderr, flush=True)

    def write(self, metrics: dict[str, Any]) -> None:
        """Write `metrics.json`, its keys sorted; `ValueError` for a number that is not finite."""
        text = json.dumps(metrics | {"seed": self.seed, "quick": self.quick}, indent=2, sort_keys=True, allow_nan=False)
        self._put("metrics.json", lambda path: path.write_text(text, encoding="utf-8"))

    def save(self, figure: Figure, name: str) -> None:
        """Write a figure as PNG. A `Figure` made without pyplot is drawn by Agg, and needs no display."""
        self._put(name, lambda path: figure.savefig(path, format="png", dpi=150))

    def _put(self, name: str, write: Callable[[Path], Any]) -> None:
        unfinished = self.out / f".{name}.{os.getpid()}"
        try:
            write(unfinished)
            os.replace(unfinished, self.out / name)  # whole or not at all
        finally:
            unfinished.unlink(missing_ok=True)


SCHEDULER = "work on the workers of this Dask scheduler, as tcp://HOST:8786 (default: in this process)"


def in_double_precision() -> None:
    """Double precision, and compiled programs kept beside the experiments."""
    jax.config.update("jax_enable_x64", True)
    if jax.config.jax_compilation_cache_dir is None:  # type: ignore[attr-defined]
        jax.config.update("jax_compilation_cache_dir", str(Path(__file__).parents[1] / ".cache" / "jax"))


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        self.exit(2, f"{self.prog}: {printable(message)}; `--help` tells what can be given\n")


def command(
    name: str,
    about: str,
    experiment: Callable[[Run], None],
    arguments: Sequence[str] | None = None,
    sweep: bool = False,
) -> None:
    """Run an experiment in double precision with the command line's options; bad input is one sentence, exit 2.

    A `sweep` takes `--scheduler`.
    """
    parser = _Parser(prog=f"experiments.{name}", description=about)
    parser.add_argument("--out", type=Path, default=Path("out") / name, help="folder to fill (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="seed of the noise, 0 or more (default: 0)")
    parser.add_argument("--quick", action="store_true", help="a smaller run, of less than five minutes")
    if sweep:
        parser.add_argument("--scheduler", metavar="ADDRESS", help=SCHEDULER)
    run = Run(**vars(parser.parse_args(arguments)))
    if run.seed < 0:
        parser.error(f"--seed is {run.seed}, but must be 0 or more")
    in_double_precision()
    try:
        if run.scheduler is not None:
            check_address(run.scheduler)
        run.out.mkdir(parents=True, exist_ok=True)
        experiment(run)
    except (InputError, OSError) as error:
        parser.error(str(error))


def print_table(*rows: Sequence[Any]) -> None:
    """Print rows with aligned columns; floating numbers with four digits."""
    cells = [[f"{x:.4g}" if isinstance(x, float) else str(x) for x in row] for row in rows]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    print("\n".join("  ".join(map(str.ljust, row, widths)).rstrip() for row in cells))
