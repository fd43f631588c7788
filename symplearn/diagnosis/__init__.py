"""Locate, name, model, show: what a simulation left out."""

from ._build import Restriction as Restriction
from ._build import restriction_of as restriction_of
from ._diagnose import diagnose as diagnose
from ._options import Options as Options
from ._record import Diagnosis as Diagnosis
from ._record import Forecast as Forecast
from ._record import Series as Series
