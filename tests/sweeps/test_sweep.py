"""Many runs at once: the numbers of single runs, whatever the cut; failures that stay alone; names that are wrong."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import xarray as xr

import jaxmodsim as jms
from jaxmodsim.problems import ramped_box
from jaxmodsim.sweeps import Derivative, SweepProgress

from ..helpers.optimized import optimized

SIGMA0 = np.geomspace(200.0, 2e4, 9)
MASS = np.linspace(1.0, 3.0, 14)
OVER = {"friction.sigma0": SIGMA0, "m": MASS}
START: dict[str, Any] = {"q0": [0.0], "qd0": [0.0], "t1": 4.0}
TS = np.linspace(0.0, 4.0, 5)


def peak(run: jms.Trajectory) -> Any:
    return jnp.max(jnp.abs(run.qd[:, 0]))


# Functions count by identity: one mapping for all tests compiles once.
OBSERVE = {"v": "qd[0]", "friction": "friction", "peak": (peak, "m/s")}
SCENE = ramped_box.scene(ramped_box.lugre())


def box_sweep(**changes: Any) -> xr.Dataset:
    return jms.sweep(SCENE, **({"over": OVER, "observe": OBSERVE, "ts": TS} | START | changes))


@pytest.fixture(scope="module")
@optimized()
def found() -> xr.Dataset:
    return box_sweep()


@pytest.mark.quick
@optimized()
def test_numbers_are_those_of_single_runs(found: xr.Dataset) -> None:
    assert dict(found.sizes) == {"friction.sigma0": 9, "m": 14, "time": 5}
    assert found["v"].dims == ("friction.sigma0", "m", "time")
    assert (found["result"] == 0).all()
    for i, j in ((0, 0), (8, 13), (4, 5)):
        scene = ramped_box.scene(ramped_box.lugre(sigma0=SIGMA0[i]), m=MASS[j])
        run = jms.simulate(scene, ts=TS, **START)
        # Rounding differs in a batch, and with it the lengths of steps: both are as far from a tight run.
        np.testing.assert_allclose(found["v"][i, j], run.qd[:, 0], rtol=1e-7, atol=1e-7)
        np.testing.assert_allclose(found["friction"][i, j], run.forces["friction"], rtol=1e-5)
        np.testing.assert_allclose(found["peak"][i, j], np.abs(run.qd[:, 0]).max(), rtol=1e-7)
        assert found["num_steps"][i, j] == run.stats["num_steps"]


def test_dimensions_units_and_origin(found: xr.Dataset) -> None:
    np.testing.assert_array_equal(found["m"], MASS)
    np.testing.assert_array_equal(found["time"], TS)
    assert found["peak"].attrs["units"] == "m/s"
    assert found["friction.sigma0"].attrs["units"] == "N/m"
    assert found["result"].attrs["flag_meanings"][0] == "The run reached t1."
    origin = json.loads(found.attrs["provenance"])
    assert origin["numbers"]["friction.Fc"] == 1.5
    assert "friction.sigma0" not in origin["numbers"]
    assert origin["versions"]["jax"] == jax.__version__
    assert origin["arguments"]["rtol"] == 1e-6
    assert "LuGre" in found.attrs["system"]
    assert "Rodas5P" in found.attrs["solver"]


@pytest.mark.parametrize("chunk", [1000, 14, 5])
@optimized()
def test_any_cut_gives_the_same_numbers(found: xr.Dataset, chunk: int) -> None:
    other = box_sweep(chunk=chunk)
    for name in ("v", "friction", "peak"):
        np.testing.assert_allclose(other[name], found[name], rtol=1e-11, atol=1e-14)
    np.testing.assert_array_equal(other["num_steps"], found["num_steps"])


@optimized()
def test_many_lanes_are_sorted_and_put_back() -> None:
    """More runs than are run without a look ahead, in an order that is not that of their steps."""
    rng = np.random.default_rng(3)
    drawn = {"friction.sigma0": 10 ** rng.uniform(2.0, 5.0, 1500), "m": rng.uniform(1.0, 3.0, 1500)}
    whole = box_sweep(over={"sample": drawn})
    assert whole["num_steps"].max() > 1.5 * whole["num_steps"].min()
    rows = [0, 700, 1499]
    part = box_sweep(over={"sample": {name: x[rows] for name, x in drawn.items()}})
    np.testing.assert_allclose(whole["v"][rows], part["v"], rtol=1e-11, atol=1e-14)
    np.testing.assert_array_equal(whole["m"], drawn["m"])
    assert whole["m"].dims == ("sample",)


def test_a_lane_that_fails_stays_alone() -> None:
    """One run with a negative mass, one whose parameter is out of range: codes with sentences, and NaN."""

    def of(stiction: np.ndarray, mass: np.ndarray) -> xr.Dataset:
        law = {"friction.sigma0": SIGMA0, "friction.Fc": np.full(9, 1.5), "friction.Fs": stiction}
        return box_sweep(over={"law": law, "m": mass})

    stiction, mass = np.full(9, 1.75), MASS.copy()
    found = of(stiction, mass)
    stiction[2], mass[3] = 1.0, -1.0
    broken = of(stiction, mass)
    bad = np.zeros((9, 14), bool)
    bad[2], bad[:, 3] = True, True
    np.testing.assert_array_equal(broken["result"] != 0, bad)
    assert np.isnan(broken["v"].values[bad]).all()
    assert np.isnan(broken["peak"].values[bad]).all()
    np.testing.assert_allclose(broken["v"].values[~bad], found["v"].values[~bad], rtol=1e-11, atol=1e-14)
    sentences = broken["result"].attrs["flag_meanings"]
    assert "Fs must be" in sentences[int(broken["result"][2, 0])]
    assert "mass matrix" in sentences[int(broken["result"][0, 3])].lower()


def test_a_lane_of_many_steps_is_run_again_among_its_like() -> None:
    """One run needs more steps than runs get at first, one more than it may have at all."""
    tolerance = np.full(14, 1e-6)
    tolerance[4], tolerance[9] = 1e-12, 1e-16
    runs = box_sweep(over={"run": {"m": MASS, "rtol": tolerance, "atol": 1e-3 * tolerance}}, max_steps=2500)
    steps = runs["num_steps"].values
    assert 1024 < steps[4] < 2500
    assert steps[9] == 2500
    assert runs["result"][4] == 0
    assert "step limit" in runs["result"].attrs["flag_meanings"][int(runs["result"][9])]
    others = [i for i in range(14) if i not in (4, 9)]
    scene = ramped_box.scene(ramped_box.lugre(), m=MASS[4])
    run = jms.simulate(scene, ts=TS, rtol=1e-12, atol=1e-15, **START)
    np.testing.assert_allclose(runs["v"][4], run.qd[:, 0], rtol=1e-11, atol=1e-14)
    assert (runs["result"][others] == 0).all()
    assert (steps[others] < 200).all()


def test_initial_state_and_end_may_change_without_times() -> None:
    over = {"qd0[0]": [0.5, 1.0], "t1": [1.0, 2.0, 3.0]}
    found = jms.sweep(SCENE, over, ["q[0]", "friction"], q0=[0.0], qd0=[0.0])
    assert found["q[0]"].dims == ("qd0[0]", "t1")
    assert found["t1"].attrs["units"] == "s"
    run = jms.simulate(SCENE, [0.0], [1.0], 3.0)
    np.testing.assert_allclose(found["q[0]"][1, 2], run.q[-1, 0], rtol=1e-10)
    np.testing.assert_allclose(found["friction"][1, 2], run.forces["friction"][-1], rtol=1e-10)
    pairs = {"start": {"q0": [[0.0], [1.0]], "qd0": [[1.0], [2.0]]}}
    states = jms.sweep(SCENE, pairs, ["q[0]"], t1=3.0)
    np.testing.assert_allclose(states["q[0]"][0], run.q[-1, 0], rtol=1e-10)
    assert states["q0"].dims == ("start", "q0_0")


def test_derivatives_are_those_of_the_run() -> None:
    observe = {
        "v": "qd[0]",
        "slopes": Derivative("qd[0]", ("m", "friction.Fc", "qd0[0]")),
        "dm": Derivative(peak, "m"),
    }
    found = jms.sweep(SCENE, {"m": [1.5, 2.5]}, observe, **START)
    assert found["slopes"].dims == ("m", "slopes_wrt")
    assert found["dm"].dims == ("m",)
    assert list(found["slopes_wrt"].values) == ["m", "friction.Fc", "qd0[0]"]

    def end(m: float, fc: float, v: float) -> float:
        scene = ramped_box.scene(ramped_box.lugre(Fc=fc), m=m)
        return float(jms.simulate(scene, [0.0], [v], 4.0, rtol=1e-10, atol=1e-13).qd[-1, 0])

    # The field is smooth: a step of 1e-4 leaves 1e-8 of truncation, and the run at rtol 1e-6 some 1e-5.
    h = 1e-4
    base = np.array([2.5, 1.5, 0.0])
    steps = [(end(*(base + h * e)) - end(*(base - h * e))) / (2 * h) for e in np.eye(3)]
    np.testing.assert_allclose(found["slopes"][1], steps, rtol=1e-3, atol=1e-6)
    np.testing.assert_allclose(found["dm"], found["slopes"][:, 0], rtol=1e-12)


def test_a_function_may_be_swept() -> None:
    def product(a: Any, b: Any) -> dict[str, Any]:
        return {"sum": a + b, "powers": jnp.stack([a, b**2]), "root": jnp.sqrt(a - 1.0)}

    found = jms.sweep(product, {"a": [0.0, 1.0, 5.0], "b": np.arange(70)})
    assert found["powers"].dims == ("a", "b", "powers_0")
    np.testing.assert_array_equal(found["sum"][2], 5.0 + np.arange(70))
    assert (found["result"][0] == 1).all()
    assert np.isnan(found["sum"][0]).all()
    np.testing.assert_array_equal(found["root"][2], 2.0)
    alone = jms.sweep(lambda a: a**2, {"a": [3.0]})
    assert alone["value"].item() == 9.0


def test_a_function_may_return_a_run() -> None:
    def run(gain: Any) -> jms.Trajectory:
        return jms.simulate(ramped_box.scene(ramped_box.lugre(sigma2=gain)), throw=False, **START)

    found = jms.sweep(run, {"gain": [0.1, 0.4]}, {"v": "qd[0]"})
    single = jms.simulate(ramped_box.scene(ramped_box.lugre(sigma2=0.4)), **START)
    np.testing.assert_allclose(found["v"][1], single.qd[-1, 0], rtol=1e-10)
    assert "step limit" in found["result"].attrs["flag_meanings"][1]


def test_types_of_the_scene_are_kept() -> None:
    scene = jax.tree.map(lambda x: x.astype(jnp.float32), SCENE)
    start = {"q0": np.zeros(1, np.float32), "qd0": np.zeros(1, np.float32), "t1": 2.0, "rtol": 1e-4, "atol": 1e-6}
    found = jms.sweep(scene, {"m": [1.0, 2.0]}, ["qd[0]"], **start)
    assert found["qd[0]"].dtype == np.float32
    assert (found["result"] == 0).all()


def test_progress_counts_lanes_and_failures() -> None:
    seen: list[SweepProgress] = []
    jms.sweep(lambda a: jnp.sqrt(a), {"a": np.linspace(-1.0, 8.0, 10)}, chunk=4, progress=seen.append)
    assert [now.done for now in seen] in ([0, 4, 8, 10], [0, 4, 6, 10], [0, 2, 6, 10])
    assert (seen[-1].total, seen[-1].failed) == (10, 1)


def test_ctrl_c_keeps_what_has_been_run() -> None:
    def stop(now: SweepProgress) -> None:
        if now.done >= 4:
            raise KeyboardInterrupt

    with pytest.warns(UserWarning, match="interrupted"):
        found = jms.sweep(lambda a: 2.0 * a, {"a": np.arange(100.0)}, chunk=4, progress=stop)
    ran = (found["result"] == 0).values
    assert 4 <= ran.sum() < 100
    np.testing.assert_array_equal(found["value"].values[ran], 2.0 * np.arange(100.0)[ran])
    assert np.isnan(found["value"].values[~ran]).all()


def each_mistake() -> Iterator[tuple[str, dict[str, Any], str]]:
    yield "misspelt", {"over": {"friction.sigma_0": SIGMA0}}, "Did you mean 'friction.sigma0'"
    yield "no mapping", {"over": [1.0]}, "over must name the numbers to sweep"
    yield "empty", {"over": {"m": []}}, "at least one value"
    yield "number", {"over": {"m": 1.0}}, "sequence of at least one value"
    yield "text", {"over": {"solver": ["a", "b"]}}, "cannot be swept"
    yield "nan", {"over": {"m": [1.0, np.nan]}}, r"at \[1\] it is nan"
    yield (
        "range",
        {"over": {"friction.sigma0": [1.0, -1.0]}},
        r"is -1 at \[1\], but friction.sigma0 must be finite and >",
    )
    yield (
        "range of another",
        {"over": {"friction.Fc": [0.1, 99.0]}},
        r"99 at \[1\], but friction.Fs must be .*>= friction",
    )
    yield "ragged", {"over": {"m": [[1.0], [1.0, 2.0]]}}, "'m' in over must be an array"
    yield "unequal", {"over": {"s": {"m": [1.0, 2.0], "friction.Fc": [1.0]}}}, "must have the same length"
    yield "nothing zipped", {"over": {"s": {}}}, "is empty"
    yield "twice", {"over": {"m": [1.0], "s": {"m": [1.0]}}}, "names 'm' twice"
    yield "reserved", {"over": {"result": {"m": [1.0]}}}, "cannot use the name 'result'"
    yield "both", {"over": {"t1": [1.0]}}, "t1 is given"
    yield "shape", {"over": {"m": [[1.0, 2.0]]}}, r"shape \[n\]"
    yield "no state", {"q0": None}, "needs q0"
    yield "index", {"over": {"q0[1]": [1.0]}}, "q0\\[0\\]"
    yield "observable", {"observe": {"v": "qd[7]"}}, "No observable has the name 'qd\\[7\\]'"
    yield "nothing observed", {"observe": None}, "observe must name the results of each run"
    yield "no function", {"observe": {"v": 3.0}}, "must be a function of the run"
    yield "not numbers", {"observe": {"v": lambda run: run}}, "must be an array of real numbers"
    yield "complex", {"observe": {"v": lambda run: 1j * run.q}}, "must be real"
    yield "wrt", {"observe": {"v": Derivative("q[0]", "friction.fc")}}, "Did you mean 'friction.Fc'"
    yield "throw", {"throw": True}, "no argument 'throw'"
    yield "option", {"max_step": 3}, "no argument 'max_step'.*Did you mean 'max_steps'"
    yield "value", {"t1": -1.0}, "t1 must not be before t0"
    yield "ts", {"ts": [0.0, 99.0]}, "ts must lie within"
    yield "t1 of a run", {"over": {"t1": [4.0, 2.0]}, "t1": None}, "ts must lie within .* every run, from 0 to 2"
    yield "t0 of a run", {"over": {"t0": [0.0, 5.0]}, "ts": None}, "t1 must not be before t0 in any run"
    yield "rtol of a run", {"over": {"rtol": [1e-6, -1e-6]}}, "'rtol' in over must not be negative"
    yield "dt of a run", {"over": {"dt": [1e-3, 0.0]}}, "'dt' in over must be positive"
    yield "slash", {"observe": {"F/Fc": "friction"}}, "without a slash"
    yield "slash in over", {"over": {"a/b": {"m": [1.0]}}}, "without a slash"
    yield "chunk", {"chunk": 0}, "chunk must be a positive integer"
    yield "progress", {"progress": "yes"}, "progress must be"
    yield "executor", {"executor": 4}, "dask.distributed.Client"
    yield "same name", {"observe": {"m": "q[0]"}}, "rename"


@pytest.mark.parametrize(("changes", "text"), [x[1:] for x in each_mistake()], ids=[x[0] for x in each_mistake()])
def test_mistakes_are_named(monkeypatch: pytest.MonkeyPatch, changes: dict[str, Any], text: str) -> None:
    monkeypatch.setattr("jaxtyping.config.jaxtyping_disable", True)  # as users have it
    with pytest.raises(ValueError, match=text):
        box_sweep(**changes)


@pytest.mark.filterwarnings("ignore")
def test_a_function_that_raises_says_how_it_should_not() -> None:
    def end(m: Any) -> Any:
        return jms.simulate(ramped_box.scene(ramped_box.lugre(), m=m), **START).qd[-1, 0]

    with pytest.raises(RuntimeError, match=r"mass matrix .* Pass throw=False"):
        jms.sweep(end, {"m": [1.0, -2.0]})


def test_mistakes_with_a_function(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("jaxtyping.config.jaxtyping_disable", True)  # as users have it
    with pytest.raises(ValueError, match="needs a Scene or a function"):
        jms.sweep(3.0, {"a": [1.0]})  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="a function takes no qd0"):
        jms.sweep(lambda a: a, {"a": [1.0]}, qd0=[0.0])
    with pytest.raises(ValueError, match=r"no argument 'chunks'\. Did you mean 'chunk'"):
        jms.sweep(lambda a: a, {"a": [1.0]}, chunks=4)
    with pytest.raises(ValueError, match="observe needs a run"):
        jms.sweep(lambda a: a, {"a": [1.0]}, ["q[0]"])
    with pytest.raises(ValueError, match="name the results to keep by observe"):
        jms.sweep(lambda a: jms.simulate(SCENE, [0.0], [a], 1.0, throw=False), {"a": [1.0]})


def test_a_zipped_table_of_pandas_is_read(tmp_path: Path) -> None:
    del tmp_path
    pandas = pytest.importorskip("pandas")
    found = jms.sweep(lambda a, b: a - b, {"row": pandas.DataFrame({"a": [1.0, 2.0], "b": [0.5, 0.5]})})
    np.testing.assert_array_equal(found["value"], [0.5, 1.5])
