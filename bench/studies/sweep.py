"""Many runs of the LuGre testbench: `sweep` on all cores, CVODES in as many processes, Kvaerno5 under plain `vmap`.

Every solver has the loosest tolerance at which the velocity of the nominal run stays within 1e-6 of the reference. All
run the same sets of parameters. Further measures are a million runs into a store with their memory, and a store whose
process is killed repeatedly.
"""

import concurrent.futures as cf
import filecmp
import json
import multiprocessing
import os
import random
import resource
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np

import jaxmodsim as jms
from bench.cases import half_decades
from bench.peers import CVODES, KVAERNO5, LOOP, VMAP, Peer, makers, run_sweep
from bench.record import OURS, Result, importable, timed
from bench.tasks import TESTBENCH

GOAL = 1e-6


def main(smoke: bool, out: Path) -> Result:
    """Run all parts; a smoke run omits the slow peers."""
    del out
    result = Result("sweep", ("diffrax", "casadi", "xarray", "zarr", "numpy"), {"t1": TESTBENCH.t1})
    wanted = (OURS,) if smoke else (OURS, KVAERNO5, CVODES)
    peers = importable(result, {name: make for name, make in makers(TESTBENCH).items() if name in wanted})
    rtol = {name: _loosest(peer) for name, peer in peers.items()}
    _side_by_side(result, peers, rtol, 64 if smoke else 4096, 1 if smoke else 5)
    _million(result, 500 if smoke else 1_000_000)
    if not smoke:
        _killed(result, rtol[OURS], 20)
    return result


def _loosest(peer: Peer) -> float:
    ladder = half_decades(-3, -8)
    return next(rtol for rtol in ladder if TESTBENCH.errors(peer.record(rtol)[0])["error of v"][0] <= GOAL)


def cvodes_velocities(rtol: float, sets: np.ndarray) -> np.ndarray:
    """End velocities by CVODES, one after another, in a separate process."""
    return makers(TESTBENCH)[CVODES]().many[LOOP](rtol, sets)()


def _side_by_side(result: Result, peers: dict[str, Peer], rtol: dict[str, float], count: int, rounds: int) -> None:
    """Time the same runs by all; CVODES has a warm process for each core."""
    sets, cores = TESTBENCH.sets(count), os.cpu_count() or 1
    result.settings["runs"] = count
    with cf.ProcessPoolExecutor(cores, multiprocessing.get_context("spawn")) as pool:
        calls: dict[tuple[str, str], Any] = {
            (OURS, "sweep"): lambda: run_sweep(TESTBENCH, sets, rtol[OURS])["v"].values
        }
        for name in set(peers) - {CVODES}:
            calls[name, "plain vmap"] = peers[name].many[VMAP](rtol[name], sets)
        if CVODES in peers:
            parts = np.array_split(sets, 4 * cores)
            list(pool.map(cvodes_velocities, [1e-3] * cores, [sets[:2]] * cores))
            calls[CVODES, f"{cores} processes"] = lambda: np.concatenate(
                list(pool.map(cvodes_velocities, [rtol[CVODES]] * len(parts), parts))
            )
        tight = run_sweep(TESTBENCH, sets, 1e-11)["v"].values
        for (name, way), found in timed(calls, rounds, per=count, limit_s=60.0).items():
            result.add_time("run", found, peer=name, at=way)
            error = float(np.max(np.abs(np.asarray(calls[name, way]()) / tight - 1.0)))
            result.add("error", error, peer=name, at=way)
            result.add("rtol", rtol[name], peer=name, at=way)


def _command(count: int, rtol: float, store: Path) -> list[str]:
    return [sys.executable, "-m", "bench.studies.sweep", str(count), str(rtol), str(store)]


def _million(result: Result, count: int) -> None:
    """Run into a store in a separate process, and record its peak memory from the kernel."""
    with tempfile.TemporaryDirectory() as folder:
        command = _command(count, 1e-5, Path(folder) / "store.zarr")
        done = subprocess.run(command, check=True, capture_output=True, text=True)
    found = json.loads(done.stdout.splitlines()[-1])
    result.settings["many"] = count
    result.add("many runs into a store", found["seconds"], "s")
    result.add("peak memory of many runs", found["peak_bytes"], "B")


def into_store(count: int, rtol: float, store: Path) -> None:
    """A sweep into a store, in a separate process, which prints each chunk and finally its time."""
    jms.tune_cpu()
    jax.config.update("jax_enable_x64", True)
    sets = TESTBENCH.sets(count)
    run_sweep(TESTBENCH, sets[:2048], rtol)  # compiles
    start = time.perf_counter()
    run_sweep(TESTBENCH, sets, rtol, out=store, progress=lambda now: print(now.done, flush=True))
    seconds = time.perf_counter() - start
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    print(json.dumps({"seconds": seconds, "peak_bytes": peak}))


def _killed(result: Result, rtol: float, times: int) -> None:
    """Compare a sweep whose process is killed and restarted at random times with an undisturbed one."""
    draw = random.Random(7)
    with tempfile.TemporaryDirectory() as folder:
        whole, broken = Path(folder) / "whole.zarr", Path(folder) / "broken.zarr"
        subprocess.run(_command(100_000, rtol, whole), check=True, stdout=subprocess.DEVNULL)
        for kill in range(times):
            process = subprocess.Popen(_command(100_000, rtol, broken), stdout=subprocess.PIPE)
            assert process.stdout is not None
            process.stdout.readline()  # chunks are about to be written
            time.sleep(draw.uniform(0.0, 0.05))
            process.send_signal(signal.SIGKILL)
            if process.wait() != -signal.SIGKILL:
                raise AssertionError(f"The sweep ended before it was killed, after {kill} times.")
        subprocess.run(_command(100_000, rtol, broken), check=True, stdout=subprocess.DEVNULL)
        names = sorted(str(x.relative_to(whole)) for x in whole.rglob("*") if x.is_file())
        others = sorted(str(x.relative_to(broken)) for x in broken.rglob("*") if x.is_file())
        same = filecmp.cmpfiles(whole, broken, names, shallow=False)
    result.settings["kills"] = times
    result.add("same store after kills", int(names == others and not same[1] and not same[2]))


if __name__ == "__main__":
    into_store(int(sys.argv[1]), float(sys.argv[2]), Path(sys.argv[3]))
