"""Scenes as FMUs: validated and run by FMPy in both modes, and compared with `simulate` and JAX."""

import functools
import importlib.util
import json
import shutil
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
import pytest

import jaxmodsim as jms
from jaxmodsim.export import _compile
from jaxmodsim.export._fmu_description import base_unit
from jaxmodsim.problems import belt_oscillator, bouncing_ball, n_link_pendulum, ramped_box, slider_crank
from jaxmodsim.scene import State, elements, forward_dynamics

from ..helpers.compilers import OWN, needs_fmpy

# The wheel of Ecos leaves its library for threads to another wheel, which puts it here.
THREADS = Path(sys.prefix) / "lib" / "libtbb.so.12"
needs_ecos = pytest.mark.skipif(
    importlib.util.find_spec("ecospy") is None or not THREADS.exists(), reason="needs ecospy and tbb, wheels for Linux"
)
fmpy = pytest.importorskip("fmpy", reason="needs FMPy, which runs FMUs")


def double_pendulum() -> jms.Scene:
    plain = n_link_pendulum.double_pendulum()
    joints = (
        jms.Friction(jms.Coulomb(1.0), along=lambda q: q[0], name="shoulder"),
        jms.Friction(jms.Coulomb(0.5, 0.7), along=lambda q: q[1] - q[0], name="elbow"),
    )
    return jms.Scene(plain.lagrangian, plain.params, joints, coordinates=plain.coordinates)


def mass(t: Any, q: Any, qd: Any, p: Any) -> Any:
    del t
    return 0.5 * p["m"] * jnp.sum(qd**2) + p["f"] * q[0]


def puck() -> jms.Scene:
    return jms.Scene(mass, {"m": 2.0, "f": 1.0}, (jms.Friction(jms.Coulomb(1.5, 2.0), along=lambda q: q),))


def switched_spring() -> jms.Scene:
    spring = jms.Switch(lambda t, q, qd, p: q[0], above=lambda t, q, qd, p: -p["k"] * q)
    pull = jms.AppliedForce(lambda t, q, qd, p: -q, name="pull")
    return jms.Scene(mass, {"m": 1.0, "f": 0.0, "k": 4.0}, (spring, pull))


def end_stops() -> jms.Scene:
    """A mass between two stops, under a sine force."""

    def lagrangian(t: Any, q: Any, qd: Any, p: Any) -> Any:
        return 0.5 * qd[0] ** 2 + p["f"] * jnp.sin(3.0 * t) * q[0]

    lower = jms.Contact(lambda t, q, p: q[0] + 0.1, restitution=0.5, name="lower")
    upper = jms.Contact(lambda t, q, p: 0.1 - q[0], restitution=0.5, name="upper")
    return jms.Scene(lagrangian, {"f": 2.0}, constraints=(lower, upper))


def skate() -> jms.Scene:
    """A blade on a slope, which moves only along its direction q[2]."""

    def lagrangian(t: Any, q: Any, qd: Any, p: Any) -> Any:
        del t
        return 0.5 * (qd[0] ** 2 + qd[1] ** 2) + 0.05 * qd[2] ** 2 - p["g"] * q[1]

    blade = jms.VelocityConstraint(lambda t, q, qd, p: -jnp.sin(q[2]) * qd[0] + jnp.cos(q[2]) * qd[1], name="blade")
    return jms.Scene(lagrangian, {"g": 2.0}, constraints=(blade,))


def rigid_gear() -> jms.Scene:
    """Two shafts, whose torques reverse that in the mesh."""

    def torques(t: Any, q: Any, qd: Any, p: Any) -> Any:
        del q, qd
        return jnp.stack([p["f"] * jnp.sin(4.1 * t - 2.1), 4.5 * jnp.sin(4.7 * t + 0.8)])

    law = jms.Geared(jms.Coulomb(0.3), 0.6, "mesh", 0.5)
    effects = jms.AppliedForce(torques), jms.Friction(law, along=lambda q: q[0], name="gear")
    mesh = jms.Constraint(lambda t, q, p: q[0] - 1.5 * q[1], name="mesh")
    return jms.Scene(mass, {"m": 1.0, "f": 3.0}, effects, (mesh,))


