"""Base classes of wrappers of a solver, and of a step size controller."""

from typing import Any, cast

import diffrax as dfx
import equinox as eqx
import optimistix as optx
from jaxtyping import PyTree


class AbstractSolverWrapper(dfx.AbstractAdaptiveSolver, dfx.AbstractWrappedSolver):
    """A wrapper of another solver, with its order and the attributes that diffrax sets and reads."""

    @property
    def root_finder(self) -> PyTree:
        """Root finder of the wrapped solver, if it is implicit: diffrax gives it the tolerances of the controller."""
        return cast(dfx.AbstractImplicitSolver, self.solver).root_finder

    @property
    def scan_kind(self) -> PyTree:
        """Kind of loop of the wrapped solver, if it is a Runge-Kutta method: diffrax sets it for the adjoint."""
        return cast(dfx.AbstractRungeKutta, self.solver).scan_kind

    def order(self, terms: PyTree) -> int | None:
        """Order of the wrapped solver."""
        return self.solver.order(terms)

    def error_order(self, terms: PyTree) -> PyTree:
        """Order of the error estimate of the wrapped solver."""
        return self.solver.error_order(terms)


class AbstractControllerWrapper(dfx.AbstractAdaptiveStepSizeController):
    """A wrapper of another step size controller, with the attributes that implicit solvers read."""

    controller: eqx.AbstractVar[dfx.AbstractStepSizeController]

    @property
    def rtol(self) -> Any:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Relative tolerance of the wrapped controller, for implicit solvers; NaN if it has none."""
        return getattr(self.controller, "rtol", float("nan"))

    @property
    def atol(self) -> Any:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Absolute tolerance of the wrapped controller, for implicit solvers; NaN if it has none."""
        return getattr(self.controller, "atol", float("nan"))

    @property
    def norm(self) -> Any:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Norm of the wrapped controller, for implicit solvers."""
        return getattr(self.controller, "norm", optx.max_norm)
