"""How strong an effect may be and still be hidden, and whether the claim of a case holds: computed, never assumed."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ._concealed_drawing import Public, Unsuitable
from ._concealed_effects import Effect
from ._concealed_fit import Fitted, Form, Given, fit
from ._concealed_sensors import Setup, expected, moved

WAYS = ("open", "noise", "absorbed", "unread", "masked", "confined", "one_of_several")
ABSORBED = 1.2  # the recalibrated simulation's residuals over the noise, at most
CONFINED = 0.2  # share of the rows at which the effect acts, at most
MASKING = 2.0  # how much more than the masked effect the mask displaces the readings, at least


class Trace(NamedTuple):
    """What a small dose of an effect does to the readings, in sd of the noise and per unit of the effect."""

    displaced: np.ndarray  # from the same start with the same parameters
    left: np.ndarray  # what recalibration and free starts cannot absorb, with the rows of the priors
    rows: int

    @property
    def detectable(self) -> float:
        """Root of the chi-square that a unit adds."""
        return float(np.linalg.norm(self.left))

    @property
    def misfit(self) -> float:
        """Rms of the recalibrated simulation's residual without noise."""
        return float(np.linalg.norm(self.left[: self.rows]) / np.sqrt(self.rows))


def form_of(setup: Setup, public: Public, effects: Sequence[Effect] = (), opened: tuple = ()) -> Form:
    """The published simulation, with effects or without, as something to fit."""
    names = (*setup.system.coordinates, *setup.system.momenta)
    # What is known exactly is held by an sd far below all others.
    initial = tuple((names.index(k), m, sd or 1e-9) for k, (m, sd) in public.initial.items())
    return Form(setup, public.free, tuple(effects), tuple(opened), initial)


def starts(setup: Setup) -> list[np.ndarray]:
    """True first states."""
    return [r.start for r in setup.records]


def clean_readings(setup: Setup, effects: Sequence[Effect]) -> tuple[np.ndarray, ...]:
    """True readings without noise, by recording."""
    return tuple(expected(setup, r, effects, moved(setup, r, effects), r.times) for r in setup.records)


def weights(setup: Setup) -> np.ndarray:
    """True noise by column."""
    return np.array([setup.noise[r.column] for r in setup.readings])


DOSE = 1e-3


def trace(setup: Setup, public: Public, effect: Effect) -> Trace:
    """Linear response to an effect around the simulation without it."""
    form, given = form_of(setup, public), Given(clean_readings(setup, ()), weights(setup))
    theta = form.begin(starts(setup))
    _, slopes = form.differences(theta, form.scales(theta), given)
    dosed = clean_readings(setup, (effect.scaled(DOSE),))
    parts = zip(given.readings, dosed, strict=True)
    moved_by = np.concatenate([((b - a) / given.sd).ravel() for a, b in parts]) / DOSE
    rows = len(moved_by)
    whole = np.concatenate([moved_by, np.zeros(len(slopes) - rows)])
    if not np.all(np.isfinite(slopes)):
        raise Unsuitable("the simulation itself runs away")
    size = np.linalg.norm(slopes, axis=0)
    basis = np.linalg.svd(slopes / np.where(size > 0, size, 1.0), full_matrices=False)
    basis_kept = basis[0][:, basis[1] > 1e-9 * basis[1][0]]
    return Trace(moved_by, whole - basis_kept @ (basis_kept.T @ whole), rows)


def recalibrated(setup: Setup, public: Public, readings: tuple[np.ndarray, ...]) -> Fitted:
    """The simulation without effects, fitted by SciPy's least squares from the true values on."""
    form = form_of(setup, public)
    theta = form.begin(starts(setup))
    return fit(form, Given(readings, weights(setup)), theta, form.scales(theta), most=12)


