"""`equilibrium`: find a state of a scene that is at rest."""

from __future__ import annotations  # `help` shows types as they are written here

from collections.abc import Mapping
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, ArrayLike, Float, PyTree

from .._core.arguments import check_real
from .._core.arrays import is_known
from .._core.readable import AbstractReadable, Table, short, table_of
from ..scene import Scene, State, check_scene, from_dynamics, quantity_of
from ._orbit import NEUTRAL, format_complex
from ._periodic_orbit import check_known
from ._rest import RestPoint, RestProblem, rest_at, rest_equations, solve_rest
from ._return_map import OrbitError, pack, unpack

# Times [s] at which an equilibrium is checked again, and the tolerance in its scales.
_OTHER_TIMES, _SAME = (0.381966, 2.236068, 31.622777), 1e-6
# Coordinates [m or rad] and states of effects below the first are rounding errors. Those below the second, relative to
# the largest of their kind, do not define a scale.
_ROUNDING, _NOTHING = 1e-12, 1e-6


class Equilibrium(AbstractReadable, eqx.Module):
    """An equilibrium of a scene: rest, or steady sliding on a moving surface.

    `q` and `z` have derivatives by all numbers of the scene.

    - `q`, `z`: coordinates and states of effects, as in `simulate`. Velocities are zero.
    - `eigenvalues`: of the equations of motion, linearised within the constraints, bristles included [1/s]; complex,
      shape `[k]`, in order of falling real part. Empty, `k = 0`, at the end of a set.
    - `ends`: direction of the limiting friction force of each element in stick, by name.
    - `scene`: the scene.

    **Example:**

    ```python
    belt = jms.problems.belt_oscillator
    sliding = jms.equilibrium(belt.scene(belt.stribeck()), [0.06])
    print(sliding.stability)
    ```

    ```text
    unstable: an eigenvalue of 5.69101+8.22268j 1/s
    ```
    """

    q: Float[Array, " dof"]
    z: dict[str, PyTree]
    eigenvalues: np.ndarray
    ends: dict[str, int]
    scene: Scene

    @property
    def state(self) -> State:
        """Coordinates, velocities and states of effects."""
        return State(self.q, jnp.zeros_like(self.q), self.z)

    @property
    def amplitude(self) -> Float[Array, " dof"]:
        """Zeros, shape `[dof]`, for comparison with orbits."""
        return jnp.zeros_like(self.q)

    @property
    def period(self) -> float:
        """Period [s] of the least damped small oscillation; infinite without oscillations."""
        rate = nearest_oscillation(self.eigenvalues)
        return 2.0 * np.pi / rate.imag if rate.imag else np.inf

    @property
    def stable(self) -> bool:
        """Whether all eigenvalues have negative real parts."""
        return self.stability == "stable"

    @property
    def stability(self) -> str:
        """`stable`, `unstable` with the eigenvalue, or `neutral` if first order does not decide."""
        if self.ends:
            return "neutral: the end of a set of equilibria that friction holds"
        size = np.max(np.abs(self.eigenvalues), initial=0.0)
        first = self.eigenvalues[0] if len(self.eigenvalues) else -np.inf
        if first.real < -NEUTRAL * size:
            return "stable"
        if first.real <= NEUTRAL * size:
            return "neutral: an eigenvalue is on the imaginary axis, and stability is not decided to first order"
        return f"unstable: an eigenvalue of {format_complex(first)} 1/s"


def nearest_oscillation(eigenvalues: np.ndarray) -> complex:
    """The eigenvalue with a positive imaginary part and the smallest ratio of real to imaginary part; 0 without one."""
    above = eigenvalues[np.imag(eigenvalues) > 0]
    return complex(above[np.argmin(np.abs(np.real(above)) / np.imag(above))]) if len(above) else 0.0j


