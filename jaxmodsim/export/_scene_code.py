"""A scene as C99, for a drive, a controller or a web page."""

import inspect
import re
from collections import Counter
from collections.abc import Callable

import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, PyTree

from .._core.arguments import as_whole
from ..scene import (
    Scene,
    State,
    check_scene,
    check_step,
    compensating_force,
    elements,
    scene_step,
    signals_of,
    state_names,
    vector_field,
)
from ._c_code import literal, type_of, unused, write_function

_C_TEXT = """\
/* {name}: a scene of jaxmodsim as C99. Generated; change the scene, not this file. Units are SI. */
#include <math.h>

/* Places in p, the numbers of the scene. */
enum {{
{places}
  {name}_P
}};
/* Entries of y: {states}. */
enum {{ {name}_Y = {size}, {name}_DOF = {dof} }};

extern const {real} {name}_numbers[{name}_P], {name}_rest[{name}_Y];
{prototypes}

/* The numbers with which the scene was written. */
const {real} {name}_numbers[{name}_P] = {{{numbers}}};
/* The state at rest at the origin. */
const {real} {name}_rest[{name}_Y] = {{{rest}}};

{routines}
/* Steps of the length h from the time t, one after another; false (0) if one was not solved. */
{run} {{
  for (long i = 0; i < steps; ++i) {{
    if (!{name}_step(t + i * h, t + (i + 1) * h, p, y)) return 0;
  }}
  return 1;
}}
"""


# The functions of the generated code, with the numbers `p` and the state `y`; their docstrings become comments.


def _rate(t: Array, p: Scene, y: State) -> PyTree:
    """Rates of the state y at the time t."""
    return vector_field(t, y, p)


def _step(t0: Array, t1: Array, p: Scene, y: State) -> PyTree:
    """One step of ImplicitFriction from t0 to t1; false (0) where it is not solved, or y is not finite after it."""
    after, solved = scene_step(p, t0, t1, y)
    return after, solved & jnp.all(jnp.isfinite(ravel_pytree(after)[0]))


def _friction(t0: Array, t1: Array, p: Scene, y: State) -> PyTree:
    """Force that makes up for friction at the motion in y; states of the laws in y go from t0 to t1."""
    return compensating_force(p, t0, t1, y)


