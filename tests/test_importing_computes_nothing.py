"""Importing symplearn makes JAX compute nothing, so that a program may choose its platform afterwards."""

import subprocess
import sys

CODE = """
import symplearn, symplearn.cli, integrators
import jax
jax.config.update("jax_platforms", "no such platform")
try:
    print("begun on", jax.devices())
except RuntimeError:
    print("not begun")
"""


def test_a_platform_is_chosen_after_the_import():
    """A platform that does not exist, chosen after the import, is looked for: JAX had not begun on another, nor taken
    the memory of a graphics card."""
    found = subprocess.run([sys.executable, "-c", CODE], capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "not begun"
