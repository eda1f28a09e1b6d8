"""A scene as an FMU, a component of system simulators by the standard FMI 3.0."""

import dataclasses
import hashlib
import tempfile
import zipfile
from collections.abc import Callable, Mapping, Sequence
from os import PathLike
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

from .._core.arguments import as_mapping, as_names, did_you_mean
from ..scene import (
    Scene,
    Signal,
    State,
    check_scene,
    elements,
    quantity_of,
    read_element,
    scene_ranges,
    scene_units,
    state_names,
)
from ._compile import PLATFORMS, compile_library, compiler_of, own_platform
from ._fmu_description import FmuVariable, describe
from ._fmu_model import Model, header, series_of, write_model

_WRITTEN = ("fmi3.c", "fmi3.h", "motion.c", "motion.h")
_BUILD = """\
<?xml version="1.0" encoding="UTF-8"?>
<fmiBuildDescription fmiVersion="3.0">
  <BuildConfiguration modelIdentifier="{name}">
    <SourceFileSet language="C99">
      <SourceFile name="fmi3.c"/>
      <SourceFile name="motion.c"/>
      <SourceFile name="model.c"/>
    </SourceFileSet>
    <Library name="m" external="true"/>
  </BuildConfiguration>
</fmiBuildDescription>
"""
PARAMETER, CONTINUOUS, DISCRETE = range(3)


def fmu(
    scene: Scene,
    q0: Any,
    qd0: Any,
    path: str | PathLike[str],
    *,
    inputs: Sequence[str] = (),
    outputs: Mapping[str, Callable[..., Any]] | None = None,
    t1: float = 1.0,
    rtol: float = 1e-6,
    atol: float = 1e-9,
    platforms: Sequence[str] | None = None,
) -> Path:
    """Write a scene as an FMU of FMI 3.0, for model exchange and co-simulation.

    The file contains C sources and compiled libraries, which need no Python. Variables have the names of the scene:

    - Coordinates `x` and velocities `x_dot` are continuous states and outputs, with start values. Their rates are
      `der(x)`, states of laws `friction.z`.
    - Numbers of the scene are tunable parameters, except `inputs`. A `Signal` is an input: a linear one is continuous,
      a held one discrete; its start value is the one at t = 0.
    - Outputs are the force of each effect by its name, the multipliers of each constraint by its name, the modes
      (`friction.mode`: -1, 0, 1; a contact: 0, 1; a switch: -1, 1), and `outputs`.
    - Event indicators `friction.guard` are positive while a mode holds.

    Parameters and discrete inputs change in events; then modes are decided anew, as at the start of a run.
    Directional and adjoint derivatives of rates, event indicators and outputs by time, numbers and states are exact.

    In co-simulation the FMU integrates with `Rodas5P` and error control, and locates its events in the step. With the
    event mode of the importer, and early return, each event ends a step. Memory is allocated for instances and saved
    states alone.

    **Arguments:**

    - `scene`: the `Scene`, in float64.
    - `q0`, `qd0`: start values of coordinates and velocities, shape `[dof]`.
    - `path`: the file, `NAME.fmu`; NAME, an identifier, is the name of the model.
    - `inputs`: names of numbers that are inputs: `"torque"`, `"friction.belt_velocity"`. Numbers in `params` are
      continuous inputs, others are discrete ones. Constraints and displacements use the value of an input, not its
      rate.
    - `outputs`: further outputs by name, with a unit in brackets: `{"height [m]": fn}`, where `fn(t, q, qd, params)`
      returns one number or an array.
    - `t1`: end of the default experiment [s].
    - `rtol`, `atol`: default tolerances of co-simulation, as in `simulate`. A tolerance of the importer replaces
      `rtol`, and scales `atol`.
    - `platforms`: platforms of the compiled libraries, such as `("x86_64-linux",)`. By default Linux and macOS for
      x86_64 and aarch64, and Windows for x86_64, if the package `ziglang` is installed (`jaxmodsim[fmi]`); else this
      platform, by the system's compiler. With `()` the FMU has sources only.

    **Returns:**

    The path of the file.

    **Raises:**

    - `ValueError` before anything is written, for a scene in float32, an unsupported operation of JAX, a loop without a
      known limit, an unknown input, equal names, and a platform without a compiler.
    - `RuntimeError` with the message of a compiler that fails.

    **Example:**

    ```python
    scene = jms.problems.belt_oscillator.scene()
    path = jms.export.fmu(scene, [0.0], [0.1], "belt.fmu", inputs=["friction.belt_velocity"], platforms=())
    print(path.name)
    ```

    ```text
    belt.fmu
    ```
    """
    path, targets = _path(path), _targets(platforms)
    if not isinstance(scene, Scene):
        raise ValueError(f"fmu needs a Scene, but {scene!r} was given.")
    model, kinds = _model(scene, q0, qd0, as_names(inputs, name="fmu inputs"), outputs)
    numbers = [read_element(model.scene, each) for each in elements(model.scene)]
    states = [float(x) for leaf in jtu.tree_leaves(model.y) for x in np.ravel(leaf)]
    prototypes, functions = write_model(model)
    units = {name.partition("[")[0].strip(): name.partition("[")[2].strip(" ]") for name in outputs or ()}
    variables, guards = _variables(model, numbers, states, kinds, units)
    run = {"startTime": 0.0, "stopTime": t1, "tolerance": rtol}
    text = describe(path.stem, "TOKEN", variables, guards, run)
    sources = {each: (Path(__file__).parent / each).read_text() for each in _WRITTEN}
    declared = header(model, numbers, states, kinds, RTOL=rtol, ATOL=atol)
    token = hashlib.sha256("".join([text, declared, functions, *sources.values()]).encode()).hexdigest()
    text = text.replace('"TOKEN"', f'"{token}"', 1)
    sources["model.h"] = (
        f"/* Generated. Numbers of the scene: {', '.join(elements(model.scene))}. */\n"
        f'#ifndef MODEL_H\n#define MODEL_H\n#define TOKEN "{token}"\n{declared}\n{prototypes}\n#endif\n'
    )
    sources["model.c"] = f'/* Generated. */\n#include "model.h"\n#include <math.h>\n\n{functions}'
    sources["buildDescription.xml"] = _BUILD.format(name=path.stem)
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        (folder / "sources").mkdir()
        for name, each in sources.items():
            (folder / "sources" / name).write_text(each)
        (folder / "modelDescription.xml").write_text(text)
        compiled = [folder / "sources" / name for name in sources if name.endswith(".c")]
        for target in targets:
            compile_library(compiled, target, folder / "binaries" / target / (path.stem + PLATFORMS[target][0]))
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
            for each in sorted(x for x in folder.rglob("*") if x.is_file()):
                archive.write(each, each.relative_to(folder).as_posix())
    return path


