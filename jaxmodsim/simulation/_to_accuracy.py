"""Runs with a requested accuracy: two methods, compared until their difference is small."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import pairwise
from typing import TypeAlias

import diffrax as dfx
import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import ArrayLike, PyTree

from .._core.arguments import as_flag
from .._core.arrays import is_known
from .._core.trace_checks import check_indices
from ..scene import Scene
from ._accuracy import Accuracy, Attempt, CostScaling, evaluations_per_step
from ._observe import named_series
from ._outcome import SimulationError
from ._run_request import MOST_EVENTS, MOST_STEPS, TIGHTEST, Plugin, RunRequest, run_request
from ._solve import default_solver, solve
from ._trajectory import Trajectory, trajectory

_ACCURACIES = (1e-12, 1e-1)
# Largest relative tolerance. Absolute tolerances are this part of the relative ones, as by default.
_LOOSEST, _ABSOLUTE = 0.1, 1e-3
# Errors are differences to two references, runs by different methods. In parts of the accuracy: the first tolerance of
# the references, their admissible difference, and that to two runs with ten times looser tolerances.
_AHEAD, _AGREE, _NEAR = 1e-2, 0.25, 0.5
# Difference of the whole state above which two runs are unrelated, for any observable.
_APART = 0.1
# Two runs converge if their difference falls by at least this factor from tolerances this many times looser.
_LOOSER, _FALL = 1e3, 30.0
# An estimate of at least this multiple of its uncertainty shows the order of the error in the tolerance.
_KNOWN = 4.0
# Least magnitude of an observable to which errors are relative.
_SMALLEST = 1e-6
# In stick the integrated state is constant, and all methods make the same steps. Steps of the second method are
# therefore no longer than this part of the run, so that it samples the loads at other times; and its index.
_PART, _BOUNDED = 127.0, 2
# Fewer saved times than the first number do not show magnitudes and chaos; the second number does.
_FEW, _TIMES = 11, 101


Observe: TypeAlias = Callable[[Trajectory], ArrayLike]


@dataclass(frozen=True, eq=False)
class _TrialRun:
    """A run of the search, with the compared observable and state, shape `[..., columns]`."""

    run: Trajectory
    which: int
    solver: dfx.AbstractSolver
    rtol: float
    atol: float
    observed: np.ndarray
    state: np.ndarray
    # The sentence of an early end, or empty.
    failure: str

    @property
    def ok(self) -> bool:
        return not self.failure

    @property
    def bounded(self) -> bool:
        """Whether the search has bounded its steps."""
        return self.which == _BOUNDED

    @property
    def name(self) -> str:
        return type(self.solver).__name__ + (", bounded" if self.bounded else "")

    @property
    def num_steps(self) -> int:
        return int(self.run.stats["num_steps"])

    @property
    def evaluations(self) -> int | None:
        """Evaluations of the vector field in one step."""
        return evaluations_per_step(self.solver, (self.run.q, self.run.qd, self.run.z))


@dataclass(frozen=True)
class _AccuracySearch:
    """The search and its runs, by the tolerance and the index of the method in `solvers`."""

    request: RunRequest
    asked: float
    observe: Observe
    solvers: tuple[dfx.AbstractSolver, ...]
    made: dict[tuple[float, int], _TrialRun] = field(default_factory=dict)
    seen: dict[tuple[float, int], _TrialRun] = field(default_factory=dict)

    @property
    def tightest(self) -> float:
        return _round(TIGHTEST * float(jnp.finfo(self.request.q0.dtype).eps))

    @property
    def second(self) -> int:
        """Index of the method for comparison with the first one."""
        return len(self.solvers) - 1

    def run(self, rtol: float, which: int) -> _TrialRun:
        """The run by one of the methods at a tolerance, made once."""
        if (rtol, which) not in self.made:
            self.made[rtol, which] = self.make(rtol, which, self.request)
        return self.made[rtol, which]

    def along(self, rtol: float, which: int) -> _TrialRun:
        """The same run, saved at more times if it has few."""
        if self.request.ts is not None and self.request.ts.shape[0] >= _FEW:
            return self.run(rtol, which)
        if (rtol, which) not in self.seen:
            ts = np.linspace(self.request.t0, self.request.t1, _TIMES).astype(self.request.q0.dtype)
            self.seen[rtol, which] = self.make(rtol, which, self.request._replace(ts=ts))
        return self.seen[rtol, which]

    def failure(self, rtol: float, which: int) -> str:
        """Sentence of an early end of the run by one of the methods at a tolerance; empty if it reached t1."""
        return self.run(rtol, which).failure or self.along(rtol, which).failure

    def make(self, rtol: float, which: int, request: RunRequest) -> _TrialRun:
        solver, dtype = self.solvers[which], self.request.q0.dtype
        atol = _round(max(_ABSOLUTE * rtol, float(jnp.finfo(dtype).eps)))
        plugin = Plugin(*eqx.partition(solver, eqx.is_array))
        request = request._replace(rtol=np.asarray(rtol, dtype), atol=np.asarray(atol, dtype), solver=plugin)
        if which == _BOUNDED:
            request = request._replace(dtmax=np.asarray((request.t1 - request.t0) / _PART, dtype))
        solved = solve(request)
        _check_known(solved)
        run, failure = trajectory(request, solved), solved.failure(request.scene)
        observed = np.zeros(0) if failure else _observed(self.observe, run)
        return _TrialRun(run, which, solver, rtol, atol, observed, _states(run), failure)

    def pair(self, rtol: float) -> tuple[_TrialRun, ...]:
        """Runs by both methods; by one of them at two tolerances if the other does not reach the end."""
        good = [which for which in (0, self.second) if not self.failure(rtol, which)]
        runs = tuple(self.run(rtol, which) for which in good)
        if len(good) != 1:
            return runs
        other = _round(rtol / 10 if rtol / 10 >= self.tightest else rtol * 10), good[0]
        if self.failure(*other) or self.run(*other).num_steps == runs[0].num_steps:
            return runs
        return (*runs, self.run(*other))


@dataclass(frozen=True)
class _References:
    """Two reference runs, their difference, the magnitudes of the observable, and a remark if they do not agree."""

    runs: tuple[_TrialRun, ...]
    size: np.ndarray
    gap: float
    remark: str

    def error(self, made: _TrialRun) -> float:
        """Difference to the farther reference."""
        return max(_error(made, each, self.size) for each in self.runs)

    def estimate(self, made: _TrialRun) -> float:
        """Estimate of the error of a run: its difference to the references, and the uncertainty of that."""
        return self.error(made) + self.gap if made.ok else math.inf


def _error(one: _TrialRun, other: _TrialRun, size: np.ndarray) -> float:
    return float(np.max(np.abs(one.observed - other.observed) / size))


def simulate_to_accuracy(
    scene: Scene,
    q0: ArrayLike | list[float],
    qd0: ArrayLike | list[float],
    t1: ArrayLike,
    *,
    accuracy: float,
    observable: str | Observe | None = None,
    t0: ArrayLike = 0.0,
    ts: ArrayLike | list[float] | None = None,
    z0: dict[str, PyTree] | None = None,
    dtmax: ArrayLike | None = None,
    solver: dfx.AbstractSolver | None = None,
    adjoint: dfx.AbstractAdjoint | None = None,
    max_steps: int = MOST_STEPS,
    max_events: int = MOST_EVENTS,
    stick_on_chatter: bool = False,
    project: bool = True,
    throw: bool = True,
) -> Trajectory:
    """Run a scene with the solver and the tolerances that give a global accuracy for the least work.

    The search makes about ten runs of two methods. It takes the run with the least work among those whose difference to
    tighter runs by either method is within the accuracy. In scenes with events the second method makes steps of at most
    1/127 of the run, unless `dtmax` bounds both, so that the two methods do not miss the same load. A short pulse that
    all runs miss is not detected: pass `dtmax`.

    Errors are relative to the largest magnitude of the observable at the saved times (with fewer than 11, at 101 times
    along the run), or to 1e-6 of its unit if the magnitude is below that.

    **Arguments:**

    Those of `simulate` without `rtol`, `atol` and `dt`, and:

    - `accuracy`: largest error of the observable, from 1e-12 to 0.1.
    - `observable`: `"q[0]"`, `"qd[0]"`, the name of an effect for its force (followed by `[i]` for a component), or a
      function of the `Trajectory` that returns numbers of shape `[]`, `[time]` or `[time, k]`, each column relative to
      its largest magnitude among the returned numbers. By default all coordinates and velocities, each relative to
      its own magnitude.
    - `solver`: the method; the search then chooses the tolerances alone.
    - `throw`: whether a run that ends early, or an accuracy that is not reached, raises an error. Otherwise
      `run.result` has the outcome, and `run.accuracy.remark` the reason.

    **Returns:**

    A `Trajectory`. `run.accuracy` reports the search, and `run.accuracy.options` are the arguments of `simulate` for
    more such runs.

    **Raises:**

    - `ValueError` as `simulate`, and for traced numbers (`jax.jit`, `jax.vmap`, `jax.grad`).
    - `SimulationError` if the run ended early, or no run has the accuracy, and `throw` is set.

    **Example:**

    ```python
    scene = jms.problems.braked_spring.scene(m=1.0, k=1.0)
    run = jms.simulate_to_accuracy(scene, [1.0], [0.0], 10.0, accuracy=1e-6)
    print(f"{run.q[-1, 0]:.5f} m, in closed form {jnp.cos(10.0):.5f} m")
    ```

    ```text
    -0.83907 m, in closed form -0.83907 m
    ```
    """
    throw = as_flag(throw, name="throw")
    request = run_request(
        *(scene, q0, qd0, t1),
        t0=t0,
        ts=ts,
        z0=z0,
        dtmax=dtmax,
        solver=solver,
        adjoint=adjoint,
        max_steps=max_steps,
        max_events=max_events,
        stick_on_chatter=stick_on_chatter,
        project=project,
    )
    asked = _asked(request, accuracy)
    solvers, choices = _solvers(request)
    search = _AccuracySearch(request, asked, _observe(observable), solvers)
    return _search(search, choices, callable(observable), throw)


def _observe(observable: str | Observe | None) -> Observe:
    if observable is None:
        return _states
    if isinstance(observable, str):
        return partial(named_series, name=observable)
    if callable(observable):
        return observable
    raise ValueError(
        f"observable must be a name such as 'q[0]' or a function of the Trajectory, but {observable!r} was given."
    )


def _search(search: _AccuracySearch, choices: tuple[int, ...], own: bool, throw: bool) -> Trajectory:
    """The run with the least work; `choices` are the admissible methods, see `_references` for `own`."""
    asked = search.asked
    rtol = _round(max(_AHEAD * asked, search.tightest))
    first = search.pair(rtol)
    if len(first) < 2:
        if throw:
            failure = search.failure(rtol, 0) or search.failure(rtol, search.second)
            raise SimulationError(f"accuracy={asked:g} needs runs at rtol {rtol:g} for comparison. {failure}")
        return search.run(rtol, 0).run
    references = _references(search, rtol, own)
    if references.remark:
        if throw:
            raise SimulationError(references.remark)
        return _chosen(search, references, references.runs[0], references.gap)
    for which in choices:
        looser = _round(10 * max(each.rtol for each in references.runs))
        while looser <= _LOOSEST and references.estimate(search.run(looser, which)) <= asked:
            looser = _round(10 * looser)
    good = [made for (_, which), made in search.made.items() if which in choices and references.estimate(made) <= asked]
    best = min(
        good or references.runs,
        key=lambda made: (made.num_steps * (made.evaluations or 1), references.estimate(made)),
    )
    return _chosen(search, references, best, references.estimate(best))


def _check_known(tree: PyTree) -> None:
    if not is_known(*jtu.tree_leaves(tree)):
        raise ValueError(
            "simulate_to_accuracy makes several runs and compares them, which needs numbers that are known, but here"
            " some are traced (jax.jit, jax.vmap or jax.grad): call it once outside, and pass **run.accuracy.options,"
            " its solver, rtol and atol, to simulate here."
        )


def _asked(request: RunRequest, accuracy: float) -> float:
    """The accuracy, checked."""
    _check_known((request, accuracy))
    if isinstance(accuracy, bool) or not isinstance(accuracy, int | float | np.number):
        raise ValueError(f"accuracy must be a known number, as in accuracy=1e-6, but {accuracy!r} was given.")
    if not _ACCURACIES[0] <= accuracy <= _ACCURACIES[1]:
        raise ValueError(
            f"accuracy must lie within [{_ACCURACIES[0]:g}, {_ACCURACIES[1]:g}], but {accuracy:g} was given."
        )
    return float(accuracy)


def _solvers(request: RunRequest) -> tuple[tuple[dfx.AbstractSolver, ...], tuple[int, ...]]:
    """Two methods, and which of them may be chosen; in scenes with events the second one again, for bounded steps.

    Without stiffness a method of order 8 is cheaper at tight tolerances. For stiff scenes all other available methods
    take far more work, so that one of them is a check only; so is the second method if the first one is an argument.
    """
    default = default_solver(request.scene, request.q0.shape[0], False)
    stiff = request.scene.stiff
    other = dfx.Kvaerno5() if stiff else dfx.Dopri8()
    bounds = bool(request.scene.mode_names) and request.dtmax is None
    if request.solver is None:
        bounded = (other,) if bounds else ()
        return (default, other, *bounded), (0,) if stiff else (0, 1)
    given = request.solver.whole
    if not isinstance(given, dfx.AbstractAdaptiveSolver):
        raise ValueError(
            f"simulate_to_accuracy chooses tolerances, but {type(given).__name__} takes fixed steps: pass another"
            " solver, or none."
        )
    other = other if type(given) is type(default) else default
    bounded = (other,) if bounds else ()
    return (given, other, *bounded), (0,)


def _states(run: Trajectory) -> np.ndarray:
    return np.concatenate([np.asarray(run.q), np.asarray(run.qd)], axis=1).astype(float)


def _observed(observe: Observe, run: Trajectory) -> np.ndarray:
    check_indices(lambda: observe(run), name="observable")
    values = np.asarray(observe(run))
    if not np.issubdtype(values.dtype, np.floating) or values.ndim > 2 or not values.size:
        raise ValueError(
            "observable must return real numbers of shape [], [time] or [time, k], but it returned an array of shape"
            f" {list(values.shape)} and type {values.dtype}."
        )
    if not np.isfinite(values).all():
        raise ValueError(
            "observable is not finite. Times of events are padded with infinity: pick those that happen, as in"
            " run.events.t[0]."
        )
    return values.astype(float)


def _size(values: np.ndarray) -> np.ndarray:
    """Largest magnitudes of columns."""
    return np.maximum(np.max(np.abs(np.atleast_1d(values)), axis=0, keepdims=True), _SMALLEST)


def _references(search: _AccuracySearch, rtol: float, own: bool) -> _References:
    """The first two runs that agree, from a tolerance downwards; if none do, the nearest.

    Magnitudes are those along the run, for a function (`own`) those of its values.
    """
    nearest = None
    while True:
        pair = search.pair(rtol)
        if len(pair) < 2:
            break
        one, other = (search.along(made.rtol, made.which) for made in pair)
        size = _size(pair[0].observed if own else one.observed)
        references = _References(pair, size, _error(pair[0], pair[1], size), "")
        if np.max(np.abs(one.state - other.state) / _size(one.state)) > _APART:
            references = replace(references, gap=max(references.gap, _APART))
        elif references.gap <= _AGREE * search.asked and _confirmed(search, references, rtol):
            return references
        if nearest is None or references.gap < nearest.gap:
            nearest = references
        if rtol <= search.tightest:
            break
        rtol = _round(max(rtol / 10, search.tightest))
    assert nearest is not None
    return replace(nearest, remark=_remark(search, nearest, rtol))


def _confirmed(search: _AccuracySearch, references: _References, rtol: float) -> bool:
    """Whether a pair with a looser tolerance is near, too: in chaos two runs may agree in one number by chance."""
    looser = search.pair(_round(10 * rtol))
    return len(looser) == 2 and max(map(references.error, looser)) <= _NEAR * search.asked


def _remark(search: _AccuracySearch, nearest: _References, rtol: float) -> str:
    """Why two runs do not agree, and the remedy."""
    names = " and ".join(dict.fromkeys(each.name for each in nearest.runs))
    text = (
        f"accuracy={search.asked:g} was not reached: the best two runs, by {names} at rtol {nearest.runs[0].rtol:g},"
        f" differ by {nearest.gap:.2g}."
    )
    ended = [text for text in (search.failure(rtol, 0), search.failure(rtol, search.second)) if text]
    looser = search.pair(_round(_LOOSER * nearest.runs[0].rtol))
    # Unrelated runs do not converge, even if a single number of them differs less than in others.
    converges = nearest.gap < _APART and len(looser) == 2
    falls = converges and nearest.gap < _error(looser[0], looser[1], nearest.size) / _FALL
    if len(ended) == 2:
        return f"{text} At rtol {rtol:g} none reached the end. {ended[0]}"
    if search.request.q0.dtype == jnp.float32:
        return (
            f"{text} The numbers are in float32, whose rounding is {float(jnp.finfo(jnp.float32).eps):.1g}: set"
            " jax_enable_x64 and build the scene and the initial state in float64."
        )
    if falls:
        return (
            f"{text} That is rounding, which this motion amplifies: ask for less, or for a shorter run. A motion that"
            " doubles small differences again and again (chaos) loses digits in proportion to time."
        )
    return (
        f"{text} Tighter tolerances do not bring them together: the motion is chaotic over this time, or the observable"
        " jumps at a saved time (a force or a mode at an event). Ask for a shorter run, or for an observable that does"
        " not depend on the phase."
    )


def _chosen(search: _AccuracySearch, references: _References, best: _TrialRun, estimate: float) -> Trajectory:
    """A run with the report of the search."""
    attempts = {
        x: Attempt(x.name, x.rtol, x.atol, x.num_steps, x.evaluations, references.estimate(x))
        for x in search.made.values()
    }
    accuracy = Accuracy(
        search.asked,
        estimate,
        best.solver,
        best.rtol,
        best.atol,
        best.num_steps,
        _cost_scaling([attempts[x] for x in attempts if x.which == best.which], best.rtol, references.gap),
        tuple(attempts.values()),
        references.remark,
        float(np.asarray(best.run.request.dtmax)) if best.bounded else None,
    )
    return replace(best.run, accuracy=accuracy)


def _cost_scaling(attempts: list[Attempt], rtol: float, gap: float) -> CostScaling:
    """Steps for ten times smaller and larger errors, from the next tighter and looser run of the same method."""
    runs = sorted((run for run in attempts if math.isfinite(run.estimate)), key=lambda r: r.rtol)
    place = [run.rtol for run in runs].index(rtol)
    # Powers of ten in steps for one in the tolerance, and in the tolerance for one in the error, if that is known.
    slopes = [math.log10(a.num_steps / b.num_steps) / math.log10(b.rtol / a.rtol) for a, b in pairwise(runs)]
    known = [run for run in runs if run.estimate > _KNOWN * gap]
    order = 1.0
    if len(known) > 1 and known[-1].estimate > known[0].estimate:
        order = math.log(known[-1].estimate / known[0].estimate) / math.log(known[-1].rtol / known[0].rtol)
    per = min(max(1.0 / order, 0.5), 2.0)
    better = slopes[max(place - 1, 0)] if slopes else 0.0
    worse = slopes[min(place, len(slopes) - 1)] if slopes else 0.0
    return CostScaling(max(10 ** (per * better), 1.0), min(10 ** (-per * worse), 1.0))


def _round(x: float) -> float:
    """`x` with three digits, for readers."""
    return float(f"{x:.3g}")
