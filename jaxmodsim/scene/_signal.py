"""Sampled functions of time among the numbers of a scene."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._core.arguments import as_flag, as_reals
from .._core.arrays import Scalar, after, entry, is_known
from .._core.parameters import as_vector


def _samples(x: object, *, name: str) -> Float[Array, " n"]:
    """A vector; a column of a table (pandas, polars, xarray) becomes its array."""
    if isinstance(x, range) or (hasattr(x, "__array__") and not isinstance(x, jax.Array | np.ndarray | np.generic)):
        x = as_reals(x, name=name)
    return as_vector(x, name=name)


class Signal(eqx.Module):
    """A sampled function of time, as an entry of `Scene` parameters: functions get its value at time t there.

    Each value holds from its sample to the next one, so that the signal jumps at its samples and has the new value
    there. With `linear`, straight lines join the samples. Before the first sample it has the first value, after the
    last one the last. Steps of `simulate` end on the samples.

    Derivatives are with respect to `values`; the times are constants. A Lagrangian uses the rate of a linear signal;
    the jumps of a held signal change the energy by jumps that `run.energy` does not contain. Displacements (`along`,
    `at`) and constraints use the value of a signal without its rate: give their motion as a function of t. Constraints
    and gaps that a linear signal moves raise an error.

    **Arguments:**

    - `t`: times of the samples [s], increasing, shape `[samples]`: an array, a list, or a column of a table, as for
      `Record`.
    - `values`: values there, any unit, shape `[samples]`.
    - `linear`: whether values are interpolated instead of held.

    **Raises:**

    - `ValueError` for shapes that differ, times that are not finite or do not increase, and values that are not finite.

    **Example:**

    ```python
    drive = jms.AppliedForce(lambda t, q, qd, p: p["u"][None])
    u = jms.Signal([0.0, 1.0], [4.0, 0.0])  # 4 N for 1 s
    scene = jms.Scene(lambda t, q, qd, p: 0.5 * p["m"] * qd[0] ** 2, {"m": 2.0, "u": u}, (drive,))
    print(jms.simulate(scene, [0.0], [0.0], 2.0).qd.round(6), "m/s")
    ```

    ```text
    [[2.]] m/s
    ```
    """

    t: Any = eqx.field(converter=lambda x: _samples(x, name="Signal t"))
    values: Any = eqx.field(converter=lambda x: _samples(x, name="Signal values"))
    linear: bool = eqx.field(default=False, static=True, converter=lambda x: as_flag(x, name="Signal linear"))

    def __check_init__(self) -> None:
        """Refuse samples that do not define a function of time."""
        if self.t.shape != self.values.shape:
            raise ValueError(
                f"Signal needs one value for each time, but t has the shape {self.t.shape} and values"
                f" {self.values.shape}."
            )
        if not is_known(self.t):
            return
        t = np.asarray(self.t)
        if (bad := np.flatnonzero(~(np.isfinite(t) & (np.diff(t, prepend=-np.inf) > 0)))).size:
            k = bad[0]
            follows = f" after t[{k - 1}] = {t[k - 1]}" if k else ""
            raise ValueError(
                f"Signal: t must be finite and increase from sample to sample, but t[{k}] = {t[k]}{follows}: sort the"
                " samples, and leave out repeated ones."
            )
        if is_known(self.values) and (bad := np.flatnonzero(~np.isfinite(self.values))).size:
            raise ValueError(
                f"Signal: values must be finite, but the one at t = {t[bad[0]]:g} is {self.values[bad[0]]}"
                f" ({bad.size} such of {t.size}). Leave such samples out."
            )

    def piece(self, t: Scalar) -> "Piece":
        """The signal from the last sample at or before `t` to the next one."""
        times = jax.lax.stop_gradient(self.t)
        last = times.shape[0] - 1
        i = after(times, t) - 1
        here = jnp.maximum(i, 0)
        start, value = entry(times, here), entry(self.values, here)
        if not self.linear:
            return Piece(self, value, None, None)
        there = jnp.minimum(i + 1, last)
        length = entry(times, there) - start
        slope = (entry(self.values, there) - value) / jnp.where(length > 0, length, 1.0).astype(value.dtype)
        return Piece(self, value, slope, start)


class Piece(eqx.Module):
    """A signal between two of its samples: a number, or a straight line that continues beyond them."""

    signal: Signal
    value: Scalar
    slope: Scalar | None
    start: Scalar | None

    def at(self, t: Scalar) -> Scalar:
        """Value at `t`."""
        if self.slope is None or self.start is None:
            return self.value
        return self.value + self.slope * (t - self.start).astype(self.value.dtype)


def _is_signal(x: Any) -> bool:
    return isinstance(x, Signal | Piece)


def signals_of(tree: Any) -> list[Any]:
    """The signals in `tree`.

    **Returns:**

    A list of `Signal`s, in the order of the leaves.
    """
    return [x for x in jax.tree.leaves(tree, is_leaf=_is_signal) if _is_signal(x)]


def signals_at(tree: Any, t: Scalar, *, held: bool = True, linear: bool = True) -> Any:
    """`tree` with the value at `t` in the place of each signal of these kinds."""

    def value(x: Any) -> Any:
        if not _is_signal(x):
            return x
        signal = x.signal if isinstance(x, Piece) else x
        if not (linear if signal.linear else held):
            return x
        return (x if isinstance(x, Piece) else x.piece(t)).at(t)

    return jax.tree.map(value, tree, is_leaf=_is_signal)


def signals_from(tree: Any, t: Scalar) -> Any:
    """`tree` with the piece of each signal from `t` on, for a step from there."""
    return jax.tree.map(lambda x: x.piece(t) if isinstance(x, Signal) else x, tree, is_leaf=_is_signal)


def sample_times(tree: Any, *, linear: bool) -> Float[Array, " n"] | None:
    """Times of all samples in `tree` in order, with `linear` those of linear signals, too; None without signals.

    **Returns:**

    The times [s], increasing, shape `[n]`, repeated for equal times of several signals; or None.
    """
    times = [jax.lax.stop_gradient(x.t) for x in signals_of(tree) if linear or not x.linear]
    if len(times) < 2:
        return times[0] if times else None
    return jnp.sort(jnp.concatenate(times))
