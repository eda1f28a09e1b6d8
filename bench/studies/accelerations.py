"""Time of the accelerations of a chain of n links: in a loop, and for 1024 states at once.

Point masses of 0.5 to 2 kg on links of 0.5 to 2 m, angles from straight down [rad]. By hand: the closed form, once in
arrays and once in scalars, optimised for XLA on CPU. In a loop, each evaluation is followed by an Euler step, because a
single evaluation takes less time than its call.
"""

import os
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxmodsim as jms
from bench.record import OURS, Call, Result, importable, timed
from jaxmodsim._core.arrays import fusion_barrier, opaque_one
from jaxmodsim._core.cholesky import solve_positive_definite
from jaxmodsim.problems import n_link_pendulum
from jaxmodsim.scene import State, vector_field

HAND = ("JAX by hand, arrays", "JAX by hand, scalars")
LOOP, BATCH, BATCH_LOOP = "loop", "many", "many in a loop"
STEP, G = 1e-4, 9.81
# Calls by way, and the accelerations at the many states.
Made = tuple[dict[str, Call], Any]
# Larger chains in scalars take minutes to compile.
LARGEST_WRITTEN_OUT = 12


def main(smoke: bool, out: Path) -> Result:
    """Measure every size with all peers, in turns."""
    del out
    result = Result("accelerations", ("mujoco", "numpy"), {"step": STEP})
    for n in (2,) if smoke else (1, 2, 3, 4, 6, 8, 12, 16, 24, 32):
        _size(n, result, smoke)
    return result


