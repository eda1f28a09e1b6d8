"""Where a search begins."""

import abc

import equinox as eqx
from jaxtyping import Array, Float

from ._problem import Problem
from ._solve import Options


class AbstractBeginning(eqx.Module):
    """How to find where a search begins."""

    @abc.abstractmethod
    def begin(
        self, problem: Problem, x: Float[Array, " n"], options: Options
    ) -> tuple[Float[Array, " n"], tuple[float, ...]]:
        """A better `x`, and the root mean squares, in noise levels, of all starts that were tried."""
