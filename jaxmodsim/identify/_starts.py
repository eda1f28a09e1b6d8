"""States at the beginning of records: what is known, what is free, and what the samples say."""

import re
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..scene import State
from ._observe import Observable, first_coordinate
from ._record import Record

# Samples at the beginning of a record, from which position and velocity are estimated.
_SAMPLES = 20

_LOCAL = re.compile(r"(q0|qd0)\[(\d+)\]|z0\.(.+?)(?:\[(\d+)\])?")


def start_state(record: Record, channel: str | None = None) -> tuple[float, float]:
    """Position and velocity at the first sample, by a parabola through the first 20.

    **Arguments:**

    - `record`: its `channel`, by default the only one, is a position [m or rad].

    **Returns:**

    Position and velocity.
    """
    x = record.measured if channel is None else record.channels[channel]
    count = min(_SAMPLES, len(record.t))
    t = record.t[:count] - record.t[0]
    found = np.polynomial.polynomial.polyfit(t, x[:count], min(2, count - 1))
    return float(found[0]), float(found[1])


def local_names(y: State) -> tuple[str, ...]:
    """Names of the numbers of an initial state: `q0[0]`, `qd0[0]`, `z0.friction`."""
    dof = y.q.shape[0]
    names = [f"q0[{i}]" for i in range(dof)] + [f"qd0[{i}]" for i in range(dof)]
    for effect, z in y.z.items():
        if isinstance(z, jnp.ndarray):
            names += [f"z0.{effect}"] if z.ndim == 0 else [f"z0.{effect}[{i}]" for i in range(z.shape[0])]
    return tuple(names)


def placed(base: State, names: tuple[str, ...], values: Float[Array, " local"]) -> State:
    """The state with the numbers of these names replaced."""
    q, qd, z = base.q, base.qd, dict(base.z)
    for i, name in enumerate(names):
        found = _LOCAL.fullmatch(name)
        assert found is not None
        if found[1] == "q0":
            q = q.at[int(found[2])].set(values[i])
        elif found[1] == "qd0":
            qd = qd.at[int(found[2])].set(values[i])
        else:
            effect = found[3]
            z[effect] = values[i] if found[4] is None else z[effect].at[int(found[4])].set(values[i])
    return State(q, qd, z)


def taken(state: State, names: tuple[str, ...]) -> Float[Array, " local"]:
    """The numbers of these names; the inverse of `placed`."""
    numbers = []
    for name in names:
        found = _LOCAL.fullmatch(name)
        assert found is not None
        if found[1] is not None:
            numbers.append((state.q if found[1] == "q0" else state.qd)[int(found[2])])
        else:
            z = state.z[found[3]]
            numbers.append(z if found[4] is None else z[int(found[4])])
    return jnp.stack(numbers) if numbers else jnp.zeros(0)


def measured_start(
    record: Record, observables: tuple[tuple[str, Observable], ...], dof: int, *, exact: bool
) -> tuple[Any, Any]:
    """Coordinates and velocities at the first sample, as far as they were measured; the others are zero.

    With `exact` the position is the first sample and the velocity zero.
    """
    q, qd = np.zeros(dof), np.zeros(dof)
    for channel, observable in observables:
        if channel not in record.channels:
            continue
        for i in range(dof):
            if observable == f"q[{i}]" or (i == 0 and observable is first_coordinate):
                q[i], qd[i] = (record.channels[channel][0], 0.0) if exact else start_state(record, channel)
    for channel, observable in observables:
        for i in range(dof):
            if channel in record.channels and observable == f"qd[{i}]":
                qd[i] = record.channels[channel][0]
    return q, qd
