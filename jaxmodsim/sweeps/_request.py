"""The arguments of `sweep`, checked and converted."""

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
from ._run import AbstractRun, Derivative, FunctionRun, Observation, RunOutcome, SceneRun, observations

# Numeric arguments of `simulate`. All others are static.
_NUMBERS = ("q0", "qd0", "t1", "t0", "ts", "z0", "rtol", "atol", "dt", "dtmax")
# Numeric arguments that can be swept.
_SWEPT = tuple(name for name in _NUMBERS if name not in ("ts", "z0"))
_UNITS = {"t0": "s", "t1": "s", "dt": "s", "dtmax": "s"}
_OPTIONS = {name: x.default for name, x in inspect.signature(simulate).parameters.items()}
# Arguments of `simulate` that `sweep` takes, and its own, for hints.
_TAKEN = [name for name in _OPTIONS if name not in ("scene", "throw", "adjoint")]
_OWN = ["over", "observe", "out", "executor", "devices", "chunk", "progress"]


@dataclass(frozen=True)
class Request:
    """A sweep, ready to run.

    - `run`: the computation of one run; `fixed`: the values common to all runs.
    - `grid`: the numbers that differ, in their floating type.
    - `shapes`: shapes and types of the results of a run.
    - `units`: known units of the swept numbers.
    """

    run: AbstractRun
    fixed: PyTree
    grid: Grid
    shapes: RunOutcome
    units: dict[str, str]

    @property
    def observe(self) -> tuple[Observation, ...]:
        """The observables of each run."""
        observe = getattr(self.run, "observe", None)
        return observe if observe is not None else tuple(Observation(name, name, "") for name in self.shapes.values)


def request_of(system: object, grid: Grid, observe: object, arguments: Mapping[str, object]) -> Request:
    """Check and convert the arguments of a sweep.

    **Raises:**

    - `ValueError` for wrong arguments, before anything is compiled.
    """
    arguments = {name: value for name, value in arguments.items() if value is not None}
    for name in arguments:
        if name not in _TAKEN:
            hint = " A run that fails gets its code." if name == "throw" else did_you_mean(name, [*_OWN, *_TAKEN])
            raise ValueError(f"sweep takes no argument {name!r}.{hint}")
    if isinstance(system, Scene):
        return _of_scene(system, grid, observe, arguments)
    if not callable(system):
        raise ValueError(f"sweep needs a Scene or a function, but a {type(system).__name__} was given.")
    if arguments:
        raise ValueError(
            f"sweep of a function takes no {', '.join(arguments)}, which only a Scene uses: pass it to simulate inside"
            " the function."
        )
    _check_arguments(system, grid.values)
    run = FunctionRun(system, None if observe is None else observations(observe))
    for each in run.observe or ():
        if isinstance(each.of, Derivative):
            raise ValueError(f"observe[{each.name!r}]: derivatives need a Scene; differentiate inside the function.")
    floating = jnp.result_type(float)
    converted = Grid(tuple(GridAxis(a.name, {n: x.astype(floating) for n, x in a.values.items()}) for a in grid.axes))
    return Request(run, (), converted, shapes(run, (), converted.first), {})


def _check_arguments(function: Callable[..., object], names: Iterable[str]) -> None:
    """Check that the names are those of the function's arguments."""
    try:
        signature = inspect.signature(function)
    except (TypeError, ValueError):  # functions in C have no signature
        return
    try:
        signature.bind(**dict.fromkeys(names))
    except TypeError as error:
        raise ValueError(
            f"over must name the arguments of the function, {signature}, but it names {', '.join(names)}: {error}."
        ) from error


def _of_scene(scene: Scene, grid: Grid, observe: object, arguments: dict[str, object]) -> Request:
    swept = grid.values
    for name in ("q0", "qd0", "t1"):
        if name not in arguments and name not in swept:
            raise ValueError(f"sweep of a scene needs {name}, as simulate does, or {name!r} in over.")
        if name in arguments and name in swept:
            raise ValueError(f"{name} is given, and {name!r} is in over: omit one of them.")
    numbers, dtype = _fixed(scene, arguments, swept)
    inside, outside = _inside(scene), _outside(numbers)
    _check_names(inside, outside, swept)
    run = SceneRun(observations(observe), _choices(arguments))
    for each in run.observe:
        if isinstance(each.of, Derivative):
            _check_names(inside, outside, each.of.names, f"observe[{each.name!r}]")

    def convert(name: str, values: np.ndarray) -> np.ndarray:
        """Check the shape of the values and convert them to the type of the number that they replace."""
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
    _check_ranges(scene, {name: inside[name][2] for name in swept if name in inside}, converted.values)
    # `simulate` checks the arguments of the first run, while their values are known.
    first = numbers | {name: value for name, value in converted.first.items() if name in numbers}
    run_request(scene, **first, **dict(run.choices))
    ranges, units = scene_ranges(scene), dict(_UNITS)
    for name in swept:
        leaf = inside[name][2] if name in inside else name
        if leaf in ranges and ranges[leaf].unit:
            units[name] = ranges[leaf].unit
    return Request(run, (scene, numbers), converted, shapes(run, (scene, numbers), converted.first), units)


