"""Identification: numbers of scenes and laws from measured records."""

from ._axis import AXIS_MODELS as AXIS_MODELS
from ._axis import AxisModel as AxisModel
from ._axis import axis_scene as axis_scene
from ._axis import rough_axis as rough_axis
from ._begin import Continuation as Continuation
from ._begin import MultiStart as MultiStart
from ._compare import Candidate as Candidate
from ._compare import compare as compare
from ._compare import compare_laws as compare_laws
from ._comparison import Comparison as Comparison
from ._coverage import Coverage as Coverage
from ._coverage import coverage as coverage
from ._fit import fit as fit
from ._fit_law import fit_law as fit_law
from ._fit_law import law_force as law_force
from ._losses import Cauchy as Cauchy
from ._losses import Huber as Huber
from ._losses import Squares as Squares
from ._observe import first_coordinate as first_coordinate
from ._prepare import Shooting as Shooting
from ._record import Record as Record
from ._replay import Controller as Controller
from ._replay import replay as replay
from ._result import FitResult as FitResult
from ._staged import Staged as Staged
from ._starts import start_state as start_state
