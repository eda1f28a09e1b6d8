"""Identification: numbers of scenes and laws from measured records."""

from ._axis import AXIS_MODELS as AXIS_MODELS
from ._axis import AxisModel as AxisModel
from ._axis import axis_scene as axis_scene
from ._axis import rough_axis as rough_axis
from ._design import design_input as design_input
from ._fit import first_coordinate as first_coordinate
from ._fit import fit as fit
from ._fit_law import fit_law as fit_law
from ._fit_law import law_force as law_force
from ._fit_result import FitResult as FitResult
from ._goals import a_optimal as a_optimal
from ._goals import d_optimal as d_optimal
from ._goals import e_optimal as e_optimal
from ._input_design import Excitation as Excitation
from ._input_design import InputDesign as InputDesign
from ._input_design import Limits as Limits
from ._record import Record as Record
from ._replay import replay as replay
