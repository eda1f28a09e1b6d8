"""The same cases in other programs: SciPy with terminal events, MuJoCo with fixed steps, CVODES of CasADi.

Each maker returns a function of the tolerance, or of the step, that runs the case and returns its outputs.
"""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from bench.peers import by_casadi
from bench.studies.bouncing_ball import restitution
from bench.tasks import Box
from jaxmodsim.problems import bristles

Run = Callable[[float], np.ndarray]


class _Legs:
    """A run of SciPy in legs that end at a time, or at an event, whose guard falls through zero."""

    def __init__(self, y0: Any, rtol: float, method: str) -> None:
        self.t, self.y = 0.0, np.array(y0, float)
        self.options: dict[str, Any] = {"rtol": max(rtol, 3e-14), "atol": 1e-2 * rtol, "method": method}

    def leg(self, field: Any, end: float, guard: Any = None) -> bool:
        """Advance; says whether the event came first."""
        if guard is not None:
            guard.terminal, guard.direction = True, -1.0
        done = solve_ivp(field, (self.t, end), self.y, events=guard, **self.options)
        self.t, self.y = float(done.t[-1]), done.y[:, -1].copy()
        return done.status == 1


def scipy_friction(method: str) -> Run:
    """`Rotational.Friction`: motor, clutch, spring and brake."""
    c, d = 160.0, 1.0

    def field(clutch, braking, motor, stuck, held):
        def rate(t, y):
            spring = c * (y[1] - y[2]) + d * (y[4] - y[5])
            drive = 200.0 * math.sin(100.0 * t) * motor
            a3, a2 = drive + clutch, (-spring - clutch) / 0.05
            if stuck:
                a3 = a2 = (drive - spring) / 1.05
            return [y[3], y[4], y[5], a3, a2, 0.0 if held else spring - braking]

        return rate

    def within(motor):
        """The torque of the stuck clutch above its limit of -80 N m."""

        def margin(t, y):
            spring = c * (y[1] - y[2]) + d * (y[4] - y[5])
            return (-spring - 0.05 * 200.0 * math.sin(100.0 * t) * motor) / 1.05 + 80.0

        return margin

    def run(rtol: float) -> np.ndarray:
        r = _Legs([0.0, 0.0, 0.0, 100.0, 90.0, 90.0], rtol, method)

        def slip(t, y):
            return y[3] - y[4]

        r.leg(field(-80.0, 0, 1, False, False), 0.5, slip)
        r.leg(field(0, 0, 1, True, False), 0.5, within(1))
        r.leg(field(-80.0, 0, 1, False, False), 0.5, slip)
        r.leg(field(0, 0, 1, True, False), 0.5)
        r.leg(field(0, 800.0, 0, True, False), 3.0, within(0))
        r.leg(field(-80.0, 800.0, 0, False, False), 3.0, lambda t, y: y[5])
        r.y[5] = 0.0
        r.leg(field(-80.0, 0, 0, False, True), 3.0, slip)
        r.leg(field(0, 0, 0, True, True), 3.0)
        y = r.y
        return np.array([y[1] - y[0], y[0], y[3], y[2] - y[1], y[5] - y[4]])

    return run


def scipy_two_balls(method: str) -> Run:
    """`nosnoc two_balls_cls`."""

    def field(t, y):
        spring = 1e4 * (y[1] - y[0] - 1.0)
        return [y[2], y[3], spring - 9.81, -spring - 9.81]

    def run(rtol: float) -> np.ndarray:
        r = _Legs([1.0, 2.0, 0.0, 0.0], rtol, method)
        while r.leg(field, 1.0, lambda t, y: y[0] - 0.2):
            r.y[0], r.y[2] = 0.2, -0.8 * r.y[2]
        return r.y

    return run


