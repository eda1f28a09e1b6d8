"""Equations of motion derived symbolically, against which the tests hold those by automatic differentiation."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import sympy
from sympy.physics.mechanics import LagrangesMethod, dynamicsymbols, msubs

# The symbol of time in dynamicsymbols.
TIME: Any = vars(dynamicsymbols)["_t"]


class Solved(NamedTuple):
    """Accelerations, shape `[dof]`, and multipliers, shape `[constraints]`, at one state."""

    qdd: np.ndarray
    multipliers: np.ndarray


def symbolic_motion(
    lagrangian: Any,
    coordinates: Sequence[Any],
    parameters: Mapping[Any, float],
    *,
    forces: Sequence[Any] | None = None,
    holonomic: Sequence[Any] = (),
    nonholonomic: Sequence[Any] = (),
) -> Callable[..., Solved]:
    """Equations of motion by `sympy.physics.mechanics.LagrangesMethod`, as a NumPy function.

    **Arguments:**

    - `lagrangian`: expression in `coordinates`, their time derivatives `q.diff()`, `TIME` and
      `parameters`.
    - `coordinates`: `dynamicsymbols`.
    - `parameters`: number of each symbol.
    - `forces`: generalised force of each coordinate, expressions of the same kind; none if left out.
    - `holonomic`: expressions that are zero along the motion.
    - `nonholonomic`: expressions linear in the velocities that are zero along the motion.

    **Returns:**

    A function from (q, qd) and optionally t to `Solved`. Multipliers come in the order of `holonomic`, then
    `nonholonomic`, with the sign of a force: `M qdd = load + forces + A^T multipliers`, A the derivative of the
    constraints' rates by the velocities.
    """
    coordinates, constraints = list(coordinates), [*holonomic, *nonholonomic]
    dof = len(coordinates)
    method: Any = LagrangesMethod(
        lagrangian, coordinates, hol_coneqs=list(holonomic) or None, nonhol_coneqs=list(nonholonomic) or None
    )
    method.form_lagranges_equations()
    matrix, rhs = method.mass_matrix_full[dof:, dof:], method.forcing_full[dof:, :]
    rhs += sympy.Matrix([*(forces or [0] * dof), *([0] * len(constraints))])
    q, qd, t = sympy.symbols(f"q:{dof}"), sympy.symbols(f"qd:{dof}"), sympy.Symbol("time")
    plain = dict(zip([x.diff() for x in coordinates], qd, strict=True)) | dict(zip(coordinates, q, strict=True))
    plain[TIME] = t
    evaluate = sympy.lambdify(
        [q, qd, t, list(parameters)], [msubs(matrix, plain), msubs(rhs, plain)], modules="numpy", cse=True
    )
    numbers = list(parameters.values())

    def solve(q: Any, qd: Any, t: float = 0.0) -> Solved:
        matrix, rhs = evaluate(np.asarray(q), np.asarray(qd), t, numbers)
        solution = np.linalg.solve(np.asarray(matrix, float), np.asarray(rhs, float))[:, 0]
        return Solved(solution[:dof], solution[dof:])

    return solve
