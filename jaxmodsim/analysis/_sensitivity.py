"""`sensitivity`: how much each number of a scene matters to what is observed along a run."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

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

# Cost in plain runs, measured on two shared cores for LuGre's test bench and the belt oscillator with 44 events.
# Forward: 1.6 to 3.0 for 6 parameters, 2.0 to 3.5 for 24, 3.3 to 10 for 96. Reverse: 8 to 20 for one output (3 to 5
# after `tune_cpu`), 4.5 to 18 for four; it compiles two to three times as long.
_FORWARD, _PER_PARAMETER = 2.0, 0.1
_REVERSE, _PER_OUTPUT = 8.0, 1.0


@dataclass(frozen=True)
class Sensitivity:
    """What `sensitivity` found; print it, or draw it by `jaxmodsim.plot.sensitivity_figure`.

    - `label`, `unit`: of the observable, as far as they are known.
    - `t`: times of the run [s], shape `[time]`.
    - `observable`: its values y, shape `[time]`, `[k]` or `[]`.
    - `values`: of the parameters p, by name; `units` of those that declare one.
    - `derivatives`: dy/dp by name, of the shape of the observable.
    - `normalised`: `p dy/dp / scale` by name: the relative change of y per relative change of p. The scale is the rms
      of y over the run where y is a function of time, and the magnitude of each y where it is not. A parameter that is
      zero counts as changed by one unit, an observable whose scale is zero as having the scale of one unit; `remarks`
      names them.
    - `ranking`: pairs of name and rms of the normalised sensitivity, the largest first.
    - `mode`: of differentiation, `forward` or `reverse`.
    - `remarks`: in sentences.
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
    remarks: tuple[str, ...]

    @property
    def over_time(self) -> bool:
        """Whether the observable is a function of time, and not numbers of the run as a whole."""
        return _over_time(self.observable, self.t)

    def __str__(self) -> str:
        """A table in the order of the ranking, and the remarks."""
        shape = f"{self.t.shape[0]} times" if self.over_time else f"shape {self.observable.shape}"
        unit = f" [{self.unit}]" if self.unit else ""
        names = [f"{name} [{self.units[name]}]" if name in self.units else name for name, _ in self.ranking]
        width = max(map(len, names))
        lines = [
            f"{self.label}{unit}: {shape}, rms {_rms(self.observable):.5g}; {self.mode} mode",
            f"{'':{width}}  {'value':>11}  {'rms dy/dp':>11}  {'rms p dy/dp / scale':>19}",
        ]
        for text, (name, size) in zip(names, self.ranking, strict=True):
            slope = _rms(self.derivatives[name])
            lines.append(f"{text:{width}}  {self.values[name]:11.5g}  {slope:11.5g}  {size:19.5g}")
        return "\n".join([*lines, *(f"- {remark}" for remark in self.remarks)])


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
    """Derivatives of what is observed along a run by numbers of its scene, exact, through all mode changes.

    ```python
    result = jaxmodsim.sensitivity(scene, "q[0]", q0=[1.0], qd0=[0.0], t1=5.0, ts=jnp.linspace(0.0, 5.0, 101))
    print(result)
    jaxmodsim.sensitivity(scene, lambda run: run.events.t[2], ("m", "friction.Fc"), q0=[1.0], qd0=[0.0], t1=5.0)
    ```

    The scene runs once to see its events and again for the derivatives. A forward Jacobian costs about 2 + 0.1 n plain
    runs for n parameters, a reverse one about 8 + m for m numbers observed; the cheaper one is taken, which is reverse
    for many parameters (more than 70 for one number) and few outputs. Tolerances control the motion and its
    derivatives, as described in `StoredSteps`.

    **Arguments:**

    - `scene`: the `Scene`; its numbers must be known (not traced).
    - `observable`: function of the `Trajectory` that returns real numbers: shape `[time]` for those at the times of the
      run, or `[]` or `[k]` for numbers of the run as a whole, such as `run.events.t[2]`. Or a name: `q[0]`, `qd[0]`, or
      of an effect for its force, with `[i]` for a component.
    - `wrt`: names of numbers as in `jaxmodsim.scene.scene_numbers`, with `[i]` behind for one entry of an array, whose
      own name stands for all; and `q0[0]`, `qd0[0]` for the initial state. By default all numbers of the scene but
      zeros, values of signals, and what says how a law is run and not what it is (`width`).
    - `q0`, `qd0`, `t1`, `ts`: as for `simulate`.
    - `mode`: `"forward"` or `"reverse"`; by default the cheaper one.
    - `options`: further arguments of `simulate`, but not `adjoint` and `throw`.

    **Returns:**

    A `Sensitivity`.

    **Raises:**

    - `ValueError` for names that are unknown or given twice, an observable that is no function, does not give real
      numbers of a shape above, or is not finite (`run.events.t` is padded with infinity).
    - `SimulationError` if the run ends early.
    """
    if not isinstance(scene, Scene):
        raise ValueError(f"sensitivity needs a Scene, but a {type(scene).__name__} was given.")
    for name in ("adjoint", "throw"):
        if name in options:
            raise ValueError(
                f"sensitivity sets {name} itself: leave it out, and choose by mode='forward' or 'reverse'."
            )
    if mode not in (None, *_MODES):
        raise ValueError(f"mode must be 'forward', 'reverse' or left out for the cheaper one, but {mode!r} was given.")
    values = chosen_numbers(scene, q0, qd0, wrt)
    given: dict[str, Any] = {**options, "ts": ts}
    run = simulate(scene, q0, qd0, t1, **given)
    if run.modes is not None:  # a traced run would hold room for all events that are allowed
        given["max_events"] = run.log_size
    observe, label, unit = observable_of(scene, observable)
    y = observed(observe(run))
    if mode is None:
        forward, reverse = _FORWARD + _PER_PARAMETER * len(values), _REVERSE + _PER_OUTPUT * y.size
        mode = "forward" if forward <= reverse else "reverse"

    def at(x: dict[str, Array]) -> Array:
        changed, start = with_values(scene, {"q0": run.request.q0, "qd0": run.request.qd0}, x)
        return jnp.asarray(observe(simulate(changed, **start, t1=t1, throw=False, **given)))

    differentiate = jax.jacfwd if mode == "forward" else jax.jacrev
    derivatives = differentiate(at)({name: jnp.asarray(x, y.dtype) for name, x in values.items()})
    derivatives = {name: derivatives[name] for name in values}
    normalised, remarks = _normalised(y, run, values, derivatives)
    sizes = {name: _rms(x) for name, x in normalised.items()}
    ranking = tuple(sorted(sizes.items(), key=lambda pair: -pair[1]))
    ranges, places = scene_ranges(scene), elements(scene)
    leaves = {name: places[name][0] for name in values if name in places}
    units = {name: ranges[leaf].unit for name, leaf in leaves.items() if leaf in ranges and ranges[leaf].unit}
    return Sensitivity(label, unit, run.t, y, values, units, derivatives, normalised, ranking, mode, remarks)


