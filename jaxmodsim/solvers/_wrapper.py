"""What all wrappers of a solver take from it."""

from typing import cast

import diffrax as dfx
from jaxtyping import PyTree


class AbstractSolverWrapper(dfx.AbstractAdaptiveSolver, dfx.AbstractWrappedSolver):
    """A solver made of another one, with its order and what diffrax sets and reads of it."""

    @property
    def root_finder(self) -> PyTree:
        """That of the wrapped solver, if it is implicit: diffrax gives it the tolerances of the controller."""
        return cast(dfx.AbstractImplicitSolver, self.solver).root_finder

    @property
    def scan_kind(self) -> str | None:
        """That of the wrapped solver, if it is a Runge-Kutta method: diffrax sets it for the kind of derivative."""
        return cast(dfx.AbstractRungeKutta, self.solver).scan_kind

    def order(self, terms: PyTree) -> int | None:
        """Order of the wrapped solver."""
        return self.solver.order(terms)

    def error_order(self, terms: PyTree) -> PyTree:
        """Order of the error estimate of the wrapped solver."""
        return self.solver.error_order(terms)
