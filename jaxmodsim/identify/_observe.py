"""What a record measured: functions of the motion, or names."""

import re
from collections.abc import Callable, Mapping
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
from jaxtyping import Array

from .._core.arguments import as_mapping, did_you_mean
from .._core.index_check import traced
from ..scene import Scene, State, scene_forces
from ._record import Record

# `observe(q, qd)`, or "q[0]", "qd[1]", or the name of an effect, whose force is meant.
Observable: TypeAlias = Callable[[Array, Array], Array] | str

_STATE = re.compile(r"(q|qd)\[(\d+)\]")


def first_coordinate(q: Array, qd: Array) -> Array:
    """The first coordinate, which is what a position sensor on one axis sees."""
    del qd
    return q[0]


def by_channel(
    observe: Observable | Mapping[str, Observable], records: tuple[Record, ...]
) -> tuple[tuple[str, Observable], ...]:
    """What each channel of the records observes.

    **Raises:**

    - `ValueError` for a channel without an observable.
    """
    channels = list(dict.fromkeys(channel for record in records for channel in record.channels))
    if not isinstance(observe, Mapping):
        if len(channels) > 1:
            raise ValueError(
                f"The records have the channels {', '.join(channels)}: observe must say what each is, as in"
                f" observe={{{channels[0]!r}: 'q[0]', ...}}."
            )
        return ((channels[0], observe),)
    observe = as_mapping(observe, name="observe", example=f"{{{channels[0]!r}: 'q[0]'}}")
    missing, unknown = set(channels) - set(observe), set(observe) - set(channels)
    if missing or unknown:
        raise ValueError(
            f"observe must say what each channel is: {', '.join(channels)}; it has: {', '.join(observe) or 'none'}."
        )
    return tuple((channel, observe[channel]) for channel in channels)


def check_observables(observables: tuple[tuple[str, Observable], ...], scene: Scene, y: State) -> None:
    """Refuse what is no number of the scene.

    **Raises:**

    - `ValueError` for a name that is neither an entry of q or qd nor an effect, or a function that returns no number or
      uses an index out of range.
    """
    for channel, observable in observables:
        if not isinstance(observable, str) and not callable(observable):
            raise ValueError(
                f"observe must be a function of q and qd, or a name such as 'q[0]', but {channel} has {observable!r}."
            )
        if isinstance(observable, str):
            entry = _STATE.fullmatch(observable)
            known = [f"{x}[{i}]" for x in ("q", "qd") for i in range(y.q.shape[0])] + list(scene.names)
            if observable not in known:
                hint = "" if entry else did_you_mean(observable, known)
                raise ValueError(
                    f"observe: {channel} observes {observable!r}, but there are: {', '.join(known)}.{hint}"
                )
        shape = _shape(observable, y, scene)
        if shape != ():
            what = "observe(q, qd)" if not isinstance(observable, str) else f"{observable!r}"
            raise ValueError(f"{what} returned the shape {shape}, but one number, shape (), is needed.")


def _shape(observable: Observable, y: State, scene: Scene) -> Any:
    if callable(observable):
        return getattr(traced(observable, name="observe(q, qd)", q=y.q, qd=y.qd), "shape", None)
    look = lambda: observer(((".", observable),))(jnp.zeros((), y.q.dtype), y, scene)["."]  # noqa: E731
    return getattr(jax.eval_shape(look), "shape", None)


def observer(
    observables: tuple[tuple[str, Observable], ...],
) -> Callable[[Array, State, Scene], dict[str, Array]]:
    """A function of time, state and scene that returns what each channel sees."""

    def observe(t: Array, y: State, scene: Scene) -> dict[str, Array]:
        forces = scene_forces(t, y, scene) if any(needs_forces(x) for _, x in observables) else {}
        return {channel: observed(observable, y.q, y.qd, forces) for channel, observable in observables}

    return observe


def needs_forces(observable: Observable) -> bool:
    """Whether it is the force of an effect."""
    return isinstance(observable, str) and _STATE.fullmatch(observable) is None


def observed(observable: Observable, q: Array, qd: Array, forces: Mapping[str, Array]) -> Array:
    """What is seen where the effects have these forces."""
    if callable(observable):
        return observable(q, qd)
    entry = _STATE.fullmatch(observable)
    if entry is None:
        force = forces[observable]
        return jnp.reshape(force, ()) if force.size == 1 else force
    return (q if entry[1] == "q" else qd)[int(entry[2])]
