"""Side-by-side timing, and the record of where and with what it was done."""

import gc
import importlib.metadata
import os
import platform
import statistics
import subprocess
import time
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

_SLOW = 0.02
_BURST = 5
# All but what benches write: the results of one are no change to the next.
_WHAT_IS_MEASURED = (":/", ":(top,exclude)bench/results", ":(top,exclude)README.md")


def describe_machine(*packages: str) -> dict[str, Any]:
    """Processor, versions, commit and date of a measurement."""
    return {
        "cpu": _cpu_model(),
        "cores": os.cpu_count(),
        "system": platform.system(),
        "python": platform.python_version(),
        "versions": {name: importlib.metadata.version(name) for name in packages},
        "xla_flags": os.environ.get("XLA_FLAGS", ""),
        "commit": _git("rev-parse", "HEAD"),
        "uncommitted_changes": bool(_git("status", "--porcelain", "--untracked-files=no", "--", *_WHAT_IS_MEASURED)),
        "date": datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
    }


def _cpu_model() -> str:
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or "unknown"


def _git(*command: str) -> str:
    try:
        done = subprocess.run(
            ["git", *command], cwd=Path(__file__).parent, capture_output=True, text=True, check=True, timeout=20
        )
    except (OSError, subprocess.SubprocessError):
        return ""
    return done.stdout.strip()


def measure(calls: dict[str, Callable[[], Any]], rounds: int, limit_s: float = 30.0) -> dict[str, dict[str, Any]]:
    """Time several calls in turns, so that a drift of the machine's speed meets them all alike.

    The first call of each, which compiles, is timed apart. Then in every round each call has its turn: a fast one
    (below 20 ms) is called once to warm the caches that the others have emptied, then timed five times in a row; a
    slow one is timed once. Each call must wait for its own result.

    **Arguments:**

    - `calls`: functions without arguments, by name.
    - `rounds`: number of turns of each.
    - `limit_s`: a call that has taken this long in all [s] sits out the remaining rounds, but has at least one.

    **Returns:**

    For each name `first_s`, `median_s`, `quartiles_s`, `minimum_s`, `repetitions`; or `failed`, the reason.
    """
    report: dict[str, dict[str, Any]] = {}
    seconds: dict[str, list[float]] = {}
    for name, call in calls.items():
        try:
            first = _seconds(call)
            second = _seconds(call)
        except Exception as error:  # a peer that fails is a result
            report[name] = {"failed": f"{type(error).__name__}: {str(error).strip().splitlines()[0][:200]}"}
            continue
        report[name] = {"first_s": first, "slow": second > _SLOW}
        seconds[name] = []
    gc.collect()
    gc.disable()
    try:
        for _ in range(rounds):
            for name, taken in seconds.items():
                if sum(taken) < limit_s:
                    taken += _turn(calls[name], report[name]["slow"])
    finally:
        gc.enable()
    for name, taken in seconds.items():
        del report[name]["slow"]
        report[name] |= _summary(taken)
    return report


def _turn(call: Callable[[], Any], slow: bool) -> list[float]:
    if slow:
        return [_seconds(call)]
    call()
    return [_seconds(call) for _ in range(_BURST)]


def _seconds(call: Callable[[], Any]) -> float:
    start = time.perf_counter()
    call()
    return time.perf_counter() - start


def _summary(taken: list[float]) -> dict[str, Any]:
    quartiles = statistics.quantiles(taken, n=4) if len(taken) > 1 else [taken[0]] * 3
    return {
        "median_s": statistics.median(taken),
        "quartiles_s": [quartiles[0], quartiles[2]],
        "minimum_s": min(taken),
        "repetitions": len(taken),
    }


def scaled(report: dict[str, Any], count: int) -> dict[str, Any]:
    """The same report per run, for calls that make `count` runs each; the first call stays as it is."""
    if "failed" in report:
        return report
    return report | {
        "median_s": report["median_s"] / count,
        "quartiles_s": [x / count for x in report["quartiles_s"]],
        "minimum_s": report["minimum_s"] / count,
        "runs_per_call": count,
    }


def machine_line(machine: dict[str, Any]) -> str:
    """One line that names processor, versions, date and commit."""
    versions = ", ".join(f"{name} {version}" for name, version in machine["versions"].items())
    state = " with uncommitted changes" if machine["uncommitted_changes"] else ""
    return (
        f"{machine['cpu']}, {machine['cores']} cores, Python {machine['python']}, {versions};"
        f" {machine['date']}, commit {machine['commit'][:10] or 'unknown'}{state}."
    )
