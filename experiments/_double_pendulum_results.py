"""What the trainings on the double pendulum came to: metrics, the table, Figures 5.12 to 5.14, and what helps."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure

from ._command import print_table
from ._ensemble import Spread

STEP, GRAVITY = 0.01, 9.81
POSTERIOR, L1, PIECES, COARSE = WAYS = ("posterior", "l1", "posterior_in_pieces", "posterior_step_5_times")
COLOURS = dict(zip(WAYS, ("tab:blue", "tab:red", "tab:green", "tab:orange"), strict=True))
FAR = 0.5  # radians
PUBLISHED = (
    "published, as figures alone: neither estimate follows the truth beyond about 5 s; the posterior's Hamiltonian "
    "error is lower and without spikes; the spread of the stochastic simulation grows where the estimate departs"
)


def energy(x: np.ndarray) -> np.ndarray:
    """H (5.28) over the last axis, with the denominator of specification E46."""
    a, b, p, r = np.moveaxis(x, -1, 0)
    kinetic = (p**2 + 2 * r**2 - 2 * p * r * np.cos(a - b)) / (2 * (1 + np.sin(a - b) ** 2))
    return kinetic - GRAVITY * (2 * np.cos(a) + np.cos(b))


class Drawn(NamedTuple):
    """Of each repeat: angles (repeat, draw, time, 2) of stochastic simulations over the time of the data, with the
    learnt process noise and with one of the true one-step error's variances; the one-step errors (repeat, time, 4) from
    true states; the variances learnt (repeat, 4)."""

    learnt: np.ndarray
    ideal: np.ndarray
    one_step: np.ndarray
    variances: np.ndarray


class Regime(NamedTuple):
    """One motion: truth (time, 4), free runs of each way (repeat, time, 4), and the draws of the posterior's."""

    truth: np.ndarray
    runs: dict[str, np.ndarray]
    drawn: Drawn | None

    @property
    def middle(self) -> int:
        """The repeat in the middle of the posterior's Hamiltonian errors."""
        off = _off(self.runs[POSTERIOR], self.truth).mean(axis=1)
        return int(np.argsort(off)[len(off) // 2])


def _off(xs: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """The absolute Hamiltonian error over time."""
    return np.abs(energy(xs) - energy(truth[0]))


def judge(xs: np.ndarray, truth: np.ndarray) -> dict[str, Spread]:
    """Of all repeats (5.29), its maximum, and the time until an angle is off by half a radian."""
    off = _off(xs, truth)
    far = np.any(np.abs(xs[..., :2] - truth[:, :2]) > FAR, axis=-1)
    until = STEP * np.where(far.any(axis=1), far.argmax(axis=1), len(truth))
    return {
        "mean_hamiltonian_error": Spread.of(off.mean(axis=1)),
        "maximum_hamiltonian_error": Spread.of(off.max(axis=1)),
        "time_to_half_radian": Spread.of(until),
    }


def coverage(draws: np.ndarray, angles: np.ndarray) -> np.ndarray:
    """The share of true angles inside the middle 90 % of the draws, of each repeat."""
    low, high = np.quantile(draws, (0.05, 0.95), axis=1)
    return np.mean((low <= angles) & (angles <= high), axis=(1, 2))


def calibrate(drawn: Drawn, xs: np.ndarray, truth: np.ndarray) -> dict[str, Spread]:
    """The spread of the stochastic simulation against the true error of the free run, over the time of the data.

    `coverage_90` is the share of angles inside the middle 90 % of the draws, `error_over_spread` the median over time
    of |error| / standard deviation (0.67 for a normal), `rank_correlation` that of the two over time (Spearman).

    Why it is as it is: `one_step_error_over_process_noise` is the root of the mean of squared one-step errors over
    learnt variances (1 where the process noise is as large as what it stands for), `one_step_error_correlation` that of
    neighbours in time (0 for the white noise that it is taken for), and `coverage_90_ideal` the coverage of white noise
    with the errors' own variances.
    """
    count = drawn.learnt.shape[2]
    angles, nominal = truth[:count, :2], xs[:, :count, :2]
    error = np.abs(nominal - angles).mean(axis=-1)[:, 1:]
    sd = drawn.learnt.std(axis=1).mean(axis=-1)[:, 1:]
    ranks = [np.argsort(np.argsort(each, axis=1), axis=1) for each in (error, sd)]
    e = drawn.one_step
    neighbours = np.sum(e[:, 1:] * e[:, :-1], axis=1) / np.sum(e**2, axis=1)
    return {
        "coverage_90": Spread.of(coverage(drawn.learnt, angles)),
        "coverage_90_ideal": Spread.of(coverage(drawn.ideal, angles)),
        "error_over_spread": Spread.of(np.median(error / np.maximum(sd, 1e-12), axis=1)),
        "rank_correlation": Spread.of([np.corrcoef(*pair)[0, 1] for pair in zip(*ranks, strict=True)]),
        "one_step_error_over_process_noise": Spread.of(np.sqrt(np.mean(e**2 / drawn.variances[:, None], axis=(1, 2)))),
        "one_step_error_correlation": Spread.of(neighbours.mean(axis=1)),
        "process_noise_sd": Spread.of(np.sqrt(drawn.variances.mean(axis=1))),
    }


def metrics(regimes: dict[str, Regime]) -> dict[str, Any]:
    """The keys of `metrics.json`: a number of a way ends in the way and the motion, the calibration's in the motion.

    `gain_hamiltonian_error_*` is how many times lower the mean Hamiltonian error is, repeat by repeat: than L1's for
    the posterior, and than the posterior's for what is beyond the dissertation.
    """
    numbers: dict[str, Any] = {}
    for name, (truth, runs, drawn) in regimes.items():
        for way, xs in runs.items():
            numbers |= {f"{key}_{way}_{name}": value for key, value in judge(xs, truth).items()}
        mean = {way: _off(xs, truth).mean(axis=1) for way, xs in runs.items()}
        for way in mean:
            other = L1 if way == POSTERIOR else POSTERIOR
            if way != L1 and other in mean:
                numbers[f"gain_hamiltonian_error_{way}_{name}"] = Spread.of(mean[other] / mean[way])
        if drawn is not None:
            numbers |= {f"{key}_{name}": one for key, one in calibrate(drawn, runs[POSTERIOR], truth).items()}
    return numbers


def show(regimes: dict[str, Regime], numbers: dict[str, Any]) -> None:
    """Print the table, what is beyond the dissertation, and whether the spread can be trusted."""
    keys = ("mean_hamiltonian_error", "maximum_hamiltonian_error", "time_to_half_radian")
    rows = [
        (name, way, *(str(numbers[f"{key}_{way}_{name}"]) for key in keys))
        for name, regime in regimes.items()
        for way in regime.runs
    ]
    print_table(("motion", "way", "mean |H error|", "largest |H error|", "s to 0.5 rad"), *rows)
    print("medians and [10 %, 90 %] of the repeats; a model that stands still has no Hamiltonian error, so read it")
    print(f"beside the time to half a radian; {PUBLISHED}\n")
    for name in regimes:
        for way, words in (
            (POSTERIOR, "posterior against L1"),
            (PIECES, "beyond, the recording filtered in pieces"),
            (COARSE, "beyond, a learning step 5 times larger (every fifth reading, a fifth of the work)"),
        ):
            gain = numbers.get(f"gain_hamiltonian_error_{way}_{name}")
            if gain is not None:
                print(f"{name}: {words}: mean Hamiltonian error lower {gain} times; {gain.verdict}")
    for name, regime in regimes.items():
        if regime.drawn is not None:
            print(_trust({key: numbers[f"{key}_{name}"].median for key in _TRUST}, name))


_TRUST = (
    "coverage_90",
    "coverage_90_ideal",
    "error_over_spread",
    "rank_correlation",
    "one_step_error_over_process_noise",
    "one_step_error_correlation",
    "process_noise_sd",
)


def _trust(of: dict[str, float], name: str) -> str:
    """What the calibration says, of medians over the repeats."""
    ratio = of["one_step_error_over_process_noise"]
    size = "too small" if ratio > 1.5 else "too large" if ratio < 2 / 3 else "of the right size"
    return (
        f"{name}: the middle 90 % of stochastic simulations hold {100 * of['coverage_90']:.0f} % of the true angles, "
        f"and the error is {of['error_over_spread']:.2g} standard deviations (0.67 if calibrated); spread and error "
        f"rise together with rank correlation {of['rank_correlation']:.2f}. The learnt process noise (sd "
        f"{of['process_noise_sd']:.2g}; the published prior's scale is 0.001) is {size}: one-step errors are "
        f"{ratio:.2g} times it. With their own variance 90 % would hold {100 * of['coverage_90_ideal']:.0f} %: "
        "neighbouring errors correlate by "
        f"{of['one_step_error_correlation']:.2f}, where process noise is white."
    )


def draw(regimes: dict[str, Regime]) -> Figure:
    """Figures 5.12 and 5.13 (angles in time, with the draws) and 5.14b (the absolute Hamiltonian error)."""
    figure = Figure(figsize=(15.0, 3.6 * len(regimes)), layout="constrained")
    panels = figure.subplots(len(regimes), 3, squeeze=False)
    for row, (name, regime) in zip(panels, regimes.items(), strict=True):
        truth, times, one = regime.truth, STEP * np.arange(len(regime.truth)), regime.middle
        for i in (0, 1):
            if regime.drawn is not None:
                draws = regime.drawn.learnt[one, :30, :, i].T
                row[i].plot(times[: len(draws)], draws, color="tab:blue", alpha=0.08, linewidth=0.6)
            row[i].plot(times, truth[:, i], color="0.3", linewidth=2.0)
            for way, xs in regime.runs.items():
                row[i].plot(times, xs[one, :, i], color=COLOURS[way], linewidth=1.0)
            row[i].axvline(times[len(times) // 2], color="0.8", linewidth=1.0)
            limit = 1.5 * np.abs(truth[:, i]).max()
            row[i].set(title=f"{name}: q{i + 1} in rad, truth grey; data end at the line", xlabel="time in s")
            row[i].set_ylim(-limit, limit)
        for way, xs in regime.runs.items():
            row[2].semilogy(times, _off(xs[one], truth).clip(1e-3), color=COLOURS[way], linewidth=1.0, label=way)
        row[2].set(title=f"{name}: absolute Hamiltonian error", xlabel="time in s")
        row[2].legend(fontsize=8)
    return figure


def phase(regimes: dict[str, Regime], ways: Sequence[str] = (POSTERIOR, L1)) -> Figure:
    """Figure 5.14a: the orbits of both objectives, coloured by the absolute Hamiltonian error."""
    figure = Figure(figsize=(9.0, 3.6 * len(regimes)), layout="constrained")
    panels = figure.subplots(len(regimes), len(ways), squeeze=False, sharex="row", sharey="row")
    for row, (name, regime) in zip(panels, regimes.items(), strict=True):
        shown = [way for way in ways if way in regime.runs]
        paths = {way: regime.runs[way][regime.middle] for way in shown}
        colour = {way: np.log10(_off(xs, regime.truth).clip(1e-3)) for way, xs in paths.items()}
        limits = min(c.min() for c in colour.values()), max(c.max() for c in colour.values())
        for axes, way in zip(row, shown, strict=False):
            q, p = paths[way][:, 0], paths[way][:, 2]
            image = axes.scatter(q, p, c=colour[way], s=2.0, vmin=limits[0], vmax=limits[1], cmap="viridis")
            axes.plot(regime.truth[:, 0], regime.truth[:, 2], color="0.6", linewidth=0.4, zorder=0)
            wide = 2.0 * np.abs(regime.truth).max(axis=0)  # what leaves this has failed
            axes.set(xlim=(-wide[0], wide[0]), ylim=(-wide[2], wide[2]))
            axes.set(title=f"{name}: {way}", xlabel="q1 in rad", ylabel="p1")
        figure.colorbar(image, ax=row, label="log10 |H error|")
    return figure
