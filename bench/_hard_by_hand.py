"""Hard cases that are no run of a scene, written by hand for diffrax and scipy, and those that MuJoCo can express."""

import math
import xml.etree.ElementTree as ET
from collections.abc import Callable
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu
import mujoco
import numpy as np
import optimistix as optx
from _hard_plain import ATOL, PLAIN, RTOL
from scipy.integrate import solve_ivp

import jaxmodsim as jms
from jaxmodsim import problems
from jaxmodsim.validation.hard import SceneTask

G = 9.81
# Units of length, time and mass of the cases `units_...`.
UNITS = {
    "units_nanometres": (2.0**-30, 1.0, 1.0),
    "units_kilometres": (2.0**10, 1.0, 2.0**20),
    "units_microseconds": (2.0**-20, 2.0**-20, 2.0**-30),
}
NAN, INF = math.nan, math.inf


# Events.


def _leg_by_scipy(method: str, guard: Callable[[Any], Any], t: float, y: Any, t1: float) -> tuple[float, Any, bool]:
    """A throw up to where the guard falls through zero: time, state, and whether it did."""

    def event(t: float, y: Any) -> Any:
        del t
        return guard(y)

    event.terminal, event.direction = True, -1  # type: ignore[attr-defined]
    done = solve_ivp(lambda t, y: [y[1], -G], (t, t1), y, method, events=event, rtol=RTOL, atol=ATOL)  # noqa: ARG005
    if not done.success:
        raise RuntimeError(done.message)
    return float(done.t[-1]), done.y[:, -1], done.status == 1


def _throw(t: Any, y: Any, args: Any) -> Any:
    del t, args
    return jnp.stack([y[1], jnp.full_like(y[1], -G)])


@eqx.filter_jit
def _leg(guard: Callable[[Any], Any], t: Any, y: Any, t1: Any) -> Any:
    return dfx.diffeqsolve(
        dfx.ODETerm(_throw),
        dfx.Tsit5(),
        t,
        t1,
        None,
        y,
        stepsize_controller=dfx.PIDController(RTOL, ATOL),
        event=dfx.Event(lambda t, y, args, **_: guard(y), optx.Newton(RTOL, ATOL), False),  # noqa: ARG005
        throw=False,
    )


def _leg_by_diffrax(guard: Callable[[Any], Any], t: float, y: Any, t1: float) -> tuple[float, Any, bool]:
    """The same by diffrax."""
    done = _leg(guard, jnp.asarray(t), jnp.asarray(y), jnp.asarray(t1))
    met = bool(done.result == dfx.RESULTS.event_occurred)
    if not met and done.result != dfx.RESULTS.successful:
        raise RuntimeError(dfx.RESULTS[done.result])
    return float(done.ts[-1]), np.asarray(done.ys[-1]), met


def _by(program: str) -> Callable[..., tuple[float, Any, bool]]:
    if program.startswith("scipy"):
        return lambda *given: _leg_by_scipy(program.split()[1], *given)
    return _leg_by_diffrax


def _height(y: Any) -> Any:
    return y[0]


def _below_ceiling(y: Any) -> Any:
    return 1.0 - y[0]


def _ball(program: str) -> tuple[float, float]:
    """Time of the last bounce [s], and height at 2 s [m]."""
    leg, t, y, last = _by(program), 0.0, np.array([1.0, 0.0]), NAN
    while t < 2.0:
        t, y, met = leg(_height, t, y, 2.0)
        if met:
            y, last = np.array([0.0, -0.5 * y[1]]), t
    return last, float(y[0])


def _touch(program: str) -> float:
    """When the ceiling is touched [s]; NaN where that is not seen."""
    v0 = math.sqrt(2.0 * G) * (1.0 + 1e-8)
    t, _, met = _by(program)(_below_ceiling, 0.0, np.array([0.0, v0]), 1.0)
    return t if met else NAN


# Numbers.


def _spring(**params: Any) -> jms.Scene:
    return problems.braked_spring(problems.braked_spring_law(), **params)


def _in_units(program: str, name: str) -> float:
    """Position at 30 s [m] of the mass on a spring, from a run in other units."""
    length, time, mass = UNITS[name]
    p, force = problems.BRAKED_SPRING, mass * length / time**2
    law = jms.Coulomb(p["Fc"] * force, p["Fs"] * force)
    scene = problems.braked_spring(law, m=p["m"] * mass, k=p["k"] * mass / time**2)
    return float(PLAIN[program](scene, [length], [0.0], 30.0 * time).q[-1, 0]) / length


def _twice(program: str) -> float:
    rows = np.asarray(PLAIN[program](_spring(), [1.0], [0.0], 1.0, ts=[0.5, 0.5, 1.0, 1.0]).q)[:, 0]
    return float(np.max(np.abs(np.diff(rows)[[0, 2]])))


def by_hand(program: str) -> dict[str, Callable[[], float]]:
    """What gives the answer of the cases that are no `SceneTask`, by name."""
    units = {name: lambda name=name: _in_units(program, name) for name in UNITS}
    return units | {
        "bouncing_ball": lambda: _ball(program)[0],
        "bouncing_ball_unheld": lambda: _ball(program)[1],
        "grazing_ceiling": lambda: _touch(program),
        "times_repeated": lambda: _twice(program),
    }


# Garbage: calls of which none has an answer.


def _poisoned(scene: jms.Scene, where: Callable[[Any], Any], value: float) -> jms.Scene:
    return eqx.tree_at(where, scene, jnp.asarray(value))


def _with_record(t: np.ndarray, values: np.ndarray) -> jms.Scene:
    """A measured pull on the mass."""

    def pull(time: Any, q: Any, qd: Any, p: Any) -> Any:
        del q, qd, p
        return jnp.reshape(jnp.interp(time, t, values), (1,))

    scene = _spring()
    return jms.Scene(scene.lagrangian, params=scene.params, effects=(jms.AppliedForce(pull), *scene.effects))


