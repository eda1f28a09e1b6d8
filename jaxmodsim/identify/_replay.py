"""A scene driven by a record: fixed steps from sample to sample."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Float

from ..numerics import RosenbrockTableau, rosenbrock_step
from ..scene import Scene, State, scene_field

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


def replay(
    scene: Scene,
    t: Float[Array, " samples"],
    inputs: dict[str, Float[Array, " samples"]],
    q0: Float[Array, " dof"],
    qd0: Float[Array, " dof"],
    substeps: int,
    observe: Callable[[Array, Array], Array],
) -> Float[Array, " samples"]:
    """Run a scene over the samples of a record, with the inputs held from each sample to the next.

    Linearly implicit steps of fixed length: stable whatever the stiffness of the friction law, and cheap to
    differentiate forwards.

    **Arguments:**

    - `scene`: its `params` must be a dict that has the inputs' names.
    - `t`: times of the samples [s].
    - `inputs`: samples by name of the entry of `params` they drive.
    - `q0`, `qd0`: state at the first sample.
    - `substeps`: steps from sample to sample.
    - `observe`: `observe(q, qd)`, the number that is compared with the record.

    **Returns:**

    The observed number at each sample, shape `[samples]`.
    """

    def advance(y: State, sample: tuple[Array, Array, dict[str, Array]]) -> tuple[State, Array]:
        start, dt, held = sample
        driven = _drive(scene, held)

        def field(t: Array, y: State) -> State:
            return scene_field(t, y, driven)

        step = dt / substeps

        def substep(k: Any, y: State) -> State:
            return rosenbrock_step(_RODAS3, field, start + k * step, step, y, pivot=True).y1

        y = substep(0, y) if substeps == 1 else jax.lax.fori_loop(0, substeps, substep, y)
        return y, observe(y.q, y.qd)

    y0 = State(q0, qd0, scene.state0(q0))
    samples = (t[:-1], jnp.diff(t), jtu.tree_map(lambda x: x[:-1], inputs))
    _, observed = jax.lax.scan(advance, y0, samples)
    return jnp.concatenate([jnp.reshape(observe(q0, qd0), (1,)), observed])


def _drive(scene: Scene, held: dict[str, Array]) -> Scene:
    params: dict[str, Any] = {**scene.params, **held}
    return Scene(scene.lagrangian, params=params, effects=scene.effects) if held else scene
