"""The motion of a record, as far as the model's output shows it without another run."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ..scene import Friction
from ._observe import Observable, first_coordinate
from ._record import Record

# Two states at which a function that observes a coordinate tells itself apart from others.
_PROBES = ((0.73, -1.31), (-0.29, 0.57))


class Motion(NamedTuple):
    """Coordinates and velocities of a record by number, shape `[samples]` each, and its times [s]."""

    t: Float[np.ndarray, " samples"]
    q: dict[int, Float[np.ndarray, " samples"]]
    qd: dict[int, Float[np.ndarray, " samples"]]


class Slip(NamedTuple):
    """Slip of a friction element: times [s], displacement [m or rad] and velocity, shape `[samples]` each."""

    t: Float[np.ndarray, " samples"]
    x: Float[np.ndarray, " samples"]
    v: Float[np.ndarray, " samples"]


def coordinates_seen(observables: tuple[tuple[str, Observable], ...], dof: int) -> dict[str, str]:
    """Which channels are a coordinate or a velocity, `q[0]` or `qd[0]`, by channel."""
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


def _recognised(observable: Any, dof: int) -> str:
    """The entry of q or qd that a function returns."""
    matches = {f"{x}[{i}]" for x in ("q", "qd") for i in range(dof)}
    for a, b in _PROBES:
        q, qd = a + 0.11 * np.arange(dof), b - 0.17 * np.arange(dof)
        got = float(observable(jnp.asarray(q), jnp.asarray(qd)))
        states = {f"q[{i}]": x for i, x in enumerate(q)} | {f"qd[{i}]": x for i, x in enumerate(qd)}
        matches = {name for name in matches if np.isclose(got, states[name], rtol=1e-5, atol=0.0)}
    return next(iter(matches), "")


def motion_of(record: Record, outputs: Mapping[str, np.ndarray], seen: Mapping[str, str]) -> Motion:
    """The motion that the model ran through, or that an input of a law gave; velocities by difference if need be."""
    q: dict[int, np.ndarray] = {}
    qd: dict[int, np.ndarray] = {}
    for channel, name in seen.items():
        x = outputs.get(channel, record.inputs.get(channel))
        if x is not None:
            into = qd if name.startswith("qd") else q
            into.setdefault(int(name.split("[")[1][:-1]), np.asarray(x, float))
    for i, x in q.items():
        qd.setdefault(i, np.gradient(x, record.t))
    return Motion(record.t, q, qd)


def slip_of(effect: Friction, motion: Motion, params: Any, dof: int) -> Slip | None:
    """Slip of an element; None where it is a vector or not all of the motion is known."""
    if set(motion.q) != set(range(dof)):
        return None
    q, qd = (np.stack([each[i] for i in range(dof)], axis=1) for each in (motion.q, motion.qd))
    states = (jnp.asarray(motion.t), jnp.asarray(q), jnp.asarray(qd))
    v = np.asarray(jax.vmap(lambda t, q, qd: effect.slip(t, q, qd, params))(*states))
    if v.ndim > 1 or not np.isfinite(v).all():
        return None
    x = np.concatenate([[0.0], np.cumsum(0.5 * np.diff(motion.t) * (v[1:] + v[:-1]))])
    return Slip(motion.t, x, v)
