"""`global_sensitivity`: which parameters matter over their whole ranges, motion by motion."""

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from ..metrics import motion_kind
from ..scene import Scene
from ._estimates import Estimate, MorrisDesign, SobolDesign, constant, morris_design, sobol_design
from ._global import GlobalSensitivity
from ._samples import Span, check_power, check_ranges, spread
from ._sweep import sweep

if TYPE_CHECKING:
    import xarray as xr

_DESIGNS = {"sobol": sobol_design, "morris": morris_design}
# Share of the blocks of a design that may be lost.
_LOSS = 0.2
# Share of the runs from which on a class has indices of its own.
_RARE = 0.05
# Trajectories of Morris's design below which a mean effect says nothing.
_FEWEST = 8


class _Classes(NamedTuple):
    """Kinds of motion: of each run its label, and of each label its name and its share of the runs, largest first."""

    labels: np.ndarray
    names: dict[float, str]
    shares: dict[float, float]

    @property
    def common(self) -> list[float]:
        """Labels of those that are not rare."""
        return [label for label, share in self.shares.items() if share >= _RARE]


def global_sensitivity(
    system: Scene | Callable[..., object],
    observe: Mapping[str, object] | Sequence[str] | str | None,
    ranges: Mapping[str, Span],
    *,
    method: str = "sobol",
    count: int = 256,
    by: str | None = None,
    seed: int = 0,
    confidence: float = 0.95,
    **options: object,
) -> GlobalSensitivity:
    """Which parameters matter over their whole ranges, for each kind of motion apart.

    ```python
    result = sweeps.global_sensitivity(
        scene,
        {"period": metrics.period(), "peak": metrics.peak("friction")},
        {"friction.Fs": (5.0, 9.0), "k": (50.0, 200.0, "log")},
        q0=[0.0], qd0=[0.1], t1=10.0, ts=jnp.linspace(0.0, 10.0, 201), max_events=64,
    )
    print(result)
    ```

    **Sobol' indices** (`method="sobol"`) share out the variance of an observable: `S1` goes with one parameter alone,
    `ST` with it in any way, so that their difference is its part in interactions. They cost `count (D + 2)` runs for D
    parameters. **Elementary effects** (`method="morris"`) are changes of the observable as one parameter goes its
    range: `mu_star` is the mean of their sizes, in the unit of the observable over the whole range of the parameter,
    `mu` that with signs, `sigma` their scatter, which interactions and curvature cause. They cost `count (D + 1)` runs
    and few trajectories (20 to 50) rank parameters.

    Where some runs stick and others do not, an average over all of them says little of either. So runs are put into
    classes of motion, by the observable `by`, and there are also:

    - the indices of the class itself: which parameters decide the motion;
    - those within each class with at least 5 % of the runs. By elementary effects, those between two points of one
      class count, and of each parameter the share of steps that lead into another class is kept. By variance, the
      points of a class make no Saltelli design, so that total indices cannot be had: there are `S1` from given data, of
      the independent points of the design in that class, if there are 128 of them. A class seldom fills the box of the
      ranges; parameters that its edge ties together then share the part of the variance that both explain.

    Runs that fail take their whole block of the design with them, `D + 2` or `D + 1` runs. So do those in which an
    observable is not defined (NaN, as the period of a run that comes to rest), for this one observable over all runs;
    where that leaves less than 80 %, there are only the classes.

    Samples and Sobol' statistics are SALib's (Herman, Usher 2017, J. Open Source Softw. 2:97).

    **Arguments:**

    - `system`: a `Scene`, or a function, as for `sweep`.
    - `observe`: what is observed, one number of each run, as for `sweep`; see `jaxmodsim.metrics`. None for a function
      that returns numbers.
    - `ranges`: of each parameter, by names as in `over` of `sweep`: `(low, high)`, `(low, high, "log")` or a frozen
      distribution of `scipy.stats` (by elementary effects one with ends).
    - `method`: `"sobol"` or `"morris"`.
    - `count`: blocks of the design: for Sobol' indices a power of two; for elementary effects, of trajectories, >= 8.
    - `by`: the name of an observable that says which kind of motion a run has, as `metrics.motion_kind` or
      `metrics.classes` do. By default `motion_kind` of all elements of a scene that run by events; without such, runs
      are not put into classes.
    - `seed`: of the random numbers.
    - `confidence`: of the intervals, between 0 and 1.
    - `options`: further arguments of `sweep`: `q0`, `qd0`, `t1`, `ts`, `out`, and so on. Events of each run are logged
      in `max_events` entries (1024 by default): a smaller one, of what runs need, is faster.

    **Returns:**

    A `GlobalSensitivity`.

    **Raises:**

    - `ValueError` for wrong ranges, names, counts, observables that are more than one number, and if more than 20 % of
      the blocks have a run that failed.
    - `ImportError` where the extra `sweep` is not installed.
    """
    if method not in _DESIGNS:
        raise ValueError(f"method must be 'sobol' or 'morris', but {method!r} was given.")
    check_ranges(ranges)
    if method == "sobol":
        check_power(count)
    elif isinstance(count, bool) or not isinstance(count, int | np.integer) or count < _FEWEST:
        raise ValueError(f"count must be a number of trajectories, at least {_FEWEST}, but {count!r} was given.")
    if not 0 < confidence < 1:
        raise ValueError(f"confidence must lie between 0 and 1, but {confidence!r} was given.")
    asked, by = _asked(system, observe, by)
    design = _DESIGNS[method](len(ranges), int(count), confidence, seed)
    given: dict[str, Any] = options
    runs = sweep(system, {"sample": spread(ranges, design.points)}, asked, **given)
    values = _values(runs, by)
    ok = np.asarray(runs["result"]) == 0
    use = np.repeat(ok.reshape(-1, design.block).all(axis=1), design.block)
    _check_losses(runs, ok, use)
    classes = _classes(values.pop(by), use, getattr(_given(asked, by), "describe", None), by) if by else None
    if not values:
        raise ValueError(f"There is nothing to observe but {by!r}, which says the kind of motion: name a quantity.")
    return _result(method, design, tuple(ranges), runs, values, use, classes, confidence)


