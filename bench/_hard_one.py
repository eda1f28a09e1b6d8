"""One hard case by one program, in a process of its own, and what its answer is worth."""

import math
import multiprocessing
import os
import tempfile
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from _hard_by_hand import IN_MUJOCO, by_hand, by_mujoco, garbage
from _hard_plain import IMPLICIT, PLAIN

import jaxmodsim as jms
from jaxmodsim.problems import BRAKED_SPRING, braked_spring_motion
from jaxmodsim.validation.hard import HardCase, RefusedCalls, SceneTask, check, hard_cases

OURS, MUJOCO = "jaxmodsim", "MuJoCo"
PROGRAMS = (OURS, *PLAIN, MUJOCO)
RIGHT, WRONG, ERROR, NONE = "right", "wrong without a word", "error", "no answer"
# Admissible error of the others, in that of ours, and at least, relative to the scale of the answer; of MuJoCo, whose
# step is fixed, at least the last one.
GENEROUS, LEAST, COARSE = 100.0, 1e-3, 1e-2
# Asked of `jaxmodsim` alone: what is no simulation, or is about methods and types of its own.
OURS_ALONE = (
    *("chart_at_pole", "types_mixed"),
    *("step_limit_slip", "step_limit_stick", "step_limit_regularised", "step_limit_none"),
    # No law by the sign of slip holds less than it resists with.
    *("chatter_named", "chatter_held"),
    # A number of mode changes.
    "smooth_break_away",
)


def _spring_at(t: float) -> float:
    return float(braked_spring_motion(jnp.asarray(t), **BRAKED_SPRING)[0])


# Right answers other than those asked of `jaxmodsim`: it is held to a step, a limit or a phase that others have not.
_OTHERWISE: dict[str, Callable[[], tuple[float, float]]] = {
    "periods_1000000": lambda: (1.0, 1.0),
    "step_limit": lambda: (_spring_at(1000.0), 1.0),
    # (t - m/Fv)/Fv, for 2 kg and 1e7 N s/m.
    "explicit_is_named": lambda: (1e-6 - 2e-14, 1e-6),
    "bouncing_ball_unheld": lambda: (0.0, 1.0),
    **{f"units_{name}": lambda: (_spring_at(30.0), 1.0) for name in ("nanometres", "kilometres", "microseconds")},
}


def asked(case: HardCase, program: str) -> bool:
    """Whether a program is asked a case."""
    if program == OURS:
        return True
    if program == MUJOCO:
        return case.name in IN_MUJOCO
    if case.name in OURS_ALONE:
        return False
    stiff = isinstance(case.task, SceneTask) and any(effect.stiff for effect in case.task.scene.effects)
    return program != IMPLICIT or stiff or case.family == "stiffness"


def ask(name: str, program: str, limit: float) -> dict[str, Any]:
    """What a program gives for a case, in a process of its own, within `limit` [s] from where it is imported.

    **Returns:**

    `verdict`, of `RIGHT`, `WRONG`, `ERROR` and `NONE`, `says`, and `seconds`; for `jaxmodsim` `warm_s`, of a second
    run.
    """
    context = multiprocessing.get_context("spawn")
    receive, send = context.Pipe(duplex=False)
    process = context.Process(target=_work, args=(name, program, send))
    process.start()
    send.close()
    found: dict[str, Any] = {"verdict": NONE, "says": f"no answer in {limit:g} s"}
    try:
        receive.recv()  # imports are done
        began = time.perf_counter()
        while receive.poll(max(limit - (time.perf_counter() - began), 0.0)):
            found |= receive.recv()
    except EOFError:
        process.join()
        if found["verdict"] == NONE:
            found = {"verdict": ERROR, "says": f"the process ended with code {process.exitcode}"}
    finally:
        process.kill()
        process.join()
    return {"case": name, "program": program} | found


def judged_elsewhere(case: HardCase, answer: dict[str, Any]) -> dict[str, Any]:
    """What an answer is worth that came from another environment: `value`, `error` or neither."""
    if "error" in answer:
        return {"verdict": ERROR, "says": answer["error"]}
    if "value" not in answer:
        return {"verdict": NONE, "says": "no answer in time"}
    right, says = _judge(case, LEAST)(float(answer["value"]))
    return {"verdict": RIGHT if right else WRONG, "says": says, "seconds": answer["seconds"]}


