"""Which named problems and hard cases are computed in one kernel, run and derivatives, and which are not and why.

Programs are lowered, not compiled.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmodsim import (
    AppliedForce,
    Constraint,
    Contact,
    Coulomb,
    Friction,
    Scene,
    VelocityConstraint,
    simulate,
)
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


BODIES = np.array([0, 2])
ENDS = [Contact(lambda t, q, p, x=x: q[1] + x * jnp.sin(q[BODIES])[1], name=f"end {x}") for x in (-0.5, 0.5)]
INDEXED: dict[str, dict[str, list[Any]]] = {
    "the Lagrangian": {},
    "a force": {"effects": [AppliedForce(lambda t, q, qd, p: jnp.zeros(3).at[BODIES].set(-qd[BODIES]))]},
    "slip in the plane": {"effects": [Friction(Coulomb(0.5), along=lambda q: q[BODIES], normal_force=1.0)]},
    "a constraint": {"constraints": [Constraint(lambda t, q, p: q[BODIES] - 0.2 * q[1], name="ramps")]},
    "a velocity constraint": {
        "constraints": [VelocityConstraint(lambda t, q, qd, p: jnp.diff(qd[BODIES]), name="edge")]
    },
    "two contacts with friction": {
        "effects": [Friction(Coulomb(0.3), along=lambda q: q[0], normal_force=each.name) for each in ENDS],
        "constraints": [*ENDS],
    },
}


@pytest.mark.parametrize("kind", INDEXED)
def test_entries_by_lists_of_indices_are_in_one_kernel(kind: str) -> None:
    """In arrays their derivative is a scatter, which no kernel holds. That of the loads of friction was one, too."""

    def lagrangian(t: Any, q: Any, qd: Any, p: Any) -> Any:
        del t
        return 0.5 * p["m"] * (jnp.sum(qd[BODIES] ** 2) + qd[1] ** 2) - p["m"] * 9.81 * jnp.take(q, jnp.array([1]))[0]

    def last(m: Any) -> Any:
        scene = Scene(lagrangian, {"m": m}, **INDEXED[kind])
        return simulate(scene, np.zeros(3), np.zeros(3), 0.5, throw=False).q[-1, 0]

    assert kernels(last, jnp.asarray(1.0)) == KERNELS
