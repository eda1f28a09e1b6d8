"""The SPEC of `jaxmodsim sweep`: a TOML file that says what to sweep."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from pydantic import Field

from ..scene import Scene
from ..simulation import Trajectory, named_series
from ..sweeps import latin_hypercube, sobol
from . import _table
from ._spec_scene import read_system

_SAMPLERS: dict[str, Callable[..., dict[str, np.ndarray]]] = {"latin_hypercube": latin_hypercube, "sobol": sobol}


class _SpecTable(_table.AbstractTable):
    scene: _table.Table
    over: _table.Table
    run: _table.Table = Field({})
    observe: _table.Table | None = None


class _RunTable(_table.AbstractTable):
    q0: _table.Numbers | None = None
    qd0: _table.Numbers | None = None
    t0: _table.Number | None = None
    t1: _table.Number | None = None
    ts: _table.Numbers | _table.Table | None = None
    rtol: _table.Number | None = None
    atol: _table.Number | None = None
    dt: _table.Number | None = None
    dtmax: _table.Number | None = None
    max_steps: _table.Whole | None = None
    max_events: _table.Whole | None = None
    stick_on_chatter: _table.Switch | None = None
    project: _table.Switch | None = None


class _TimesTable(_table.AbstractTable):
    start: _table.Number
    stop: _table.Number
    count: _table.Whole


class _SpanTable(_table.AbstractTable):
    low: _table.Number = Field(alias="from")
    to: _table.Number
    count: _table.Whole
    spacing: Literal["linear", "log"] = "linear"


class _SamplesTable(_table.AbstractTable):
    latin_hypercube: _table.Table | None = None
    sobol: _table.Table | None = None
    count: _table.Whole
    seed: _table.Seed = 0


class _ObservedTable(_table.AbstractTable):
    of: _table.Text
    take: Literal["end", "max", "min", "mean", "rms", "peak", "ptp"] | None = None
    unit: _table.Text | None = None


_SPAN = tuple(field.alias or name for name, field in _SpanTable.model_fields.items())


@dataclass(frozen=True)
class Spec:
    """What is to be swept: the arguments of `jaxmodsim.sweep`, read from a file.

    - `run`: those that go to `simulate`.
    """

    system: Scene | Callable[..., object]
    over: dict[str, Any]
    observe: dict[str, object] | None
    run: dict[str, Any]


def read_spec(path: Path) -> Spec:
    """Read a SPEC. What it says of names of numbers and observables is left to `sweep`.

    **Raises:**

    - `ValueError` for a mistake in it, as one sentence with the table and the key.
    """
    file, name = _table.read_toml(path), path.name
    whole = _table.read_table(_SpecTable, file, name)
    arguments = _run(whole.run, _table.inner(name, "run"))
    system = read_system(whole.scene, _table.inner(name, "scene"), path.parent)
    over = _table.inner(name, "over")
    dimensions = {key: _dimension(key, given, over) for key, given in whole.over.items()}
    along = "ts" in arguments or not isinstance(system, Scene)
    kept = None if whole.observe is None else _observe(whole.observe, _table.inner(name, "observe"), along)
    return Spec(system, dimensions, kept, arguments)


def _run(content: dict[str, object], where: str) -> dict[str, object]:
    arguments = _table.read_table(_RunTable, content, where).model_dump(exclude_none=True)
    ts = arguments.get("ts")
    if isinstance(ts, dict):
        times = _table.read_table(_TimesTable, ts, _table.inner(where, "ts"))
        ts = np.linspace(times.start, times.stop, times.count)
    return arguments if ts is None else {**arguments, "ts": np.asarray(ts, float)}


def _dimension(name: str, given: object, over: str) -> object:
    """Values of a dimension, or of several numbers that change along it."""
    if isinstance(given, list):
        return given
    if not isinstance(given, dict):
        raise ValueError(f"{over}: {name} must be a list or a table, but {given!r} was given.")
    where = _table.inner(over, name)
    if any(sampler in given for sampler in _SAMPLERS):
        return _sample(_table.read_table(_SamplesTable, given, where), where)
    if any(key in given for key in _SPAN):
        return _span(_table.read_table(_SpanTable, given, where), where)
    for each, values in given.items():
        if not isinstance(values, list):
            raise ValueError(
                f"{where}: {each} must be a list, as numbers that change together are, but {values!r} was given; a"
                f" dimension has {', '.join(_SPAN)} or latin_hypercube, and names with a dot stand in quotes."
            )
    return given


def _span(span: _SpanTable, where: str) -> np.ndarray:
    if span.spacing == "linear":
        return np.linspace(span.low, span.to, span.count)
    if min(span.low, span.to) <= 0:
        raise ValueError(
            f"{where}: from and to must be > 0 for spacing = 'log', but they are {span.low:g} and {span.to:g}."
        )
    return np.geomspace(span.low, span.to, span.count)


def _sample(samples: _SamplesTable, where: str) -> dict[str, np.ndarray]:
    chosen = {name: ranges for name in _SAMPLERS if (ranges := getattr(samples, name)) is not None}
    if len(chosen) > 1:
        raise ValueError(f"{where}: {' and '.join(chosen)} are given; one of them draws the samples.")
    ((name, ranges),) = chosen.items()
    spans = {key: tuple(span) if isinstance(span, list) else span for key, span in ranges.items()}
    try:
        return _SAMPLERS[name](spans, samples.count, seed=samples.seed)
    except ValueError as error:
        raise ValueError(f"{where}: {name}: {error}") from error


@dataclass(frozen=True)
class Reduced:
    """One number of an observable along a run.

    - `of`: its name; `take`: which number, as in `_ObservedTable`. Means are over time, by the trapezoidal rule.
    """

    of: str
    take: str

    def __call__(self, run: Trajectory) -> Array:
        """The number."""
        x, t = named_series(run, self.of), run.t
        if self.take == "end":
            return x[-1]
        if self.take in ("mean", "rms"):
            mean = jnp.trapezoid(x if self.take == "mean" else x**2, t) / (t[-1] - t[0])
            return mean if self.take == "mean" else jnp.sqrt(mean)
        if self.take == "peak":
            return jnp.max(jnp.abs(x))
        return {"max": jnp.max, "min": jnp.min, "ptp": jnp.ptp}[self.take](x)


def _observe(content: dict[str, object], where: str, along: bool) -> dict[str, object]:
    """What is kept of each run; `along` says whether the run may be known over time."""
    kept: dict[str, object] = {}
    for name, given in content.items():
        if isinstance(given, str):
            kept[name] = given
            continue
        if not isinstance(given, dict):
            raise ValueError(f"{where}: {name} must be text or a table, but {given!r} was given.")
        asked = _table.read_table(_ObservedTable, given, _table.inner(where, name))
        if asked.take not in (None, "end") and not along:
            raise ValueError(
                f"{_table.inner(where, name)}: take = {asked.take!r} needs the run over time, but [run] has no ts."
            )
        what = asked.of if asked.take is None else Reduced(asked.of, asked.take)
        kept[name] = what if asked.unit is None else (what, asked.unit)
    if not kept:
        raise ValueError(f'{where}: it is empty; name what to keep, as in v_end = "qd[0]".')
    return kept
