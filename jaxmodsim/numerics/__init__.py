"""Numerics that know no mechanics: small linear algebra, Rosenbrock steps, numbers and their ranges."""

from ._linalg import MAX_UNROLLED_CHOLESKY as MAX_UNROLLED_CHOLESKY
from ._linalg import cholesky_pivots as cholesky_pivots
from ._linalg import factor_lu as factor_lu
from ._linalg import solve_positive_definite as solve_positive_definite
from ._numbers import Function as Function
from ._numbers import Number as Number
from ._numbers import Range as Range
from ._numbers import as_function as as_function
from ._numbers import as_number as as_number
from ._numbers import as_real as as_real
from ._numbers import check_ranges as check_ranges
from ._numbers import modules_of as modules_of
from ._numbers import parameter as parameter
from ._numbers import range_checks as range_checks
from ._numbers import ranges_of as ranges_of
from ._once import once as once
from ._once import unit_of as unit_of
from ._rosenbrock import RosenbrockTableau as RosenbrockTableau
from ._rosenbrock import rosenbrock_step as rosenbrock_step
from ._safe import safe_power as safe_power
from ._scalarise import in_scalars as in_scalars
from ._watch import Watch as Watch
from ._watch import first_root as first_root
from ._watch import watch as watch