def scipy_slip_stick(method: str) -> Run:
    """`nosnoc periodic_slip_stick_codim1`."""

    def slip(sign):
        return lambda t, y: [y[1], -y[0] - sign / (1.0 + sign * (y[1] - 0.2))]

    def run(rtol: float) -> np.ndarray:
        r, sign = _Legs([-0.8, -1.0], rtol, method), -1.0
        while r.t < 40.0:
            if r.leg(slip(sign), 40.0, lambda t, y, s=sign: s * (y[1] - 0.2)):
                r.y[1] = 0.2
                if abs(r.y[0]) < 1.0:
                    r.leg(lambda t, y: [y[1], 0.0], 40.0, lambda t, y: 1.0 - y[0])
                sign = -1.0 if r.y[0] > 0 else 1.0
        return r.y

    return run


def scipy_bounce(method: str) -> Run:
    """`diff_sim_grads task1`."""

    def run(rtol: float) -> np.ndarray:
        r = _Legs([1.0, -2.0], rtol, method)
        while r.leg(lambda t, y: [y[1], 0.0], 1.0, lambda t, y: y[0] - 0.1):
            r.y = np.array([0.1, -r.y[1]])
        return r.y[:1]

    return run


def scipy_lugre(method: str) -> Run:
    """`EXUDYN lugreFrictionTest`."""
    sigma0, sigma1 = 1e5, math.sqrt(1e5)

    def field(t, y):
        level = 1.0 + 0.5 * math.exp(-((y[1] / 1e-3) ** 2))
        rate = y[1] - sigma0 * abs(y[1]) / level * y[2]
        return [y[1], 2.0 * (0.1 * t - y[0]) - sigma0 * y[2] - sigma1 * rate - 0.4 * y[1], rate]

    def run(rtol: float) -> np.ndarray:
        done = solve_ivp(field, (0.0, 25.0), [0.0] * 3, method, rtol=max(rtol, 3e-14), atol=1e-4 * rtol)
        return done.y[:2, -1]

    return run


def cvodes_lugre() -> Run:
    """`EXUDYN lugreFrictionTest`."""
    numbers = (1e5, math.sqrt(1e5), 0.4, 1.0, 1.5, 1e-3)
    peer = by_casadi(Box(bristles.pulled_box, numbers, 1.0, 0.2, 2.0, 25.0, 2, 1e-4, 1e-6, 1e-7))
    return lambda rtol: np.asarray(peer.record(rtol)[0])[-1, :2]


def _model(xml: str, step: float) -> tuple[Any, Any, Any]:
    import mujoco as engine

    mujoco: Any = engine
    head = f'<mujoco><option timestep="{step}" gravity="0 0 {{g}}" integrator="implicitfast" tolerance="1e-12"/>'
    model = mujoco.MjModel.from_xml_string(head.format(g=-9.81 if "ground" in xml else 0.0) + xml + "</mujoco>")
    return mujoco, model, mujoco.MjData(model)


def mujoco_friction(step: float) -> Callable[[], np.ndarray]:
    """`Rotational.Friction`: friction of a tendon between two joints, and of a joint."""
    # Friction constraints as hard as the step allows.
    hard = f'solimpfriction="0.9999 0.9999 0.001" solreffriction="{2.0 * step} 1"'
    bodies = "".join(
        f'<body><joint name="j{i}" {hard} type="hinge" axis="0 0 1"/>'
        f'<inertial pos="0 0 0" mass="1" diaginertia="{x} {x} {x}"/>'
        "</body>" for i, x in enumerate((1.0, 0.05, 1.0))
    )  # fmt: skip
    ties = (
        f'<tendon><fixed frictionloss="80" {hard}><joint joint="j0" coef="-1"/><joint joint="j1" coef="1"/></fixed>'
        '<fixed stiffness="160" damping="1" springlength="0"><joint joint="j1" coef="-1"/><joint joint="j2" coef="1"/>'
        "</fixed></tendon>"
    )
    mujoco, model, data = _model(f"<worldbody>{bodies}</worldbody>{ties}", step)

    def run() -> np.ndarray:
        mujoco.mj_resetData(model, data)
        model.dof_frictionloss[2] = 0.0
        data.qvel[:] = 100.0, 90.0, 90.0
        count = round(3.0 / step)
        for i in range(count):
            on = i * step < 0.5 - 0.5 * step
            data.qfrc_applied[0] = 200.0 * math.sin(100.0 * i * step) if on else 0.0
            if not on:
                model.dof_frictionloss[2] = 800.0
            mujoco.mj_step(model, data)
        q, v = data.qpos, data.qvel
        return np.array([q[1] - q[0], q[0], v[0], q[2] - q[1], v[2] - v[1]])

    return run


