"""Step size control that stops at the first value that is not finite."""

from typing import Any, cast

import diffrax as dfx
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import PyTree


class FiniteSteps(dfx.AbstractStepSizeController):
    """Constant steps that end the run, at its last finite state, instead of carrying NaN to the end."""

    inner: dfx.ConstantStepSize = dfx.ConstantStepSize()

    def wrap(self, direction: Any) -> "FiniteSteps":
        """Constant steps know no direction."""
        del direction
        return self

    def init(
        self, terms: PyTree, t0: Any, t1: Any, y0: PyTree, dt0: Any, args: PyTree, func: Any, error_order: Any
    ) -> tuple[Any, Any]:
        """As `diffrax.ConstantStepSize`."""
        return self.inner.init(terms, t0, t1, y0, dt0, args, func, error_order)

    def adapt_step_size(
        self,
        t0: Any,
        t1: Any,
        y0: PyTree,
        y1_candidate: PyTree,
        args: PyTree,
        y_error: Any,
        error_order: Any,
        controller_state: Any,
    ) -> tuple[Any, Any, Any, Any, Any, dfx.RESULTS]:
        """Keep the step if all of its result is finite."""
        _, next_t0, next_t1, jump, state, _ = self.inner.adapt_step_size(
            t0, t1, y0, y1_candidate, args, y_error, error_order, controller_state
        )
        finite = jnp.stack([jnp.all(jnp.isfinite(leaf)) for leaf in jtu.tree_leaves(y1_candidate)]).all()
        # diffrax has no code for a value that is not finite; this is the nearest that step control does not use.
        failure = cast(dfx.RESULTS, dfx.RESULTS.nonlinear_divergence)
        result = dfx.RESULTS.where(finite, dfx.RESULTS.successful, failure)
        return finite, jnp.where(finite, next_t0, t0), next_t1, jump, state, result
