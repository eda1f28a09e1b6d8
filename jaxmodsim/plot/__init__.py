"""Figures. Only this room imports matplotlib. Functions return a `Figure`, which a notebook displays."""

try:
    from ._style import Figure as Figure
except ModuleNotFoundError as error:
    raise ImportError('jaxmodsim.plot needs matplotlib: pip install "jaxmodsim[plot]".') from error

from ._animate import Animation as Animation
from ._animate import animate as animate
from ._identify import comparison_figure as comparison_figure
from ._identify import design_figure as design_figure
from ._identify import fit_figure as fit_figure
from ._identify import loops_figure as loops_figure
from ._identify import result_figure as result_figure
from ._identify import score_figure as score_figure
from ._identify import servo_figure as servo_figure
from ._identify import truth_figure as truth_figure
from ._map import map2d as map2d
from ._orbits import branch_figure as branch_figure
from ._orbits import orbit_figure as orbit_figure
from ._run import run as run
from ._testbench import ramp_figure as ramp_figure
from ._testbench import stick_figure as stick_figure
from ._uncertainty import indices_figure as indices_figure
from ._uncertainty import posterior_figure as posterior_figure
from ._uncertainty import profile_figure as profile_figure
from ._uncertainty import sensitivity_figure as sensitivity_figure
from ._work_precision import work_precision_figure as work_precision_figure
