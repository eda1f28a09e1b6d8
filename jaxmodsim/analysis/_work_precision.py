"""`work_precision`: the error of several methods against their time and steps."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike

from .._core.arguments import as_whole
from .._core.system import describe_machine
from ..friction import AbstractSetValuedLaw, DeadZone, LuGre, Regularized
from ..scene import Friction, Scene, elements
from ..simulation import Trajectory, default_solver, evaluations_per_step
from ..solvers import Rodas5P
from ._reference import (
    ATOL,
    Question,
    Reference,
    event_error,
    find_reference,
    gradient_error,
    in_type,
    mode_changes_of,
    scale_of,
)
from ._sensitivity import chosen_numbers, observable_of, observed
from ._timing import measure
from ._work_rows import Row, Timing, WorkPrecision

# Prefixes of the names of initial values, which are no numbers of the scene.
_START = ("q0[", "qd0[")
COSTS = ("run", "vmap", "forward", "reverse")
# Tolerance of the references relative to the smallest tolerance of the study, and its smallest value.
_TIGHTER, _TIGHTEST = 1e-3, 1e-12
_PACKAGES = ("jaxmodsim", "jax", "jaxlib", "diffrax", "equinox", "numpy")
_DTYPES = ("float32", "float64")


@dataclass(frozen=True)
class Method:
    """A method to run a problem. Each of its settings becomes a row of `work_precision`.

    - `solver`: any diffrax solver, or `jaxmodsim.Rodas5P`, `Gauss`, `ImplicitFriction`; by default the choice of
      `simulate`.
    - `scene`: another formulation of the problem with the same coordinates, such as one of `formulations`; None for the
      scene of the problem.
    - `steps`: fixed time steps [s], > 0, in place of tolerances.
    - `dtype`: `"float32"` or `"float64"`; by default that of the scene.

    **Raises:**

    - `ValueError` for a field of another type, and steps that are not positive.

    **Example:**

    ```python
    rough = jms.problems.braked_spring.scene(jms.DeadZone(jms.Coulomb(Fc=0.1), width=1e-3))
    methods = {"events": jms.Method(jms.Rodas5P()), "band": jms.Method(scene=rough, steps=(1e-3, 1e-4))}
    print(methods["band"].steps)
    ```

    ```text
    (0.001, 0.0001)
    ```
    """

    solver: dfx.AbstractSolver | None = None
    scene: Scene | None = None
    steps: Sequence[float] | None = None
    dtype: str | None = None

    def __post_init__(self) -> None:
        """Check the fields."""
        if self.solver is not None and not isinstance(self.solver, dfx.AbstractSolver):
            raise ValueError(f"solver must be a diffrax solver, as in diffrax.Tsit5(), but {self.solver!r} was given.")
        if self.scene is not None and not isinstance(self.scene, Scene):
            raise ValueError(f"scene must be a Scene, but a {type(self.scene).__name__} was given.")
        if self.steps is not None and (not len(self.steps) or any(not x > 0 for x in self.steps)):
            raise ValueError(f"steps must be fixed steps [s], > 0, as in (1e-3, 1e-4), but {self.steps!r} was given.")
        if self.dtype not in (None, *_DTYPES):
            raise ValueError(f"dtype must be 'float32' or 'float64', but {self.dtype!r} was given.")


def default_methods(scene: Scene) -> dict[str, Method]:
    """Methods with solvers that suit the scene."""
    if scene.mode_names:
        solvers = (Rodas5P(), dfx.Tsit5())
    elif any(effect.stiff for effect in scene.effects):
        solvers = (Rodas5P(), dfx.Kvaerno5(), dfx.Tsit5())
    else:
        solvers = (dfx.Tsit5(), dfx.Dopri8(), Rodas5P())
    return {type(solver).__name__: Method(solver) for solver in solvers}


def formulations(scene: Scene, *, width: float, sigma0: float | None = None, sigma1: float = 0.0) -> dict[str, Scene]:
    """Replace the set-valued laws of a scene by other formulations.

    `DeadZone` needs fixed time steps, because its vector field jumps at the edges of the band.

    **Arguments:**

    - `scene`: a `Scene` with event-driven set-valued laws (`Coulomb`, `Stribeck`).
    - `width`: of `Regularized` and `DeadZone` [m/s or rad/s], > 0.
    - `sigma0`: bristle stiffness of `LuGre` [N/m], > 0; None to omit this formulation. `width` is then also the
      Stribeck velocity that replaces the stiction of `Coulomb`.
    - `sigma1`: bristle damping of `LuGre` [N s/m], >= 0.

    **Returns:**

    Scenes by the names `Regularized`, `DeadZone` and, with `sigma0`, `LuGre`.

    **Raises:**

    - `ValueError` if no law of the scene is set-valued, if numbers are out of range, or with `sigma0` if a law is
      neither `Coulomb` nor the Gaussian `Stribeck`.

    **Example:**

    ```python
    scene = jms.problems.belt_oscillator.scene()
    methods = {"exact": jms.Method()}
    for name, other in jms.formulations(scene, width=1e-3, sigma0=1e5).items():
        methods[name] = jms.Method(scene=other, steps=(1e-3, 1e-4) if name == "DeadZone" else None)
    print(list(methods))
    ```

    ```text
    ['exact', 'Regularized', 'DeadZone', 'LuGre']
    ```
    """
    if not isinstance(scene, Scene):
        raise ValueError(f"formulations needs a Scene, but a {type(scene).__name__} was given.")
    at = [i for i, effect in enumerate(scene.effects) if isinstance(effect, Friction) and effect.event_driven]
    if not at:
        raise ValueError(
            "formulations needs a set-valued law, but the scene has none. It replaces Coulomb, Stribeck and laws made"
            " of them."
        )

    def laws(scene: Scene) -> list[Any]:
        return [scene.effects[i].law for i in at]  # pyright: ignore[reportAttributeAccessIssue]

    scenes = {
        "Regularized": eqx.tree_at(laws, scene, [Regularized(law, width) for law in laws(scene)]),
        "DeadZone": eqx.tree_at(laws, scene, [DeadZone(law, width) for law in laws(scene)]),
    }
    if sigma0 is not None:
        scenes["LuGre"] = eqx.tree_at(laws, scene, [_bristle(law, width, sigma0, sigma1) for law in laws(scene)])
    return scenes


def _bristle(law: AbstractSetValuedLaw, width: float, sigma0: float, sigma1: float) -> LuGre:
    numbers = law.lugre_numbers(width)
    if numbers is None:
        raise ValueError(
            f"LuGre replaces Coulomb and the Gaussian Stribeck, but the law is {law}. Omit sigma0, and build a scene"
            " with LuGre yourself."
        )
    return LuGre(sigma0=sigma0, sigma1=sigma1, **numbers)


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
    """Run a scene by several methods at several tolerances, and compare errors with times and steps.

    **Reference.** Two solvers, `Rodas5P` and an explicit one, must agree at a tolerance of 1e-3 times the smallest in
    `tolerances`, but at least 1e-12; or one solver and a closed form. The result holds their disagreement: smaller
    errors are noise. A method with its own `scene` is also compared with the reference of that formulation, which
    separates the modelling error from the integration error. If that reference fails, as for a field that jumps, the
    row has the total error alone.

    **Times** are those of warm calls of `simulate` or of compiled functions of it, with the methods in turns. The
    compilation time is separate. All runs of a vmap are equal, which is the best case: a batch waits for its slowest
    run. Gradients are those of the last value of the observable.

    **Arguments:**

    - `scene`, `q0`, `qd0`, `t1`, `ts`: as for `simulate`.
    - `observable`: the quantity whose errors are measured: a name such as `"q[0]"`, the name of an effect for its
      force, or a function of the `Trajectory` that returns real numbers of shape `[time]`, `[k]` or `[]`.
    - `methods`: a `Method` for each name; by default solvers that suit the scene.
    - `tolerances`: relative tolerances, > 0; the absolute ones are a thousandth of them.
    - `reference`: a closed form of the observable: numbers of its shape, or a function of the times.
    - `agreement`: largest disagreement of the references, relative to the scale; by default the smallest tolerance.
    - `wrt`: numbers for the gradient, as for `sensitivity`; by default, if a gradient is timed, all that are not zero.
    - `costs`: the timed calls: `run`, and any of `vmap`, `forward`, `reverse` (gradients).
    - `batch`: number of runs of the vmap.
    - `rounds`, `limit_s`: number of times each call is timed, and limit of the total time [s].
    - `max_steps`: largest number of steps of a run. Fixed time steps have no limit.
    - `name`: of the problem, for table and figure.

    **Returns:**

    A `WorkPrecision`, in which failed methods have rows with the reason.

    **Raises:**

    - `ValueError` for invalid arguments, and if JAX computes in single precision: the reference needs double precision.
    - `RuntimeError` if the references disagree or fail.

    **Example:**

    ```python
    scene = jms.problems.braked_spring.scene(m=1.0, k=1.0)
    methods = {"Tsit5": jms.Method(diffrax.Tsit5())}
    study = jms.work_precision(scene, [1.0], [0.0], 10.0, methods=methods, tolerances=(1e-4, 1e-6), rounds=1)
    for row in study.rows:
        print(f"rtol {row.rtol:g}: {row.steps} steps, error {row.error:.1e}")
    ```

    ```text
    rtol 0.0001: 21 steps, error 6.4e-05
    rtol 1e-06: 56 steps, error 5.9e-07
    ```
    """
    if not jax.config.jax_enable_x64:  # pyright: ignore[reportAttributeAccessIssue]
        raise ValueError(
            "work_precision needs references in double precision: call jax.config.update('jax_enable_x64', True) first."
            " Pass Method(dtype='float32') for runs in single precision."
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
    _check(methods, tolerances, costs)
    batch, rounds = as_whole(batch, name="batch"), as_whole(rounds, name="rounds")
    if {"forward", "reverse"} & set(costs) or wrt is not None:
        question = replace(question, values=chosen_numbers(scene, question.q0, question.qd0, wrt))
        costs = tuple(costs) if {"forward", "reverse"} & set(costs) else (*costs, "forward")
    smallest = min(tolerances) if tolerances else 1e-6
    rtol, agreement = max(_TIGHTER * smallest, _TIGHTEST), smallest if agreement is None else agreement
    target = find_reference(scene, question, rtol, closed=closed, scale=None, agreement=agreement)
    scale = scale_of(target.y)
    limits: dict[int, Reference | str] = {}
    for method in methods.values():
        if method.scene is not None and id(method.scene) not in limits:
            try:
                limits[id(method.scene)] = find_reference(
                    method.scene, question, rtol, closed=None, scale=scale, agreement=agreement
                )
            except RuntimeError as error:
                limits[id(method.scene)] = f"This formulation has no reference: {error}"
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


def _check(methods: dict[str, Method], tolerances: list[float], costs: Sequence[str]) -> None:
    for name, method in methods.items():
        if not isinstance(method, Method):
            raise ValueError(
                f"methods[{name!r}] must be a Method, as in Method(diffrax.Tsit5()), but {method!r} was given."
            )
    if not methods:
        raise ValueError("methods is empty: name at least one, or omit it for solvers that suit the scene.")
    if any(not x > 0 for x in tolerances):
        raise ValueError(f"tolerances must be > 0, but {tolerances} were given.")
    if not tolerances and any(method.steps is None for method in methods.values()):
        raise ValueError("tolerances is empty: pass some, or steps for every method.")
    if isinstance(costs, str) or "run" not in costs or not set(costs) <= set(COSTS):
        raise ValueError(f"costs must be 'run' and any of {', '.join(COSTS[1:])}, but {costs!r} was given.")


def _settings(method: Method, tolerances: Sequence[float]) -> list[dict[str, float]]:
    if method.steps is not None:
        return [{"dt": float(dt)} for dt in method.steps]
    return [{"rtol": rtol, "atol": ATOL * rtol} for rtol in tolerances]


class _PreparedMethod(NamedTuple):
    """A method with its calls, one for each cost, which are compiled once for all settings."""

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
            f"wrt must name numbers that all scenes have, but that of methods[{name!r}] has no {', '.join(lacking)}."
        )
    solver = default_solver(scene, start["q0"].size, fixed) if method.solver is None else method.solver
    # Fixed time steps have no limit.
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
    """Results of a method at a setting, by cost, and their times or the reasons of failure."""

    given: dict[str, Any]
    reports: dict[str, dict[str, Any]]


def _measured(
    candidates: list[tuple[_PreparedMethod, dict[str, float]]], costs: Sequence[str], rounds: int, limit_s: float
) -> list[_Timed]:
    """Time all candidates in turns, cost after cost, without those that have failed before."""
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
    """Timings of each candidate; all settings of a method share the compilation of its first one."""
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
    target: Reference,
    limit: Reference | str | None,
    scale: float,
) -> Row:
    """The row of a candidate, with errors and times."""
    prepared, setting = candidate
    row = Row(prepared.name, setting.get("rtol"), setting.get("dt"), str(prepared.dtype))
    failed = [report["failed"] for report in outcome.reports.values() if "failed" in report]
    if failed:
        return replace(row, failed=failed[0])
    run, warnings = outcome.given["run"], []
    y = np.asarray(observed(question.observe(run)), float)

    def apart(a: np.ndarray, b: np.ndarray) -> float:
        return float(np.max(np.abs(a - b))) / scale

    error, numerical, model = apart(y, target.y), None, None
    if limit is None:
        numerical, model = error, 0.0
    elif isinstance(limit, str):
        warnings.append(limit)
    else:
        numerical, model = apart(y, limit.y), apart(limit.y, target.y)
    events, changes = None, mode_changes_of(run)
    if target.events is not None and changes is not None:
        events = event_error(changes, target.events)
        if events is None:
            counts = f"{changes.t.size} changes, in the reference {target.events.t.size}"
            warnings.append(f"The sequence of modes differs from that of the reference: {counts}.")
    derivatives = [outcome.given[cost] for cost in ("forward", "reverse") if cost in outcome.given]
    gradient = None
    if derivatives and target.gradient is not None:
        gradient = max(gradient_error({n: float(x) for n, x in each.items()}, target.gradient) for each in derivatives)
    steps = int(run.stats["num_steps"])
    each = evaluations_per_step(prepared.solver, (run.q, run.qd, run.z))
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
        warnings=tuple(warnings),
    )
