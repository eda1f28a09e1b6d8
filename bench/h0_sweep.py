"""Many runs of the LuGre testbench: `sweep` on both cores, CVODES in two processes, Kvaerno5 under plain `vmap`.

Every solver gets the loosest tolerance at which the velocity of the nominal run stays within 1e-6 of the reference. All
run the same sets of parameters. Measured besides: one core against all, a store, a lane that never ends among 10 000
others, a million runs and the memory they take, and a store whose process is killed again and again.

    python bench/h0_sweep.py [--smoke] [--out DIR]
"""

import concurrent.futures as cf
import filecmp
import json
import multiprocessing
import os
import random
import resource
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np
from _ladder import half_decades, loosest
from _lugre import (
    CVODES,
    KVAERNO5,
    LOOP,
    OBSERVE,
    OURS,
    TESTBENCH,
    VMAP,
    Peer,
    error_ladder,
    parameter_sets,
    peers,
    reference_solution,
    run_sweep,
    testbench,
)
from _measure import machine_line, measure, scaled
from _options import begin
from _report import new_result, target_rows, write_result
from _workload import numpy_workload_s

import jaxmodsim as jms
from jaxmodsim.problems import box_lugre, ramped_box

GOAL = 1e-6
LADDER = half_decades(-3, -8)


def main() -> None:
    """Measure, and write `sweep.json`."""
    options = begin("Sweeps, measured side by side.")
    smoke = options.smoke
    reference, _ = reference_solution()
    solvers = {peer.name: peer for peer in peers(only=(OURS, KVAERNO5, CVODES))}
    rtol = {name: _loosest(peer, reference) for name, peer in solvers.items()}
    print("tolerances", rtol)
    content = new_result("sweep", options, "diffrax", "casadi", "xarray", "zarr", "numpy") | {
        "rtol": rtol,
        "side_by_side": _side_by_side(solvers, rtol, 64 if smoke else 4096, 1 if smoke else 5),
        "cores": _cores(rtol[OURS], 512 if smoke else 65536, 1 if smoke else 5),
        "spread": _spread(rtol[OURS], 1100 if smoke else 16384, 1 if smoke else 3),
        "one_lane_that_never_ends": _one_bad_lane(rtol[OURS], 256 if smoke else 10_000, 1 if smoke else 7),
        "million": _million(2000 if smoke else 1_000_000),
        "killed": _killed(rtol[OURS], 1 if smoke else 20),
    }
    content["tables"] = [_table(content), _target_table(content)]
    write_result(content, options)


def _loosest(peer: Peer, reference: np.ndarray) -> float:
    row = loosest(error_ladder(peer, reference, LADDER), "v_run", GOAL)
    assert row is not None, f"{peer.name} does not reach {GOAL:g}"
    return row["rtol"]


def cvodes_velocities(rtol: float, sets: np.ndarray) -> np.ndarray:
    """End velocities by CVODES, one after another; run in a process of its own."""
    return peers(only=(CVODES,))[0].many[LOOP](rtol, sets)()


def _side_by_side(solvers: dict[str, Peer], rtol: dict[str, float], count: int, rounds: int) -> dict[str, Any]:
    """The same runs by all; CVODES in as many processes as there are cores, started and warmed before."""
    sets, cores = parameter_sets(count), os.cpu_count() or 1
    with cf.ProcessPoolExecutor(cores, multiprocessing.get_context("spawn")) as pool:
        parts = np.array_split(sets, 4 * cores)
        list(pool.map(cvodes_velocities, [1e-3] * cores, [sets[:2]] * cores))
        kvaerno = solvers[KVAERNO5].many[VMAP](rtol[KVAERNO5], sets)
        calls = {
            OURS: lambda: run_sweep(sets, rtol[OURS])["v"].values,
            f"{OURS}, plain vmap": solvers[OURS].many[VMAP](rtol[OURS], sets),
            f"{CVODES}, {cores} processes": lambda: np.concatenate(
                list(pool.map(cvodes_velocities, [rtol[CVODES]] * len(parts), parts))
            ),
            f"{KVAERNO5}, plain vmap": lambda: np.asarray(kvaerno()),
        }
        report = {name: scaled(row, count) for name, row in measure(calls, rounds, limit_s=60.0).items()}
        tight = run_sweep(sets, 1e-11)["v"].values
        for name, call in calls.items():
            report[name]["largest_relative_error"] = float(np.max(np.abs(np.asarray(call()) / tight - 1.0)))
    return report


