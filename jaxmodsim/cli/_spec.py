"""The SPEC of `jaxmodsim sweep`, `orbit`, `branch` and `export`: a TOML file, read into arguments of the library.

A mistake raises a `ValueError` of one sentence with the table and the key.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree
from pydantic import Field

from ..metrics import peak
from ..scene import Scene
from ..simulation import Trajectory, named_series
from ..sweeps import latin_hypercube, sobol
from . import _toml

_SAMPLERS: dict[str, Callable[..., dict[str, np.ndarray]]] = {"latin_hypercube": latin_hypercube, "sobol": sobol}


class _SweepTables(_toml.AbstractTable):
    scene: _toml.Table
    over: _toml.Table
    run: _toml.Table = Field({})
    observe: _toml.Table | None = None


class _RunTable(_toml.AbstractTable):
    q0: _toml.Numbers | None = None
    qd0: _toml.Numbers | None = None
    t0: _toml.Number | None = None
    t1: _toml.Number | None = None
    ts: _toml.Numbers | _toml.Table | None = None
    rtol: _toml.Number | None = None
    atol: _toml.Number | None = None
    dt: _toml.Number | None = None
    dtmax: _toml.Number | None = None
    max_steps: _toml.Whole | None = None
    max_events: _toml.Whole | None = None
    stick_on_chatter: _toml.Switch | None = None
    project: _toml.Switch | None = None


class _TimesTable(_toml.AbstractTable):
    start: _toml.Number
    stop: _toml.Number
    count: _toml.Whole


class _SpanTable(_toml.AbstractTable):
    low: _toml.Number = Field(alias="from")
    to: _toml.Number
    count: _toml.Whole
    spacing: Literal["linear", "log"] = "linear"


class _SamplesTable(_toml.AbstractTable):
    latin_hypercube: _toml.Table | None = None
    sobol: _toml.Table | None = None
    count: _toml.Whole
    seed: _toml.Seed = 0


class _ObservedTable(_toml.AbstractTable):
    of: _toml.Text
    take: Literal["end", "max", "min", "mean", "rms", "peak", "ptp"] | None = None
    unit: _toml.Text | None = None


class _OrbitTables(_toml.AbstractTable):
    scene: _toml.Table
    orbit: _toml.Table
    branch: _toml.Table | None = None


class _OrbitTable(_toml.AbstractTable):
    q0: _toml.Numbers
    qd0: _toml.Numbers
    period: _toml.Number | None = None
    frequency: _toml.Text | None = None
    settle: _toml.Number | None = None
    rtol: _toml.Number | None = None
    atol: _toml.Number | None = None


class _BranchTable(_toml.AbstractTable):
    parameter: _toml.Text
    first: _toml.Number = Field(alias="from")
    to: _toml.Number
    start: Literal["orbit", "Hopf"] = "orbit"
    step: _toml.Number | None = None
    max_orbits: _toml.Whole | None = None


class _ExportTables(_toml.AbstractTable):
    scene: _toml.Table
    export: _toml.Table


class _ExportTable(_toml.AbstractTable):
    q0: _toml.Numbers
    qd0: _toml.Numbers
    inputs: _toml.Texts | None = None
    platforms: _toml.Texts | None = None
    t1: _toml.Number | None = None
    rtol: _toml.Number | None = None
    atol: _toml.Number | None = None


_SPAN_KEYS = tuple(field.alias or name for name, field in _SpanTable.model_fields.items())


@dataclass(frozen=True)
class SweepSpec:
    """The arguments of `jaxmodsim.sweep`, read from a file; those in `run` go to `simulate`."""

    system: Scene | Callable[..., object]
    over: dict[str, Any]
    observe: dict[str, object] | None
    run: dict[str, Any]


@dataclass(frozen=True)
class OrbitSpec:
    """The arguments of `periodic_orbit` and `continue_orbits`, read from a file.

    - `guess`: `(q0, qd0)`; `options`: `period` and other arguments of both functions.
    - `branch`: arguments of `continue_orbits` alone; None without a table [branch].
    - `from_rest`: whether the branch begins at the first Hopf point of the equilibria from `q0`.
    """

    scene: Scene
    guess: tuple[list[float], list[float]]
    options: dict[str, Any]
    branch: dict[str, Any] | None
    from_rest: bool = False


@dataclass(frozen=True)
class PeriodOf:
    """The period of a force whose angular frequency [rad/s] is an entry of `params`."""

    frequency: str

    def __call__(self, params: PyTree) -> Array:
        """The period [s]."""
        return 2.0 * math.pi / params[self.frequency]


@dataclass(frozen=True)
class Reduced:
    """A number that summarises the values of an observable at the saved times of a run.

    - `of`: name of the observable; `take`: which number, as in `_ObservedTable`. Means are over time, by the
      trapezoidal rule.
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
        return {"max": jnp.max, "min": jnp.min, "ptp": jnp.ptp}[self.take](x)


def read_sweep_spec(path: Path) -> SweepSpec:
    """Read the SPEC of a sweep. Names of numbers and observables are checked by `sweep`."""
    name = path.name
    whole = _toml.read_table(_SweepTables, _toml.read_toml(path), name)
    arguments = _toml.read_table(_RunTable, whole.run, where := _toml.inner(name, "run")).model_dump(exclude_none=True)
    if isinstance(arguments.get("ts"), dict):
        times = _toml.read_table(_TimesTable, arguments["ts"], _toml.inner(where, "ts"))
        arguments["ts"] = np.linspace(times.start, times.stop, times.count)
    if "ts" in arguments:
        arguments["ts"] = np.asarray(arguments["ts"], float)
    system = _toml.read_system(whole.scene, _toml.inner(name, "scene"), path.parent)
    over = _toml.inner(name, "over")
    dimensions = {key: _dimension(key, entry, over) for key, entry in whole.over.items()}
    series = "ts" in arguments or not isinstance(system, Scene)
    observe = None if whole.observe is None else _observe(whole.observe, _toml.inner(name, "observe"), series)
    return SweepSpec(system, dimensions, observe, arguments)


