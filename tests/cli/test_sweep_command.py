"""`jaxmodsim sweep`, as a user meets it: what it runs, what it keeps, how it refuses."""

import re
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr

import jaxmodsim as jms
from jaxmodsim.cli import _sweep
from jaxmodsim.cli._spec import Reduced, read_sweep_spec
from jaxmodsim.cli._toml import PROBLEMS, known_laws
from jaxmodsim.plot import map2d
from jaxmodsim.problems import belt_oscillator
from jaxmodsim.sweeps import SweepProgress, latin_hypercube, plan_sweep, sobol

EXAMPLE = Path(__file__).parents[2] / "examples" / "d1_belt.toml"
MODEL = """
import jax.numpy as jnp
import jaxmodsim as jms

def lagrangian(t, q, qd, p):
    return 0.5 * p["m"] * qd[0] ** 2

scene = jms.Scene(lagrangian, params={"m": 1.0})

def root(a, b):
    return {"root": jnp.sqrt(a) + b}

def fails(a, b):
    return {"root": 1 / 0}
"""
ROOT = """
[scene]
file = "model.py"
object = "root"
[over]
a = {from = -1, to = 8, count = 10}
b = {from = 1, to = 100, count = 3, spacing = "log"}
"""
BELT = """
[scene]
problem = "belt_oscillator"
m = 1
c = 2.0
law = {kind = "Regularized", width = 1e-2, law = {kind = "Coulomb", Fc = 5, Fs = 8}}
[run]
q0 = [0.05]
qd0 = [0.0]
t1 = 0.5
rtol = 1e-7
ts = {start = 0, stop = 0.5, count = 11}
[over]
pair = {k = [50, 80, 120], "friction.Fc" = [4, 5, 6]}
"qd0[0]" = [0.0, 0.1]
[observe]
x = "q[0]"
end = {of = "qd[0]", take = "end"}
fastest = {of = "qd[0]", take = "max", unit = "m/s"}
effective = {of = "friction", take = "rms", unit = "N"}
"""

Command = Callable[..., tuple[int, str, str]]


@pytest.fixture
def spec(tmp_path: Path) -> Callable[[str], str]:
    """Write a SPEC, with the model beside it; gives its path."""
    (tmp_path / "model.py").write_text(MODEL)

    def write(text: str) -> str:
        (tmp_path / "spec.toml").write_text(text)
        return str(tmp_path / "spec.toml")

    return write


def test_a_problem_is_run_as_sweep_runs_it(run_command: Command, spec: Callable[[str], str], tmp_path: Path) -> None:
    out = tmp_path / "belt.zarr"
    code, text, errors = run_command("sweep", spec(BELT), "--out", str(out))
    assert code == 0, errors
    assert "6 runs" in text
    assert "The run reached t1." in text
    assert str(out) in text
    found = xr.open_zarr(out, consolidated=False)
    assert found["x"].dims == ("pair", "qd0[0]", "time")
    assert found["fastest"].attrs["units"] == "m/s"
    np.testing.assert_array_equal(found["friction.Fc"], [4.0, 5.0, 6.0])
    law = jms.Regularized(jms.Coulomb(6.0, 8.0), 1e-2)
    ts = np.linspace(0.0, 0.5, 11)
    run = jms.simulate(belt_oscillator.scene(law, m=1.0, k=120.0, c=2.0), [0.05], [0.1], 0.5, ts=ts, rtol=1e-7)
    one = found.isel({"pair": 2, "qd0[0]": 1})
    np.testing.assert_allclose(one["x"], run.q[:, 0], rtol=1e-10)
    np.testing.assert_allclose(one["end"], run.qd[-1, 0], rtol=1e-10)
    np.testing.assert_allclose(one["fastest"], run.qd[:, 0].max(), rtol=1e-10)
    square = np.asarray(run.forces["friction"]) ** 2
    np.testing.assert_allclose(one["effective"], np.sqrt(np.trapezoid(square, ts) / 0.5), rtol=1e-10)
    np.testing.assert_allclose(Reduced("q[0]", "ptp")(run), np.ptp(run.q[:, 0]))
    np.testing.assert_allclose(Reduced("q[0]", "min")(run), np.min(run.q[:, 0]))
    np.testing.assert_allclose(Reduced("q[0]", "mean")(run), np.trapezoid(run.q[:, 0], ts) / 0.5)


