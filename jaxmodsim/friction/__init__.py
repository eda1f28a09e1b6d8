"""Friction laws, one in each file; they know slip velocity and their own state, nothing of mechanisms."""

from .._core.parameters import parameter as parameter  # for laws of one's own
from ._armstrong import Armstrong as Armstrong
from ._armstrong import ArmstrongState as ArmstrongState
from ._coulomb import Coulomb as Coulomb
from ._curve import Curve as Curve
from ._dahl import Dahl as Dahl
from ._elasto_plastic import ElastoPlastic as ElastoPlastic
from ._law import AbstractDynamicLaw as AbstractDynamicLaw
from ._law import AbstractForceLaw as AbstractForceLaw
from ._law import AbstractKarnoppLaw as AbstractKarnoppLaw
from ._law import AbstractLaw as AbstractLaw
from ._law import AbstractPlanarLaw as AbstractPlanarLaw
from ._law import AbstractSetValuedLaw as AbstractSetValuedLaw
from ._lugre import LuGre as LuGre
from ._max_stable_step import max_stable_step as max_stable_step
from ._maxwell_slip import MaxwellSlip as MaxwellSlip
from ._passivity import Passivity as Passivity
from ._passivity import check_passivity as check_passivity
from ._stribeck import Stribeck as Stribeck
from ._stribeck import exponential as exponential
from ._stribeck import lorentzian as lorentzian
from ._tuning import Width as Width
from ._tuning import damping_sigma1 as damping_sigma1
from ._tuning import regularized_width as regularized_width
from ._viscous import Viscous as Viscous
from .modifiers._asymmetric import AbstractAsymmetric as AbstractAsymmetric
from .modifiers._asymmetric import asymmetric as asymmetric
from .modifiers._scaled import scaled_by as scaled_by
from .wrappers._dead_zone import DeadZone as DeadZone
from .wrappers._regularized import Regularized as Regularized
from .wrappers._sign import Sign as Sign
