"""Priors of every effect's values: the same strength for every effect, along the motion that was recorded."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from .. import _effects as effects
from .._effects import Candidate, Drag, Oscillating, PowerForce
from ._activity import powers
from ._calibrate import Priors, even
from ._memories import Span
from ._motion import Motion, rms
from ._problem import Problem

# Prior scale of an effect: its force against the forces already there, its error against the reading, its change of a
# parameter against the parameter. Readings count from zero, which is the sensor's: a bias errs as much as a scale does.
STRENGTH = 0.3
# A stop bears the forces already there at this share of the motion's range, over `STRENGTH`, or softer: at a ten
# thousandth. A prior that hard stops do not fit in makes them softer than they are; orders of magnitude cost little.
_DEPTH = 3e-5
# Share of the rows that at least lie inside of a stop.
_RESTING = 0.1
# Share of the largest momentum that a blow may be, as one that sets in motion what was at rest.
_BLOW = 0.5
# Root mean square over the recording of what grows evenly to one, and of what is one in half of it: their inverses.
_EVEN, _HALF = np.sqrt(3.0), np.sqrt(2.0)


def with_effects(problem: Problem, priors: Priors, motion: Motion) -> Priors:
    """Priors with those of every effect's values filled in."""
    centres, scales, lower, upper = (a.copy() for a in (priors.centres, priors.scales, priors.lower, priors.upper))
    for one in problem.equations.candidates:
        amplitudes = slice(one.first, one.first + one.effect.amplitudes)
        scales[amplitudes] = STRENGTH * np.array(_unit(motion, one))
        if one.effect is effects.HIDDEN:
            loose = _looseness(problem, priors, motion, one.place)
            scales[amplitudes] *= np.hypot(1.0, loose / STRENGTH) * np.hypot(1.0, loose)
        if one.effect is effects.FORCING:
            scales[amplitudes] *= _fast(motion, one.place)
        if one.effect is effects.IMPULSE:
            scales[amplitudes] = np.fmax(scales[amplitudes], _BLOW * motion.momenta[one.place])
        if one.effect is effects.DELAY:
            scales[one.first], upper[one.first] = problem.latest / 2, problem.latest
        if one.effect.places:
            place = amplitudes.stop
            low, high = _range(motion, one)
            centres[place], scales[place] = even(low, high)
            lower[place], upper[place] = low, high
    scales = np.where(np.isfinite(scales) & (scales > 0), scales, 1.0)
    starts = [_unseen(motion, i, _looseness(problem, priors, motion, i)) for i in range(problem.equations.declared)]
    return replace(priors, centres=centres, scales=scales, lower=lower, upper=upper, unseen=np.array(starts),
                   powers=powers(problem, motion), windows=motion.windows, forces=motion.forces)  # fmt: skip


def _fast(motion: Motion, i: int) -> float:
    """By how many times as much as those already there a periodic force may be: what moves a body as far in a shorter
    time is the stronger by the square of their ratio, and this is the middle of all orders of magnitude between."""
    return float(max(1.0, motion.frequencies[1] / motion.own_frequency(i)))


def _looseness(problem: Problem, priors: Priors, motion: Motion, i: int) -> float:
    """By how many times as much as it is the stiffness of a coordinate may be another, by the priors of what is
    calibrated.

    Two bodies that a strong spring joins swing slowly together; seen alone, one looks as soft as that. What an unseen
    one may do is as strong as what the seen one's own stiffness may be.
    """
    there = motion.forces[i] / rms(motion.q[:, i] - np.nanmean(motion.q[:, i]))
    return float(np.linalg.norm(motion.stiffening[i] * priors.widths(problem)) / there)


def _unseen(motion: Motion, i: int, loose: float) -> tuple[float, float]:
    """How strong the force of an unseen oscillator on one coordinate may be at the start, and its rate of change."""
    push = np.hypot(STRENGTH, loose) * motion.forces[i]
    return push, push * motion.own_frequency(i) * np.sqrt(np.hypot(1.0, loose))


