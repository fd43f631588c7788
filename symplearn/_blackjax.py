"""The way to blackjax: imported when it is first needed, because with it JAX begins to compute.

Until then a program may still choose its platform, and takes no memory of a graphics card.
"""

from typing import Any

import jax


def blackjax() -> Any:
    """The module `blackjax`; what it works out when it is imported is worked out at once, also within a traced
    function."""
    with jax.ensure_compile_time_eval():
        import blackjax
    return blackjax