def to_c(scene: Scene, dof: int = 1, *, name: str = "scene") -> str:
    """C99 code of a scene: its right-hand side, steps of `ImplicitFriction`, and a friction feed-forward.

    For a drive, copy the text to `NAME.c` of its project, and the prototypes at its beginning to a header. The
    functions allocate no memory and have no internal state, and every loop has a constant bound:

    - `NAME_rate(t, p, y, rate)`: rates of the state `y`, for an observer or another solver.
    - `NAME_step(t0, t1, p, y)`: one step of `ImplicitFriction`, in place; returns 0 if its equations were not solved,
      or the state is not finite.
    - `NAME_run(t, h, steps, p, y)`: several steps, the same as `simulate(..., dt=h)`.
    - `NAME_friction(t0, t1, p, y, force)`, for scenes with friction: the force that compensates friction in each cycle.
      Write the planned coordinates and velocities to `y`; the function advances the states of the laws in `y`.

    `p` has the numbers of the scene at the indices of an enumeration, `p[NAME_p_friction_Fc]`. Initial values are
    `NAME_numbers`, the numbers of the exported scene, and `NAME_rest`, the state at rest. An input of each cycle, such
    as a torque or a temperature, is a number in `p`. If nothing depends on time explicitly, pass the times 0 and h,
    which avoids rounding of large times.

    Numbers are `double` for a scene in float64 and `float` for one in float32, for units without `double`. Results
    equal those of JAX to four units in the last place of their terms, if the compiler neither reorders sums nor ignores
    NaN (no `-ffast-math`).

    The feed-forward in a control loop:

    ```c
    static double y[press_Y], u[press_DOF];        /* q, qd, bristle; begins as a copy of press_rest */
    y[0] = q_plan, y[1] = qd_plan;                 /* every millisecond */
    press_friction(0.0, 1e-3, press_numbers, y, u);
    torque += u[0];
    ```

    **Arguments:**

    - `scene`: the `Scene`. Set-valued laws need the wrapper `Regularized`. Constraints are not supported; replace a
      `Signal` by a number, which the caller sets.
    - `dof`: number of coordinates.
    - `name`: prefix of the names in the code, an identifier.

    **Returns:**

    The text of one file.

    **Raises:**

    - `ValueError` for an unsupported operation of JAX, a loop without a bound, a friction element that
      `ImplicitFriction` does not support, a constraint, a `Signal`, and a name that is not an identifier.

    **Example:**

    ```python
    scene = jms.problems.ramped_box.scene(jms.problems.ramped_box.lugre())
    code = jms.to_c(scene, name="box")
    print(next(line for line in code.splitlines() if "box_step" in line))
    ```

    ```text
    int box_step(double t0, double t1, const double p[box_P], double y[box_Y]);
    ```
    """
    if not isinstance(scene, Scene):
        raise ValueError(f"to_c needs a Scene, but {scene!r} was given.")
    if not (isinstance(name, str) and name.isidentifier() and name.isascii()):
        raise ValueError(f"to_c: name must be an identifier such as 'press', but {name!r} was given.")
    dof = as_whole(dof, name="dof")
    if scene.constraints:
        raise ValueError(
            f"to_c does not support constraints, but the scene has {', '.join(map(repr, scene.constraint_names))}:"
            " use independent coordinates."
        )
    if signals_of(scene.params):
        raise ValueError(
            "to_c does not support a Signal: replace it by a number, which the caller sets before every step."
        )
    check_step(scene)
    start = jnp.zeros(dof, jnp.result_type(*(jtu.tree_leaves(scene) or [float])))
    y = State(start, start, scene.initial_state(start))
    check_scene(scene, y)
    places = {f"{name}_p_{re.sub('[^0-9A-Za-z]+', '_', each).strip('_')}": each for each in elements(scene)}
    if len(places) < len(elements(scene)):
        raise ValueError(f"to_c: several numbers of the scene have the same name in C: {', '.join(elements(scene))}.")
    results, real = _results_of(scene, y), type_of(start.dtype)
    run = f"int {name}_run({real} t, {real} h, long steps, const {real} p[{name}_P], {real} y[{name}_Y])"
    numbers, rest = (
        ", ".join(literal(x) for leaf in jtu.tree_leaves(tree) for x in np.ravel(leaf)) for tree in (scene, y)
    )
    return _C_TEXT.format(
        name=name,
        routines="\n".join(_routine_text(*each, scene, y, name) for each in results.items()),
        numbers=numbers,
        rest=rest,
        places="\n".join(f"  {place}, /* {each} */" for place, each in places.items()),
        states=", ".join(state_names(y)),
        size=len(state_names(y)),
        dof=dof,
        real=real,
        prototypes="\n".join([*(_c_signature(*each, name, real) + ";" for each in results.items()), run + ";"]),
        run=run,
    )


def _results_of(scene: Scene, y: State) -> dict[Callable[..., PyTree], list[str]]:
    """The variables of the results of each function of the generated code."""
    size, dof = len(state_names(y)), y.q.shape[0]
    results: dict[Callable[..., PyTree], list[str]] = {
        _rate: [f"rate[{i}]" for i in range(size)],
        _step: [*(f"y[{i}]" for i in range(size)), "return"],
    }
    if scene.friction:
        results[_friction] = [f"force[{i}]" for i in range(dof)] + [f"y[{i}]" for i in range(2 * dof, size)]
    return results


def _routine_text(fn: Callable[..., PyTree], results: list[str], scene: Scene, y: State, name: str) -> str:
    known = {"p": scene, "y": y}
    arguments = {x: known.get(x, jnp.zeros((), y.q.dtype)) for x in inspect.signature(fn).parameters}
    try:
        lines = write_function(fn, arguments, lambda _: results)
    except ValueError as error:
        raise ValueError(
            f"to_c does not support {error}, which `{fn.__name__[1:]}` of the scene needs. It supports arithmetic,"
            " elementary functions and choices (jnp.where) of scalars and small arrays: express the Lagrangian, force"
            " or law by these."
        ) from error
    head = [f"/* {inspect.getdoc(fn) or fn.__name__} */", _c_signature(fn, results, name, type_of(y.q.dtype)) + " {"]
    return "\n".join([*head, *unused(arguments, lines), *lines, "}\n"])


def _c_signature(fn: Callable[..., PyTree], results: list[str], name: str, real: str) -> str:
    sizes = Counter(each.partition("[")[0] for each in results)
    constant = "" if {"y", "return"} & set(sizes) else "const "
    known = {"p": f"const {real} p[{name}_P]", "y": f"{constant}{real} y[{name}_Y]"}
    arguments = [known.get(x, f"{real} {x}") for x in inspect.signature(fn).parameters]
    arguments += [f"{real} {x}[{size}]" for x, size in sizes.items() if x not in ("y", "return")]
    return f"{'int' if 'return' in sizes else 'void'} {name}{fn.__name__}({', '.join(arguments)})"
