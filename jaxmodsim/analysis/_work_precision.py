"""`work_precision`: what an extra digit costs, method by method."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike

from .._core.system import describe_machine
from .._core.timing import measure
from ..scene import Scene, elements
from ..simulation import Trajectory, default_solver, evaluations_per_step
from ._methods import Method, default_methods
from ._reference import ATOL, Converged, Question, converged, event_error, gradient_error, happened, in_type, scale_of
from ._sensitivity import chosen_numbers, observable_of, observed
from ._work_rows import Row, Timing, WorkPrecision

# Numbers of a gradient that are none of the scene.
_START = ("q0[", "qd0[")
COSTS = ("run", "vmap", "forward", "reverse")
# Tolerance of the references: so much tighter than the tightest asked for, down to what rounding allows.
_TIGHTER, _TIGHTEST = 1e-3, 1e-12
_PACKAGES = ("jaxmodsim", "jax", "jaxlib", "diffrax", "equinox", "numpy")


def work_precision(
    scene: Scene,
    q0: ArrayLike | list[float],
    qd0: ArrayLike | list[float],
    t1: float,
    *,
    ts: ArrayLike | list[float] | None = None,
    observable: str | Callable[[Trajectory], ArrayLike] = "q[0]",
    methods: Mapping[str, Method] | None = None,
    tolerances: Sequence[float] = (1e-3, 1e-5, 1e-7, 1e-9),
    reference: float | ArrayLike | Callable[[np.ndarray], ArrayLike] | None = None,
    agreement: float | None = None,
    wrt: Sequence[str] | str | None = None,
    costs: Sequence[str] = ("run",),
    batch: int = 64,
    rounds: int = 10,
    limit_s: float = 10.0,
    max_steps: int = 100_000,
    name: str = "scene",
) -> WorkPrecision:
    """Run a scene by several methods at several tolerances: errors against times and steps.

    ```python
    problem = jaxmodsim.problems.named_problems()["lugre_box"]()
    study = jaxmodsim.work_precision(**problem.arguments)
    print(study)
    study.cheapest(1e-6)
    jaxmodsim.plot.work_precision_figure(study).savefig("lugre_box.png")
    ```

    **Reference.** Two solvers at a tolerance a thousand times tighter than the tightest asked for (1e-12 at the
    tightest), `Rodas5P` and an explicit one, must agree; or one and a closed form. Their disagreement is kept: smaller
    errors are noise. A method with a `scene` of its own is also held against what that formulation converges to, found
    in the same way, so that the error of the model stands apart from that of the integration; where that is not
    found (a field that jumps), the error stays whole.

    **Times** are of warm calls of `simulate`, or of compiled functions of it, all methods in turns, with compiling
    apart. All runs of a vmap are alike, which is the best case: a batch waits for its slowest run. Gradients are
    those of the last value of the observable.

    **Arguments:**

    - `scene`, `q0`, `qd0`, `t1`, `ts`: as for `simulate`.
    - `observable`: what errors are of: a name, as in `"q[0]"`, or of an effect for its force; or a function of the
      `Trajectory` that returns real numbers of shape `[time]`, `[k]` or `[]`.
    - `methods`: a `Method` for each name; by default solvers that suit the scene.
    - `tolerances`: relative ones, > 0; absolute ones are a thousandth of them.
    - `reference`: a closed form of the observable: numbers of its shape, or a function of the times.
    - `agreement`: largest disagreement of the references, relative to the scale; by default the tightest tolerance.
    - `wrt`: numbers for the gradient, as for `sensitivity`; by default, if a gradient is timed, all that are not zero.
    - `costs`: what is timed, of `run`, `vmap`, `forward`, `reverse` (gradients).
    - `batch`: runs of the vmap.
    - `rounds`, `limit_s`: how often each call is timed, and after how many seconds in all no more.
    - `max_steps`: limit of a run. Of fixed steps as many as they make are allowed.
    - `name`: of the problem, for table and figure.

    **Returns:**

    A `WorkPrecision`. A method that fails stays in it, with the reason.

    **Raises:**

    - `ValueError` for arguments that are wrong, and where JAX computes in single precision, as the reference needs
      double precision.
    - `RuntimeError` if the references disagree or fail.
    """
    if not jax.config.jax_enable_x64:  # pyright: ignore[reportAttributeAccessIssue]
        raise ValueError(
            "work_precision needs references in double precision: call jax.config.update('jax_enable_x64', True) first,"
            " and give methods that run in single precision Method(dtype='float32')."
        )
    if not isinstance(scene, Scene):
        raise ValueError(f"work_precision needs a Scene, but {scene!r} was given.")
    observe, label, unit = observable_of(scene, observable)
    ts = None if ts is None else np.asarray(ts, float)
    question = Question(
        np.asarray(q0, float), np.asarray(qd0, float), float(t1), ts, observe, label, unit, {}, max_steps
    )
    closed = _closed_form(reference, np.array([question.t1]) if ts is None else ts)
    methods = default_methods(scene) if methods is None else dict(methods)
    tolerances = [float(x) for x in tolerances]
    _check(methods, tolerances, costs, batch, rounds)
    if {"forward", "reverse"} & set(costs) or wrt is not None:
        question = replace(question, values=chosen_numbers(scene, question.q0, question.qd0, wrt))
        costs = tuple(costs) if {"forward", "reverse"} & set(costs) else (*costs, "forward")
    smallest = min(tolerances) if tolerances else 1e-6
    rtol, agreement = max(_TIGHTER * smallest, _TIGHTEST), smallest if agreement is None else agreement
    target = converged(scene, question, rtol, closed=closed, scale=None, agreement=agreement)
    scale = scale_of(target.y)
    limits: dict[int, Converged | str] = {}
    for method in methods.values():
        if method.scene is not None and id(method.scene) not in limits:
            try:
                limits[id(method.scene)] = converged(
                    method.scene, question, rtol, closed=None, scale=scale, agreement=agreement
                )
            except RuntimeError as error:
                limits[id(method.scene)] = f"No limit of this formulation was found: {error}"
    candidates = [
        (prepared, setting)
        for prepared in [_prepared(name, method, scene, question, batch) for name, method in methods.items()]
        for setting in _settings(prepared.method, tolerances)
    ]
    outcomes = _measured(candidates, costs, rounds, limit_s)
    rows = [
        _row(one, outcome, timings, question, target, limits.get(id(one[0].method.scene)), scale)
        for one, outcome, timings in zip(candidates, outcomes, _timings(candidates, outcomes, batch), strict=True)
    ]
    return WorkPrecision(
        name,
        question.label,
        question.unit,
        f"at t = {question.t1:g} s" if question.ts is None else f"at {len(question.ts)} times to {question.t1:g} s",
        scale,
        target.how,
        target.disagreement,
        target.events_disagreement,
        target.gradient_disagreement,
        tuple(costs),
        batch,
        tuple(rows),
        describe_machine(*_PACKAGES),
    )


def _closed_form(
    reference: float | ArrayLike | Callable[[np.ndarray], ArrayLike] | None, times: np.ndarray
) -> np.ndarray | None:
    if reference is None:
        return None
    closed = np.asarray(reference(times) if callable(reference) else reference, float)
    if not np.isfinite(closed).all():
        raise ValueError(f"reference must be finite, but it is {closed}.")
    return closed


def _check(methods: dict[str, Method], tolerances: list[float], costs: Sequence[str], batch: int, rounds: int) -> None:
    for name, method in methods.items():
        if not isinstance(method, Method):
            raise ValueError(
                f"methods[{name!r}] must be a Method, as in Method(diffrax.Tsit5()), but {method!r} was given."
            )
    if not methods:
        raise ValueError("methods is empty: name at least one, or leave it out for those that suit the scene.")
    if any(not x > 0 for x in tolerances):
        raise ValueError(f"tolerances must be > 0, but {tolerances} were given.")
    if not tolerances and any(method.steps is None for method in methods.values()):
        raise ValueError("tolerances is empty: give some, or every method its steps.")
    if isinstance(costs, str) or "run" not in costs or not set(costs) <= set(COSTS):
        raise ValueError(f"costs must be 'run' and others of {', '.join(COSTS)}, but {costs!r} was given.")
    for name, number in (("batch", batch), ("rounds", rounds)):
        if isinstance(number, bool) or not isinstance(number, int) or number < 1:
            raise ValueError(f"{name} must be a positive integer, but {number!r} was given.")


def _settings(method: Method, tolerances: Sequence[float]) -> list[dict[str, float]]:
    if method.steps is not None:
        return [{"dt": float(dt)} for dt in method.steps]
    return [{"rtol": rtol, "atol": ATOL * rtol} for rtol in tolerances]


class _PreparedMethod(NamedTuple):
    """A method, ready to run: what makes each of the costs at a setting, compiled once for all settings."""

    name: str
    method: Method
    solver: dfx.AbstractSolver
    dtype: np.dtype
    calls: dict[str, Callable[[dict[str, float]], Any]]


def _prepared(name: str, method: Method, scene: Scene, question: Question, batch: int) -> _PreparedMethod:
    scene = scene if method.scene is None else method.scene
    dtype = jnp.dtype(method.dtype) if method.dtype is not None else jnp.result_type(float, *jax.tree.leaves(scene))
    scene, start, fixed = in_type(scene, dtype), question.start(dtype), method.steps is not None
    lacking = [one for one in question.values if not one.startswith(_START) and one not in elements(scene)]
    if lacking:
        raise ValueError(
            f"The scene of methods[{name!r}] has no number {', '.join(lacking)}: name in wrt what all of them have."
        )
    solver = default_solver(scene, start["q0"].size, fixed) if method.solver is None else method.solver
    # All steps of a ladder that was asked for are allowed.
    allowed = max(question.max_steps, *(math.ceil(question.t1 / dt) + 1 for dt in method.steps or ()), 1)
    options: dict[str, object] = {"solver": solver, "max_steps": allowed}

    def end(start: dict[str, Array], scene: Scene, setting: dict[str, ArrayLike]) -> tuple[Array, Array, Array]:
        run = question.run(scene, start, setting, throw=False, **options)
        return run.q, run.qd, run.code

    def run(setting: dict[str, float]) -> Trajectory:
        done = question.run(scene, start, setting, **options)
        done.q.block_until_ready()
        return done

    x = {name: jnp.asarray(value, dtype) for name, value in question.values.items()}
    starts = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (batch, *leaf.shape)), start)
    many = jax.jit(jax.vmap(end, in_axes=(0, None, None)))
    forward = jax.jit(jax.jacfwd(partial(question.last, **options)))
    reverse = jax.jit(jax.grad(partial(question.last, **options)))
    calls = {
        "run": run,
        "vmap": lambda setting: jax.block_until_ready(many(starts, scene, setting)),
        "forward": lambda setting: jax.block_until_ready(forward(x, scene, start, setting)),
        "reverse": lambda setting: jax.block_until_ready(reverse(x, scene, start, setting)),
    }
    return _PreparedMethod(name, method, solver, dtype, calls)


class _Timed(NamedTuple):
    """What a method gave at a setting, by the costs, and the times of that or why it failed."""

    given: dict[str, Any]
    reports: dict[str, dict[str, Any]]


def _measured(
    candidates: list[tuple[_PreparedMethod, dict[str, float]]], costs: Sequence[str], rounds: int, limit_s: float
) -> list[_Timed]:
    """Everything timed, cost after cost, all candidates in turns; those that cannot run are left out of the rest."""
    outcomes = [_Timed({}, {}) for _ in candidates]

    def call(i: int, cost: str) -> None:
        prepared, setting = candidates[i]
        outcomes[i].given[cost] = prepared.calls[cost](setting)

    for cost in ("run", *(cost for cost in costs if cost != "run")):
        able = [i for i, one in enumerate(outcomes) if not any("failed" in report for report in one.reports.values())]
        reports = measure({str(i): partial(call, i, cost) for i in able}, rounds, limit_s)
        for i in able:
            outcomes[i].reports[cost] = reports[str(i)]
    return outcomes


def _timings(
    candidates: list[tuple[_PreparedMethod, dict[str, float]]], outcomes: list[_Timed], batch: int
) -> list[dict[str, Timing]]:
    """Timings of each candidate; what is compiled for the first setting of a method serves the others."""
    compiled: dict[tuple[str, str], float] = {}
    timings: list[dict[str, Timing]] = []
    for (prepared, _), outcome in zip(candidates, outcomes, strict=True):
        timings.append({})
        for cost, report in outcome.reports.items():
            if "failed" in report:
                continue
            first = max(report["first_s"] - report["median_s"], 0.0)
            share, (low, high) = batch if cost == "vmap" else 1, report["quartiles_s"]
            timings[-1][cost] = Timing(
                compiled.setdefault((prepared.name, cost), first), report["median_s"] / share, low / share, high / share
            )
    return timings


def _row(
    candidate: tuple[_PreparedMethod, dict[str, float]],
    outcome: _Timed,
    timings: dict[str, Timing],
    question: Question,
    target: Converged,
    limit: Converged | str | None,
    scale: float,
) -> Row:
    """Errors of a candidate beside its times."""
    prepared, setting = candidate
    row = Row(prepared.name, setting.get("rtol"), setting.get("dt"), str(prepared.dtype))
    failed = [report["failed"] for report in outcome.reports.values() if "failed" in report]
    if failed:
        return replace(row, failed=failed[0])
    run, remarks = outcome.given["run"], []
    y = np.asarray(observed(question.observe(run)), float)

    def apart(a: np.ndarray, b: np.ndarray) -> float:
        return float(np.max(np.abs(a - b))) / scale

    error, numerical, model = apart(y, target.y), None, None
    if limit is None:
        numerical, model = error, 0.0
    elif isinstance(limit, str):
        remarks.append(limit)
    else:
        numerical, model = apart(y, limit.y), apart(limit.y, target.y)
    events, there = None, happened(run)
    if target.events is not None and there is not None:
        events = event_error(there, target.events)
        if events is None:
            remarks.append(f"Other mode changes than in the reference: {there.t.size}, there {target.events.t.size}.")
    derivatives = [outcome.given[cost] for cost in ("forward", "reverse") if cost in outcome.given]
    gradient = None
    if derivatives and target.gradient is not None:
        gradient = max(gradient_error({n: float(x) for n, x in each.items()}, target.gradient) for each in derivatives)
    steps, each = int(run.stats["num_steps"]), evaluations_per_step(prepared.solver, run)
    return replace(
        row,
        error=error,
        numerical=numerical,
        model=model,
        events=events,
        gradient=gradient,
        steps=steps,
        rejected=int(run.stats["num_rejected_steps"]),
        evaluations=None if each is None else each * steps,
        times=timings,
        remarks=tuple(remarks),
    )
