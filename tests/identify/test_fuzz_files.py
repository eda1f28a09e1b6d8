"""Files: written whole or not at all, whatever ends the writing; and refused if they are damaged, whatever the damage.

`pytest tests/identify/test_fuzz_files.py --hypothesis-profile=deep` draws many more examples than the suite does.
"""

import ast
import importlib.util
import random
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import scipy.io
from hypothesis import strategies as st

import jaxmodsim as jms
from jaxmodsim._core import system
from jaxmodsim._core.system import written_whole
from jaxmodsim.analysis import Row, WorkPrecision, load_work_precision
from jaxmodsim.cli import _output, _records
from jaxmodsim.identify import FitResult
from jaxmodsim.identify.uncertainty._estimate import FitDiagnostics, FitProvenance, ParameterEstimate
from jaxmodsim.plot import Figure

from ..helpers.fuzz import fuzz
from .test_how_sure import PARTS, same

PACKAGE = Path(jms.__file__).parent
T = np.linspace(0.0, 1.0, 9)


def fit_result() -> FitResult:
    """A result that no fit has found, with something of each kind in it."""
    record = jms.Record(T, {"x": np.sin(T), "f": T}, {"u": np.cos(T)}, "drive", noise={"x": 0.1})
    numbers = {"m": 2.0, "friction.Fc": 0.1 + 0.2}
    estimate = ParameterEstimate(
        values=numbers, start=numbers, units={"m": "kg", "friction.Fc": "N"}, covariance=np.diag([np.inf, 1e-6]),
        white=np.eye(2), information=np.eye(2), logarithmic=("m",), bounds={"m": (0.0, float("inf"))},
    )  # fmt: skip
    diagnostics = FitDiagnostics(
        rmse={"x": 0.1}, noise={"x": 0.1}, ending="converged", evaluations=3, starts=(1.0,),
        step_error={"x": 1e-3}, step_moves={"k": 0.25},
        single_precision=False, issues=(),
    )  # fmt: skip
    provenance = FitProvenance(
        records=(record,), outputs=({"x": np.sin(T)},), coordinates={"x": "q[0]"}, numbers={"m": np.asarray(2.0)},
        model=None,
    )  # fmt: skip
    return FitResult(estimate=estimate, diagnostics=diagnostics, provenance=provenance, search=None)


def same_result(a: FitResult, b: FitResult) -> bool:
    return all(same(vars(getattr(a, part)), vars(getattr(b, part))) for part in PARTS)


def work() -> WorkPrecision:
    row = Row("Rodas5P", 1e-6, None, "float64", "", 1e-7, warnings=("none",))
    return WorkPrecision(
        "box", "q[0]", "m", "at the end", 1.0, "two solvers", 1e-12, 0.0, 0.0, ("run",), 64, (row,), {"cpu": "x"}
    )


# How something is saved and loaded, and what tells whether it is the same.
KEPT: dict[str, tuple[Any, Callable[[Any, Path], None], Callable[[Path], Any], Callable[[Any, Any], bool]]] = {
    "fit": (fit_result(), lambda x, path: x.save(path), FitResult.load, same_result),
    "work": (work(), lambda x, path: x.save(path), load_work_precision, lambda a, b: a == b),
}


@pytest.mark.parametrize("kind", KEPT)
@pytest.mark.parametrize("step", [97])
def test_what_is_cut_off_is_refused(kind: str, step: int, tmp_path: Path) -> None:
    kept, save, load, _ = KEPT[kind]
    path = tmp_path / "kept"
    save(kept, path)
    whole = path.read_bytes()
    for length in {*range(0, len(whole), step), *range(max(len(whole) - 30, 0), len(whole) - 1)}:
        path.write_bytes(whole[:length])
        with pytest.raises(ValueError, match="kept"):
            load(path)


@pytest.mark.parametrize("kind", KEPT)
def test_damage_is_refused_or_does_not_matter(kind: str, tmp_path: Path) -> None:
    kept, save, load, equal = KEPT[kind]
    path = tmp_path / "kept"
    save(kept, path)
    whole = path.read_bytes()
    places = st.lists(st.tuples(st.floats(0.0, 1.0, exclude_max=True), st.integers(1, 255)), min_size=1, max_size=3)

    @fuzz(0.03, places)
    def check(damage: list[tuple[float, int]]) -> None:
        spoilt = bytearray(whole)
        for share, change in damage:
            spoilt[int(share * len(whole))] ^= change
        path.write_bytes(spoilt)
        words = "kept"
        try:
            assert equal(load(path), kept)
        except ValueError as refusal:
            words = str(refusal)
        assert "kept" in words, words

    check()


RECORD = pd.DataFrame({"t": T, "q": np.sin(T), "u": np.cos(T)})
RECORDS: dict[str, Callable[[Path], Any]] = {
    ".csv": lambda path: RECORD.to_csv(path, index=False),
    ".parquet": lambda path: RECORD.to_parquet(path),
    ".mat": lambda path: scipy.io.savemat(path, {name: RECORD[name].to_numpy() for name in RECORD}),
}


# Reading MATLAB's takes a process of its own.
@pytest.mark.parametrize(("ending", "share"), [(".csv", 0.02), (".parquet", 0.02), (".mat", 0.006)])
def test_damaged_records_are_records_or_refused(ending: str, share: float, tmp_path: Path) -> None:
    path = tmp_path / f"record{ending}"
    RECORDS[ending](path)
    whole = path.read_bytes()

    @fuzz(share, st.floats(0.0, 1.0), st.floats(0.0, 1.0, exclude_max=True), st.integers(0, 255))
    def check(length: float, place: float, change: int) -> None:
        spoilt = bytearray(whole)
        spoilt[int(place * len(whole))] ^= change
        path.write_bytes(spoilt if length < 0.5 else spoilt[: int((2 * length - 1) * len(whole))])
        words = "record"
        try:
            found = _records.read_record(path, _records.AxisColumns("t", "q", "u", {}))
            assert all(np.isfinite(part.measured).all() for part in found.parts)
        except ValueError as refusal:
            words = str(refusal)
        assert "record" in words, words

    check()


