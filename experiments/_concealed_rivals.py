"""Which other effects come closest to the truth: linear responses to every word, on every target, over its shapes.

All responses are computed in a few batches of lanes around the simulation without effects; what recalibration and free
starts absorb is projected out. A rival is ranked by how much of the truth's response it reproduces.
"""

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from ._concealed_coefficients import Sizes, rms, sizes, targets
from ._concealed_drawing import Public
from ._concealed_effects import FAMILY, PAIRED, PARAMETRIC, SENSOR, Effect
from ._concealed_fit import Form, Given
from ._concealed_hiding import DOSE, clean_readings, form_of, starts, weights
from ._concealed_sensors import Setup

FREQUENCIES, TIMES, HIDDEN, STOPS = 48, 24, 10, (0.7, 0.85, 0.95)
_BENT = ("coulomb_friction", "contact_stop")
_BATCH = 400  # lanes at a time
# A candidate is not dosed beyond this share of the truth's response: over many swings even a small one is not linear.
# One that runs away is dosed by the second.
_GENTLE, _RUNAWAY = 0.01, 1e-3


class Candidate(NamedTuple):
    """A word on a target with its shape, and the effects whose responses span what it can do."""

    effect: Effect
    span: tuple[Effect, ...]


class Rival(NamedTuple):
    """A candidate with a first strength, and the chi-square of the truth's response that it leaves over."""

    effect: Effect
    left: float
    part: float  # of the chi-square
    price: float  # of its coefficients, by BIC

    @property
    def behind(self) -> float:
        """What its BIC will be about, less what is common to all."""
        return self.left + self.price


_CLOSED = ("side", "z_0", "w_0", "t_on", "t_off")
# Only a positive strength is what these words mean.
POSITIVE = ("viscous_damping", "quadratic_drag", "coulomb_friction", "relative_damping", "self_excitation",
            "hidden_oscillator", "sensor_delay", "contact_stop")  # fmt: skip


def physical(effect: Effect) -> bool:
    """Whether an effect's strength has the sign that its word asks for."""
    return effect.word not in POSITIVE or effect.values[effect.strength] > 0


def open_names(effect: Effect) -> list[str]:
    """The coefficients that a fit is free in."""
    return [name for name, value in effect.values.items() if name not in _CLOSED and isinstance(value, float)]


def candidates(setup: Setup, public: Public, recordings: tuple[int, ...]) -> list[Candidate]:
    """Every word that a fit of trajectories can tell, on every target, on a grid of its shape."""
    at = sizes(setup)
    known = set(setup.values) - {f.name for f in public.free}
    found = []
    for word in FAMILY:
        if word in ("sensor_noise", "sensor_outliers") or (word == "sensor_delay" and setup.system.drive):
            continue
        for target in targets(word, setup):
            if word == "parameter_error" and target not in known:
                continue
            for values, span in _shapes(word, target, setup, at):
                others = tuple(Effect(w, target, v, recordings) for w, v in span)
                found.append(Candidate(Effect(word, target, values, recordings), others))
    return found


_Span = list[tuple[str, dict[str, Any]]]


def _shapes(word: str, target: Any, setup: Setup, at: Sizes) -> Iterator[tuple[dict[str, Any], _Span]]:
    """Coefficients of natural size on the grid, and the responses that span them."""
    if word in SENSOR:
        (reading,) = (r for r in setup.readings if r.column == target)
        size = rms(reading.see(at.q, at.p, setup.values))
        span = at.times[-1] - at.times[0]
        name, value = {"sensor_bias": ("b", size), "sensor_gain": ("g", 1.0), "sensor_drift": ("r", size / span),
                       "sensor_delay": ("tau", 0.3 / at.omega)}[word]  # fmt: skip
        yield {name: value}, [(word, {name: value})]
    elif word in PARAMETRIC:
        yield from _of_parameter(word, at)
    elif word in PAIRED:
        yield from _of_pair(word, at)
    else:
        yield from _of_coordinate(word, setup.system.coordinates.index(target), at)


def _waves(word: str, name: str, size: float, at: Sizes) -> Iterator[tuple[dict[str, Any], _Span]]:
    span = at.times[-1] - at.times[0]
    high = min(np.pi / float(np.median(np.diff(at.times))) / 2, 3 * at.omega)
    for omega in np.linspace(np.pi / span, high, FREQUENCIES):
        both = [{name: size, "omega": float(omega), "phi": phi} for phi in (0.0, -np.pi / 2)]
        yield both[0], [(word, one) for one in both]


