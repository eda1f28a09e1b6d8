"""Request of a run: the arguments of `simulate`, checked and converted."""

import math
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, ArrayLike, Float, PyTree

from .._core.arguments import as_flag, as_mapping, as_names, as_whole, check_real, did_you_mean
from .._core.arrays import is_known
from .._core.parameters import check_not_nan, is_weak
from .._core.speed import warn_about_single_precision
from ..scene import Scene, State, check_step, scene_numbers
from ..solvers import ImplicitFriction
from ._integrated_system import Series

MOST_STEPS, MOST_EVENTS = 16384, 1024
# Least relative tolerance, in roundings; below, the error estimate is rounding where a velocity passes zero: in float32
# 119 of 256 boxes on a swinging belt ended early at 25 roundings, one at 59. Below the other, float32 logs a warning.
TIGHTEST, _SINGLE = 64.0, 0.99e-6
# Number of events that every run logs. A belt oscillator over 60 s with 108 events takes 4, 9 and 19 % longer with 8,
# 16 and 64 entries.
_LOGGED = 16
_RECORDS = ("events", "energy")


@partial(jtu.register_dataclass, data_fields=("arrays",), meta_fields=("rest",))
@dataclass(frozen=True)
class Plugin:
    """A solver or an adjoint: its arrays are numbers of the run, the rest is compiled in."""

    arrays: PyTree
    rest: Any

    @property
    def whole(self) -> Any:
        """The solver or adjoint itself."""
        return eqx.combine(self.arrays, self.rest)


@jtu.register_static
@dataclass(frozen=True)
class RunChoices:
    """Choices of a run that are compiled in.

    - `max_steps`, `max_events`, `stick_on_chatter`, `project`: as for `simulate`.
    - `log`: entries of the log of events; later events are counted, not logged.
    - `audited`: whether the run integrates the work, too.
    - `series`: a series that is saved at the ends of all steps, or None.
    """

    max_steps: int
    max_events: int
    stick_on_chatter: bool
    project: bool
    log: int = 0
    audited: bool = False
    series: Series | None = None


class RunRequest(NamedTuple):
    """The arguments of `simulate`, checked and converted to arrays of one floating type."""

    scene: Scene
    q0: Float[Array, " dof"]
    qd0: Float[Array, " dof"]
    # Initial states of effects that do not start at rest.
    z0: dict[str, PyTree]
    t0: Float[Array, ""]
    t1: Float[Array, ""]
    ts: Float[Array, " time"] | None
    rtol: Float[Array, ""]
    atol: Float[Array, ""]
    dt: Float[Array, ""] | None
    dtmax: Float[Array, ""] | None
    solver: Plugin | None
    adjoint: Plugin | None
    choices: RunChoices

    @property
    def initial_state(self) -> State:
        """State at t0; effects without an entry in `z0` start at rest."""
        return State(self.q0, self.qd0, self.scene.initial_state(self.q0) | self.z0)

    @property
    def shortest_step(self) -> Float[Array, ""]:
        """Shortest step [s], the resolution of time."""
        span = jnp.maximum(jnp.abs(self.t0), jnp.abs(self.t1))
        return float(jnp.finfo(span.dtype).eps) * span

    def choosing(self, **choices: Any) -> "RunRequest":
        """The same run with other choices."""
        return self._replace(choices=replace(self.choices, **choices))


