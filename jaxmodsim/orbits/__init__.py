"""Periodic orbits and equilibria, their stability, and branches of them."""

from ._branch import Branch as Branch
from ._branch import SpecialOrbit as SpecialOrbit
from ._continue import continue_orbits as continue_orbits
from ._curve import SpecialCurve as SpecialCurve
from ._curve import continue_special as continue_special
from ._equilibria import continue_equilibria as continue_equilibria
from ._equilibrium import Equilibrium as Equilibrium
from ._equilibrium import equilibrium as equilibrium
from ._hunting import Hunting as Hunting
from ._hunting import hunting as hunting
from ._orbit import PeriodicOrbit as PeriodicOrbit
from ._periodic_orbit import periodic_orbit as periodic_orbit
from ._return_map import OrbitError as OrbitError
