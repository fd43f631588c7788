"""Double precision on the processor, a garbage collector for much that stays, and what a process of the command line
keeps in the user's cache folder."""

import atexit
import gc
import os
import shutil
import tempfile
from pathlib import Path

# New objects between two collections, and how many of those between two of older objects.
_COLLECTED = 200_000, 20, 50


def prepare(cache: bool) -> None:
    """Double precision; compiled programs and the plots' font list in a private folder of the user's cache."""
    import jax

    # Expressions and traced functions are hundreds of thousands of objects that stay: to look through them again and
    # again took a twentieth of a diagnosis.
    gc.freeze()
    gc.set_threshold(*_COLLECTED)
    atexit.register(gc.freeze)  # else all that stayed is looked through once more: 0.35 s of the demo
    jax.config.update("jax_enable_x64", True)
    if not os.environ.get("JAX_PLATFORMS"):
        # A diagnosis is machine code and small arrays, for each of which a graphics card has to be called.
        jax.config.update("jax_platforms", "cpu")
    folder = _private_folder() if cache else None
    # Left to itself matplotlib keeps its font list in a folder of its own.
    if "MPLCONFIGDIR" not in os.environ:
        os.environ["MPLCONFIGDIR"] = str(folder / "matplotlib") if folder else _passing_folder()
    jax.config.update("jax_enable_compilation_cache", cache)  # $JAX_COMPILATION_CACHE_DIR may name one, too
    if folder is not None:
        jax.config.update("jax_compilation_cache_dir", str(folder / "jax"))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.05)


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
