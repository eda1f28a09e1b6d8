"""Differentiable mechanics with friction: Lagrangians in, motion, figures and fits out.

Scenes: Scene, AppliedForce, Friction, Switch, Signal, AbstractEffect; Constraint, VelocityConstraint;
    Contact, with Poisson or HuntCrossley, end_stops, backlash; project_initial_state.
Mechanics: point_mass, rigid_body; Chart, Cylindrical, Spherical.
Friction laws: Viscous, Curve, Coulomb, Stribeck, Dahl, LuGre, ElastoPlastic, MaxwellSlip, Armstrong; in the wrappers
    Regularized, DeadZone, Sign, Bristle; with asymmetric, scaled_by; of gears Geared, ServoGear.
About laws: check_passivity, damping_sigma1, regularized_width, max_stable_step; to_mujoco, to_modelica.
Scenes elsewhere: to_c.
Runs: simulate, simulate_to_accuracy; they give a Trajectory, or raise a SimulationError.
Solvers: Rodas5P, Gauss, ImplicitFriction; EventSolver and EventController; StoredSteps, an adjoint.
Analysis: energy_audit (EnergyAudit), sensitivity (Sensitivity), check_gradients (GradientCheck), cyclic_coordinates;
    work_precision (WorkPrecision), Method, formulations.
Periodic orbits: periodic_orbit (PeriodicOrbit), continue_orbits (Branch); where they begin:
equilibrium (Equilibrium), continue_equilibria.
Records: fit, fit_law, Record, FitResult.
Many runs: sweep.
Speed: tune_cpu, called before JAX computes anything.
Modules: analysis, export, identify, metrics, orbits, plot, problems, sweeps.

`help(jaxmodsim.simulate)` says more of each. Remarks go to the logger "jaxmodsim" of the module logging.
"""

from importlib import import_module as _import_module
from typing import TYPE_CHECKING
from typing import Any as _Any

from ._core.system import versions as _versions

if TYPE_CHECKING:
    from . import metrics as metrics
    from . import plot as plot
    from . import problems as problems
    from . import sweeps as sweeps
    from ._core.speed import tune_cpu as tune_cpu
    from .analysis import EnergyAudit as EnergyAudit
    from .analysis import GradientCheck as GradientCheck
    from .analysis import Method as Method
    from .analysis import Sensitivity as Sensitivity
    from .analysis import WorkPrecision as WorkPrecision
    from .analysis import check_gradients as check_gradients
    from .analysis import cyclic_coordinates as cyclic_coordinates
    from .analysis import energy_audit as energy_audit
    from .analysis import formulations as formulations
    from .analysis import sensitivity as sensitivity
    from .analysis import work_precision as work_precision
    from .export import to_c as to_c
    from .export import to_modelica as to_modelica
    from .export import to_mujoco as to_mujoco
    from .friction import Armstrong as Armstrong
    from .friction import Bristle as Bristle
    from .friction import Coulomb as Coulomb
    from .friction import Curve as Curve
    from .friction import Dahl as Dahl
    from .friction import DeadZone as DeadZone
    from .friction import ElastoPlastic as ElastoPlastic
    from .friction import Geared as Geared
    from .friction import LuGre as LuGre
    from .friction import MaxwellSlip as MaxwellSlip
    from .friction import Regularized as Regularized
    from .friction import ServoGear as ServoGear
    from .friction import Sign as Sign
    from .friction import Stribeck as Stribeck
    from .friction import Viscous as Viscous
    from .friction import asymmetric as asymmetric
    from .friction import check_passivity as check_passivity
    from .friction import damping_sigma1 as damping_sigma1
    from .friction import max_stable_step as max_stable_step
    from .friction import regularized_width as regularized_width
    from .friction import scaled_by as scaled_by
    from .identify import FitResult as FitResult
    from .identify import Record as Record
    from .identify import fit as fit
    from .identify import fit_law as fit_law
    from .mechanics import Chart as Chart
    from .mechanics import Constraint as Constraint
    from .mechanics import Contact as Contact
    from .mechanics import Cylindrical as Cylindrical
    from .mechanics import HuntCrossley as HuntCrossley
    from .mechanics import Poisson as Poisson
    from .mechanics import Spherical as Spherical
    from .mechanics import VelocityConstraint as VelocityConstraint
    from .mechanics import backlash as backlash
    from .mechanics import end_stops as end_stops
    from .mechanics import point_mass as point_mass
    from .mechanics import rigid_body as rigid_body
    from .orbits import Branch as Branch
    from .orbits import Equilibrium as Equilibrium
    from .orbits import PeriodicOrbit as PeriodicOrbit
    from .orbits import continue_equilibria as continue_equilibria
    from .orbits import continue_orbits as continue_orbits
    from .orbits import equilibrium as equilibrium
    from .orbits import periodic_orbit as periodic_orbit
    from .scene import AbstractEffect as AbstractEffect
    from .scene import AppliedForce as AppliedForce
    from .scene import Friction as Friction
    from .scene import Scene as Scene
    from .scene import Signal as Signal
    from .scene import Switch as Switch
    from .simulation import SimulationError as SimulationError
    from .simulation import Trajectory as Trajectory
    from .simulation import project_initial_state as project_initial_state
    from .simulation import simulate as simulate
    from .simulation import simulate_to_accuracy as simulate_to_accuracy
    from .solvers import EventController as EventController
    from .solvers import EventSolver as EventSolver
    from .solvers import Gauss as Gauss
    from .solvers import ImplicitFriction as ImplicitFriction
    from .solvers import Rodas5P as Rodas5P
    from .solvers import StoredSteps as StoredSteps
    from .sweeps import sweep as sweep