def run_request(
    scene: Scene,
    q0: ArrayLike | list[float],
    qd0: ArrayLike | list[float],
    t1: ArrayLike,
    *,
    t0: ArrayLike = 0.0,
    ts: ArrayLike | list[float] | None = None,
    z0: dict[str, PyTree] | None = None,
    rtol: ArrayLike = 1e-6,
    atol: ArrayLike = 1e-9,
    dt: ArrayLike | None = None,
    dtmax: ArrayLike | None = None,
    solver: dfx.AbstractSolver | None = None,
    adjoint: dfx.AbstractAdjoint | None = None,
    max_steps: int = MOST_STEPS,
    max_events: int = MOST_EVENTS,
    stick_on_chatter: bool = False,
    project: bool = True,
    record: tuple[str, ...] = (),
) -> RunRequest:
    """Check and convert the arguments of `simulate`.

    **Returns:**

    A `RunRequest`.

    **Raises:**

    - `ValueError` naming the argument, its value and the requirement.
    """
    if not isinstance(scene, Scene):
        raise ValueError(f"simulate needs a Scene, but a {type(scene).__name__} was given.")
    given = {"q0": q0, "qd0": qd0, "t1": t1, "t0": t0, "rtol": rtol, "atol": atol, "ts": ts, "dt": dt, "dtmax": dtmax}
    scene, array, known = _converted(scene, {name: value for name, value in given.items() if value is not None})
    _check_values(array)
    _check_span(t0, t1, array)
    if array["q0"].shape != (1,):
        _check_slips(scene, array["q0"], array["t0"])
    if isinstance(solver, ImplicitFriction):
        if dt is None:
            raise ValueError(
                "ImplicitFriction takes fixed steps and has no estimate of its error: pass the step, as in dt=1e-3."
            )
        check_step(scene)
    if isinstance(adjoint, dfx.BacksolveAdjoint):
        raise ValueError(
            "simulate cannot use diffrax.BacksolveAdjoint, which knows neither events nor projections nor what is"
            " kept of a run. Leave adjoint out, or pass diffrax.ForwardMode()."
        )
    z0 = {} if z0 is None else _own_states(scene, array["q0"], z0, array["q0"].dtype)
    plugins = _plugin(solver, dfx.AbstractSolver, "solver"), _plugin(adjoint, dfx.AbstractAdjoint, "adjoint")
    known = known and is_known(*jtu.tree_leaves((z0, plugins)))
    max_events = as_whole(max_events, name="max_events")
    return RunRequest(
        scene,
        array["q0"],
        array["qd0"],
        z0,
        array["t0"],
        array["t1"],
        array.get("ts"),
        array["rtol"],
        array["atol"],
        array.get("dt"),
        array.get("dtmax"),
        *plugins,
        RunChoices(
            as_whole(max_steps, name="max_steps"),
            max_events,
            as_flag(stick_on_chatter, name="stick_on_chatter"),
            as_flag(project, name="project"),
            *_recorded(record, bool(scene.contacts), max_events, known),
        ),
    )


def _recorded(record: tuple[str, ...], has_contacts: bool, max_events: int, known: bool) -> tuple[int, bool]:
    """Entries of the log of events, and whether the work is recorded.

    A run with known numbers logs its first events. A traced run does not: a derivative would carry the log.
    """
    for name in as_names(record, name="record"):
        if name not in _RECORDS:
            raise ValueError(
                f"record holds {name!r}, which is none of {', '.join(_RECORDS)}.{did_you_mean(name, _RECORDS)}"
            )
    audited = "energy" in record
    if "events" in record or (audited and has_contacts):  # losses of impacts come from the log
        return max_events, audited
    return min(_LOGGED, max_events) if known else 0, audited


def _array(value: PyTree, dtype: np.dtype) -> Any:
    """An array of `dtype`: NumPy for known values (cheaper to pass), JAX for values that are traced or on a device."""
    if isinstance(value, jax.Array):
        return value if value.dtype == dtype else value.astype(dtype)
    return np.asarray(value, dtype)


def _converted(scene: Scene, given: dict[str, Any]) -> tuple[Scene, dict[str, Any], bool]:
    """The scene, the numbers as arrays of the common type of scene and initial state, and whether none is traced."""
    for name in ("q0", "qd0", "ts"):
        value = given.get(name)
        # A list may contain traced numbers, as in qd0=[scene.params["v"]].
        if isinstance(value, list | tuple) and not is_known(*value):
            given[name] = jnp.asarray(value)
    for name, value in given.items():
        if type(value) is not float:
            check_real(value, name=name)
    leaves: list[Any] = [*jtu.tree_leaves(scene), given["q0"], given["qd0"]]
    check_not_nan(leaves[:-2], lambda: scene_numbers(scene))
    kinds = {x.dtype for x in leaves if hasattr(x, "dtype") and not is_weak(x)}
    dtype = kinds.pop() if len(kinds) == 1 else jnp.result_type(*kinds) if kinds else jnp.result_type(float)
    if not jnp.issubdtype(dtype, jnp.floating):
        dtype = jnp.result_type(float)
    if any(is_weak(x) for x in leaves[:-2]):
        # Numbers from `jnp.asarray(2.0)` or from Python would otherwise compile the run once more.
        scene = jtu.tree_map(lambda x: jnp.asarray(x, dtype) if is_weak(x) else x, scene)
    array = {name: _array(value, dtype) for name, value in given.items()}
    for name in ("q0", "qd0"):
        if array[name].ndim != 1 or array[name].shape[0] == 0 or array[name].shape != array["q0"].shape:
            listed = f": write {name}=[{given[name]}]" if array[name].ndim == 0 else ""
            raise ValueError(
                f"q0 and qd0 must both have the shape [dof], but q0 has the shape {array['q0'].shape} and qd0"
                f" {array['qd0'].shape}{listed}."
            )
    for name in ("t0", "t1", "rtol", "atol", "dt", "dtmax"):
        if name in array and array[name].shape != ():
            raise ValueError(f"{name} must be one number, but has the shape {array[name].shape}.")
    return scene, array, is_known(*leaves, *array.values())


