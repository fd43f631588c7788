"""The figure of `markov_parameters`: the dissertation's 3.1, on a logarithmic axis."""

from typing import Any

import numpy as np
from matplotlib.figure import Figure

from ._markov_parameters_results import METHODS, name_of

COLOURS = dict(zip(METHODS, ("tab:red", "tab:orange", "tab:blue", "tab:purple", "grey"), strict=True))
NAMES = dict(zip(METHODS, ("LS", "GLS", "MAP", "autoregression", "floor: A = I is known"), strict=True))


def errors_against_equations(found: dict[str, Any], size: str) -> Figure:
    """Figure 3.1: medians and quartiles of the error against K, a panel for each noise."""
    noises, counts = found["noises"], found[f"K_{size}"]
    figure = Figure(figsize=(12, 4.2), layout="constrained")
    panels = figure.subplots(1, len(noises), sharey=True, squeeze=False)[0]
    for panel, noise in zip(panels, noises, strict=True):
        for method in METHODS:
            known = [count for count in counts if name_of(size, noise, count, method) in found]
            if not known:
                continue
            every = [found[name_of(size, noise, count, method)] for count in known]
            low, middle, high = (np.array([one[key] for one in every]) for key in _QUARTILES)
            panel.plot(known, middle, "o-", ms=3, color=COLOURS[method], label=NAMES[method])
            panel.fill_between(known, low, high, color=COLOURS[method], alpha=0.2)
        panel.set(yscale="log", title=f"{size} systems, noise {noise:g}", xlabel="equations K")
    panels[0].set_ylabel("spectral norm of the error")
    panels[-1].legend(fontsize="small")
    return figure


_QUARTILES = ("lower_quartile", "median", "upper_quartile")
