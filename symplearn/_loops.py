"""How XLA runs loops on a CPU: as one compiled function each, not kernel by kernel.

A loop over time does little in each step, so that handing its kernels to a thread pool one after the other takes long:
a trajectory's slopes cost 3.4 times the processor time on one thread of the diagnosis, 1.7 times on two. XLA reads
its options once, when JAX first computes, so this is imported before anything else;
`XLA_FLAGS` that set such options already are left as they are.
"""

import os
from importlib.metadata import version

# Bytes of state up to which a loop becomes one function.
_SMALL = 10_000_000
# The option has this name in these versions of jaxlib; another would end the process at a name it does not know.
_KNOWN = ("0.10.", "0.11.")
_OPTION = "--xla_backend_extra_options"


def ask_for_whole_loops() -> None:
    """Add the option to this process's `XLA_FLAGS`."""
    given = os.environ.get("XLA_FLAGS", "")
    if version("jaxlib").startswith(_KNOWN) and _OPTION not in given:
        os.environ["XLA_FLAGS"] = f"{given} {_OPTION}=xla_cpu_small_while_loop_byte_threshold={_SMALL}".strip()


ask_for_whole_loops()
