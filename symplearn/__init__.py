"""Identify Hamiltonian systems from few, noisy, indirect recordings, and say what physics a simulation left out.

In reading order: recordings and simulation files, models, objectives, fits, forecasts, diagnosis. What writes the
report is in `symplearn.report`, which alone needs matplotlib.
"""

from ._errors import InputError as InputError
from ._evidence import LaplaceApproximation as LaplaceApproximation
from ._evidence import laplace_evidence as laplace_evidence
from ._expression import parse_expression as parse_expression
from ._filter import Filtered as Filtered
from ._filter import UnscentedTransform as UnscentedTransform
from ._filter import log_likelihood as log_likelihood
from ._filter import unscented_filter as unscented_filter
from ._fit import Estimate as Estimate
from ._fit import fit as fit
from ._forecast import forecast as forecast
from ._hamiltonians import Legendre as Legendre
from ._hamiltonians import Monomials as Monomials
from ._hamiltonians import Polynomial as Polynomial
from ._hamiltonians import PolynomialPotential as PolynomialPotential
from ._inputs import Inputs as Inputs
from ._model import Coordinates as Coordinates
from ._model import FullState as FullState
from ._model import Gaussian as Gaussian
from ._model import Interval as Interval
from ._model import LinearObservation as LinearObservation
from ._model import Propagator as Propagator
from ._model import StateSpaceModel as StateSpaceModel
from ._model import intervals_between as intervals_between
from ._noise import AdditiveGaussian as AdditiveGaussian
from ._noise import Dense as Dense
from ._noise import Diagonal as Diagonal
from ._noise import ScaledIdentity as ScaledIdentity
from ._noise import WienerIncrement as WienerIncrement
from ._objectives import MarginalLikelihood as MarginalLikelihood
from ._objectives import TimeSeries as TimeSeries
from ._parameters import Bounded as Bounded
from ._parameters import Frozen as Frozen
from ._parameters import Learnt as Learnt
from ._parameters import Positive as Positive
from ._parameters import resolve as resolve
from ._prior import Flat as Flat
from ._prior import HalfNormal as HalfNormal
from ._prior import Laplace as Laplace
from ._prior import Normal as Normal
from ._prior import Prior as Prior
from ._recording import Recording as Recording
from ._recording import read_recordings as read_recordings
from ._simulation_file import parse_simulation as parse_simulation
from ._simulation_file import read_simulation as read_simulation
from ._simulation_records import SimulationFile as SimulationFile
from ._simulation_text import simulation_text as simulation_text
from ._smoother import Smoothed as Smoothed
from ._smoother import smooth as smooth
from ._symbolic import jax_function as jax_function
from .diagnosis import Diagnosis as Diagnosis
from .diagnosis import Options as Options
from .diagnosis import diagnose as diagnose
from .diagnosis import restriction_of as restriction_of
