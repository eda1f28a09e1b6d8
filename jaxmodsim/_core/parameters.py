"""Numbers of a scene: their conversion, admissible ranges and error messages."""

import dataclasses
import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import partial
from typing import TYPE_CHECKING, Any, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from .arrays import is_known
from .functions import Reaction, StateDependent, as_state_function, nominal

if TYPE_CHECKING:
    Number: TypeAlias = Any  # callers pass plain numbers; type checkers ignore the converter of `parameter`
    Vector: TypeAlias = Any
    NumberOrState: TypeAlias = Any  # a number, or a function of the state
else:
    Number: TypeAlias = Float[Array, ""]
    Vector: TypeAlias = Float[Array, " n"]
    NumberOrState: TypeAlias = Float[Array, ""] | StateDependent | Reaction
_Numbers: TypeAlias = Float[Array | np.ndarray, "..."]


class Default(float):
    """A default value, which takes the floating type of the other numbers."""


def is_weak(number: object) -> bool:
    """Whether the type of a number is weak: JAX converts it to the type of other numbers."""
    return getattr(number, "weak_type", isinstance(number, float))


@dataclasses.dataclass(frozen=True)
class Range:
    """Admissible range and unit of a parameter.

    **Arguments:**

    - `unit`: SI unit, as printed.
    - `lower`: lower limit, a number or the name of another parameter of the same object; None for no limit.
    - `strict`: whether the lower limit is excluded.
    - `upper`: upper limit, included; None for no limit.
    - `most`: upper limit in a fit, as a multiple of the parameter that `lower` names; None for no limit.
    - `execution`: whether the parameter belongs to the numerical method and not to the law; by default a fit keeps it.
    """

    unit: str
    lower: float | str | None = None
    strict: bool = False
    upper: float | None = None
    execution: bool = False
    most: float | None = None

    @property
    def text(self) -> str:
        """The range as text, such as `finite and > 0 [N/m]`."""
        unit = f" [{self.unit}]" if self.unit else ""
        if self.lower is None and self.upper is None:
            return f"a finite number{unit}"
        limit = self.lower if isinstance(self.lower, str) or self.lower is None else f"{self.lower:g}"
        least = "" if limit is None else f" and {'>' if self.strict else '>='} {limit}"
        most = "" if self.upper is None else f" and <= {self.upper:g}"
        return f"finite{least}{most}{unit}"

    def holds(self, value: _Numbers, others: Mapping[str, _Numbers]) -> Bool[Array | np.ndarray | np.bool_, "..."]:
        """Whether `value` is in range, elementwise; `others` are the parameters of the same object by name.

        NumPy evaluates a NumPy array, without JAX.
        """
        finite = np.isfinite(value) if isinstance(value, np.ndarray) else jnp.isfinite(value)
        if self.upper is not None:
            finite = finite & (value <= self.upper)
        if self.lower is None:
            return finite
        lower = others[self.lower] if isinstance(self.lower, str) else self.lower
        return finite & ((value > lower) if self.strict else (value >= lower))

    def check(self, value: _Numbers, *, name: str, others: Mapping[str, _Numbers] | None = None) -> None:
        """Refuse numbers out of range unless they are traced; `others` as in `holds`.

        **Raises:**

        - `ValueError` with `name`, the range and the value.
        """
        limit = None if others is None or not isinstance(self.lower, str) else others[self.lower]
        if not is_known(value, limit):
            return
        if not np.all(self.holds(np.asarray(value), {} if limit is None else {str(self.lower): np.asarray(limit)})):
            against = "" if limit is None else f" ({self.lower} = {limit})"
            raise ValueError(f"{name} must be {self.text}{against}, but {value} was given.")


def as_number(value: object, *, name: str) -> Float[Array, ""]:
    """Convert to a real floating scalar; integers are converted, floating types are kept.

    **Raises:**

    - `ValueError` with `name`, the value and the requirement.
    """
    array = as_real(value, name=name)
    if array.shape != ():
        raise ValueError(
            f"{name} has shape {array.shape}, but one number is needed. To run many values at once, build one scene"
            " and batch its numbers with jax.vmap."
        )
    return array


