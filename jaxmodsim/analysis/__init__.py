"""Checks of what a scene gives."""

from ._check_gradients import GradientCheck as GradientCheck
from ._check_gradients import check_gradients as check_gradients
from ._cyclic import cyclic_coordinates as cyclic_coordinates
from ._energy_audit import EnergyAudit as EnergyAudit
from ._energy_audit import energy_audit as energy_audit
from ._methods import Method as Method
from ._methods import formulations as formulations
from ._sensitivity import Sensitivity as Sensitivity
from ._sensitivity import sensitivity as sensitivity
from ._work_precision import work_precision as work_precision
from ._work_rows import Row as Row
from ._work_rows import WorkPrecision as WorkPrecision
from ._work_rows import load_work_precision as load_work_precision