def _dimension(name: str, entry: object, over: str) -> object:
    """Values of a dimension, or of several numbers that change along it."""
    if isinstance(entry, list):
        return entry
    if not isinstance(entry, dict):
        raise ValueError(f"{over}: {name} must be a list or a table, but {entry!r} was given.")
    where = _toml.inner(over, name)
    if any(sampler in entry for sampler in _SAMPLERS):
        return _sample(_toml.read_table(_SamplesTable, entry, where), where)
    if any(key in entry for key in _SPAN_KEYS):
        span = _toml.read_table(_SpanTable, entry, where)
        if span.spacing == "log" and min(span.low, span.to) <= 0:
            raise ValueError(
                f"{where}: from and to must be > 0 for spacing = 'log', but they are {span.low:g} and {span.to:g}."
            )
        return (np.linspace if span.spacing == "linear" else np.geomspace)(span.low, span.to, span.count)
    for number, values in entry.items():
        if not isinstance(values, list):
            raise ValueError(
                f"{where}: {number} must be a list, as numbers that change together are, but {values!r} was given; a"
                f" dimension has {', '.join(_SPAN_KEYS)} or latin_hypercube, and names with a dot need quotes."
            )
    return entry


def _sample(samples: _SamplesTable, where: str) -> dict[str, np.ndarray]:
    chosen = {name: ranges for name in _SAMPLERS if (ranges := getattr(samples, name)) is not None}
    if len(chosen) > 1:
        raise ValueError(f"{where}: {' and '.join(chosen)} exclude each other; name the one that draws the samples.")
    ((name, ranges),) = chosen.items()
    spans = {key: tuple(span) if isinstance(span, list) else span for key, span in ranges.items()}
    try:
        return _SAMPLERS[name](spans, samples.count, seed=samples.seed)
    except ValueError as error:
        raise ValueError(f"{where}: {name}: {error}") from error


def _observe(content: dict[str, object], where: str, series: bool) -> dict[str, object]:
    """The observables of a run; `series` says whether the run may be known over time."""
    observables: dict[str, object] = {}
    for name, entry in content.items():
        if isinstance(entry, str):
            observables[name] = entry
            continue
        if not isinstance(entry, dict):
            raise ValueError(f"{where}: {name} must be text or a table, but {entry!r} was given.")
        table = _toml.read_table(_ObservedTable, entry, _toml.inner(where, name))
        if table.take not in (None, "end", "peak") and not series:
            raise ValueError(
                f"{_toml.inner(where, name)}: take = {table.take!r} needs the run over time, but [run] has no ts."
            )
        of = table.of
        if table.take is not None:
            of = peak(of) if table.take == "peak" else Reduced(of, table.take)
        observables[name] = of if table.unit is None else (of, table.unit)
    if not observables:
        raise ValueError(f'{where}: it is empty; name an observable, as in v_end = "qd[0]".')
    return observables


def read_orbit_spec(path: Path) -> OrbitSpec:
    """Read the SPEC of an orbit or a branch."""
    name = path.name
    whole = _toml.read_table(_OrbitTables, _toml.read_toml(path), name)
    scene, where = _scene(whole.scene, path), _toml.inner(name, "orbit")
    options = _toml.read_table(_OrbitTable, whole.orbit, where).model_dump(exclude_none=True)
    guess, frequency = (options.pop("q0"), options.pop("qd0")), options.pop("frequency", None)
    if frequency is not None:
        if "period" in options:
            raise ValueError(f"{where}: period and frequency exclude each other; both define the period.")
        if not isinstance(scene.params, dict) or frequency not in scene.params:
            known = ", ".join(scene.params) if isinstance(scene.params, dict) else "none"
            raise ValueError(
                f"{where}: frequency must be the name of an entry of params, which is the angular frequency [rad/s] of"
                f" the force, but {frequency!r} was given; the entries are: {known}."
            )
        options["period"] = PeriodOf(frequency)
    if whole.branch is None:
        return OrbitSpec(scene, guess, options, None)
    branch = _toml.read_table(_BranchTable, whole.branch, _toml.inner(name, "branch")).model_dump(exclude_none=True)
    branch["span"] = (branch.pop("first"), branch.pop("to"))
    from_rest = branch.pop("start") == "Hopf"
    if from_rest and not {"period", "settle"}.isdisjoint(options):
        raise ValueError(
            f'{where}: orbits from a Hopf point have their own period and do not settle: with start = "Hopf" omit'
            " period, frequency and settle."
        )
    return OrbitSpec(scene, guess, options, branch, from_rest)


def read_export_spec(path: Path) -> tuple[Scene, dict[str, Any]]:
    """Read the SPEC of an FMU: the scene, and the other arguments of `export.fmu`, by name."""
    whole = _toml.read_table(_ExportTables, _toml.read_toml(path), path.name)
    scene = _scene(whole.scene, path)
    table = _toml.read_table(_ExportTable, whole.export, _toml.inner(path.name, "export"))
    return scene, table.model_dump(exclude_none=True)


def _scene(content: dict[str, object], path: Path) -> Scene:
    where = _toml.inner(path.name, "scene")
    scene = _toml.read_system(content, where, path.parent)
    if not isinstance(scene, Scene):
        raise ValueError(f"{where}: object must be a Scene, but it is a function.")
    return scene
