"""Side-by-side timing."""

import gc
import time
from collections.abc import Callable

from jaxtyping import PyTree

_SLOW = 0.02
_BURST = 5


def measure(calls: dict[str, Callable[[], object]], rounds: int, limit_s: float = 30.0) -> dict[str, dict[str, PyTree]]:
    """Time several calls in turns, so that drift of the machine's speed affects all alike.

    The first call of each, which compiles, is timed separately. Then every call has one turn per round. A fast call
    (below 20 ms) runs once to warm the caches, and then five times for the timing; a slow call runs once. Each call
    must wait for its own result.

    **Arguments:**

    - `calls`: functions without arguments, by name.
    - `rounds`: number of turns of each.
    - `limit_s`: total time [s] after which a call skips the remaining rounds; it has at least one.

    **Returns:**

    For each name `first_s`, `median_s`, `quartiles_s`, `minimum_s` and `repetitions`; or `failed`, the error.
    """
    report: dict[str, dict[str, PyTree]] = {}
    seconds: dict[str, list[float]] = {}
    slow: dict[str, bool] = {}
    for name, call in calls.items():
        try:
            first, second = _seconds(call), _seconds(call)
        except Exception as error:  # a failure is a result, too
            report[name] = {"failed": f"{type(error).__name__}: {str(error).strip().splitlines()[0][:400]}"}
            continue
        report[name], seconds[name], slow[name] = {"first_s": first}, [], second > _SLOW
    gc.collect()
    gc.disable()
    try:
        for _ in range(rounds):
            for name, taken in seconds.items():
                if sum(taken) < limit_s:
                    if not slow[name]:
                        calls[name]()
                    taken += [_seconds(calls[name]) for _ in range(1 if slow[name] else _BURST)]
    finally:
        gc.enable()
    for name, taken in seconds.items():
        report[name] |= _summary(taken)
    return report


def _seconds(call: Callable[[], object]) -> float:
    start = time.perf_counter()
    call()
    return time.perf_counter() - start


def _summary(taken: list[float]) -> dict[str, PyTree]:
    import statistics  # slow to import

    quartiles = statistics.quantiles(taken, n=4) if len(taken) > 1 else [taken[0]] * 3
    return {
        "median_s": statistics.median(taken),
        "quartiles_s": [quartiles[0], quartiles[2]],
        "minimum_s": min(taken),
        "repetitions": len(taken),
    }
