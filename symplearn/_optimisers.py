"""How gradients become steps of a stochastic training, and how each leaf gets a rate of its own."""

import abc
from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax
import optax
from jaxtyping import PyTree

from ._errors import InputError


class AbstractOptimiser(eqx.Module):
    """How gradients become steps."""

    @abc.abstractmethod
    def transformation(self, steps: int) -> optax.GradientTransformation:
        """The rule in optax's terms, for so many steps an epoch."""


class Adam(AbstractOptimiser):
    """Adam (Kingma and Ba 2015) whose rate is multiplied by `factor` every `decay_every` epochs.

    **Arguments:** `learning_rate`, in free coordinates; `decay_every` - epochs, or None for a constant rate; `factor`;
    `betas` - of the two averages; `clip` - the largest norm of a gradient, in nats, or None: a longer one is shortened.
    """

    learning_rate: float = eqx.field(static=True, default=0.05)
    decay_every: int | None = eqx.field(static=True, default=None)
    factor: float = eqx.field(static=True, default=0.8)
    betas: tuple[float, float] = eqx.field(static=True, default=(0.9, 0.999))
    clip: float | None = eqx.field(static=True, default=None)

    def __check_init__(self):
        if not (self.learning_rate > 0 and self.factor > 0) or not all(0 <= beta < 1 for beta in self.betas):
            raise InputError(
                f"`Adam` needs a positive learning rate and factor and betas in [0, 1), but was given "
                f"{self.learning_rate}, {self.factor} and {self.betas}."
            )

    def transformation(self, steps: int) -> optax.GradientTransformation:
        rate: Any = self.learning_rate
        if self.decay_every is not None:
            rate = optax.exponential_decay(rate, self.decay_every * steps, self.factor, staircase=True)
        adam = optax.adam(rate, *self.betas)
        return adam if self.clip is None else optax.chain(optax.clip_by_global_norm(self.clip), adam)


class ByLeaf(AbstractOptimiser):
    """An optimiser for each leaf, by the leaf's name or the beginning of it, as in `Prior`; "" is for all others.

    `ByLeaf({"": Adam(0.05), "process_noise": Adam(0.5, betas=(0.1, 0.1))})`. The rate of a `Positive` leaf is relative:
    0.5 there is the dissertation's rate of 0.5 theta_q for theta_q itself, and no step can make it negative.

    **Raises:** `InputError`, at the start of training, where a leaf has no optimiser.
    """

    optimisers: dict[str, AbstractOptimiser]

    def __init__(self, optimisers: Mapping[str, AbstractOptimiser]):
        self.optimisers = dict(optimisers)

    def transformation(self, steps: int) -> optax.GradientTransformation:
        return optax.partition({name: one.transformation(steps) for name, one in self.optimisers.items()}, self._labels)

    def _labels(self, learnt: PyTree) -> PyTree:
        return jax.tree_util.tree_map_with_path(lambda path, _: self._label(path), learnt)

    def _label(self, path: Any) -> str:
        name = jax.tree_util.keystr(path, simple=True, separator=".")
        fitting = [start for start in self.optimisers if start in ("", name) or name.startswith(start + ".")]
        if not fitting:
            raise InputError(
                f"`{name}` learns but has no optimiser; give `ByLeaf` one for it, or for all others as ''."
            )
        return max(fitting, key=len)
