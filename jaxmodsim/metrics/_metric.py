"""What a metric of a run is."""

from collections.abc import Callable
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike

from .._core.arguments import as_names
from ..simulation import Trajectory


@dataclass(frozen=True)
class Metric:
    """A function of a `Trajectory` that gives one number; two of equal fields are equal, and compile once.

    Works under `jax.jit`, `jax.vmap` and `jax.grad`, on runs with events and without. NaN where a run has no such
    number, as the period of one that comes to rest.

    - `label`: what it is, for tables and figures. `unit`: its unit; "1" where it has none.
    - `measure`: called as `measure(run, *arguments)`.
    - `arguments`: what else it depends on.
    - `read`: what an integer stands for, called as `read(value, *arguments)`; None for a quantity.
    """

    label: str
    unit: str
    measure: Callable[..., object]
    arguments: tuple[object, ...] = ()
    read: Callable[..., str] | None = None

    def __call__(self, run: Trajectory) -> Array:
        """The number, shape `[]`."""
        return jnp.asarray(self.measure(run, *self.arguments))

    def describe(self, value: ArrayLike) -> str:
        """What a value stands for: of a class of motion its name, of a quantity the number with its unit."""
        number = float(np.asarray(value))
        if self.read is not None:
            return self.read(int(number), *self.arguments)
        return f"{number:.6g}" if self.unit == "1" else f"{number:.6g} {self.unit}"


def classes(fn: Callable[[Trajectory], object], names: tuple[str, ...] | list[str]) -> Metric:
    """Classes of motion by a function of your own, as for laws without modes.

    ```python
    kind = metrics.classes(lambda run: jnp.where(jnp.abs(run.qd[-1, 0]) < 1e-3, 0, 1), ("rests", "moves"))
    ```

    **Arguments:**

    - `fn`: function of a `Trajectory` that returns an index into `names`; must work under `jax.jit`.
    - `names`: of the classes.

    **Returns:**

    A `Metric` whose `describe(i)` is `names[i]`.

    **Raises:**

    - `ValueError` if `names` is empty.
    """
    names = as_names(names, name="names")
    if not names:
        raise ValueError("names must hold a name for each class, as in ('rests', 'moves'), but it is empty.")
    if not callable(fn):
        raise ValueError(f"fn must be a function of a Trajectory, but {fn!r} was given.")
    return Metric("kind of motion", "1", _class_of, (fn, names), _class_name)


def _class_of(run: Trajectory, fn: Callable[[Trajectory], object], names: tuple[str, ...]) -> object:
    del names
    return fn(run)


def _class_name(value: int, fn: Callable[[Trajectory], object], names: tuple[str, ...]) -> str:
    del fn
    return names[value] if 0 <= value < len(names) else f"class {value}"
