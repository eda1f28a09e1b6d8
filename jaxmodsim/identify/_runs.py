"""Records as arrays of one shape, run side by side."""

from itertools import pairwise
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ._record import Record


class Runs(NamedTuple):
    """Records, or windows of them, padded to the same length, with a leading axis of runs.

    - `t`: times [s]; the last one is repeated where a run is shorter than the longest.
    - `inputs`, `measured`: by name. `weight`: 1 where a sample counts, 0 where not, by channel.
    - `slips`: instants by effect, `slip_weight` their weights.
    """

    t: Float[Array, "runs samples"]
    inputs: dict[str, Float[Array, "runs samples"]]
    measured: dict[str, Float[Array, "runs samples"]]
    weight: dict[str, Float[Array, "runs samples"]]
    slips: dict[str, Float[Array, "runs instants"]]
    slip_weight: dict[str, Float[Array, "runs instants"]]


class Windows(NamedTuple):
    """Where the runs come from.

    - `record`, `first`, `last`: index of the record and its samples `first` to `last`, of each run; the last sample
      is also the first of the next run where `linked`.
    - `linked`: whether the next run goes on from the end of this one, shape `[runs - 1]`.
    """

    record: tuple[int, ...]
    first: tuple[int, ...]
    last: tuple[int, ...]
    linked: Bool[np.ndarray, " links"]


def cut(records: tuple[Record, ...], window: float | None) -> Windows:
    """Whole records, or windows of nearly this length [s]; each ends with the first sample of the next.

    **Raises:**

    - `ValueError` if the window is shorter than two samples.
    """
    record, first, last, linked = [], [], [], []
    steps = None
    if window is not None:
        span = max(float(np.median(np.diff(each.t))) for each in records)
        if not (np.isfinite(window) and window >= 2 * span):
            raise ValueError(f"A window must be at least two samples, {2 * span:g} s, long, but it is {window} s.")
        steps = round(window / span)
    for i, each in enumerate(records):
        samples = len(each.t)
        edges = [0, samples - 1] if steps is None else [*range(0, samples - 1, steps), samples - 1]
        if len(edges) > 2 and edges[-1] - edges[-2] < (steps or 0) // 4:
            del edges[-2]  # too short to say anything about its own start
        for a, b in pairwise(edges):
            record.append(i)
            first.append(a)
            last.append(b)
            linked.append(b != edges[-1])
    return Windows(tuple(record), tuple(first), tuple(last), np.array(linked[:-1], bool))


def runs_of(records: tuple[Record, ...], windows: Windows) -> Runs:
    """The samples of the windows as arrays of one shape."""
    longest = max(b - a for a, b in zip(windows.first, windows.last, strict=True)) + 1
    channels = list(dict.fromkeys(channel for record in records for channel in record.channels))
    effects = list(dict.fromkeys(effect for record in records for effect in record.slips))
    parts = [records[i].samples(a, b + 1) for i, a, b in zip(windows.record, windows.first, windows.last, strict=True)]
    continues = [*windows.linked.tolist(), False]
    instants = max((len(x) for part in parts for x in part.slips.values()), default=0)

    def column(values: Any) -> Array:
        return jnp.asarray(np.stack(values))

    def pad(x: np.ndarray) -> np.ndarray:
        return np.pad(x, (0, longest - len(x)), mode="edge")

    def counts(part: Record, channel: str, goes_on: bool) -> np.ndarray:
        # The sample that two windows share counts in the later one.
        own = len(part.t) - int(goes_on)
        return np.where(np.arange(longest) < own, float(channel in part.channels), 0.0)

    def times(part: Record, effect: str) -> np.ndarray:
        found = part.slips.get(effect, np.zeros(0))
        return np.pad(found, (0, instants - len(found)), constant_values=np.inf)

    found = {effect: np.stack([times(part, effect) for part in parts]) for effect in effects}
    zero = np.zeros(longest)
    return Runs(
        column([pad(part.t) for part in parts]),
        {name: column([pad(part.inputs[name]) for part in parts]) for name in parts[0].inputs},
        {
            name: column([pad(part.channels[name]) if name in part.channels else zero for part in parts])
            for name in channels
        },
        {
            name: column([counts(part, name, goes_on) for part, goes_on in zip(parts, continues, strict=True)])
            for name in channels
        },
        {name: column(np.where(np.isfinite(x), x, 0.0)) for name, x in found.items()},
        {name: column(np.isfinite(x).astype(float)) for name, x in found.items()},
    )