def _instants(at: Sizes) -> np.ndarray:
    return np.linspace(at.times[0], at.times[-1], TIMES + 2)[1:-1] + 1.37e-7


def _of_parameter(word: str, at: Sizes) -> Iterator[tuple[dict[str, Any], _Span]]:
    if word == "parametric_modulation":
        yield from _waves(word, "a", 1.0, at)
    elif word == "parameter_drift":
        values = {"r": 1.0 / (at.times[-1] - at.times[0])}
        yield values, [(word, values)]
    elif word == "parameter_error":
        yield {"d": 1.0}, [(word, {"d": 1.0})]
    else:
        for t in _instants(at):
            values = {"d": 1.0, "t_star": float(t)}
            yield values, [(word, values)]


def _of_pair(word: str, at: Sizes) -> Iterator[tuple[dict[str, Any], _Span]]:
    force = float(np.mean(at.force))
    values = {
        "relative_damping": {"c": force / rms(at.v[0] - at.v[1])},
        "coupling_spring": {"k": force / rms(at.q[0] - at.q[1])},
        "gyroscopic_coupling": {"b": force / rms(at.v)},
        "central_correction": {"b": force * float(np.mean(np.hypot(*at.q))) ** 4 / 3},
    }[word]
    yield values, [(word, values)]


def _of_coordinate(word: str, i: int, at: Sizes) -> Iterator[tuple[dict[str, Any], _Span]]:
    q, v, force = at.q[i], rms(at.v[i]), float(at.force[i])
    size = rms(q)
    if word == "periodic_forcing":
        yield from _waves(word, "a", force, at)
    elif word == "impulse":
        for t in _instants(at):
            values = {"j": force / at.omega, "t_star": float(t)}
            yield values, [(word, values)]
    elif word == "hidden_oscillator":
        for omega in at.omega * np.geomspace(0.25, 2.5, HIDDEN):
            values = {"omega": float(omega), "kappa": float(omega * np.sqrt(force / size))}
            free = [{"a": force, "omega": float(omega), "phi": phi} for phi in (0.0, -np.pi / 2)]
            yield values, [(word, values), *(("periodic_forcing", one) for one in free)]
    elif word == "contact_stop":
        for share in STOPS:
            for side, level in (("upper", np.quantile(q, share)), ("lower", np.quantile(q, 1 - share))):
                values = {"k": force / np.ptp(q) * 4, "a": float(level), "side": side}
                yield values, [(word, values)]
    elif word == "self_excitation":
        values = {"c": force / v, "a": float(np.max(np.abs(q)))}
        yield values, [("viscous_damping", {"c": force / v}), ("position_damping", {"c": force / (v * size**2)})]
    else:
        values = {
            "viscous_damping": {"c": force / v}, "quadratic_drag": {"c": force / v**2},
            "coulomb_friction": {"f": force}, "constant_force": {"f": force}, "linear_stiffness": {"k": force / size},
            "quadratic_stiffness": {"k": force / size**2}, "cubic_stiffness": {"k": force / size**3},
        }[word]  # fmt: skip
        yield values, [(word, values)]


def responses(setup: Setup, public: Public, effects: Sequence[Effect]) -> np.ndarray:
    """Change of all readings per unit of each effect, in sd, shape (row, effect)."""
    columns = np.empty((sum(len(r.times) for r in setup.records) * len(setup.readings), len(effects)))
    batches: dict[tuple[bool, bool], list[int]] = {}
    for k, e in enumerate(effects):
        batches.setdefault((e.word in _BENT, "t_star" in e.values), []).append(k)
    for places in batches.values():
        for begin in range(0, len(places), _BATCH):
            some = places[begin : begin + _BATCH]
            columns[:, some] = _batch(setup, public, [effects[k] for k in some])
    return columns


@np.errstate(all="ignore")  # what ran away is dosed less
def _gently(setup: Setup, public: Public, effects: Sequence[Effect]) -> np.ndarray:
    """The same, where those of large response are given in smaller doses; the first effect sets what is large."""
    columns = responses(setup, public, effects)
    size = DOSE * np.linalg.norm(columns, axis=0)
    share = _GENTLE * np.linalg.norm(columns[:, 0]) / size
    share = np.where(np.isfinite(size), share, _RUNAWAY)
    strong = np.nonzero(share < 1)[0]
    if len(strong):
        columns[:, strong] = responses(setup, public, [effects[k].scaled(share[k]) for k in strong]) / share[strong]
    return columns


