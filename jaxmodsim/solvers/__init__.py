"""Plug-ins for diffrax."""

from ._controllers import FiniteSteps as FiniteSteps
from ._rodas5p import Rodas5P as Rodas5P