def _size(n: int, result: Result, smoke: bool) -> None:
    """Measure one size."""
    many, single, batches = (8, 20, 2) if smoke else (1024, max(200, 4000 // n), max(2, 32 // n))
    rng, numbers = np.random.default_rng(20240229), chain_numbers(n)
    q, qd = rng.uniform(-1.0, 1.0, (many, n)), rng.uniform(-1.0, 1.0, (many, n))
    scene = n_link_pendulum.scene(n, **numbers)
    exact = np.asarray(jax.vmap(_arrays, (0, 0, None))(jnp.asarray(q), jnp.asarray(qd), scene))
    makers: dict[str, Any] = {
        OURS: lambda: _compiled(_ours, n, q, qd, single, batches),
        HAND[0]: lambda: _compiled(_arrays, n, q, qd, single, batches),
        HAND[1]: lambda: _compiled(_scalars, n, q, qd, single, batches),
        "MuJoCo": lambda: _mujoco(n, q, qd, single),
    }
    if n > LARGEST_WRITTEN_OUT:
        del makers[HAND[1]]
    counts = {LOOP: single, BATCH: many, BATCH_LOOP: many * batches}
    calls, sizes, case = {}, {}, f"{n}"
    for name, (ways, found) in importable(result, makers).items():
        error = np.max(np.abs(found - exact[: len(found)]) / np.abs(exact[: len(found)]).max(axis=1, keepdims=True))
        result.add("disagreement", float(error), case=case, peer=name)
        calls |= {(name, way): call for way, call in ways.items()}
        sizes |= {(name, way): counts[way] for way in ways}
    report = timed(calls, 1 if smoke else 12, per=sizes, limit_s=10.0)
    for way in (LOOP, BATCH, BATCH_LOOP):
        hand = [report[name, way] for name in HAND if (name, way) in report]
        result.add_time(way, min(hand, key=lambda found: found["minimum_s"]), case=case, peer="JAX by hand")
    for (name, way), found in report.items():
        if name not in HAND:
            result.add_time(way, found, case=case, peer=name)


def chain_numbers(n: int) -> dict[str, Any]:
    """Masses [kg], lengths [m] and gravity [m/s^2]."""
    rng = np.random.default_rng(n)
    return {"m": rng.uniform(0.5, 2.0, n), "l": rng.uniform(0.5, 2.0, n), "g": G}


def _ours(q: Any, qd: Any, scene: jms.Scene) -> Any:
    """Accelerations from the Lagrangian."""
    return vector_field(jnp.zeros_like(q[0]), State(q, qd, {}), scene).qd


def _arrays(q: Any, qd: Any, scene: jms.Scene) -> Any:
    return n_link_pendulum.acceleration(q, qd, **scene.params)


def _scalars(q: Any, qd: Any, scene: jms.Scene) -> Any:
    """Accelerations in scalars, with sines computed once and an elimination by quotients."""
    n, p, unit = q.shape[0], scene.params, opaque_one(q[0])
    m, l, w = ([x[i] for i in range(n)] for x in (p["m"], p["l"], qd))  # noqa: E741
    s, c = ([fusion_barrier(fn(q[i]), unit) for i in range(n)] for fn in (jnp.sin, jnp.cos))
    below = [sum(m[i + 1 :], m[i]) for i in range(n)]
    mass: list[list[Any]] = [[None] * n for _ in range(n)]
    load = [-below[i] * p["g"] * l[i] * s[i] for i in range(n)]
    for i in range(n):
        for j in range(i + 1):
            size = below[i] * l[i] * l[j]
            mass[i][j] = mass[j][i] = size * (c[i] * c[j] + s[i] * s[j])
            slope = size * (s[i] * c[j] - c[i] * s[j])
            load[i] = load[i] - slope * w[j] * w[j]
            load[j] = load[j] + slope * w[i] * w[i]
    return solve_positive_definite(jnp.stack([jnp.stack(row) for row in mass]), jnp.stack(load))


def _compiled(fn: Any, n: int, q: Any, qd: Any, single: int, batches: int) -> Made:
    """Functions compiled by JAX."""
    chain, many = n_link_pendulum.scene(n, **chain_numbers(n)), jax.vmap(fn, (0, 0, None))
    one, all_of_them = (jnp.asarray(q[0]), jnp.asarray(qd[0])), (jnp.asarray(q), jnp.asarray(qd))
    programs = {
        LOOP: (partial(_euler, fn, single), one),
        BATCH: (many, all_of_them), BATCH_LOOP: (partial(_euler, many, batches), all_of_them),
    }  # fmt: skip
    calls = {}
    for way, (program, state) in programs.items():
        compiled = jax.jit(program).lower(*state, chain).compile()
        calls[way] = lambda compiled=compiled, state=state: jax.block_until_ready(compiled(*state, chain))
    return calls, np.asarray(calls[BATCH]())


def _euler(fn: Any, count: int, q: Any, qd: Any, chain: jms.Scene) -> Any:
    """`count` dependent evaluations, each at the state after the previous one."""

    def step(_: Any, state: Any) -> Any:
        q, qd = state
        return q + STEP * qd, qd + STEP * fn(q, qd, chain)

    return jax.lax.fori_loop(0, count, step, (q, qd))


def _mujoco(n: int, q: np.ndarray, qd: np.ndarray, single: int) -> Made:
    """MuJoCo with nested bodies on hinges, without contacts and constraints; its angles are relative."""
    import mujoco as engine
    from mujoco.rollout import Rollout

    mujoco: Any = engine  # its names are made at run time
    p, bodies = chain_numbers(n), ""
    for i in range(n):
        above = 0.0 if i == 0 else p["l"][i - 1]
        bodies += (
            f'<body pos="0 0 {-float(above)!r}"><joint type="hinge" axis="0 -1 0"/>'
            f'<inertial pos="0 0 {-float(p["l"][i])!r}" mass="{float(p["m"][i])!r}" diaginertia="1e-12 1e-12 1e-12"/>'
        )
    model = mujoco.MjModel.from_xml_string(
        f'<mujoco><compiler angle="radian"/><option timestep="{STEP}" gravity="0 0 {-G}" integrator="Euler">'
        '<flag contact="disable" constraint="disable"/></option>'
        f"<worldbody>{bodies}{'</body>' * n}</worldbody></mujoco>"
    )
    data, threads = mujoco.MjData(model), os.cpu_count() or 1
    workers, pool = [mujoco.MjData(model) for _ in range(threads)], Rollout(nthread=threads)
    own_q, own_qd = np.diff(q, axis=1, prepend=0.0), np.diff(qd, axis=1, prepend=0.0)
    states = np.hstack([np.zeros((len(q), 1)), own_q, own_qd])  # time, angles, rates

    def place() -> None:
        data.qpos, data.qvel = own_q[0], own_qd[0]

    def loop() -> None:
        place()
        mujoco.mj_step(model, data, single)

    place()
    mujoco.mj_forward(model, data)
    found = np.cumsum(data.qacc)[None]
    many = lambda: pool.rollout(model, workers, states, nstep=1, skip_checks=False)  # noqa: E731
    return {LOOP: loop, BATCH: many}, found
