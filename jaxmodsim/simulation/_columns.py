"""Series of a run by name, as columns, and as tables of them."""

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any, NamedTuple

import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Float, Shaped

from .._core.arguments import did_you_mean
from .._core.arrays import is_known
from .._core.system import extra
from ..scene import Quantity, Scene, quantity_of

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr


@jtu.register_pytree_with_keys_class
class ByName(dict[str, Any]):
    """Series of a run by name, a pytree."""

    def __missing__(self, name: object) -> None:
        known = f"the names are: {', '.join(self) or 'none'}.{did_you_mean(str(name), self)}"
        raise KeyError(f"The run has no {name!r} here; {known}")

    def tree_flatten_with_keys(self) -> tuple[list[tuple[Any, Any]], tuple[str, ...]]:
        """Values in the order of the names."""
        return [(jtu.DictKey(name), value) for name, value in self.items()], tuple(self)

    @classmethod
    def tree_unflatten(cls, names: tuple[str, ...], values: Iterable[Any]) -> "ByName":
        """The inverse of `tree_flatten_with_keys`."""
        return cls(zip(names, values, strict=True))


class Columns(NamedTuple):
    """Columns of a run at the times that it reached.

    - `time`: times [s], shape `[time]`.
    - `values`: coordinates, velocities, forces of effects and modes by name, shape `[time]` each.
    - `units`: their units.
    """

    time: Float[np.ndarray, " time"]
    values: dict[str, Shaped[np.ndarray, " time"]]
    units: dict[str, str]

    def to_dataframe(self) -> "pd.DataFrame":
        """A DataFrame over time, with the units in its `attrs`."""
        pandas = extra("pandas", "to_dataframe")
        table = pandas.DataFrame(self.values, index=pandas.Index(self.time, name="time"))
        table.attrs["units"] = {"time": "s", **self.units}
        return table

    def to_xarray(self) -> "xr.Dataset":
        """A Dataset over time, with the units in the attributes of its variables."""
        variables = {name: (("time",), x, {"units": self.units[name]}) for name, x in self.values.items()}
        return extra("xarray", "to_xarray").Dataset(variables, {"time": (("time",), self.time, {"units": "s"})})


def columns(scene: Scene, t: Array, q: Array, qd: Array, forces: dict[str, Array], modes: dict[str, Array]) -> Columns:
    """The columns of a run.

    **Raises:**

    - `ValueError` inside `jax.jit`, `jax.vmap` or `jax.grad`, where numbers are not known.
    """
    if not is_known(t, q, *forces.values()):
        raise ValueError("A table of a run needs numbers: make it outside of jax.jit, jax.vmap and jax.grad.")
    series = {f"{kind}[{i}]": x[:, i] for kind, x in (("q", q), ("qd", qd)) for i in range(x.shape[1])}
    for name, force in forces.items():
        parts = np.reshape(force, (force.shape[0], -1)).T
        series |= {name if len(parts) == 1 else f"{name}[{i}]": part for i, part in enumerate(parts)}
    reached = np.isfinite(t)
    called = {quantity_of(scene, name): np.asarray(x)[reached] for name, x in series.items()}
    called |= {Quantity(f"{name}_mode", "1"): np.asarray(x)[reached].astype(int) for name, x in modes.items()}
    return Columns(
        np.asarray(t)[reached], {name: x for (name, _), x in called.items()}, {name: unit for name, unit in called}
    )