# Every name is loaded when it is first asked for: with JAX that takes more than a second, which `jaxmodsim --help`
# does not wait for. The same names as above, which is for type checkers.
_LATER = {
    "_core.speed": ("tune_cpu",),
    "analysis": (
        "EnergyAudit",
        "GradientCheck",
        "Method",
        "Sensitivity",
        "WorkPrecision",
        "check_gradients",
        "cyclic_coordinates",
        "energy_audit",
        "formulations",
        "sensitivity",
        "work_precision",
    ),
    "export": ("to_c", "to_modelica", "to_mujoco"),
    "friction": (
        "Armstrong",
        "Bristle",
        "Coulomb",
        "Curve",
        "Dahl",
        "DeadZone",
        "ElastoPlastic",
        "Geared",
        "LuGre",
        "MaxwellSlip",
        "Regularized",
        "ServoGear",
        "Sign",
        "Stribeck",
        "Viscous",
        "asymmetric",
        "check_passivity",
        "damping_sigma1",
        "max_stable_step",
        "regularized_width",
        "scaled_by",
    ),
    "identify": ("FitResult", "Record", "fit", "fit_law"),
    "mechanics": (
        "Chart",
        "Constraint",
        "Contact",
        "Cylindrical",
        "HuntCrossley",
        "Poisson",
        "Spherical",
        "VelocityConstraint",
        "backlash",
        "end_stops",
        "point_mass",
        "rigid_body",
    ),
    "metrics": (),
    "orbits": (
        "Branch",
        "Equilibrium",
        "PeriodicOrbit",
        "continue_equilibria",
        "continue_orbits",
        "equilibrium",
        "periodic_orbit",
    ),
    "plot": (),
    "problems": (),
    "scene": ("AbstractEffect", "AppliedForce", "Friction", "Scene", "Signal", "Switch"),
    "simulation": ("SimulationError", "Trajectory", "project_initial_state", "simulate", "simulate_to_accuracy"),
    "solvers": ("EventController", "EventSolver", "Gauss", "ImplicitFriction", "Rodas5P", "StoredSteps"),
    "sweeps": ("sweep",),
}
_FOLDERS = {name: folder for folder, names in _LATER.items() for name in names}
__all__ = [*_FOLDERS]  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> _Any:
    if name == "__version__":
        return _versions(__name__)[__name__]
    if name in _LATER:
        return _import_module(f"{__name__}.{name}")
    if name not in _FOLDERS:
        # Tracebacks ask whether a similar name of this module was meant.
        here = _import_module(__name__)
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}", name=name, obj=here)
    value = globals()[name] = getattr(_import_module(f"{__name__}.{_FOLDERS[name]}"), name)
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *_FOLDERS, *(folder.partition(".")[0] for folder in _LATER)})
