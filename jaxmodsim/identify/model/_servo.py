"""Models of a position servo that turns a pendulum: motor, position loop of the firmware, gear friction."""

from collections.abc import Mapping

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.ndimage import gaussian_filter1d, percentile_filter

from ..._core.parameters import AbstractRanged, Number, parameter
from ...friction import ServoGear
from ..data._record import SINGLE, Record, Runs
from ._engines import ModelOutput, with_values

# Duty of the motor per radian and gain of the firmware: 4096 counts a turn, gain in 1/256, full duty 885.
DUTY_PER_RADIAN = 4096 / (2 * np.pi) / 256 / 885
# Percentile and length [s] of the moving window that show the supply while the bridge conducts.
_CONDUCTING, _SPAN = 10, 0.2
# Names of the start in the inputs of a record: constant columns.
_START = ("start.q", "start.qd")

# Free parameters of the gear by law. M1 to M6: Duclusaud and others 2025, see `ServoGear`.
SERVO_LAWS: dict[str, tuple[str, ...]] = {
    "M1": ("Kc", "Kv"),
    "M2": ("Kc", "Kv", "Kcs", "vs", "alpha"),
    "M3": ("Kc", "Kv", "Km"),
    "M4": ("Kc", "Kv", "Kcs", "vs", "alpha", "Km", "Kms"),
    "M5": ("Kc", "Kv", "Kcs", "vs", "alpha", "Km", "Kms", "Ke", "Kes"),
    "M6": ("Kc", "Kv", "Kcs", "vs", "alpha", "Km", "Kms", "Ke", "Kes", "Kmq", "Keq"),
    "MQ": ("Kc", "Kv", "Kcs", "vs", "Km", "Ke", "Kq"),
}
# Start values.
_GEAR_START = {
    "Kc": 0.01, "Kv": 0.008, "Kcs": 0.01, "vs": 0.5, "alpha": 1.0, "Km": 0.3, "Kms": 0.05, "Ke": 0.05, "Kes": 0.05,
    "Kmq": 0.5, "Keq": 0.5,
}  # fmt: skip


class Servo(AbstractRanged):
    """A servo whose gear turns a pendulum: `(inertia + armature) q'' = motor - gravity sin(q - tilt) - friction`.

    The motor torque is `kt (duty volts - kt q')/R` while the torque is enabled, and zero otherwise. The firmware sets
    `duty = clip(kp (q_goal - q) 4096/(2 pi)/256/885, -1, 1)`. The friction is that of `gear` under the torques of motor
    and gravity, plus `Kq motor^2`.

    **Arguments:**

    - `gear`: a `ServoGear`; its torques are replaced by those of the servo.
    - `inertia`: of the pendulum [kg m^2], > 0. `gravity`: torque at a right angle [N m], >= 0.
    - `kt`: torque constant at the output [N m/A], > 0. `R`: resistance of the winding [ohm], > 0.
    - `armature`: inertia of the rotor at the output [kg m^2], >= 0. `tilt`: angle of the lowest position [rad].
    - `Kq`: friction per squared motor torque [1/(N m)], >= 0.

    **Raises:**

    - `ValueError` if a number is out of range.
    """

    gear: ServoGear
    inertia: Number = parameter("inertia", "kg m^2", lower=0.0, strict=True)
    gravity: Number = parameter("gravity", "N m", lower=0.0)
    kt: Number = parameter("kt", "N m/A", lower=0.0, strict=True, default=0.3)
    R: Number = parameter("R", "ohm", lower=0.0, strict=True, default=2.2)
    armature: Number = parameter("armature", "kg m^2", lower=0.0, default=0.002)
    tilt: Number = parameter("tilt", "rad", default=0.02)
    Kq: Number = parameter("Kq", "1/(N m)", lower=0.0, default=0.0)

    @classmethod
    def start(cls, law: str, inertia: float, gravity: float) -> "Servo":
        """Start values of a fit with one of `SERVO_LAWS`."""
        names = SERVO_LAWS[law]
        own = {name for name in names if name != "Kq"} | ({"alpha"} if "vs" in names else set())
        gear = ServoGear(0.0, 0.0, **{name: _GEAR_START[name] for name in own})
        return cls(gear, inertia, gravity, Kq=0.2 if "Kq" in names else 0.0)

    @staticmethod
    def free(law: str) -> tuple[str, ...]:
        """Names of the parameters that a fit with one of `SERVO_LAWS` changes."""
        return ("kt", "R", "armature", "tilt", *("Kq" if k == "Kq" else f"gear.{k}" for k in SERVO_LAWS[law]))

    def motor(self, duty: Array, volts: Array, enabled: Array, qd: Array) -> Array:
        """Torque of the motor [N m]."""
        return enabled * self.kt / self.R * (duty * volts - self.kt * qd)

    def friction(self, motor: Array, external: Array, qd: Array) -> Array:
        """Magnitude of the dry part of the friction [N m]."""
        gear = eqx.tree_at(lambda gear: (gear.motor, gear.external), self.gear, (motor, external))
        return gear.sliding_force(qd) + self.Kq * motor**2

    def step(self, q: Array, qd: Array, h: Array, inputs: Mapping[str, Array]) -> tuple[Array, Array]:
        """One step of the time stepping of Moreau: friction is at most what brings the velocity to zero.

        Torques are those of the angle in the middle of the step; viscous friction and induced voltage are implicit.
        """
        middle = q + 0.5 * h * qd
        if "kp" in inputs:
            duty = jnp.clip(inputs["kp"] * (inputs["q_goal"] - middle) * DUTY_PER_RADIAN, -1.0, 1.0)
        else:
            duty = inputs["duty"]
        enabled, mass = inputs["torque_enable"], self.inertia + self.armature
        motor, external = self.motor(duty, inputs["volts"], enabled, qd), -self.gravity * jnp.sin(middle - self.tilt)
        damped = mass + 0.5 * h * (self.gear.Kv + enabled * self.kt**2 / self.R)
        free = qd + h * (motor + external - self.gear.viscous_force(qd)) / damped
        most = h * self.friction(motor, external, qd) / damped
        after = jnp.where(jnp.abs(free) <= most, 0.0, free - jnp.sign(free) * most)
        after = jnp.where(h > 0, after, qd)
        return q + 0.5 * h * (qd + after), after


