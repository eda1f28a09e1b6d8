"""A geared shoulder joint with stiction under PID control: its hunting, and a slow ramp with friction compensated.

Hunting: `continue_orbits` follows the limit cycle over the damping of the controller. Its amplitude falls to zero. The
reference is SciPy, slip by slip with its stop as an event, and for the gain at zero amplitude a closed form: for small
slips friction is linear in the speed, and each slip from rest at x ends at -r x, with r from a cubic.
"""

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

import jaxmodsim as jms
from bench.record import Result
from jaxmodsim.control import check_observer, compensate_friction
from jaxmodsim.scene import State, replace_elements, scene_step

# Break-away at 2.8 N m, within 2.4 to 3.3 N m; near rest friction falls by 7 N m s/rad.
FC, FS, FV, SLOPE = 0.7, 2.8, 0.5, 7.0
VS = (FS - FC) / (SLOPE + FV)
J, MGL, TARGET, KP, KI = 0.4, 9.0, 0.5, 60.0, 250.0
SPAN, SPEED, H, SCIPY = (2.0, 3.1), 0.02, 1e-3, "SciPy with events"
# The law of the ramp is Gaussian in the speed; its steepest fall is SLOPE.
LUGRE = jms.LuGre(sigma0=2000.0, sigma1=60.0, sigma2=FV, Fc=FC, Fs=FS, vs=0.24)
RAMP_GAINS = {"kp": KP, "kd": SPAN[0], "ki": KI}


def main(smoke: bool, out: Path) -> Result:
    """Follow the limit cycle, compare it with SciPy, and run the ramp; a smoke run has neither branch nor long runs."""
    del out
    settings = {"speed": 1e3 * SPEED, "Fs": FS, "slope": SLOPE, "kp": KP, "ki": KI, "kd": SPAN[0]}
    result = Result("shoulder_joint", ("scipy",), settings)
    exact: Any = brentq(lambda kd: slip_ratio(kd) - 1.0, 1.0, 6.0)
    result.add("damping without hunting", exact, "N m s/rad", case="vanishing", peer="closed form")
    if not smoke:
        _hunting(result, exact)
    _ramp(result, 2.0 if smoke else 10.0)
    return result


