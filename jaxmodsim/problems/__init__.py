"""Reference problems, one module each, with its scene, its parameters and its exact or reference solution."""

from . import belt_oscillator as belt_oscillator
from . import bouncing_ball as bouncing_ball
from . import braked_spring as braked_spring
from . import bristles as bristles
from . import cart_pole as cart_pole
from . import cartesian_pendulum as cartesian_pendulum
from . import charged_particle as charged_particle
from . import coupled_belts as coupled_belts
from . import foucault_pendulum as foucault_pendulum
from . import four_bar as four_bar
from . import knife_edge as knife_edge
from . import n_link_pendulum as n_link_pendulum
from . import ramped_box as ramped_box
from . import slider_crank as slider_crank
from . import spherical_pendulum as spherical_pendulum
from . import spiral_bead as spiral_bead
from . import stick_slip_pendulum as stick_slip_pendulum
from . import testbench as testbench
from . import turntable_puck as turntable_puck
from . import worm_drive as worm_drive
from ._named import NamedProblem as NamedProblem
from ._named import named_problems as named_problems
