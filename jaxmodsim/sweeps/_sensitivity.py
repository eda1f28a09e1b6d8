"""`global_sensitivity`: the effect of parameters on runs over their whole ranges."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from .._core.arguments import as_whole
from .._core.system import extra
from ..metrics import motion_kind
from ..scene import Scene
from ._samples import Span, check_power, check_ranges, spread
from ._sweep import sweep

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

# Largest share of the design that may be lost with runs that failed or have no value.
_LOSS = 0.2
# Least number of trajectories of Morris's design.
_FEWEST = 8
_TITLES = {"sobol": "Sobol' indices", "morris": "Elementary effects (Morris)"}
_INDICES = {"sobol": ("S1", "ST"), "morris": ("mu_star", "mu", "sigma")}


class Indices(NamedTuple):
    """Indices of one observable by each parameter, shape `[parameters]` each; NaN if they cannot be computed.

    - `values`: by name. By variance `S1`, the share of the variance that a parameter explains alone, and `ST`, the
      share with all its interactions. By elementary effects `mu_star`, the mean magnitude of the change of the
      observable over the whole range of a parameter, `mu`, the mean with its sign, and `sigma`, the standard deviation.
    - `errors`: half widths of the confidence intervals, by the same names.
    - `runs`: number of runs they are computed from.
    """

    values: dict[str, Float[np.ndarray, " parameters"]]
    errors: dict[str, Float[np.ndarray, " parameters"]]
    runs: int


@dataclass(frozen=True)
class GlobalSensitivity:
    """Indices of each observable by each parameter, from `global_sensitivity`.

    Prints as a table with confidence intervals; `jaxmodsim.plot.indices_figure` draws it.

    - `method`: "sobol" or "morris"; `names`: the parameters; `confidence`: of the intervals.
    - `indices`: the indices of each observable, by name.
    - `motions`: share of the runs with each kind of motion, largest first; empty without event-driven friction.
    - `units`: of the observables that have one.
    - `failed`: number of runs that failed. `dropped`: number of runs that were left out with them.
    - `runs`: all runs, from `sweep`.
    - `warnings`: sentences on what limits the indices.
    """

    method: str
    names: tuple[str, ...]
    confidence: float
    indices: dict[str, Indices]
    motions: dict[str, float]
    units: dict[str, str]
    failed: int
    dropped: int
    runs: "xr.Dataset"
    warnings: tuple[str, ...]

    def table(self) -> "pd.DataFrame":
        """A row for each observable and parameter; half widths of intervals in columns `_conf`."""
        rows = []
        for name, indices in self.indices.items():
            for j, parameter in enumerate(self.names):
                row: dict[str, object] = {"observable": name, "parameter": parameter}
                for index, values in indices.values.items():
                    row[index] = float(values[j])
                    if index in indices.errors:
                        row[f"{index}_conf"] = float(indices.errors[index][j])
                rows.append(row | {"runs": indices.runs})
        return extra("pandas").DataFrame(rows)

    def __str__(self) -> str:
        """A table for each observable, the kinds of motion and the warnings."""
        total, width = self.runs["result"].size, max(map(len, self.names))
        lines = [f"{_TITLES[self.method]} of {len(self.names)} parameters from {total} runs, {self.failed} failed"]
        if self.motions:
            lines.append("motion: " + ", ".join(f"{kind} {100 * share:.0f} %" for kind, share in self.motions.items()))
        for name, indices in self.indices.items():
            unit = f" [{self.units[name]}]" if name in self.units and self.method == "morris" else ""
            if all(np.isnan(x).all() for x in indices.values.values()):
                lines += ["", f"{name}{unit}: no indices"]
                continue
            lines += ["", f"{name}{unit} ({indices.runs} runs)"]
            lines.append(" " * width + "".join(f"  {index:>21}" for index in indices.values))
            for j, parameter in enumerate(self.names):
                cells = []
                for index, values in indices.values.items():
                    error = f" +- {indices.errors[index][j]:8.2g}" if index in indices.errors else ""
                    cells.append(f"  {f'{values[j]:.3g}{error}':>21}")
                lines.append(f"{parameter:{width}}{''.join(cells)}")
        return "\n".join([*lines, *(f"- {warning}" for warning in self.warnings)])


def global_sensitivity(
    system: Scene | Callable[..., object],
    observe: Mapping[str, object] | Sequence[str] | str | None,
    ranges: Mapping[str, Span],
    *,
    method: str = "sobol",
    count: int = 256,
    seed: int = 0,
    confidence: float = 0.95,
    **options: object,
) -> GlobalSensitivity:
    """Compute the effect of parameters on observables over the whole ranges of the parameters.

    **Sobol' indices** (`method="sobol"`) divide the variance of an observable among the parameters: `S1` is the share
    of a parameter alone, `ST` the share with all its interactions. They cost `count (D + 2)` runs for D parameters.
    **Elementary effects** (`method="morris"`) are changes of the observable as one parameter crosses its range:
    `mu_star` is their mean magnitude, in the unit of the observable, `mu` the mean with its sign, and `sigma` their
    standard deviation, which interactions and curvature cause. They cost `count (D + 1)` runs; 20 to 50 trajectories
    are enough to rank parameters.

    Averages over runs that stick and runs that do not can mislead. For a scene with event-driven friction, the result
    has the share of each kind of motion (`metrics.motion_kind`), and warns if there are several. Then narrow the ranges
    to one kind, or observe the kind itself, as a function of the run that returns 1.0 or 0.0: its indices show which
    parameters decide the motion.

    A run that fails, or an observable that is NaN (such as the period of a run that comes to rest), removes its whole
    block of the design, `D + 2` or `D + 1` runs. An observable that loses more than 20 % of the design has no indices.

    The designs and statistics are those of SALib (Herman, Usher 2017, J. Open Source Softw. 2:97).

    **Arguments:**

    - `system`: a `Scene`, or a function, as for `sweep`.
    - `observe`: observables with one number for each run, as for `sweep`; see `jaxmodsim.metrics`. None for a function
      that returns numbers.
    - `ranges`: of each parameter, by names as in `over` of `sweep`: `(low, high)`, `(low, high, "log")` or a frozen
      distribution of `scipy.stats`.
    - `method`: "sobol" or "morris".
    - `count`: size of the design. For Sobol' indices a power of two; for elementary effects the number of
      trajectories, >= 8.
    - `seed`: of the random numbers.
    - `confidence`: of the intervals, between 0 and 1.
    - `options`: further arguments of `sweep`: `q0`, `qd0`, `t1`, `ts`, `out`, and so on. Events of each run are logged
      in `max_events` entries (1024 by default): a smaller number is faster.

    **Returns:**

    A `GlobalSensitivity`.

    **Raises:**

    - `ValueError` for wrong ranges, names or counts, observables with several numbers, and if failed runs remove more
      than 20 % of the design.
    - `ImportError` without the extra `sweep`.

    **Example:**

    ```python
    def deflection(F, k):
        return F / k

    result = jms.sweeps.global_sensitivity(deflection, None, {"F": (1.0, 2.0), "k": (50.0, 200.0, "log")}, count=512)
    (indices,) = result.indices.values()
    print(dict(zip(result.names, indices.values["ST"].round(1).tolist(), strict=True)))
    ```

    ```text
    {'F': 0.2, 'k': 0.8}
    ```
    """
    if method not in _INDICES:
        raise ValueError(f"method must be 'sobol' or 'morris', but {method!r} was given.")
    check_ranges(ranges)
    if method == "sobol":
        check_power(count)
    else:
        as_whole(count, name="count", least=_FEWEST)
    if not 0 < confidence < 1:
        raise ValueError(f"confidence must lie between 0 and 1, but {confidence!r} was given.")
    kind = motion_kind(*system.event_driven) if isinstance(system, Scene) and system.event_driven else None
    if kind is not None and observe is not None:
        names = [observe] if isinstance(observe, str) else observe
        observe = {**(names if isinstance(names, Mapping) else {name: name for name in names}), kind.label: kind}
    order = {"calc_second_order": False} if method == "sobol" else {}
    points = extra(f"SALib.sample.{method}").sample(_cube(len(ranges)), int(count), seed=seed, **order)
    design = _Design(method, points, confidence, seed)
    runs = sweep(system, {"sample": spread(ranges, points)}, observe, **options)  # pyright: ignore[reportArgumentType]
    values = _values(runs)
    ok = np.asarray(runs["result"]) == 0
    use = design.whole(ok)
    _check_losses(runs, ok, use)
    motions = {} if kind is None else _shares(values.pop(kind.label)[use], kind.describe)
    failed, dropped = int((~ok).sum()), int((~use).sum())
    warnings = [f"{failed} runs failed; {dropped} runs of their blocks were left out."] if failed else []
    if len(motions) > 1:
        warnings.append(
            f"{len(motions)} KINDS OF MOTION: the indices mix changes of the kind with changes within each. Narrow the"
            " ranges, or observe the kind of motion itself."
        )
    indices = {}
    for name, y in values.items():
        defined = design.whole(use & np.isfinite(y))
        if missing := int((use & ~np.isfinite(y)).sum()):
            lost = use.sum() - defined.sum()
            warnings.append(f"{name} is NaN in {missing} of {use.sum()} runs; {lost} runs were left out.")
        elif _is_constant(y[use]):
            warnings.append(f"{name} is the same in all runs.")
        enough = defined.sum() >= (1 - _LOSS) * use.sum()
        indices[name] = design.indices(y, defined if enough else np.zeros_like(use))
    units = {name: runs[name].attrs["units"] for name in values if "units" in runs[name].attrs}
    return GlobalSensitivity(
        method, tuple(ranges), confidence, indices, motions, units, failed, dropped, runs, tuple(warnings)
    )


@dataclass(frozen=True)
class _Design:
    """A design in the unit cube, whose blocks of runs can only be used as a whole.

    - `points`: shape `[runs, parameters]`.
    """

    method: str
    points: Float[np.ndarray, "runs parameters"]
    confidence: float
    seed: int

    def whole(self, use: Bool[np.ndarray, " runs"]) -> Bool[np.ndarray, " runs"]:
        """The runs of those blocks of which all runs can be used."""
        block = self.points.shape[1] + (2 if self.method == "sobol" else 1)
        return np.repeat(use.reshape(-1, block).all(axis=1), block)

    def indices(self, y: Float[np.ndarray, " runs"], use: Bool[np.ndarray, " runs"]) -> Indices:
        """Indices from the runs of whole blocks."""
        names, y, parameters = _INDICES[self.method], y[use], self.points.shape[1]
        if y.size < 2 * (parameters + 2) or (self.method == "sobol" and _is_constant(y)):
            nothing = dict.fromkeys(names, np.full(parameters, np.nan))
            return Indices(nothing, nothing, y.size)
        # SALib replaces the seed 0 by a random one.
        options = {"conf_level": self.confidence, "seed": self.seed + 1}
        analyze = extra(f"SALib.analyze.{self.method}").analyze
        if self.method == "sobol":
            result = analyze(_cube(parameters), y, calc_second_order=False, **options)
        else:
            result = analyze(_cube(parameters), self.points[use], y, num_resamples=1000, **options)
        values = {name: np.asarray(result[name], float) for name in names}
        return Indices(values, {x: np.asarray(result[f"{x}_conf"]) for x in names if f"{x}_conf" in result}, y.size)


def _cube(parameters: int) -> dict[str, object]:
    """The unit cube as SALib describes it."""
    names = [f"x{i}" for i in range(parameters)]
    return {"num_vars": parameters, "names": names, "bounds": [[0.0, 1.0]] * parameters}


def _is_constant(y: Float[np.ndarray, " runs"]) -> bool:
    return bool(np.ptp(y) <= 1e-12 * np.abs(y).max(initial=0.0))


def _values(runs: "xr.Dataset") -> dict[str, np.ndarray]:
    """Each observable as a vector over the runs."""
    observables = {str(name): x for name, x in runs.data_vars.items() if name not in ("result", "num_steps")}
    for name, x in observables.items():
        if x.ndim != 1:
            raise ValueError(
                f"Indices need one number for each run, but {name!r} also has the dimensions {x.dims[1:]}: observe one"
                " entry, as metrics.final('q[0]') does."
            )
    return {name: np.asarray(x, float) for name, x in observables.items()}


def _shares(labels: np.ndarray, describe: Callable[[float], str]) -> dict[str, float]:
    """Share of the runs with each label, largest first."""
    kinds, counts = np.unique(labels, return_counts=True)
    order = np.argsort(-counts, kind="stable")
    return {describe(float(kinds[i])): float(counts[i] / labels.size) for i in order}


def _check_losses(runs: "xr.Dataset", ok: np.ndarray, use: np.ndarray) -> None:
    lost = 1.0 - use.mean()
    if lost <= _LOSS:
        return
    codes, counts = np.unique(np.asarray(runs["result"])[~ok], return_counts=True)
    sentences = list(runs["result"].attrs.get("flag_meanings", ()))
    reasons = [f"{n} x {sentences[c] if 0 <= c < len(sentences) else c}" for c, n in zip(codes, counts, strict=True)]
    raise ValueError(
        f"{(~ok).sum()} of {ok.size} runs failed, which removes {100 * lost:.0f} % of the design, more than"
        f" {100 * _LOSS:.0f} %: {' '.join(reasons)} Narrow the ranges, or fix these runs."
    )