def _check_span(t0: ArrayLike, t1: ArrayLike, array: dict[str, Any]) -> None:
    """Refuse times that differ, but are equal in the type of the run, which would end at its start without an error."""
    known = is_known(t0, t1, array["t0"], array["t1"])  # inside `jax.jit` arithmetic of known arrays is traced
    if known and np.asarray(array["t0"]) == np.asarray(array["t1"]) and np.asarray(t0) != np.asarray(t1):
        raise ValueError(
            f"t0 = {t0} and t1 = {t1} are the same number in {array['t0'].dtype}: count the time from another moment,"
            " or pass q0 in float64."
        )


def _check_slips(scene: Scene, q0: jax.Array | np.ndarray, t0: jax.Array | np.ndarray) -> None:
    """Refuse the velocity of a belt that is a number where slip is a vector."""
    for name, effect in scene.friction.items():
        if effect.along is None or callable(effect.belt_velocity):
            continue
        # This test comes first, as the rest takes time.
        if is_known(effect.belt_velocity) and np.any(np.asarray(effect.belt_velocity) != 0):
            effect.check_belt(q0, scene.bind_time(jnp.asarray(t0)).params, name)


def _own_states(scene: Scene, q0: jax.Array | np.ndarray, z0: dict[str, PyTree], dtype: np.dtype) -> dict[str, PyTree]:
    """Convert and check the initial states of effects."""
    z0 = as_mapping(z0, name="z0", example="{'friction': 0.0}")
    states = scene.initial_state(jnp.asarray(q0, dtype))
    for name, state in z0.items():
        if name not in states:
            raise ValueError(
                f"z0 names {name!r}, but the effects with a state of their own are: {', '.join(states) or 'none'}."
            )
        if jtu.tree_structure(state) != jtu.tree_structure(states[name]):
            raise ValueError(f"z0[{name!r}] must have the structure of {states[name]}, but {state} was given.")
        if [jnp.shape(x) for x in jtu.tree_leaves(state)] != [jnp.shape(x) for x in jtu.tree_leaves(states[name])]:
            raise ValueError(f"z0[{name!r}] must have the shapes of {states[name]}, but {state} was given.")
    return {name: jtu.tree_map(lambda x: _array(x, dtype), state) for name, state in z0.items()}


def _check_values(array: dict[str, Any]) -> None:
    """Check the known values; the run checks traced ones."""
    # Comparisons of Python numbers take a tenth of the time of those of arrays without dimensions.
    known = {
        name: value.item() if value.ndim == 0 else np.asarray(value) for name, value in array.items() if is_known(value)
    }
    for name, value in known.items():
        if not (math.isfinite(value) if isinstance(value, float) else np.isfinite(value).all()):
            raise ValueError(f"{name} must be finite, but it is {array[name]}.")
    for name in ("rtol", "atol"):
        if name in known and known[name] < 0:
            raise ValueError(f"{name} must not be negative, but it is {array[name]}.")
    if "rtol" in known and "atol" in known and known["rtol"] + known["atol"] <= 0:
        raise ValueError("rtol and atol must not both be zero.")
    if "rtol" in known and known["rtol"] < _SINGLE and array["rtol"].dtype == np.float32:
        warn_about_single_precision()
    for name in ("dt", "dtmax"):
        if name in known and known[name] <= 0:
            raise ValueError(f"{name} must be positive, but it is {array[name]}.")
    if "dt" in array and "dtmax" in array:
        raise ValueError("dt fixes the step, so dtmax has no place beside it: pass one of them.")
    t0, t1, ts = known.get("t0"), known.get("t1"), known.get("ts")
    if t0 is not None and t1 is not None and t1 < t0:
        raise ValueError(f"t1 must not be before t0, but t0 = {array['t0']} and t1 = {array['t1']}.")
    if "ts" in array and (array["ts"].ndim != 1 or array["ts"].shape[0] == 0):
        raise ValueError(f"ts must be a vector of times, shape [time], but it has the shape {array['ts'].shape}.")
    if ts is not None and (back := ts[1:] < ts[:-1]).any():
        k = int(np.argmax(back)) + 1
        raise ValueError(f"ts must increase, but ts[{k}] = {ts[k]} follows ts[{k - 1}] = {ts[k - 1]}: sort the times.")
    if ts is not None and t0 is not None and t1 is not None and not (t0 <= ts[0] and ts[-1] <= t1):
        raise ValueError(
            f"ts must lie within [t0, t1] = [{array['t0']}, {array['t1']}], but runs from {ts[0]} to {ts[-1]}."
        )


def _plugin(plugin: object | None, kind: type, name: str) -> Plugin | None:
    if plugin is None:
        return None
    if not isinstance(plugin, kind):
        raise ValueError(f"{name} must be a diffrax.{kind.__name__} object, but {plugin!r} was given.")
    return Plugin(*eqx.partition(plugin, eqx.is_array))