# Scene, start, end, largest error of coordinates at rtol 1e-6, and of event times.
CASES: dict[str, Callable[[], tuple[Any, Any, Any, float, float, float]]] = {
    "box": lambda: (ramped_box.scene(ramped_box.lugre()), [0.0], [0.0], 10.0, 2e-6, 0.0),
    "belt": lambda: (belt_oscillator.scene(), [0.0], [0.1], 5.0, 1e-6, 1e-6),
    "ball": lambda: (bouncing_ball.scene(e=0.7), [1.0], [0.0], 4.0, 1e-9, 1e-9),
    "pendulum": lambda: (double_pendulum(), [2.0, 1.0], [0.0, 0.0], 3.0, 1e-5, 1e-5),
    "crank": lambda: (
        slider_crank.scene(torque=3.0, mu=0.3),
        *slider_crank.state(0.6, 2.0),
        1.5,
        1e-4,
        1e-5,
    ),
}
NAMES = ["box", "belt", "ball", "pendulum", "crank"]
# Friction in the plane, a switch, stops, a velocity constraint, a gear; validation and derivatives are as above.
CASES |= {
    "puck": lambda: (puck(), [0.0, 0.0], [3.0, 4.0], 10.0, 1e-7, 0.0),
    "switch": lambda: (switched_spring(), [-1.0], [1.0], 6.0, 1e-7, 1e-6),
    "stops": lambda: (end_stops(), [0.0], [0.3], 3.0, 1e-7, 0.0),
    "skate": lambda: (skate(), [0.0, 0.0, 0.0], [1.0, 0.0, 1.0], 3.0, 1e-7, 0.0),
    "gear": lambda: (rigid_gear(), [0.0, 0.0], [0.0, 0.0], 4.0, 2e-6, 0.0),
}
OTHERS = ["puck", "switch", "stops", "skate", "gear"]


@functools.cache
def exported(name: str) -> tuple[Path, Any]:
    """The file, and its description."""
    scene, q0, qd0, t1, *_ = CASES[name]()
    FOLDERS.append(tempfile.mkdtemp())
    path = jms.export.fmu(scene, q0, qd0, Path(FOLDERS[-1]) / f"{name}.fmu", t1=t1, platforms=[OWN])
    return path, fmpy.read_model_description(str(path))


@functools.cache
def unpacked(name: str) -> str:
    FOLDERS.append(fmpy.extract(str(exported(name)[0])))
    return FOLDERS[-1]


@pytest.fixture(scope="module", autouse=True)
def without_traces() -> Iterator[None]:
    """Remove the files of this module at its end."""
    yield
    for folder in FOLDERS:
        shutil.rmtree(folder)


FOLDERS: list[str] = []


def instance(name: str, **options: Any) -> Any:
    """An instance for co-simulation, initialised at tolerance 1e-6."""
    from fmpy.fmi3 import FMU3Slave

    description = exported(name)[1]
    made = FMU3Slave(
        guid=description.guid,
        unzipDirectory=unpacked(name),
        modelIdentifier=description.coSimulation.modelIdentifier,
        instanceName="one",
    )
    made.instantiate(**options)
    made.enterInitializationMode(tolerance=1e-6, startTime=0.0)
    made.exitInitializationMode()
    return made


def references(name: str) -> dict[str, int]:
    return {each.name: each.valueReference for each in exported(name)[1].modelVariables}


@functools.cache
def tight_run(name: str) -> Any:
    scene, q0, qd0, t1, *_ = CASES[name]()
    return jms.simulate(scene, q0, qd0, t1, ts=np.linspace(0.0, t1, 101), rtol=1e-10, atol=1e-12, max_steps=100_000)


@needs_fmpy
@pytest.mark.parametrize("name", NAMES)
def test_validation_has_no_finding(name: str) -> None:
    from fmpy.validation import validate_fmu

    assert validate_fmu(str(exported(name)[0])) == []


