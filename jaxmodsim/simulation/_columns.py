"""A run as named columns, and as tables of them."""

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Array, Float, Shaped

from .._core.arrays import is_known
from .._core.system import extra
from ..scene import Quantity, Scene, quantity_of

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr


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
