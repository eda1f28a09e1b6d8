"""Periodic orbits and equilibria, their stability, and branches of them."""

from ._branch import BifurcationPoint as BifurcationPoint
from ._branch import Branch as Branch
from ._continue import BifurcationCurve as BifurcationCurve
from ._continue import continue_bifurcation as continue_bifurcation
from ._continue import continue_orbits as continue_orbits
from ._equilibria import continue_equilibria as continue_equilibria
from ._equilibrium import Equilibrium as Equilibrium
from ._equilibrium import equilibrium as equilibrium
from ._orbit import PeriodicOrbit as PeriodicOrbit
from ._periodic_orbit import periodic_orbit as periodic_orbit
from ._return_map import OrbitError as OrbitError
