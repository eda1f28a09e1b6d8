"""A ball that bounces to rest, by events, a compliant contact by hand, and MuJoCo, for several steps or tolerances.

The ball drops from 1 m with e = 1/2. The compliant contacts have a linear spring and damper for this e, which is
stiffer for smaller steps.
"""

import math
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
from scipy.optimize import brentq

import jaxmodsim as jms
from bench.record import Result, importable, timed
from jaxmodsim.problems import bouncing_ball

E, G, BOUNCING, AT_REST = 0.5, 9.81, 0.8, 2.5


def restitution(damping: float) -> float:
    """Restitution of a spring and damper that do not pull (Schwager and Poeschel, Granular Matter 9:465, 2007)."""
    s = math.sqrt(1.0 - damping**2)
    return math.exp(-damping / s * (math.pi - math.atan(2.0 * damping * s / (1.0 - 2.0 * damping**2))))


# Damping relative to critical damping.
DAMPING = brentq(lambda damping: restitution(damping) - E, 0.01, 0.6)
# (h, t) -> height and velocity at t, after a drop from h.
Run = Callable[[Any, float], Any]
_SCENE = bouncing_ball.scene(e=E)


def main(smoke: bool, out: Path) -> Result:
    """Measure errors of height and derivative between bounces, height and energy at rest, and the time of a run."""
    del out
    result = Result("bouncing_ball", ("mujoco", "diffrax"), {"bouncing": BOUNCING, "rest": AT_REST})
    steps = (1e-3,) if smoke else (1e-3, 1e-4, 1e-5)
    peers: dict[tuple[str, float], Run] = {("jaxmodsim", rtol): _events(rtol) for rtol in (1e-4, 1e-8)}
    peers |= {("compliant, by hand", dt): jax.jit(partial(_by_hand, dt=dt), static_argnums=1) for dt in steps}
    made = importable(result, {"MuJoCo": lambda: [_mujoco(dt) for dt in steps]})
    peers |= {("MuJoCo", dt): run for dt, run in zip(steps, made.get("MuJoCo", ()), strict=False)}
    height, slope = jax.value_and_grad(lambda h: bouncing_ball.motion(jnp.asarray(BOUNCING), h=h, e=E)[0])(1.0)
    for (peer, at), run in peers.items():
        about = {"peer": peer, "at": at}
        result.add("error of the height", abs(float(run(1.0, BOUNCING)[0] - height)), "m", **about)
        result.add("error of its derivative", abs(_slope(peer, run) - float(slope)), "1", **about)
        rest, velocity = (float(x) for x in run(1.0, AT_REST))
        result.add("height at rest", rest, "m", **about)
        result.add("energy at rest", G * rest + 0.5 * velocity**2, "J", **about)
    calls = {key: partial(run, 1.0, AT_REST) for key, run in peers.items()}
    for (peer, at), found in timed(calls, 3 if smoke else 30).items():
        result.add_time("run", found, peer=peer, at=at)
    return result


def _slope(peer: str, run: Run) -> float:
    if peer == "MuJoCo":  # it has no derivatives through contacts
        return float(run(1.0 + 1e-4, BOUNCING)[0] - run(1.0 - 1e-4, BOUNCING)[0]) / 2e-4
    return float(jax.grad(lambda h: run(h, BOUNCING)[0])(1.0))


def _events(rtol: float) -> Run:
    def run(h: Any, t: float) -> Any:
        end = jms.simulate(_SCENE, jnp.reshape(jnp.asarray(h), (1,)), [0.0], t, rtol=rtol, atol=1e-3 * rtol)
        return jnp.stack([end.q[-1, 0], end.qd[-1, 0]])

    return run


def _frequency(dt: float) -> float:
    """Frequency of the spring [rad/s]: for smaller steps a contact is shorter and has more steps."""
    return math.pi / (0.2 * math.sqrt(dt))


def _by_hand(h: Any, t: float, dt: float) -> Any:
    """Symplectic Euler."""
    frequency = _frequency(dt)

    def step(_: Any, y: Any) -> Any:
        x, v = y
        push = jnp.maximum(-(frequency**2) * x - 2.0 * DAMPING * frequency * v, 0.0)
        v = v + dt * (jnp.where(x < 0, push, 0.0) - G)
        return x + dt * v, v

    return jnp.stack(jax.lax.fori_loop(0, round(t / dt), step, (jnp.asarray(h, float), jnp.zeros(()))))


def _mujoco(dt: float) -> Run:
    import mujoco as engine

    mujoco: Any = engine  # its names are made at run time
    frequency = _frequency(dt)
    model = mujoco.MjModel.from_xml_string(
        f'<mujoco><option timestep="{dt}" gravity="0 0 {-G}"/><default><geom condim="1" solimp="0.99 0.99 0.001"'
        f' solref="{-(frequency**2)} {-2.0 * DAMPING * frequency}"/></default><worldbody><geom type="plane"'
        ' size="1 1 1"/><body pos="0 0 0.1"><joint type="slide" axis="0 0 1"/><geom size="0.1" mass="1"/></body>'
        "</worldbody></mujoco>"
    )
    data = mujoco.MjData(model)

    def run(h: Any, t: float) -> tuple[float, float]:
        mujoco.mj_resetData(model, data)
        data.qpos[0] = h
        mujoco.mj_step(model, data, round(t / dt))
        return float(data.qpos[0]), float(data.qvel[0])

    return run