def equilibrium(scene: Scene, q0: ArrayLike | list[float], *, ends: Mapping[str, int] | None = None) -> Equilibrium:
    """Find an equilibrium, stable or not, by Newton's iteration on the equations of motion.

    Set-valued friction on a moving surface (`belt_velocity`) slips at the equilibrium: steady sliding. On a surface at
    rest it sticks, and the equilibria form a set. The function finds the ends of the set, with friction at its limit.

    The state has first derivatives by all numbers of the scene, forward and reverse, by the implicit function theorem.

    **Arguments:**

    - `scene`: the `Scene`, in float64, independent of time, with contacts open.
    - `q0`: start of the iteration, shape `[dof]`. States of effects start as in a run.
    - `ends`: for each friction element in stick, by name, 1 for the end of the set from which it would slide forwards,
      -1 for the end from which it would slide backwards.

    **Returns:**

    An `Equilibrium`.

    **Raises:**

    - `ValueError` for invalid arguments, float32, a scene with a `Switch`, inside `jax.jit` or `jax.vmap`, and if the
      names in `ends` are not those of the elements in stick.
    - `OrbitError` if the iteration does not converge, the equilibrium is one of a family, the scene depends on time, or
      a contact is closed.

    **Example:**

    ```python
    belt = jms.problems.belt_oscillator
    sliding = jms.equilibrium(belt.scene(belt.stribeck()), [0.06])
    print(sliding.q.round(5), sliding.eigenvalues.round(3))
    ```

    ```text
    [0.07366] [5.691+8.223j 5.691-8.223j]
    ```
    """
    known = jtu.tree_map(jax.lax.stop_gradient, scene)
    problem, x, dof = prepare_rest(known, q0, ends, None)
    point, _ = solve_rest(problem, x, 0.0, dof, rest_scale(x, dof, 1.0))
    refuse_time(problem, point, dof)
    rest = describe_rest(problem, point, dof)
    if is_known(*jtu.tree_leaves(scene)):
        return rest
    # One step of Newton from the solution has the derivatives of the implicit function theorem.
    at = rest_equations(problem, scene, jnp.asarray(point.x), jnp.zeros(()), dof)
    inverse = np.linalg.pinv(point.rows @ point.by[:, :-1]) @ point.rows
    change = jnp.asarray(inverse) @ jnp.concatenate([at.rate, at.held])
    state = unpack(scene, jnp.asarray(point.x) + jax.lax.stop_gradient(change) - change, dof)
    return replace(rest, q=state.q, z=state.z, scene=scene)


def prepare_rest(
    scene: Scene, q0: ArrayLike | list[float], ends: Mapping[str, int] | None, parameter: str | None
) -> tuple[RestProblem, np.ndarray, int]:
    """The problem of an equilibrium, a start, and the number of coordinates.

    **Raises:**

    - `ValueError` for invalid arguments.
    """
    check_known(scene, "equilibrium")
    check_real(q0, name="q0")
    q = jnp.asarray(q0, float)
    if q.ndim != 1 or not q.shape[0]:
        raise ValueError(f"q0 must have the shape [dof], but it has {q.shape}.")
    y, dof, ends = State(q, jnp.zeros_like(q), scene.initial_state(q)), q.shape[0], dict(ends or {})
    check_scene(scene, y)
    if scene.switches:
        raise ValueError(
            f"equilibrium does not support switches, but the scene has {', '.join(scene.switches)}: replace each by the"
            " force of one side, as an AppliedForce."
        )
    numbers, rows = scene.num_modes(dof), _rows_of(scene, dof)
    mode = jnp.zeros(numbers) if numbers else None
    sides = scene.split_modes(jnp.zeros(numbers))[0]
    if mode is not None and sides.size:
        t = jnp.zeros(())
        slip = from_dynamics(
            lambda d: d.friction_elements.slip_mode(d.friction_elements.v[: sides.size], t),
            *(t, y, scene.bind_time(t), mode),
        )
        mode = mode.at[: sides.size].set(slip)
    still = [name for name, part in rows.items() if mode is not None and not np.any(np.asarray(mode[part]))]
    planar = [name for name in still if rows[name].stop - rows[name].start > 1]
    if planar:
        raise ValueError(
            f"{planar[0]} sticks in a plane, where the set of equilibria has a curve as its border, and no ends. Give"
            " its surface a velocity, or use one friction element for each direction."
        )
    if set(ends) != set(still) or not all(side in (1, -1) for side in ends.values()):
        need = "ends={" + ", ".join(f"{name!r}: 1" for name in still) + "}"
        mend = (
            f"{', '.join(still)} sticks, and the equilibria form a set: pass {need} for the end from which it would"
            " slide forwards, or -1 for backwards"
            if still
            else "nothing sticks, and an equilibrium has no ends: omit them"
        )
        raise ValueError(f"At rest {mend}; ends={ends or None!r} was given.")
    for name, side in ends.items():
        sides = sides.at[rows[name]].set(side)
    return RestProblem(scene, mode, sides, parameter), np.asarray(pack(y)), dof


