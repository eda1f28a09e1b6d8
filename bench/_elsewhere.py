"""Peers whose pins clash with ours: measured by a script in an environment of their own, with times scaled to this one.

The scale is that of the same NumPy work, timed in both environments.
"""

import json
import os
import subprocess
from pathlib import Path
from typing import Any

from _measure import scaled
from _workload import numpy_workload_s

_XLA_OPTION = "--xla_backend_extra_options=xla_cpu_small_while_loop_byte_threshold=1000000"


def ask(interpreter: str, script: str, task: dict[str, Any], *, tuned: bool) -> dict[str, Any]:
    """What a script beside this one found, with `times` scaled; or under `missing` why there is nothing.

    **Arguments:**

    - `interpreter`: Python of the other environment.
    - `script`: name of the file, which reads the task as JSON and prints a line `RESULT` and JSON: `times` as `measure`
      finds them, and `numpy_workload_s`.
    - `task`: for the script; `tuned` is added, and sets the XLA option of `tune_cpu`.
    """
    before = numpy_workload_s()
    try:
        done = subprocess.run(
            [interpreter, str(Path(__file__).parent / script)],
            input=json.dumps(task | {"tuned": tuned}),
            env=os.environ | {"XLA_FLAGS": _XLA_OPTION if tuned else "", "PYTHONPATH": ""},
            capture_output=True,
            text=True,
        )
    except OSError as error:
        return {"missing": f"its interpreter does not start: {error}"}
    lines = [line for line in done.stdout.splitlines() if line.startswith("RESULT ")]
    if not lines:
        reason = (done.stderr.strip().splitlines() or ["no output"])[-1]
        return {"missing": f"its script failed: {reason[:200]}"}
    found = json.loads(lines[0].removeprefix("RESULT "))
    here = min(before, numpy_workload_s())
    scale = here / found["numpy_workload_s"]
    found["times"] = {name: _rescaled(row, scale) for name, row in found["times"].items()}
    return found | {"numpy_workload_here_s": here, "scale": scale}


def _rescaled(row: dict[str, Any], scale: float) -> dict[str, Any]:
    if "failed" in row:
        return row
    return scaled(row, 1) | {"unscaled_s": row["median_s"], "median_s": row["median_s"] * scale}
