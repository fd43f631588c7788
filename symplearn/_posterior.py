"""The posterior of what a model learns, as draws that say whether they can be trusted. Dissertation sec. 2.3."""

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ._arviz import arviz, inference_data
from ._convergence import Diagnostics, diagnose_draws, labels
from ._errors import InputError, shown
from ._fit import Estimate
from ._log_posterior import negative_log_posterior
from ._model import AbstractStateSpaceModel
from ._objectives import AbstractObjective, TimeSeries
from ._parameters import flatten, named_parameters, resolve, value_of
from ._prior import Prior
from ._sampler import Drawn

# What of a `Drawn` is one number, kept as an attribute of the file.
_NUMBERS = (
    *("evaluations", "gradients", "accepted", "pareto_k", "largest_weight"),
    *("log_evidence", "log_evidence_sd", "elbo"),
)
_TABLE = ("mean", "sd", "5 %", "50 %", "95 %", "ESS", "R-hat")


class LogPosterior(eqx.Module):
    """The log posterior density of the free coordinates of a model, in nats, without its evidence."""

    model: AbstractStateSpaceModel
    series: TimeSeries | tuple[TimeSeries, ...]
    objective: AbstractObjective
    prior: Prior

    def __call__(self, free: Float[Array, " parameter"]) -> Float[Array, ""]:
        rebuild = flatten(self.model)[1]
        return -negative_log_posterior(rebuild(free), self.series, self.objective, self.prior)


def log_posterior_of(estimate: Estimate) -> LogPosterior:
    """The log posterior that an estimate is the mode of."""
    return LogPosterior(estimate.model, estimate.recording, estimate.objective, estimate.prior)


