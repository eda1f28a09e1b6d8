"""Hard cases in jaxonomy: what it is given, and what it answers in the time it has."""

import json
import os
import subprocess
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
from _hard_plain import ATOL, RTOL

from jaxmodsim.validation.hard import HardCase, SceneTask

G = 9.81
# How jaxonomy is asked: by the method it takes by itself, and by the one for stiff systems.
METHODS = {"jaxonomy": "auto", "jaxonomy BDF": "bdf"}
_STIFF = ("bristle_stiff",)
_BALLS = {
    "bouncing_ball": ({"y0": 1.0, "v0": 0.0, "e": 0.5}, 2.0),
    "grazing_ceiling": ({"y0": 0.0, "ceiling": 1.0}, 1.0),
}
IN_JAXONOMY = (*_STIFF, "zero_start", *_BALLS)


def in_jaxonomy(case: HardCase, program: str) -> bool:
    """Whether jaxonomy is asked a case by this method."""
    return case.name in (_STIFF if METHODS[program] == "bdf" else IN_JAXONOMY)


def _task(case: HardCase) -> tuple[dict[str, float], float]:
    """Numbers of a case by name, and its end [s]."""
    if case.name == "grazing_ceiling":
        numbers, t1 = _BALLS[case.name]
        assert not isinstance(case.task, SceneTask)
        return numbers | {"g": G, "v0": getattr(case.task, "x", np.nan)}, t1
    if case.name in _BALLS:
        numbers, t1 = _BALLS[case.name]
        return numbers | {"g": G}, t1
    assert isinstance(case.task, SceneTask)
    scene = case.task.scene
    law = {name: float(value) for name, value in vars(scene.effects[-1].law).items() if np.ndim(value) == 0}
    return law | {name: float(value) for name, value in scene.params.items()}, float(case.task.t1)


def answer(case: HardCase, program: str, interpreter: str, limit: float) -> dict[str, Any]:
    """What jaxonomy gives for a case within `limit` [s] from where it is imported: `value`, `error` or neither.

    **Raises:**

    - `RuntimeError` if it does not start.
    """
    numbers, t1 = _task(case)
    task = {"case": case.name, "numbers": numbers, "t1": t1, "rtol": RTOL, "atol": ATOL, "method": METHODS[program]}
    script = Path(__file__).parent / "_jaxonomy_hard.py"
    process = subprocess.Popen(
        [interpreter, str(script)],
        env=os.environ | {"XLA_FLAGS": "", "PYTHONPATH": ""},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    )
    assert process.stdin is not None
    assert process.stdout is not None
    process.stdin.write(json.dumps(task) + "\n")
    process.stdin.flush()
    if process.stdout.readline().strip() != "READY":
        process.kill()
        raise RuntimeError(f"{interpreter} does not run {script.name}: is jaxonomy installed there?")
    began, watch = time.perf_counter(), threading.Timer(limit, process.kill)
    watch.start()
    lines = [line for line in process.stdout if line.startswith("RESULT ")]
    watch.cancel()
    process.wait()
    return json.loads(lines[0].removeprefix("RESULT ")) | {"seconds": time.perf_counter() - began} if lines else {}
