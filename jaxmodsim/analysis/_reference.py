"""Reference solutions, against which `work_precision` measures errors."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import diffrax as dfx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Array, ArrayLike, Float, Int

from ..scene import Scene
from ..simulation import SimulationError, Trajectory, simulate
from ..solvers import Rodas5P
from ._sensitivity import observed, with_values

# Ratio of the absolute to the relative tolerance, as in the defaults of `simulate`.
ATOL = 1e-3
# Largest number of steps of a reference, as a multiple of `max_steps`.
_PATIENCE = 20


@dataclass(frozen=True)
class Question:
    """The problem and the observable of a study.

    - `q0`, `qd0`, `t1`, `ts`: as for `simulate`.
    - `observe`, `label`, `unit`: the observable.
    - `values`: of the numbers by which the last value of the observable is differentiated.
    - `max_steps`: largest number of steps of a run.
    """

    q0: np.ndarray
    qd0: np.ndarray
    t1: float
    ts: np.ndarray | None
    observe: Callable[[Trajectory], ArrayLike]
    label: str
    unit: str
    values: dict[str, float]
    max_steps: int

    def start(self, dtype: DTypeLike) -> dict[str, Array]:
        """Initial coordinates and velocities in a floating type."""
        return {"q0": jnp.asarray(self.q0, dtype), "qd0": jnp.asarray(self.qd0, dtype)}

    def run(
        self, scene: Scene, start: dict[str, Array], setting: Mapping[str, object], **options: object
    ) -> Trajectory:
        """Run the problem; `setting` holds the tolerances or the step."""
        return simulate(scene, **start, t1=self.t1, ts=self.ts, **{"max_steps": self.max_steps, **setting, **options})

    def last(
        self,
        x: dict[str, Array],
        scene: Scene,
        start: dict[str, Array],
        setting: Mapping[str, object],
        **options: object,
    ) -> Array:
        """The last value of the observable, as a function of the numbers `x`."""
        scene, start = with_values(scene, start, x)
        return jnp.ravel(self.observe(self.run(scene, start, setting, throw=False, **options)))[-1]


class ModeChanges(NamedTuple):
    """Mode changes of a run: their times [s], and pairs of the index of the effect and its new mode."""

    t: Float[np.ndarray, " events"]
    modes: Int[np.ndarray, "events 2"]


class Reference(NamedTuple):
    """The reference solution of a scene.

    - `y`: the observable.
    - `events`: mode changes; None for a scene without modes.
    - `gradient`: of the last value of the observable, by name; None if no gradient is measured.
    - `disagreement`: of the observable between two references, relative to its scale. `events_disagreement` [s] and
      `gradient_disagreement` likewise, zero without a second reference.
    - `how`: the methods of both references as text.
    """

    y: np.ndarray
    events: ModeChanges | None
    gradient: dict[str, float] | None
    disagreement: float
    events_disagreement: float
    gradient_disagreement: float
    how: str


def in_type(scene: Scene, dtype: object) -> Scene:
    """The scene with all its numbers in a floating type."""
    return jtu.tree_map(lambda x: x.astype(dtype) if jnp.issubdtype(x.dtype, jnp.floating) else x, scene)


def mode_changes_of(run: Trajectory) -> ModeChanges | None:
    """Mode changes of a run; None for a scene without modes."""
    if run.modes is None:
        return None
    events = run.events
    finite = np.isfinite(events.t)
    return ModeChanges(np.asarray(events.t)[finite], np.stack([events.effect, events.after], axis=1)[finite])


def event_error(one: ModeChanges, other: ModeChanges) -> float | None:
    """Largest difference of times [s]; None if the sequences of modes differ."""
    if one.modes.shape != other.modes.shape or (one.modes != other.modes).any():
        return None
    return float(np.max(np.abs(one.t - other.t), initial=0.0))


def gradient_error(one: dict[str, float], other: dict[str, float]) -> float:
    """Largest relative difference of the derivatives; absolute for those that are zero."""
    return max(abs(one[name] - x) / (abs(x) or 1.0) for name, x in other.items())


def scale_of(y: np.ndarray) -> float:
    """Largest magnitude, or one."""
    return float(np.max(np.abs(y))) or 1.0


def find_reference(
    scene: Scene, question: Question, rtol: float, *, closed: np.ndarray | None, scale: float | None, agreement: float
) -> Reference:
    """Compute the reference by two solvers at a tight tolerance, or by a closed form and one solver.

    **Raises:**

    - `RuntimeError` if they disagree by more than `agreement`, or a run fails.
    """
    scene, stiff = in_type(scene, jnp.float64), any(effect.stiff for effect in scene.effects)
    solvers: tuple[object, ...] = (Rodas5P(), dfx.Tsit5() if scene.mode_names or stiff else dfx.Dopri8())
    if closed is not None and not scene.mode_names and not question.values:
        solvers = solvers[:1]
    solutions = [_tight(scene, question, solver, rtol) for solver in solvers]
    names = [f"{type(solver).__name__} at rtol = {rtol:.0e}" for solver in solvers]
    ys = [y for y, _, _ in solutions]
    if closed is not None:
        if closed.size != ys[0].size:
            raise ValueError(
                f"reference has the shape {closed.shape}, but {question.label} has the shape {ys[0].shape}."
            )
        ys, how = [np.reshape(closed, ys[0].shape), ys[0]], ["the closed form", names[0]]
    else:
        how = names
    scale = scale_of(ys[0]) if scale is None else scale
    apart = np.abs(ys[0] - ys[1])
    disagreement = float(apart.max()) / scale
    if not disagreement <= agreement:
        at = int(np.argmax(apart))
        raise RuntimeError(
            f"The references disagree: {question.label} is {np.ravel(ys[0])[at]:.12g} by {how[0]} and"
            f" {np.ravel(ys[1])[at]:.12g} by {how[1]}. The difference of {disagreement:.1e} of the scale exceeds"
            f" agreement={agreement:.1e}. Reduce t1 if the motion is chaotic, loosen the tolerances, or pass a closed"
            " form as reference or a larger agreement."
        )
    events, other = solutions[0][1], solutions[-1][1]
    times = None if events is None or other is None else event_error(events, other)
    gradient, second = solutions[0][2], solutions[-1][2]
    return Reference(
        ys[0],
        events if times is not None else None,
        gradient,
        disagreement,
        times or 0.0,
        0.0 if gradient is None or second is None else gradient_error(gradient, second),
        " and ".join(how),
    )


def _tight(
    scene: Scene, question: Question, solver: object, rtol: float
) -> tuple[np.ndarray, ModeChanges | None, dict[str, float] | None]:
    """Observable, mode changes and gradient by one solver at a tight tolerance."""
    setting, start = {"rtol": rtol, "atol": ATOL * rtol}, question.start(jnp.float64)
    options = {"solver": solver, "max_steps": _PATIENCE * question.max_steps}
    try:
        run = question.run(scene, start, setting, **options)
    except SimulationError as error:
        raise RuntimeError(
            f"The reference by {type(solver).__name__} at rtol = {rtol:.0e} failed: {error} It may take"
            f" {_PATIENCE} times max_steps."
        ) from error
    y, gradient = np.asarray(observed(question.observe(run))), None
    if question.values:
        x = {name: jnp.asarray(value, jnp.float64) for name, value in question.values.items()}
        derivatives = jax.jacfwd(question.last)(x, scene, start, setting, **options)
        gradient = {name: float(derivatives[name]) for name in question.values}
    return y, mode_changes_of(run), gradient
