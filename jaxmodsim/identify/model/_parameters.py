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

# What a parameter is measured from: a number, another parameter, or sigma1, Fs and Fc of a law that is to be passive.
Floor: TypeAlias = float | str | tuple[str, str, str] | None
# Logarithmic coordinates stop short of overflow, and one iteration does not change a parameter by more than this factor
# to a power: the curvature of a model over more decades is nothing that a linearisation knows.
_MOST_DECADES, _LONGEST_LOG_STEP = 60.0, 1.5
# Least distance from a limit that a logarithm is taken of, and least unit of a parameter without limits.
_LEAST_DISTANCE, _LEAST_UNIT = 1e-30, 1e-12

_Number = TypeVar("_Number", float, Array, np.ndarray)
_Known = TypeVar("_Known", Array, np.ndarray)


def entry_names(name: str, number: ArrayLike) -> tuple[str, ...]:
    """Names of the entries of a number; that of a single one is its own."""
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
    """Whole numbers with the entries in `values` replaced, those that have any."""
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

    - `ValueError` if its numbers are others by name or shape.
    """
    if not isinstance(model, Scene | AbstractLaw):
        raise ValueError(f"model must be a Scene or a law, but {model!r} was given.")
    own = scene_numbers(model)
    missing, extra = [k for k in numbers if k not in own], [k for k in own if k not in numbers]
    if missing or extra:
        raise ValueError(
            f"The model is not the one that was fitted: it lacks {', '.join(missing) or 'nothing'}, and has"
            f" {', '.join(extra) or 'nothing'} that was not there."
        )
    for name, number in numbers.items():
        if np.shape(number) != np.shape(own[name]):
            raise ValueError(
                f"The model is not the one that was fitted: {name} has the shape {np.shape(own[name])}, but"
                f" {np.shape(number)} was fitted."
            )
    return replace_numbers(model, {k: jnp.asarray(x) for k, x in numbers.items()})


class FreeParameters(eqx.Module):
    """Names, start values and limits of the parameters of a fit.

    Each has a coordinate x, about 1 in size: a parameter that must be greater than a number is `floor + unit exp(x)`;
    one that may also reach its lower limit is `floor + unit x` with x >= 0, where the limit may be another parameter
    (Fs >= Fc); one that is also at most so many times that other is `floor (1 + unit x)`; one without limits is
    `unit x`. So all limits are bounds of x, and one may be reached exactly. A parameter that is not free, but whose
    limit is, keeps its distance from it: with Fs = Fc at the start, it stays so.

    - `names`: of the free parameters, in the order they were given.
    - `following`: names of the parameters that are not free but follow one that is.
    """

    names: tuple[str, ...] = eqx.field(static=True)
    following: tuple[str, ...] = eqx.field(static=True)
    _order: tuple[str, ...] = eqx.field(static=True)
    _kinds: tuple[str, ...] = eqx.field(static=True)
    _bases: tuple[str | tuple[str, str, str] | None, ...] = eqx.field(static=True)
    start: dict[str, Array]
    _floors: dict[str, Array]
    _units: dict[str, Array]
    _upper: dict[str, Array]
    _most: dict[str, Array]

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
        - `free`: names of those to fit.
        - `passive`: names of the sigma1, Fs and Fc that the free sigma2 of a LuGre law must go with for it to be
          passive, `sigma2 >= sigma1 (Fs - Fc)/Fc`, by the name of that sigma2.

        **Raises:**

        - `ValueError` for a name that is unknown, given twice or no single number, or a start beyond its limits.
        """
        _check_names(numbers, free)
        values = {name: float(jnp.asarray(x)) for name, x in numbers.items() if jnp.shape(x) == ()}
        following: list[str] = []
        while more := [
            name for name, r in ranges.items() if name not in (*free, *following) and r.lower in (*free, *following)
        ]:
            following += more
        moving = (*free, *following)
        floors: dict[str, Floor] = {}
        for name in moving:
            floors[name] = ranges[name].lower if name in ranges else None
            if isinstance(floors[name], str) and floors[name] not in moving:
                floors[name] = values[str(floors[name])]  # a limit that is fixed is a number
        floors |= {name: names for name, names in (passive or {}).items() if name in free}
        order: list[str] = []
        for name in moving:
            _append_after(name, floors, order)
        strict = {name for name in free if name in ranges and ranges[name].strict}
        upper = {name: most for name in free if name in ranges and (most := ranges[name].upper) is not None}
        upper |= {
            name: max(most * values[str(ranges[name].lower)], values[name])
            for name in free
            if name in ranges and isinstance(floors[name], float) and (most := ranges[name].most) is not None
        }
        # Of a limit that starts at zero there is no multiple. Whoever starts with more is not held back.
        most = {
            name: max(most, values[name] / values[base])
            for name in free
            if isinstance(base := floors[name], str) and (most := ranges[name].most) is not None and values[base] > 0
        }
        for name in free:
            _check_start(name, values, floors[name], name in strict, upper.get(name))
        kinds = {
            name: "follow"
            if name in following
            else "line"
            if floors[name] is None
            else "ratio"
            if name in most
            else "log"
            if name in strict and isinstance(floors[name], float | int)
            else "above"
            for name in order
        }
        numeric = {name: x for name, x in floors.items() if isinstance(x, float | int)}
        units = {name: _unit(kinds[name], values, name, floors[name]) for name in order}
        beside = {each: values[each] for x in floors.values() if isinstance(x, tuple) for each in x}
        start = beside | {name: values[name] for name in order}
        start |= {
            name: max(values[name], _base(floors[name], values)) for name in free if kinds[name] in ("above", "ratio")
        }
        return FreeParameters(
            names=tuple(free),
            following=tuple(following),
            _order=tuple(order),
            _kinds=tuple(kinds[name] for name in order),
            _bases=tuple(x if isinstance(x := floors[name], str | tuple) else None for name in order),
            start={name: on_device(x) for name, x in start.items()},
            _floors={name: on_device(numeric.get(name, 0.0)) for name in order},
            _units={name: on_device(x) for name, x in units.items()},
            _upper={name: on_device(x) for name, x in upper.items()},
            _most={name: on_device(x) for name, x in most.items()},
        )

    @property
    def followed(self) -> dict[str, str]:
        """What each parameter follows that is not free but moves with one that is."""
        bases = dict(zip(self._order, self._bases, strict=True))
        return {name: str(bases[name]) for name in self.following}

    @staticmethod
    def none() -> "FreeParameters":
        """Nothing is free."""
        return FreeParameters((), (), (), (), (), {}, {}, {}, {}, {})

    def _kind(self, name: str) -> str:
        return self._kinds[self._order.index(name)]

    def _floor(self, name: str, values: Mapping[str, _Known]) -> _Known | Array | np.floating:
        base = self._bases[self._order.index(name)]
        if base is None:
            return self._floors[name]
        return values[base] if isinstance(base, str) else _passive_floor(*(values[each] for each in base))

    def values(self, x: Float[Array, " free"]) -> dict[str, Array]:
        """The parameters at `x`, and those that follow them."""
        values = dict(self.start)  # what a floor names and is not free stays as it is
        for name, kind in zip(self._order, self._kinds, strict=True):
            floor = self._floor(name, values)
            if kind == "follow":
                start = self._floor(name, self.start)
                values[name] = floor + (self.start[name] - start)
                continue
            here = x[self.names.index(name)]
            over = self._units[name] * (jnp.exp(here) if kind == "log" else here)
            values[name] = floor * (1.0 + over) if kind == "ratio" else floor + over
        return {name: values[name] for name in self._order}

    def coordinates(self, values: Mapping[str, ArrayLike]) -> Float[Array, " free"]:
        """The x at which the parameters are these `values`, moved into the limits."""
        dtype = jnp.result_type(float)
        return _coordinates(
            self, {**self.start, **{name: on_device(np.asarray(x, dtype)) for name, x in values.items()}}
        )

    def _coordinates(self, known: Mapping[str, Array]) -> Float[Array, " free"]:
        coordinates: dict[str, Array] = {}
        for name in self.names:
            floor, kind = self._floor(name, known), self._kind(name)
            over = (known[name] / floor - 1.0 if kind == "ratio" else known[name] - floor) / self._units[name]
            coordinates[name] = jnp.log(jnp.maximum(over, _LEAST_DISTANCE)) if kind == "log" else over
        lower, upper = self.bounds
        return jnp.clip(_stack([coordinates[name] for name in self.names]), lower, upper)

    @property
    def x0(self) -> Float[Array, " free"]:
        """The coordinates at the start."""
        return self.coordinates({})

    @property
    def bounds(self) -> tuple[Float[Array, " free"], Float[Array, " free"]]:
        """Lower and upper bounds of x."""
        least = {"line": -jnp.inf, "log": -_MOST_DECADES, "above": 0.0, "ratio": 0.0}
        lower = _stack([jnp.asarray(least[self._kind(name)], float) for name in self.names])
        upper = []
        for name in self.names:
            if name in self._upper:
                most = (self._upper[name] - self._floors[name]) / self._units[name]
                upper.append(jnp.log(most) if self._kind(name) == "log" else most)
            elif name in self._most:
                upper.append((self._most[name] - 1.0) / self._units[name])
            else:
                upper.append(jnp.asarray(_MOST_DECADES if self._kind(name) == "log" else jnp.inf, float))
        return lower, _stack(upper)

    def limits(self, x: ArrayLike) -> dict[str, tuple[float, float]]:
        """Lower and upper limit of each parameter where the others are as at `x`."""
        values = {name: np.asarray(each) for name, each in {**self.start, **self.at(x).values}.items()}
        floors = {name: float(self._floor(name, values)) for name in self.names}
        return {
            name: (
                -math.inf if self._kind(name) == "line" else floors[name],
                float(self._most[name]) * floors[name]
                if name in self._most
                else float(self._upper.get(name, math.inf)),
            )
            for name in self.names
        }

    def limit_of(self, name: str) -> str | None:
        """Name of the parameter that is the lower limit of this one, as Fc of Fs."""
        base = self._bases[self._order.index(name)]
        return base if isinstance(base, str) else None

    def fixed_limits(self, name: str) -> tuple[float, float]:
        """Lower and upper limit of a parameter that are numbers, infinite where they are none."""
        line = self._kind(name) == "line" or self._bases[self._order.index(name)] is not None
        low = -math.inf if line else float(self._floors[name])
        return low, float(self._upper.get(name, math.inf))

    @property
    def longest(self) -> Float[Array, " free"]:
        """Longest change of x in one iteration."""
        return jnp.asarray([_LONGEST_LOG_STEP if self._kind(name) == "log" else jnp.inf for name in self.names])

    @property
    def kinds(self) -> tuple[str, ...]:
        """Kind of each coordinate: "line", "above" (a limit), "ratio" (to a limit) or "log" (of a distance from it)."""
        return tuple(self._kind(name) for name in self.names)

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
        """The parameters at `x`, shape `[free]`, which is known; for what is not compiled itself."""
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
def _coordinates(free: FreeParameters, known: dict[str, Array]) -> Float[Array, " free"]:
    return free._coordinates(known)


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