def test_a_peak_is_that_between_saved_times_too(spec: Callable[[str], str]) -> None:
    """It was the largest of the saved values: 30 % too small with five samples a cycle."""
    text = BELT.replace("ts = {start = 0, stop = 0.5, count = 11}", "").split("[observe]")[0]
    peak = '[observe]\nhigh = {of = "qd[0]", take = "peak"}'
    assert read_sweep_spec(Path(spec(text + peak))).observe == {"high": jms.metrics.peak("qd[0]")}


def test_a_function_of_a_file_is_drawn_and_failures_are_told(
    run_command: Command, spec: Callable[[str], str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn: list[str] = []

    def draw(found: xr.Dataset, name: str, **options: Any) -> Any:
        drawn.append(name)
        return map2d(found, name, **options)

    monkeypatch.setattr(_sweep, "map2d", draw)
    command = ("sweep", spec(ROOT), "--out", str(tmp_path / "root.zarr"), "--figure", str(tmp_path / "map" / "a.png"))
    code, text, errors = run_command(*command, "--chunk", "6")
    assert code == 0, errors
    found = xr.open_zarr(tmp_path / "root.zarr", consolidated=False)
    np.testing.assert_allclose(found["root"][5], 2.0 + np.array([1.0, 10.0, 100.0]))
    assert "The function gave NaN." in text
    assert "27 " in text
    assert "30 runs in" in text
    assert (tmp_path / "map" / "a.png").read_bytes().startswith(b"\x89PNG")
    assert drawn == ["root"]
    again = run_command(*command, "--chunk", "6")
    assert again[0] == 0
    assert "30 of 30 runs were already stored." in again[1]
    code, _, errors = run_command("sweep", spec(ROOT.replace("8,", "9,")), "--out", str(tmp_path / "root.zarr"))
    assert code == 2
    assert "holds the results of another sweep" in errors


def test_a_dry_run_says_what_would_be_run(run_command: Command, spec: Callable[[str], str], tmp_path: Path) -> None:
    code, text, errors = run_command("sweep", spec(BELT), "--dry-run", "--chunk", "4", "--out", str(tmp_path / "no"))
    assert code == 0, errors
    for part in ("6 runs, in 2 chunks of up to 4", "k, friction.Fc", "pair x qd0[0] x time", "m/s"):
        assert part in text
    assert not (tmp_path / "no").exists()


def test_the_example_is_a_spec(run_command: Command) -> None:
    code, text, errors = run_command("sweep", str(EXAMPLE), "--dry-run", "--figure", "a.png")
    assert code == 0, errors
    assert "1,920 runs" in text


def test_ctrl_c_says_what_is_kept_and_the_same_command_goes_on(
    run_command: Command, spec: Callable[[str], str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupting(now: SweepProgress) -> str:
        if now.done >= 6:
            raise KeyboardInterrupt
        return ""

    command = ("sweep", spec(ROOT), "--out", str(tmp_path / "root.zarr"), "--chunk", "3")
    with monkeypatch.context() as patch:
        patch.setattr(_sweep, "SweepProgressText", lambda: interrupting)
        code, _, errors = run_command(*command)
    assert code == 130
    assert "6 of 30 runs are stored in" in errors
    assert "resumes the sweep" in errors
    code, text, _ = run_command(*command)
    assert code == 0
    # What was at work when it was interrupted is not waited for, and run again.
    assert "24 runs in" in text
    assert "6 of 30 runs were already stored" in text
    assert np.isfinite(xr.open_zarr(tmp_path / "root.zarr", consolidated=False)["root"]).sum() == 27


def test_processes_get_the_model_by_value(run_command: Command, spec: Callable[[str], str], tmp_path: Path) -> None:
    """A worker has no module of the name that the file goes by here."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the cluster's own
        code, text, errors = run_command("sweep", spec(ROOT), "--out", str(tmp_path / "root.zarr"), "--workers", "1")
    assert code == 0, errors
    assert "30 runs in" in text
    found = xr.open_zarr(tmp_path / "root.zarr", consolidated=False)
    np.testing.assert_allclose(found["root"][5], 2.0 + np.array([1.0, 10.0, 100.0]))


def test_samples_are_those_of_the_library(spec: Callable[[str], str]) -> None:
    text = ROOT[: ROOT.index("[over]")] + '[over]\ns = {KIND = {a = [1, 2], b = [1, 100, "log"]}, count = 8, seed = 3}'
    ranges: dict[str, Any] = {"a": (1.0, 2.0), "b": (1.0, 100.0, "log")}
    for kind, drawn in (("latin_hypercube", latin_hypercube), ("sobol", sobol)):
        found = read_sweep_spec(Path(spec(text.replace("KIND", kind)))).over["s"]
        for name, values in drawn(ranges, 8, seed=3).items():
            np.testing.assert_array_equal(found[name], values)


def test_the_plan_is_what_sweep_gives(spec: Callable[[str], str]) -> None:
    asked = read_sweep_spec(Path(spec(ROOT)))
    laid = plan_sweep(asked.system, asked.over, chunk=3)
    found = jms.sweep(asked.system, asked.over, chunk=3)
    assert laid.dims == dict(found.sizes) == {"a": 10, "b": 3}
    assert {name: dims for name, (dims, _) in laid.variables.items()} == {n: x.dims for n, x in found.items()}
    assert (laid.runs, laid.chunks, laid.runs_per_chunk) == (30, 10, 3)
    with pytest.raises(ValueError, match="chunk must be a positive integer"):
        plan_sweep(asked.system, asked.over, chunk=0)


def test_problems_and_laws_that_a_spec_may_name() -> None:
    assert {"belt_oscillator", "ramped_box", "cart_pole", "n_link_pendulum"} <= set(PROBLEMS)
    named = {name for name in vars(jms.friction) if name in dir(jms) and name[0].isupper()}
    functions = {"Curve", "Geared", "ServoGear"}  # they are made of one, which a file cannot say
    assert set(known_laws()) == {name for name in named if isinstance(getattr(jms, name), type)} - functions


def each_mistake() -> Iterator[tuple[str, str, str, str]]:
    """What is replaced in a SPEC by what, and what the error says."""
    yield "no toml", 'problem = "belt_oscillator"', "problem =", "spec.toml is not TOML: .*line 3"
    yield "table", "[observe]", "[observed]", "no key 'observed'; the keys are .*Did you mean 'observe'"
    yield "no scene", "[scene]", "[observe.scene]", "scene is missing"
    yield "problem", '"belt_oscillator"', '"belt"', r"\[scene\]: problem must be one of.*'belt' was given"
    yield "neither", 'problem = "belt_oscillator"', "", "either problem or file .* neither is given"
    yield "both", "m = 1\n", 'file = "model.py"\n', "both are given"
    yield "number", "m = 1\n", "mass = 1\n", r"\[scene\]: there is no key 'mass'; the keys are .*belt"
    yield "text", "m = 1\n", 'm = "one"\n', "m must be a number or a list of numbers, but 'one' was given"
    yield "law", '"Coulomb"', '"Coulom"', r"\[scene.law.law\]: kind must be one of.*Did you mean 'Coulomb'"
    yield "kind", 'kind = "Coulomb", ', "", r"\[scene.law.law\]: kind is missing"
    yield "range", "Fc = 5,", "Fc = -5,", r"\[scene.law.law\]: .*Fc.*-5"
    yield "missing", ", width = 1e-2", "", r"\[scene.law\]: width is missing"
    yield "run", "rtol =", "rtoll =", r"\[run\]: there is no key 'rtoll'.*Did you mean 'rtol'"
    yield "state", "q0 = [0.05]", "q0 = 0.05", "q0 must be a list of numbers, but 0.05"
    yield "ts", "stop = 0.5", "end = 0.5", r"\[run.ts\]: stop is missing"
    yield "misspelt", "count = 11", "cuont = 11", r"\[run.ts\]: count is missing.*'cuont' is there instead"
    yield "count", "count = 11", "count = 11.5", r"\[run.ts\]: count must be a whole number > 0, but 11.5"
    yield "no end", "t1 = 0.5\n", "", "needs t1"
    yield "zipped", "k = [50, 80, 120]", "k = 50", r"\[over.pair\]: k must be a list"
    yield "unequal", "k = [50, 80, 120]", "k = [50]", "must have the same length"
    yield "axis", "[0.0, 0.1]", "0.1", r"\[over\]: qd0\[0\] must be a list or a table, but 0.1"
    yield "spacing", "[0.0, 0.1]", '{from = 0, to = 1, count = 3, spacing = "lin"}', "linear, log, but 'lin'"
    yield "log", "[0.0, 0.1]", '{from = 0, to = 1, count = 3, spacing = "log"}', r'\[over."qd0\[0\]"\]: from and to'
    yield "name", '"qd0[0]" =', '"friction.fs" =', "Did you mean 'friction.Fs'"
    yield "both samplers", "[0.0, 0.1]", "{sobol = {}, latin_hypercube = {}, count = 2}", "exclude each other"
    yield "ranges", "[0.0, 0.1]", "{sobol = {m = [2, 1]}, count = 2}", r"sobol: The range of 'm'"
    yield "take", 'take = "max"', 'take = "maximum"', r"\[observe.fastest\]: take must be one of end.*'maximum'"
    yield "of", 'of = "friction", ', "", r"\[observe.effective\]: of is missing"
    yield "series", "ts = {start = 0, stop = 0.5, count = 11}", "", r"take = 'max' needs .* \[run\] has no ts"
    yield "observable", 'x = "q[0]"', 'x = "q[3]"', r"No observable has the name 'q\[3\]'"
    yield "nothing", BELT[BELT.index("x = ") :], "", r"\[observe\]: it is empty"


@pytest.mark.parametrize(("old", "new", "text"), [x[1:] for x in each_mistake()], ids=[x[0] for x in each_mistake()])
def test_mistakes_in_a_spec_are_named(
    run_command: Command,
    spec: Callable[[str], str],
    monkeypatch: pytest.MonkeyPatch,
    old: str,
    new: str,
    text: str,
) -> None:
    monkeypatch.setattr("jaxtyping.config.jaxtyping_disable", True)  # as users have it
    assert old in BELT
    code, _, errors = run_command("sweep", spec(BELT.replace(old, new, 1)), "--dry-run")
    assert code == 2
    (line,) = errors.splitlines()
    assert re.search(text, line), line


def each_mistake_with_a_file() -> Iterator[tuple[str, str, str, str]]:
    yield "object", '"root"', '"rot"', "object must be a Scene or a function of model.py.*lagrangian.*mean 'root'"
    yield "file", '"model.py"', '"models.py"', "models.py' is missing"
    yield "broken", '"model.py"', '"broken.py"', "running broken.py failed with ZeroDivisionError"
    yield "key", "[over]", "m = 1\n[over]", "no key 'm'; the keys are problem, file, object"
    yield "run", "[over]", "[run]\nt1 = 1\n[over]", "a function takes no t1"
    yield "arguments", "a = {", "c = {", r"over must name the arguments of the function, \(a, b\), but it names c, b"
    yield "failing", '"root"', '"fails"', r"model.py, line \d+: ZeroDivisionError: division by zero"


@pytest.mark.parametrize(
    ("old", "new", "text"),
    [x[1:] for x in each_mistake_with_a_file()],
    ids=[x[0] for x in each_mistake_with_a_file()],
)
def test_mistakes_with_a_file_are_named(
    run_command: Command, spec: Callable[[str], str], tmp_path: Path, old: str, new: str, text: str
) -> None:
    (tmp_path / "broken.py").write_text("1 / 0")
    code, _, errors = run_command("sweep", spec(ROOT.replace(old, new, 1)), "--dry-run")
    assert code == 2
    assert re.search(text, errors), errors


def test_mistakes_in_the_command_line(run_command: Command, spec: Callable[[str], str], tmp_path: Path) -> None:
    store = ("--out", str(tmp_path / "a.zarr"))
    sample = ROOT.replace("a = {from = -1, to = 8, count = 10}", "a = {sobol = {a = [1, 2]}, count = 8}")
    for text, arguments, words in (
        (ROOT, (), "--out STORE is missing"),
        (ROOT, (*store, "--workers", "2", "--scheduler", "tcp://a:1"), "exclude each other"),
        (ROOT, (*store, "--figure", "a.pdf"), "ends in .png"),
        (ROOT, (*store, "--chunk", "0"), "--chunk"),
        (sample, (*store, "--figure", "a.png"), "that rise or fall, but 'a'"),
        (BELT, (*store, "--figure", "a.png"), "two dimensions, but 'x' has pair, qd0[0], time"),
    ):
        code, _, errors = run_command("sweep", spec(text), *arguments)
        assert (code, words in errors) == (2, True), errors
    assert run_command("sweep", str(tmp_path / "none.toml"), "--dry-run")[2].endswith("No such file or directory.\n")
    assert not (tmp_path / "a.zarr").exists()
    assert run_command("sweep", "--help")[0] == 0
