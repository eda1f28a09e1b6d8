"""The quantities of the matrix: each is a function that measures all peers of a case in turns, and adds rows.

Times are medians of interleaved repetitions, without the compilation, which is part of the first call. Every peer is
measured at the loosest tolerance of the ladder that reaches the goal: rows at "chosen".
"""

import time
from dataclasses import dataclass
from functools import partial
from typing import Any

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np

from bench.peers import GROUPS, LOOP, SWEEP, Peer, makers
from bench.record import OURS, Result, importable, timed
from bench.tasks import Box, Case

CHOSEN = "chosen"
TIGHT = 1e-6


@dataclass
class Matrix:
    """One case while it is measured.

    - `peers`: by name. `chosen`: loosest tolerance of each peer that reaches the goal.
    """

    case: Case
    smoke: bool
    result: Result
    peers: dict[str, Peer]
    chosen: dict[str, float]

    def rounds(self, count: int) -> int:
        """Number of repetitions; one in a smoke run."""
        return 1 if self.smoke else count

    def able(self) -> dict[str, Peer]:
        """Peers that reach the goal."""
        return {name: peer for name, peer in self.peers.items() if name in self.chosen}


def run_case(case: Case, smoke: bool) -> Result:
    """Measure all quantities of a case, one after the other."""
    result = case.result()
    wanted = {name: make for name, make in makers(case.task).items() if not smoke or name in case.small}
    matrix = Matrix(case, smoke, result, importable(result, wanted), {})
    for quantity in case.quantities:
        quantity(matrix)
    return result


def errors(m: Matrix) -> None:
    """Measure errors and steps at every tolerance, and choose the loosest tolerance that reaches the goal."""
    case, task = m.case, m.case.task
    runs = {name: peer.record for name, peer in m.peers.items()}
    tight = [rtol for rtol in case.ladder if case.goal or rtol == TIGHT]
    goal = case.goal
    for name, record in runs.items():
        small = dict.fromkeys((*tight[:1], *tight[2:9:3], *tight[9:10])) if m.smoke else case.ladder
        for rtol in small:
            try:
                recorded, steps = record(rtol)
            except Exception as error:  # a peer that fails is a result
                m.result.add(case.measure, f"failed: {error}", peer=name, at=rtol)
                continue
            found = task.errors(recorded) | ({} if steps is None else {"steps": (steps, "1")})
            reached = goal is not None and found[case.measure][0] <= goal and name not in m.chosen
            if reached:
                m.chosen[name] = rtol
                m.result.add("rtol", rtol, peer=name, at=CHOSEN)
            for at in (rtol, CHOSEN) if reached else (rtol,):
                for quantity, (value, unit) in found.items():
                    m.result.add(quantity, value, unit, peer=name, at=at)
            if reached and case.name == "pulled_spring" and name != OURS:
                break
        if goal is None:  # jaxmodsim is the first peer
            goal = 1.05 * next(r["value"] for r in m.result.rows if r["quantity"] == case.measure and r["at"] == TIGHT)
            m.chosen[OURS] = TIGHT
            m.result.add("rtol", TIGHT, at=CHOSEN)


def run_time(m: Matrix) -> None:
    """Time one run that returns the end state, as a user calls it, and for jaxmodsim also inside `jax.jit`."""
    calls: dict[tuple[str, str, Any], Any] = {}
    p = jnp.asarray(m.case.task.numbers)
    for name, peer in m.able().items():
        for at in {CHOSEN: m.chosen[name]} | ({TIGHT: TIGHT} if m.case.goal is None else {}):
            rtol = m.chosen[name] if at == CHOSEN else TIGHT
            calls["run", name, at] = peer.once(rtol)
            if peer.traced and name == OURS:
                run = jax.jit(partial(_at, peer.traced, rtol, None))
                calls["run in `jax.jit`", name, at] = lambda run=run: run(p).block_until_ready()
    for (quantity, name, at), found in timed(calls, m.rounds(60), limit_s=10.0).items():
        m.result.add_time(quantity, found, peer=name, at=at)


def _at(traced: Any, rtol: float, adjoint: Any, p: Any) -> Any:
    return traced(p, rtol, adjoint)