def _path(path: str | PathLike[str]) -> Path:
    path = Path(path)
    if path.suffix != ".fmu" or not (path.stem.isidentifier() and path.stem.isascii()):
        raise ValueError(f"fmu: path must be NAME.fmu with an identifier for NAME, such as press.fmu, but got {path}.")
    return path


def _targets(platforms: Sequence[str] | None) -> tuple[str, ...]:
    able = [each for each in PLATFORMS if compiler_of(each) is not None]
    if platforms is None:
        if not able:
            raise ValueError(
                f"fmu: there is no C compiler for {own_platform()}: install jaxmodsim[fmi], or pass platforms=() for an"
                " FMU with sources only."
            )
        return tuple(able)
    for each in as_names(platforms, name="fmu platforms"):
        if each not in PLATFORMS:
            raise ValueError(f"fmu: unknown platform {each!r}; the platforms are {', '.join(PLATFORMS)}.")
        if each not in able:
            raise ValueError(f"fmu: there is no C compiler for {each}: install jaxmodsim[fmi].")
    return tuple(platforms)


def _model(
    scene: Scene, q0: Any, qd0: Any, inputs: Sequence[str], outputs: Mapping[str, Callable[..., Any]] | None
) -> tuple[Model, list[int]]:
    """The scene with numbers in place of signals, and the kind of each number."""
    zero = jnp.zeros(())
    params = jax.tree.map(lambda x: x.piece(zero).at(zero) if _is_signal(x) else x, scene.params, is_leaf=_is_signal)
    kinds = jax.tree.map(
        lambda x: (CONTINUOUS if x.linear else DISCRETE) * jnp.ones(()) if _is_signal(x) else -jnp.ones_like(x),
        scene.params,
        is_leaf=_is_signal,
    )
    scene = dataclasses.replace(scene, params=params)
    for leaf in jtu.tree_leaves((scene, jnp.asarray(q0, float))):
        if jnp.asarray(leaf).dtype != np.float64:
            raise ValueError(
                f"fmu needs a scene in float64, but it has numbers in {jnp.asarray(leaf).dtype}: call"
                ' jax.config.update("jax_enable_x64", True) before the scene is made.'
            )
    # A number in `params` that is no signal is marked by -1.
    marked = dataclasses.replace(jax.tree.map(jnp.zeros_like, scene), params=kinds)
    marks = {name: int(read_element(marked, name)) for name in elements(marked)}
    for name in inputs:
        if name not in marks:
            raise ValueError(
                f"fmu inputs: the scene has no number {name!r}; its numbers are {', '.join(marks)}."
                f"{did_you_mean(name, marks)}"
            )
        marks[name] = {-1: CONTINUOUS, 0: DISCRETE}.get(marks[name], marks[name])
    q, qd = jnp.asarray(q0, float), jnp.asarray(qd0, float)
    if q.ndim != 1 or q.shape != qd.shape:
        raise ValueError(f"fmu: q0 and qd0 need the shape [dof], but have the shapes {q.shape} and {qd.shape}.")
    y = State(q, qd, scene.initial_state(q))
    check_scene(scene, y)
    projects = bool(scene.bilateral or scene.contacts) or scene.stick_drifts
    given = as_mapping(outputs, name="fmu outputs", example="{'height [m]': fn}")
    named = {name.partition("[")[0].strip(): fn for name, fn in given.items()}
    return Model(scene, y, scene.num_modes(q.shape[0]), projects, named), [max(x, 0) for x in marks.values()]