def _batch(setup: Setup, public: Public, effects: Sequence[Effect]) -> np.ndarray:
    """Lanes that each hold one dosed effect, and a last one that holds none."""
    merged: dict[tuple[Any, ...], list[int]] = {}
    for k, e in enumerate(effects):
        merged.setdefault((e.key, e.values.get("side"), e.recordings), []).append(k)
    lanes = len(effects) + 1
    union = []
    for places in merged.values():
        first = effects[places[0]]
        values: dict[str, Any] = {"side": first.values["side"]} if "side" in first.values else {}
        for name in first.values:
            if name == "side":
                continue
            # Shapes are those of the first in lanes where the strength is zero.
            values[name] = np.full(lanes, 0.0 if name == first.strength else first.values[name])
            for k in places:
                dosed = effects[k].scaled(DOSE) if name == first.strength else effects[k]
                values[name][k] = dosed.values[name]
        union.append(Effect(first.word, first.target, values, first.recordings))
    form = form_of(setup, public, union)
    theta = form.begin(starts(setup))[:, None] * np.ones(lanes)
    found = [(one[:, :, :-1] - one[:, :, -1:]) / weights(setup)[None, :, None] for one in form.readings(theta)]
    return np.concatenate([one.reshape(-1, lanes - 1) for one in found]) / DOSE


def nuisances(setup: Setup, public: Public) -> np.ndarray:
    """An orthonormal basis of what recalibration and free starts can do, with the rows of the priors."""
    form, given = form_of(setup, public), Given(clean_readings(setup, ()), weights(setup))
    theta = form.begin(starts(setup))
    _, slopes = form.differences(theta, form.scales(theta), given)
    size = np.linalg.norm(slopes, axis=0)
    u, s, _ = np.linalg.svd(slopes / np.where(size > 0, size, 1.0), full_matrices=False)
    return u[:, s > 1e-9 * s[0]]


def ranked(form: Form, public: Public, kept: Sequence[Effect], truth: Effect, found: list[Candidate]) -> list[Rival]:
    """Candidates in place of `truth`, beside the effects that are kept, the closest first, one for word and target."""
    setup = form.setup
    basis = nuisances(setup, public)
    spans = [e for c in found for e in c.span]
    whole = _gently(setup, public, [truth, *kept, *spans])
    price = float(np.log(len(whole)))
    whole = np.concatenate([whole, np.zeros((len(basis) - len(whole), whole.shape[1]))])
    whole = np.where(np.isfinite(whole), whole, 0.0)
    whole = whole - basis @ (basis.T @ whole)
    others = np.linalg.qr(whole[:, 1 : 1 + len(kept)])[0] if kept else np.zeros((len(whole), 0))
    whole = whole - others @ (others.T @ whole)
    goal, best = whole[:, 0], {}
    place = 1 + len(kept)
    for c in found:
        columns = whole[:, place : place + len(c.span)]
        place += len(c.span)
        weight, *_ = np.linalg.lstsq(columns, goal, rcond=1e-8)
        left, whole_goal = float(np.sum((goal - columns @ weight) ** 2)), max(float(np.sum(goal**2)), 1e-300)
        rival = Rival(_with_strength(c, weight), left, left / whole_goal, price * _freedom(setup, c.effect))
        if physical(rival.effect) and (c.effect.key not in best or left < best[c.effect.key].left):
            best[c.effect.key] = rival
    return sorted(best.values(), key=lambda r: r.behind)


def _freedom(setup: Setup, effect: Effect) -> int:
    """How many coefficients and hidden states an effect brings."""
    hidden = 2 * len(setup.records) if effect.word == "hidden_oscillator" else 0
    return len(open_names(effect)) + hidden


def _with_strength(c: Candidate, weight: np.ndarray) -> Effect:
    """The candidate as strong as the projection says, signs and phases included."""
    effect = c.effect
    if len(c.span) == 1:
        return effect.with_values(**{effect.strength: effect.values[effect.strength] * float(weight[0])})
    if effect.word == "self_excitation":
        drag, bend = (float(w) * e.values["c"] for w, e in zip(weight, c.span, strict=True))
        if drag * bend >= 0:  # no a does this; the nearest is an a beyond the motion
            return effect.with_values(c=-drag, a=20 * effect.values["a"])
        a = np.sqrt(-drag / bend)
        return effect.with_values(c=-drag, a=float(np.clip(a, 0.05 * effect.values["a"], 20 * effect.values["a"])))
    if effect.word == "hidden_oscillator":
        return effect.scaled(float(weight[0])) if weight[0] > 0 else effect.with_values(kappa=-1.0)
    return effect.with_values(
        a=effect.values["a"] * float(np.hypot(*weight)), phi=float(np.arctan2(-weight[1], weight[0]))
    )
