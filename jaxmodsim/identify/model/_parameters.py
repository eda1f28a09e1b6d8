"""Numbers of a model by name, entry by entry; those that a fit may change, in coordinates whose limits are a box."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple, TypeAlias, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from ..._core.arrays import on_device
from ..._core.parameters import Range
from ...friction import AbstractLaw
from ...scene import Scene, replace_numbers, scene_numbers

# Lower limit of a parameter: a number, another parameter, or sigma1, Fs and Fc of a law that must be passive.
Floor: TypeAlias = float | str | tuple[str, str, str] | None
# Bound of logarithmic coordinates, short of overflow, and their longest step in one iteration: a linearisation says
# nothing about a change by more than such a factor.
_MOST_DECADES, _LONGEST_LOG_STEP = 60.0, 1.5
# Least distance from a limit that a logarithm is taken of, and least unit of a parameter without limits.
_LEAST_DISTANCE, _LEAST_UNIT = 1e-30, 1e-12

_Known = TypeVar("_Known", float, Array, np.ndarray)


def entry_names(name: str, number: ArrayLike) -> tuple[str, ...]:
    """Names of the entries of a number; a single number has its own name."""
    return tuple(f"{name}[{i}]" for i in range(jnp.size(number))) if jnp.ndim(number) == 1 else (name,)


def split_entries(numbers: Mapping[str, Array]) -> dict[str, Array]:
    """Single numbers by name; arrays of more than one axis stay as they are."""
    split: dict[str, Array] = {}
    for name, number in numbers.items():
        if jnp.ndim(number) == 1:
            split |= {entry: number[i] for i, entry in enumerate(entry_names(name, number))}
        else:
            split[name] = number
    return split


def split_ranges(numbers: Mapping[str, Array], ranges: Mapping[str, Range]) -> dict[str, Range]:
    """Ranges of the entries; a limit by an array is that by the entry of the same index."""
    split: dict[str, Range] = {}
    for name, allowed in ranges.items():
        for i, entry in enumerate(entry_names(name, numbers[name])):
            lower = allowed.lower
            if isinstance(lower, str) and jnp.ndim(numbers[lower]) == 1:
                lower = entry_names(lower, numbers[lower])[i]
            split[entry] = replace(allowed, lower=lower)
    return split


def join_entries(numbers: Mapping[str, Array], values: Mapping[str, Array]) -> dict[str, Array]:
    """Numbers with entries in `values`, with these replaced."""
    joined: dict[str, Array] = {}
    for name, number in numbers.items():
        entries = entry_names(name, number)
        if not any(entry in values for entry in entries):
            continue
        if jnp.ndim(number) == 1:
            joined[name] = jnp.stack([jnp.asarray(values.get(entry, number[i])) for i, entry in enumerate(entries)])
        else:
            joined[name] = values[name]
    return joined


def chosen_entries(numbers: Mapping[str, Array], free: Sequence[str]) -> Sequence[str]:
    """Entries that `free` names, where the name of an array stands for all of them."""
    if isinstance(free, str):
        return free  # refused where it is used
    return tuple(entry for name in free for entry in (entry_names(name, numbers[name]) if name in numbers else (name,)))


def with_numbers(model: eqx.Module, numbers: Mapping[str, np.ndarray]) -> eqx.Module:
    """The scene or law with all its numbers replaced.

    **Raises:**

    - `ValueError` if its numbers have other names or shapes.
    """
    if not isinstance(model, Scene | AbstractLaw):
        raise ValueError(f"model must be a Scene or a law, but {model!r} was given.")
    own = scene_numbers(model)
    missing, extra = [k for k in numbers if k not in own], [k for k in own if k not in numbers]
    if missing or extra:
        raise ValueError(
            f"The model is not the fitted one: it lacks {', '.join(missing) or 'nothing'}, and has"
            f" {', '.join(extra) or 'nothing'} in addition."
        )
    for name, number in numbers.items():
        if np.shape(number) != np.shape(own[name]):
            raise ValueError(
                f"The model is not the fitted one: {name} has the shape {np.shape(own[name])}, but"
                f" {np.shape(number)} was fitted."
            )
    return replace_numbers(model, {k: jnp.asarray(x) for k, x in numbers.items()})


class ParameterCoordinate(eqx.Module):
    """One parameter of a fit and its coordinate x, about 1 in size, in which all limits are bounds.

    - `kind`: of the coordinate.
        - "log": `floor + unit exp(x)`, above a number.
        - "above": `floor + unit x` with x >= 0, at or above a number or another parameter (Fs >= Fc).
        - "ratio": `floor (1 + unit x)`, from another parameter to `most` times it.
        - "line": `unit x`, without limits.
        - "follow": `floor + unit`, of a parameter that is not free but limited by a free one.
    - `base`: name of the parameter that is the floor, or names of the sigma1, Fs and Fc of a law that must be passive;
      None if the floor is the number `floor`.
    - `upper`, `most`: largest value and largest ratio to the base, infinite for no limit.
    """

    name: str = eqx.field(static=True)
    kind: str = eqx.field(static=True)
    base: str | tuple[str, str, str] | None = eqx.field(static=True)
    floor: Array
    unit: Array
    upper: Array
    most: Array

    @staticmethod
    def of(name: str, values: Mapping[str, float], floor: Floor, declared: Range) -> "ParameterCoordinate":
        """The coordinate of a free parameter that starts at its value, above a floor and in its declared range."""
        value, upper, most = values[name], math.inf if declared.upper is None else declared.upper, math.inf
        if declared.most is not None and isinstance(floor, float):
            upper = max(declared.most * values[str(declared.lower)], value)
        elif declared.most is not None and isinstance(floor, str) and values[floor] > 0:
            # A start beyond the largest ratio raises it.
            most = max(declared.most, value / values[floor])
        _check_start(name, values, floor, declared.strict, upper)
        distance = value - _floor(floor, values)
        if floor is None:
            kind, unit = "line", max(abs(value), _LEAST_UNIT) if value else 1.0
        elif math.isfinite(most):
            kind, unit = "ratio", distance / _floor(floor, values) or 1.0
        else:
            kind = "log" if declared.strict and isinstance(floor, float | int) else "above"
            unit = distance if distance > 0 else abs(value) or 1.0
        base = floor if isinstance(floor, str | tuple) else None
        number = 0.0 if isinstance(floor, str | tuple | None) else float(floor)
        return ParameterCoordinate(name, kind, base, *(on_device(each) for each in (number, unit, upper, most)))

    @staticmethod
    def following(name: str, base: str, values: Mapping[str, float]) -> "ParameterCoordinate":
        """A parameter that keeps its distance from a base that moves."""
        distance = on_device(values[name] - values[base])
        return ParameterCoordinate(name, "follow", base, on_device(0.0), distance, on_device(np.inf), on_device(np.inf))

    def floor_at(self, values: Mapping[str, _Known]) -> _Known | Array | float:
        """The lower limit where the other parameters have these values."""
        return self.floor if self.base is None else _floor(self.base, values)

    def value(self, x: Array | None, values: Mapping[str, Array]) -> Array:
        """The parameter at x, where those before it have these values."""
        floor = self.floor_at(values)
        if x is None:
            return floor + self.unit
        over = self.unit * (jnp.exp(x) if self.kind == "log" else x)
        return floor * (1.0 + over) if self.kind == "ratio" else floor + over

    def coordinate(self, values: Mapping[str, Array]) -> Array:
        """The x at which the parameter has its value among these."""
        floor, value = self.floor_at(values), values[self.name]
        over = (value / floor - 1.0 if self.kind == "ratio" else value - floor) / self.unit
        return jnp.log(jnp.maximum(over, _LEAST_DISTANCE)) if self.kind == "log" else over

    @property
    def bounds(self) -> tuple[Array, Array]:
        """Lower and upper bound of x."""
        least = {"line": -jnp.inf, "log": -_MOST_DECADES, "above": 0.0, "ratio": 0.0}[self.kind]
        most = ((self.most - 1.0) if self.kind == "ratio" else self.upper - self.floor) / self.unit
        most = jnp.minimum(jnp.log(most), _MOST_DECADES) if self.kind == "log" else most
        return jnp.asarray(least, most.dtype), most

    @property
    def fixed_limits(self) -> tuple[float, float]:
        """Lower and upper limit of the parameter that are numbers, infinite if there are none."""
        line = self.kind == "line" or self.base is not None
        return -math.inf if line else float(self.floor), float(self.upper)


class FreeParameters(eqx.Module):
    """The parameters of a fit, by a vector x with one coordinate for each.

    - `names`: of the free parameters, in the order they were named.
    - `entries`: the free parameters, and those that follow one, each after its base.
    - `start`: start values of the entries, and values of fixed parameters that are bases, by name.
    """

    names: tuple[str, ...] = eqx.field(static=True)
    entries: tuple[ParameterCoordinate, ...]
    start: dict[str, Array]

    @staticmethod
    def of(
        numbers: Mapping[str, ArrayLike],
        ranges: Mapping[str, Range],
        free: Sequence[str],
        passive: Mapping[str, tuple[str, str, str]] | None = None,
    ) -> "FreeParameters":
        """Choose `free` among `numbers`.

        **Arguments:**

        - `numbers`: all numbers by name.
        - `ranges`: their ranges, by name.
        - `free`: names of those to fit. A parameter limited by a free one keeps its distance: if Fs = Fc at the start,
          it stays so.
        - `passive`: names of the sigma1, Fs and Fc that keep a LuGre law with a free sigma2 passive,
          `sigma2 >= sigma1 (Fs - Fc)/Fc`, by the name of that sigma2.

        **Raises:**

        - `ValueError` for a name that is unknown, repeated or no single number, or a start beyond its limits.
        """
        _check_names(numbers, free)
        values = {name: float(jnp.asarray(x)) for name, x in numbers.items() if jnp.shape(x) == ()}
        following: list[str] = []
        while more := [
            name for name, r in ranges.items() if name not in (*free, *following) and r.lower in (*free, *following)
        ]:
            following += more
        floors: dict[str, Floor] = {}
        for name in (*free, *following):
            lower = ranges[name].lower if name in ranges else None
            fixed = isinstance(lower, str) and lower not in (*free, *following)
            floors[name] = values[str(lower)] if fixed else lower
        floors |= {name: names for name, names in (passive or {}).items() if name in free}
        order: list[str] = []
        for name in floors:
            _append_after(name, floors, order)
        entries = tuple(
            ParameterCoordinate.following(name, str(floors[name]), values)
            if name in following
            else ParameterCoordinate.of(name, values, floors[name], ranges.get(name, Range("")))
            for name in order
        )
        start = {each: values[each] for floor in floors.values() if isinstance(floor, tuple) for each in floor}
        for each in entries:
            inside = each.kind in ("above", "ratio")
            start[each.name] = max(values[each.name], _floor(floors[each.name], values) if inside else -math.inf)
        return FreeParameters(tuple(free), entries, {name: on_device(x) for name, x in start.items()})

    @property
    def following(self) -> dict[str, str]:
        """The base of each parameter that is not free but follows one that is, by name."""
        return {each.name: str(each.base) for each in self.entries if each.kind == "follow"}

    @property
    def free(self) -> tuple[ParameterCoordinate, ...]:
        """The free parameters in the order of `names`."""
        entries = {each.name: each for each in self.entries}
        return tuple(entries[name] for name in self.names)

    def __getitem__(self, name: str) -> ParameterCoordinate:
        return self.free[self.names.index(name)]

    @property
    def kinds(self) -> tuple[str, ...]:
        """Kind of each coordinate in the order of `names`."""
        return tuple(each.kind for each in self.free)

    def values(self, x: Float[Array, " free"]) -> dict[str, Array]:
        """The parameters at `x`, and those that follow them."""
        values = dict(self.start)  # a fixed base stays as it is
        for each in self.entries:
            here = None if each.kind == "follow" else x[self.names.index(each.name)]
            values[each.name] = each.value(here, values)
        return {each.name: values[each.name] for each in self.entries}

    def coordinates(self, values: Mapping[str, ArrayLike]) -> Float[Array, " free"]:
        """The x at which the parameters are these `values`, moved into the limits."""
        dtype = jnp.result_type(float)
        return _coordinates(
            self, {**self.start, **{name: on_device(np.asarray(x, dtype)) for name, x in values.items()}}
        )

    @property
    def x0(self) -> Float[Array, " free"]:
        """The coordinates at the start."""
        return self.coordinates({})

    @property
    def bounds(self) -> tuple[Float[Array, " free"], Float[Array, " free"]]:
        """Lower and upper bounds of x."""
        pairs = [each.bounds for each in self.free]
        return _stack([lower for lower, _ in pairs]), _stack([upper for _, upper in pairs])

    def limits(self, x: ArrayLike) -> dict[str, tuple[float, float]]:
        """Lower and upper limit of each parameter where the others are as at `x`."""
        values = {name: np.asarray(each) for name, each in {**self.start, **self.at(x).values}.items()}
        limits = {}
        for each in self.free:
            floor = float(each.floor_at(values))
            upper = float(each.most) * floor if each.kind == "ratio" else float(each.upper)
            limits[each.name] = (-math.inf if each.kind == "line" else floor, upper)
        return limits

    @property
    def longest(self) -> Float[Array, " free"]:
        """Longest change of x in one iteration."""
        return jnp.asarray([_LONGEST_LOG_STEP if kind == "log" else jnp.inf for kind in self.kinds])

    def vector(self, x: Float[Array, " free"]) -> Float[Array, " free"]:
        """The parameters at `x` as a vector in the order of `names`."""
        values = self.values(x)
        return _stack([values[name] for name in self.names])

    def slopes(self, x: Float[Array, " free"]) -> Float[Array, "free free"]:
        """Derivatives of the parameters by x."""
        if not self.names:
            return jnp.zeros((0, 0), x.dtype)
        return jax.jacfwd(self.vector)(x)

    def at(self, x: ArrayLike) -> "ParameterPoint":
        """The parameters at a known `x`, shape `[free]`, as NumPy arrays."""
        values, slopes, lower, upper = _parameters_at(self, on_device(x))
        values = {name: np.asarray(each) for name, each in values.items()}
        vector = np.array([values[name] for name in self.names], lower.dtype)
        return ParameterPoint(values, vector, *(np.asarray(each) for each in (slopes, lower, upper)))


class ParameterPoint(NamedTuple):
    """The parameters at a point.

    - `values`: by name, those that follow included. `vector`: those that are free, in their order, shape `[free]`.
    - `slopes`: their derivatives by x, shape `[free, free]`. `lower`, `upper`: bounds of x, shape `[free]`.
    """

    values: dict[str, np.ndarray]
    vector: Float[np.ndarray, " free"]
    slopes: Float[np.ndarray, "free free"]
    lower: Float[np.ndarray, " free"]
    upper: Float[np.ndarray, " free"]


@eqx.filter_jit
def _parameters_at(free: FreeParameters, x: Float[Array, " free"]) -> tuple[dict[str, Array], Array, Array, Array]:
    return free.values(x), free.slopes(x), *free.bounds


@eqx.filter_jit
def _coordinates(free: FreeParameters, values: dict[str, Array]) -> Float[Array, " free"]:
    return jnp.clip(_stack([each.coordinate(values) for each in free.free]), *free.bounds)


def _stack(entries: list[Array]) -> Float[Array, " free"]:
    return jnp.stack(entries) if entries else jnp.zeros(0)


def _check_names(numbers: Mapping[str, ArrayLike], free: Sequence[str]) -> None:
    if isinstance(free, str) or not free:
        raise ValueError("free must name at least one number, as in free=('m', 'friction.Fc').")
    for name in free:
        if name not in numbers:
            raise ValueError(f"free names {name!r}, but the numbers are: {', '.join(numbers)}.")
        if list(free).count(name) > 1:
            raise ValueError(f"free names {name!r} twice.")
        if jnp.shape(numbers[name]) != ():
            raise ValueError(f"{name} is an array of shape {jnp.shape(numbers[name])}; only single numbers fit.")


def _check_start(name: str, values: Mapping[str, float], floor: Floor, strict: bool, upper: float) -> None:
    value = values[name]
    if isinstance(floor, str | float | int):
        least = _floor(floor, values)
        if value < least or (strict and value == least):
            shown = f"{floor} = {least:g}" if isinstance(floor, str) else f"{floor:g}"
            raise ValueError(f"The start {name} = {value:g} must lie above its limit {shown}.")
    if upper < math.inf and isinstance(floor, str | tuple):
        raise ValueError(f"{name} is limited by {floor} and by {upper:g}: free only one of the two.")
    if value > upper:
        raise ValueError(f"The start {name} = {value:g} must lie below its limit {upper:g}.")


def _append_after(name: str, floors: Mapping[str, Floor], order: list[str]) -> None:
    """Append a name to the order, after its bases."""
    if name in order:
        return
    floor = floors.get(name)
    for base in floor if isinstance(floor, tuple) else (floor,):
        if isinstance(base, str) and base in floors:
            _append_after(base, floors, order)
    order.append(name)


def _floor(floor: Floor, values: Mapping[str, _Known]) -> _Known | float:
    """The number that a parameter is measured from; that of a passive law is `sigma1 (Fs - Fc)/Fc`."""
    if isinstance(floor, tuple):
        sigma1, Fs, Fc = (values[each] for each in floor)
        return sigma1 * (Fs - Fc) / Fc
    return values[floor] if isinstance(floor, str) else floor or 0.0
