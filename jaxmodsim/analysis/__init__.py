"""Checks of what a scene gives."""

from ._check_gradients import GradientCheck as GradientCheck
from ._check_gradients import NumberCheck as NumberCheck
from ._check_gradients import check_gradients as check_gradients
from ._cyclic import cyclic_coordinates as cyclic_coordinates
from ._energy_audit import EnergyAudit as EnergyAudit
from ._energy_audit import energy_audit as energy_audit
from ._sensitivity import Sensitivity as Sensitivity
from ._sensitivity import sensitivity as sensitivity
