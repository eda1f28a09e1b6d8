"""From a Lagrangian to equations of motion; constraints and their reactions; coordinates and their frames."""

from ._bodies import point_mass as point_mass
from ._bodies import rigid_body as rigid_body
from ._charts import Chart as Chart
from ._charts import Cylindrical as Cylindrical
from ._charts import Spherical as Spherical
from ._constraints import AbstractConstraint as AbstractConstraint
from ._constraints import Constraint as Constraint
from ._constraints import LinearizedConstraints as LinearizedConstraints
from ._constraints import VelocityConstraint as VelocityConstraint
from ._constraints import constraint_residual as constraint_residual
from ._constraints import errors as errors
from ._constraints import linearize_constraints as linearize_constraints
from ._constraints import parts as parts
from ._constraints import project as project
from ._constraints import rates as rates
from ._contact import BoundContact as BoundContact
from ._contact import Contact as Contact
from ._lagrange import Lagrangian as Lagrangian
from ._lagrange import MotionEquations as MotionEquations
from ._lagrange import acceleration as acceleration
from ._lagrange import energies as energies
from ._lagrange import inverse_dynamics as inverse_dynamics
from ._lagrange import momentum as momentum
from ._lagrange import motion_equations as motion_equations
from ._lagrange import quadratic as quadratic
from ._lagrange import velocity as velocity