def garbage(program: str) -> dict[str, dict[str, Callable[[], Any]]]:
    """By case and name, calls that should raise an error; their result is the last position."""
    plain = PLAIN[program]

    def end(scene: Any = None, q0: Any = (1.0,), qd0: Any = (0.0,), t1: Any = 1.0, **settings: Any) -> Any:
        run = plain(scene or _spring(), np.asarray(q0), np.asarray(qd0), t1, **settings)
        return np.asarray(run.q)[-1:, 0]

    spring, box = _spring(), problems.ramped_box(problems.box_lugre())
    t = np.linspace(0.0, 1.0, 11)
    hole = np.where(t == 0.5, NAN, t)
    single = jtu.tree_map(lambda x: x.astype(np.float32), spring)
    return {
        "nan_parameters": {
            "law": lambda: end(_poisoned(spring, lambda s: s.effects[-1].law.Fc, NAN)),
            "infinite law": lambda: end(_poisoned(box, lambda s: s.effects[-1].law.sigma0, INF), q0=(0.0,)),
            "put in later": lambda: end(_poisoned(spring, lambda s: s.params["k"], NAN)),
            "infinite, put in later": lambda: end(_poisoned(spring, lambda s: s.params["k"], INF)),
        },
        "nan_states": {
            "q0": lambda: end(q0=(NAN,)),
            "qd0": lambda: end(qd0=(INF,)),
            "t1": lambda: end(t1=INF),
            "rtol": lambda: end(rtol=NAN),
            "dt": lambda: end(dt=0.0),
        },
        "nan_records": {
            "time": lambda: end(_with_record(hole, t)),
            "signal": lambda: end(_with_record(t, hole)),
        },
        "times_unfit": {
            "empty": lambda: end(ts=[]),
            "unsorted": lambda: end(ts=[0.5, 0.2]),
            "outside": lambda: end(ts=[0.5, 2.0]),
            "before": lambda: end(ts=[-0.5, 0.5]),
        },
        "late_start_single": {
            "clock": lambda: end(single, np.ones(1, np.float32), np.zeros(1, np.float32), 1e9 + 30.0, t0=1e9),
        },
    }


# MuJoCo, at the step and by the method that it has by default.

_SLIDE = """
<mujoco>
  <option gravity="0 0 0"/>
  <worldbody><body><joint name="slide" type="slide" axis="1 0 0"/><geom size="0.1" mass="1"/></body></worldbody>
</mujoco>
"""
_BALL = """
<mujoco>
  <option gravity="0 0 -{g!r}"/>
  <worldbody><body><joint type="ball"/><geom name="bob" pos="{x!r} 0 {z!r}" size="0.001" mass="1"/></body></worldbody>
</mujoco>
"""


def _advance(model: Any, data: Any, t1: float, ramp: float) -> None:
    """Run to `t1` under a force that grows by `ramp` [N/s]; an error where MuJoCo says that something is wrong."""
    step = model.opt.timestep
    for i in range(round(t1 / step)):
        if ramp:
            data.qfrc_applied[0] = ramp * (i + 0.5) * step
        mujoco.mj_step(model, data)
    if any(warning.number for warning in data.warning):
        raise RuntimeError("MuJoCo warns: nan, inf or huge value, the simulation is unstable.")


def _slider(task: SceneTask) -> float:
    """A mass on a slide, on a spring or under a force that rises; friction as `to_mujoco` writes it."""
    scene, params = task.scene, task.scene.params
    model, element = ET.fromstring(_SLIDE), ET.fromstring(jms.to_mujoco(scene.effects[-1].law, "slide"))
    joint, geom = model.find("worldbody/body/joint"), model.find("worldbody/body/geom")
    assert joint is not None
    assert geom is not None
    geom.set("mass", repr(float(params["m"])))
    joint.set("stiffness", repr(float(params.get("k", 0.0))))
    if element.tag == "actuator":
        model.append(element)
    else:
        joint.attrib.update(element.attrib)
    compiled = mujoco.MjModel.from_xml_string(ET.tostring(model, encoding="unicode"))
    data = mujoco.MjData(compiled)
    data.qpos[0], data.qvel[0] = float(task.q0[0]), float(task.qd0[0])
    _advance(compiled, data, float(task.t1), float(params.get("ramp", 0.0)))
    return float(data.qpos[0] if "k" in params else data.qvel[0])


def _pendulum(turn: float) -> float:
    """Height of the spherical pendulum at 1 s [m], on a ball joint, which has no pole."""
    phi = 1.8
    model = mujoco.MjModel.from_xml_string(_BALL.format(g=G, x=math.sin(phi), z=math.cos(phi)))
    data = mujoco.MjData(model)
    data.qvel[2] = turn
    _advance(model, data, 1.0, 0.0)
    mujoco.mj_forward(model, data)
    return float(data.geom("bob").xpos[2])


_SLIDERS = (
    "bristle_soft",
    "bristle_stiff",
    "bristle_overdamped",
    "stribeck_narrow",
    "mass_tiny",
    "mass_huge",
    "zero_start",
    "vanishing_friction",
)
_PENDULUMS = ("pole_passed", "pole_cartesian")
IN_MUJOCO = (*_SLIDERS, *_PENDULUMS)


def by_mujoco(name: str, task: SceneTask) -> float:
    """The answer of one of the cases `IN_MUJOCO`."""
    if name == "pole_passed":
        return math.acos(_pendulum(float(task.qd0[1])))
    if name == "pole_cartesian":
        return _pendulum(float(task.qd0[1]) / math.sin(1.8))
    return _slider(task)
