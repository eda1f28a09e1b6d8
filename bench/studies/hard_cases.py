"""Hard cases by `jaxmodsim` and by other programs: right, silently wrong, error, no answer.

diffrax and scipy get the same equations of motion, with `Fc sign(v)` for dry friction. Mass matrices are solved
accurately and constraints are differentiated twice, but there are no events and no projection onto constraints.
`jaxmodsim` gets each case as defined, with the tolerance of the case; the others have a hundred times this tolerance,
and at least 1e-3. If a case has no answer, any error is right. Every program runs every case in its own process, with
60 s for compilation and run.

Then `jaxmodsim` runs every case in both floating types; the tests run them under every transform. The largest stable
step of each explicit method is found by bisection. The figures of docs/hard_cases.md show both.
"""

import multiprocessing
import time
from collections import Counter
from collections.abc import Callable
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from scipy.integrate import solve_ivp

import jaxmodsim as jms
from bench.hard import add_errors, add_steps, check_many
from bench.record import OURS, Result
from jaxmodsim.friction import AbstractSetValuedLaw
from jaxmodsim.scene import State, vector_field
from tests.hard.case import HardCase, SceneTask
from tests.hard.catalogue import hard_cases
from tests.hard.check import check
from tests.hard.steps import formulations

RIGHT, WRONG, ERROR, NONE = "right", "silently wrong", "error", "no answer"
RTOL, ATOL, LIMIT = 1e-6, 1e-9, 60.0
# Admissible error of the others, as a multiple of ours, and at least relative to the scale of the answer.
GENEROUS, LEAST = 100.0, 1e-3
# A selection of each family of runs of a scene: all cases by all programs take hours.
CASES = (
    *("bristle_stiff", "zero_start", "force_equals_limit", "dip_of_slip", "belt_turns", "shaken_table"),
    *("pole_start", "painleve_rod", "resting_place"),
)


def main(smoke: bool, out: Path) -> Result:
    """Compare all programs, and check all cases; a smoke run has one case."""
    del out
    result = Result("hard_cases", ("diffrax", "scipy", "numpy"))
    result.settings |= {"rtol": RTOL, "atol": ATOL, "limit": LIMIT, "generous": GENEROUS, "least": LEAST}
    counts: dict[str, Counter[str]] = {}
    programs = (OURS, "diffrax Tsit5") if smoke else (OURS, *PLAIN)
    for name in ("zero_start",) if smoke else CASES:
        case = hard_cases()[name]
        for program in programs:
            if not _asked(case, program):
                continue
            found = _ask(name, program)
            about: dict[str, Any] = {"case": f"{case.family}: `{name}`", "peer": program}
            nan = found["verdict"] == WRONG and "nan" in found["says"].split(", right is")[0]
            counts[program] = counts.get(program, Counter()) + Counter([found["verdict"]])
            result.add("verdict", f"{found['verdict']} (NaN)" if nan else found["verdict"], **about)
            result.add("says", found["says"], **about)
            print(f"{name}, {program}: {found['verdict']}: {found['says']}", flush=True)
    for program, found in counts.items():
        result.add("cases", found.total(), peer=program, at="asked")
        for verdict in (RIGHT, WRONG, ERROR, NONE):
            result.add("cases", found[verdict], peer=program, at=verdict)
    if smoke:
        add_errors(result, check_many(["step_longer_than_run"]))
        add_steps(result, ["viscous"], ["Euler"])
    else:
        add_errors(result, check_many(list(hard_cases())))
        add_steps(result, list(formulations()))
    return result


def _asked(case: HardCase, program: str) -> bool:
    """Whether a program runs a case; the implicit solver of diffrax runs stiff cases."""
    stiff = isinstance(case.task, SceneTask) and any(effect.stiff for effect in case.task.scene.effects)
    return program != "diffrax Kvaerno5" or stiff or case.family == "stiffness"


def _ask(name: str, program: str) -> dict[str, Any]:
    """Verdict of a program on a case, in its own process, within `LIMIT` after its import."""
    context = multiprocessing.get_context("spawn")
    receive, send = context.Pipe(duplex=False)
    process = context.Process(target=_work, args=(name, program, send))
    process.start()
    send.close()
    found: dict[str, Any] = {"verdict": NONE, "says": f"no answer in {LIMIT:g} s"}
    try:
        receive.recv()  # imports are done
        began = time.perf_counter()
        while receive.poll(max(LIMIT - (time.perf_counter() - began), 0.0)):
            found |= receive.recv()
    except EOFError:
        process.join()
        if found["verdict"] == NONE:
            found = {"verdict": ERROR, "says": f"the process ended with code {process.exitcode}"}
    finally:
        process.kill()
        process.join()
    return found


def _work(name: str, program: str, send: Any) -> None:
    """The process: it sends a sign after its imports, and then the answer."""
    jms.tune_cpu()
    jax.config.update("jax_enable_x64", True)
    case = hard_cases()[name]
    send.send({})
    if program == OURS:
        send.send(_ours(case))
    else:
        send.send(_judged(_judge(case), lambda: _value(case, program), error_is_right=bool(case.ends)))


