"""Results in a store: written chunk by chunk, gone on with after any end, and never mixed with others."""

import filecmp
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
import xarray as xr

import jaxmodsim as jms
from jaxmodsim.problems import ramped_box
from jaxmodsim.sweeps import SweepProgress

# A function that compiles at once, and a grid of 10 x 13 chunks.
OVER = {"a": np.arange(1.0, 41.0), "b": np.linspace(0.0, 1.0, 26)}
CHUNK = 8


def curve(a: Any, b: Any) -> dict[str, Any]:
    return {"power": a**b, "waves": jnp.sin(a * jnp.linspace(0.0, 1.0, 3)) + b}


def store(out: Path, **changes: Any) -> xr.Dataset:
    return jms.sweep(curve, **({"over": OVER, "chunk": CHUNK, "out": out} | changes))


def files_of(folder: Path) -> list[Path]:
    return sorted(path.relative_to(folder) for path in folder.rglob("*") if path.is_file())


def assert_same_bytes(one: Path, other: Path) -> None:
    assert files_of(one) == files_of(other)
    same, different, unread = filecmp.cmpfiles(one, other, [str(x) for x in files_of(one)], shallow=False)
    assert same
    assert not different
    assert not unread


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("whole") / "store.zarr"
    store(path)
    return path


def stop_after(runs: int) -> Any:
    def stop(now: SweepProgress) -> None:
        if now.done >= runs:
            raise KeyboardInterrupt

    return stop


def test_a_store_holds_what_memory_would(whole: Path) -> None:
    stored, kept = xr.open_zarr(whole, consolidated=False), jms.sweep(curve, OVER)
    xr.testing.assert_equal(stored.drop_attrs().load(), kept.drop_attrs())
    assert stored["power"].dims == ("a", "b")
    assert stored["result"].attrs["flag_meanings"] == kept["result"].attrs["flag_meanings"]
    assert stored.attrs["system"] == "curve"
    assert list(store(whole).data_vars) == ["power", "waves", "num_steps", "result"]


def test_numbers_that_change_together_are_coordinates_of_a_store(tmp_path: Path) -> None:
    over = {"sample": {"a": [1.0, 2.0, 4.0], "b": [0.0, 0.5, 1.0]}}
    stored, kept = store(tmp_path / "store.zarr", over=over), jms.sweep(curve, over)
    xr.testing.assert_identical(stored.load().drop_attrs(), kept.drop_attrs())
    assert set(stored.coords) == {"a", "b"}


def test_an_interrupted_sweep_goes_on(whole: Path, tmp_path: Path) -> None:
    out = tmp_path / "store.zarr"
    for runs in (100, 500):
        with pytest.raises(KeyboardInterrupt, match="call sweep again"):
            store(out, progress=stop_after(runs))
    partly = xr.open_zarr(out, consolidated=False)["result"].values
    assert 500 <= (partly == 0).sum() < 1040
    assert (partly[partly != 0] == -1).all()
    begun: list[int] = []
    store(out, progress=lambda now: begun.append(now.done))
    assert begun[0] == (partly == 0).sum()
    assert_same_bytes(out, whole)


def test_a_finished_sweep_is_not_run_again(whole: Path) -> None:
    before = {path: (whole / path).stat().st_mtime_ns for path in files_of(whole)}
    seen: list[SweepProgress] = []
    store(whole, progress=seen.append)
    assert [now.done for now in seen] == [1040]
    assert before == {path: (whole / path).stat().st_mtime_ns for path in files_of(whole)}


def test_killed_at_random_moments(whole: Path, tmp_path: Path) -> None:
    """Also in the middle of a file: a store is the same to the last bit however often its process was killed."""
    out, draw, killed = tmp_path / "store.zarr", random.Random(5), 0
    code = (
        f"import sys; sys.path.insert(0, {str(Path(__file__).parents[2])!r})\n"
        "import jax; jax.config.update('jax_enable_x64', True)\n"
        "from pathlib import Path\n"
        "from tests.sweeps.test_sweep_store import store\n"
        f"store(Path({str(out)!r}), progress=lambda now: print(now.done, flush=True))\n"
    )
    for _ in range(4):
        process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
        assert process.stdout is not None
        begun = process.stdout.readline()  # the sweep has begun
        assert begun
        time.sleep(draw.uniform(0.0, 0.15))
        process.send_signal(signal.SIGKILL)
        process.stdout.close()
        killed += process.wait() == -signal.SIGKILL
    assert killed >= 2
    store(out)
    assert_same_bytes(out, whole)


