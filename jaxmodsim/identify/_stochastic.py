"""Many records a few at a time."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Float

from ._begin import AbstractBeginning
from ._problem import Problem
from ._solve import Options


class Stochastic(AbstractBeginning):
    """Gradient steps on a few runs at a time, for more records than one would run in every iteration.

    Each step takes the gradient of the mean loss of `batch` runs, drawn without replacement until all have had their
    turn, in the coordinates in which limits are bounds. The fit that follows uses all records; with `max_steps=1` it
    only evaluates them.

    **Arguments:**

    - `optimiser`: an `optax.GradientTransformation`, such as `optax.adam(0.05)`; coordinates are about 1 in size.
    - `batch`: number of runs in a step, >= 1.
    - `steps`: number of steps, >= 1.
    - `seed`: of the order of the runs.

    **Raises:**

    - `ValueError` for a number out of range, or (at the fit) windows that are linked, or more runs in a batch than
      there are.
    """

    optimiser: Any = eqx.field(static=True)
    batch: int = eqx.field(static=True, default=4)
    steps: int = eqx.field(static=True, default=200)
    seed: int = eqx.field(static=True, default=0)

    def __check_init__(self) -> None:
        """Refuse what is no optimiser, and numbers out of range."""
        if not (hasattr(self.optimiser, "init") and hasattr(self.optimiser, "update")):
            raise ValueError(f"optimiser must be one of optax, as optax.adam(0.05), but it is {self.optimiser!r}.")
        if self.batch < 1 or self.steps < 1:
            raise ValueError(f"Stochastic needs batch >= 1 and steps >= 1, but they are {self.batch} and {self.steps}.")

    def begin(
        self, problem: Problem, x: Float[Array, " n"], options: Options
    ) -> tuple[Float[Array, " n"], tuple[float, ...]]:
        """Where the last step ended; Ctrl-C ends at the step before."""
        if problem.jump is not None:
            raise ValueError("Stochastic() draws runs by themselves: give Shooting no jump, or leave Stochastic out.")
        if self.batch > problem.count:
            raise ValueError(f"Stochastic() draws {self.batch} runs at a time, but there are {problem.count}.")
        rng, box = np.random.default_rng(self.seed), problem.box
        state, order = self.optimiser.init(x), np.zeros(0, int)
        try:
            for number in range(self.steps):
                if order.size < self.batch:
                    order = np.concatenate([order, rng.permutation(problem.count)])
                drawn, order = jnp.asarray(order[: self.batch]), order[self.batch :]
                cost, gradient = _gradient(problem, x, drawn)
                if not bool(jnp.isfinite(cost)):
                    raise RuntimeError(f"The loss is not finite in step {number + 1}: take a smaller learning rate.")
                update, state = self.optimiser.update(gradient, state, x)
                x = jnp.clip(x + update, box.lower, box.upper)
                if options.progress is not None:
                    values = problem.free.values(problem.split(x)[0])
                    shown = {name: float(values[name]) for name in problem.free.names}
                    options.progress(number + 1, float(jnp.sqrt(2 * cost)), shown)
        except KeyboardInterrupt:
            pass  # the fit that follows goes on from here, and may be interrupted itself
        return x, ()


@eqx.filter_jit
def _gradient(problem: Problem, x: Float[Array, " n"], drawn: Array) -> tuple[Array, Array]:
    """Mean loss of a sample of these runs, and its gradient by all of x."""
    shared, own = problem.split(x)
    some = eqx.tree_at(
        lambda p: (p.base, p.runs),
        problem,
        jtu.tree_map(lambda leaf: leaf[drawn], (problem.base, problem.runs)),
        is_leaf=lambda leaf: leaf is None,
    )
    residual, jacobian = some.evaluate(jnp.concatenate([shared, jnp.reshape(own[drawn], (-1,))]))
    cost = problem.loss.cost(residual)
    residual, jacobian = problem.loss.weighted(residual, jacobian)
    slope, samples = jacobian.T @ residual, jnp.sum(some.weights)
    size = shared.shape[0]
    mine = jnp.zeros_like(own).at[drawn].set(jnp.reshape(slope[size:], (drawn.shape[0], own.shape[1])))
    return cost / samples, jnp.concatenate([slope[:size], jnp.reshape(mine, (-1,))]) / samples
