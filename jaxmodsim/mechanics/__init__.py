"""From a Lagrangian to equations of motion; coordinates and their frames."""

from ._charts import AbstractChart as AbstractChart
from ._charts import Chart as Chart
from ._charts import Cylindrical as Cylindrical
from ._charts import Spherical as Spherical
from ._lagrange import Lagrangian as Lagrangian
from ._lagrange import MotionEquations as MotionEquations
from ._lagrange import acceleration as acceleration
from ._lagrange import energies as energies
from ._lagrange import motion_equations as motion_equations
