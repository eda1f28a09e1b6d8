"""Control of mechanisms with friction: compensation of friction, and estimation of its state and of its level."""

from ._compensation import check_observer as check_observer
from ._compensation import compensate_friction as compensate_friction
from ._filter import FilterRun as FilterRun
from ._filter import FrictionFilter as FrictionFilter
from ._square_root import Correction as Correction
from ._square_root import Gaussian as Gaussian
from ._square_root import Step as Step
from ._square_root import linearized as linearized
from ._square_root import unscented as unscented
