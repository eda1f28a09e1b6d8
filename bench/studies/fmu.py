"""Scenes as FMUs in FMPy: errors of coordinates and event times against `simulate`, and the time of a step.

Co-simulation has the FMU's own integrator, model exchange CVODE of FMPy; both at a relative tolerance of 1e-6. The
reference is `simulate` at 1e-10.
"""

import ctypes
import time
from pathlib import Path
from typing import Any

import numpy as np

import jaxmodsim as jms
from bench.record import Result
from jaxmodsim.export._compile import own_platform
from jaxmodsim.problems import belt_oscillator, bouncing_ball, n_link_pendulum, ramped_box, slider_crank

RTOL, ROWS, STEP = 1e-6, 100, 1e-3


def main(smoke: bool, out: Path) -> Result:
    """Export each scene, run it in both modes, and time steps of 1 ms of the belt."""
    result = Result("fmu", ("fmpy", "ziglang"), {"rtol": RTOL})
    for name, (scene, q0, qd0, t1) in _scenes().items():
        if smoke and name not in ("box", "belt"):
            continue
        began = time.process_time()
        path = jms.export.fmu(scene, q0, qd0, out / f"{name}.fmu", t1=t1, platforms=[own_platform()])
        result.add("export", time.process_time() - began, "s", case=name)
        _errors(result, name, path, jms.simulate(scene, q0, qd0, t1, ts=_times(t1), rtol=1e-10, atol=1e-12), t1)
        path.unlink()
    return result


def _times(t1: float) -> np.ndarray:
    return np.linspace(0.0, t1, ROWS + 1)


def _scenes() -> dict[str, tuple[jms.Scene, Any, Any, float]]:
    plain = n_link_pendulum.double_pendulum()
    joints = (
        jms.Friction(jms.Coulomb(1.0), along=lambda q: q[0], name="shoulder"),
        jms.Friction(jms.Coulomb(0.5, 0.7), along=lambda q: q[1] - q[0], name="elbow"),
    )
    return {
        "box": (ramped_box.scene(ramped_box.lugre()), [0.0], [0.0], 10.0),
        "belt": (belt_oscillator.scene(), [0.0], [0.1], 20.0),
        "double_pendulum": (jms.Scene(plain.lagrangian, plain.params, joints), [2.0, 1.0], [0.0, 0.0], 5.0),
        "slider_crank": (slider_crank.scene(torque=3.0, mu=0.3), *slider_crank.state(0.6, 2.0), 3.0),
        "ball": (bouncing_ball.scene(e=0.7), [1.0], [0.0], 4.0),
    }


def _errors(result: Result, name: str, path: Path, run: Any, t1: float) -> None:
    import fmpy

    for kind in ("CoSimulation", "ModelExchange"):
        rows = fmpy.simulate_fmu(
            str(path), fmi_type=kind, stop_time=t1, output_interval=t1 / ROWS, relative_tolerance=RTOL,
            record_events=False,
        )  # fmt: skip
        at = [int(np.argmin(np.abs(rows["time"] - t))) for t in _times(t1)]
        found = np.stack([rows[each] for each in rows.dtype.names[1 : 1 + run.q.shape[1]]], axis=1)[at]
        result.add("error of coordinates", float(np.max(np.abs(found - run.q))), "m or rad", case=name, at=kind)
    one = _instance(path)
    times, t = [], 0.0
    while t < t1 - 1e-12:
        event, _, _, t = one.doStep(t, min(t1 / ROWS, t1 - t))
        if event:
            one.enterEventMode()
            one.updateDiscreteStates()
            one.enterStepMode()
            times.append(t)
    expected = np.asarray(run.events.t) if run.events is not None else np.zeros(0)
    result.add("events", float(len(times)), "1", case=name)
    result.add("events of the run", float(len(expected)), "1", case=name)
    if len(expected):
        # An FMU has more: it also counts the changes of a guide's side, at which no mode changes.
        apart = np.abs(np.asarray(times)[:, None] - expected).min(axis=0)
        result.add("error of event times", float(np.max(apart)), "s", case=name)
    one.freeInstance()
    if name == "belt":
        result.add("step of 1 ms", _step_time(_instance(path)), "s", case=name)


def _instance(path: Path) -> Any:
    import fmpy
    from fmpy.fmi3 import FMU3Slave

    description, folder = fmpy.read_model_description(str(path)), fmpy.extract(str(path))
    identifier = description.coSimulation.modelIdentifier
    one = FMU3Slave(guid=description.guid, unzipDirectory=folder, modelIdentifier=identifier, instanceName="one")
    one.instantiate(eventModeUsed=True, earlyReturnAllowed=True)
    one.enterInitializationMode(tolerance=RTOL, startTime=0.0)
    one.exitInitializationMode()
    one.updateDiscreteStates()
    one.enterStepMode()
    return one


def _step_time(one: Any) -> float:
    """Median time [s] of `fmi3DoStep`, the call included; the events among them end steps early."""
    step = one.dll.fmi3DoStep
    step.argtypes = [ctypes.c_void_p, ctypes.c_double, ctypes.c_double, ctypes.c_bool, *4 * [ctypes.c_void_p]]
    flags, reached, spent = [ctypes.c_bool() for _ in range(3)], ctypes.c_double(), []
    places = [*map(ctypes.byref, flags), ctypes.byref(reached)]
    t = 0.0
    for _ in range(5000):
        began = time.perf_counter()
        step(one.component, t, STEP, True, *places)
        spent.append(time.perf_counter() - began)
        t = reached.value
        if flags[0].value:
            one.enterEventMode()
            one.updateDiscreteStates()
            one.enterStepMode()
    one.freeInstance()
    return float(np.median(spent))
