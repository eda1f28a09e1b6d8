"""A measured record."""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float


@dataclass(frozen=True)
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
    inputs: dict[str, Float[np.ndarray, " samples"]] = field(default_factory=dict)
    name: str = "record"

    def __post_init__(self) -> None:
        """Convert and check."""
        columns = {"t": self.t, "measured": self.measured, **self.inputs}
        arrays = {}
        for label, column in columns.items():
            try:
                array = np.asarray(column, dtype=float)
            except (TypeError, ValueError) as error:
                raise ValueError(f"{self.name}: column {label!r} holds something that is no number.") from error
            if array.ndim != 1 or array.shape != np.shape(self.t) or array.shape[0] < 2:
                raise ValueError(
                    f"{self.name}: columns must have one shape [samples] with two samples or more, but 't' has"
                    f" {np.shape(self.t)} and {label!r} has {array.shape}."
                )
            bad = np.flatnonzero(~np.isfinite(array))
            if bad.size:
                raise ValueError(
                    f"{self.name}: column {label!r} has {bad.size} values that are not finite, the first in sample"
                    f" {bad[0]} ({array[bad[0]]}). Remove or fill them first."
                )
            arrays[label] = array
        stalls = np.flatnonzero(np.diff(arrays["t"]) <= 0)
        if stalls.size:
            k = int(stalls[0])
            raise ValueError(
                f"{self.name}: times must increase, but sample {k + 1} at t = {arrays['t'][k + 1]} s follows sample"
                f" {k} at t = {arrays['t'][k]} s."
            )
        object.__setattr__(self, "t", arrays.pop("t"))
        object.__setattr__(self, "measured", arrays.pop("measured"))
        object.__setattr__(self, "inputs", arrays)
