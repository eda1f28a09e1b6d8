"""The equations of a scene as C functions of flat arrays: rates, guards, events, outputs and their derivatives."""

import inspect
import json
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, PyTree

from .._core.parameters import range_checks
from ..mechanics import motion_equations, project
from ..scene import Scene, State, forward_dynamics, start, switch, vector_field
from ..solvers import RODAS5P
from ._c_code import unused, write_function

# Arguments of the functions: scalars, and arrays that a function reads or changes in place.
_READ = {x: f"double {x}" for x in ("t", "along", "dense", "least")}
_READ |= {x: f"const double *{x}" for x in ("p", "y", "m", "tol", "fired", "dp", "dy", "seed")}


class Model(NamedTuple):
    """A scene with the parts of an FMU.

    The functions in C that `_routines` names have the arguments and the docstrings of their methods.

    - `scene`: the scene; `y`: its initial state.
    - `modes`: number of entries of all modes; `projects`: whether constraints or stick drift.
    - `outputs`: functions of (t, q, qd, params) by name, beside the forces and reactions.
    """

    scene: Scene
    y: State
    modes: int
    projects: bool
    outputs: Mapping[str, Callable[..., Any]]

    @property
    def mode(self) -> Array:
        """Modes of zero."""
        return jnp.zeros(self.modes)

    def modes_or_none(self, mode: Array) -> Array | None:
        """`mode`, or None for a scene without modes."""
        return mode if self.modes else None

    def observe(self, t: Array, y: State, scene: Scene, mode: Array) -> tuple[Any, dict[str, Array]]:
        """Dynamics, and outputs by name."""
        dynamics = forward_dynamics(t, y, scene, self.modes_or_none(mode))
        observed = dict(dynamics.forces)
        observed |= {name: each.multiplier for name, each in dynamics.reactions.items()}
        bound = scene.bind_state(t, y.q, y.qd).params
        observed |= {name: jnp.asarray(fn(t, y.q, y.qd, bound), y.q.dtype) for name, fn in self.outputs.items()}
        return dynamics, observed

    def rate(self, t: Array, p: Scene, y: State, m: Array) -> PyTree:
        """Rates of the state."""
        return vector_field(t, y, p, self.modes_or_none(m))

    def linear(self, t: Array, p: Scene, y: State, m: Array) -> PyTree:
        """Rates, their derivative by time, and their Jacobian by rows."""
        flat, unravel = ravel_pytree(y)

        def field(ty: Array) -> tuple[Array, Array]:
            out, _ = ravel_pytree(self.rate(ty[0], p, unravel(ty[1:]), m))
            return out, out

        jacobian, rates = jax.jacfwd(field, has_aux=True)(jnp.concatenate([t[None], flat]))
        return rates, jacobian[:, 0], jacobian[:, 1:]

    def evaluate(self, t: Array, p: Scene, y: State, m: Array, tol: Array) -> PyTree:
        """Rates, guards and outputs."""
        dynamics, outputs = self.observe(t, y, p, m)
        guards = dynamics.guards(tol[0], (tol[1], tol[2]))[0] if self.modes else ()
        return dynamics.rate, guards, list(outputs.values())

    def push(self, t: Array, p: Scene, y: State, m: Array, tol: Array, along: Array, dp: Scene, dy: State) -> PyTree:
        """Directional derivative of model_evaluate, along time, numbers and states."""
        return jax.jvp(lambda t, p, y: self.evaluate(t, p, y, m, tol), (t, p, y), (along, dp, dy))[1]

    def pull(self, t: Array, p: Scene, y: State, m: Array, tol: Array, seed: Array) -> PyTree:
        """Adjoint derivative of model_evaluate, by time, numbers and states."""
        out, transposed = jax.vjp(lambda t, p, y: self.evaluate(t, p, y, m, tol), t, p, y)
        return transposed(ravel_pytree(out)[1](seed))

    def guards(self, t: Array, p: Scene, y: State, m: Array, tol: Array) -> PyTree:
        """Guards, their tolerances, and their values at events."""
        values, limits, roots = forward_dynamics(t, y, p, m).guards(tol[0], (tol[1], tol[2]))
        slips, *others = p.split_modes(roots)  # doubles resolve the roots of friction
        return values, limits, jnp.concatenate([jnp.zeros_like(slips), *others])

    def on_constraints(self, t: Array, p: Scene, y: State, m: Array) -> State:
        """The state on the constraints."""
        if not p.bilateral and not p.contacts:
            return y
        p = p.bind_state(t, y.q, y.qd)
        mass = motion_equations(p.lagrangian, t, y.q, y.qd, p.params).mass
        q, qd = project(p.constraints_in(self.modes_or_none(m)), t, y.q, y.qd, p.params, mass)
        return y._replace(q=q, qd=qd)

    def projected(self, t: Array, p: Scene, m: Array, y: State) -> State:
        """The state on the constraints, without slip in stick."""
        y = self.on_constraints(t, p, y, m)
        return forward_dynamics(t, y, p, m).stick(m) if p.stick_drifts else y

    def ranges(self, p: Scene) -> list[Array]:
        """Whether each of the `requirements` holds, as 1 or 0."""
        return [jnp.where(holds, 1.0, 0.0) for _, holds in range_checks(p)]

    @property
    def requirements(self) -> list[str]:
        """Admissible ranges of the numbers, as sentences."""
        return [text for text, _ in range_checks(self.scene)]

    def begin(self, t: Array, p: Scene, tol: Array, y: State, m: Array) -> tuple[State, Array]:
        """State and modes at the start."""
        y = self.on_constraints(t, p, y, jnp.zeros_like(m))
        return start(t, y, p, m, tol[0]) if self.modes else (y, m)

    def after(
        self, t: Array, p: Scene, tol: Array, fired: Array, dense: Array, least: Array, y: State, m: Array
    ) -> tuple[State, Array]:
        """State and modes after the guards that fired; dense: whether impacts accumulate; least: a rebound's height."""
        rate = vector_field(t, y, p, m) if p.contacts else None
        y, m, touching = switch(t, y, p, m, fired > 0, tol[0], dense > 0, False, rate, least)
        return self.on_constraints(t, p, y, touching) if p.contacts else y, m


