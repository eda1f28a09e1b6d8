"""What the first call of a scene costs, traced and compiled, and what its derivatives cost after that.

Processor time, since compiling uses all cores: of a run with 51 saved times, and of derivatives of the sum of its
positions by six numbers (five of the belt). Chains have links of one metre and one kilogram and friction in each joint;
they start at rest, raised. Warm times are those of jitted functions.
"""

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np

import jaxmodsim as jms
from bench.record import Result, timed
from bench.tasks import BELT, TESTBENCH
from jaxmodsim.problems import n_link_pendulum

SAMPLES, VISCOUS, SIX = 51, "two viscous joints", "six LuGre joints"
JOINT = (100.0, 1.0, 0.05, 0.2, 0.3, 0.1)  # sigma0, sigma1, sigma2, Fc, Fs in N m and rad, vs in rad/s


class Task(NamedTuple):
    """A scene of some numbers, and its run from rest."""

    make: Callable[[Any], jms.Scene]
    numbers: tuple[float, ...]
    q0: np.ndarray
    t1: float

    def run(self, p: Any, **options: Any) -> jms.Trajectory:
        """The run of numbers `p`."""
        ts = np.linspace(0.0, self.t1, SAMPLES)
        return jms.simulate(self.make(p), self.q0, 0.0 * self.q0, self.t1, ts=ts, throw=False, **options)


def chain(n: int, law: Callable[[Any], Any]) -> Task:
    """A chain of `n` links with a law in each joint."""

    def make(p: Any) -> jms.Scene:
        base = n_link_pendulum.scene(n)
        joints = tuple(jms.Friction(law(p), along=lambda q, i=i: q[i]) for i in range(n))
        return jms.Scene(base.lagrangian, params=base.params, effects=joints)

    return Task(make, JOINT, 0.5 + 0.1 * np.arange(n), 5.0)


def lugre(p: Any) -> jms.LuGre:
    """The law of six numbers."""
    return jms.LuGre(*(p[i] for i in range(6)))


TASKS = {
    VISCOUS: chain(2, lambda p: jms.Viscous(p[2])),
    "LuGre box": Task(TESTBENCH.scene, TESTBENCH.numbers, np.zeros(1), TESTBENCH.t1),
    "Coulomb belt": Task(BELT.scene, BELT.numbers, np.zeros(1), BELT.t1),
    "two LuGre joints": chain(2, lugre),
    "two Coulomb joints": chain(2, lambda p: jms.Coulomb(p[3])),
    "three LuGre joints": chain(3, lugre),
    SIX: chain(6, lugre),
}


def main(smoke: bool, out: Path) -> Result:
    """All scenes, after one that is not counted; a small run takes two."""
    del out
    result = Result("first_calls", ("diffrax",), {"samples": SAMPLES})
    once = chain(1, lambda p: jms.Viscous(p[2]))  # what JAX itself must load is no scene's
    jax.jit(jax.grad(lambda p: jnp.sum(once.run(p).q))).lower(jnp.asarray(JOINT)).compile()
    for name in list(TASKS)[: 2 if smoke else None]:
        task = TASKS[name]

        def total(p: Any, task: Task = task, **options: Any) -> tuple[Any, Any]:
            run = task.run(p, **options)
            return jnp.sum(run.q), run.stats["num_steps"]

        ways = {
            "run": total,
            "gradient": jax.grad(total, has_aux=True),
            "jacobian": jax.jacfwd(total, has_aux=True),
        }
        if name == SIX:
            ways["run by Tsit5"] = lambda p, total=total: total(p, solver=dfx.Tsit5(), max_steps=1_000_000)
        calls, p = {}, jnp.asarray(task.numbers)
        for way, function in ways.items():
            began = time.process_time()
            call = jax.jit(function).lower(p).compile()
            result.add(f"first {way}", time.process_time() - began, "s", case=name)
            calls[way] = lambda call=call, p=p: jax.block_until_ready(call(p))
        for way, found in timed(calls, 3 if smoke else 30).items():
            result.add_time(way, found, case=name)
            if way.startswith("run"):
                steps = int(calls[way]()[1])
                result.add(f"steps of {way}", steps, case=name)
                result.add(f"step of {way}", found["median_s"] / steps, "s", case=name)
    return result
