"""Measured records, and their windows as arrays of one shape."""

from collections.abc import Iterable, Mapping, Sequence
from itertools import pairwise
from typing import NamedTuple, TypeAlias

import jax.numpy as jnp
import numpy as np
import numpy.typing as npt
from jaxtyping import Array, ArrayLike, Float

from ..._core.arguments import as_float, as_label, as_mapping, as_names, as_reals
from ..._core.arrays import on_device

# Samples of one channel, shape `[samples]`; also a column of a table (pandas, xarray, polars).
Column: TypeAlias = ArrayLike | Sequence[object] | npt.ArrayLike
# Default name of a single channel.
SINGLE = "measured"


class Record:
    """Samples of a measurement: outputs, and the inputs that drove the machine.

    **Arguments:**

    - `t`: times of the samples [s], increasing, shape `[samples]`, at least two.
    - `measured`: measured output at these times, shape `[samples]`; or several outputs by name,
      `{"x": ..., "force": ...}`.
    - `inputs`: inputs by name, shape `[samples]` each. In a fit each drives the entry of the scene's `params` of the
      same name.
    - `name`: for figures and tables.
    - `linear`: names of the inputs that are interpolated linearly; the others are held until the next sample.
    - `noise`: standard deviation of the noise of each channel by its name, in its unit, > 0; one number for a single
      channel. A fit estimates the others. The channel of slip instants is `"friction slips"`.
    - `slips`: instants [s] at which friction elements broke away, by the name of the effect in the scene, increasing.

    **Raises:**

    - `ValueError` naming the column and the first wrong sample, for NaN, times that do not increase, or different
      lengths.

    **Example:**

    ```python
    record = jms.Record([0.0, 0.1, 0.2], {"x": [0.0, 0.01, 0.03]}, {"u": [1.0, 1.0, 0.0]}, name="step")
    print(record.part(0.1, 0.2).channels["x"])
    ```

    ```text
    [0.01 0.03]
    ```
    """

    t: Float[np.ndarray, " samples"]
    channels: dict[str, Float[np.ndarray, " samples"]]
    inputs: dict[str, Float[np.ndarray, " samples"]]
    name: str
    linear: frozenset[str]
    noise: dict[str, float]
    slips: dict[str, Float[np.ndarray, " instants"]]

    def __init__(
        self,
        t: Column,
        measured: Column | Mapping[str, Column],
        inputs: Mapping[str, Column] | None = None,
        name: str = "record",
        *,
        linear: Iterable[str] = (),
        noise: float | Mapping[str, float] | None = None,
        slips: Mapping[str, Column] | None = None,
    ):
        name = as_label(name, name="name") or "record"
        outputs = dict(measured) if isinstance(measured, Mapping) else {SINGLE: measured}
        inputs = as_mapping(inputs, name="inputs", example="{'u': force}")
        slips = as_mapping(slips, name="slips", example="{'friction': [0.5, 1.5]}")
        if not outputs:
            raise ValueError(f"{name}: measured must hold at least one channel.")
        self.t = _column(t, "t", None, name)
        shape = self.t.shape
        self.channels = {label: _column(column, label, shape, name) for label, column in outputs.items()}
        self.inputs = {label: _column(column, label, shape, name) for label, column in inputs.items()}
        self.name, self.linear = name, frozenset(as_names(linear, name="linear"))
        unknown = self.linear - set(self.inputs)
        if unknown:
            raise ValueError(f"{name}: linear names {sorted(unknown)}, but the inputs are {list(self.inputs)}.")
        stalls = np.flatnonzero(np.diff(self.t) <= 0)
        if stalls.size:
            k = int(stalls[0])
            raise ValueError(
                f"{name}: times must increase, but sample {k + 1} at t = {self.t[k + 1]} s follows sample {k} at"
                f" t = {self.t[k]} s."
            )
        self.slips = {effect: _instants(instants, effect, self.t, name) for effect, instants in slips.items()}
        self.noise = self._levels(noise)

    def _levels(self, noise: float | Mapping[str, float] | None) -> dict[str, float]:
        known = (*self.channels, *(slip_channel(effect) for effect in self.slips))
        if noise is None:
            return {}
        if not isinstance(noise, Mapping):
            if len(known) > 1:
                raise ValueError(f"{self.name}: noise must name its channels, {', '.join(known)}; it is {noise!r}.")
            noise = dict.fromkeys(known, noise)
        for channel in noise:
            if channel not in known:
                raise ValueError(f"{self.name}: noise names {channel!r}, but the channels are: {', '.join(known)}.")
        return {
            channel: as_float(level, name=f"{self.name}: noise of {channel!r}", lower=0.0)
            for channel, level in noise.items()
        }

    @property
    def measured(self) -> Float[np.ndarray, " samples"]:
        """The only channel.

        **Raises:**

        - `ValueError` for several: use `channels`.
        """
        if len(self.channels) > 1:
            raise ValueError(f"{self.name} has the channels {', '.join(self.channels)}: use Record.channels.")
        return next(iter(self.channels.values()))

    def part(self, start: float, end: float, name: str | None = None) -> "Record":
        """The samples from `start` to `end` [s], both included, with the same times.

        **Raises:**

        - `ValueError` for fewer than two samples.
        """
        start, end = as_float(start, name="start"), as_float(end, name="end")
        inside = np.flatnonzero((self.t >= start) & (self.t <= end))
        if inside.size < 2:
            raise ValueError(
                f"{self.name} has {inside.size} samples from start = {start:g} to end = {end:g} s; two are needed."
            )
        return self.samples(int(inside[0]), int(inside[-1]) + 1, name)

    def samples(self, first: int, last: int, name: str | None = None) -> "Record":
        """Samples from `first` to `last`, without the last."""
        keep = slice(first, last)
        t = self.t[keep]
        slips = {effect: instants[(instants >= t[0]) & (instants <= t[-1])] for effect, instants in self.slips.items()}
        return Record(
            t,
            {label: x[keep] for label, x in self.channels.items()},
            {label: x[keep] for label, x in self.inputs.items()},
            as_label(name, name="name") or self.name,
            linear=self.linear,
            noise=self.noise,
            slips=slips,
        )

    def windows(self, seconds: float) -> tuple["Record", ...]:
        """Cut into windows of this length [s], the last one shorter; none shorter than a quarter of it.

        **Raises:**

        - `ValueError` for windows of fewer than two samples.
        """
        seconds = as_float(seconds, name="seconds", lower=0.0)
        parts = min(float(self.t[-1] - self.t[0]) / seconds, float(len(self.t)))  # one a sample at most
        count = max(round(parts), 1)
        if 2 * count > len(self.t):
            raise ValueError(
                f"{self.name}: windows of {seconds} s cannot be cut from {len(self.t)} samples over"
                f" {self.t[-1] - self.t[0]:g} s."
            )
        edges = np.linspace(0, len(self.t), count + 1).astype(int)
        return tuple(self.samples(int(a), int(b), f"{self.name}[{i}]") for i, (a, b) in enumerate(pairwise(edges)))

    def __repr__(self) -> str:
        inputs, channels = ", ".join(self.inputs) or "none", ", ".join(self.channels)
        return (
            f"Record({self.name!r}, {len(self.t)} samples, {self.t[0]:g} to {self.t[-1]:g} s, channels: {channels},"
            f" inputs: {inputs})"
        )


