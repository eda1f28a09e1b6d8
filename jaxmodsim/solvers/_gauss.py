"""Gauss: symplectic collocation with fixed steps, as a diffrax solver."""

from typing import Any, ClassVar

import diffrax as dfx
import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import PyTree

from ..numerics import CollocationMemory, collocation_start, collocation_step
from ._interpolation import PolynomialInterpolation


class Gauss(dfx.AbstractSolver):
    stages: int = eqx.field(default=3, static=True)
    term_structure: ClassVar = dfx.ODETerm
    interpolation_cls: ClassVar = PolynomialInterpolation

    def __check_init__(self) -> None:
        if isinstance(self.stages, bool) or self.stages not in (1, 2, 3):
            raise ValueError(f"Gauss has 1, 2 or 3 stages, but stages = {self.stages!r} was given.")

    def order(self, terms: PyTree) -> int:
        """Order of the solution: twice the number of stages."""
        del terms
        return 2 * self.stages

    def init(self, terms: PyTree, t0: Any, t1: Any, y0: PyTree, args: PyTree) -> CollocationMemory:
        """What the first step starts from; states of a wrong type are refused here."""
        del t1
        for leaf in jtu.tree_leaves(y0):
            if not jnp.issubdtype(jnp.result_type(leaf), jnp.floating):
                raise ValueError(
                    f"Gauss needs a state of real floating numbers, but one of its arrays has the type"
                    f" {jnp.result_type(leaf)}. Split complex numbers into real and imaginary parts."
                )
        return collocation_start(self.stages, lambda t, y: terms.vf(t, y, args), jnp.asarray(t0), y0)

    def func(self, terms: PyTree, t0: Any, y0: PyTree, args: PyTree) -> PyTree:
        """The vector field."""
        return terms.vf(t0, y0, args)

    def step(
        self,
        terms: PyTree,
        t0: Any,
        t1: Any,
        y0: PyTree,
        args: PyTree,
        solver_state: CollocationMemory,
        made_jump: Any,
    ) -> tuple[PyTree, None, dict[str, PyTree], CollocationMemory, dfx.RESULTS]:
        """One step; see `jaxmodsim.numerics.collocation_step`."""
        rest = [jnp.where(made_jump, 0.0, x) for x in solver_state.rest]
        step = collocation_step(
            self.stages,
            lambda t, y: terms.vf(t, y, args),
            jnp.asarray(t0),
            jnp.asarray(t1 - t0),
            y0,
            solver_state._replace(rest=rest),
        )
        result = dfx.RESULTS.where(step.solved, dfx.RESULTS.successful, dfx.RESULTS.nonlinear_divergence)
        return step.y1, None, {"y0": y0, "y1": step.y1, "k": step.dense}, step.memory, result
