"""Differentiable mechanics with friction: Lagrangians in, motion, figures and fits out."""

from . import problems as problems
from ._speed import tune_cpu as tune_cpu
from .analysis import GradientCheck as GradientCheck
from .analysis import check_gradients as check_gradients
from .effects import AbstractEffect as AbstractEffect
from .effects import AppliedForce as AppliedForce
from .effects import Friction as Friction
from .friction import Coulomb as Coulomb
from .friction import DeadZone as DeadZone
from .friction import LuGre as LuGre
from .friction import Regularized as Regularized
from .friction import Sign as Sign
from .friction import Stribeck as Stribeck
from .friction import Viscous as Viscous
from .friction import asymmetric as asymmetric
from .identify import FitResult as FitResult
from .identify import Record as Record
from .identify import fit as fit
from .identify import fit_law as fit_law
from .scene import Scene as Scene
from .simulation import SimulationError as SimulationError
from .simulation import Trajectory as Trajectory
from .simulation import simulate as simulate
from .solvers import EventController as EventController
from .solvers import EventSolver as EventSolver
from .solvers import Rodas5P as Rodas5P
