"""Nature: draws a case, hides physics in it, and knows the answer. It shares no code with symplearn.

`drawn` makes the case of a seed and a plan: it draws again until the claim of its way of hiding holds by computation.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from ._concealed_coefficients import Sizes, rms, sizes, suits, targets, unit_effect
from ._concealed_drawing import Public, Unsuitable, Wish, drawn_setting
from ._concealed_effects import OUTSIDE, Effect
from ._concealed_hiding import Claim, check, clean_readings, measured, trace, weights
from ._concealed_plan import ALLOWED, TRACED, Plan
from ._concealed_planes import ZOO
from ._concealed_sensors import Setup, expected, moved, noisy
from ._concealed_systems import Generator, log_uniform

MASKS = ("sensor_bias", "sensor_gain", "sensor_drift", "sensor_outliers", "viscous_damping", "cubic_stiffness",
         "constant_force", "quadratic_drag")  # fmt: skip
# The largest doses: parts of the forces that are there, of a parameter, of a reading.
_LARGEST = {"parameter_error": 0.25, "regime_change": 0.3, "parameter_drift": 0.4, "parametric_modulation": 0.3,
            "sensor_delay": 0.4, "contact_stop": 6.0, "impulse": 0.6, "sensor_gain": 0.4}  # fmt: skip
_ATTEMPTS = 80


class Case(NamedTuple):
    """A case with its answer."""

    plan: Plan
    setup: Setup
    public: Public
    effects: tuple[Effect, ...]
    remainder: tuple[Effect, ...]
    jitter: float
    noisy: tuple[np.ndarray, ...]
    clean: tuple[np.ndarray, ...]  # without noise, at the rows
    forecast: tuple[np.ndarray, ...]
    claim: Claim
    attempts: int


def drawn(item: Plan, seed: int) -> Case:
    """The case of a seed and a number. `RuntimeError` where no draw fits."""
    for attempt in range(_ATTEMPTS):
        rng = np.random.default_rng([seed, 2, item.number, attempt])
        if attempt == _ATTEMPTS // 2 and not item.healthy:  # what was asked may be impossible: another word
            item = item._replace(word=str(rng.choice(ALLOWED[item.way])))
        try:
            with np.errstate(all="ignore"):
                return _attempt(rng, item, attempt + 1)
        except (Unsuitable, FloatingPointError, np.linalg.LinAlgError):
            continue
    raise RuntimeError(f"case {item.number}: nothing fits {item}")


def _attempt(rng: Generator, item: Plan, attempts: int) -> Case:
    word = str(rng.choice(OUTSIDE)) if item.word == "outside" else item.word
    wish = _wish(rng, item, word)
    setup, public = drawn_setting(rng, wish)
    at = sizes(setup)
    effects = () if item.healthy else _effects(rng, item, word, wish, setup, public, at)
    if not item.healthy and effects[0].word == "sensor_noise":
        stated = public.noise[str(effects[0].target)] / effects[0].values["s"]
        public = public._replace(noise=public.noise | {str(effects[0].target): float(f"{stated:.4g}")})
    remainder, jitter = _remainder(rng, item.remainder, setup, public, at)
    return _finished(rng, item, setup, public, effects, remainder, jitter, attempts)


def _wish(rng: Generator, item: Plan, word: str) -> Wish:
    fit = [s for s in ZOO.values() if item.healthy or suits(word, s)]
    if item.way == "unread":
        fit = [s for s in fit if s.dof == 2]
    system = fit[rng.integers(len(fit))]
    several = 1 + int(rng.random() < 0.25) * int(rng.integers(1, 3))
    return Wish(
        system.name,
        records=int(rng.integers(2, 5)) if item.way == "one_of_several" else several,
        unread=int(rng.integers(2)) if item.way == "unread" else None,
        state_noise=word == "sensor_noise",
        known=str(rng.choice(system.varied)) if word == "parameter_error" else None,
        quiet=item.way in ("noise", "absorbed"),
        healthy=item.healthy,
        late=word == "sensor_delay",
    )


def _effects(
    rng: Generator, item: Plan, word: str, wish: Wish, setup: Setup, public: Public, at: Sizes
) -> tuple[Effect, ...]:
    """The hidden effect first, then its mask or a second one."""
    first = _dosed(rng, item.way, _unit(rng, word, item, wish, setup, at), setup, public)
    if item.way == "masked":
        other = str(rng.choice([w for w in MASKS if w != word and suits(w, setup.system)]))
        mask = _unit(rng, other, item, wish, setup, at)
        if other == "sensor_outliers":
            return first, mask
        ratio = rms(trace(setup, public, first).displaced) / rms(trace(setup, public, mask).displaced)
        return first, _limited(mask, ratio * log_uniform(rng, 2.2, 6.0))
    if not item.second:
        return (first,)
    others = [w for w in TRACED if w not in ("parameter_error", word) and suits(w, setup.system)]
    second = _unit(rng, str(rng.choice(others)), item._replace(way="open"), wish, setup, at)
    return first, _dosed(rng, "second", second, setup, public)


def _unit(rng: Generator, word: str, item: Plan, wish: Wish, setup: Setup, at: Sizes) -> Effect:
    """An effect of natural size on a target that fits the case."""
    fit = targets(word, setup)
    if word == "parameter_error":
        fit = [t for t in fit if t == wish.known]
    if item.way == "unread":
        fit = [t for t in fit if t == setup.system.coordinates[wish.unread or 0]]
    if not fit:
        raise Unsuitable("no target")
    effect = unit_effect(rng, word, fit[rng.integers(len(fit))], setup, at)
    several = len(setup.records) > 1
    if several and (item.way == "one_of_several" or word in ("impulse", "burst")):
        which = 1 if word in ("impulse", "burst", "regime_change") else int(rng.integers(1, len(setup.records) + 1))
        effect = Effect(effect.word, effect.target, effect.values, (which,))
    return effect


# Root of the chi-square that an effect adds to the recalibrated simulation: from hardly to clearly visible.
_VISIBLE = {"open": (3, 300), "unread": (3, 150), "masked": (4, 100), "confined": (3, 100),
            "one_of_several": (3, 100), "second": (6, 100)}  # fmt: skip


def _dosed(rng: Generator, way: str, unit: Effect, setup: Setup, public: Public) -> Effect:
    """The effect as strong as its way of hiding allows or asks."""
    if unit.word in ("sensor_noise", "sensor_outliers"):
        return unit
    found = trace(setup, public, unit)
    most = float(np.max(np.abs(found.displaced)))
    if not 0 < most < np.inf:
        raise Unsuitable("it does nothing")
    if way == "noise":
        dose = 0.95 / most * log_uniform(rng, 0.45, 1.0)
    elif way == "absorbed":
        low, high = 3.5 / most, 0.62 / max(found.misfit, 1e-9)
        if high < low:
            raise Unsuitable("recalibration does not absorb it")
        dose = log_uniform(rng, low, min(high, 15 * low))
    else:
        dose = log_uniform(rng, *_VISIBLE[way]) / max(found.detectable, 1e-9)
    return _limited(unit, dose)


def _limited(unit: Effect, dose: float) -> Effect:
    """`Unsuitable` where the dose would change the motion beyond recognition."""
    if not 0 < dose <= _LARGEST.get(unit.word, 0.5):
        raise Unsuitable("it would have to be too strong")
    scaled = unit.scaled(dose)
    name = unit.strength
    return scaled.with_values(**{name: float(f"{scaled.values[name]:.5g}")})


def _remainder(rng: Generator, kind: str, setup: Setup, public: Public, at: Sizes) -> tuple[tuple[Effect, ...], float]:
    """A small error without a name: it leaves a fifth to a half of the noise's sd in the recalibrated residuals."""
    if not kind:
        return (), 0.0
    size = float(rng.uniform(0.2, 0.5))
    if kind == "jitter":
        record = setup.records[0]
        i = int(rng.integers(len(setup.readings)))
        d, reading = setup.system.dof, setup.readings[i]
        h = reading.see(at.q[:d], at.p, setup.values)
        return (), float(f"{size * setup.noise[reading.column] / rms(np.gradient(h, record.times)):.4g}")
    word = "ripple" if kind == "ripple" else "quintic_stiffness"
    fit = targets(word, setup)
    unit = unit_effect(rng, word, fit[rng.integers(len(fit))], setup, at)
    misfit = trace(setup, public, unit).misfit
    if misfit < 1e-3:
        raise Unsuitable("recalibration owns the remainder")
    return (unit.scaled(size / misfit),), 0.0


