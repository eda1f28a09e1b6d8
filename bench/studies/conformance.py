"""Public cases of others: published figures, references, our values and derivatives; and the same in other programs."""

import re
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np

import jaxmodsim as jms
from bench.conformance import gradients, impacts, peers, relays, rotational, translational
from bench.conformance.case import Case, same_order
from bench.record import Result, importable, timed

CASES = {case.name: case for each in (rotational, translational, impacts, relays, gradients) for case in each.CASES}
SMOKE = ("Translational.Brake", "diff_sim_grads task1")
TASK1 = {"y": -1.0, "vy": -0.99559, "u": -0.0020698}  # the convex method of DiffCoSim, of nine methods the one in print


def main(smoke: bool, out: Path) -> Result:
    """Measure all cases, the optima of two tasks, and work against precision of five cases."""
    del out
    least = f"{gradients.least_loss():.10f}"
    result = Result("conformance", ("mujoco", "casadi", "scipy", "numpy"), {"least": least})
    for name in SMOKE if smoke else CASES:
        _case(result, CASES[name])
        jax.clear_caches()
    if not smoke:
        _optima(result)
    names = ("diff_sim_grads task1",) if smoke else tuple(peers.PEERS)
    for name in names:
        _work(result, CASES[name], (1e-6,) if smoke else (1e-4, 1e-6, 1e-8, 1e-10), smoke)
    return result


def _case(result: Result, case: Case) -> None:
    """Add the rows of a case."""
    about = {"case": case.name}
    result.add("source", case.source, **about)
    result.add("published results", case.results or None, **about)
    result.add("remark", case.note or None, **about)
    exact = case.exact()
    values = np.asarray(exact.values, float)
    published = [np.nan if x is None else x for x in case.published] or [np.nan] * len(values)
    if case.published:
        result.add("error of the published values", float(np.nanmax(np.abs(published - values))), **about)
    for output, there, value in zip(case.outputs, published, values, strict=True):
        result.add("published", None if np.isnan(there) else f"{there:.12g}", at=output, **about)
        result.add("reference", f"{value:.14g}", at=output, **about)
    try:
        ours = case.ours()
    except Exception as error:  # a case that fails is a result
        reason = re.sub(r"\s+", " ", str(error)).partition(":")[0]
        result.add("error of ours", f"failed: {reason}", **about)
        return
    result.add("error of ours", float(np.max(np.abs(ours.values - values))), **about)
    for output, value in zip(case.outputs, ours.values, strict=True):
        result.add("ours", f"{value:.14g}", at=output, **about)
    if exact.events:
        late = same_order(exact.events, ours.events)
        same = len(exact.events) == len(ours.events)
        result.add("error of event times in seconds", "failed: another order" if late is None else late, **about)
        result.add("events", f"{len(exact.events)}" + ("" if same else f" of {len(ours.events)}"), **about)
    if case.modes:
        late = same_order(case.modes, ours.events)
        result.add(
            "published modes", "failed: another order" if late is None else f"{len(case.modes)} in order", **about
        )
    if ours.derivatives is not None:
        slopes = case.exact_derivatives()
        error = float(np.max(np.abs(ours.derivatives - slopes)) / np.max(np.abs(slopes)))
        result.add("error of derivatives", error, **about)
        for name, row, own in zip(case.by, slopes, ours.derivatives, strict=True):
            at = f"d {case.outputs[0].partition(' [')[0]} / d {name}"
            result.add("difference of the reference", f"{row[0]:.9g}", at=at, **about)
            result.add("our derivative", f"{own[0]:.9g}", at=at, **about)
        result.add("run with derivatives", ours.seconds, "s", **about)


def _optima(result: Result) -> None:
    """Add what the tasks of differentiable simulators end with."""
    exact = CASES["diff_sim_grads task1"].exact_derivatives()[:, 0]
    for (name, value), right in zip(TASK1.items(), exact, strict=True):
        result.add("derivative", value, peer="convex (DiffCoSim)", case="task 1", at=name)
        result.add("derivative", float(right), peer="exact", case="task 1", at=name)
    least = gradients.least_loss()
    for name, loss in gradients.TASK3_LOSSES.items():
        result.add("loss", loss, peer=name, case="task 3")
        result.add("loss above the least", loss - least, peer=name, case="task 3")
    for name, velocity in gradients.TASK2_VELOCITIES.items():
        end = gradients.exact_end(-0.5, 1.0, *velocity, 0.92)
        miss = float(np.hypot(end[0] + 2.0, end[1] - 1.5))
        result.add("distance from the target", miss, "m", peer=name, case="task 2")
    velocity, count = gradients.target_velocity()
    end = gradients.exact_end(-0.5, 1.0, *velocity, 0.92)
    result.add("distance from the target", float(np.hypot(end[0] + 2.0, end[1] - 1.5)), "m", case="task 2")
    result.add("runs", count, case="task 2")
    loss, count = gradients.optimal_control()
    result.add("loss", loss, case="task 3")
    result.add("loss above the least", loss - least, case="task 3")
    result.add("runs", count, case="task 3")


def _work(result: Result, case: Case, ladder: tuple[float, ...], smoke: bool) -> None:
    """Add errors and times of one run of a case in each program."""
    exact = np.asarray(case.exact().values, float)
    by_scipy, by_mujoco = peers.PEERS[case.name]
    setup = case.make({name: jax.numpy.asarray(float(value)) for name, value in case.numbers.items()})
    ratio = 1e-4 if "lugre" in case.name else 1e-2
    runs: dict[tuple[str, float], Any] = {}

    def ours(rtol: float) -> np.ndarray:
        run = jms.simulate(*setup, case.t1, rtol=rtol, atol=ratio * rtol)
        return np.array([float(x) for x in case.observe(run.q[-1], run.qd[-1])])

    methods = ("LSODA",) if "lugre" in case.name else ("RK45", "DOP853")
    for rtol in ladder:
        runs["jaxmodsim", rtol] = partial(ours, rtol)
        runs |= {(f"SciPy {method}", rtol): partial(by_scipy(method), rtol) for method in methods}
    if "lugre" in case.name:
        made = importable(result, {"CVODES (CasADi)": peers.cvodes_lugre})
        runs |= {(name, rtol): partial(run, rtol) for name, run in made.items() for rtol in ladder}
    if by_mujoco is not None:
        steps = (1e-3,) if smoke else (1e-3, 1e-4, 1e-5)
        made = importable(result, {"MuJoCo": lambda: [by_mujoco(step) for step in steps]})
        runs |= {("MuJoCo", step): run for step, run in zip(steps, made.get("MuJoCo", ()), strict=False)}
    for (peer, at), run in runs.items():
        result.add("error", float(np.max(np.abs(run() - exact))), case=case.name, peer=peer, at=at)
    for (peer, at), found in timed(runs, 1 if smoke else 7, limit_s=5.0).items():
        result.add_time("run", found, case=case.name, peer=peer, at=at)
