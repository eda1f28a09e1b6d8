"""Friction laws, one in each file; they know slip velocity and their own state, nothing of mechanisms."""

from .._core.parameters import parameter as parameter  # for laws of one's own

# The order in which the laws are listed everywhere: each file registers its law.
# isort: off
from ._viscous import Viscous as Viscous
from ._curve import Curve as Curve
from ._coulomb import Coulomb as Coulomb
from ._stribeck import Stribeck as Stribeck
from ._stribeck import lorentzian as lorentzian
from .wrappers._regularized import Regularized as Regularized
from .wrappers._dead_zone import DeadZone as DeadZone
from .wrappers._sign import Sign as Sign
from .wrappers._bristle import Bristle as Bristle
from .modifiers._geared import Geared as Geared
from ._dahl import Dahl as Dahl
from ._lugre import LuGre as LuGre
from ._elasto_plastic import ElastoPlastic as ElastoPlastic
from ._maxwell_slip import MaxwellSlip as MaxwellSlip
from ._armstrong import Armstrong as Armstrong
from ._armstrong import ArmstrongState as ArmstrongState
from ._servo_gear import ServoGear as ServoGear

# isort: on
from ._check_passivity import check_passivity as check_passivity
from ._law import AbstractDynamicLaw as AbstractDynamicLaw
from ._law import AbstractForceLaw as AbstractForceLaw
from ._law import AbstractKarnoppLaw as AbstractKarnoppLaw
from ._law import AbstractLaw as AbstractLaw
from ._law import AbstractPlanarLaw as AbstractPlanarLaw
from ._law import AbstractSetValuedLaw as AbstractSetValuedLaw
from ._law import laws as laws
from ._law import register_law as register_law
from ._law_case import STANDARD as STANDARD
from ._law_case import LawCase as LawCase
from ._max_stable_step import max_stable_step as max_stable_step
from ._tuning import damping_sigma1 as damping_sigma1
from ._tuning import regularized_width as regularized_width
from .modifiers._asymmetric import AbstractAsymmetric as AbstractAsymmetric
from .modifiers._asymmetric import asymmetric as asymmetric
from .modifiers._scaled import scaled_by as scaled_by
