"""What metrics are taken of, by name."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from .._core.safe import safe_norm
from ..scene import Friction
from ..simulation import Events, Trajectory


def magnitude_of(x: Float[Array, "time ..."]) -> Float[Array, " time"]:
    """Magnitude at each time; of a force with several components its norm."""
    return jnp.abs(x) if x.ndim == 1 else jax.vmap(safe_norm)(jnp.reshape(x, (x.shape[0], -1)))


def element_of(run: Trajectory, name: str) -> Friction:
    """A friction element by name."""
    for known, effect in zip(run.scene.names, run.scene.effects, strict=True):
        if known == name and isinstance(effect, Friction):
            return effect
    elements = [x for x, effect in zip(run.scene.names, run.scene.effects, strict=True) if isinstance(effect, Friction)]
    raise ValueError(f"The scene has no friction element {name!r}; there are: {', '.join(elements) or 'none'}.")


def slip_of(run: Trajectory, name: str) -> tuple[Float[Array, " nodes"], Float[Array, "nodes ..."]]:
    """Times and slip velocities of a friction element, from t0 on and at the saved times."""
    element, problem = element_of(run, name), run.request

    def slip(t: Array, q: Array, qd: Array) -> Array:
        return element.slip(t, q, qd, run.scene.bind_time(t).params)

    def joined(first: ArrayLike, rest: Array) -> Array:
        return jnp.concatenate([jnp.asarray(first, rest.dtype)[None], rest])

    t, q, qd = joined(problem.t0, run.t), joined(problem.q0, run.q), joined(problem.qd0, run.qd)
    return t, jax.vmap(slip)(t, q, qd)


def is_exact(run: Trajectory, name: str) -> bool:
    """Whether a friction element runs by events."""
    element_of(run, name)
    return name in run.scene.event_driven


def needs_modes(run: Trajectory, name: str, what: str, mend: str) -> None:
    """Refuse an element without modes."""
    if not is_exact(run, name):
        raise ValueError(
            f"{what} reads the modes of {name!r}, but its law does not run by events, so that it has none: {mend}."
        )


def changes_of(run: Trajectory, name: str) -> tuple[Events, Array]:
    """Mode changes of a run, and which of them are of this element."""
    events = run.events
    return events, (events.effect == run.scene.names.index(name)) & jnp.isfinite(events.t)


def modes_at_ends(run: Trajectory, name: str, events: Events, own: Array) -> tuple[Array, Array]:
    """Mode of an element at t0 and at the end of a run: 0 in stick, else the sign of its slip velocity."""
    kept = run.mode[name][-1].astype(int)
    if not own.shape[0]:
        return kept, kept
    first, last = jnp.argmax(own), own.shape[0] - 1 - jnp.argmax(own[::-1])
    changed = jnp.any(own)
    return jnp.where(changed, events.before[first], kept), jnp.where(changed, events.after[last], kept)


def last_two(t: Float[Array, " events"], these: Array) -> tuple[Array, Array, Array]:
    """Time [s] of the last of these events, time since the one before, and whether there are two.

    The times are zero where there are not; with gradients that are zero, too.
    """
    order = jnp.cumsum(these)
    count = order[-1] if t.shape[0] else jnp.zeros((), int)
    last = jnp.sum(jnp.where(these & (order == count), t, 0.0))
    before = jnp.sum(jnp.where(these & (order == count - 1), t, 0.0))
    return last, last - before, count >= 2