def _check_start(name: str, values: Mapping[str, float], floor: Floor, strict: bool, upper: float | None) -> None:
    value = values[name]
    if isinstance(floor, str | float | int):
        least = values[floor] if isinstance(floor, str) else floor
        if value < least or (strict and value == least):
            shown = f"{floor} = {least:g}" if isinstance(floor, str) else f"{floor:g}"
            raise ValueError(f"The start {name} = {value:g} must lie above its limit {shown}.")
    if upper is not None:
        if isinstance(floor, str | tuple):
            raise ValueError(f"{name} is limited by {floor} and by {upper:g}: free only one of the two.")
        if value > upper:
            raise ValueError(f"The start {name} = {value:g} must lie below its limit {upper:g}.")


def _append_after(name: str, floors: Mapping[str, Floor], order: list[str]) -> None:
    """Append a name to the order after all that it is measured from."""
    if name in order:
        return
    floor = floors.get(name)
    for base in floor if isinstance(floor, tuple) else (floor,):
        if isinstance(base, str) and base in floors:
            _append_after(base, floors, order)
    order.append(name)


def _passive_floor(sigma1: _Number, Fs: _Number, Fc: _Number) -> _Number:
    return sigma1 * (Fs - Fc) / Fc


def _base(floor: Floor, values: Mapping[str, float]) -> float:
    if floor is None:
        return 0.0
    if isinstance(floor, tuple):
        return _passive_floor(*(values[name] for name in floor))
    return values[floor] if isinstance(floor, str) else float(floor)


def _unit(kind: str, values: Mapping[str, float], name: str, floor: Floor) -> float:
    """Size of a step of one in x: the distance from the limit, or where there is none, of the value."""
    value = values[name]
    if kind == "line":
        return max(abs(value), _LEAST_UNIT) if value else 1.0
    distance = value - _base(floor, values)
    if kind == "ratio":
        return distance / _base(floor, values) or 1.0
    return distance if distance > 0 else (abs(value) or 1.0)
