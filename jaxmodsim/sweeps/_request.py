"""What the caller of `sweep` asks for, checked and converted."""

import inspect
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from .._core.arguments import check_real, did_you_mean
from ..scene import Scene, elements, scene_numbers, scene_ranges
from ..simulation import run_request, simulate
from ._compute import shapes
from ._grid import Grid, GridAxis
from ._observe import Derivative, Observation, observations
from ._run import AbstractRun, FunctionRun, RunOutcome, SceneRun

# Arguments of `simulate` that are numbers. All others are compiled in.
_NUMBERS = ("q0", "qd0", "t1", "t0", "ts", "z0", "rtol", "atol", "dt", "dtmax")
# Those of them that can be swept.
_SWEPT = tuple(name for name in _NUMBERS if name not in ("ts", "z0"))
_UNITS = {"t0": "s", "t1": "s", "dt": "s", "dtmax": "s"}
_OPTIONS = {name: x.default for name, x in inspect.signature(simulate).parameters.items()}


@dataclass(frozen=True)
class Request:
    """A sweep, ready to run.

    - `run`: what is computed of one run, and `fixed` the numbers common to all.
    - `grid`: the numbers that differ, in the floating type they are used in.
    - `shapes`: of what a run gives.
    - `units`: of the numbers that are swept, as far as they are known.
    """

    run: AbstractRun
    fixed: PyTree
    grid: Grid
    shapes: RunOutcome
    units: dict[str, str]

    @property
    def observe(self) -> tuple[Observation, ...]:
        """What is kept of each run."""
        asked = getattr(self.run, "observe", None)
        return asked if asked is not None else tuple(Observation(name, name, "") for name in self.shapes.values)


def request(system: object, grid: Grid, observe: object, arguments: Mapping[str, object]) -> Request:
    """Check and convert what a sweep is asked for.

    **Raises:**

    - `ValueError` for what does not go together, before anything is compiled.
    """
    if isinstance(system, Scene):
        return _of_scene(system, grid, observe, dict(arguments))
    if not callable(system):
        raise ValueError(f"sweep needs a Scene or a function, but a {type(system).__name__} was given.")
    given = [name for name, value in arguments.items() if value is not None]
    if given:
        raise ValueError(
            f"{', '.join(given)} has no place beside a function: only a Scene is run by sweep itself. Pass it to"
            " simulate inside the function."
        )
    _check_taken(system, grid.values)
    run = FunctionRun(system, None if observe is None else observations(observe))
    for what in run.observe or ():
        if isinstance(what.of, Derivative):
            raise ValueError(f"observe[{what.name!r}]: derivatives are for a Scene; differentiate inside the function.")
    floating = jnp.result_type(float)
    converted = Grid(tuple(GridAxis(a.name, {n: x.astype(floating) for n, x in a.values.items()}) for a in grid.axes))
    return Request(run, (), converted, shapes(run, (), converted.first), {})


def _check_taken(function: Callable[..., object], names: Iterable[str]) -> None:
    """Refuse names that a function does not take, and those that are missing."""
    try:
        signature = inspect.signature(function)
    except (TypeError, ValueError):  # a function written in C does not say
        return
    try:
        signature.bind(**dict.fromkeys(names))
    except TypeError as error:
        raise ValueError(
            f"over must name what the function takes, {signature}, but it names {', '.join(names)}: {error}."
        ) from error


def _of_scene(scene: Scene, grid: Grid, observe: object, arguments: dict[str, object]) -> Request:
    arguments = {name: value for name, value in arguments.items() if value is not None}
    for name in arguments:
        if name in ("throw", "adjoint", "scene") or name not in _OPTIONS:
            hint = ": a run that fails gets its code" if name == "throw" else ""
            raise ValueError(f"sweep takes no argument {name!r}{hint}.")
    swept = grid.values
    for name in ("q0", "qd0", "t1"):
        if name not in arguments and name not in swept:
            raise ValueError(f"sweep of a scene needs {name}, as simulate does, or {name!r} in over.")
        if name in arguments and name in swept:
            raise ValueError(f"{name} is given, and {name!r} is in over: leave one of them out.")
    numbers, dtype = _fixed(scene, arguments, swept)
    inside, outside = _inside(scene), _outside(numbers)
    _check_names(inside, outside, swept)
    run = SceneRun(observations(observe), _choices(arguments))
    for what in run.observe:
        if isinstance(what.of, Derivative):
            _check_names(inside, outside, what.of.names, f"observe[{what.name!r}]")

    def convert(name: str, values: np.ndarray) -> np.ndarray:
        """Values in the type of the number they replace, if they have its shape."""
        shape = inside[name][0] if name in inside else outside[name]
        if values.shape[1:] != shape:
            raise ValueError(
                f"{name!r} in over must have the shape [{', '.join(['n', *map(str, shape)])}], as the number has the"
                f" shape {shape}, but it has {values.shape}."
            )
        return values.astype(inside[name][1] if name in inside else dtype)

    converted = Grid(
        tuple(GridAxis(a.name, {name: convert(name, x) for name, x in a.values.items()}) for a in grid.axes),
    )
    _check_runs(converted, numbers)
    # Let `simulate` look at the arguments of the first run while their values are known.
    given = numbers | {name: value for name, value in converted.first.items() if name in numbers}
    run_request(scene, **given, **dict(run.choices))
    ranges, units = scene_ranges(scene), dict(_UNITS)
    for name in swept:
        leaf = inside[name][2] if name in inside else name
        if leaf in ranges and ranges[leaf].unit:
            units[name] = ranges[leaf].unit
    return Request(run, (scene, numbers), converted, shapes(run, (scene, numbers), converted.first), units)


