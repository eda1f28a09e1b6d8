"""A branch on disk, written as it grows, from which the same call resumes."""

import json
import os
import shutil
import uuid
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TypeAlias

import jax.numpy as jnp
import numpy as np

from .._core.system import extra
from ..scene import Scene, scene_numbers
from ._branch import BifurcationPoint
from ._orbit import PeriodicOrbit, describe
from ._orbit_step import OrbitStep
from ._return_map import OrbitError, OrbitProblem, ShotOrbit, evaluate, pack

# Kind, value, index, phase, period, state and direction.
_StoredPoint: TypeAlias = tuple[str, float, int, float, float, list[float], list[float]]

# Number of orbits between two writes.
_OFTEN = 20


class BranchStore:
    """A Zarr store of a branch: states, periods and values of its orbits, and derived quantities.

    **Raises:**

    - `ValueError` if the folder is no store of a branch, or of another branch.
    """

    def __init__(self, path: Path, scene: Scene, parameter: str, span: Sequence[float]) -> None:
        """Open a store, or prepare a new one."""
        self._path, self.steps = path, 0
        numbers = {name: np.asarray(x).tolist() for name, x in scene_numbers(scene).items()}
        self._about = {"parameter": parameter, "span": list(span), "numbers": numbers}
        self._arrays: dict[str, np.ndarray] = {}
        self._points: list[_StoredPoint] = []
        if self._before.exists() and not path.exists():
            os.rename(self._before, path)  # the process was killed between the two renames of `write`
        if not path.exists():
            return
        try:
            stored = extra("xarray").open_zarr(path, consolidated=False, chunks=None)
            about, self._points = json.loads(stored.attrs["branch"]), json.loads(stored.attrs["points"])
            self._arrays = {name: np.asarray(x) for name, x in stored.items()}
        except (KeyError, ValueError, OSError) as error:
            raise ValueError(
                f"{path} is no store of a branch ({type(error).__name__}): pass another folder as out, or remove it."
            ) from error
        changed = [name for name, x in self._about.items() if about.get(name) != x]
        if changed:
            raise ValueError(
                f"{path} holds another branch, which differs in: {', '.join(changed)}. Pass another folder as out, or"
                " remove it."
            )
        self.steps = len(self._arrays["value"])

    def read(self, begin: OrbitStep) -> tuple[list[OrbitStep], list[BifurcationPoint[PeriodicOrbit]]]:
        """The stored orbits and bifurcations, computed again from their states."""
        steps, points, dof = [], [], len(begin.orbit.q)
        stored = zip(*(self._arrays[name] for name in ("state", "period", "value", "tangent", "phase")), strict=True)
        for x, period, value, sense, phase in stored:
            problem = replace(begin.problem, phase=jnp.asarray(phase), anchor=jnp.asarray(x))
            shot = self._shot(problem, x, float(period), float(value), dof)
            steps.append(begin.next_at(problem, shot, describe(problem, shot, dof)[0], sense))
        for kind, value, index, phase, period, x, direction in self._points:
            problem = replace(begin.problem, phase=jnp.asarray(phase))
            shot = self._shot(problem, np.asarray(x), period, value, dof)
            orbit = describe(problem, shot, dof)[0]
            points.append(BifurcationPoint(kind, value, index, orbit, np.asarray(direction)))
        return steps, points

    def _shot(self, problem: OrbitProblem, x: np.ndarray, period: float, value: float, dof: int) -> ShotOrbit:
        shot = evaluate(problem, x[None], period, np.array([value]), dof)
        if shot.failure:
            raise OrbitError(f"The run of an orbit stored in {self._path} fails: {shot.failure}")
        return shot

    def write_often(self, steps: list[OrbitStep], points: list[BifurcationPoint[PeriodicOrbit]]) -> None:
        """Write the branch after every twentieth orbit."""
        if len(steps) % _OFTEN == 0:
            self.write(steps, points)

    def write(self, steps: list[OrbitStep], points: list[BifurcationPoint[PeriodicOrbit]]) -> None:
        """Write the whole branch, and replace the former store atomically."""
        orbits = [each.orbit for each in steps]
        multipliers = np.array([each.multipliers for each in orbits])
        rows = {
            "phase": ("orbit", [float(each.problem.phase) for each in steps]),
            "value": ("orbit", [each.shot.value for each in steps]),
            "period": ("orbit", [each.shot.period for each in steps]),
            "state": (("orbit", "entry"), [each.shot.x[0] for each in steps]),
            "tangent": (("orbit", "unknown"), [each.tangent * each.scale for each in steps]),
            "lowest": (("orbit", "coordinate"), [np.asarray(each.lowest) for each in orbits]),
            "highest": (("orbit", "coordinate"), [np.asarray(each.highest) for each in orbits]),
            "advance": (("orbit", "coordinate"), [np.asarray(each.advance) for each in orbits]),
            "multipliers_real": (("orbit", "multiplier"), np.real(multipliers)),
            "multipliers_imaginary": (("orbit", "multiplier"), np.imag(multipliers)),
            "stable": ("orbit", [each.stable for each in orbits]),
        }
        stored: list[_StoredPoint] = []
        for each in points:
            x, phase = np.asarray(pack(each.orbit.state)).tolist(), float(each.orbit.t0 / each.orbit.period)
            period, direction = float(each.orbit.period), each.direction.tolist()
            stored.append((each.kind, each.value, each.index, phase, period, x, direction))
        attrs = {"branch": json.dumps(self._about), "points": json.dumps(stored)}
        data = extra("xarray").Dataset({name: (dims, np.array(x)) for name, (dims, x) in rows.items()}, attrs=attrs)
        self._path.parent.mkdir(parents=True, exist_ok=True)
        scratch = self._path.with_name(f".{self._path.name}.{uuid.uuid4().hex}")
        data.to_zarr(scratch, mode="w", zarr_format=3, consolidated=False)
        if self._path.exists():
            shutil.rmtree(self._before, ignore_errors=True)
            os.rename(self._path, self._before)
        os.rename(scratch, self._path)
        shutil.rmtree(self._before, ignore_errors=True)

    @property
    def _before(self) -> Path:
        """Path of the former store while it is replaced."""
        return self._path.with_name(f".{self._path.name}.before")
