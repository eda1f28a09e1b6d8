"""What `simulate_to_accuracy` chose, and what it went by."""

from dataclasses import dataclass
from typing import NamedTuple

import diffrax as dfx


class CostScaling(NamedTuple):
    """Predicted steps for another accuracy, as multiples of those that were made.

    - `better`: for an error ten times smaller, >= 1.
    - `worse`: for an error ten times larger, <= 1.
    """

    better: float
    worse: float


@dataclass(frozen=True)
class Attempt:
    """One run of the search.

    - `solver`: name of its method, with "bounded" behind it where the search bounded the step.
    - `rtol`, `atol`: its tolerances.
    - `num_steps`: its steps, rejected ones included.
    - `evaluations`: evaluations of the vector field in one step, the Jacobian of a Rosenbrock method counted as one for
      each entry of the state; None of methods for which that is not fixed.
    - `estimate`: of its error, in the measure of `Accuracy.asked`; infinite if the run ended early.
    """

    solver: str
    rtol: float
    atol: float
    num_steps: int
    evaluations: int | None
    estimate: float


@dataclass(frozen=True, eq=False)
class Accuracy:
    """What was chosen for an accuracy that was asked for; print it.

    - `asked`: the accuracy.
    - `estimate`: of the error of the run, in the same measure; at most `asked` where that was reached.
    - `solver`, `rtol`, `atol`: what the run was made with; `options` holds them as arguments of `simulate`.
    - `num_steps`: steps of the run.
    - `cost_scaling`: steps for ten times better and ten times worse, as multiples of `num_steps`, by the
      observed slope.
    - `attempts`: all runs of the search, in the order in which they were made.
    - `remark`: what kept the search from the accuracy, in a sentence; empty where it was reached.
    - `dtmax`: longest step [s] where the search has bounded it; it is among the `options` then.
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
        """Whether the estimate is within what was asked for."""
        return not self.remark

    @property
    def options(self) -> dict[str, dfx.AbstractSolver | float]:
        """Arguments for `simulate` that make this run again, also where its numbers are traced."""
        bound = {} if self.dtmax is None else {"dtmax": self.dtmax}
        return {"solver": self.solver, "rtol": self.rtol, "atol": self.atol, **bound}

    def __str__(self) -> str:
        """The choice in a sentence, what ten times better and worse would cost, and a table of the runs."""
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
