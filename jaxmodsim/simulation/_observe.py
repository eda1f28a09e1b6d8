"""Series along a run by name."""

import re

from jaxtyping import Array, Float

from ..scene import describe_series
from ._integrated_system import Series
from ._trajectory import Trajectory

_STATE = re.compile(r"(q|qd)\[(\d+)\]")
_FORCE = re.compile(r"(.+?)(?:\[(\d+)\])?")


def find_series(run: Trajectory, name: str) -> Series:
    """The series of this name, see `named_series`."""
    dof, state = run.q.shape[1], _STATE.fullmatch(name)
    if state is not None and int(state[2]) < dof:
        return Series(state[1], "", int(state[2]))
    forces, match = run.forces, _FORCE.fullmatch(name)
    effect, index = (name, None) if name in forces or match is None else match.groups()
    if effect in forces:
        force = forces[effect]
        if index is None and force.ndim == 1:
            return Series("force", effect, None)
        if index is not None and force.ndim == 2 and int(index) < force.shape[1]:
            return Series("force", effect, int(index))
    names = [describe_series(run.scene, f"{kind}[{i}]") for kind in ("q", "qd") for i in range(dof)]
    for each, force in forces.items():
        names += [f"{each}[{i}]" for i in range(force.shape[1])] if force.ndim == 2 else [each]
    raise ValueError(f"No observable has the name {name!r}; there are: {', '.join(names)}; or a function.")


def read_series(run: Trajectory, series: Series) -> Float[Array, " time"]:
    """A series at the times of a run."""
    kind, effect, index = series
    whole = run.forces[effect] if kind == "force" else run.q if kind == "q" else run.qd
    return whole if index is None else whole[:, index]


def named_series(run: Trajectory, name: str) -> Float[Array, " time"]:
    """The series `name` at the times of a run.

    `q[0]` and `qd[0]` are coordinates and velocities, the name of an effect is its force, with `[i]` for a component.

    **Returns:**

    The series, shape `[time]`.

    **Raises:**

    - `ValueError` for any other name.
    """
    return read_series(run, find_series(run, name))


def named_unit(name: str) -> str:
    """Unit of a series; a coordinate is a length or an angle.

    **Returns:**

    The unit, such as `m/s or rad/s`.
    """
    state = _STATE.fullmatch(name)
    return "N or N m" if state is None else "m or rad" if state[1] == "q" else "m/s or rad/s"