def _is_signal(x: object) -> bool:
    return isinstance(x, Signal)


def _variables(
    model: Model, numbers: Sequence[float], states: Sequence[float], kinds: Sequence[int], units: Mapping[str, str]
) -> tuple[list[FmuVariable], range]:
    """All variables in the order of their value references, and the references of the event indicators.

    **Raises:**

    - `ValueError` if two variables have the same name.
    """
    scene, known, ranges = model.scene, scene_units(model.scene), scene_ranges(model.scene)
    variables = [FmuVariable("time", 0, "independent", "continuous", unit="s")]

    def add(name: str, causality: str, variability: str, **more: Any) -> None:
        variables.append(FmuVariable(name, len(variables), causality, variability, **more))

    for (name, (array, _)), start, kind in zip(elements(scene).items(), numbers, kinds, strict=True):
        causality, variability = (("parameter", "tunable"), ("input", "continuous"), ("input", "discrete"))[kind]
        least = ranges[array].lower if array in ranges else None
        least = float(least) if isinstance(least, float | int) and np.isfinite(least) else None
        add(name, causality, variability, start=start, unit=_unit(known.get(array, "")), least=least)
    first, dof = len(variables), model.y.q.shape[0]
    labels = [quantity_of(scene, name) for name in state_names(model.y)]
    for i, (label, start) in enumerate(zip(labels, states, strict=True)):
        add(label.name, "output" if i < 2 * dof else "local", "continuous", start=start, unit=_unit(label.unit))
    for i, label in enumerate(labels):
        unit = _unit(f"{label.unit}/s") if label.unit else ""
        add(f"der({label.name})", "local", "continuous", unit=unit, derivative=first + i)
    guards = range(len(variables), len(variables) + model.modes)
    widths = scene.mode_widths(dof)
    kinks = [f"kink_{i + 1}" for i in range(scene.num_kinks)]
    for name, width in zip([*scene.mode_names, *kinks], [*widths, *[1 for _ in kinks]], strict=True):
        for each in _components(f"{name}.guard", (width,) if width > 1 else ()):
            add(each, "local", "continuous")
    for name, shape in series_of(model).items():
        for each in _components(name, shape):
            add(each, "output", "continuous", unit=_unit(units.get(name, quantity_of(scene, each).unit)))
    for name in scene.mode_names:
        add(f"{name}.mode", "output", "discrete", integer=True)
    names = [each.name for each in variables]
    for name in names:
        if names.count(name) > 1:
            raise ValueError(f"fmu: two variables have the name {name!r}: rename the number, coordinate or effect.")
    return variables, guards


def _components(name: str, shape: tuple[int, ...]) -> list[str]:
    return [name + (f"[{','.join(map(str, i))}]" if i else "") for i in np.ndindex(*shape)]


def _unit(text: str) -> str:
    """A unit, or nothing for one that is not known, such as `N or N m`."""
    return "" if " or " in text or text in ("-", "1") else text
