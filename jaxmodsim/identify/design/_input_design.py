"""The best input for an axis: criteria, limits, the motion with its force, and the information of its record."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Float

from ..._core.arguments import as_float
from ..._core.readable import AbstractReadable, Table, table_of
from ..._core.system import jsonable, written_whole
from ...scene import Scene, State, replace_numbers, scene_numbers, vector_field
from ...solvers import rosenbrock_step
from ..model._engines import RODAS3, replay
from ..model._parameters import join_entries
from ..uncertainty._estimate import correlated

# Relative standard error above which a number is undetermined; correlation above which two are indistinguishable.
_VAGUE, _ALIKE = 0.5, 0.98
# Share of a limit from which it is reached, and of the travel from which a deviation is reported.
_REACHED, _OFF = 0.98, 0.05
# Share of the duration over which a motion fades in, and out.
_FADE = 0.1


def d_optimal(information: Float[Array, "free free"]) -> Float[Array, ""]:
    """Mean logarithm of the eigenvalues: minimises the volume of the confidence ellipsoid.

    **Returns:**

    The criterion, shape `[]`.
    """
    return jnp.linalg.slogdet(information)[1] / information.shape[0]


def a_optimal(information: Float[Array, "free free"]) -> Float[Array, ""]:
    """Minus the logarithm of the mean variance: minimises the mean of the squared relative errors.

    **Returns:**

    The criterion, shape `[]`.
    """
    return -jnp.log(jnp.trace(jnp.linalg.inv(information)) / information.shape[0])


def e_optimal(information: Float[Array, "free free"]) -> Float[Array, ""]:
    """Logarithm of the smallest eigenvalue: minimises the error of the worst-known combination.

    **Returns:**

    The criterion, shape `[]`.
    """
    return jnp.log(jnp.maximum(jnp.linalg.eigvalsh(information)[0], jnp.finfo(information.dtype).tiny))


@dataclass(frozen=True)
class AxisLimits:
    """Limits of an axis; None for no limit.

    **Arguments:**

    - `force`: largest magnitude of the input [N], > 0.
    - `speed`: largest magnitude of the velocity [m/s], > 0.
    - `travel`: largest distance from the start to either side [m], > 0: half of the whole stroke if the axis starts in
      its middle.
    - `rotary`: whether these are a torque [N m], rad/s and rad.

    **Raises:**

    - `ValueError` for a limit that is no positive finite number, or without any limit.
    """

    force: float | None = None
    speed: float | None = None
    travel: float | None = None
    rotary: bool = False

    def __post_init__(self) -> None:
        if not self.active:
            raise ValueError(
                "AxisLimits needs at least one of force [N], speed [m/s] and travel [m]: without any, the best input is"
                " infinite."
            )
        for name, (value, unit) in self.active.items():
            as_float(value, name=f"The limit of {name} [{unit}]", lower=0.0)

    @property
    def active(self) -> dict[str, tuple[float, str]]:
        """Value and unit of each limit, by name."""
        units = ("N m", "rad/s", "rad") if self.rotary else ("N", "m/s", "m")
        limits = zip(("force", "speed", "travel"), (self.force, self.speed, self.travel), units, strict=True)
        return {name: (value, unit) for name, value, unit in limits if value is not None}

    def __str__(self) -> str:
        return ", ".join(f"{name} {value:g} {unit}" for name, (value, unit) in self.active.items())


@dataclass(frozen=True, kw_only=True)
class Excitation:
    """A motion that starts and ends at rest, its force in the model, and the information in a record of it.

    - `t`: times [s], evenly spaced, shape `[time]`.
    - `q_ref`, `qd_ref`: reference position [m] and velocity [m/s].
    - `force`: force [N] for them in the model, held from each sample to the next.
    - `q`, `qd`: position and velocity of the model under this force, without feedback.
    - `information`: Fisher information of the free numbers, each in units of itself (of 1 if it is zero): the inverse
      is the covariance of the relative errors. Of the record alone, without a prior. Shape `[free, free]`.
    - `errors`: predicted standard errors by name, in the unit of the number; infinite for a number without effect.
    - `correlation`: of the errors, shape `[free, free]`.
    """

    t: Float[np.ndarray, " time"]
    q_ref: Float[np.ndarray, " time"]
    qd_ref: Float[np.ndarray, " time"]
    force: Float[np.ndarray, " time"]
    q: Float[np.ndarray, " time"]
    qd: Float[np.ndarray, " time"]
    information: Float[np.ndarray, "free free"]
    errors: dict[str, float]
    correlation: Float[np.ndarray, "free free"]


@dataclass(frozen=True, kw_only=True)
class InputDesign(AbstractReadable):
    """The most informative input for the free numbers, within limits.

    - `best`: the designed input.
    - `baseline`: the best single sine within the same limits and of the same duration.
    - `values`, `units`: the free numbers of the design, and the unit of each that declares one.
    - `limits`: the `AxisLimits`.
    - `noise`: assumed standard deviation of a sample.
    - `ending`: why the search ended.
    - `single_precision`: whether it was computed in float32.
    """

    best: Excitation
    baseline: Excitation
    values: dict[str, float]
    units: dict[str, str]
    limits: AxisLimits
    noise: float
    ending: str
    single_precision: bool

    @property
    def used(self) -> dict[str, float]:
        """Share of each limit that the input uses, at most 1, by its name."""
        best = self.best
        peaks = {
            "force": np.max(np.abs(best.force)),
            "speed": max(np.max(np.abs(best.qd_ref)), np.max(np.abs(best.qd))),
            "travel": max(np.max(np.abs(q - best.q_ref[0])) for q in (best.q_ref, best.q)),
        }
        return {name: float(peaks[name]) / value for name, (value, _) in self.limits.active.items()}

    @property
    def warnings(self) -> tuple[str, ...]:
        """Limitations of the design, in words."""
        warnings = []
        where = f"Within {self.limits}"
        for name, value in self.values.items():
            share = self.best.errors[name] / abs(value) if value else 0.0
            if not np.isfinite(self.best.errors[name]):
                warnings.append(f"{where}, {name} has no effect on the record.")
            elif share > _VAGUE:
                warnings.append(
                    f"{where}, {name} is not determined: its standard error would be {100 * share:.0f} % of its value."
                )
        for a, b, c in correlated(list(self.values), self.best.correlation, _ALIKE):
            warnings.append(f"{where}, {a} and {b} can hardly be told apart (correlation {c:+.3f}).")
        full = [name for name, share in self.used.items() if share > _REACHED]
        if full:
            warnings.append(f"What limits it: {' and '.join(full)}.")
        off = float(np.max(np.abs(self.best.q - self.best.q_ref)))
        reach = float(np.max(np.abs(self.best.q_ref - self.best.q_ref[0])))
        if off > _OFF * reach:
            warnings.append(
                f"The force alone does not keep the model on its reference: it is off by up to {off:.2g} m."
                " Control position and velocity of the axis, or choose a shorter dt."
            )
        if self.ending != "converged":
            warnings.append(f"The search {self.ending}: more steps or another seed may find a better input.")
        if self.single_precision:
            warnings.append("Computed in single precision: enable jax_enable_x64 for reliable numbers.")
        return tuple(warnings)

    def rows(self) -> list[tuple[str, float, float, float, str]]:
        """Rows of a table: name, value, predicted standard error, that of the best sine, unit."""
        return [
            (name, value, self.best.errors[name], self.baseline.errors[name], self.units[name])
            for name, value in self.values.items()
        ]

    def to_dict(self) -> dict[str, object]:
        """Everything except the samples, in types of JSON; infinite errors are None."""
        return jsonable(
            {
                "duration": float(self.best.t[-1] - self.best.t[0]),
                "samples": len(self.best.t),
                "noise": self.noise,
                "limits": {name: value for name, (value, _) in self.limits.active.items()},
                "used": self.used,
                "parameters": {
                    name: {"value": value, "standard_error": error, "standard_error_of_a_sine": sine, "unit": unit}
                    for name, value, error, sine, unit in self.rows()
                },
                "information": {"names": list(self.values), "matrix": self.best.information.tolist()},
                "ending": self.ending,
                "warnings": list(self.warnings),
            }
        )

    def to_csv(self, path: str | Path) -> None:
        """Write `t` [s], `q_ref` [m], `qd_ref` [m/s], `force` [N] with a header line, atomically.

        Pass `q_ref` and `qd_ref` to a drive that tracks a motion, with `force` as feed-forward; pass `force`, held from
        each sample to the next, to a drive that takes a force. Record the force that was actually applied.

        **Raises:**

        - `OSError` if the file cannot be written.
        """
        columns = np.column_stack([self.best.t, self.best.q_ref, self.best.qd_ref, self.best.force])
        with written_whole(path) as file:
            np.savetxt(file, columns, fmt="%.9g", delimiter=",", header="t,q_ref,qd_ref,force", comments="")


@table_of.register
def _(design: InputDesign) -> Table:
    best = design.best
    rows = [
        (name, f"{value:.6g}", f"{error:.2g}", f"{100 * error / abs(value):.2g}" if value else "-", f"{sine:.2g}", unit)
        for name, value, error, sine, unit in design.rows()
    ]
    head = ("parameter", "value", "standard error", "in %", "of a plain sine", "unit")
    used = ", ".join(f"{name} {100 * share:.0f} %" for name, share in design.used.items())
    title = f"{len(best.t)} samples, {best.t[-1] - best.t[0]:g} s, noise {design.noise:g}; used: {used}"
    return Table(title, head, rows, design.warnings)


class DrivenAxis(eqx.Module):
    """A scene of one coordinate and one input, with its free numbers.

    Numbers are relative: `x[i]` is the change of the i-th free number in units of `scale[i]`. Arrays of the same shapes
    reuse compiled code.

    - `scene`: the model.
    - `start`: numbers that move with the free ones, by name.
    - `slopes`: their derivatives by x, shape `[free]` each.
    - `q0`: position at the start, where the axis rests, shape `[1]`.
    - `noise`: standard deviation of one sample of the observed quantity, in its unit.
    - `input_name`: the entry of the scene's params that is the force.
    - `observe`: `observe(q, qd)`, the recorded quantity.
    """

    scene: Scene
    start: dict[str, Array]
    slopes: dict[str, Array]
    q0: Float[Array, " one"]
    noise: Float[Array, ""]
    input_name: str = eqx.field(static=True)
    observe: Callable[[Array, Array], Array] = eqx.field(static=True)

    def at(self, x: Float[Array, " free"]) -> Scene:
        """The scene with its free numbers moved by `x`."""
        values = {name: start + jnp.sum(self.slopes[name] * x) for name, start in self.start.items()}
        return replace_numbers(self.scene, join_entries(scene_numbers(self.scene), values))


def motion_basis(
    t: Float[np.ndarray, " time"], harmonics: int
) -> tuple[Float[np.ndarray, "time weights"], Float[np.ndarray, "time weights"]]:
    """Displacements and velocities whose sums are motions: sines, then cosines, faded in and out.

    The k-th of either kind has k periods in the whole time. The fading is a polynomial of degree 5 with first two
    derivatives zero at either end, so that each motion starts and ends in the same place, at rest, without
    acceleration.
    """
    whole = t[-1] - t[0]
    ends = np.minimum(t - t[0], t[-1] - t) / (_FADE * whole)
    s = np.clip(ends, 0.0, 1.0)
    side = np.where(t - t[0] < 0.5 * whole, 1.0, -1.0) / (_FADE * whole)
    fade = (s**3 * (10.0 - 15.0 * s + 6.0 * s**2))[:, None]
    slope = (30.0 * s**2 * (1.0 - s) ** 2 * side)[:, None]
    rate = 2.0 * np.pi * np.arange(1, harmonics + 1) / whole
    angle = np.outer(t - t[0], rate)
    wave = np.hstack([np.sin(angle), np.cos(angle)])
    wave_rate = np.hstack([rate * np.cos(angle), -rate * np.sin(angle)])
    return fade * wave, slope * wave + fade * wave_rate


def feed_forward(
    axis: DrivenAxis, t: Float[Array, " time"], q: Float[Array, " time"], qd: Float[Array, " time"]
) -> Float[Array, " time"]:
    """Force [N], held from each sample to the next, for a motion of the axis; the last one is not used.

    Inverse dynamics: the state of the friction follows from the motion alone. The force over a sample gives the change
    of velocity over it, by the acceleration in the middle, which is linear in the force.

    **Arguments:**

    - `t`: times of the samples [s].
    - `q`, `qd`: motion at the samples [m], [m/s].
    """
    scene = axis.scene

    def acceleration(force: float, t: Array, y: State) -> Array:
        params: dict[str, object] = {**scene.params, axis.input_name: jnp.full((), force, q.dtype)}
        driven = Scene(scene.lagrangian, params=params, effects=scene.effects)
        return vector_field(t, y, driven).qd[0]

    def advance(z: dict[str, object], sample: tuple[Array, ...]) -> tuple[dict[str, object], Array]:
        start, step, q0, qd0, q1, qd1 = sample

        def state(t: Array, z: dict[str, object]) -> State:
            share = (t - start) / step
            return State(jnp.reshape(q0 + share * (q1 - q0), (1,)), jnp.reshape(qd0 + share * (qd1 - qd0), (1,)), z)

        end = z
        if jtu.tree_leaves(z):
            end = rosenbrock_step(
                RODAS3, lambda t, z: vector_field(t, state(t, z), scene).z, start, step, z, pivot=True
            ).y1
        middle = start + 0.5 * step
        y = state(middle, jtu.tree_map(lambda a, b: 0.5 * (a + b), z, end))
        free = acceleration(0.0, middle, y)
        return end, ((qd1 - qd0) / step - free) / (acceleration(1.0, middle, y) - free)

    samples = (t[:-1], jnp.diff(t), q[:-1], qd[:-1], q[1:], qd[1:])
    _, force = jax.lax.scan(advance, scene.initial_state(q[:1]), samples)
    return jnp.concatenate([force, force[-1:]])


def driven_motion(
    axis: DrivenAxis, t: Float[Array, " time"], force: Float[Array, " time"], substeps: int = 1
) -> Float[Array, "2 time"]:
    """Position and velocity of the model under a force that is held from each sample to the next."""
    inputs, rest = {axis.input_name: force}, jnp.zeros_like(axis.q0)
    return replay(axis.scene, t, inputs, axis.q0, rest, substeps, lambda q, qd: jnp.stack([q[0], qd[0]])).T


def sensitivities(
    axis: DrivenAxis, t: Float[Array, " time"], force: Float[Array, " time"]
) -> tuple[Float[Array, " time"], Float[Array, "time free"]]:
    """The observed quantity under a force, and its derivatives by the free numbers, in noise levels."""

    def record(x: Array) -> Array:
        inputs, rest = {axis.input_name: force}, jnp.zeros_like(axis.q0)
        return replay(axis.at(x), t, inputs, axis.q0, rest, observe=axis.observe) / axis.noise

    size = next(iter(axis.slopes.values())).shape[0]
    zero, units = jnp.zeros(size, force.dtype), jnp.eye(size, dtype=force.dtype)
    return jax.vmap(lambda unit: jax.jvp(record, (zero,), (unit,)), out_axes=(None, 1))(units)