def _check_runs(grid: Grid, numbers: Mapping[str, Any]) -> None:
    """Check tolerances, steps and times, as a single wrong one would end all compiled runs."""
    swept = grid.values
    for names, least in ((("rtol", "atol"), "not be negative"), (("dt", "dtmax"), "be positive")):
        for name in names:
            if name in swept and not (swept[name] >= 0 if "not" in least else swept[name] > 0).all():
                raise ValueError(f"{name!r} in over must {least}, but its minimum is {swept[name].min():g}.")
    if "t0" not in swept and "t1" not in swept:
        return
    t0, t1 = (np.atleast_1d(swept[name] if name in swept else numbers[name]) for name in ("t0", "t1"))
    together = any({"t0", "t1"} <= set(axis.values) for axis in grid.axes)
    if (t1 - t0 if together else t1.min() - t0.max()).min() < 0:
        raise ValueError("t1 must not be before t0 in any run; numbers that change together share a dimension of over.")
    ts = numbers.get("ts")
    if ts is not None and not (t0.max() <= ts[0] and ts[-1] <= t1.min()):
        raise ValueError(
            f"ts must lie within [t0, t1] of every run, from {t0.max():g} to {t1.min():g}, but runs from {ts[0]:g} to"
            f" {ts[-1]:g}. Observe the end of the motion, or set ts relative to t1 inside a function."
        )


def _check_ranges(scene: Scene, leaves: Mapping[str, str], swept: Mapping[str, np.ndarray]) -> None:
    """Refuse values out of range; the runs check limits that are arrays, or change as well. `leaves`: their arrays."""
    numbers = scene_numbers(scene)
    for number, allowed in scene_ranges(scene).items():
        pair = {each for each in (number, allowed.lower) if isinstance(each, str)}
        for name, leaf in leaves.items():
            others = pair - {leaf}
            if others == pair or any(each in leaves.values() or numbers[each].shape for each in others):
                continue
            now = {**numbers, leaf: swept[name]}
            wrong = np.argwhere(~np.asarray(allowed.holds(now[number], now))).tolist()
            if wrong:
                value = swept[name][tuple(wrong[0])]
                raise ValueError(f"{name!r} in over is {value:g} at {wrong[0]}, but {number} must be {allowed.text}.")


def _inside(scene: Scene) -> dict[str, tuple[tuple[int, ...], np.dtype, str]]:
    """Shape, type and array of each number of a scene, by name: arrays and their single entries."""
    leaves = scene_numbers(scene)
    single = {name: ((), leaves[leaf].dtype, leaf) for name, (leaf, _) in elements(scene).items()}
    return single | {name: (leaf.shape, leaf.dtype, name) for name, leaf in leaves.items()}


def _outside(numbers: Mapping[str, Any]) -> dict[str, tuple[int, ...]]:
    """Shape of each argument of `simulate` that can be swept, by name: vectors and their entries."""
    known = {name: np.shape(numbers[name]) for name in _SWEPT if name in numbers}
    return known | {f"{name}[{i}]": () for name in ("q0", "qd0") for i in range(np.size(numbers[name]))}


def _fixed(
    scene: Scene, arguments: Mapping[str, Any], swept: Mapping[str, np.ndarray]
) -> tuple[dict[str, Any], np.dtype]:
    """Numeric arguments of `simulate`, with the first value of swept ones, and the floating type."""
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
    """Static arguments."""
    choices = {name: value for name, value in arguments.items() if name not in _NUMBERS}
    for name, value in choices.items():
        try:
            hash(value)
        except TypeError:
            raise ValueError(f"{name} is static under jax.jit and must be hashable, but {value!r} is not.") from None
    return tuple(({"max_steps": _OPTIONS["max_steps"]} | choices).items())


def _check_names(
    inside: Mapping[str, object], outside: Mapping[str, object], names: Iterable[str], where: str = "over"
) -> None:
    """Check that each name is known and unique."""
    for name in names:
        if name in inside and name in outside:
            raise ValueError(f"{where} names {name!r}, a number of the scene and also an argument: rename the former.")
        if name not in inside and name not in outside:
            known = [*sorted(inside), *sorted(outside)]
            hint = did_you_mean(name, known)
            extra = " To sweep dt or dtmax, also pass a value of it." if name in ("dt", "dtmax") else ""
            raise ValueError(f"{where} names {name!r}, but the numbers are: {', '.join(known)}.{hint}{extra}")