def _check_runs(grid: Grid, numbers: Mapping[str, Any]) -> None:
    """Refuse tolerances, steps and times that no run works with: compiled code would end all of them over one."""
    swept = grid.values
    for names, least in ((("rtol", "atol"), "not be negative"), (("dt", "dtmax"), "be positive")):
        for name in names:
            if name in swept and not (swept[name] >= 0 if "not" in least else swept[name] > 0).all():
                raise ValueError(f"{name!r} in over must {least}, but there is {swept[name].min():g}.")
    if "t0" not in swept and "t1" not in swept:
        return
    t0, t1 = (np.atleast_1d(swept[name] if name in swept else numbers[name]) for name in ("t0", "t1"))
    together = any({"t0", "t1"} <= set(axis.values) for axis in grid.axes)
    if (t1 - t0 if together else t1.min() - t0.max()).min() < 0:
        raise ValueError("t1 must not be before t0 in any run; numbers that go together share one dimension of over.")
    ts = numbers.get("ts")
    if ts is not None and not (t0.max() <= ts[0] and ts[-1] <= t1.min()):
        raise ValueError(
            f"ts must lie within [t0, t1] of every run, from {t0.max():g} to {t1.min():g}, but runs from {ts[0]:g} to"
            f" {ts[-1]:g}. Observe the motion at the end, or times as a part of t1 inside a function."
        )


def _inside(scene: Scene) -> dict[str, tuple[tuple[int, ...], np.dtype, str]]:
    """Shape, type and array of each number of a scene, arrays and their single entries alike, by name."""
    leaves = scene_numbers(scene)
    single = {name: ((), leaves[leaf].dtype, leaf) for name, (leaf, _) in elements(scene).items()}
    return single | {name: (leaf.shape, leaf.dtype, name) for name, leaf in leaves.items()}


def _outside(numbers: Mapping[str, Any]) -> dict[str, tuple[int, ...]]:
    """Shape of each argument of `simulate` that may be swept, vectors and their entries alike, by name."""
    known = {name: np.shape(numbers[name]) for name in _SWEPT if name in numbers}
    return known | {f"{name}[{i}]": () for name in ("q0", "qd0") for i in range(np.size(numbers[name]))}


def _fixed(
    scene: Scene, arguments: Mapping[str, Any], swept: Mapping[str, np.ndarray]
) -> tuple[dict[str, Any], np.dtype]:
    """Arguments of `simulate` that are numbers, one value of those that are swept; and the floating type."""
    numbers = {name: arguments[name] for name in _NUMBERS if name in arguments}
    numbers |= {name: swept[name][0] for name in _SWEPT if name in swept}
    numbers = {"rtol": _OPTIONS["rtol"], "atol": _OPTIONS["atol"], "t0": _OPTIONS["t0"]} | numbers
    for name, value in numbers.items():
        if name != "z0":
            check_real(value, name=name)
    states = [x for x in (*scene_numbers(scene).values(), numbers["q0"], numbers["qd0"]) if hasattr(x, "dtype")]
    dtype = jnp.result_type(*(x.dtype for x in states)) if states else jnp.result_type(float)
    if not jnp.issubdtype(dtype, jnp.floating):
        dtype = jnp.result_type(float)
    z0 = {"z0": numbers.pop("z0")} if "z0" in numbers else {}
    return {name: np.asarray(value, dtype) for name, value in numbers.items()} | z0, dtype


def _choices(arguments: Mapping[str, object]) -> tuple[tuple[str, Any], ...]:
    """Arguments that are compiled in."""
    given = {name: value for name, value in arguments.items() if name not in _NUMBERS}
    for name, value in given.items():
        try:
            hash(value)
        except TypeError:
            raise ValueError(f"{name} is compiled in and must be hashable, but {value!r} is not.") from None
    return tuple(({"max_steps": _OPTIONS["max_steps"]} | given).items())


def _check_names(
    inside: Mapping[str, object], outside: Mapping[str, object], names: Iterable[str], where: str = "over"
) -> None:
    """Refuse names of nothing, or of two things."""
    for name in names:
        if name in inside and name in outside:
            raise ValueError(f"{where} names {name!r}, which is a number of the scene and an argument: rename the one.")
        if name not in inside and name not in outside:
            known = [*sorted(inside), *sorted(outside)]
            hint = did_you_mean(name, known)
            extra = " Give a value of dt or dtmax to sweep it." if name in ("dt", "dtmax") else ""
            raise ValueError(f"{where} names {name!r}, but the numbers are: {', '.join(known)}.{hint}{extra}")
