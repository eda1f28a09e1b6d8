"""Report of `simulate_to_accuracy`: the chosen run, all runs of the search, and their measure of work."""

from dataclasses import dataclass
from typing import NamedTuple

import diffrax as dfx
import jax.tree_util as jtu
import numpy as np
from jaxtyping import PyTree

from ..solvers import RODAS5P, Rodas5P


class CostScaling(NamedTuple):
    """Predicted steps for another accuracy, as multiples of the steps of the run.

    - `better`: for an error ten times smaller, >= 1.
    - `worse`: for an error ten times larger, <= 1.
    """

    better: float
    worse: float


@dataclass(frozen=True)
class Attempt:
    """One run of the search.

    - `solver`: name of its method, followed by "bounded" if the search bounded the step.
    - `rtol`, `atol`: its tolerances.
    - `num_steps`: its steps, rejected ones included.
    - `evaluations`: evaluations of the vector field in one step; the Jacobian of a Rosenbrock method counts as one for
      each entry of the state. None for methods without a fixed number.
    - `estimate`: estimate of its error, in the measure of `Accuracy.asked`; infinite if the run ended early.
    """

    solver: str
    rtol: float
    atol: float
    num_steps: int
    evaluations: int | None
    estimate: float


@dataclass(frozen=True, eq=False)
class Accuracy:
    """The choice for a requested accuracy; print it.

    - `asked`: the requested accuracy.
    - `estimate`: estimate of the error of the run, in the same measure; at most `asked` if the search reached it.
    - `solver`, `rtol`, `atol`: method and tolerances of the run; `options` has them as arguments of `simulate`.
    - `num_steps`: steps of the run.
    - `cost_scaling`: steps for an error ten times smaller and ten times larger, as multiples of `num_steps`, by the
      observed slope.
    - `attempts`: all runs of the search, in their order.
    - `remark`: why the search did not reach the accuracy, in a sentence; empty if it did.
    - `dtmax`: longest step [s] if the search has bounded it; `options` then contains it.
    """

    asked: float
    estimate: float
    solver: dfx.AbstractSolver
    rtol: float
    atol: float
    num_steps: int
    cost_scaling: CostScaling
    attempts: tuple[Attempt, ...]
    remark: str = ""
    dtmax: float | None = None

    @property
    def reached(self) -> bool:
        """Whether the estimate is within the requested accuracy."""
        return not self.remark

    @property
    def options(self) -> dict[str, dfx.AbstractSolver | float]:
        """Arguments for `simulate` that repeat this run, also with traced numbers."""
        bound = {} if self.dtmax is None else {"dtmax": self.dtmax}
        return {"solver": self.solver, "rtol": self.rtol, "atol": self.atol, **bound}

    def __str__(self) -> str:
        """The choice in a sentence, the cost of ten times smaller and larger errors, and a table of the runs."""
        name = type(self.solver).__name__
        lines = [
            f"accuracy {self.asked:.3g}: {name} at rtol {self.rtol:.3g}, {self.num_steps} steps, error about"
            f" {self.estimate:.2g}",
            f"ten times better: {self.cost_scaling.better:.2f} times the steps; ten times worse:"
            f" {self.cost_scaling.worse:.2f}",
            f"{'solver':15}  {'rtol':>8}  {'steps':>8}  {'evaluations':>12}  {'error':>8}",
        ]
        for run in self.attempts:
            work = "" if run.evaluations is None else str(run.num_steps * run.evaluations)
            lines.append(f"{run.solver:15}  {run.rtol:8.1e}  {run.num_steps:8}  {work:>12}  {run.estimate:8.1e}")
        return "\n".join([*lines, *([self.remark] if self.remark else [])])


def evaluations_per_step(solver: dfx.AbstractSolver, ys: PyTree) -> int | None:
    """Evaluations of the vector field in one step, rejected or not; None for methods that iterate.

    One for each stage; a stage that is equal to the last one of the step before counts once (`diffrax.Tsit5`). The
    Jacobian of `Rodas5P` counts as one for each entry of the state, its time derivative as one. `ys` are the states of
    a run, with a leading axis of time.

    **Returns:**

    The number, or None.
    """
    if isinstance(solver, Rodas5P):
        return len(RODAS5P.nodes) + 1 + sum(np.size(x[0]) for x in jtu.tree_leaves(ys))
    if isinstance(solver, dfx.Euler):
        return 1
    if isinstance(solver, dfx.AbstractERK) and isinstance(solver.tableau, dfx.ButcherTableau):
        return solver.tableau.num_stages - bool(solver.tableau.fsal)
    return None