def _asked(
    system: object, observe: Mapping[str, object] | Sequence[str] | str | None, by: str | None
) -> tuple[dict[str, object] | None, str | None]:
    """What is observed, with the kind of motion where a scene has one, and its name."""
    if observe is None:
        return None, by
    asked: dict[str, object] = {name: name for name in ([observe] if isinstance(observe, str) else observe)}
    if isinstance(observe, Mapping):
        asked = dict(observe)
    if by is None and isinstance(system, Scene) and system.event_driven:
        kind = motion_kind(*system.event_driven)
        return asked | {kind.label: kind}, kind.label
    if by is not None and by not in asked:
        raise ValueError(f"by names {by!r}, but what is observed is: {', '.join(asked)}.")
    return asked, by


def _given(asked: Mapping[str, object] | None, name: str) -> object:
    given = None if asked is None else asked[name]
    return given[0] if isinstance(given, tuple) else given


def _values(runs: "xr.Dataset", by: str | None) -> dict[str, np.ndarray]:
    """Each observable as a vector over the runs."""
    values = {str(name): runs[name] for name in runs.data_vars if name not in ("result", "num_steps")}
    if by is not None and by not in values:
        raise ValueError(f"by names {by!r}, but the function returns: {', '.join(values)}.")
    for name, value in values.items():
        if value.ndim != 1:
            raise ValueError(
                f"Indices are of one number of each run, but {name!r} has the dimensions {value.dims[1:]} beside:"
                " observe one of them, as metrics.final('q[0]') does."
            )
    return {name: np.asarray(value, float) for name, value in values.items()}


def _check_losses(runs: "xr.Dataset", ok: np.ndarray, use: np.ndarray) -> None:
    lost = 1.0 - use.mean()
    if lost <= _LOSS:
        return
    codes, counts = np.unique(np.asarray(runs["result"])[~ok], return_counts=True)
    sentences = list(runs["result"].attrs.get("flag_meanings", ()))
    reasons = [f"{n} x {sentences[c] if 0 <= c < len(sentences) else c}" for c, n in zip(codes, counts, strict=True)]
    raise ValueError(
        f"{(~ok).sum()} of {ok.size} runs failed, with which {100 * lost:.0f} % of the design is lost, more than"
        f" {100 * _LOSS:.0f} %: {' '.join(reasons)} Narrow the ranges, or mend these runs."
    )