def _rows_of(scene: Scene, dof: int) -> dict[str, slice]:
    """The rows of the modes of each event-driven friction element."""
    stops = np.cumsum([0, *scene.mode_widths(dof)]).tolist()
    return {name: slice(*pair) for name, *pair in zip(scene.event_driven, stops, stops[1:], strict=False)}


def rest_scale(x: np.ndarray, dof: int, span: float, tangent: np.ndarray | float = 0.0) -> np.ndarray:
    """Magnitudes of the unknowns or their change over the span; small entries have that of their kind, or 1."""
    scale = np.ones(len(x) + 1)
    size = np.maximum(np.abs(x), np.abs(tangent) * span)
    for part in (slice(0, dof), slice(2 * dof, len(x))):
        largest = np.max(size[part], initial=0.0)
        if largest > _ROUNDING:
            scale[:-1][part] = np.where(size[part] > _NOTHING * largest, size[part], largest)
    scale[-1] = span
    return scale


def refuse_time(problem: RestProblem, point: RestPoint, dof: int) -> None:
    """Check that the equilibrium is the same at other times.

    **Raises:**

    - `OrbitError` if the scene depends on time.
    """
    scale = rest_scale(point.x, dof, 1.0)
    for t in _OTHER_TIMES:
        by, residual = rest_at(problem, point.x, point.value, dof, t).scaled(scale)
        if np.max(np.abs(np.linalg.lstsq(by[:, :-1], residual, rcond=None)[0])) > _SAME:
            raise OrbitError(
                f"The scene depends on time: the equilibrium at t = 0 is no equilibrium at t = {t:g} s. Use coordinates"
                " that come to rest, such as the lag behind a drive at constant speed. For a periodic force use"
                " periodic_orbit."
            )


def describe_rest(problem: RestProblem, point: RestPoint, dof: int) -> Equilibrium:
    """The equilibrium at a solution of its equations."""
    scene = problem.with_value(point.value)
    values, sides = np.zeros(0, complex), np.asarray(problem.ends)
    ends = {name: int(sides[part][0]) for name, part in _rows_of(scene, dof).items() if np.any(sides[part])}
    if not ends:
        values = np.linalg.eigvals(point.linearised).astype(complex)
        values = values[np.lexsort((-np.imag(values), -np.real(values)))]
    state = unpack(scene, jnp.asarray(point.x), dof)
    return Equilibrium(state.q, state.z, values, ends, scene)


@table_of.register
def _(rest: Equilibrium) -> Table:
    """Coordinates, eigenvalues, stability."""
    if not is_known(rest.q):
        return Table("Equilibrium, traced", (), [])
    rows = [(quantity_of(rest.scene, f"q[{i}]").label, short(x)) for i, x in enumerate(rest.q)]
    notes = [f"eigenvalues {', '.join(map(format_complex, rest.eigenvalues))} 1/s"] if len(rest.eigenvalues) else []
    if np.isfinite(rest.period):
        notes.append(f"period of small oscillations {rest.period:.6g} s")
    sides = [f"{name}, {'forwards' if side > 0 else 'backwards'}" for name, side in rest.ends.items()]
    notes += [f"about to slide: {'; '.join(sides)}"] if sides else []
    return Table(f"Equilibrium, {rest.stability}", ("", "at"), rows, tuple(notes))