def _cores(rtol: float, count: int, rounds: int) -> dict[str, Any]:
    """One core against all of them: threads take over the affinity of the thread that starts them."""
    sets, everywhere = parameter_sets(count), os.sched_getaffinity(0)

    def on(cores: set[int]) -> Any:
        os.sched_setaffinity(0, cores)
        try:
            return run_sweep(sets, rtol)
        finally:
            os.sched_setaffinity(0, everywhere)

    with tempfile.TemporaryDirectory() as folder:
        fresh = iter(range(1_000_000))
        calls = {
            "one core": lambda: on({min(everywhere)}),
            "all cores": lambda: on(everywhere),
            "all cores, into a store": lambda: run_sweep(sets, rtol, out=Path(folder) / str(next(fresh))),
        }
        report = {name: scaled(row, count) for name, row in measure(calls, rounds, limit_s=120.0).items()}
    scaling = report["one core"]["median_s"] / report["all cores"]["median_s"]
    return report | {"scaling": scaling, "scaling_of_the_machine": _scaling_of_the_machine()}


def _scaling_of_the_machine() -> float:
    """What processes that share nothing gain from all cores: on shared machines less than the number of them."""
    cores, found = os.cpu_count() or 1, []
    with cf.ProcessPoolExecutor(cores, multiprocessing.get_context("spawn")) as pool:
        list(pool.map(numpy_workload_s, [1] * cores))
        for _ in range(5):
            one = pool.submit(numpy_workload_s).result()
            found.append(cores * one / statistics.mean(pool.map(numpy_workload_s, [25] * cores)))
    return statistics.median(found)


def _spread(rtol: float, count: int, rounds: int) -> dict[str, Any]:
    """Lanes of very different numbers of steps: stiffness over four decades, speeds over two."""
    ranges = {"sigma0": (1e2, 1e6), "sigma1": (0.1, 1e2), "vs": (1e-3, 0.2)}
    drawn = np.random.default_rng(1).uniform(size=(len(ranges), count))
    sets = {f"friction.{n}": a * (b / a) ** u for (n, (a, b)), u in zip(ranges.items(), drawn, strict=True)}
    tolerance = {"rtol": rtol, "atol": TESTBENCH.atol * rtol}
    start: dict[str, Any] = {"q0": [0.0], "qd0": [0.0], "t1": TESTBENCH.t1, **tolerance}

    def run() -> Any:
        return jms.sweep(testbench(), {"set": sets}, OBSERVE, **start)

    def lane(values: Any) -> Any:
        scene = ramped_box(box_lugre(**{name.split(".")[1]: x for name, x in values.items()}))
        return jms.simulate(scene, throw=False, **start).qd[-1, 0]

    plain = jax.jit(jax.vmap(lane))  # all at once, as one would write it by hand
    calls = {"sweep": run, "plain vmap": lambda: plain(sets).block_until_ready()}
    report = {name: scaled(row, count) for name, row in measure(calls, rounds, limit_s=120.0).items()}
    steps = run()["num_steps"].values
    return report | {"steps": [int(x) for x in np.quantile(steps, [0.0, 0.1, 0.5, 0.9, 1.0])]}


