"""Scenes as people run them without `simulate`: by diffrax and scipy, with friction by the sign of slip.

The right-hand side is that of `vector_field`, which is more than most would write: mass matrices are solved with care,
constraints are differentiated twice. Missing are the events, and the projection onto the constraints.
"""

from collections.abc import Callable
from functools import partial
from types import SimpleNamespace
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from scipy.integrate import solve_ivp

import jaxmodsim as jms
from jaxmodsim.friction import AbstractSetValuedLaw
from jaxmodsim.scene import State, vector_field

RTOL, ATOL = 1e-6, 1e-9
MAX_STEPS = 1_000_000


def with_signs(scene: jms.Scene) -> jms.Scene:
    """The scene with `Fc sign(v)` in the place of every set-valued law."""
    return eqx.tree_at(lambda scene: scene.effects, scene, tuple(_with_sign(effect) for effect in scene.effects))


def _with_sign(effect: Any) -> Any:
    if isinstance(effect, jms.Friction) and isinstance(effect.law, AbstractSetValuedLaw):
        return eqx.tree_at(lambda effect: effect.law, effect, jms.Sign(effect.law))
    return effect


def _start(scene: jms.Scene, q0: Any, qd0: Any) -> State:
    q, qd = jnp.asarray(q0), jnp.asarray(qd0)
    dtype = jnp.result_type(q, float) if q.dtype != jnp.float32 else q.dtype
    return State(q.astype(dtype), qd.astype(dtype), scene.initial_state(q.astype(dtype)))


def _rate(t: Any, y: State, scene: jms.Scene) -> State:
    return vector_field(t, y, scene, None)


def _run(t_end: Any, states: State) -> SimpleNamespace:
    """What the answer of a case is read of, with a leading axis of time as a `Trajectory` has."""
    return SimpleNamespace(q=states.q, qd=states.qd, z=states.z, t_end=t_end)


def by_diffrax(
    scene: jms.Scene,
    q0: Any,
    qd0: Any,
    t1: Any,
    *,
    solver: dfx.AbstractSolver,
    t0: Any = 0.0,
    ts: Any = None,
    rtol: Any = RTOL,
    dt: Any = None,
) -> SimpleNamespace:
    """Run by `diffeqsolve`.

    **Raises:**

    - `RuntimeError` with diffrax's words where it did not reach `t1`.
    """
    y0 = _start(scene, q0, qd0)
    solution = dfx.diffeqsolve(
        dfx.ODETerm(_rate),
        solver,
        jnp.asarray(t0, y0.q.dtype),
        jnp.asarray(t1, y0.q.dtype),
        dt,
        y0,
        args=with_signs(scene),
        saveat=dfx.SaveAt(t1=True) if ts is None else dfx.SaveAt(ts=jnp.asarray(ts, y0.q.dtype)),
        stepsize_controller=dfx.PIDController(rtol, ATOL) if dt is None else dfx.ConstantStepSize(),
        max_steps=MAX_STEPS,
        throw=False,
    )
    if solution.result != dfx.RESULTS.successful:
        raise RuntimeError(dfx.RESULTS[solution.result])
    assert solution.ys is not None
    return _run(t1, solution.ys)


def by_scipy(
    scene: jms.Scene,
    q0: Any,
    qd0: Any,
    t1: Any,
    *,
    method: str,
    t0: Any = 0.0,
    ts: Any = None,
    rtol: Any = RTOL,
    dt: Any = np.inf,
) -> SimpleNamespace:
    """Run by `solve_ivp`; `dt` is its longest step.

    **Raises:**

    - `RuntimeError` with scipy's words where it did not reach `t1`.
    """
    y0, scene = _start(scene, q0, qd0), with_signs(scene)
    flat, unravel = ravel_pytree(y0)

    @jax.jit
    def field(t: Any, y: Any) -> Any:
        return ravel_pytree(_rate(t, unravel(y), scene))[0]

    span = tuple(float(np.asarray(t, flat.dtype)) for t in (t0, t1))
    given = None if ts is None else np.asarray(ts, float)
    done = solve_ivp(
        lambda t, y: np.asarray(field(t, y)), span, np.asarray(flat), method, given, rtol=rtol, atol=ATOL, max_step=dt
    )
    if not done.success:
        raise RuntimeError(done.message)
    ends = done.y if ts is not None else done.y[:, -1:]
    if not np.size(ends):  # no times, no rows
        return _run(t1, State(np.zeros((0, 1)), np.zeros((0, 1)), {}))
    return _run(t1, jax.vmap(unravel, in_axes=1)(jnp.asarray(ends)))


PLAIN: dict[str, Callable[..., SimpleNamespace]] = {
    "diffrax Tsit5": partial(by_diffrax, solver=dfx.Tsit5()),
    "diffrax Kvaerno5": partial(by_diffrax, solver=dfx.Kvaerno5()),
    "scipy RK45": partial(by_scipy, method="RK45"),
    "scipy LSODA": partial(by_scipy, method="LSODA"),
}
# The others are asked everything; this one where rates are high.
IMPLICIT = "diffrax Kvaerno5"
