"""Friction laws: functions of slip velocity and of their own state, independent of the mechanism."""

from .._core.parameters import parameter as parameter  # for user-defined laws

# Modules register their laws when they are imported: this is the order in which the laws are listed.
# isort: off
from ._static import Viscous as Viscous
from ._static import Curve as Curve
from ._static import Coulomb as Coulomb
from ._static import Stribeck as Stribeck
from ._static import lorentzian as lorentzian
from ._wrappers import Regularized as Regularized
from ._wrappers import DeadZone as DeadZone
from ._wrappers import Sign as Sign
from ._bristles import Bristle as Bristle
from ._bristles import Dahl as Dahl
from ._bristles import LuGre as LuGre
from ._bristles import ElastoPlastic as ElastoPlastic
from ._maxwell_slip import MaxwellSlip as MaxwellSlip
from ._armstrong import Armstrong as Armstrong
from ._armstrong import ArmstrongState as ArmstrongState
from ._gears import Geared as Geared
from ._gears import ServoGear as ServoGear

# isort: on
from ._law import STANDARD as STANDARD
from ._law import AbstractDynamicLaw as AbstractDynamicLaw
from ._law import AbstractForceLaw as AbstractForceLaw
from ._law import AbstractKarnoppLaw as AbstractKarnoppLaw
from ._law import AbstractLaw as AbstractLaw
from ._law import AbstractPlanarLaw as AbstractPlanarLaw
from ._law import AbstractSetValuedLaw as AbstractSetValuedLaw
from ._law import LawCase as LawCase
from ._law import Passivity as Passivity
from ._law import laws as laws
from ._law import register_law as register_law
from ._modifiers import AbstractAsymmetric as AbstractAsymmetric
from ._modifiers import asymmetric as asymmetric
from ._modifiers import scaled_by as scaled_by
from ._passivity import check_passivity as check_passivity
from ._tuning import damping_sigma1 as damping_sigma1
from ._tuning import max_stable_step as max_stable_step
from ._tuning import regularized_width as regularized_width
