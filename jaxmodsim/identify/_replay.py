"""A scene driven by a record: fixed steps from sample to sample."""

from collections.abc import Callable
from typing import Any, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Float, PyTree

from ..scene import Scene, State, vector_field
from ..solvers import RosenbrockTableau, rosenbrock_step

# Order 3, L-stable, stiffly accurate, three field evaluations (Sandu et al. 1997, Atmospheric Environment 31:3459).
# Of order 3 because a held input has no more smoothness between samples than its samples carry, and three evaluations
# instead of eight make the replay of a long record three times cheaper.
_RODAS3 = RosenbrockTableau(
    gamma=0.5,
    stage=np.array([[0.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 0.0], [2.0, 0.0, 0.0, 0.0], [2.0, 0.0, 1.0, 0.0]]),
    coupling=np.array([[0.0, 0.0, 0.0, 0.0], [4.0, 0.0, 0.0, 0.0], [1.0, -1.0, 0.0, 0.0], [1.0, -1.0, -8 / 3, 0.0]]),
    nodes=np.array([0.0, 0.0, 1.0, 1.0]),
    time=np.array([0.5, 1.5, 0.0, 0.0]),
    solution=np.array([2.0, 0.0, 1.0, 1.0]),
    error=np.array([0.0, 0.0, 0.0, 1.0]),
)


# `observe(t, y, scene)`, what is seen of a state; the scene is as the inputs drive it.
Observe: TypeAlias = Callable[[Array, State, Scene], Any]
Inputs: TypeAlias = dict[str, Float[Array, " samples"]]


class Controller(eqx.Module):
    """A controller that runs once per sample, as a drive does; what it puts out is held until the next sample.

    **Arguments:**

    - `fn`: `fn(t, q, qd, memory, params) -> (outputs, memory)`: the entries of `params` that it sets, by name, and its
      own state (an integral, a filter) for the next sample. `params` holds the scene's numbers and the inputs of the
      record, such as the reference, so gains that are entries of it can be fitted.
    - `memory`: its state at the first sample, a pytree of numbers.
    """

    fn: Callable[..., Any] = eqx.field(static=True)
    memory: PyTree[Array] = eqx.field(default=(), converter=lambda tree: jtu.tree_map(jnp.asarray, tree))


def run_samples(
    scene: Scene,
    t: Float[Array, " samples"],
    inputs: Inputs,
    y0: State,
    observe: Observe,
    *,
    substeps: int = 1,
    linear: frozenset[str] = frozenset(),
    controller: Controller | None = None,
) -> tuple[PyTree[Array], State]:
    """Run a scene over the samples of a record.

    Linearly implicit steps of fixed length: stable whatever the stiffness of the friction law, and cheap to
    differentiate forwards.

    **Arguments:**

    - `scene`: its `params` must be a dict that has the inputs' names.
    - `t`: times of the samples [s].
    - `inputs`: samples by name of the entry of `params` they drive.
    - `y0`: state at the first sample.
    - `observe`: what is seen of each sample.
    - `substeps`: steps from sample to sample.
    - `linear`: inputs that run in straight lines from sample to sample; the others are held.
    - `controller`: what closes a loop around the scene.

    **Returns:**

    What was observed at each sample, with a leading axis of samples, and the state at the last one.
    """

    def advance(carry: tuple[State, Any], sample: Any) -> tuple[tuple[State, Any], Any]:
        (y, memory), (start, dt, held, slopes) = carry, sample
        here = _driven(scene, held)
        outputs: dict[str, Array] = {}
        if controller is not None:
            outputs, memory = controller.fn(start, y.q, y.qd, memory, here.params)
            here = _driven(here, outputs)
        seen = observe(start, y, here)

        def field(t: Array, y: State) -> State:
            return vector_field(t, y, _driven(here, {k: held[k] + (t - start) * x for k, x in slopes.items()}))

        step = dt / substeps

        def substep(k: Any, y: State) -> State:
            return rosenbrock_step(_RODAS3, field, start + k * step, step, y, pivot=True).y1

        moved = substep(0, y) if substeps == 1 else jax.lax.fori_loop(0, substeps, substep, y)
        # Records of different lengths that run side by side repeat their last time.
        y = jtu.tree_map(lambda new, old: jnp.where(dt > 0, new, old), moved, y)
        return (y, memory), seen

    dt = jnp.diff(t)
    slopes = {name: jnp.diff(inputs[name]) / jnp.where(dt > 0, dt, 1.0) for name in sorted(linear)}
    memory = () if controller is None else controller.memory
    samples = (t[:-1], dt, jtu.tree_map(lambda x: x[:-1], inputs), slopes)
    (end, memory), seen = jax.lax.scan(advance, (y0, memory), samples)
    last = _driven(scene, jtu.tree_map(lambda x: x[-1], inputs))
    if controller is not None:
        last = _driven(last, controller.fn(t[-1], end.q, end.qd, memory, last.params)[0])
    final = observe(t[-1], end, last)
    return jtu.tree_map(lambda x, y: jnp.concatenate([x, jnp.asarray(y)[None]]), seen, final), end


def replay(
    scene: Scene,
    t: Float[Array, " samples"],
    inputs: Inputs,
    q0: Float[Array, " dof"],
    qd0: Float[Array, " dof"],
    substeps: int,
    observe: Callable[[Array, Array], Array],
) -> Float[Array, " samples"]:
    """Run a scene over the samples of a record, with the inputs held from each sample to the next.

    **Arguments:**

    - `scene`, `t`, `inputs`, `substeps`: see `run_samples`.
    - `q0`, `qd0`: state at the first sample.
    - `observe`: `observe(q, qd)`, the number that is compared with the record.

    **Returns:**

    The observed number at each sample, shape `[samples]`.
    """
    y0 = State(q0, qd0, scene.initial_state(q0))

    def look(t: Array, y: State, scene: Scene) -> Array:
        del t, scene
        return observe(y.q, y.qd)

    return run_samples(scene, t, inputs, y0, look, substeps=substeps)[0]


def _driven(scene: Scene, held: dict[str, Array]) -> Scene:
    if not held:
        return scene
    return eqx.tree_at(lambda x: x.params, scene, {**scene.params, **held})