def test_what_a_killed_process_leaves_is_cleared(whole: Path, tmp_path: Path) -> None:
    """A file half written, and a chunk whose last variable is missing."""
    out = tmp_path / "store.zarr"
    store(out)
    (out / "power" / "c" / "0" / "0.0123.partial").write_bytes(b"half")
    (out / "result" / "c" / "3" / "1").unlink()
    (out / "power" / "c" / "3" / "1").write_bytes((out / "power" / "c" / "0" / "0").read_bytes())
    store(out)
    assert_same_bytes(out, whole)


def other_curve(a: Any, b: Any) -> dict[str, Any]:
    return {"power": a**b * 1.5, "waves": jnp.sin(a * jnp.linspace(0.0, 1.0, 3)) + b}


def test_results_of_something_else_are_refused(whole: Path, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"over: b was .* is "):
        store(whole, over=OVER | {"b": np.linspace(0.0, 2.0, 26)})
    with pytest.raises(ValueError, match=r"chunks was \[1, 7\], is \[1, 13\]"):
        store(whole, chunk=13)
    with pytest.raises(ValueError, match="the code of the scene, the observables, or this library has changed"):
        jms.sweep(other_curve, OVER, chunk=CHUNK, out=whole)
    (tmp_path / "notes").mkdir()
    (tmp_path / "notes" / "a.txt").write_text("mine")
    for path in (tmp_path / "notes", tmp_path / "notes" / "a.txt"):
        with pytest.raises(ValueError, match="is not a store of a sweep"):
            store(path)
    assert (tmp_path / "notes" / "a.txt").read_text() == "mine"


def test_another_scene_is_refused_by_its_number(tmp_path: Path) -> None:
    given: dict[str, Any] = {"q0": [0.0], "qd0": [0.0], "t1": 0.1, "out": tmp_path / "box.zarr"}
    jms.sweep(ramped_box.scene(ramped_box.lugre()), {"m": [1.0, 2.0]}, ["q[0]"], **given)
    with pytest.raises(ValueError, match=r"numbers: friction.Fc was 1.5, is 1.4; .*rtol.* was 1e-06, is 1e-07"):
        jms.sweep(ramped_box.scene(ramped_box.lugre(Fc=1.4)), {"m": [1.0, 2.0]}, ["q[0]"], rtol=1e-7, **given)


def test_a_folder_that_cannot_be_written(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(OSError, match="file"):
        store(tmp_path / "file" / "store.zarr")


def test_a_disk_that_is_full_loses_nothing(whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out, replace = tmp_path / "store.zarr", os.replace
    written = 0

    def full(self: Path, target: Any) -> Any:
        nonlocal written
        written += 1
        if written > 300:
            raise OSError(28, "No space left on device")
        return replace(self, target)

    with monkeypatch.context() as patch:
        patch.setattr(Path, "replace", full)
        with pytest.raises(OSError, match="No space left"):
            store(out)
    done = int((xr.open_zarr(out, consolidated=False)["result"] == 0).sum())
    assert 0 < done < 1040
    begun: list[int] = []
    store(out, progress=lambda now: begun.append(now.done))
    assert begun[0] == done
    assert_same_bytes(out, whole)


def test_a_damaged_chunk_is_refused(tmp_path: Path) -> None:
    """No other numbers come out of it, wherever it is damaged."""
    out = tmp_path / "store.zarr"
    store(out)
    chunk = out / "power" / "c" / "0" / "0"
    whole = chunk.read_bytes()
    for place in range(0, len(whole), len(whole) // 6):
        chunk.write_bytes(whole[:place] + bytes([whole[place] ^ 0x10]) + whole[place + 1 :])
        with pytest.raises(ValueError, match="checksum"):
            xr.open_zarr(out, consolidated=False)["power"][0, 0].load()
    chunk.write_bytes(whole)
    assert float(xr.open_zarr(out, consolidated=False)["power"][0, 0]) == 1.0
    chunk = out / "result" / "c" / "0" / "0"
    chunk.write_bytes(chunk.read_bytes()[:-1])
    with pytest.raises(ValueError, match=r"store.zarr is damaged: chunk 0 of result cannot be read .* Remove its file"):
        store(out)
    chunk.unlink()
    store(out)
