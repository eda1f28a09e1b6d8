"""Which named problems and hard cases are computed in one kernel, run and derivatives, and which are not and why.

Programs are lowered, not compiled.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import pytest

from jaxmodsim import simulate
from jaxmodsim.problems import named_problems

from .hard.case import SceneTask
from .hard.catalogue import hard_cases

MARK = "xla_cpu_small_call"
# Kernels of a run, of its gradient (the run, then its steps backward), and of a directional derivative.
KERNELS = {"run": 1, "gradient": 2, "tangent": 1}
# The exceptions with their reasons, by the name of a problem or a hard case.
_LOOP = "Its loop hands on the steps for the derivative, more numbers than a kernel holds."
NOT_ONE_KERNEL = {
    "cycles_100000": _LOOP,
    "periods_1000000": _LOOP,
    "vanishing_friction": _LOOP,
    "smooth_break_away": "The gradient of a count is zero and takes no run.",
}


def _of_problem(name: str) -> tuple[Callable[[Any], Any], Any]:
    problem = named_problems()[name]()

    def last(scene: Any) -> Any:
        return simulate(scene, problem.q0, problem.qd0, problem.t1, max_steps=problem.max_steps, throw=False).q[-1, 0]

    return last, jax.tree.map(lambda x: jnp.asarray(x, float), problem.scene)


def _of_hard_case(name: str) -> tuple[Callable[[Any], Any], Any]:
    task = hard_cases()[name].task
    assert isinstance(task, SceneTask)
    return lambda x: task.answer(x).value, jnp.asarray(task.x)


PROBLEMS = [(name, _of_problem) for name in named_problems()]
CASES = [(name, _of_hard_case) for name, case in hard_cases().items() if isinstance(case.task, SceneTask)]


def kernels(function: Callable[[Any], Any], x: Any) -> dict[str, int]:
    """Kernels of a function and of its derivatives."""
    ways = {"run": function, "gradient": jax.grad(function), "tangent": lambda x: jax.jvp(function, (x,), (x,))}
    return {name: jax.jit(way).lower(x).as_text().count(MARK) for name, way in ways.items()}


@pytest.mark.parametrize(("name", "read"), PROBLEMS + CASES, ids=[name for name, _ in PROBLEMS + CASES])
def test_run_and_derivatives_are_one_kernel_each(name: str, read: Callable[[str], tuple[Any, Any]]) -> None:
    found = kernels(*read(name))
    assert (found != KERNELS) == (name in NOT_ONE_KERNEL), found