def acting(setup: Setup, effect: Effect) -> float:
    """Share of the rows at which an effect acts."""
    if effect.word == "sensor_outliers":
        return float(effect.values["e"])
    rows = sum(len(r.times) for r in setup.records)
    if effect.word == "impulse":
        return 1.0 / rows
    hit = 0
    for record in setup.records:
        if effect.word == "burst":
            hit += int(np.sum((record.times >= effect.values["t_on"]) & (record.times < effect.values["t_off"])))
        elif effect.word == "contact_stop":
            i = setup.system.coordinates.index(str(effect.target))
            q = moved(setup, record, (effect,)).at(record.times)[i]
            upper = effect.values["side"] == "upper"
            hit += int(np.sum(q > effect.values["a"] if upper else q < effect.values["a"]))
        else:
            hit += len(record.times)
    return hit / rows


def displacement(setup: Setup, effects: Sequence[Effect], without: Sequence[Effect], clean: tuple) -> np.ndarray:
    """How far leaving effects out moves the readings, in sd, from the same start with the same parameters."""
    bare = clean_readings(setup, without)
    return np.concatenate([((a - b) / weights(setup)).ravel() for a, b in zip(clean, bare, strict=True)])


class Claim(NamedTuple):
    """Numbers behind a way of hiding."""

    displaced_most: float
    displaced_rms: float
    calibrated_over_noise: float
    misfit_rms: float
    detectable: float
    acting: float


def measured(
    setup: Setup, public: Public, effects: Sequence[Effect], clean: tuple, noisy: tuple, noise: float
) -> Claim:
    """Everything that the ways of hiding are judged by; `effects` begin with the one that is hidden.

    `noise` is the rms of the noise that was drawn, in its standard deviations.
    """
    moved_by = displacement(setup, effects, effects[1:], clean)
    bare = recalibrated(setup, public, clean)
    on_noise = recalibrated(setup, public, noisy)
    return Claim(
        float(np.max(np.abs(moved_by))),
        float(np.sqrt(np.mean(moved_by**2))),
        on_noise.rms / noise,
        bare.rms,
        float(np.sqrt(bare.chi2)),
        acting(setup, effects[0]),
    )


def check(way: str, setup: Setup, effects: Sequence[Effect], clean: tuple, claim: Claim) -> None:
    """`Unsuitable` where a case does not hide its first effect the way it says."""
    holds = {
        "open": lambda: True,
        "noise": lambda: claim.displaced_most < 1,
        "absorbed": lambda: claim.calibrated_over_noise <= ABSORBED and claim.displaced_most > 3,
        "unread": lambda: _unseen(setup, effects[0]),
        "masked": lambda: _masked(setup, effects, clean, claim),
        "confined": lambda: 0 < claim.acting <= CONFINED,
        "one_of_several": lambda: len(setup.records) > 1 and len(effects[0].recordings) == 1,
    }
    if not holds[way]():
        raise Unsuitable(f"not hidden by way of {way}")


def _unseen(setup: Setup, effect: Effect) -> bool:
    """No reading moves when the coordinate, or its momentum, that the effect acts on is moved."""
    d, x = setup.system.dof, setup.records[0].start
    i = setup.system.coordinates.index(str(effect.target))
    for place in (i, d + i):
        other = x.copy()
        other[place] += 0.1
        for reading in setup.readings:
            if reading.see(x[:d], x[d:], setup.values) != reading.see(other[:d], other[d:], setup.values):
                return False
    return True


def _masked(setup: Setup, effects: Sequence[Effect], clean: tuple, claim: Claim) -> bool:
    """The mask displaces the readings more: a motion, a sensor's error, or the rms of outliers."""
    if effects[1].word == "sensor_outliers":
        c = effects[1].values
        return bool(np.sqrt(c["e"]) * c["sd"] >= MASKING * claim.displaced_rms * setup.noise[str(effects[1].target)])
    mask = displacement(setup, effects, (effects[0], *effects[2:]), clean)
    return float(np.sqrt(np.mean(mask**2))) >= MASKING * claim.displaced_rms
