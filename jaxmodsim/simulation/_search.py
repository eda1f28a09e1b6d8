"""The search behind `simulate(..., accuracy=...)`: runs by two methods, compared until their difference is small."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import pairwise
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax.core
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

from .._core.index_check import check_indices
from ..solvers import Rodas5P
from ._accuracy import Accuracy, Tenfold, Tried
from ._observe import named_series
from ._outcome import SUCCESS, SimulationError, describe_failure
from ._solve import Options, Problem, Solved, default_solver, solve
from ._trajectory import Trajectory, trajectory

_ACCURACIES = (1e-12, 1e-1)
# Tolerances are looked for between these: so many rounding errors of a number, and a number. Absolute ones are this
# part of relative ones, as by default.
_TIGHTEST, _LOOSEST, _ABSOLUTE = 50.0, 0.1, 1e-3
# Errors are differences to two references, runs by different methods. As parts of the accuracy: the tolerance at which
# these are tried first, and how far they may be apart; and how far they may be from two more of ten times looser ones.
_AHEAD, _AGREE, _NEAR = 1e-2, 0.25, 0.5
# Difference of the whole state at which two runs have nothing to do with each other, whatever is observed.
_APART = 0.1
# Fall of the difference of two runs from tolerances this many times looser below which they do not converge.
_LOOSER, _FALL = 1e3, 30.0
# An estimate this many times what is uncertain of it says how the error follows the tolerance.
_KNOWN = 4.0
# Magnitude of an observable below which errors are relative to this instead.
_SMALLEST = 1e-6
# In stick nothing that is integrated moves, and methods that are left to themselves make the same steps. Those of the
# one that is compared with are no longer than this part of the run, so that it looks at the loads in other places; and
# its place among the methods.
_PART, _BOUNDED = 127.0, 2
# Saved times that are too few to show magnitudes and chaos, and how many do.
_FEW, _TIMES = 11, 101


@dataclass(frozen=True, eq=False)
class _Made:
    """A run of the search, with what is compared: the observable and the state, of the shape `[..., columns]`."""

    run: Trajectory
    which: int
    solver: dfx.AbstractSolver
    rtol: float
    atol: float
    observed: np.ndarray
    state: np.ndarray
    # How it ended early, if it did.
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


@dataclass(frozen=True)
class _Search:
    """What is searched for, and what was run: by the tolerance and the place of the method among `solvers`."""

    problem: Problem
    options: Options
    asked: float
    observe: Callable[[Trajectory], Any]
    solvers: tuple[dfx.AbstractSolver, ...]
    made: dict[tuple[float, int], _Made] = field(default_factory=dict)
    seen: dict[tuple[float, int], _Made] = field(default_factory=dict)

    @property
    def tightest(self) -> float:
        return _round(_TIGHTEST * float(jnp.finfo(self.problem.q0.dtype).eps))

    @property
    def second(self) -> int:
        """Place of the method that the first one is compared with."""
        return len(self.solvers) - 1

    def run(self, rtol: float, which: int) -> _Made:
        """The run by one of the methods at a tolerance; made once."""
        if (rtol, which) not in self.made:
            self.made[rtol, which] = self.make(rtol, which, self.problem)
        return self.made[rtol, which]

    def along(self, rtol: float, which: int) -> _Made:
        """The same run, kept at more times where few are saved."""
        if self.problem.ts is not None and self.problem.ts.shape[0] >= _FEW:
            return self.run(rtol, which)
        if (rtol, which) not in self.seen:
            ts = np.linspace(self.problem.t0, self.problem.t1, _TIMES).astype(self.problem.q0.dtype)
            self.seen[rtol, which] = self.make(rtol, which, self.problem._replace(ts=ts))
        return self.seen[rtol, which]

    def failure(self, rtol: float, which: int) -> str:
        """How the run by one of the methods at a tolerance ended early; nothing if it did not."""
        return self.run(rtol, which).failure or self.along(rtol, which).failure

    def make(self, rtol: float, which: int, problem: Problem) -> _Made:
        solver, dtype = self.solvers[which], self.problem.q0.dtype
        atol = _round(max(_ABSOLUTE * rtol, float(jnp.finfo(dtype).eps)))
        arrays, rest = eqx.partition(solver, eqx.is_array)
        plugins = (arrays, None if problem.plugins is None else problem.plugins[1])
        problem = problem._replace(rtol=np.asarray(rtol, dtype), atol=np.asarray(atol, dtype), plugins=plugins)
        if which == _BOUNDED:
            problem = problem._replace(dtmax=np.asarray((problem.t1 - problem.t0) / _PART, dtype))
        options = replace(self.options, solver=rest)
        solved = solve(problem, options)
        _check_known(solved)
        run, failure = trajectory(problem, options, solved), _failure(problem, solved)
        observed = np.zeros(0) if failure else _observed(self.observe, run)
        return _Made(run, which, solver, rtol, atol, observed, _states(run), failure)

    def pair(self, rtol: float) -> tuple[_Made, ...]:
        """Runs by both methods; by one of them at two tolerances where the other does not reach the end."""
        good = [which for which in (0, self.second) if not self.failure(rtol, which)]
        found = tuple(self.run(rtol, which) for which in good)
        if len(good) != 1:
            return found
        other = _round(rtol / 10 if rtol / 10 >= self.tightest else rtol * 10), good[0]
        if self.failure(*other) or self.run(*other).num_steps == found[0].num_steps:
            return found
        return (*found, self.run(*other))


@dataclass(frozen=True)
class _References:
    """Two runs that errors are taken against, how far they are apart, and the magnitudes of what is observed.

    And a remark if they are too far apart.
    """

    runs: tuple[_Made, ...]
    size: np.ndarray
    gap: float
    remark: str

    def error(self, made: _Made) -> float:
        """Difference to the farther one."""
        return max(_error(made, each, self.size) for each in self.runs)

    def estimate(self, made: _Made) -> float:
        """Of the error of a run: its difference, and what is uncertain of that."""
        return self.error(made) + self.gap if made.ok else math.inf


def _error(one: _Made, other: _Made, size: np.ndarray) -> float:
    return float(np.max(np.abs(one.observed - other.observed) / size))


def reach(
    problem: Problem, options: Options, accuracy: Any, observable: Any, tolerances: tuple[Any, Any], throw: bool
) -> Trajectory:
    """The cheapest run whose observable has the accuracy; see `simulate`."""
    asked = _asked(problem, accuracy, observable, tolerances)
    observe = _states if observable is None else observable
    if isinstance(observable, str):
        observe = partial(named_series, name=observable)
    solvers, choices = _solvers(problem, options)
    search = _Search(problem, options, asked, observe, solvers)
    rtol = _round(max(_AHEAD * asked, search.tightest))
    first = search.pair(rtol)
    if len(first) < 2:
        return _early(search, rtol, throw)
    references = _references(search, rtol, callable(observable))
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
        key=lambda made: (made.num_steps * (_evaluations(made) or 1), references.estimate(made)),
    )
    return _chosen(search, references, best, references.estimate(best))


def _check_known(tree: Any) -> None:
    if any(isinstance(x, jax.core.Tracer) for x in jtu.tree_leaves(tree)):
        raise ValueError(
            "accuracy is a search by several runs, which needs numbers that are known, but here some are traced"
            " (jax.jit, jax.vmap or jax.grad): run simulate(..., accuracy=...) once outside, and pass"
            " **run.accuracy.options, its solver, rtol and atol, instead of accuracy here."
        )


def _asked(problem: Problem, accuracy: Any, observable: Any, tolerances: tuple[Any, Any]) -> float:
    """The accuracy, if it and what goes with it can be searched for."""
    if accuracy is None:
        raise ValueError("observable says what accuracy= is of: pass accuracy, too, or leave observable out.")
    _check_known((problem, accuracy))
    if isinstance(accuracy, bool) or not isinstance(accuracy, int | float | np.number):
        raise ValueError(f"accuracy must be a known number, as in accuracy=1e-6, but {accuracy!r} was given.")
    if not _ACCURACIES[0] <= accuracy <= _ACCURACIES[1]:
        raise ValueError(
            f"accuracy must lie within [{_ACCURACIES[0]:g}, {_ACCURACIES[1]:g}], but {accuracy:g} was given."
        )
    if problem.dt is not None or not all(isinstance(x, float) for x in tolerances) or tolerances != (1e-6, 1e-9):
        raise ValueError("accuracy= chooses the tolerances itself: leave rtol, atol and dt out, or accuracy.")
    if not (observable is None or isinstance(observable, str) or callable(observable)):
        raise ValueError(
            f"observable must be a name such as 'q[0]' or a function of the Trajectory, but {observable!r} was given."
        )
    return float(accuracy)


def _solvers(problem: Problem, options: Options) -> tuple[tuple[dfx.AbstractSolver, ...], tuple[int, ...]]:
    """Two methods, and which of them may be chosen; in scenes with events the second one again, for bounded steps.

    Where nothing is stiff a method of order 8 is cheaper at tight tolerances. Of stiff scenes all other methods at hand
    take far more work, so that one of them serves as a check only; so does any beside a method that was given.
    """
    default = default_solver(problem.scene, problem.q0.shape[0], False)
    stiff = any(effect.stiff for effect in problem.scene.effects)
    other = dfx.Kvaerno5() if stiff else dfx.Dopri8()
    bounds = bool(problem.scene.event_driven) and problem.dtmax is None
    if options.solver is None:
        bounded = (other,) if bounds else ()
        return (default, other, *bounded), (0,) if stiff else (0, 1)
    given = eqx.combine(options.solver, problem.plugins[0])
    if not isinstance(given, dfx.AbstractAdaptiveSolver):
        raise ValueError(
            f"accuracy= chooses tolerances, but {type(given).__name__} takes fixed steps: pass another solver, or none."
        )
    other = other if type(given) is type(default) else default
    bounded = (other,) if bounds else ()
    return (given, other, *bounded), (0,)


def _states(run: Trajectory) -> np.ndarray:
    return np.concatenate([np.asarray(run.q), np.asarray(run.qd)], axis=1).astype(float)


def _observed(observe: Callable[[Trajectory], Any], run: Trajectory) -> np.ndarray:
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


def _references(search: _Search, rtol: float, own: bool) -> _References:
    """The first two runs, from a tolerance downwards, that agree; if none do, the nearest.

    Magnitudes are those along the run, of a function (`own`) those of what it returns.
    """
    nearest = None
    while True:
        pair = search.pair(rtol)
        if len(pair) < 2:
            break
        one, other = (search.along(made.rtol, made.which) for made in pair)
        size = _size(pair[0].observed if own else one.observed)
        found = _References(pair, size, _error(pair[0], pair[1], size), "")
        if np.max(np.abs(one.state - other.state) / _size(one.state)) > _APART:
            found = replace(found, gap=max(found.gap, _APART))
        elif found.gap <= _AGREE * search.asked and _confirmed(search, found, rtol):
            return found
        if nearest is None or found.gap < nearest.gap:
            nearest = found
        if rtol <= search.tightest:
            break
        rtol = _round(max(rtol / 10, search.tightest))
    assert nearest is not None
    return replace(nearest, remark=_remark(search, nearest, rtol))


def _confirmed(search: _Search, found: _References, rtol: float) -> bool:
    """Whether a pair from a looser tolerance is near, too: in chaos two runs may meet in one number by accident."""
    looser = search.pair(_round(10 * rtol))
    return len(looser) == 2 and max(map(found.error, looser)) <= _NEAR * search.asked


def _remark(search: _Search, nearest: _References, rtol: float) -> str:
    """Why two runs do not agree, and what to do."""
    names = " and ".join(dict.fromkeys(each.name for each in nearest.runs))
    text = (
        f"accuracy={search.asked:g} was not reached: the best two runs, by {names} at rtol {nearest.runs[0].rtol:g},"
        f" differ by {nearest.gap:.2g}."
    )
    ended = [text for text in (search.failure(rtol, 0), search.failure(rtol, search.second)) if text]
    looser = search.pair(_round(_LOOSER * nearest.runs[0].rtol))
    # Runs that are apart do not converge, be it that a single number of them differs less than that of others.
    converges = nearest.gap < _APART and len(looser) == 2
    falls = converges and nearest.gap < _error(looser[0], looser[1], nearest.size) / _FALL
    if len(ended) == 2:
        return f"{text} At rtol {rtol:g} none reached the end. {ended[0]}"
    if search.problem.q0.dtype == jnp.float32:
        return (
            f"{text} The numbers are in float32, whose rounding is {float(jnp.finfo(jnp.float32).eps):.1g}: set"
            " jax_enable_x64 and build the scene and the initial state in float64."
        )
    if falls:
        return (
            f"{text} That is rounding, as this motion enlarges it: ask for less, or for a shorter run. A motion that"
            " doubles small differences again and again (chaos) loses digits in proportion to time."
        )
    return (
        f"{text} Tighter tolerances do not bring them together: the motion is chaotic over this time, or the observable"
        " jumps at a saved time (a force or a mode where an event happens). Ask for a shorter run, or for something"
        " that does not hang on the phase."
    )


def _early(search: _Search, rtol: float, throw: bool) -> Trajectory:
    """What becomes of runs that end early: the sentence of the first."""
    if throw:
        failure = search.failure(rtol, 0) or search.failure(rtol, search.second)
        raise SimulationError(f"For accuracy={search.asked:g} runs at rtol {rtol:g} were made to check by. {failure}")
    return search.run(rtol, 0).run


def _failure(problem: Problem, solved: Solved) -> str:
    """How a run ended early; nothing if it did not."""
    if int(solved.code) == SUCCESS:
        return ""
    t, y = solved.end or (solved.t[-1], jtu.tree_map(lambda x: x[-1], solved.y))
    return describe_failure(problem.scene, float(t), y, int(solved.code))


def _chosen(search: _Search, references: _References, best: _Made, estimate: float) -> Trajectory:
    """A run with the report of the search."""
    tried = {
        x: Tried(x.name, x.rtol, x.atol, x.num_steps, _evaluations(x), references.estimate(x))
        for x in search.made.values()
    }
    accuracy = Accuracy(
        search.asked,
        estimate,
        best.solver,
        best.rtol,
        best.atol,
        best.num_steps,
        _tenfold([tried[x] for x in tried if x.which == best.which], best.rtol, references.gap),
        tuple(tried.values()),
        references.remark,
        float(np.asarray(best.run.problem.dtmax)) if best.bounded else None,
    )
    return replace(best.run, accuracy=accuracy)


def _tenfold(tried: list[Tried], rtol: float, gap: float) -> Tenfold:
    """Steps for ten times better and worse, from the next tighter and the next looser run of the same method."""
    runs = sorted((run for run in tried if math.isfinite(run.estimate)), key=lambda r: r.rtol)
    place = [run.rtol for run in runs].index(rtol)
    # Powers of ten in steps for one in the tolerance, and in the tolerance for one in the error, where that is known.
    slopes = [math.log10(a.num_steps / b.num_steps) / math.log10(b.rtol / a.rtol) for a, b in pairwise(runs)]
    known = [run for run in runs if run.estimate > _KNOWN * gap]
    order = 1.0
    if len(known) > 1 and known[-1].estimate > known[0].estimate:
        order = math.log(known[-1].estimate / known[0].estimate) / math.log(known[-1].rtol / known[0].rtol)
    per = min(max(1.0 / order, 0.5), 2.0)
    better = slopes[max(place - 1, 0)] if slopes else 0.0
    worse = slopes[min(place, len(slopes) - 1)] if slopes else 0.0
    return Tenfold(max(10 ** (per * better), 1.0), min(10 ** (-per * worse), 1.0))


def _evaluations(made: _Made) -> int | None:
    """Evaluations of the vector field in one step, the Jacobian counted as one for each entry of the state."""
    if isinstance(made.solver, dfx.AbstractERK) and isinstance(made.solver.tableau, dfx.ButcherTableau):
        return made.solver.tableau.num_stages - bool(made.solver.tableau.fsal)
    if isinstance(made.solver, Rodas5P):
        run = made.run
        return 8 + 1 + sum(np.size(x) for x in jtu.tree_leaves((run.q, run.qd, run.z))) // run.t.shape[0]
    return None


def _round(x: float) -> float:
    """Three digits, to be read and copied."""
    return float(f"{x:.3g}")