def _finished(
    rng: Generator, item: Plan, setup: Setup, public: Public, effects: Sequence[Effect], remainder: Any, jitter: float,
    attempts: int,
) -> Case:  # fmt: skip
    """Motions, readings and noise of a drawn case, its claim checked."""
    whole = (*effects, *remainder)
    clean, after, seen, level = [], [], [], []
    for record in setup.records:
        motion = moved(setup, record, whole)
        clean.append(expected(setup, record, whole, motion, record.times))
        after.append(expected(setup, record, whole, motion, record.forecast))
        late = record.times + jitter * rng.normal(size=len(record.times))
        shown = clean[-1] if not jitter else expected(setup, record, whole, motion, np.clip(late, *late[[0, -1]]))
        seen.append(noisy(rng, setup, effects, shown, record.number))
        level.append(((seen[-1] - shown) / weights(setup)).ravel())
        for row, column in public.blanks[record.number - 1]:
            seen[-1][row, column] = np.nan
    _bounded(setup, clean)
    claim = Claim(0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
    if effects:
        without_remainder = clean_readings(setup, effects) if remainder else tuple(clean)
        claim = measured(setup, public, effects, without_remainder, tuple(seen), rms(np.concatenate(level)))
        check(item.way, setup, effects, without_remainder, claim)
        claim = claim._replace(detectable=float(np.hypot(claim.detectable, _of_noise(setup, effects))))
    return Case(item, setup, public, tuple(effects), tuple(remainder), jitter, tuple(seen), tuple(clean),
                tuple(after), claim, attempts)  # fmt: skip


def _of_noise(setup: Setup, effects: Sequence[Effect]) -> float:
    """Root of the likelihood ratio that a wrong noise or outliers are expected to give."""
    rows, total = sum(len(r.times) for r in setup.records), 0.0
    for e in effects:
        if e.word == "sensor_noise":
            total += rows * (e.values["s"] ** 2 - 1 - 2 * np.log(e.values["s"]))
        elif e.word == "sensor_outliers":  # entropy of one wide Gaussian less that of the mixture
            part, wide = e.values["e"], (e.values["sd"] / setup.noise[str(e.target)]) ** 2
            mixing = -part * np.log(part) - (1 - part) * np.log(1 - part)
            total += rows * max(np.log(1 + part * wide) - part * np.log(1 + wide) - 2 * mixing, 0.0)
    return float(np.sqrt(total))


def _bounded(setup: Setup, clean: Sequence[np.ndarray]) -> None:
    """`Unsuitable` where the effects have carried the readings far from where the simulation is."""
    for bare, found in zip(clean_readings(setup, ()), clean, strict=True):
        if not np.all(np.isfinite(found)) or np.any(np.max(np.abs(found), axis=0) > 4 * np.max(np.abs(bare), axis=0)):
            raise Unsuitable("the motion is another one")