@needs_fmpy
@pytest.mark.parametrize("kind", ["CoSimulation", "ModelExchange"])
@pytest.mark.parametrize("name", [*NAMES, *OTHERS])
def test_both_modes_agree_with_simulate(name: str, kind: str) -> None:
    _, q0, _, t1, error, _ = CASES[name]()
    exact, importer = tight_run(name), kind == "ModelExchange"
    rows = fmpy.simulate_fmu(
        str(exported(name)[0]),
        fmi_type=kind,
        stop_time=t1,
        output_interval=t1 / 100,
        relative_tolerance=1e-9 if importer else 1e-6,
        record_events=False,
    )
    at = [int(np.argmin(np.abs(rows["time"] - t))) for t in np.linspace(0.0, t1, 101)]
    found = np.stack([rows[each] for each in rows.dtype.names[1 : 1 + len(q0)]], axis=1)[at]
    # CVODE of the importer accumulates ten to a hundred times its tolerance; a rest of impacts begins early.
    assert np.max(np.abs(found - exact.q)) < (max(error, 2e-6) if importer else error)
    for effect, force in exact.forces.items():
        series = rows[effect if force.ndim == 1 else f"{effect}[0]"][at]
        np.testing.assert_allclose(series[-1], np.ravel(force[-1])[0], rtol=1e-3, atol=1e-3)


# In a process of its own, which may crash: arguments are the library for threads, the file, the step and names.
ECOS = """
import ctypes, json, sys
threads, path, step, *names = sys.argv[1:]
ctypes.CDLL(threads, mode=ctypes.RTLD_GLOBAL)
from ecospy import EcosSimulation, EcosSimulationStructure
parts = EcosSimulationStructure()
parts.add_model("one", path)
simulation = EcosSimulation(structure=parts, step_size=float(step))
simulation.init()
rows = [[simulation.get_real(f"one::{name}") for name in names]]
for _ in range(100):
    simulation.step()
    rows.append([simulation.get_real(f"one::{name}") for name in names])
simulation.terminate()
print("rows", json.dumps(rows))
"""


@needs_fmpy
@needs_ecos
@pytest.mark.parametrize("name", [*NAMES, *OTHERS])
def test_another_importer_agrees_with_simulate(name: str) -> None:
    """Ecos, a program in C++ that reads FMI 3.0 without any code of FMPy."""
    _, q0, _, t1, error, _ = CASES[name]()
    path, description = exported(name)
    names = [each.name for each in description.modelVariables if each.causality == "output"][: len(q0)]
    command = [sys.executable, "-c", ECOS, str(THREADS), str(path), repr(t1 / 100), *names]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=100)
    rows = json.loads(done.stdout.partition("rows ")[2])
    np.testing.assert_allclose(rows, tight_run(name).q, atol=error, rtol=0)


@needs_fmpy
@pytest.mark.parametrize("name", NAMES[1:])
def test_events_are_those_of_simulate(name: str) -> None:
    scene, _, _, t1, _, error = CASES[name]()
    run, one = tight_run(name), instance(name, eventModeUsed=True, earlyReturnAllowed=True)
    one.updateDiscreteStates()
    one.enterStepMode()
    places = [references(name)[f"{each}.mode"] for each in scene.mode_names]
    t, times, changed = 0.0, [], []
    while t < t1 - 1e-12:
        event, _, _, t = one.doStep(t, min(t1 / 10, t1 - t))
        if event:
            before = one.getInt32(places)
            one.enterEventMode()
            assert not one.updateDiscreteStates()[0]
            one.enterStepMode()
            after = one.getInt32(places)
            # No mode changes at an impact, and none where the load of a guide changes its sign.
            if after != before or scene.contacts:
                times.append(t)
                changed.append((before, after))
    order = np.argsort(run.events.t, kind="stable")
    assert len(times) == len(order) > 3
    np.testing.assert_allclose(times, np.asarray(run.events.t)[order], atol=error, rtol=0)
    index = [scene.part_names.index(each) for each in scene.mode_names]
    for (before, after), k in zip(changed, order, strict=True):
        i = index.index(int(run.events.effect[k]))
        assert (before[i], after[i]) == (int(run.events.before[k]), int(run.events.after[k]))
    one.freeInstance()