def series_of(model: Model) -> dict[str, tuple[int, ...]]:
    """Shapes of the outputs by name, in their order; JAX sorts the keys of mappings."""
    t, names = jnp.zeros(()), []

    def values(y: State, scene: Scene) -> list[Array]:
        outputs = model.observe(t, y, scene, model.mode)[1]
        names[:] = outputs
        return list(outputs.values())

    shapes = jax.eval_shape(values, model.y, model.scene)
    return {name: x.shape for name, x in zip(names, shapes, strict=True)}


def _routines(model: Model) -> dict[str, tuple[Callable[..., PyTree], tuple[str, ...]]]:
    """Each C function by name: its function, and the arguments that it changes in place; others write to `out`."""
    routines: dict[str, tuple[Callable[..., PyTree], tuple[str, ...]]] = {
        "rate": (model.rate, ()),
        "linear": (model.linear, ()),
        "evaluate": (model.evaluate, ()),
        "push": (model.push, ()),
        "pull": (model.pull, ()),
        "start": (model.begin, ("y", "m")),
    }
    if model.requirements:
        routines["ranges"] = (model.ranges, ())
    if model.modes:
        routines["guards"] = (model.guards, ())
        routines["switch"] = (model.after, ("y", "m"))
    if model.projects:
        routines["project"] = (model.projected, ("y",))
    return routines