def _hunting(result: Result, exact: float) -> None:
    branch = jms.continue_orbits(_hunting_scene(), ([0.01, _integral(0.01)], [0.0, 0.01]), "kd", SPAN, settle=60.0,
                                 step=0.1, max_orbits=60)  # fmt: skip
    amplitude = branch.amplitude[:, 0]
    # Amplitude is a smooth function of the gain down to zero.
    last = np.polyfit(amplitude[-4:], branch.values[-4:], 2)
    result.add("damping without hunting", float(last[-1]), "N m s/rad", case="vanishing")
    for k in (0, len(branch.orbits) // 2, -1):
        kd = float(branch.values[k])
        case = {"case": "limit cycle", "at": f"kd = {kd:.3g}"}
        result.add("amplitude", 1e3 * float(amplitude[k]), "mrad", **case)
        result.add("period", float(branch.period[k]), "s", **case)
        size, period = cycle(kd)
        result.add("amplitude", 1e3 * size, "mrad", peer=SCIPY, **case)
        result.add("period", period, "s", peer=SCIPY, **case)
    for part in (0.95, 1.05):
        size, _ = cycle(part * exact)
        result.add("amplitude", 1e3 * size, "mrad", case="limit cycle", peer=SCIPY, at=f"kd = {part * exact:.3g}")


def _hunting_scene() -> jms.Scene:
    def lagrangian(t: Any, q: Any, qd: Any, p: Any) -> Any:
        del t, p
        return 0.5 * J * qd[0] ** 2 + MGL * jnp.cos(TARGET + q[0]) + 0.5 * qd[1] ** 2

    def pid(t: Any, q: Any, qd: Any, p: Any) -> Any:
        """The integral is a coordinate, whose rate a force keeps at the error."""
        del t
        force = -KP * q[0] - KI * q[1] - p["kd"] * qd[0]
        return jnp.stack([force, qd[0] + jnp.sqrt(KP / J) * (q[0] - qd[1])])

    law = jms.Stribeck(Fc=FC, Fs=FS, vs=VS, Fv=FV, exponent=1.0)
    effects = (jms.AppliedForce(pid), jms.Friction(law, along=lambda q: q[0], name="friction"))
    return jms.Scene(lagrangian, {"kd": SPAN[0]}, effects, coordinates=("error [rad]", "integral [rad s]"))


def _integral(x: float) -> float:
    """Integral of the error at which a joint at rest at x breaks away, towards zero error."""
    return (-KP * x - MGL * np.sin(TARGET + x) + np.sign(x) * FS) / KI


def slip(x: float, kd: float) -> tuple[float, float]:
    """A slip from rest at the error x: error at its stop, and time until the next break-away."""
    side, h = -np.sign(x), 1e-6

    def rates(t: float, y: Any) -> list[float]:
        del t
        force = side * (FC + (FS - FC) * np.exp(-abs(y[1]) / VS)) + FV * y[1]
        return [y[1], (-KP * y[0] - kd * y[1] - KI * y[2] - MGL * np.sin(TARGET + y[0]) - force) / J, y[0]]

    def stop(t: float, y: Any) -> float:
        del t
        return y[1] * side

    stop.terminal, stop.direction = True, -1  # pyright: ignore[reportFunctionMemberAccess]
    jerk = -KI * x / J  # at break-away forces balance, and the integral makes the joint move
    y0 = [x + jerk * h**3 / 6.0, jerk * h**2 / 2.0, _integral(x) + x * h]
    run = solve_ivp(rates, (h, 20.0), y0, events=stop, rtol=1e-10, atol=1e-14, method="DOP853")
    (end,) = run.y_events[0]
    return float(end[0]), float(run.t[-1] + (_integral(end[0]) - end[2]) / end[0])


def cycle(kd: float, slips: int = 400) -> tuple[float, float]:
    """Half the range [rad] after many slips, and the duration of two; zero if the errors vanish."""
    x, ends, times = 0.02, [], []
    for _ in range(slips):
        x, time = slip(x, kd)
        ends.append(x)
        times.append(time)
        if abs(x) < 1e-6 or (len(ends) > 1 and ends[-1] * ends[-2] > 0):
            return 0.0, 0.0
        if len(ends) > 3 and abs(ends[-1] - ends[-3]) < 1e-8:
            break
    return 0.5 * abs(ends[-1] - ends[-2]), times[-1] + times[-2]


def slip_ratio(kd: float) -> float:
    """Minus the error at the end of a small slip over that at its start.

    `J x''' + (kd - SLOPE) x'' + k x' + KI x = 0` from `x = 1, x' = x'' = 0` to the next `x' = 0`, by the roots.
    """
    stiffness = KP + MGL * np.cos(TARGET)
    roots = np.roots([J, kd - SLOPE, stiffness, KI])
    weights = np.linalg.solve(np.vander(roots, 3, increasing=True).T, [1.0, 0.0, 0.0])

    def state(t: float, order: int) -> float:
        return float(np.sum(weights * roots**order * np.exp(roots * t)).real)

    t = np.linspace(1e-3, 3.0, 3000)
    first = next(k for k in range(1, len(t)) if state(t[k], 1) > 0.0)
    stop: Any = brentq(lambda t: state(t, 1), t[first - 1], t[first])
    return -state(stop, 0)


def _ramp(result: Result, t1: float) -> None:
    joint = jms.Scene(_energy, {"J": J, "u": 0.0}, (jms.AppliedForce(_motor), jms.Friction(LUGRE)))

    @jax.jit
    def tracked(share: Any) -> Any:
        zero, h = jnp.array(0.0), jnp.array(H)

        def period(carry: Any, t: Any) -> Any:
            y, z, integral = carry
            plan = State((TARGET + SPEED * t)[None], jnp.array([SPEED]), z)
            force, z = compensate_friction(joint, zero, h, plan, share=share)
            error = y.q[0] - plan.q[0]
            integral = integral + h * error
            pid = RAMP_GAINS["kp"] * error + RAMP_GAINS["kd"] * (y.qd[0] - SPEED) + RAMP_GAINS["ki"] * integral
            u = MGL * jnp.sin(y.q[0]) - pid + force[0]
            y, _ = scene_step(replace_elements(joint, {"u": u}), zero, h, y)
            return (y, z, integral), (y.q[0], y.qd[0], error)

        z = joint.initial_state(jnp.zeros(1))
        start = State(jnp.array([TARGET]), jnp.zeros(1), z)
        return jax.lax.scan(period, (start, z, zero), jnp.arange(0.0, t1, H))[1]

    for share in (0.0, 0.8, 1.0, 1.2):
        q, speed, error = (np.asarray(x)[int(0.2 * t1 / H) :] for x in tracked(share))
        case = {"case": "ramp", "at": f"{share:g}"}
        result.add("stair", 1e3 * stair(q, speed), "mrad", **case)
        result.add("tracking error", 1e3 * float(np.abs(error).max()), "mrad", **case)
        named = "Over-compensation" in check_observer(LUGRE, J, **RAMP_GAINS, level=share).condition
        result.add("over-compensation", "named" if named else "-", **case)


def stair(q: np.ndarray, speed: np.ndarray) -> float:
    """Largest distance between two sticks, which are slower than a tenth of the ramp; zero without a stick."""
    sticks = np.flatnonzero(np.abs(speed) < 0.1 * SPEED)
    return float(np.diff(q[sticks]).max()) if len(sticks) > 1 else 0.0


def _energy(t: Any, q: Any, qd: Any, p: Any) -> Any:
    del t
    return 0.5 * p["J"] * qd[0] ** 2 + MGL * jnp.cos(q[0])


def _motor(t: Any, q: Any, qd: Any, p: Any) -> Any:
    del t, q, qd
    return jnp.reshape(p["u"], (1,))
