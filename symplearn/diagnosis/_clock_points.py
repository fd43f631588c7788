"""One column whitened beside an error of its sensor and one of its clock, for many of these at once under `jax.vmap`.

The filter of `_coloured` for two processes, written entry by entry: small matrices, one for each error, took five times
as long (121 errors, 2001 rows: 0.107 s against 0.020).
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from ._coloured import transition


def whitened_column(
    column: Float[Array, " row"], loadings: Float[Array, "2 row"], variances: Float[Array, " row"],
    gaps: tuple[Float[Array, " kind"], Int[Array, " row"]], shapes: tuple[Array, Array, Array],
) -> tuple[Float[Array, " row"], Float[Array, ""]]:  # fmt: skip
    """The column's whitened innovations, and the sum of their log variances; arguments as in `remembered`."""
    kinds, places = gaps
    still = [[ratio, ratio * frequency**2] for ratio, frequency in zip(*shapes[:2], strict=True)]
    each = [jax.vmap(transition, (0, None, None))(kinds, *one) for one in zip(*shapes[1:], strict=True)]

    def step(carry, data):
        (a, b, c), (p, q), logs = carry  # covariances within and across the processes, their means
        y, (h, g), r, first, second = data
        k = [h * a[0] + g * b[0][0], h * a[1] + g * b[1][0]]
        j = [h * b[0][0] + g * c[0], h * b[0][1] + g * c[1]]
        seen = r > 0
        S = jnp.where(seen, h * k[0] + g * j[0] + r, 1.0)
        e, gain = jnp.where(seen, y - h * p[0] - g * q[0], 0.0), jnp.where(seen, 1.0 / S, 0.0)
        p, q = ([m + n * gain * e for m, n in zip(*pair, strict=True)] for pair in ((p, k), (q, j)))
        b = [[b[m][n] - k[m] * j[n] * gain for n in range(2)] for m in range(2)]
        half = [[first[m, 0] * b[0][n] + first[m, 1] * b[1][n] for n in range(2)] for m in range(2)]
        b = [[half[m][0] * second[n, 0] + half[m][1] * second[n, 1] for n in range(2)] for m in range(2)]
        a, c = _moved(a, k, gain, still[0], first), _moved(c, j, gain, still[1], second)
        p, q = ([F[m, 0] * x[0] + F[m, 1] * x[1] for m in range(2)] for F, x in ((first, p), (second, q)))
        return ((a, b, c), (p, q), logs + jnp.where(seen, jnp.log(S), 0.0)), e / jnp.sqrt(S)

    zero = jnp.zeros(())
    pair = [zero, zero]
    begin = [still[0][0], zero, still[0][1]], [pair, pair], [still[1][0], zero, still[1][1]]
    rows = column, loadings.T, variances, *(one[places] for one in each)
    (_, _, logs), kept = jax.lax.scan(step, (begin, (pair, pair), zero), rows)
    return kept, logs


def _moved(own, seen, gain, still, F):
    """One process's covariance (00, 01, 11) after a reading and the gap that follows it."""
    x, y, z = (own[i] - seen[m] * seen[n] * gain for i, (m, n) in enumerate(((0, 0), (0, 1), (1, 1))))
    x, z = x - still[0], z - still[1]
    u, v = F[0, 0] * x + F[0, 1] * y, F[0, 0] * y + F[0, 1] * z
    s, t = F[1, 0] * x + F[1, 1] * y, F[1, 0] * y + F[1, 1] * z
    return [still[0] + u * F[0, 0] + v * F[0, 1], u * F[1, 0] + v * F[1, 1], still[1] + s * F[1, 0] + t * F[1, 1]]