def _elastic(step: float, e: float) -> str:
    """A contact as a spring and damper with this restitution.

    It takes ten steps, and more where steps are shorter than 0.1 ms: the restitution depends on where in a step the
    impact falls, and this error falls with the number of steps alone.
    """
    frequency = math.pi / (10.0 * max(1.0, math.sqrt(1e-4 / step)) * step)
    damping = 0.0 if e == 1.0 else brentq(lambda damping: restitution(damping) - e, 1e-6, 0.6)
    return (
        '<default><geom condim="1" solimp="0.9999 0.9999 0.001"'
        f' solref="{-(frequency**2)} {-2.0 * damping * frequency}"/></default>'
    )


def mujoco_two_balls(step: float) -> Callable[[], np.ndarray]:
    """`nosnoc two_balls_cls`: the lower ball strikes a plane that is as elastic as the step allows."""
    balls = "".join(
        f'<body><joint name="j{i}" type="slide" axis="0 0 1"/><geom size="0.2" mass="1" {more}/></body>'
        for i, more in enumerate(("", 'contype="0" conaffinity="0"'))
    )
    tie = (
        '<tendon><fixed stiffness="1e4" springlength="1"><joint joint="j0" coef="-1"/><joint joint="j1" coef="1"/>'
        "</fixed></tendon>"
    )
    plane = '<geom name="ground" type="plane" size="1 1 1"/>'
    xml = f"{_elastic(step, 0.8)}<worldbody>{plane}{balls}</worldbody>{tie}"
    mujoco, model, data = _model(xml, step)

    def run() -> np.ndarray:
        mujoco.mj_resetData(model, data)
        data.qpos[:] = 1.0, 2.0
        mujoco.mj_step(model, data, round(1.0 / step))
        return np.concatenate([data.qpos, data.qvel])

    return run


def mujoco_bounce(step: float) -> Callable[[], np.ndarray]:
    """`diff_sim_grads task1`."""
    xml = (
        f'{_elastic(step, 1.0)}<worldbody><geom type="plane" size="1 1 1"/><body pos="0 0 0.1"><joint type="slide"'
        ' axis="0 0 1"/><geom size="0.1" mass="1"/></body></worldbody>'
    )
    mujoco, model, data = _model(xml, step)

    def run() -> np.ndarray:
        mujoco.mj_resetData(model, data)
        data.qpos[0], data.qvel[0] = 0.9, -2.0
        mujoco.mj_step(model, data, round(1.0 / step))
        return np.array([data.qpos[0] + 0.1])

    return run


# By case: SciPy's run for a method, MuJoCo's for a step, or None where it has no such friction.
PEERS: dict[str, tuple[Callable[[str], Run], Callable[[float], Callable[[], np.ndarray]] | None]] = {
    "Rotational.Friction": (scipy_friction, mujoco_friction),
    "nosnoc two_balls_cls": (scipy_two_balls, mujoco_two_balls),
    "nosnoc periodic_slip_stick_codim1": (scipy_slip_stick, None),
    "diff_sim_grads task1": (scipy_bounce, mujoco_bounce),
    "EXUDYN lugreFrictionTest": (scipy_lugre, None),
}