def _unit(motion: Motion, one: Candidate) -> tuple[float, ...]:
    """Amplitudes as strong as what is already there."""
    if one.effect.acts_on == effects.COLUMN:
        level = motion.levels[one.place]
        units = {effects.BIAS: level, effects.GAIN: 1.0, effects.DRIFT: _EVEN * level / motion.span}
        return (units.get(one.effect, 1.0),) * one.effect.amplitudes
    if one.effect.acts_on == effects.PARAMETER:
        later = {effects.DRIFTING: _EVEN / motion.span, effects.REGIME: _HALF}
        return (later.get(one.effect, 1.0),) * one.effect.amplitudes
    return _pair_unit(motion, one) if one.effect.acts_on == effects.PAIR else _force_unit(motion, one)


def _force_unit(motion: Motion, one: Candidate) -> tuple[float, ...]:
    i = one.place
    q, v, push = motion.q[:, i], motion.v[:, i], motion.forces[i]
    if isinstance(one.effect, PowerForce):
        return (push / rms(q**one.effect.power),)
    if isinstance(one.effect, Drag):
        return (push / rms(np.abs(v) ** one.effect.power),)
    if one.effect is effects.EXCITATION:
        return push / rms(v), push / rms(q**2 * v)
    if one.effect is effects.STOP:
        return (push / (_DEPTH * max(np.ptp(q), 1e-300)),)
    if one.effect is effects.HIDDEN:
        return (push * motion.own_frequency(i) ** 2 / rms(q),)
    if one.nameless is not None:
        return (1.0,) * one.effect.amplitudes  # see `with_nameless`
    if one.effect is effects.IMPULSE:
        return (push / motion.own_frequency(i),)
    return (push,) * 2  # a cosine and a sine, whose root mean squares add in squares


def _pair_unit(motion: Motion, one: Candidate) -> tuple[float, ...]:
    i, j = one.places
    push = min(motion.forces[i], motion.forces[j])
    if one.effect is effects.RELATIVE:
        return (push / rms(motion.v[:, i] - motion.v[:, j]),)
    if one.effect is effects.SPRING:
        return (push / rms(motion.q[:, i] - motion.q[:, j]),)
    if one.effect is effects.GYROSCOPIC:  # each is pushed by the other's speed, which may be in another unit
        return (min(motion.forces[i] / rms(motion.v[:, j]), motion.forces[j] / rms(motion.v[:, i])),)
    r = np.hypot(motion.q[:, i], motion.q[:, j])
    return (np.hypot(motion.forces[i], motion.forces[j]) / rms(3 * r / np.maximum(r, 0.1 * rms(r)) ** 5),)


def _range(motion: Motion, one: Candidate) -> tuple[float, float]:
    """Where an effect's place may lie."""
    if isinstance(one.effect, Oscillating):
        return motion.frequencies
    if one.effect is effects.HIDDEN:  # which its start shows where it has swung but half a cycle
        low, high = motion.frequencies
        return low / 2, high
    if one.effect is effects.STOP:
        # One that a body comes to rest on lies beyond most of what is read.
        low, least, most, high = np.nanquantile(motion.q[:, one.place], [0.0, _RESTING, 1.0 - _RESTING, 1.0])
        return (float(least), float(high)) if one.side == "upper" else (float(low), float(most))
    return motion.first, motion.last


def with_nameless(
    problem: Problem, priors: Priors, scales: Sequence[Float[np.ndarray, " _"]], spans: Sequence[Span | None]
) -> Priors:
    """Priors with those of forces without a name, which stand last, behind all that has some already: `scales` of their
    amplitudes, in their order, and between what the fading of each lies that fades."""
    grown = {}
    for name, fill in (("centres", 0.0), ("scales", 1.0), ("lower", -np.inf), ("upper", np.inf)):
        values = np.full(problem.equations.size, fill)
        old = getattr(priors, name)
        values[: len(old)] = old
        grown[name] = values
    last = problem.equations.candidates[-len(scales) :]
    for one, scale, span in zip(last, scales, spans, strict=True):
        place = one.first + one.effect.amplitudes
        grown["scales"][one.first : place] = scale
        if span is not None:
            grown["lower"][place], grown["upper"][place] = span.low, span.high
            grown["centres"][place], grown["scales"][place] = even(span.low, span.high)
    return replace(priors, **grown)