@needs_fmpy
@pytest.mark.parametrize("name", NAMES)
def test_derivatives_are_those_of_jax(name: str) -> None:
    scene, q0, qd0, *_ = CASES[name]()
    one, at = instance(name), references(name)
    y = State(jnp.asarray(q0, float), jnp.asarray(qd0, float), scene.initial_state(jnp.asarray(q0, float)))
    n = sum(np.size(x) for x in jtu.tree_leaves(y))
    names = list(at)
    first = 1 + len(elements(scene))
    states, numbers = [at[x] for x in names[first : first + n]], [at[x] for x in elements(scene)]
    y = unflattened(y, one.getFloat64(states))
    modes = jnp.asarray(one.getInt32([at[f"{x}.mode"] for x in scene.mode_names]), float) if scene.mode_names else None
    if scene.guides:  # and their sides, which are no variables
        assert modes is not None
        loads = forward_dynamics(jnp.zeros(()), y, scene, jnp.append(modes, 1.0)).guide_loads(jnp.zeros(()))[0]
        modes = jnp.append(modes, jnp.where(loads >= 0, 1.0, -1.0))

    def everything(t: Any, scene: jms.Scene, y: State) -> list[Any]:
        d = forward_dynamics(t, y, scene, modes)
        guards = [] if modes is None else [d.guards(jnp.asarray(1e-12), (jnp.asarray(1e-6), jnp.asarray(1e-9)))[0]]
        reactions = [each.multiplier for each in d.reactions.values()]
        return [jnp.ravel(x) for x in jtu.tree_leaves((d.rate, guards, list(d.forces.values()), reactions))]

    def flat(knowns: Any) -> Any:
        return jnp.concatenate(
            everything(knowns[0], unflattened(scene, knowns[1:first]), unflattened(y, knowns[first:]))
        )

    at_start = jnp.concatenate([jnp.ravel(x) for x in jtu.tree_leaves((jnp.zeros(()), scene, y))])
    exact = np.asarray(jax.jit(jax.jacfwd(flat))(at_start))
    unknowns = list(range(first + n, first + n + exact.shape[0]))
    knowns, seeds = [0, *numbers, *states], np.random.default_rng(0)
    scale = np.max(np.abs(exact), axis=1)
    for _ in range(3):
        along = seeds.normal(size=exact.shape[1])
        found = one.getDirectionalDerivative(unknowns, knowns, along)
        np.testing.assert_allclose(found, exact @ along, rtol=0, atol=1e-12 * max(scale) * exact.shape[1])
        weights = seeds.normal(size=exact.shape[0])
        back = one.getAdjointDerivative(unknowns, knowns, weights, len(knowns))
        np.testing.assert_allclose(back, weights @ exact, rtol=0, atol=1e-12 * max(scale) * exact.shape[0])
    assert one.getDirectionalDerivative(states[:1], states, np.arange(1.0, 1.0 + n)) == [1.0]
    one.freeInstance()


def unflattened(like: Any, entries: Any) -> Any:
    leaves, at = [], 0
    for leaf in jtu.tree_leaves(like):
        leaves.append(jnp.reshape(jnp.asarray(entries[at : at + np.size(leaf)]), np.shape(leaf)))
        at += np.size(leaf)
    return jtu.tree_unflatten(jtu.tree_structure(like), leaves)


def stepped(one: Any, times: Any, h: float, place: int) -> list[float]:
    found = []
    for t in times:
        one.doStep(float(t), h)
        found += one.getFloat64([place])
    return found


@needs_fmpy
def test_a_saved_state_continues_bit_by_bit_in_another_instance() -> None:
    one, other, x = instance("belt"), instance("belt"), references("belt")["x"]
    times = np.arange(30) / 20
    stepped(one, times, 0.05, x)
    saved = one.getFMUState()
    data = one.serializeFMUState(saved)
    ahead = stepped(one, 1.5 + times, 0.05, x)
    restored = other.deserializeFMUState(data)
    other.setFMUState(restored)
    assert stepped(other, 1.5 + times, 0.05, x) == ahead
    one.setFMUState(saved)
    assert stepped(one, 1.5 + times, 0.05, x) == ahead
    one.freeFMUState(saved)
    other.freeFMUState(restored)
    other.reset()
    other.enterInitializationMode(tolerance=1e-6, startTime=0.0)
    other.exitInitializationMode()
    assert other.getFloat64([x]) == [0.0]
    one.freeInstance()
    other.freeInstance()


