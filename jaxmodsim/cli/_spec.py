"""The SPEC of `jaxmodsim sweep`: a TOML file that says what to sweep."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..scene import Scene
from ..simulation import Trajectory, named_series
from ..sweeps import latin_hypercube, sobol
from ._spec_scene import read_system
from ._table import LIST, NUMBER, NUMBERS, SEED, SWITCH, TABLE, TEXT, WHOLE, Kind, Table, one_of, read_table

_RUN: dict[str, Kind] = {
    "q0": NUMBERS,
    "qd0": NUMBERS,
    "t0": NUMBER,
    "t1": NUMBER,
    "rtol": NUMBER,
    "atol": NUMBER,
    "dt": NUMBER,
    "dtmax": NUMBER,
    "max_steps": WHOLE,
    "max_events": WHOLE,
    "hold_chatter": SWITCH,
    "project": SWITCH,
}
_SPAN = ("from", "to", "count", "spacing")
_SAMPLERS: dict[str, Callable[..., dict[str, np.ndarray]]] = {"latin_hypercube": latin_hypercube, "sobol": sobol}


@dataclass(frozen=True)
class Spec:
    """What is to be swept: the arguments of `jaxmodsim.sweep`, read from a file.

    - `run`: those that go to `simulate`.
    """

    system: Scene | Callable[..., Any]
    over: dict[str, Any]
    observe: dict[str, Any] | None
    run: dict[str, Any]


def read_spec(path: Path) -> Spec:
    """Read a SPEC. What it says of names of numbers and observables is left to `sweep`.

    **Raises:**

    - `ValueError` for a mistake in it, as one sentence with the table and the key.
    """
    whole = read_table(path)
    scene, over = whole.table("scene", needed=True), whole.table("over", needed=True)
    run, observe = whole.table("run"), whole.table("observe")
    whole.close()
    assert scene is not None
    assert over is not None
    arguments = {} if run is None else _run(run)
    system = read_system(scene, path.parent)
    kept = None if observe is None else _observe(observe, "ts" in arguments or not isinstance(system, Scene))
    return Spec(system, {name: _dimension(over, name) for name in over.keys}, kept, arguments)


def _run(table: Table) -> dict[str, Any]:
    given = {name: table.take(name, kind) for name, kind in _RUN.items()}
    ts = table.take("ts", NUMBERS, TABLE)
    table.close()
    if isinstance(ts, dict):
        even = table.inner("ts", ts)
        start, stop = (even.take(name, NUMBER, needed=True) for name in ("start", "stop"))
        count = even.take("count", WHOLE, needed=True)
        even.close()
        ts = np.linspace(start, stop, count)
    if ts is not None:
        given["ts"] = np.asarray(ts, float)
    return {name: value for name, value in given.items() if value is not None}


def _dimension(over: Table, name: str) -> Any:
    """Values of a dimension, or of several numbers that change along it."""
    given = over.take(name, LIST, TABLE)
    if isinstance(given, list):
        return given
    table = over.inner(name, given)
    if any(sampler in given for sampler in _SAMPLERS):
        return _sample(table)
    if any(key in given for key in _SPAN):
        return _span(table)
    for each, values in given.items():
        if not isinstance(values, list):
            raise table.refusal(
                f"{each} must be a list, as numbers that change together are, but {values!r} was given; a dimension has"
                f" {', '.join(_SPAN)} or latin_hypercube, and names with a dot stand in quotes."
            )
    return given


def _span(table: Table) -> np.ndarray:
    low, high = (table.take(key, NUMBER, needed=True) for key in ("from", "to"))
    count = table.take("count", WHOLE, needed=True)
    spacing = table.take("spacing", one_of(("linear", "log")))
    table.close()
    if spacing != "log":
        return np.linspace(low, high, count)
    if min(low, high) <= 0:
        raise table.refusal(f"from and to must be > 0 for spacing = 'log', but they are {low:g} and {high:g}.")
    return np.geomspace(low, high, count)


def _sample(table: Table) -> dict[str, np.ndarray]:
    kinds = {name: table.take(name, TABLE) for name in _SAMPLERS}
    count, seed = table.take("count", WHOLE, needed=True), table.take("seed", SEED)
    table.close()
    chosen = {name: ranges for name, ranges in kinds.items() if ranges is not None}
    if len(chosen) > 1:
        raise table.refusal(f"{' and '.join(chosen)} are given; one of them draws the samples.")
    ((name, ranges),) = chosen.items()
    spans = {key: tuple(span) if isinstance(span, list) else span for key, span in ranges.items()}
    try:
        return _SAMPLERS[name](spans, count, seed=seed or 0)
    except ValueError as error:
        raise table.refusal(f"{name}: {error}") from error


@dataclass(frozen=True)
class Reduced:
    """One number of an observable along a run.

    - `of`: its name; `take`: which number, one of `WORDS`. Means are over time, by the trapezoidal rule.
    """

    WORDS: ClassVar[tuple[str, ...]] = ("end", "max", "min", "mean", "rms", "peak", "ptp")

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


def _observe(table: Table, along: bool) -> dict[str, Any]:
    """What is kept of each run; `along` says whether the run may be known over time."""
    kept: dict[str, Any] = {}
    for name in table.keys:
        given = table.take(name, TEXT, TABLE)
        if isinstance(given, str):
            kept[name] = given
            continue
        each = table.inner(name, given)
        of, take = each.take("of", TEXT, needed=True), each.take("take", one_of(Reduced.WORDS))
        unit = each.take("unit", TEXT)
        each.close()
        if take not in (None, "end") and not along:
            raise each.refusal(f"take = {take!r} needs the run over time, but [run] has no ts.")
        what = of if take is None else Reduced(of, take)
        kept[name] = what if unit is None else (what, unit)
    if not kept:
        raise table.refusal('it is empty; name what to keep, as in v_end = "qd[0]".')
    return kept
