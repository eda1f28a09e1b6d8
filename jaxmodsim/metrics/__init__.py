"""Scalar metrics of a run: break-away time, period, peaks, dissipated energy, share of stick, kind of motion."""

from ._amounts import dissipated as dissipated
from ._amounts import final as final
from ._amounts import peak as peak
from ._metric import Metric as Metric
from ._metric import classes as classes
from ._motion import mode_changes as mode_changes
from ._motion import motion_kind as motion_kind
from ._motion import stick_share as stick_share
from ._times import break_away as break_away
from ._times import period as period
