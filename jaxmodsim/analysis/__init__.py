"""Studies of a scene: gradients, sensitivities, energy, conserved momenta, cost against error."""

from ._check_gradients import GradientCheck as GradientCheck
from ._check_gradients import check_gradients as check_gradients
from ._conservation import EnergyAudit as EnergyAudit
from ._conservation import cyclic_coordinates as cyclic_coordinates
from ._conservation import energy_audit as energy_audit
from ._sensitivity import Sensitivity as Sensitivity
from ._sensitivity import sensitivity as sensitivity
from ._work_precision import Method as Method
from ._work_precision import formulations as formulations
from ._work_precision import work_precision as work_precision
from ._work_rows import Row as Row
from ._work_rows import WorkPrecision as WorkPrecision
from ._work_rows import load_work_precision as load_work_precision
