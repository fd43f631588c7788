"""Shapes and types checked at every call, double precision, a private folder where compiled programs outlive the run,
and not too many of them at once."""

import gc
import os
from pathlib import Path

import jax
import pytest
from jaxtyping import install_import_hook

jax.config.update("jax_enable_x64", True)
# As in the command line (`_private_cache.py`): to look through what stays again and again took a tenth to a sixth of
# three files' time.
gc.freeze()
gc.set_threshold(200_000, 20, 50)


def _checked(package: str) -> list[str]:
    """Modules of a package, but those that write machine code: a diagnosis calls them half a million times with hardly
    an array, and checking that took a fifth of it."""
    folder = Path(__file__).parents[1] / package
    own = [path.stem for path in folder.glob("*.py") if not path.stem.startswith(("__", "_machine"))]
    inner = [path.parent.name for path in folder.glob("*/__init__.py")]
    return [f"{package}.{name}" for name in own + inner]


install_import_hook([*_checked("symplearn"), *_checked("integrators")], "beartype.beartype")


def _private_cache() -> Path | None:
    """A folder of ours alone, mode 0700: what lies in it is executed. None where there can be none."""
    root = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    folder = root / "symplearn" / "jax"
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        if folder.is_symlink() or folder.stat().st_uid != os.getuid():
            return None
        folder.chmod(0o700)
    except OSError:
        return None
    return folder


# JAX reads $JAX_COMPILATION_CACHE_DIR by itself.
if not os.environ.get("JAX_COMPILATION_CACHE_DIR") and (_cache := _private_cache()) is not None:
    jax.config.update("jax_compilation_cache_dir", str(_cache))
# By default only programs of more than a second are kept; ours are many and small.
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)


# Each compiled program takes a few memory maps, of which Linux allows a process 65,530; past that it dies.
_MANY_MAPS = 20_000


@pytest.fixture(autouse=True, scope="module")
def _forget_compiled_programs():
    """After a file of tests, let go of compiled programs where they have become many."""
    yield
    maps = Path("/proc/self/maps")
    if maps.exists() and len(maps.read_bytes().splitlines()) > _MANY_MAPS:
        jax.clear_caches()
        gc.collect()
