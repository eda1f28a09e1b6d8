"""The SPEC of `jaxmodsim orbit` and `jaxmodsim branch`: a TOML file that says which scene, orbit and branch."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from jaxtyping import Array, PyTree
from pydantic import Field

from ..scene import Scene
from . import _table
from ._spec_scene import read_system


class _OrbitSpecTable(_table.AbstractTable):
    scene: _table.Table
    orbit: _table.Table
    branch: _table.Table | None = None


class _OrbitTable(_table.AbstractTable):
    q0: _table.Numbers
    qd0: _table.Numbers
    period: _table.Number | None = None
    frequency: _table.Text | None = None
    settle: _table.Number | None = None
    rtol: _table.Number | None = None
    atol: _table.Number | None = None


class _BranchTable(_table.AbstractTable):
    parameter: _table.Text
    first: _table.Number = Field(alias="from")
    to: _table.Number
    start: Literal["orbit", "Hopf"] = "orbit"
    step: _table.Number | None = None
    max_orbits: _table.Whole | None = None


@dataclass(frozen=True)
class PeriodOf:
    """The period of a force whose angular frequency [rad/s] is an entry of `params`."""

    frequency: str

    def __call__(self, params: PyTree) -> Array:
        """The period [s]."""
        return 2.0 * math.pi / params[self.frequency]


@dataclass(frozen=True)
class OrbitSpec:
    """Which orbit, and which branch: arguments of `periodic_orbit` and `continue_orbits`, read from a file.

    - `guess`: `(q0, qd0)`; `options`: `period` and others that both functions take.
    - `branch`: those of the branch alone, without `progress` and `out`; None where the file has none.
    - `from_rest`: whether the branch begins at the first Hopf point of the equilibria from `q0`.
    """

    scene: Scene
    guess: tuple[list[float], list[float]]
    options: dict[str, Any]
    branch: dict[str, Any] | None
    from_rest: bool = False


def read_orbit_spec(path: Path) -> OrbitSpec:
    """Read a SPEC.

    **Raises:**

    - `ValueError` for a mistake in it, as one sentence with the table and the key.
    """
    file, name = _table.read_toml(path), path.name
    whole = _table.read_table(_OrbitSpecTable, file, name)
    scene = read_system(whole.scene, _table.inner(name, "scene"), path.parent)
    if not isinstance(scene, Scene):
        raise ValueError(f"{_table.inner(name, 'scene')}: object must be a Scene, but it is a function.")
    where = _table.inner(name, "orbit")
    options = _table.read_table(_OrbitTable, whole.orbit, where).model_dump(exclude_none=True)
    guess, frequency = (options.pop("q0"), options.pop("qd0")), options.pop("frequency", None)
    if frequency is not None:
        if "period" in options:
            raise ValueError(f"{where}: period and frequency are given; one of them says how long a period is.")
        if not isinstance(scene.params, dict) or frequency not in scene.params:
            known = ", ".join(scene.params) if isinstance(scene.params, dict) else "none"
            raise ValueError(
                f"{where}: frequency must be the name of an entry of params, which is the angular frequency [rad/s] of"
                f" the force, but {frequency!r} was given; there are: {known}."
            )
        options["period"] = PeriodOf(frequency)
    if whole.branch is None:
        return OrbitSpec(scene, guess, options, None)
    branch = _table.read_table(_BranchTable, whole.branch, _table.inner(name, "branch")).model_dump(exclude_none=True)
    branch["span"] = (branch.pop("first"), branch.pop("to"))
    from_rest = branch.pop("start") == "Hopf"
    if from_rest and not {"period", "settle"}.isdisjoint(options):
        raise ValueError(
            f'{where}: orbits from a Hopf point on have their own period, and do not settle: with start = "Hopf" leave'
            " period, frequency and settle out."
        )
    return OrbitSpec(scene, guess, options, branch, from_rest)