def batch(m: Matrix) -> None:
    """Time runs with different parameters, by every batch method of each peer; loops have 64 runs."""
    count = 8 if m.smoke else 1024
    sets, task, few = m.case.task.sets(count), m.case.task, min(count, 64)
    calls, sizes = {}, {}
    for name, peer in m.able().items():
        for way, many in peer.many.items():
            if m.smoke and way in (GROUPS, SWEEP):
                continue
            sizes[name, way] = few if way == LOOP else count
            calls[name, way] = many(m.chosen[name], sets[: sizes[name, way]])
    exact = task.exact_ends(sets[:few])
    m.result.settings |= {"runs": count, "runs of a loop": few}
    for (name, way), found in timed(calls, m.rounds(7), per=sizes, limit_s=20.0).items():
        m.result.add_time("run of many", found, peer=name, at=way)
        if "failed" not in found:
            ends = np.asarray(calls[name, way]())[:few]
            error = np.abs(ends / exact - 1.0) if isinstance(task, Box) else np.abs(ends - exact)
            m.result.add("error of many", float(np.max(error)), peer=name, at=way)


def derivatives(m: Matrix) -> None:
    """Time the forward Jacobian and the reverse gradient of the end state by the parameters, and the plain run.

    All are jitted. The tolerance is that of the run. It does not bound the errors of derivatives, which are recorded.
    """
    task, calls = m.case.task, {}
    p, exact = jnp.asarray(task.numbers), task.exact_gradient()
    kinds = ("run", "jacobian", "gradient") if isinstance(task, Box) else ("run", "gradient")
    for name, peer in m.able().items():
        for kind in kinds[-1:] if m.smoke else kinds:
            if not peer.differentiated or (m.smoke and name != OURS):
                continue
            function = partial(_at, peer.traced, m.chosen[name], dfx.ForwardMode() if kind == "jacobian" else None)
            wrap = {"run": lambda f: f, "jacobian": jax.jacfwd, "gradient": jax.grad}[kind]
            calls[name, kind] = partial(_wait, jax.jit(wrap(function)), p)
    for (name, kind), found in timed(calls, m.rounds(40)).items():
        m.result.add_time("differentiated run" if kind == "run" else kind, found, peer=name, at=CHOSEN)
        if kind != "run" and "failed" not in found:
            error = task.gradient_error(np.asarray(calls[name, kind]()), exact)
            m.result.add(f"error of the {kind}", error, peer=name, at=CHOSEN)


def _wait(function: Any, *given: Any) -> Any:
    return jax.block_until_ready(function(*given))


def time_at_each_tolerance(m: Matrix, only: tuple[str, ...] = ()) -> None:
    """Time one run at every tolerance of the errors."""
    rows = [row for row in m.result.rows if row["quantity"] == "steps" and row["at"] != CHOSEN]
    done = [(row["peer"], row["at"]) for row in rows if row["peer"] in (only or m.peers)]
    calls = {(name, rtol): m.peers[name].once(rtol) for name, rtol in done}
    for (name, rtol), found in timed(calls, m.rounds(20), limit_s=3.0).items():
        m.result.add_time("run", found, peer=name, at=rtol)


def our_time_at_each(m: Matrix) -> None:
    """Time one run of jaxmodsim at every tolerance."""
    time_at_each_tolerance(m, (OURS,))


def compilation(m: Matrix) -> None:
    """Time to trace and compile a run and its gradient, with cleared caches; for a run the shortest of three."""
    p = jnp.asarray(m.case.task.numbers)
    for name, peer in m.peers.items():
        if peer.traced:
            run = partial(_at, peer.traced, TIGHT, None)
            m.result.add("compilation", min(_compiled(run, p) for _ in range(m.rounds(3))), "s", peer=name)
            if not m.smoke:
                m.result.add("compilation of the gradient", _compiled(jax.grad(run), p), "s", peer=name)


def _compiled(function: Any, p: Any) -> float:
    jax.clear_caches()
    start = time.perf_counter()
    # A new function, which no cache knows.
    jax.jit(lambda p: function(p)).lower(p).compile()
    return time.perf_counter() - start


def rk4(m: Matrix) -> None:
    """Measure errors of RK4 with the published step, a stable step, and the step of the published reference."""
    task: Any = m.case.task
    for h in (1e-3,) if m.smoke else (1e-3, 5e-5, 1e-5):
        m.result.add("steps", round(task.t1 / h), peer="RK4, here", at=h)
        error = task.errors(task.rk4_states(h))["error of F in newtons"][0]
        m.result.add("error of F in newtons", error, "N", peer="RK4, here", at=h)
