"""`sensitivity`: derivatives of an observable by the numbers of a scene, normalised and ranked."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from .._core.readable import Table
from ..scene import (
    Scene,
    elements,
    quantity_of,
    read_element,
    replace_elements,
    scene_numbers,
    scene_ranges,
    signals_of,
)
from ..simulation import Trajectory, named_series, simulate

_MODES = ("forward", "reverse")

# Cost in units of a plain run, measured on two cores for the LuGre test bench and a belt oscillator with 44 events.
# Forward: 1.6 to 3.0 for 6 parameters, 2.0 to 3.5 for 24, 3.3 to 10 for 96. Reverse: 8 to 20 for one output (3 to 5
# after `tune_cpu`), 4.5 to 18 for four, with a two to three times longer compilation.
_FORWARD, _PER_PARAMETER = 2.0, 0.1
_REVERSE, _PER_OUTPUT = 8.0, 1.0


@dataclass(frozen=True)
class Sensitivity:
    """The result of `sensitivity`, which prints as a table; `jaxmodsim.plot.sensitivity_figure` draws it.

    - `label`, `unit`: of the observable, if known.
    - `t`: times of the run [s], shape `[time]`.
    - `observable`: its values y, shape `[time]`, `[k]` or `[]`.
    - `values`: of the parameters p, by name; `units`: of the parameters that declare one.
    - `derivatives`: dy/dp by name, of the shape of the observable.
    - `normalised`: `p dy/dp / scale` by name: the relative change of y per relative change of p. The scale is the rms
      of y over the run if y is a function of time, else the magnitude of each y. A zero p or scale is replaced by one
      unit; `warnings` says so.
    - `ranking`: pairs of name and rms of the normalised sensitivity, the largest first.
    - `mode`: of differentiation, `forward` or `reverse`.
    - `warnings`: sentences on replaced zeros and on mode changes.

    **Example:**

    ```python
    scene = jms.problems.braked_spring.scene()
    result = jms.sensitivity(scene, "q[0]", q0=[1.0], qd0=[0.0], t1=5.0, ts=jnp.linspace(0.0, 5.0, 101))
    print(sorted(f"{name}: {rms:.3f}" for name, rms in result.ranking))
    ```

    ```text
    ['k: 1.822', 'm: 1.822']
    ```
    """

    label: str
    unit: str
    t: Float[Array, " time"]
    observable: Float[Array, "..."]
    values: dict[str, float]
    units: dict[str, str]
    derivatives: dict[str, Float[Array, "..."]]
    normalised: dict[str, Float[Array, "..."]]
    ranking: tuple[tuple[str, float], ...]
    mode: str
    warnings: tuple[str, ...]

    @property
    def over_time(self) -> bool:
        """Whether the observable is a function of time."""
        return _over_time(self.observable, self.t)

    def __str__(self) -> str:
        """A table in the order of the ranking, and the warnings."""
        shape = f"{self.t.shape[0]} times" if self.over_time else f"shape {self.observable.shape}"
        unit = f" [{self.unit}]" if self.unit else ""
        names = [f"{name} [{self.units[name]}]" if name in self.units else name for name, _ in self.ranking]
        rows = [
            (text, f"{self.values[name]:.5g}", f"{_rms(self.derivatives[name]):.5g}", f"{size:.5g}")
            for text, (name, size) in zip(names, self.ranking, strict=True)
        ]
        title = f"{self.label}{unit}: {shape}, rms {_rms(self.observable):.5g}; {self.mode} mode"
        return Table(title, ("number", "value", "rms dy/dp", "rms p dy/dp / scale"), rows, self.warnings).text()


def sensitivity(
    scene: Scene,
    observable: Callable[[Trajectory], ArrayLike] | str,
    wrt: Sequence[str] | str | None = None,
    *,
    q0: ArrayLike | list[float],
    qd0: ArrayLike | list[float],
    t1: ArrayLike,
    ts: ArrayLike | list[float] | None = None,
    mode: str | None = None,
    **options: object,
) -> Sensitivity:
    """Differentiate an observable of a run by numbers of its scene, exactly, through all mode changes.

    The scene runs once to count its events and again for the derivatives. In units of a plain run, a forward Jacobian
    costs about 2 + 0.1 n for n parameters, a reverse one about 8 + m for m observed numbers. The default is the cheaper
    one: reverse for more than 70 parameters of one number. Tolerances control the motion and its derivatives, as
    described in `StoredSteps`.

    **Arguments:**

    - `scene`: the `Scene`, with concrete (not traced) numbers.
    - `observable`: function of the `Trajectory` that returns real numbers: of shape `[time]` for a series at the saved
      times, or `[]` or `[k]` for numbers of the whole run, such as `run.events.t[2]`. Or a name: `q[0]`, `qd[0]`, or
      the name of an effect for its force, with `[i]` for a component.
    - `wrt`: names of numbers as in `jaxmodsim.scene.scene_numbers`, with `[i]` for one entry of an array and without it
      for all; and `q0[0]`, `qd0[0]` for the initial state. By default all numbers of the scene except zeros, values of
      signals, and numerical settings of laws (`width`).
    - `q0`, `qd0`, `t1`, `ts`: as for `simulate`.
    - `mode`: `"forward"` or `"reverse"`; by default the cheaper one.
    - `options`: further arguments of `simulate`, except `adjoint` and `throw`.

    **Returns:**

    A `Sensitivity`.

    **Raises:**

    - `ValueError` for unknown or repeated names, and for an observable that is not callable, does not return real
      numbers of a shape above, or is not finite (`run.events.t` is padded with infinity).
    - `SimulationError` if the run ends early.

    **Example:**

    ```python
    scene = jms.problems.braked_spring.scene()
    result = jms.sensitivity(scene, "q[0]", q0=[1.0], qd0=[0.0], t1=5.0, ts=jnp.linspace(0.0, 5.0, 101))
    print(f"{result.derivatives['k'][-1]:.4f} m/(N/m) at 5 s")
    ```

    ```text
    -1.0637 m/(N/m) at 5 s
    ```
    """
    if not isinstance(scene, Scene):
        raise ValueError(f"sensitivity needs a Scene, but a {type(scene).__name__} was given.")
    for name in ("adjoint", "throw"):
        if name in options:
            raise ValueError(f"sensitivity sets {name} itself: omit it, and choose mode='forward' or mode='reverse'.")
    if mode not in (None, *_MODES):
        raise ValueError(f"mode must be 'forward', 'reverse' or None for the cheaper one, but {mode!r} was given.")
    values = chosen_numbers(scene, q0, qd0, wrt)
    arguments: dict[str, Any] = {**options, "ts": ts}
    run = simulate(scene, q0, qd0, t1, **arguments)
    if run.modes is not None:  # a traced run would reserve memory for the largest allowed number of events
        arguments["max_events"] = run.log_size
    observe, label, unit = observable_of(scene, observable)
    y = observed(observe(run))
    if mode is None:
        forward, reverse = _FORWARD + _PER_PARAMETER * len(values), _REVERSE + _PER_OUTPUT * y.size
        mode = "forward" if forward <= reverse else "reverse"

    def at(x: dict[str, Array]) -> Array:
        changed, start = with_values(scene, {"q0": run.request.q0, "qd0": run.request.qd0}, x)
        return jnp.asarray(observe(simulate(changed, **start, t1=t1, throw=False, **arguments)))

    differentiate = jax.jacfwd if mode == "forward" else jax.jacrev
    derivatives = differentiate(at)({name: jnp.asarray(x, y.dtype) for name, x in values.items()})
    derivatives = {name: derivatives[name] for name in values}
    normalised, warnings = _normalised(y, run, values, derivatives)
    sizes = {name: _rms(x) for name, x in normalised.items()}
    ranking = tuple(sorted(sizes.items(), key=lambda pair: -pair[1]))
    ranges, places = scene_ranges(scene), elements(scene)
    leaves = {name: places[name][0] for name in values if name in places}
    units = {name: ranges[leaf].unit for name, leaf in leaves.items() if leaf in ranges and ranges[leaf].unit}
    return Sensitivity(label, unit, run.t, y, values, units, derivatives, normalised, ranking, mode, warnings)


def chosen_numbers(scene: Scene, q0: object, qd0: object, wrt: Sequence[str] | str | None) -> dict[str, float]:
    """The parameters and their values, by name."""
    known = {name: read_element(scene, name) for name in elements(scene)}
    numbers, ranges = scene_numbers(scene), scene_ranges(scene)
    if wrt is None:
        samples = {id(signal.values) for signal in signals_of(scene.params)}
        left = {name for name, x in numbers.items() if id(x) in samples or (name in ranges and ranges[name].execution)}
        chosen = [name for name, (leaf, _) in elements(scene).items() if leaf not in left and known[name] != 0]
        if not chosen:
            raise ValueError("All numbers of the scene are zero: name those to differentiate by, as in wrt='q0[0]'.")
        return {name: known[name] for name in chosen}
    for name, start in (("q0", q0), ("qd0", qd0)):
        known |= {f"{name}[{i}]": float(x) for i, x in enumerate(np.ravel(np.asarray(start)))}
    groups = {leaf: [name for name, (of, _) in elements(scene).items() if of == leaf] for leaf in numbers}
    groups |= {start: [name for name in known if name.startswith(f"{start}[")] for start in ("q0", "qd0")}
    chosen = []
    for name in [wrt] if isinstance(wrt, str) else wrt:
        if name not in groups and name not in known:
            raise ValueError(f"wrt names {name!r}, which is no number of the scene; there are: {', '.join(known)}.")
        chosen += groups.get(name, [name])
    for name in chosen:
        if chosen.count(name) > 1:
            raise ValueError(f"wrt names {name!r} twice.")
    if not chosen:
        raise ValueError("wrt is empty: name at least one number, or omit it for all that are not zero.")
    return {name: known[name] for name in chosen}


def with_values(scene: Scene, start: Mapping[str, ArrayLike], x: Mapping[str, Array]) -> tuple[Scene, dict[str, Array]]:
    """Scene and initial state with the parameters `x`."""
    known = elements(scene)
    start = {name: jnp.asarray(value) for name, value in start.items()}
    for name, value in x.items():
        if name not in known:
            which, index = name.rstrip("]").split("[")
            start[which] = start[which].at[int(index)].set(value)
    return replace_elements(scene, {name: value for name, value in x.items() if name in known}), start


def observable_of(
    scene: Scene,
    observable: str | Callable[[Trajectory], ArrayLike],
) -> tuple[Callable[[Trajectory], ArrayLike], str, str]:
    """The observable as a function, its label and its unit."""
    if isinstance(observable, str):
        label, unit = quantity_of(scene, observable)
        return partial(named_series, name=observable), label, unit
    if not callable(observable):
        raise ValueError(
            "observable must be a function of the Trajectory, as in lambda run: run.q[:, 0], or a name such as"
            f" 'q[0]', but {observable!r} was given."
        )
    name = getattr(observable, "__name__", "observable")
    return observable, "observable" if name == "<lambda>" else name, ""


def observed(y: Any) -> Array:
    """The value of an observable as an array.

    **Raises:**

    - `ValueError` unless it is differentiable.
    """
    dtype, shape = getattr(y, "dtype", None), getattr(y, "shape", None)
    if dtype is None or shape is None or not jnp.issubdtype(dtype, jnp.floating) or len(shape) > 1 or 0 in shape:
        given = f"an array of shape {shape} and type {dtype}" if dtype is not None else f"{y!r}"
        raise ValueError(
            f"observable must return real numbers of shape [time], [k] or [], but it returned {given}. Pick one"
            " quantity, as in lambda run: run.q[:, 0]."
        )
    if not np.isfinite(y).all():
        raise ValueError(
            f"observable must be finite, but it returned {np.asarray(y)}. Times of events are padded with infinity:"
            " pick events that happen, as in run.events.t[0]."
        )
    return jnp.asarray(y)


def _normalised(
    y: Array, run: Trajectory, values: Mapping[str, float], derivatives: Mapping[str, Array]
) -> tuple[dict[str, Array], tuple[str, ...]]:
    """Derivatives relative to parameters and observable, and the warnings."""
    warnings = []
    scale = jnp.full(y.shape, _rms(y), y.dtype) if _over_time(y, run.t) else jnp.abs(y)
    if not (scale > 0).all():
        warnings.append("The observable is zero at some times: its scale there is taken as one unit.")
        scale = jnp.where(scale > 0, scale, 1.0)
    zero = [name for name, x in values.items() if x == 0]
    if zero:
        warnings.append(f"These parameters are zero, and their change is taken as one unit: {', '.join(zero)}.")
    events = int(run.stats.get("num_events", 0))
    if events:
        warnings.append(
            f"The run has mode changes at {events} times: derivatives are valid while their sequence stays the same."
            " jaxmodsim.check_gradients checks that."
        )
    return {name: (x or 1.0) * derivatives[name] / scale for name, x in values.items()}, tuple(warnings)


def _over_time(y: Array, t: Array) -> bool:
    return y.shape == t.shape


def _rms(x: Array) -> float:
    return float(np.sqrt(np.mean(np.square(np.asarray(x)))))