def chosen_numbers(scene: Scene, q0: object, qd0: object, wrt: Sequence[str] | str | None) -> dict[str, float]:
    """The parameters and their values, by name."""
    known = {name: read_element(scene, name) for name in elements(scene)}
    numbers, ranges = scene_numbers(scene), scene_ranges(scene)
    if wrt is None:
        samples = {id(signal.values) for signal in signals_of(scene.params)}
        left = {name for name, x in numbers.items() if id(x) in samples or (name in ranges and ranges[name].execution)}
        chosen = [name for name, (leaf, _) in elements(scene).items() if leaf not in left and known[name] != 0]
        if not chosen:
            raise ValueError("The scene has no numbers but zeros: name what to differentiate by, such as wrt='q0[0]'.")
        return {name: known[name] for name in chosen}
    for name, start in (("q0", q0), ("qd0", qd0)):
        known |= {f"{name}[{i}]": float(x) for i, x in enumerate(np.ravel(np.asarray(start)))}
    groups = {leaf: [name for name, (of, _) in elements(scene).items() if of == leaf] for leaf in numbers}
    groups |= {start: [name for name in known if name.startswith(f"{start}[")] for start in ("q0", "qd0")}
    chosen = []
    for name in [wrt] if isinstance(wrt, str) else wrt:
        if name not in groups and name not in known:
            raise ValueError(f"wrt names {name!r}, but the numbers are: {', '.join(known)}.")
        chosen += groups.get(name, [name])
    for name in chosen:
        if chosen.count(name) > 1:
            raise ValueError(f"wrt names {name!r} twice.")
    if not chosen:
        raise ValueError("wrt is empty: name at least one number, or leave it out for those that are not zero.")
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
    """What is observed, its label and its unit."""
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
    """What the observable gave, if that can be differentiated."""
    dtype, shape = getattr(y, "dtype", None), getattr(y, "shape", None)
    if dtype is None or shape is None or not jnp.issubdtype(dtype, jnp.floating) or len(shape) > 1 or 0 in shape:
        given = f"an array of shape {shape} and type {dtype}" if dtype is not None else f"{y!r}"
        raise ValueError(
            f"observable must return real numbers of shape [time], [k] or [], but it returned {given}. Pick one"
            " quantity, as in lambda run: run.q[:, 0]."
        )
    if not np.isfinite(y).all():
        raise ValueError(
            f"observable is not finite: {np.asarray(y)}. Times of events are padded with infinity: pick those that"
            " happen, as in run.events.t[0]."
        )
    return jnp.asarray(y)


def _normalised(
    y: Array, run: Trajectory, values: Mapping[str, float], derivatives: Mapping[str, Array]
) -> tuple[dict[str, Array], tuple[str, ...]]:
    """Derivatives relative to parameters and observable, and what is to be said of them."""
    remarks = []
    scale = jnp.full(y.shape, _rms(y), y.dtype) if _over_time(y, run.t) else jnp.abs(y)
    if not (scale > 0).all():
        remarks.append("The observable is zero: there its scale counts as one unit.")
        scale = jnp.where(scale > 0, scale, 1.0)
    zero = [name for name, x in values.items() if x == 0]
    if zero:
        remarks.append(f"Zero, and counted as changed by one unit: {', '.join(zero)}.")
    events = int(run.stats.get("num_events", 0))
    if events:
        remarks.append(
            f"The run has {events} instants of mode changes: derivatives hold as long as these stay the same, which"
            " jaxmodsim.check_gradients looks at."
        )
    return {name: (x or 1.0) * derivatives[name] / scale for name, x in values.items()}, tuple(remarks)


def _over_time(y: Array, t: Array) -> bool:
    return y.shape == t.shape


def _rms(x: Array) -> float:
    return float(np.sqrt(np.mean(np.square(np.asarray(x)))))