def _work(name: str, program: str, send: Any) -> None:
    """The process: answers go into the pipe, with what comes later after them."""
    jms.tune_cpu()
    jax.config.update("jax_enable_x64", True)
    os.chdir(tempfile.gettempdir())  # MuJoCo writes its warnings to a file where it is
    case = hard_cases()[name]
    judge = (
        None
        if program == OURS or isinstance(case.task, RefusedCalls)
        else _judge(case, COARSE if program == MUJOCO else LEAST)
    )
    send.send({})
    began = time.perf_counter()
    if program == OURS:
        found = _ours(case)
    elif judge is None:
        found = _refused(garbage(program)[name])
    else:
        found = _judged(judge, lambda: _value(case, program), refusal_is_right=bool(case.ends))
    send.send(found | {"seconds": time.perf_counter() - began})
    if program == OURS and isinstance(case.task, SceneTask):
        x = jnp.asarray(case.task.x)
        began = time.perf_counter()
        jax.block_until_ready(case.task.run(x).q)
        send.send({"warm_s": time.perf_counter() - began})


def _ours(case: HardCase) -> dict[str, Any]:
    """By `check`, alone in float64, to the tolerance of the case."""
    verdict = check(case, transforms=("alone",), dtypes=("float64",))
    sentences = "; ".join(finding.sentence for finding in verdict.findings)
    if verdict.ok:
        return {"verdict": RIGHT, "says": sentences}
    refused = isinstance(case.task, SceneTask) and "The run reached t1" not in sentences
    return {"verdict": ERROR if refused else WRONG, "says": sentences}


def _value(case: HardCase, program: str) -> float:
    task = case.task
    if not isinstance(task, SceneTask):
        return by_hand(program)[case.name]()
    if program == MUJOCO:
        return by_mujoco(case.name, task)
    times = {name: task.numbers[name] for name in ("t0", "ts") if name in task.numbers}
    run: Any = PLAIN[program](task.scene, task.q0, task.qd0, task.t1, **times)
    return float(np.asarray(task.read(run)))


def _judge(case: HardCase, least: float) -> Callable[[float], tuple[bool, str]]:
    """Whether a number is right, and a sentence."""
    if case.name in _OTHERWISE:
        right, scale = _OTHERWISE[case.name]()
    else:
        x = case.task.x if hasattr(case.task, "x") else 0.0
        found = case.exact(x) if case.exact else case.second() if case.second else None
        if found is None:  # an end with a sentence is all that is right
            return lambda value: (False, f"{value:.9g}, and there is no such number")
        right, scale = float(found), case.scale if case.scale is not None else abs(float(found)) or 1.0
    limit = max(GENEROUS * case.tolerance, least) * scale
    return lambda value: (abs(value - right) <= limit, f"{value:.9g}, right is {right:.9g}")


def _judged(
    judge: Callable[[float], tuple[bool, str]], compute: Callable[[], float], *, refusal_is_right: bool
) -> dict[str, Any]:
    try:
        value = compute()
    except Exception as error:
        return {"verdict": RIGHT if refusal_is_right else ERROR, "says": _named(error)}
    right, says = judge(value)
    return {"verdict": RIGHT if right else WRONG, "says": says}


def _refused(calls: dict[str, Callable[[], Any]]) -> dict[str, Any]:
    """Right where every call raises, or gives no number at all."""
    silent, sentences = False, []
    for name, call in calls.items():
        try:
            values = call()
            silent |= values.size > 0
            says = f"gives {', '.join(f'{value:.6g}' for value in values) or 'nothing'}"
        except Exception as error:
            says = f"error: {_named(error)}"
        sentences.append(f"{name}: {says}")
    return {"verdict": WRONG if silent else RIGHT, "says": "; ".join(sentences)}


def _named(error: Exception) -> str:
    """Kind of an error, and its first line; from compiled code the stack comes before that."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip(" -")]
    named = [line.split("EquinoxRuntimeError: ")[1] for line in lines if "EquinoxRuntimeError: " in line]
    return f"{type(error).__name__}: {([*named, *lines] or ['without words'])[0][:200]}"


def is_nan(entry: dict[str, Any]) -> bool:
    """Whether what came back as an answer is no number."""
    return entry["verdict"] == WRONG and "nan" in entry["says"].split(", right is")[0]


def seconds(entry: dict[str, Any] | None) -> str:
    """Time of a second run [ms]."""
    return "-" if entry is None or math.isnan(entry.get("warm_s", math.nan)) else f"{1e3 * entry['warm_s']:.3g}"
