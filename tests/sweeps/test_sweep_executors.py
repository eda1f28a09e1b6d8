"""Sweeps on more than one device, and in other processes, one of which is killed."""

import multiprocessing
import os
import re
import signal
import subprocess
import sys
import warnings
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr

import jaxmodsim as jms
from jaxmodsim.problems import ramped_box
from jaxmodsim.sweeps import SweepProgress

from ..helpers.optimized import optimized

SCENE = ramped_box.scene(ramped_box.lugre())
OVER = {"m": np.linspace(1.0, 3.0, 80), "friction.Fc": [1.2, 1.5, 1.7]}
CHUNK = 12


def box_sweep(**changes: Any) -> xr.Dataset:
    # A lambda, which only goes to other processes by value.
    observe = {"v": "qd[0]", "far": lambda run: run.q[-1, 0] > 1.0}
    return jms.sweep(SCENE, OVER, observe, **({"q0": [0.0], "qd0": [0.0], "t1": 3.0, "chunk": CHUNK} | changes))


@pytest.fixture(scope="module")
@optimized()  # as it is in the other processes
def found() -> xr.Dataset:
    return box_sweep()


def assert_same(one: xr.Dataset, other: xr.Dataset) -> None:
    np.testing.assert_array_equal(one["result"], 0)
    np.testing.assert_allclose(one["v"], other["v"], rtol=1e-12)
    np.testing.assert_array_equal(one["far"], other["far"])
    np.testing.assert_array_equal(one["num_steps"], other["num_steps"])


def test_two_devices(found: xr.Dataset, tmp_path: Path) -> None:
    """Two devices in one process are asked for before JAX starts, so in a process of its own."""
    script = (
        f"import sys; sys.path.insert(0, {str(Path(__file__).parents[2])!r})\n"
        "import jax; jax.config.update('jax_enable_x64', True)\n"
        "from tests.sweeps.test_sweep_executors import box_sweep\n"
        "assert jax.local_device_count() == 2\n"
        "import jaxmodsim.sweeps._compute as compute\n"
        "call, places = compute._call, set()\n"
        "def watched(run, fixed, numbers):\n"
        "    found = call(run, fixed, numbers)\n"
        "    places.update(found.code.devices())\n"
        "    return found\n"
        "compute._call = watched\n"
        f"found = box_sweep(out={str(tmp_path / 'two.zarr')!r})\n"
        "assert places == set(jax.devices()), places\n"
        "places.clear()\n"
        f"other = box_sweep(out={str(tmp_path / 'second.zarr')!r}, devices=jax.devices()[1:])\n"
        "assert places == {jax.devices()[1]}, places\n"
    )
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count=2"
    subprocess.run([sys.executable, "-c", script], check=True, env=os.environ | {"XLA_FLAGS": flags})
    for name in ("two", "second"):
        assert_same(xr.open_zarr(tmp_path / f"{name}.zarr", consolidated=False), found)


def test_an_executor_of_processes(found: xr.Dataset) -> None:
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as executor:
        assert_same(box_sweep(executor=executor), found)


def test_dask_runs_the_chunks_of_a_lost_worker_again(found: xr.Dataset, tmp_path: Path) -> None:
    distributed = pytest.importorskip("distributed")
    with (
        warnings.catch_warnings(),
        distributed.LocalCluster(
            n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None, local_directory=tmp_path
        ) as cluster,
        distributed.Client(cluster) as client,
    ):
        warnings.simplefilter("ignore")  # the cluster's own, of the worker it has lost
        killed: list[int] = []

        def kill(now: SweepProgress) -> None:
            if now.done >= 60 and not killed:
                worker = next(iter(cluster.workers.values()))
                killed.append(worker.pid)
                os.kill(worker.pid, signal.SIGKILL)

        again = box_sweep(executor=client, progress=kill, out=tmp_path / "store.zarr")
        assert killed
        assert_same(again, found)


def test_the_script_of_the_page_runs_as_it_stands(tmp_path: Path) -> None:
    """With fewer runs."""
    pytest.importorskip("distributed")
    page = (Path(__file__).parents[2] / "docs" / "howto" / "cluster.md").read_text()
    script = re.search(r"```python\n(.*?)```", page, re.DOTALL)
    assert script is not None
    assert script[1].count(", 100)") == 2
    (tmp_path / "sweep_belt.py").write_text(script[1].replace(", 100)", ", 3)"))
    command = [sys.executable, "sweep_belt.py"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True, timeout=300)
    assert done.stdout.splitlines()[-1].endswith(" m/s")
    assert xr.open_zarr(tmp_path / "belt.zarr", consolidated=False)["peak"].shape == (3, 3)