def _one_bad_lane(rtol: float, count: int, rounds: int) -> dict[str, Any]:
    """All lanes well, and one whose tolerance drives it into the step limit."""
    sets, well = parameter_sets(count), np.full(count, rtol)
    bad = np.where(np.arange(count) == count // 3, 1e-18, rtol)
    calls = {"without": lambda: run_sweep(sets, well), "with": lambda: run_sweep(sets, bad)}
    report: dict[str, Any] = dict(measure(calls, rounds, limit_s=120.0))
    ended = run_sweep(sets, bad)
    failed, longest = int((ended["result"] != 0).sum()), int(ended["num_steps"].max())
    if (failed, longest) != (1, 16384):
        raise AssertionError(f"{failed} lanes failed, the longest run took {longest} steps.")
    return report | {"ratio": report["with"]["median_s"] / report["without"]["median_s"]}


def _million(count: int) -> dict[str, Any]:
    """A process of its own runs them into a store; its peak memory is the kernel's word."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, __file__, "--alone", str(count), "1e-5", str(Path(folder) / "store.zarr")]
        done = subprocess.run(command, check=True, capture_output=True, text=True)
    return json.loads(done.stdout.splitlines()[-1])


def alone(count: int, rtol: float, out: Path) -> None:
    """A sweep into a store, in a process of its own; says each chunk, and at the end what it took."""
    jms.tune_cpu()
    jax.config.update("jax_enable_x64", True)
    sets = parameter_sets(count)
    run_sweep(sets[:2048], rtol)  # compiles
    start = time.perf_counter()
    found = run_sweep(sets, rtol, out=out, progress=lambda now: print(now.done, flush=True))
    seconds = time.perf_counter() - start
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    failed = int((found["result"] != 0).sum())
    print(json.dumps({"runs": count, "seconds": seconds, "peak_bytes": peak, "failed": failed}))


def _killed(rtol: float, times: int) -> dict[str, Any]:
    """A sweep whose process is killed at random moments, and begun again each time; against one that was not."""
    draw, kills = random.Random(7), 0
    with tempfile.TemporaryDirectory() as folder:
        whole, broken = Path(folder) / "whole.zarr", Path(folder) / "broken.zarr"
        command = [sys.executable, __file__, "--alone", "100000", str(rtol)]
        subprocess.run([*command, str(whole)], check=True, stdout=subprocess.DEVNULL)
        while kills < times:
            process = subprocess.Popen([*command, str(broken)], stdout=subprocess.PIPE)
            assert process.stdout is not None
            process.stdout.readline()  # chunks are about to be written
            time.sleep(draw.uniform(0.0, 0.05))
            process.send_signal(signal.SIGKILL)
            if process.wait() != -signal.SIGKILL:
                raise AssertionError(f"The sweep ended before it was killed, after {kills} times.")
            kills += 1
        subprocess.run([*command, str(broken)], check=True, stdout=subprocess.DEVNULL)
        names = sorted(str(x.relative_to(whole)) for x in whole.rglob("*") if x.is_file())
        others = sorted(str(x.relative_to(broken)) for x in broken.rglob("*") if x.is_file())
        same = filecmp.cmpfiles(whole, broken, names, shallow=False)
    return {"kills": kills, "files": len(names), "same": names == others and not same[1] and not same[2]}


def _table(content: dict[str, Any]) -> dict[str, Any]:
    rows = []
    for name, row in content["side_by_side"].items():
        rtol = content["rtol"][next(each for each in content["rtol"] if name.startswith(each))]
        runs = f"{1.0 / row['median_s']:,.0f}"
        rows.append([name, f"{rtol:.0e}", f"{row['median_s'] * 1e6:.3g}", runs, f"{row['largest_relative_error']:.1e}"])
    count = content["side_by_side"][OURS]["runs_per_call"]
    return {
        "caption": f"{count} runs of the LuGre testbench with different parameters, 10 s each, all in turns; error of"
        " the end velocity. Tolerances: the loosest at which the nominal run stays within 1e-6. With"
        f" `jaxmodsim.tune_cpu()`. {machine_line(content['machine'])}",
        "columns": ["program", "rtol", "per run [us]", "runs per second", "largest relative error"],
        "rows": rows,
    }


def _target_table(content: dict[str, Any]) -> dict[str, Any]:
    side, cores, million, killed = (content[name] for name in ("side_by_side", "cores", "million", "killed"))
    spread, bad = content["spread"], content["one_lane_that_never_ends"]

    def against(name: str) -> float:
        return next(row for each, row in side.items() if each.startswith(name))["median_s"] / side[OURS]["median_s"]

    store = cores["all cores, into a store"]["median_s"] / cores["all cores"]["median_s"]
    plain = spread["plain vmap"]["median_s"] / spread["sweep"]["median_s"]
    found = [
        ("against CVODES on all cores", ">= 60", against(CVODES)),
        ("against Kvaerno5 under plain `vmap`", ">= 100", against(KVAERNO5)),
        ("against our own solver under plain `vmap`", "", against(f"{OURS}, plain")),
        (f"the same, runs of {spread['steps'][0]} to {spread['steps'][-1]} steps", "", plain),
        ("one core, to all cores", ">= 1.7", cores["scaling"]),
        ("the same of processes of NumPy that share nothing", "", cores["scaling_of_the_machine"]),
        ("into a store, to in memory", "", store),
        ("one lane of 10 000 that never ends, to none", "< 2", bad["ratio"]),
        (f"{million['runs']:,} runs into a store: runs per second", "", million["runs"] / million["seconds"]),
        ("the same: peak memory [GiB]", "< 2", million["peak_bytes"] / 2**30),
        (f"killed {killed['kills']} times: the same store, bit for bit", ">= 1", float(killed["same"])),
    ]
    return {
        "caption": f"Targets on sweeps. {machine_line(content['machine'])}",
        "columns": ["ratio of times, unless said", "target", "measured", "met"],
        "rows": target_rows(found),
    }


if __name__ == "__main__":
    if sys.argv[1:2] == ["--alone"]:
        alone(int(sys.argv[2]), float(sys.argv[3]), Path(sys.argv[4]))
    else:
        main()
