"""Cost of the first call of a scene, traced and compiled, and of its derivatives.

Times are processor times, because compilation uses all cores: of a run with 51 saved times, and of derivatives of the
sum of its positions by six parameters (five of the belt), or by all numbers of a large scene. The number of equations
that XLA receives is recorded too. Warm times are those of jitted functions.
"""

import time
from itertools import islice
from pathlib import Path
from typing import Any

import diffrax as dfx
import jax
import jax.numpy as jnp

import jaxmodsim as jms
from bench.census import equations
from bench.record import Result, timed
from bench.scenes import LARGE, SAMPLES, SIX, TIMED, WOODPECKER, chain


def main(smoke: bool, out: Path) -> Result:
    """Measure all scenes, after one for warm-up; a smoke run has two."""
    del out
    result = Result("first_calls", ("diffrax",), {"samples": SAMPLES})
    once = chain(1, lambda p: jms.Viscous(p[2]))  # JAX loads its own modules here
    jax.jit(once.ways()["gradient"]).lower(jnp.asarray(once.numbers)).compile()
    for name in [*TIMED, *LARGE][: 2 if smoke else None]:
        task = (TIMED | LARGE)[name]()
        # The run, its gradient, its Jacobian.
        ways = dict(islice(task.ways().items(), 3 if name in TIMED else 1 if name == WOODPECKER else 2))
        if name == SIX:
            ways["run by Tsit5"] = lambda p, task=task: task.total(p, solver=dfx.Tsit5(), max_steps=1_000_000)
        calls: dict[str, Any] = {}
        p = jax.tree.map(jnp.asarray, task.numbers)
        for way, function in ways.items():
            began = time.process_time()
            traced = jax.jit(function).trace(p)
            call = traced.lower().compile()
            result.add(f"first {way}", time.process_time() - began, "s", case=name)
            result.add(f"equations of {way}", len(list(equations(traced.jaxpr.jaxpr))), case=name)
            calls[way] = lambda call=call, p=p: jax.block_until_ready(call(p))
        for way, found in timed(calls, 3 if smoke else 30).items():
            result.add_time(way, found, case=name)
            if way.startswith("run"):
                steps = int(calls[way]()[1])
                result.add(f"steps of {way}", steps, case=name)
                result.add(f"step of {way}", found["median_s"] / steps, "s", case=name)
    return result
