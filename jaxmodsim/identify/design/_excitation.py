"""An axis led along a motion: the force it takes, and what the record of it would tell about the axis."""

from collections.abc import Callable, Mapping

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Float

from ...scene import Scene, State, replace_numbers, scene_numbers, vector_field
from ...solvers import rosenbrock_step
from ..model._engines import RODAS3, replay
from ..model._parameters import join_entries

# Share of the duration over which a motion fades in, and out.
_FADE = 0.1


class DrivenAxis(eqx.Module):
    """A scene of one coordinate and one input, with the numbers of it that are to be found.

    Numbers are relative: `x[i]` is the change of the i-th free number in units of `scale[i]`. Arrays of the same shapes
    reuse compiled code.

    - `scene`: the model.
    - `start`: numbers that move with the free ones, by name.
    - `slopes`: their derivatives by x, shape `[free]` each.
    - `q0`: position at the start, where the axis rests, shape `[1]`.
    - `noise`: standard deviation of one sample of what is observed, in its unit.
    - `input_name`: the entry of the scene's params that is the force.
    - `observe`: `observe(q, qd)`, what is recorded.
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
    """Displacements and velocities that a motion is a sum of: sines, then cosines, faded in and out.

    The k-th of either kind does k periods in the whole time. The fading is the polynomial of degree 5 whose first two
    derivatives are zero at either end, so that each motion starts and ends at rest, without acceleration, in the
    same place.
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
    """Force, held from each sample to the next, that leads the axis along a motion; the last one is not used.

    Inverse dynamics: the state of the friction follows from the motion alone, and the force over a sample is the one
    that gives the change of velocity over it, by the acceleration in the middle, which is linear in the force.

    **Arguments:**

    - `t`: times of the samples [s].
    - `q`, `qd`: motion at the samples [m], [m/s].

    **Returns:**

    The force at each sample [N].
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


def _record(
    axis: DrivenAxis,
    scene: Scene,
    t: Float[Array, " time"],
    force: Float[Array, " time"],
    observe: Callable[[Array, Array], Array],
    substeps: int = 1,
) -> Float[Array, " time"]:
    """What is observed on an axis of these numbers under a force that is held from each sample to the next."""
    return replay(scene, t, {axis.input_name: force}, axis.q0, jnp.zeros_like(axis.q0), substeps, observe)


def driven_motion(
    axis: DrivenAxis, t: Float[Array, " time"], force: Float[Array, " time"], substeps: int = 1
) -> Float[Array, "2 time"]:
    """Position and velocity of the model under a force alone; both from one run, as only what is observed differs."""

    def part(position: Array) -> Array:
        return _record(axis, axis.scene, t, force, lambda q, qd: jnp.where(position, q[0], qd[0]), substeps)

    return jax.vmap(part)(jnp.array([True, False]))


def sensitivities(
    axis: DrivenAxis, t: Float[Array, " time"], force: Float[Array, " time"]
) -> tuple[Float[Array, " time"], Float[Array, "time free"]]:
    """What is observed under a force, and its derivatives by the free numbers, in standard deviations of the noise."""

    def record(x: Array) -> Array:
        return _record(axis, axis.at(x), t, force, axis.observe) / axis.noise

    size = next(iter(axis.slopes.values())).shape[0]
    zero, units = jnp.zeros(size, force.dtype), jnp.eye(size, dtype=force.dtype)
    return jax.vmap(lambda unit: jax.jvp(record, (zero,), (unit,)), out_axes=(None, 1))(units)


def relative_numbers(
    values: Mapping[str, float], followed: Mapping[str, str], free: tuple[str, ...]
) -> tuple[Float[np.ndarray, " free"], dict[str, np.ndarray]]:
    """Units of the free numbers, and the derivatives by the numbers in these units of all that move with them.

    The unit is the number itself, so that errors are relative; 1 for a number that is zero. One that is not free but
    limited by one that is moves with its limit, as in a fit.
    """
    scale = np.array([abs(values[name]) or 1.0 for name in free])
    slopes: dict[str, np.ndarray] = {}
    for name in values:  # limits come before what they limit
        slopes[name] = scale * (np.array(free) == name) if name in free else slopes[followed[name]]
    return scale, slopes
