"""What can be observed along a run by name."""

import re
from collections.abc import Callable
from typing import Any

from ._trajectory import Trajectory

_NAMED = re.compile(r"(.+?)(?:\[(\d+)\])?")


def named_observable(name: str, run: Trajectory) -> tuple[Callable[[Trajectory], Any], str]:
    """A function of runs like `run` that returns what `name` says at their times, shape `[time]`, and its unit.

    `q[0]` and `qd[0]` are coordinates and velocities, the name of an effect is its force, with `[i]` for a component.

    **Raises:**

    - `ValueError` for a name that is none of them.
    """
    dof = run.q.shape[1]
    states = {f"{kind}[{i}]": (kind, i) for kind in ("q", "qd") for i in range(dof)}
    if name in states:
        kind, i = states[name]
        return lambda run: getattr(run, kind)[:, i], "m or rad" if kind == "q" else "m/s or rad/s"
    match = _NAMED.fullmatch(name)
    effect, index = (name, None) if name in run.scene.names or match is None else match.groups()
    shape = run.forces[effect].shape[1:] if effect in run.scene.names else None
    if shape is None or len(shape) != (index is not None) or (index is not None and int(index) >= shape[0]):
        names = [*states]
        for each, force in run.forces.items():
            names += [f"{each}[{i}]" for i in range(force.shape[1])] if force.ndim == 2 else [each]
        raise ValueError(f"No observable has the name {name!r}; there are: {', '.join(names)}; or a function.")
    if index is None:
        return lambda run: run.forces[effect], "N or N m"
    return lambda run: run.forces[effect][:, int(index)], "N or N m"
