"""Observed quantities of a record, functions or names, and the motion that its channels show."""

import re
from collections.abc import Callable, Mapping
from typing import NamedTuple, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree
from scipy.integrate import cumulative_trapezoid

from ..._core.arguments import as_mapping, did_you_mean
from ..._core.arrays import on_device
from ..._core.trace_checks import traced
from ...scene import Friction, Scene, State, forward_dynamics
from ..data._record import Record

# `observe(q, qd)`, or "q[0]", "qd[1]", or the name of an effect, for its force.
Observable: TypeAlias = Callable[[Array, Array], Array] | str
# What each channel observes, as a hashable mapping.
Observables: TypeAlias = tuple[tuple[str, Observable], ...]
_STATE = re.compile(r"(q|qd)\[(\d+)\]")
# Two states that identify a function which returns a coordinate.
_PROBES = ((0.73, -1.31), (-0.29, 0.57))


def first_coordinate(q: Array, qd: Array) -> Array:
    """The first coordinate, as from a position sensor on one axis."""
    del qd
    return q[0]


def by_channel(observe: Observable | Mapping[str, Observable], records: tuple[Record, ...]) -> Observables:
    """The observable of each channel of the records.

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


def check_observables(observables: Observables, scene: Scene, y: State) -> None:
    """Refuse observables that are no numbers of the scene.

    **Raises:**

    - `ValueError` for a name that is neither an entry of q or qd nor an effect, or a function that returns no number or
      uses an index out of range.
    """
    for channel, observable in observables:
        if isinstance(observable, str):
            known = [f"{x}[{i}]" for x in ("q", "qd") for i in range(y.q.shape[0])] + list(scene.names)
            if observable not in known:
                hint = "" if _STATE.fullmatch(observable) else did_you_mean(observable, known)
                raise ValueError(
                    f"observe: {channel} observes {observable!r}, but there are: {', '.join(known)}.{hint}"
                )
            what, look = repr(observable), observer(((channel, observable),))
            value = jax.eval_shape(lambda look=look: look(jnp.zeros((), y.q.dtype), y, scene, None))[channel]
        elif callable(observable):
            what, value = "observe(q, qd)", traced(observable, name="observe(q, qd)", q=y.q, qd=y.qd)
        else:
            raise ValueError(
                f"observe must be a function of q and qd, or a name such as 'q[0]', but {channel} has {observable!r}."
            )
        if (shape := getattr(value, "shape", None)) != ():
            raise ValueError(f"{what} returned the shape {shape}, but one number, shape (), is needed.")


def observer(
    observables: Observables,
) -> Callable[[Array, State, Scene, Array | None], dict[str, Array]]:
    """A function of time, state, scene and modes that returns the observed number of each channel."""

    def observe(t: Array, y: State, scene: Scene, mode: Array | None) -> dict[str, Array]:
        forces = forward_dynamics(t, y, scene, mode).forces if any(needs_forces(x) for _, x in observables) else {}
        return {channel: observed(observable, y.q, y.qd, forces) for channel, observable in observables}

    return observe


def needs_forces(observable: Observable) -> bool:
    """Whether it is the force of an effect."""
    return isinstance(observable, str) and _STATE.fullmatch(observable) is None


def observed(observable: Observable, q: Array, qd: Array, forces: Mapping[str, Array]) -> Array:
    """The observed number for these forces of the effects."""
    if callable(observable):
        return observable(q, qd)
    entry = _STATE.fullmatch(observable)
    if entry is None:
        force = forces[observable]
        return jnp.reshape(force, ()) if force.size == 1 else force
    return (q if entry[1] == "q" else qd)[int(entry[2])]


class RecordedMotion(NamedTuple):
    """Coordinates and velocities of a record by number, shape `[samples]` each, and its times [s]."""

    t: Float[np.ndarray, " samples"]
    q: dict[int, Float[np.ndarray, " samples"]]
    qd: dict[int, Float[np.ndarray, " samples"]]


class Slip(NamedTuple):
    """Slip of a friction element: displacement [m or rad] and velocity, shape `[samples]` each."""

    x: Float[np.ndarray, " samples"]
    v: Float[np.ndarray, " samples"]


def coordinates_seen(observables: Observables, dof: int) -> dict[str, str]:
    """Coordinates and velocities among the channels, such as `q[0]`, by channel."""
    seen = {}
    for channel, observable in observables:
        if observable is first_coordinate:
            seen[channel] = "q[0]"
        elif isinstance(observable, str):
            if observable.startswith(("q[", "qd[")):
                seen[channel] = observable
        elif name := _recognised(observable, dof):
            seen[channel] = name
    return seen


def _recognised(observable: Callable[[Array, Array], Array], dof: int) -> str:
    """The entry of q or qd that a function returns, or ""."""
    matches = {f"{x}[{i}]" for x in ("q", "qd") for i in range(dof)}
    for a, b in _PROBES:
        q, qd = a + 0.11 * np.arange(dof), b - 0.17 * np.arange(dof)
        got = np.asarray(observable(jnp.asarray(q), jnp.asarray(qd)))
        if got.shape != ():
            return ""
        states = {f"q[{i}]": x for i, x in enumerate(q)} | {f"qd[{i}]": x for i, x in enumerate(qd)}
        matches = {name for name in matches if np.isclose(got, states[name], rtol=1e-5, atol=0.0)}
    return next(iter(matches), "")


def motion_of(record: Record, outputs: Mapping[str, np.ndarray], seen: Mapping[str, str]) -> RecordedMotion:
    """The motion of the model, or of the input of a law; velocities by differentiation if they are not observed."""
    q: dict[int, np.ndarray] = {}
    qd: dict[int, np.ndarray] = {}
    for channel, name in seen.items():
        x = outputs.get(channel, record.inputs.get(channel))
        if x is not None:
            into = qd if name.startswith("qd") else q
            into.setdefault(int(name.split("[")[1][:-1]), np.asarray(x, float))
    for i, x in q.items():
        qd.setdefault(i, np.gradient(x, record.t))
    return RecordedMotion(record.t, q, qd)


def slip_of(effect: Friction | None, motion: RecordedMotion, params: PyTree, dof: int) -> Slip | None:
    """Slip of an element, or the motion of a law by itself; None for a vector or an unknown motion."""
    if set(motion.q) != set(range(dof)):
        return None
    if effect is None:
        v = motion.qd[0]
    else:
        q, qd = (np.stack([each[i] for i in range(dof)], axis=1) for each in (motion.q, motion.qd))
        v = np.asarray(_slips(effect, params, *(on_device(each) for each in (motion.t, q, qd))))
    if v.ndim > 1 or not np.isfinite(v).all():
        return None
    return Slip(cumulative_trapezoid(v, motion.t, initial=0.0), v)


@eqx.filter_jit
def _slips(effect: Friction, params: PyTree, t: Array, q: Array, qd: Array) -> Array:
    return jax.vmap(lambda t, q, qd: effect.slip(t, q, qd, params))(t, q, qd)
