"""A measured record."""

from collections.abc import Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float


class Record:
    """Samples of a measurement: one measured output, and the inputs that drove the machine.

    **Arguments:**

    - `t`: times of the samples [s], increasing, shape `[samples]`, at least two.
    - `measured`: measured output at these times, shape `[samples]`.
    - `inputs`: inputs by name, shape `[samples]` each; each sample is held until the next. In a fit an input
      drives the entry of the scene's `params` of the same name.
    - `name`: for figures and tables.

    **Raises:**

    - `ValueError` naming the column and the first sample at fault, for NaN, times that do not increase, or lengths
      that differ.
    """

    t: Float[np.ndarray, " samples"]
    measured: Float[np.ndarray, " samples"]
    inputs: dict[str, Float[np.ndarray, " samples"]]
    name: str

    def __init__(self, t: Any, measured: Any, inputs: Mapping[str, Any] | None = None, name: str = "record"):
        arrays = {
            label: _column(column, label, np.shape(t), name)
            for label, column in {"t": t, "measured": measured, **(inputs or {})}.items()
        }
        stalls = np.flatnonzero(np.diff(arrays["t"]) <= 0)
        if stalls.size:
            k = int(stalls[0])
            raise ValueError(
                f"{name}: times must increase, but sample {k + 1} at t = {arrays['t'][k + 1]} s follows sample"
                f" {k} at t = {arrays['t'][k]} s."
            )
        self.t, self.measured = arrays.pop("t"), arrays.pop("measured")
        self.inputs, self.name = arrays, name

    @property
    def arrays(self) -> tuple[Array, dict[str, Array], Array]:
        """`(t, inputs, measured)` as JAX arrays, for compiled code."""
        inputs = {name: jnp.asarray(values) for name, values in self.inputs.items()}
        return jnp.asarray(self.t), inputs, jnp.asarray(self.measured)

    def __repr__(self) -> str:
        inputs = ", ".join(self.inputs) or "none"
        return f"Record({self.name!r}, {len(self.t)} samples, {self.t[0]:g} to {self.t[-1]:g} s, inputs: {inputs})"


def _column(column: Any, label: str, shape: tuple[int, ...], name: str) -> Float[np.ndarray, " samples"]:
    """One column, converted and checked."""
    try:
        array = np.asarray(column, dtype=float)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name}: column {label!r} holds something that is no number.") from error
    if array.ndim != 1 or array.shape != shape or array.shape[0] < 2:
        raise ValueError(
            f"{name}: columns must have one shape [samples] with two samples or more, but 't' has {shape} and"
            f" {label!r} has {array.shape}."
        )
    bad = np.flatnonzero(~np.isfinite(array))
    if bad.size:
        raise ValueError(
            f"{name}: column {label!r} has {bad.size} values that are not finite, the first in sample {bad[0]}"
            f" ({array[bad[0]]}). Remove or fill them first."
        )
    return array