@dataclass(frozen=True)
class Posterior:
    """Draws of a posterior, of equal weight, with what says whether they stand for it.

    `values` holds the draws by name in natural units, (chain, draw, ...): a variance, not its logarithm. `free` are
    the free coordinates (chain, draw, parameter), `log_posterior` (chain, draw) is in nats and not normalised.
    `diagnostics.converged` says whether to trust them, `str(posterior)` what to do if not. `log_evidence` is given by
    samplers that know it, with the standard error `log_evidence_sd`. `estimate` is what was sampled around; None for a
    density of the user's own, whose one value is called `x`, and for draws that were loaded alone. `sampler` tells
    which one drew.
    """

    estimate: Estimate | None
    values: dict[str, Array]
    drawn: Drawn
    diagnostics: Diagnostics
    sampler: str

    @property
    def free(self) -> Float[Array, "chain draw parameter"]:
        """The draws in free coordinates."""
        return self.drawn.free

    @property
    def log_posterior(self) -> Float[Array, "chain draw"]:
        """Log density of the free coordinates at each draw, in nats, not normalised."""
        return self.drawn.log_density

    @property
    def log_evidence(self) -> float | None:
        """log p(readings) in nats, or None where the sampler gives none."""
        return self.drawn.log_evidence

    @property
    def log_evidence_sd(self) -> float | None:
        """Monte Carlo standard error of `log_evidence`."""
        return self.drawn.log_evidence_sd

    @property
    def stopped(self) -> bool:
        """Whether Ctrl-C ended the sampling before all was drawn; `diagnostics` are of the draws there are."""
        return self.drawn.stopped

    @property
    def converged(self) -> bool:
        """Whether nothing speaks against the draws."""
        return self.diagnostics.converged

    def mean(self) -> dict[str, Array]:
        """Posterior means of the values, by name."""
        return self._each(lambda draws: jnp.mean(draws, axis=0))

    def sd(self) -> dict[str, Array]:
        """Posterior standard deviations of the values, by name."""
        return self._each(lambda draws: jnp.std(draws, axis=0))

    def quantiles(self, probabilities: float | Sequence[float]) -> dict[str, Array]:
        """Posterior quantiles of the values, by name; several probabilities make a leading axis."""
        return self._each(lambda draws: jnp.quantile(draws, jnp.asarray(probabilities), axis=0))

    def median(self) -> dict[str, Array]:
        """Posterior medians: what to report of a variance, whose mode may run to zero."""
        return self.quantiles(0.5)

    def models(self, count: int | None = None) -> Any:
        """The draws as models in plain arrays, stacked: every array has the leading axis (draw,).

        `count` evenly spaced ones, or all, chain by chain. `equinox.filter_vmap(function)(posterior.models(100))`
        applies a function of one model.

        **Raises:** `InputError` for a density of the user's own, or where `count` is not from 1 to the number of draws.
        """
        if self.estimate is None:
            raise InputError(
                "This posterior has no model: it is of a density of your own, or was loaded without its estimate; its "
                "draws are in `values`, and `load_posterior(path, estimate)` makes models of them."
            )
        return models_at(self.estimate.model, self.draws(count))

    def draws(self, count: int | None = None) -> Float[Array, "draw parameter"]:
        """Free coordinates of `count` evenly spaced draws, or of all, chain by chain.

        **Raises:** `InputError` where `count` is not from 1 to the number of draws.
        """
        return evenly(self.free.reshape(-1, self.free.shape[-1]), count)

    def _each(self, summary: Callable[[Array], Array]) -> dict[str, Array]:
        return {name: summary(jnp.reshape(v, (-1, *v.shape[2:]))) for name, v in self.values.items()}

    def __str__(self) -> str:
        chains, draws = self.free.shape[:2]
        head = f"Posterior: {chains} chains of {draws} draws by {self.sampler}"
        lines = [head, *_table(self), str(self.diagnostics), *self.drawn.remarks]
        if self.log_evidence is not None:
            lines.append(f"log evidence {self.log_evidence:.3f} +- {self.log_evidence_sd:.3f} nats")
        return "\n".join(lines)

    def to_arviz(self) -> Any:
        """The draws as an `arviz.InferenceData`: groups `posterior` and `sample_stats`."""
        drawn = self.drawn
        stats = {"lp": drawn.log_density, "free": drawn.free, "diverging": drawn.divergent, "energy": drawn.energy}
        kept = {name: np.asarray(array) for name, array in stats.items() if array is not None}
        numbers = {name: getattr(drawn, name) for name in _NUMBERS if getattr(drawn, name) is not None}
        words = {"sampler": self.sampler, "remarks": "\n".join(drawn.remarks), "stopped": int(drawn.stopped)}
        return inference_data({name: np.asarray(v) for name, v in self.values.items()}, kept, words | numbers)

    def save(self, path: str | Path) -> None:
        """Write the draws to a NetCDF file, which `load_posterior` and `arviz.from_netcdf` read. Needs h5netcdf."""
        path = Path(path)
        if not path.parent.is_dir():
            raise InputError(f"{shown(path, 200)}: there is no folder {shown(path.parent, 200)}; make it first")
        unfinished = path.with_name(f".{path.name}.{os.getpid()}")
        try:
            self.to_arviz().to_netcdf(str(unfinished))
            os.replace(unfinished, path)  # whole or not at all
        finally:
            unfinished.unlink(missing_ok=True)


def posterior_of(estimate: Estimate | None, drawn: Drawn, sampler: str) -> Posterior:
    """The posterior that draws of free coordinates are."""
    values = {"x": drawn.free} if estimate is None else _values(estimate.model, drawn.free)
    return Posterior(estimate, values, drawn, diagnose_draws(values, drawn), sampler)


def load_posterior(path: str | Path, estimate: Estimate | None = None) -> Posterior:
    """Read a posterior that `Posterior.save` wrote.

    **Arguments:** `estimate` - of the same model, recording and prior, from which the draws become models again, for
    `models` and `posterior_forecast`. Without it, and for a density of the user's own, the draws are in `values` alone,
    by name as they were written.

    **Raises:** `InputError` where the file cannot be read, was not written by `save`, or is of another posterior.
    """
    try:
        data = arviz().from_netcdf(str(path))
        stats, attributes = data.sample_stats, data.posterior.attrs
        arrays = {name: jnp.asarray(stats[name].values) for name in stats.data_vars}
        values = {str(name): jnp.asarray(data.posterior[name].values) for name in data.posterior.data_vars}
        sampler = str(attributes["sampler"])
        numbers = {name: attributes[name].item() for name in _NUMBERS if name in attributes}
        remarks = tuple(str(attributes["remarks"]).splitlines())
        drawn = Drawn(
            arrays["free"],
            arrays["lp"],
            divergent=arrays.get("diverging"),
            energy=arrays.get("energy"),
            stopped=bool(attributes["stopped"]),
            remarks=remarks,
            **numbers,
        )
    except (OSError, KeyError, AttributeError, ValueError, TypeError) as error:
        raise InputError(f"`{path}` is not a posterior that can be read: {error}.") from error
    if estimate is None:
        return Posterior(None, values, drawn, diagnose_draws(values, drawn), sampler)
    _refuse_other(path, estimate, list(values), drawn)
    return posterior_of(estimate, drawn, sampler)


