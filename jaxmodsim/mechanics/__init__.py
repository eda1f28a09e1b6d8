"""From a Lagrangian to equations of motion."""

from ._lagrange import Lagrangian as Lagrangian
from ._lagrange import MotionEquations as MotionEquations
from ._lagrange import acceleration as acceleration
from ._lagrange import energies as energies
from ._lagrange import motion_equations as motion_equations