# Counts calls of the allocator while an instance steps through events, and is reset, saved and restored.
_HARNESS = """
#include <stdio.h>
#include <stdlib.h>
#include <stdbool.h>
#include "fmi3.h"
#include "model.h"
static int calls;
void *__real_malloc(size_t); void *__real_calloc(size_t, size_t); void *__real_realloc(void *, size_t);
void *__wrap_malloc(size_t n) { ++calls; return __real_malloc(n); }
void *__wrap_calloc(size_t n, size_t m) { ++calls; return __real_calloc(n, m); }
void *__wrap_realloc(void *p, size_t n) { ++calls; return __real_realloc(p, n); }
int main(void) {
  bool event, stop, early, again, known, states;
  double last, next, along = 1.0, out;
  int events = 0;
  fmi3ValueReference one = POSITION, of = ACCELERATION;
  fmi3FMUState saved = NULL;
  fmi3Instance c = fmi3InstantiateCoSimulation("one", TOKEN, "", 0, 0, 1, 1, NULL, 0, NULL, NULL, NULL);
  const int made = calls;
  fmi3EnterInitializationMode(c, true, 1e-6, 0.0, false, 0.0);
  fmi3ExitInitializationMode(c);
  do fmi3UpdateDiscreteStates(c, &again, &stop, &known, &states, &event, &next); while (again);
  fmi3EnterStepMode(c);
  for (double t = 0.0; t < 5.0; t = last) {
    if (fmi3DoStep(c, t, 0.05, true, &event, &stop, &early, &last) != fmi3OK) return 1;
    if (!event) continue;
    ++events;
    fmi3EnterEventMode(c);
    do fmi3UpdateDiscreteStates(c, &again, &stop, &known, &states, &event, &next); while (again);
    fmi3EnterStepMode(c);
  }
  if (fmi3GetDirectionalDerivative(c, &of, 1, &one, 1, &along, 1, &out, 1) != fmi3OK) return 2;
  const int stepped = calls;
  fmi3GetFMUState(c, &saved);
  const int kept = calls;
  fmi3SetFMUState(c, saved);
  fmi3Reset(c);
  printf("%d %d %d %d %d\\n", events, made, stepped - made, kept - stepped, calls - kept);
  fmi3FreeFMUState(c, &saved);
  fmi3FreeInstance(c);
  return 0;
}
"""


@needs_fmpy
@pytest.mark.skipif(shutil.which("gcc") is None, reason="needs gcc, whose linker replaces the allocator")
def test_steps_and_events_allocate_no_memory(tmp_path: Path) -> None:
    """One allocation for the instance and one for a saved state; none in steps, events and derivatives."""
    places, sources = references("belt"), Path(unpacked("belt")) / "sources"
    (tmp_path / "harness.c").write_text(_HARNESS)
    wrapped = [f"-Wl,--wrap={name}" for name in ("malloc", "calloc", "realloc")]
    numbers = [f"-DPOSITION={places['x']}", f"-DACCELERATION={places['der(x_dot)']}"]
    files = [str(tmp_path / "harness.c"), *map(str, sorted(sources.glob("*.c")))]
    command = ["gcc", "-std=c99", "-I", str(sources), *numbers, *wrapped, *files, "-o", str(tmp_path / "run"), "-lm"]
    subprocess.run(command, check=True, capture_output=True)
    done = subprocess.run([str(tmp_path / "run")], check=True, capture_output=True, text=True)
    events, made, stepped, saved, restored = map(int, done.stdout.split())
    assert events > 5
    assert (made, stepped, saved, restored) == (1, 0, 1, 0)


@needs_fmpy
def test_an_importer_ends_a_step_early() -> None:
    seen: list[float] = []

    def look(*call: Any) -> None:
        (_, t, _, _, _, may, ask, _) = call
        seen.append(t)
        ask[0] = bool(may and t > 1.0)

    one = instance("belt", earlyReturnAllowed=True, intermediateUpdate=look)
    event, _, early, last = one.doStep(0.0, 5.0)
    assert (event, early) == (False, True)
    assert last == seen[-1]
    assert 1.0 < last < 5.0
    assert all(t <= 1.0 for t in seen[:-1])
    one.freeInstance()


