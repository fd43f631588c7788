"""An error of the sensor that goes with what it reads, and maybe with how fast that changes, as far as it is known."""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum

import numpy as np
from jaxtyping import Bool, Float
from numpy.polynomial.legendre import legvander

# Polynomials up to this degree, as a worn track has another error at every place; or a plain curve, as of a scale that
# saturates: the square and the cube, as what is constant or in proportion has a name of its own.
_DEGREE, _CURVE = 12, (2, 3)
# Half of what a play may be, as shares of the range of what is read.
_GAPS = (0.0025, 0.01, 0.04)


class Form(Enum):
    """What such an error looks like: many bends, a plain curve, or play, by which what is read lags behind on the way
    there and on the way back."""

    BENDS = "bends"
    CURVE = "curve"
    PLAY = "play"


@dataclass(frozen=True)
class Shapes:
    """What such an error is a sum of, over the range of what is read, and with `speeds` over that of its rate of change
    too. Play goes with the direction, and is small beside the motion."""

    readings: tuple[float, float]
    speeds: tuple[float, float] | None = None
    form: Form = Form.BENDS

    @classmethod
    def over(
        cls, expected: Sequence[Float[np.ndarray, " _"]], times: Sequence[Float[np.ndarray, " _"]],
        seen: Bool[np.ndarray, " row"], moving: bool, form: Form = Form.BENDS,
    ) -> "Shapes":  # fmt: skip
        """Those of what is read in some recordings, end to end, and with `moving` of its rates."""
        speeds = [rate(x, t) for x, t in zip(expected, times, strict=True)]
        ends = _ends(np.concatenate(expected), seen), _ends(np.concatenate(speeds), seen) if moving else None
        return cls(*ends, form)

    def __call__(
        self, expected: Float[np.ndarray, "*batch row"], times: Float[np.ndarray, " row"]
    ) -> Float[np.ndarray, "*batch row shape"]:
        if self.form is Form.PLAY:
            return _lags(expected, times, self.readings)
        if self.form is Form.CURVE:
            plain = curves(expected, *self.readings)
            if self.speeds is None:
                return plain
            return np.concatenate([plain, _joint(expected, times, self.readings, self.speeds)], axis=-1)
        shapes = polynomials(expected, *self.readings)
        if self.speeds is None:
            return shapes
        # A constant error is among those of place.
        return np.concatenate([shapes, polynomials(rate(expected, times), *self.speeds)[..., 1:]], axis=-1)


@dataclass(frozen=True, eq=False)
class Bend:
    """The error of one channel: the mean of its shapes' coefficients, and the rms over the rows of the sd that is left
    of it."""

    shapes: Shapes
    coefficients: Float[np.ndarray, " shape"]
    spread: float

    def __call__(
        self, expected: Float[np.ndarray, "*batch row"], times: Float[np.ndarray, " row"]
    ) -> Float[np.ndarray, "*batch row"]:
        found: np.ndarray = self.shapes(expected, times) @ self.coefficients
        return found


def bent(
    expected: Float[np.ndarray, "*batch row channel"], times: Float[np.ndarray, " row"], bends: Sequence[Bend]
) -> Float[np.ndarray, "*batch row channel"]:
    """What is read where this is expected at these times; the same where there are no bends."""
    return expected + sum(one(expected[..., j], times)[..., None] * (np.arange(expected.shape[-1]) == j)
                          for j, one in enumerate(bends))  # fmt: skip


def curves(expected: Float[np.ndarray, "*row"], low: float, high: float) -> Float[np.ndarray, "*row power"]:
    """The square and the cube, counted from the middle of a range, of mean square one over it."""
    place = _place(expected, low, high)
    return np.stack([place**k * np.sqrt(2 * k + 1) for k in _CURVE], axis=-1)


def _lags(
    expected: Float[np.ndarray, "*batch row"], times: Float[np.ndarray, " row"], readings: tuple[float, float]
) -> Float[np.ndarray, "*batch row gap"]:
    """Where between both ends of its play what is read is, from -1 to 1, for several gaps: at the end that it comes
    from, once it has come as far as the gap is wide from where it turned."""
    speeds = rate(expected, times)
    ways, turned = np.sign(speeds), np.zeros(expected.shape, bool)
    turned[..., 1:] = ways[..., 1:] != ways[..., :-1]
    after = np.maximum.accumulate(np.where(turned, np.arange(len(times)), 0), axis=-1)
    before = np.maximum(after - 1, 0)
    (x, u), (y, v) = ([np.take_along_axis(one, k, axis=-1) for one in (expected, speeds)] for k in (before, after))
    # It turned between two rows; there its speed is nearly a straight line.
    share = np.clip(u / np.where(u == v, 1.0, u - v), 0.0, 1.0)
    ends = 0.5 * (x + y) + 0.25 * (u * share - v * (1.0 - share)) * (times[after] - times[before])
    gaps = np.array(_GAPS) * max(readings[1] - readings[0], 1e-300)
    come = np.where((after > 0)[..., None], np.abs(expected - ends)[..., None] / gaps, 2.0)
    return np.nan_to_num(-ways[..., None] * np.clip(come - 1.0, -1.0, 1.0))


def _joint(
    expected: Float[np.ndarray, "*batch row"], times: Float[np.ndarray, " row"], readings: tuple[float, float],
    speeds: tuple[float, float],
) -> Float[np.ndarray, "*batch row 2"]:  # fmt: skip
    """The product of place and speed, counted from the middles of their ranges, and the square of the speed; of mean
    square one over these."""
    place, speed = _place(expected, *readings), _place(rate(expected, times), *speeds)
    return np.stack([3.0 * place * speed, np.sqrt(5.0) * speed**2], axis=-1)


def polynomials(expected: Float[np.ndarray, "*row"], low: float, high: float) -> Float[np.ndarray, "*row degree"]:
    """Legendre's, orthonormal over a range; beyond, they stay as at its end."""
    shapes: np.ndarray = legvander(_place(expected, low, high), _DEGREE) * np.sqrt(2 * np.arange(_DEGREE + 1) + 1)
    return shapes


def _place(expected: Float[np.ndarray, "*row"], low: float, high: float) -> Float[np.ndarray, "*row"]:
    """Where in a range something is, from -1 to 1."""
    return np.nan_to_num(np.clip(2 * (expected - low) / max(high - low, 1e-300) - 1, -1.0, 1.0))


def rate(
    expected: Float[np.ndarray, "*batch row"], times: Float[np.ndarray, " row"]
) -> Float[np.ndarray, "*batch row"]:
    """How fast something changes that is expected at these times; zero where there is one time alone."""
    if len(times) < 2:
        return np.zeros_like(expected)
    found: np.ndarray = np.gradient(expected, times, axis=-1, edge_order=2 if len(times) > 2 else 1)
    return found


def _ends(expected: Float[np.ndarray, " row"], seen: Bool[np.ndarray, " row"]) -> tuple[float, float]:
    """The range of something where it is seen."""
    some = expected[seen & np.isfinite(expected)] if seen.any() else np.zeros(1)
    return (float(some.min()), float(some.max())) if len(some) else (0.0, 0.0)
