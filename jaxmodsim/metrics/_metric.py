"""The class of metrics, and metrics from functions of your own."""

from collections.abc import Callable
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike

from .._core.arguments import as_names
from ..simulation import Trajectory


@dataclass(frozen=True)
class Metric:
    """A scalar function of a `Trajectory`. Metrics with equal fields are equal, and compile once.

    Works under `jax.jit`, `jax.vmap` and `jax.grad`, on runs with and without events. The result is NaN if it is not
    defined for the run, such as the period of a run that comes to rest.

    - `label`: name in tables and figures. `unit`: its unit; "1" for pure numbers.
    - `measure`: called as `measure(run, *arguments)`.
    - `arguments`: further arguments of `measure`, hashable.
    - `read`: gives the meaning of an integer, called as `read(value, *arguments)`; None for a quantity.
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
        """A value as text: the name of a class of motion, or a number with its unit."""
        number = float(np.asarray(value))
        if self.read is not None:
            return self.read(int(number), *self.arguments)
        return f"{number:.6g}" if self.unit == "1" else f"{number:.6g} {self.unit}"


def classes(fn: Callable[[Trajectory], object], names: tuple[str, ...] | list[str]) -> Metric:
    """Classify motions by a function of your own, for instance for laws without modes.

    **Arguments:**

    - `fn`: function of a `Trajectory` that returns an index into `names` and works under `jax.jit`.
    - `names`: names of the classes.

    **Returns:**

    A `Metric` whose `describe(i)` is `names[i]`.

    **Raises:**

    - `ValueError` if `names` is empty or `fn` is not a function.

    **Example:**

    ```python
    scene = jms.problems.belt_oscillator.scene()
    run = jms.simulate(scene, [0.0], [0.0], 3.0, ts=jnp.linspace(0.0, 3.0, 301))
    kind = jms.metrics.classes(lambda run: jnp.where(jnp.abs(run.qd[-1, 0]) < 1e-3, 0, 1), ("rests", "moves"))
    print(kind.describe(kind(run)))
    ```

    ```text
    moves
    ```
    """
    names = as_names(names, name="names")
    if not names:
        raise ValueError("names needs a name for each class, as in ('rests', 'moves'), but it is empty.")
    if not callable(fn):
        raise ValueError(f"fn must be a function of a Trajectory, but {fn!r} was given.")
    return Metric("kind of motion", "1", _class_of, (fn, names), _class_name)


def _class_of(run: Trajectory, fn: Callable[[Trajectory], object], names: tuple[str, ...]) -> object:
    del names
    return fn(run)


def _class_name(value: int, fn: Callable[[Trajectory], object], names: tuple[str, ...]) -> str:
    del fn
    return names[value] if 0 <= value < len(names) else f"class {value}"
