"""A servo with a pendulum by SciPy: stick and slip are located as events, from equations written by hand."""

import math

import numpy as np
from scipy.integrate import solve_ivp

PENDULUM = {"inertia": 0.0049, "gravity": 0.49 * 9.80665 * 0.1}
TRUE = {
    "kt": 0.35, "R": 2.6, "armature": 0.0018, "tilt": 0.01, "Kc": 0.012, "Kv": 0.009, "Kcs": 0.008, "vs": 0.4,
    "Km": 0.25, "Ke": 0.06, "Kq": 0.15,
}  # fmt: skip


def clock(seconds: float, rng: np.random.Generator) -> np.ndarray:
    """Uneven times: 5 ms with a scatter of 0.5 ms."""
    steps = 5e-3 + 5e-4 * rng.uniform(-1.0, 1.0, round(seconds / 5e-3))
    return np.concatenate([[0.0], np.cumsum(steps)])


def simulate_servo(
    t: np.ndarray, goal: np.ndarray, volts: np.ndarray, enabled: np.ndarray, kp: float, p: dict[str, float], q0: float
) -> np.ndarray:
    """The angle at the times `t`, inputs held; the law is MQ, whose friction is a function of both torques."""
    mass = PENDULUM["inertia"] + p["armature"]
    angles, q, v = [q0], q0, 0.0
    for k in range(len(t) - 1):
        at, end, inputs = t[k], t[k + 1], (goal[k], volts[k], enabled[k])

        def torques(q: float, v: float, inputs: tuple[float, ...] = inputs) -> tuple[float, float]:
            goal, volts, on = inputs
            duty = min(max(kp * (goal - q) * 4096 / (2 * math.pi) / 256 / 885, -1.0), 1.0)
            return on * p["kt"] * (duty * volts - p["kt"] * v) / p["R"], -PENDULUM["gravity"] * math.sin(q - p["tilt"])

        def dry(q: float, v: float, torques=torques) -> float:
            motor, load = torques(q, v)
            falling = p["Kcs"] * math.exp(-abs(v) / p["vs"])
            return p["Kc"] + abs(p["Km"] * motor - p["Ke"] * load) + falling + p["Kq"] * motor**2

        for _ in range(50):
            drive = sum(torques(q, 0.0))
            if v == 0.0 and abs(drive) <= dry(q, 0.0):
                break  # it sticks: the inputs are held, so it sticks to the end
            side = math.copysign(1.0, v if v != 0.0 else drive)

            def slope(_: float, y: np.ndarray, side: float = side, torques=torques, dry=dry) -> list[float]:
                q, v = y
                return [v, (sum(torques(q, v)) - side * dry(q, v) - p["Kv"] * v) / mass]

            def stops(time: float, y: np.ndarray, side: float = side, at: float = at) -> float:
                return side * y[1] if time > at + 1e-9 else 1.0

            for name, value in (("terminal", True), ("direction", -1.0)):  # as SciPy asks for it
                setattr(stops, name, value)
            run = solve_ivp(slope, (at, end), [q, v], rtol=1e-8, atol=1e-10, events=stops)
            q, v, at = float(run.y[0, -1]), float(run.y[1, -1]), float(run.t[-1])
            if run.status == 0:
                break
            v = 0.0
        angles.append(q)
    return np.array(angles)


def commands(t: np.ndarray, kind: str) -> tuple[np.ndarray, np.ndarray]:
    """Commanded angle, and whether the motor is on."""
    on = np.ones_like(t)
    if kind == "sine":
        return 1.2 * np.sin(2.5 * t) + 0.5 * np.sin(7.0 * t), on
    if kind == "lift":
        return -1.4 * np.sin(np.minimum(t / 1.0, 1.0) * math.pi / 2) ** 2, np.where(t < 1.0, 1.0, 0.0)
    return 1.3 * np.sin(1.4 * t**1.5), on