def write_model(model: Model) -> tuple[str, str]:
    """Prototypes and functions of the equations, in C99.

    **Raises:**

    - `ValueError` naming an unsupported operation of JAX, and the function that needs it.
    """
    like = {"t": 0.0, "along": 0.0, "p": model.scene, "y": model.y, "m": model.mode, "fired": model.mode}
    like |= {"dp": model.scene, "dy": model.y, "tol": jnp.zeros(3), "dense": 0.0, "least": 0.0}
    outputs = sum(int(np.prod(shape)) for shape in series_of(model).values())
    like["seed"] = jnp.zeros(_size(model.y) + model.modes + outputs)
    prototypes, functions = [], []
    for name, (fn, changed) in _routines(model).items():
        order = tuple(inspect.signature(fn).parameters)
        fixed = [f"{x}[{i}]" for x in changed for i in range(_size(like[x]))]
        lines = _lines(name, fn, {x: like[x] for x in order}, fixed)
        declared = [_READ[x] for x in order if x not in changed]
        declared += [f"double *{x}" for x in (changed or ("out",))]
        signature = f"void model_{name}({', '.join(declared)})"
        idle = unused((*order, *(() if changed else ("out",))), lines)
        prototypes.append(f"/* {inspect.getdoc(fn) or name} */\n{signature};")
        functions.append("\n".join([signature + " {", *idle, *lines, "}\n"]))
    return "\n".join(prototypes), "\n".join(functions)


def _lines(name: str, fn: Callable[..., PyTree], like: Mapping[str, PyTree], places: Sequence[str]) -> list[str]:
    try:
        return write_function(fn, like, lambda sizes: places or [f"out[{i}]" for i in range(sum(sizes))])
    except ValueError as error:
        raise ValueError(
            f"fmu does not support {error}, which the function `{name}` of the scene needs. It supports arithmetic,"
            " elementary functions, choices (jnp.where) and loops with a known limit, of scalars and small arrays:"
            " express the Lagrangian, force or law by these."
        ) from error


def _size(tree: PyTree) -> int:
    return sum(int(np.size(x)) for x in jtu.tree_leaves(tree))


def header(
    model: Model,
    numbers: Sequence[float],
    states: Sequence[float],
    kinds: Sequence[int],
    **defined: Any,
) -> str:
    """Declarations of model.h up to the prototypes: sizes, start values, and coefficients of Rodas5P."""
    widths = model.scene.mode_widths(model.y.q.shape[0])
    stops = np.concatenate([[0], np.cumsum(widths)]).astype(int)
    outputs = sum(int(np.prod(shape)) for shape in series_of(model).values())
    sizes = {"NUMBERS": len(numbers), "STATES": len(states), "MODES": model.modes, "THINGS": len(widths)}
    sizes |= {"EVALUATED": len(states) + model.modes + outputs, "CONTACTS": len(model.scene.contacts)}
    sizes["SLIPS"] = model.scene.split_modes(model.mode)[0].size
    requirements = model.requirements
    sizes |= {"RANGES": len(requirements), "PROJECTS": int(model.projects), "GAMMA": repr(RODAS5P.gamma)} | defined
    lines = [f"#define {name} {value}" for name, value in sizes.items()]
    lines += ["enum { PARAMETER, CONTINUOUS_INPUT, DISCRETE_INPUT };"]
    lines += [
        _array("static const double model_numbers", numbers),
        _array("static const double model_states", states),
        _array("static const int model_kinds", kinds),
        f"static const char *const model_requirements[] = {{{', '.join(map(json.dumps, [*requirements, '']))}}};",
        _array("static const int model_modes", stops),
        _array("static const double NODE", RODAS5P.nodes),
        _array("static const double TIME", RODAS5P.time),
    ]
    tables = {"STAGE": RODAS5P.stage, "COUPLING": RODAS5P.coupling, "DENSE": RODAS5P.dense}
    return "\n".join([*lines, *(_array(f"static const double {name}", rows) for name, rows in tables.items())])


def _array(name: str, values: Any) -> str:
    """A constant array; one zero in place of no entry."""
    values = np.asarray(values)
    values = values if values.size else np.zeros(1, values.dtype)
    sizes = "".join(f"[{n}]" for n in values.shape)
    return f"{name}{sizes} = {str(values.tolist()).replace('[', '{').replace(']', '}')};"