def as_real(value: object, *, name: str) -> Float[Array, "..."]:
    """Convert to a real floating array of any shape; see `as_number`. The type of a `Default` remains weak."""
    if isinstance(value, Default):
        return jnp.asarray(float(value))
    if isinstance(value, jax.Array | np.ndarray | np.number | int | float) and not isinstance(value, bool):
        kind = getattr(value, "dtype", np.dtype(type(value)))
        whole = jnp.issubdtype(kind, jnp.integer)
        if whole or jnp.issubdtype(kind, jnp.floating):
            dtype = jnp.result_type(float) if whole else jnp.result_type(value)
            try:
                return jnp.asarray(value, dtype=dtype)  # a stated dtype also makes a weak type strong
            except OverflowError as error:
                raise ValueError(f"{name} is too large for {dtype}.") from error
    kind = value if isinstance(value, str | bool) else getattr(value, "dtype", type(value).__name__)
    raise ValueError(f"{name} must be a real number or an array of real numbers, but {kind!r} was given.")


def check_not_nan(leaves: Iterable[object], numbers: Callable[[], Mapping[str, Any]]) -> None:
    """Refuse a NaN among known leaves of a scene; `numbers()` has its numbers by name.

    **Raises:**

    - `ValueError` with the name of the number, and the index of the entry of an array.
    """
    if any(map(_has_nan, leaves)):
        for name, number in numbers().items():
            if _has_nan(number):
                index = np.argwhere(np.isnan(np.asarray(number)))[0].tolist()
                raise ValueError(
                    f"The number {f'{name}{index}' if index else name!r} of the scene is NaN, and so would be the"
                    " results: give its value."
                )


def _has_nan(x: Any) -> bool:
    if not is_known(x):
        return False
    array = np.asarray(x)
    if array.ndim == 0:  # every run looks at every number, and Python takes less time than NumPy for one
        value = array.item()
        return isinstance(value, float) and math.isnan(value)
    return array.dtype.kind == "f" and bool(np.isnan(array).any())


def as_vector(value: object, *, name: str) -> Float[Array, " n"]:
    """Convert to a vector of real floating numbers, shape `[n]`; one number becomes a vector of length one.

    **Raises:**

    - `ValueError` with `name`, the value and the requirement.
    """
    if isinstance(value, list | tuple):
        value = jnp.stack([as_number(x, name=name) for x in value]) if value else jnp.zeros(0)
    array = as_real(value, name=name)
    if array.ndim > 1 or array.size == 0:
        raise ValueError(f"{name} has shape {array.shape}, but a vector of numbers, shape [n], is needed.")
    return jnp.reshape(array, (-1,))


def parameter(
    name: str,
    unit: str,
    *,
    lower: float | str | None = None,
    strict: bool = False,
    upper: float | None = None,
    execution: bool = False,
    most: float | None = None,
    **field: Any,
) -> Any:
    """Dataclass field of an `eqx.Module` for one number with a unit and an admissible range.

    **Arguments:**

    - `name`: name of the field, for error messages.
    - `unit`, `lower`, `strict`, `upper`, `execution`, `most`: see `Range`.
    - `field`: further arguments of `equinox.field`, such as `default`.

    **Returns:**

    The field; it converts its value to a floating array of shape `[]`.

    **Example:**

    ```python
    import equinox as eqx

    class Spring(eqx.Module):
        k: jax.Array = jms.friction.parameter("k", "N/m", lower=0.0)

    print(Spring(k=3))
    ```

    ```text
    Spring(k=f64[])
    ```
    """
    allowed = Range(unit, lower, strict, upper, execution, most)
    if "default" in field:
        field["default"] = Default(field["default"])
    return eqx.field(converter=partial(as_number, name=name), metadata={"range": allowed}, **field)


def parameter_or(name: str, unit: str, instead: tuple[type, ...], *, lower: float, upper: float, default: float) -> Any:
    """A `parameter` that may also be an object of the types `instead`, with its own parameters."""

    def convert(value: object) -> object:
        return value if isinstance(value, instead) else as_number(value, name=name)

    return eqx.field(converter=convert, metadata={"range": Range(unit, lower, upper=upper)}, default=Default(default))


