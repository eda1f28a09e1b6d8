"""Evaluations of the vector field, the measure of work of a method."""

import diffrax as dfx
import jax.tree_util as jtu
import numpy as np

from ..solvers import RODAS5P, Rodas5P
from ._trajectory import Trajectory


def evaluations_per_step(solver: dfx.AbstractSolver, run: Trajectory) -> int | None:
    """Evaluations of the vector field in one step of a run, rejected or not; None for methods that iterate.

    One for each stage; a stage that is equal to the last one of the step before counts once (`diffrax.Tsit5`). The
    Jacobian of `Rodas5P` counts as one for each entry of the state, its time derivative as one.

    **Returns:**

    The number, or None.
    """
    if isinstance(solver, Rodas5P):
        entries = sum(np.size(x) for x in jtu.tree_leaves((run.q, run.qd, run.z))) // run.t.shape[0]
        return len(RODAS5P.nodes) + 1 + entries
    if isinstance(solver, dfx.Euler):
        return 1
    if isinstance(solver, dfx.AbstractERK) and isinstance(solver.tableau, dfx.ButcherTableau):
        return solver.tableau.num_stages - bool(solver.tableau.fsal)
    return None