class ServoEngine(eqx.Module):
    """A servo over the samples of a record, in equal steps between two of them; inputs are held."""

    model: Servo
    substeps: int = eqx.field(static=True, default=3)

    def __call__(self, values: dict[str, Array], start: None, run: Runs) -> ModelOutput:
        """The angle with these values."""
        del start
        servo = with_values(self.model, values)
        inputs = {name: x for name, x in run.inputs.items() if name not in _START}

        def advance(carry: tuple[Array, Array], sample: tuple[Array, dict[str, Array]]) -> tuple[tuple, Array]:
            (q, qd), (dt, held) = carry, sample
            before = q
            for _ in range(self.substeps):
                q, qd = servo.step(q, qd, dt / self.substeps, held)
            return (q, qd), before

        dt = jnp.diff(run.t, append=run.t[-1:])
        begin = run.inputs["start.q"][0], run.inputs["start.qd"][0]
        _, angle = jax.lax.scan(advance, begin, (dt, inputs))
        return ModelOutput({SINGLE: angle}, {}, None)


def conducting_voltage(t: Float[np.ndarray, " samples"], volts: Float[np.ndarray, " samples"]) -> np.ndarray:
    """The supply while the bridge conducts, from samples that alias its ripple.

    The samples of a supply under pulse width modulation jump between the voltage of the pulses and that of the pauses,
    which is higher. Only the former drives the motor: a low percentile over 0.2 s, smoothed.
    """
    span = max(round(_SPAN / float(np.median(np.diff(t)))), 1)
    return gaussian_filter1d(percentile_filter(np.asarray(volts, float), _CONDUCTING, span), span / 4)


def servo_record(
    t: np.ndarray,
    q: np.ndarray | None,
    q_goal: np.ndarray,
    volts: np.ndarray,
    torque_enable: np.ndarray,
    *,
    kp: float | None = None,
    duty: np.ndarray | None = None,
    q0: float | None = None,
    name: str = "record",
) -> Record:
    """A record of a servo, which starts at rest.

    **Arguments:**

    - `t`: times [s], at any distances. `q`: angle [rad]; None for a prediction. `q_goal`: command [rad].
    - `volts`: supply [V] as sampled. `torque_enable`: 0 while the motor is off.
    - `kp`: gain of the firmware, to simulate the position loop; or `duty`: the measured duty from -1 to 1.
    - `q0`: angle at the first sample [rad]; by default that of q, or of q_goal.

    **Returns:**

    A `Record` whose inputs are those of `Servo`.

    **Raises:**

    - `ValueError` unless one of kp and duty is there, and as `Record`.
    """
    if (kp is None) == (duty is None):
        raise ValueError(f"{name}: a servo needs the gain kp of its position loop or the measured duty, one of them.")
    first = q0 if q0 is not None else float((q_goal if q is None else q)[0])
    drive = {"kp": np.full(len(t), float(kp))} if kp is not None else {"duty": np.asarray(duty, float)}
    inputs = {
        "q_goal": q_goal, "volts": conducting_voltage(t, volts), "torque_enable": np.asarray(torque_enable, float),
        "start.q": np.full(len(t), first), "start.qd": np.zeros(len(t)), **drive,
    }  # fmt: skip
    return Record(t, np.full(len(t), first) if q is None else q, inputs, name)


def servo_windows(record: Record, seconds: float) -> list[Record]:
    """Overlapping windows of a servo's record, each from the smoothed state at its first sample."""
    step = float(np.median(np.diff(record.t)))
    length = max(round(seconds / step), 4)
    speed = np.gradient(gaussian_filter1d(record.measured, max(0.012 / step, 1.0)), record.t)
    windows = []
    for first in range(0, len(record.t) - length // 2, max(length // 2, 1)):
        part = record.samples(first, min(first + length, len(record.t)), f"{record.name}[{first}]")
        qd = float(speed[first]) if abs(speed[first]) > 0.02 else 0.0
        start = {"start.q": np.full(len(part.t), part.measured[0]), "start.qd": np.full(len(part.t), qd)}
        windows.append(Record(part.t, part.measured, {**part.inputs, **start}, part.name))
    return windows