def _refuse_other(path: Any, estimate: Estimate, names: list[str], drawn: Drawn) -> None:
    """Refuse draws that are not of the estimate's posterior."""
    known = list(named_parameters(estimate.model))
    if sorted(names) != sorted(known):
        raise InputError(
            f"`{path}` holds draws of {', '.join(names)}, but what learns is: {', '.join(known)}; give the estimate "
            "that they were drawn around, or none for the draws alone."
        )
    size, given = flatten(estimate.model)[0].size, drawn.free.shape[-1]
    if size != given:
        raise InputError(f"`{path}` holds draws of {given} numbers, but the model learns {size}.")
    found, written = float(_log_posterior(log_posterior_of(estimate), drawn.free[0, 0])), float(drawn.log_density[0, 0])
    # A batch of filters rounds differently from one.
    if not abs(found - written) <= 1e-6 * (1 + abs(written)):
        raise InputError(
            f"`{path}` is of another recording, model or prior: its first draw has a log posterior of {written:.6g} "
            f"nats there and {found:.6g} here."
        )


@eqx.filter_jit
def _log_posterior(density, free):
    return density(free)


def _values(model, free):
    """What the model learns at free coordinates (chain, draw, parameter), by name, in the model's order."""
    found = _sorted_values(model, free)
    return {name: found[name] for name in named_parameters(model)}


@eqx.filter_jit
def _sorted_values(model, free):
    """The same in the alphabet's order, in which a compiled function gives a dictionary back."""
    rebuild = flatten(model)[1]

    def values(free):
        return {name: value_of(leaf) for name, leaf in named_parameters(rebuild(free)).items()}

    return jax.vmap(jax.vmap(values))(free)


def evenly(draws: Float[Array, "draw parameter"], count: int | None) -> Float[Array, "some parameter"]:
    """`count` evenly spaced draws, or all.

    **Raises:** `InputError` where `count` is not from 1 to the number of draws.
    """
    count = len(draws) if count is None else count
    if not 1 <= count <= len(draws):
        raise InputError(f"There are {len(draws)} draws, but {count} were asked for; take from 1 to {len(draws)}.")
    return draws[np.arange(count) * len(draws) // count]


@eqx.filter_jit
def models_at(model, draws):
    """The model at free coordinates (draw, parameter), in plain arrays, stacked."""
    rebuild = flatten(model)[1]
    return eqx.filter_vmap(lambda free: resolve(rebuild(free)))(draws)


def _table(posterior: Posterior) -> list[str]:
    """One line for each number: mean, sd, quantiles, the smaller effective sample size, R-hat."""

    def column(by_name):
        return np.concatenate([np.ravel(value) for value in by_name.values()])

    facts = posterior.diagnostics
    quantiles = [column(posterior.quantiles(p)) for p in (0.05, 0.5, 0.95)]
    ess = np.minimum(column(facts.ess_bulk), column(facts.ess_tail))
    numbers = [column(posterior.mean()), column(posterior.sd()), *quantiles]
    names = labels(posterior.values, leading=2)
    width = max(len(name) for name in names)
    lines = [" " * width + "".join(f"{title:>12}" for title in _TABLE)]
    for k, name in enumerate(names):
        cells = "".join(f"{number[k]:12.4g}" for number in numbers)
        lines.append(f"{name:<{width}}{cells}{ess[k]:12.0f}{column(facts.r_hat)[k]:12.3f}")
    return lines