@needs_fmpy
def test_inputs_and_parameters_change_while_it_runs(tmp_path: Path) -> None:
    scene = jms.Scene(
        lambda t, q, qd, p: 0.5 * p["m"] * qd[0] ** 2,
        {"m": 2.0, "pull": jms.Signal([0.0, 1.0], [0.5, 6.0])},
        (
            jms.AppliedForce(lambda t, q, qd, p: p["pull"][None], name="motor"),
            jms.Friction(jms.Coulomb(3.0, 4.0)),
        ),
        coordinates=("x [mm]",),
    )
    path = jms.export.fmu(
        scene, [0.0], [0.0], tmp_path / "cart.fmu", inputs=["friction.belt_velocity"], platforms=[OWN],
        outputs={"height [m]": lambda t, q, qd, p: 2.0 * q[0] + p["m"]},
    )  # fmt: skip
    description = fmpy.read_model_description(str(path))
    kinds = {each.name: (each.causality, each.variability) for each in description.modelVariables}
    assert kinds["pull"] == kinds["friction.belt_velocity"] == ("input", "discrete")
    assert kinds["m"] == ("parameter", "tunable")
    given = np.array(
        [(0.0, 0.5, 0.0), (1.0, 6.0, 0.0), (2.0, 0.0, 0.0), (4.0, 0.0, 1.0)],
        dtype=[("time", float), ("pull", float), ("friction.belt_velocity", float)],
    )
    # Rest, 1.5 m/s^2 for a second, 1 s of slip to rest, then the belt drags with 1.5 m/s^2, up to its velocity.
    for kind in ("CoSimulation", "ModelExchange"):
        rows = fmpy.simulate_fmu(str(path), fmi_type=kind, stop_time=5.0, output_interval=0.25, input=given)
        last = rows[-1]
        speed = {t: rows["x_dot"][int(np.argmin(np.abs(rows["time"] - t)))] for t in (1.0, 2.0, 3.5, 5.0)}
        assert speed[1.0] == 0.0
        assert speed[2.0] == pytest.approx(1.5, abs=1e-5)
        assert speed[3.5] == pytest.approx(0.0, abs=1e-8)
        assert speed[5.0] == pytest.approx(1.0, abs=1e-5)
        assert last["x"] == pytest.approx(0.75 + 0.75 + 1.0 / 3.0 + 1.0 / 3.0, abs=1e-4)
        assert last["height"] == pytest.approx(2.0 * last["x"] + 2.0, abs=1e-9)
        assert last["friction.mode"] == 0


def test_refusals_come_by_name_before_anything_is_written(tmp_path: Path) -> None:
    scene = belt_oscillator.scene()
    path = tmp_path / "belt.fmu"

    def refused(match: str, scene: Any = scene, to: Path = path, **options: Any) -> None:
        with pytest.raises(ValueError, match=match):
            jms.export.fmu(scene, [0.0], [0.0], to, **{"platforms": (), **options})
        assert not list(tmp_path.iterdir())

    refused("NAME.fmu", to=tmp_path / "a b.fmu")
    refused("no number 'friction.belt'.*belt_velocity", inputs=["friction.belt"])
    refused("unknown platform 'amiga'", platforms=["amiga"])

    waits = jms.AppliedForce(lambda t, q, qd, p: jax.lax.while_loop(lambda x: x[0] < 1.0, lambda x: x * 2.0, qd + 0.1))
    endless = jms.Scene(scene.lagrangian, scene.params, (waits,))
    refused("while", scene=endless)


@pytest.mark.skipif(_compile.compiler_of("x86_64-windows") is None, reason="needs ziglang, which compiles for all")
def test_one_machine_compiles_for_all(tmp_path: Path) -> None:
    path = jms.export.fmu(ramped_box.scene(ramped_box.lugre()), [0.0], [0.0], tmp_path / "box.fmu")
    magic = {"linux": b"\x7fELF", "windows": b"MZ", "darwin": b"\xcf\xfa\xed\xfe"}
    with zipfile.ZipFile(path) as archive:
        binaries = [name for name in archive.namelist() if name.startswith("binaries/")]
        for name in binaries:
            content = archive.read(name)
            assert content.startswith(magic[name.split("/")[1].split("-")[1]])
            assert b"fmi3GetAdjointDerivative" in content
    assert {name.split("/")[1] for name in binaries} == set(_compile.PLATFORMS)


def test_units_have_base_units() -> None:
    assert base_unit("N s/m") == (1.0, {"kg": 1, "s": -1})
    assert base_unit("kg m^2/s") == (1.0, {"kg": 1, "m": 2, "s": -1})
    assert base_unit("1/s") == (1.0, {"s": -1})
    assert base_unit("mm/s") == (1e-3, {"m": 1, "s": -1})
    assert base_unit("N/m^n") is None