def _ours(case: HardCase) -> dict[str, Any]:
    """Verdict by `check`, in float64, to the tolerance of the case."""
    verdict = check(case, transforms=("alone",), dtypes=("float64",))
    sentences = "; ".join(finding.sentence for finding in verdict.findings)
    if verdict.ok:
        return {"verdict": RIGHT, "says": sentences}
    refused = isinstance(case.task, SceneTask) and "The run reached t1" not in sentences
    return {"verdict": ERROR if refused else WRONG, "says": sentences}


def _judge(case: HardCase) -> Callable[[float], tuple[bool, str]]:
    """Whether a number is right, and a sentence."""
    assert isinstance(case.task, SceneTask)
    found = case.exact(case.task.x) if case.exact else case.second() if case.second else None
    if found is None:  # an error is the right answer
        return lambda value: (False, f"{value:.9g}, and there is no such number")
    right, scale = float(found), case.scale if case.scale is not None else abs(float(found)) or 1.0
    limit = max(GENEROUS * case.tolerance, LEAST) * scale
    return lambda value: (abs(value - right) <= limit, f"{value:.9g}, right is {right:.9g}")


def _judged(judge: Any, compute: Callable[[], float], *, error_is_right: bool) -> dict[str, Any]:
    try:
        value = compute()
    except Exception as error:
        return {"verdict": RIGHT if error_is_right else ERROR, "says": _named(error)}
    right, says = judge(value)
    return {"verdict": RIGHT if right else WRONG, "says": says}


def _named(error: Exception) -> str:
    """Kind of an error, and its first line after the stack of compiled code."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip(" -")]
    named = [line.split("EquinoxRuntimeError: ")[1] for line in lines if "EquinoxRuntimeError: " in line]
    return f"{type(error).__name__}: {([*named, *lines] or ['without words'])[0][:200]}"


def _value(case: HardCase, program: str) -> float:
    """The answer of a program."""
    task = case.task
    assert isinstance(task, SceneTask)
    times = {name: task.numbers[name] for name in ("t0", "ts") if name in task.numbers}
    run: Any = PLAIN[program](task.scene, task.q0, task.qd0, task.t1, **times)
    return float(np.asarray(task.read(run)))


# Scenes by diffrax and scipy, with friction by the sign of slip.


def _with_signs(scene: jms.Scene) -> jms.Scene:
    """The scene with `Fc sign(v)` for every set-valued law."""

    def signed(effect: Any) -> Any:
        if isinstance(effect, jms.Friction) and isinstance(effect.law, AbstractSetValuedLaw):
            return eqx.tree_at(lambda effect: effect.law, effect, jms.Sign(effect.law))
        return effect

    return eqx.tree_at(lambda scene: scene.effects, scene, tuple(signed(effect) for effect in scene.effects))


def _start(scene: jms.Scene, q0: Any, qd0: Any) -> State:
    q, qd = (jnp.asarray(x).astype(float) for x in (q0, qd0))
    return State(q, qd, scene.initial_state(q))


def _rate(t: Any, y: State, scene: jms.Scene) -> State:
    return vector_field(t, y, scene, None)


def _run(t_end: Any, states: State) -> SimpleNamespace:
    """The states from which the answer of a case is read, with a leading time axis as in a `Trajectory`."""
    return SimpleNamespace(q=states.q, qd=states.qd, z=states.z, t_end=t_end)


def _by_diffrax(
    scene: Any, q0: Any, qd0: Any, t1: Any, *, solver: Any, t0: Any = 0.0, ts: Any = None
) -> SimpleNamespace:
    y0 = _start(scene, q0, qd0)
    solution = dfx.diffeqsolve(
        dfx.ODETerm(_rate), solver, jnp.asarray(t0, float), jnp.asarray(t1, float), None, y0, args=_with_signs(scene),
        saveat=dfx.SaveAt(t1=True) if ts is None else dfx.SaveAt(ts=jnp.asarray(ts, float)),
        stepsize_controller=dfx.PIDController(RTOL, ATOL),
        max_steps=1_000_000, throw=False,
    )  # fmt: skip
    if solution.result != dfx.RESULTS.successful:
        raise RuntimeError(dfx.RESULTS[solution.result])
    assert solution.ys is not None
    return _run(t1, solution.ys)


def _by_scipy(scene: Any, q0: Any, qd0: Any, t1: Any, *, method: str, t0: Any = 0.0, ts: Any = None) -> SimpleNamespace:
    y0, scene = _start(scene, q0, qd0), _with_signs(scene)
    flat, unravel = ravel_pytree(y0)
    field = jax.jit(lambda t, y: ravel_pytree(_rate(t, unravel(y), scene))[0])
    given = None if ts is None else np.asarray(ts, float)
    done = solve_ivp(
        lambda t, y: np.asarray(field(t, y)), (float(t0), float(t1)), np.asarray(flat), method, given, rtol=RTOL,
        atol=ATOL,
    )  # fmt: skip
    if not done.success:
        raise RuntimeError(done.message)
    ends = done.y if ts is not None else done.y[:, -1:]
    return _run(t1, jax.vmap(unravel, in_axes=1)(jnp.asarray(ends)))


PLAIN: dict[str, Callable[..., SimpleNamespace]] = {
    "diffrax Tsit5": partial(_by_diffrax, solver=dfx.Tsit5()),
    "diffrax Kvaerno5": partial(_by_diffrax, solver=dfx.Kvaerno5()),
    "scipy RK45": partial(_by_scipy, method="RK45"),
    "scipy LSODA": partial(_by_scipy, method="LSODA"),
}