def test_a_table_of_a_head_alone_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "record.csv"
    path.write_text("t,q,u\n")
    with pytest.raises(ValueError, match=r"record: columns must have one shape .*'t' has \(0,\)"):
        _records.read_record(path, _records.AxisColumns("t", "q", "u", {}))


def test_a_record_that_would_end_the_process_that_reads_it(tmp_path: Path) -> None:
    """SciPy's reader of MATLAB's files follows a damaged length into memory that is not its own."""
    path = tmp_path / "record.mat"
    RECORDS[".mat"](path)
    spoilt = bytearray(path.read_bytes())
    spoilt[176] ^= 0xFF
    path.write_bytes(spoilt)
    with pytest.raises(ValueError, match=r"record.mat is damaged or not a MATLAB file: the reader crashes"):
        _records.read_record(path, _records.AxisColumns("t", "q", "u", {}))


@contextmanager
def full_disk(room: int) -> Iterator[None]:
    """No file may become larger than that [bytes]."""
    before, most = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (room, most))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (before, most))


def keep_bytes(path: Path, content: bytes) -> None:
    with written_whole(path) as file:
        file.write(content)


WRITERS: dict[str, Callable[[Path], Any]] = {
    "fit": lambda path: fit_result().save(path),
    "work": lambda path: work().save(path),
    "bytes": lambda path: keep_bytes(path, b"new" * 1000),
    "json": lambda path: _output.write(path.parent, {path.name: {"x": [1.0] * 1000}}),
    "text": lambda path: _output.write(path.parent, {path.name: "text " * 1000}),
    "table": lambda path: _output.write(path.parent, {path.name: pd.concat([RECORD] * 20)}),
    "figure": lambda path: _output.write(path.parent, {path.name: Figure()}),
    "result": lambda path: _output.write(path.parent, {path.name: fit_result()}),
}


@pytest.mark.parametrize("kind", WRITERS)
@pytest.mark.parametrize("room", [0, 300])
def test_a_full_disk_loses_nothing(kind: str, room: int, tmp_path: Path) -> None:
    path = tmp_path / "kept"
    path.write_bytes(b"old" * 50)
    with full_disk(room), pytest.raises(OSError, match="File too large"):
        WRITERS[kind](path)
    assert path.read_bytes() == b"old" * 50
    assert [x.name for x in tmp_path.iterdir()] == ["kept"]
    WRITERS[kind](path)
    assert path.read_bytes() != b"old" * 50


@pytest.mark.parametrize("kind", WRITERS)
def test_a_folder_that_cannot_be_written(kind: str, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(OSError, match="file"):
        WRITERS[kind](tmp_path / "file" / "kept")
    assert [x.name for x in tmp_path.iterdir()] == ["file"]


def test_what_was_begun_elsewhere_is_not_in_the_way(tmp_path: Path) -> None:
    """Nor what a killed process has left: in a container the next one may well have its number."""
    path = tmp_path / "kept"
    with written_whole(path) as file:
        file.write(b"first")
        keep_bytes(path, b"second")
        assert path.read_bytes() == b"second"
    assert path.read_bytes() == b"first"


def test_killed_while_it_writes(tmp_path: Path) -> None:
    """What was there last is there whole, at whatever moment the process ends."""
    path, draw = tmp_path / "kept", random.Random(3)
    module = Path(system.__file__)
    code = (
        "import importlib.util, itertools\n"
        f"spec = importlib.util.spec_from_file_location('files', {str(module)!r})\n"
        "files = importlib.util.module_from_spec(spec)\n"
        "spec.loader.exec_module(files)\n"
        "for i in itertools.count():\n"
        f"    with files.written_whole({str(path)!r}) as file:\n"
        "        for _ in range(50):\n"
        "            file.write(bytes([i % 256]) * 20_000)\n"
        "    print(i, flush=True)\n"
    )
    assert importlib.util.find_spec("jaxmodsim._core.system") is not None
    for _ in range(5):
        process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
        assert process.stdout is not None
        begun = process.stdout.readline()
        assert begun
        time.sleep(draw.uniform(0.0, 0.03))
        process.send_signal(signal.SIGKILL)
        process.communicate()
        assert process.returncode == -signal.SIGKILL
        content = path.read_bytes()
        assert len(content) == 1_000_000
        assert len(set(content)) == 1


def test_nothing_in_the_package_runs_what_a_file_says() -> None:
    """No pickle, eval or exec; cloudpickle to workers alone, and the Python file that a SPEC names by its user."""
    found = []
    for path in sorted(PACKAGE.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            where = path.relative_to(PACKAGE).as_posix()
            names = [x.name for x in node.names] if isinstance(node, ast.Import | ast.ImportFrom) else []
            if isinstance(node, ast.ImportFrom):
                names.append(node.module or "")
            called = getattr(node.func, "id", "") if isinstance(node, ast.Call) else ""
            word = getattr(node, "arg", "") if isinstance(node, ast.keyword) else ""
            if {"pickle", "dill", "marshal", "shelve", "joblib", "cloudpickle"} & {x.split(".")[0] for x in names}:
                found.append((where, "import"))
            if called in ("eval", "exec", "compile", "__import__"):
                found.append((where, called))
            if word == "allow_pickle":
                assert isinstance(node, ast.keyword)
                assert isinstance(node.value, ast.Constant)
                assert node.value.value is False, where
    assert found == [("cli/_sweep.py", "import")]