def optional_parameter(
    name: str, unit: str, *, lower: float | str | None = None, strict: bool = False, most: float | None = None
) -> Any:
    """A `parameter` with the default None."""
    convert = partial(unless_none, convert=as_number, name=name)
    return eqx.field(default=None, converter=convert, metadata={"range": Range(unit, lower, strict, most=most)})


def vector_parameter(name: str, unit: str, *, lower: float | str | None = None, strict: bool = False) -> Any:
    """A `parameter` of several numbers, shape `[n]`."""
    return eqx.field(converter=partial(as_vector, name=name), metadata={"range": Range(unit, lower, strict)})


def optional_vector_parameter(name: str, unit: str, *, lower: float | str | None = None) -> Any:
    """A `vector_parameter` with the default None."""
    convert = partial(unless_none, convert=as_vector, name=name)
    return eqx.field(default=None, converter=convert, metadata={"range": Range(unit, lower)})


def state_parameter(name: str, *, reaction: bool = False) -> Any:
    """Field for a function of the mechanism's state, of either sign, or a constant number.

    With `reaction` it may also be the name of a constraint.
    """
    return eqx.field(converter=partial(_of_state, name=name, reaction=reaction))


def _of_state(value: Any, *, name: str, reaction: bool) -> object:
    if isinstance(value, StateDependent | Reaction):
        return value
    if reaction and isinstance(value, str):
        return Reaction(value)
    if callable(value):
        return StateDependent(None, as_state_function(value, name=name))
    number = as_number(value, name=name)
    Range("").check(number, name=name)
    return number


def unless_none(value: Any, *, convert: Callable[..., Any], name: str) -> Any:
    """`convert(value, name=name)`, or None for None."""
    return None if value is None else convert(value, name=name)


def ranges_of(module: eqx.Module) -> dict[str, Range]:
    """Ranges of the parameters of `module` that are numbers, by name."""
    return {
        f.name: f.metadata["range"]
        for f in dataclasses.fields(module)
        if "range" in f.metadata and not isinstance(nominal(getattr(module, f.name)), eqx.Module | None)
    }


def range_checks(scene: object) -> list[tuple[str, Array]]:
    """For each parameter of each module in `scene`: the requirement as a sentence, and whether it holds."""
    checks = []
    for path, module in modules_of(scene):
        values = {name: nominal(getattr(module, name)) for name in ranges_of(module)}
        for name, allowed in ranges_of(module).items():
            text = f"{type(module).__name__}: {name} must be {allowed.text} (at scene{path})."
            checks.append((text, jnp.all(allowed.holds(values[name], values))))
    return checks


def check_ranges(module: eqx.Module) -> None:
    """Check the parameters of `module` that are not traced.

    **Raises:**

    - `ValueError` with the parameter, its range and the value.
    """
    values = {name: nominal(getattr(module, name)) for name in ranges_of(module)}
    for name, allowed in ranges_of(module).items():
        allowed.check(values[name], name=f"{type(module).__name__}: {name}", others=values)


class AbstractRanged(eqx.Module):
    """A module that refuses parameters out of range."""

    def __check_init__(self) -> None:
        check_ranges(self)


def modules_of(tree: object, path: str = "") -> Iterator[tuple[str, eqx.Module]]:
    """Every `eqx.Module` inside `tree`, itself included, with its path such as `.effects[0].law`.

    The property `implied` of a module adds modules by name, which it builds from its fields.
    """
    if isinstance(tree, eqx.Module):
        yield path, tree
        for name, module in getattr(tree, "implied", {}).items():
            yield f"{path}.{name}", module
        for field in dataclasses.fields(tree):
            if not field.metadata.get("static", False):
                yield from modules_of(getattr(tree, field.name), f"{path}.{field.name}")
    elif isinstance(tree, tuple | list):
        for i, item in enumerate(tree):
            yield from modules_of(item, f"{path}[{i}]")
    elif isinstance(tree, dict):
        for key, item in tree.items():
            yield from modules_of(item, f"{path}[{key!r}]")
