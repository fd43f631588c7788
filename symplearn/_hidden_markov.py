"""The general hidden Markov model, whose noises may enter anywhere. Dissertation (2.1)."""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import jax.scipy.linalg
from jaxtyping import Array

from ._distributions import AbstractDistribution
from ._model import AbstractStateSpaceModel
from ._transforms import AbstractTransform, Moments


class HiddenMarkovModel(AbstractStateSpaceModel):
    """x_{k+1} = transition(x_k, w_k, interval_k),  y_k = observation(x_k, v_k, context_k),  x_0 ~ initial. (2.1)

    A Gaussian filter takes the state and the noise as one Gaussian of the same first two moments and passes it through
    the function by its transform, so that filter, smoother and objectives serve it as they serve a `StateSpaceModel`.
    The noise counts among the transform's dimensions: where it is only added or multiplied, a `StateSpaceModel` takes
    fewer points, and its noise is exact.

    **Arguments:**
    - `transition`: a module `(x, w, interval) -> x'`, with w one draw of `process_noise` per data interval.
    - `observation`: a module `(x, v, context) -> y`, with v one draw of `measurement_noise` per reading.
    - `process_noise`, `measurement_noise`: distributions such as `Uniform` or `MultivariateNormal`, of any sizes; or
      anything with `mean` (dim,) and `structure`, a covariance, and `sample(key)` to simulate.
    - `initial`: a `Gaussian` for the state at the first reading, or one for each of several recordings, in a tuple.
    - `log_density_of_reading`: a module `(y, x, context) -> nats`, the log density of a reading given the state, where
      it is known; a particle filter needs it. Missing channels of y are NaN, and their density is left out.
    """

    transition: Callable[[Any, Any, Any], Any]
    observation: Callable[[Any, Any, Any], Any]
    process_noise: AbstractDistribution | Any
    measurement_noise: AbstractDistribution | Any
    initial: Any = None
    log_density_of_reading: Callable[[Any, Any, Any], Any] | None = None

    @property
    def reads_exactly(self) -> bool:
        return False

    def predict(self, transform, mean, root, interval) -> Moments:
        return _pass(transform, lambda x, w: self.transition(x, w, interval), mean, root, self.process_noise)

    def read(self, transform, mean, root, context) -> Moments:
        return _pass(transform, lambda x, v: self.observation(x, v, context), mean, root, self.measurement_noise)


def _pass(
    transform: AbstractTransform, function: Callable[[Any, Any], Any], mean: Array, root: Array, noise: Any
) -> Moments:
    """Moments of function(x, noise): those of the joint Gaussian, of whose source the rows of x are kept."""
    size = mean.shape[0]
    joint_mean = jnp.concatenate([mean, noise.mean])
    joint_root = jax.scipy.linalg.block_diag(root, noise.structure.root)
    moments = transform(lambda joint: function(joint[:size], joint[size:]), joint_mean, joint_root)
    return moments._replace(source=moments.source[:size])