def slip_channel(effect: str) -> str:
    """Name of the channel of an effect's slip instants."""
    return f"{effect} slips"


def _column(column: Column, label: str, shape: tuple[int, ...] | None, name: str) -> Float[np.ndarray, " samples"]:
    """One column, converted and checked."""
    array = as_reals(column, name=f"{name}: column {label!r}")
    if array.ndim != 1 or array.shape[0] < 2 or shape not in (None, array.shape):
        others = "" if shape is None else f" 't' has {shape} and"
        raise ValueError(
            f"{name}: columns must have one shape [samples] with two samples or more, but{others} {label!r} has"
            f" {array.shape}."
        )
    bad = np.flatnonzero(~np.isfinite(array))
    if bad.size:
        raise ValueError(
            f"{name}: column {label!r} has {bad.size} values that are not finite, the first in sample {bad[0]}"
            f" ({array[bad[0]]}). Remove or fill them first."
        )
    return array


def _instants(instants: Column, effect: str, t: np.ndarray, name: str) -> Float[np.ndarray, " instants"]:
    array = (
        as_reals(instants, name=f"{name}: slips of {effect!r}")
        if np.size(np.asarray(instants, object))
        else np.zeros(0)
    )
    fine = array.ndim == 1 and bool(np.isfinite(array).all() and (np.diff(array) > 0).all())
    if not (fine and (array.size == 0 or (array[0] >= t[0] and array[-1] <= t[-1]))):
        raise ValueError(
            f"{name}: slips of {effect!r} must be increasing times within [{t[0]:g}, {t[-1]:g}] s, shape [instants],"
            f" but they are {instants!r}."
        )
    return array