def _classes(labels: np.ndarray, use: np.ndarray, describe: Callable[[object], str] | None, by: str) -> _Classes:
    if not np.isfinite(labels[use]).all():
        raise ValueError(f"by={by!r} is not a number in some runs: it must say a class for each.")
    values, counts = np.unique(labels[use], return_counts=True)
    order = np.argsort(-counts, kind="stable")
    names = {float(x): f"{by} = {x:g}" if describe is None else describe(x) for x in values}
    return _Classes(labels, names, {float(values[i]): float(counts[i] / use.sum()) for i in order})


def _result(
    method: str,
    design: SobolDesign | MorrisDesign,
    names: tuple[str, ...],
    runs: "xr.Dataset",
    values: dict[str, np.ndarray],
    use: np.ndarray,
    classes: _Classes | None,
    confidence: float,
) -> GlobalSensitivity:
    failed = int((np.asarray(runs["result"]) != 0).sum())
    dropped = int((~use).sum())
    remarks = [f"{failed} runs failed; with them {dropped} were left out."] if failed else []
    overall = {}
    for name, y in values.items():
        overall[name], more = _over_all(design, name, y, use)
        remarks += more
    membership: dict[str, Estimate] = {}
    within: dict[str, dict[str, Estimate]] = {}
    crossings = None
    several = classes is not None and len(classes.shares) > 1
    if classes is not None and several:
        common = classes.common
        for label in common[:1] if len(classes.shares) == 2 else common:
            membership[classes.names[label]] = design.overall((classes.labels == label).astype(float), use)
        for label in common:
            there = use & (classes.labels == label)
            within[classes.names[label]] = {
                name: design.within(y, there & np.isfinite(y)) for name, y in values.items()
            }
        crossings = design.crossings(classes.labels, use) if isinstance(design, MorrisDesign) else None
        remarks += _of_classes(classes)
    return GlobalSensitivity(
        method,
        names,
        confidence,
        overall,
        {} if classes is None else {classes.names[label]: share for label, share in classes.shares.items()},
        membership,
        within,
        crossings,
        {name: runs[name].attrs["units"] for name in values if "units" in runs[name].attrs},
        failed,
        dropped,
        runs,
        tuple(remarks),
    )


def _over_all(
    design: SobolDesign | MorrisDesign, name: str, y: np.ndarray, use: np.ndarray
) -> tuple[Estimate, list[str]]:
    """Indices over all runs of an observable, and what is to be said of them."""
    defined = use & np.isfinite(y)
    left = np.repeat(defined.reshape(-1, design.block).all(axis=1), design.block)
    undefined = int((use & ~defined).sum())
    if not undefined:
        return design.overall(y, use), [f"{name} is the same in all runs."] if constant(y[use]) else []
    if left.sum() < (1 - _LOSS) * use.sum():
        said = f"{name} is not defined in {undefined} of {use.sum()} runs: there are no indices over all runs."
        return design.overall(np.where(left, y, 0.0), np.zeros_like(use)), [said]
    said = f"{name} is not defined in {undefined} runs; over all runs {use.sum() - left.sum()} were left out for it."
    return design.overall(np.where(left, y, 0.0), left), [said]


def _of_classes(classes: _Classes) -> list[str]:
    remarks = [
        f"MORE THAN ONE KIND OF MOTION ({len(classes.shares)}): indices over all runs mix the change from one to"
        " another with changes within them. Read which parameters decide the motion, and the indices within each."
    ]
    rare = [classes.names[label] for label in classes.shares if label not in classes.common]
    if rare:
        share = sum(classes.shares[label] for label in classes.shares if label not in classes.common)
        remarks.append(f"Rare, and without indices of their own ({100 * share:.1f} % of the runs): {len(rare)} kinds.")
    return remarks
