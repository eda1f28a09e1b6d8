"""Friction laws, one in each file; they know slip velocity and their own state, nothing of mechanisms."""

from ._asymmetric import asymmetric as asymmetric
from ._coulomb import Coulomb as Coulomb
from ._dead_zone import DeadZone as DeadZone
from ._law import AbstractDynamicLaw as AbstractDynamicLaw
from ._law import AbstractForceLaw as AbstractForceLaw
from ._law import AbstractHoldingLaw as AbstractHoldingLaw
from ._law import AbstractLaw as AbstractLaw
from ._law import AbstractSetValuedLaw as AbstractSetValuedLaw
from ._lugre import LuGre as LuGre
from ._regularized import Regularized as Regularized
from ._sign import Sign as Sign
from ._stribeck import Stribeck as Stribeck
from ._viscous import Viscous as Viscous