class Runs(NamedTuple):
    """Records, or windows of them, padded to the same length, with a leading axis of runs.

    - `t`: times [s]; shorter runs repeat their last one.
    - `inputs`, `measured`: by name. `weight`: 1 for a sample that counts, 0 for others, by channel.
    - `slips`: instants by effect. `slip_weight`: their weights.
    """

    t: Float[Array, "runs samples"]
    inputs: dict[str, Float[Array, "runs samples"]]
    measured: dict[str, Float[Array, "runs samples"]]
    weight: dict[str, Float[Array, "runs samples"]]
    slips: dict[str, Float[Array, "runs instants"]]
    slip_weight: dict[str, Float[Array, "runs instants"]]


class Window(NamedTuple):
    """The window of a record that is a run.

    - `record`, `first`, `last`: index of the record and of its first and last sample.
    - `linked`: whether the next run continues from the end of this one; its first sample is then the last one here.
    """

    record: int
    first: int
    last: int
    linked: bool


def cut(records: tuple[Record, ...], window: float | None) -> tuple[Window, ...]:
    """Whole records, or windows of about this length [s]; each ends with the first sample of the next.

    **Raises:**

    - `ValueError` for a window shorter than two samples.
    """
    windows, steps = [], None
    if window is not None:
        span = max(float(np.median(np.diff(each.t))) for each in records)
        if not (np.isfinite(window) and window >= 2 * span):
            raise ValueError(f"A window must be at least two samples, {2 * span:g} s, long, but it is {window} s.")
        steps = round(window / span)
    for i, each in enumerate(records):
        samples = len(each.t)
        edges = [0, samples - 1] if steps is None else [*range(0, samples - 1, steps), samples - 1]
        if len(edges) > 2 and edges[-1] - edges[-2] < (steps or 0) // 4:
            del edges[-2]  # too short to show its own start
        windows += [Window(i, a, b, b != edges[-1]) for a, b in pairwise(edges)]
    return tuple(windows)


def runs_of(records: tuple[Record, ...], windows: tuple[Window, ...]) -> Runs:
    """The samples of the windows as arrays of one shape."""
    longest = max(each.last - each.first for each in windows) + 1
    channels = list(dict.fromkeys(channel for record in records for channel in record.channels))
    effects = list(dict.fromkeys(effect for record in records for effect in record.slips))
    parts = [records[each.record].samples(each.first, each.last + 1) for each in windows]
    instants = max((len(x) for part in parts for x in part.slips.values()), default=0)

    def column(values: Sequence[np.ndarray] | np.ndarray) -> Array:
        return on_device(np.stack(list(values)).astype(jnp.result_type(float)))

    def pad(x: np.ndarray) -> np.ndarray:
        return np.pad(x, (0, longest - len(x)), mode="edge")

    def counts(part: Record, channel: str, goes_on: bool) -> np.ndarray:
        # The sample that two windows share counts in the later one.
        own = len(part.t) - int(goes_on)
        return np.where(np.arange(longest) < own, float(channel in part.channels), 0.0)

    def times(part: Record, effect: str) -> np.ndarray:
        instants_by_effect = part.slips.get(effect, np.zeros(0))
        return np.pad(instants_by_effect, (0, instants - len(instants_by_effect)), constant_values=np.inf)

    instants_by_effect = {effect: np.stack([times(part, effect) for part in parts]) for effect in effects}
    zero = np.zeros(longest)
    return Runs(
        column([pad(part.t) for part in parts]),
        {name: column([pad(part.inputs[name]) for part in parts]) for name in parts[0].inputs},
        {
            name: column([pad(part.channels[name]) if name in part.channels else zero for part in parts])
            for name in channels
        },
        {
            name: column([counts(part, name, each.linked) for part, each in zip(parts, windows, strict=True)])
            for name in channels
        },
        {name: column(np.where(np.isfinite(x), x, 0.0)) for name, x in instants_by_effect.items()},
        {name: column(np.isfinite(x).astype(float)) for name, x in instants_by_effect.items()},
    )
