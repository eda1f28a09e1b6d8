"""One run of a sweep: numbers in, observables out."""

import abc
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree

from .._core.arguments import as_names
from .._core.trace_checks import check_indices
from ..scene import Scene, elements, replace_elements, replace_numbers, scene_numbers
from ..simulation import MAX_STEPS, Trajectory, named_series, simulate
from ._grid import RESERVED

# First limit of the steps of a run; runs that reach it are set aside.
CAP = 1024

# Messages for functions that return numbers.
_FUNCTION_MESSAGES = ("The function gave numbers.", "The function gave NaN.")
# A function of the run that returns real numbers, or a name as in `simulation.named_series`.
Observable: TypeAlias = Callable[[Trajectory], object] | str


@dataclass(frozen=True)
class Derivative:
    """Derivatives of an observable by numbers of the run, for `observe` of `sweep`.

    They are computed in forward mode, through all events, together with the run: n derivatives cost about `2 + 0.1 n`
    plain runs.

    **Arguments:**

    - `of`: the observable, a function of the run or a name.
    - `wrt`: names of single numbers, as in `over`: of the scene, or `q0[0]`, `t1` and so on. A tuple gives the result a
      dimension with their names; a single name does not.

    **Raises:**

    - `ValueError` for no names, and for repeated ones.

    **Example:**

    ```python
    scene = jms.problems.braked_spring.scene()
    observe = {"x": "q[0]", "dx": jms.sweeps.Derivative("q[0]", ("k", "m"))}
    runs = jms.sweep(scene, {"k": [2.0, 3.0]}, observe, q0=[1.0], qd0=[0.0], t1=2.0)
    print(runs["dx"].dims, runs["dx"].values.round(4).tolist())
    ```

    ```text
    ('k', 'dx_wrt') [[-0.3807, 0.5857], [-0.0523, 0.1206]]
    ```
    """

    of: Observable
    wrt: tuple[str, ...] | str

    def __post_init__(self) -> None:
        """Check the names."""
        names = (self.wrt,) if isinstance(self.wrt, str) else as_names(self.wrt, name="wrt")
        if not names or len(set(names)) < len(names):
            raise ValueError(f"wrt must be a name or a tuple of different names, but {self.wrt!r} was given.")
        object.__setattr__(self, "wrt", self.wrt if isinstance(self.wrt, str) else names)

    @property
    def names(self) -> tuple[str, ...]:
        """The numbers to differentiate with respect to."""
        return (self.wrt,) if isinstance(self.wrt, str) else tuple(self.wrt)


@dataclass(frozen=True)
class Observation:
    """One variable of the result."""

    name: str
    of: Observable | Derivative
    unit: str

    @property
    def value(self) -> Observable:
        """The observable; of a derivative, its primal."""
        return self.of.of if isinstance(self.of, Derivative) else self.of


def observations(observe: object) -> tuple[Observation, ...]:
    """Convert the argument `observe` of a sweep.

    **Raises:**

    - `ValueError` for anything but names, or a mapping of names to functions, names and derivatives.
    """
    if isinstance(observe, str):
        observe = (observe,)
    if isinstance(observe, list | tuple) and observe and all(isinstance(name, str) for name in observe):
        observe = {name: name for name in observe}
    if not isinstance(observe, Mapping) or not observe:
        raise ValueError(
            "observe must name the results of each run, as in observe={'v_end': lambda run: run.qd[-1, 0]} or"
            f" observe=['q[0]', 'friction'], but {observe!r} was given."
        )
    return tuple(_observation(name, value) for name, value in observe.items())


def _observation(name: object, value: object) -> Observation:
    unit = None
    if isinstance(value, tuple) and len(value) == 2 and isinstance(value[1], str):
        value, unit = value
    if not isinstance(name, str) or "/" in name:
        raise ValueError(f"observe needs names without a slash, the separator of a store, but {name!r} was given.")
    if name in RESERVED:
        raise ValueError(f"observe cannot use the name {name!r}, which every result has.")
    if not (isinstance(value, str | Derivative) or callable(value)):
        raise ValueError(
            f"observe[{name!r}] must be a function of the run, a name such as 'q[0]', or one of these with its unit, as"
            f" in (lambda run: run.t[-1], 's'), but {value!r} was given."
        )
    if unit is None:
        unit = getattr(value, "unit", "")
    return Observation(name, value, unit if isinstance(unit, str) else "")


def _observed(observation: Observation, run: Trajectory, end: bool) -> Array:
    """The value of an observable; a named one without the time axis if the run saves its `end` alone.

    **Raises:**

    - `ValueError` for anything but an array of real numbers, and for an index out of range.
    """
    of = observation.value
    if isinstance(of, str):
        value = named_series(run, of)
        return value[-1] if end else value
    check_indices(lambda: of(run), name=f"observe[{observation.name!r}]")
    return _real(observation.name, of(run))


def _real(name: str, value: object) -> Array:
    """Convert to a floating array.

    **Raises:**

    - `ValueError` for anything but real numbers.
    """
    try:
        value = jnp.asarray(value)
    except (TypeError, ValueError):
        kind = type(value).__name__
        raise ValueError(f"{name!r} must be an array of real numbers, but it returned a {kind}.") from None
    if jnp.issubdtype(value.dtype, jnp.complexfloating):
        raise ValueError(f"{name!r} must be real, but it is complex: observe real and imaginary parts separately.")
    return value if jnp.issubdtype(value.dtype, jnp.floating) else value.astype(jnp.result_type(float))


class RunOutcome(eqx.Module):
    """The results of a run.

    - `code`: 0 for success, else an index into `messages`.
    - `num_steps`: steps of the run; 0 for a function that returns no run.
    - `values`: observables by name.
    """

    code: Array
    num_steps: Array
    values: dict[str, Array]
    messages: tuple[str, ...] = eqx.field(static=True)


class AbstractRun(abc.ABC):
    """The computation of one run. Compared by value, as it is static under `jax.jit`."""

    @abc.abstractmethod
    def evaluate(self, fixed: PyTree, numbers: Mapping[str, Array]) -> RunOutcome:
        """Compute a run from the values common to all runs and its own numbers."""

    @abc.abstractmethod
    def within(self, max_steps: int) -> "AbstractRun":
        """The same computation with this limit of steps."""

    @property
    @abc.abstractmethod
    def max_steps(self) -> int | None:
        """Limit of the steps of a run; None if unknown."""


@dataclass(frozen=True)
class SceneRun(AbstractRun):
    """A run of a scene; `fixed` is the scene and the numeric arguments of `simulate`.

    - `observe`: the observables.
    - `choices`: static arguments of `simulate`.
    """

    observe: tuple[Observation, ...]
    choices: tuple[tuple[str, Any], ...]

    def evaluate(self, fixed: PyTree, numbers: Mapping[str, Array]) -> RunOutcome:
        """Run the scene; in forward mode with respect to the numbers of its derivatives."""
        scene, common = fixed
        scene, arguments = _replaced(scene, common, numbers)
        derivatives = {x.name: x.of for x in self.observe if isinstance(x.of, Derivative)}
        wrt = list(dict.fromkeys(name for derivative in derivatives.values() for name in derivative.names))
        choices: dict[str, Any] = dict(self.choices)

        def at(x: dict[str, Array]) -> tuple[dict[str, Array], RunOutcome]:
            changed, called = _replaced(scene, arguments, x)
            run = simulate(changed, **called, **choices, throw=False)
            values = {each.name: _observed(each, run, "ts" not in common) for each in self.observe}
            return values, RunOutcome(run.code, run.stats["num_steps"], values, run.result.messages)

        if not wrt:
            return at({})[1]
        slopes, outcome = jax.jacfwd(at, has_aux=True)({name: _number_of(scene, arguments, name) for name in wrt})
        values = dict(outcome.values)
        for name, derivative in derivatives.items():
            by = [slopes[name][number] for number in derivative.names]
            values[name] = by[0] if isinstance(derivative.wrt, str) else jnp.stack(by)
        return eqx.tree_at(lambda x: x.values, outcome, values)

    def within(self, max_steps: int) -> AbstractRun:
        """The same with another step limit."""
        return SceneRun(self.observe, tuple({**dict(self.choices), "max_steps": max_steps}.items()))

    @property
    def max_steps(self) -> int | None:
        """The step limit."""
        return dict(self.choices)["max_steps"]


@dataclass(frozen=True)
class FunctionRun(AbstractRun):
    """A function of the numbers of the run that returns numbers, or a run to observe."""

    function: Callable[..., object]
    observe: tuple[Observation, ...] | None

    def evaluate(self, fixed: PyTree, numbers: Mapping[str, Array]) -> RunOutcome:
        """Call the function."""
        del fixed
        returned = self.function(**numbers)
        if isinstance(returned, Trajectory):
            if self.observe is None:
                raise ValueError("The function returns a run: name the results to keep by observe=.")
            values = {each.name: _observed(each, returned, returned.end is None) for each in self.observe}
            return RunOutcome(returned.code, returned.stats["num_steps"], values, returned.result.messages)
        if self.observe is not None:
            raise ValueError(
                f"observe needs a run, but the function returned a {type(returned).__name__}: omit observe, and return"
                " a dictionary of results."
            )
        values = dict(returned) if isinstance(returned, Mapping) else {"value": returned}
        values = {str(name): _real(str(name), value) for name, value in values.items()}
        nan = jnp.any(jnp.stack([jnp.any(jnp.isnan(x)) for x in values.values()]))
        return RunOutcome(nan.astype(int), jnp.zeros((), int), values, _FUNCTION_MESSAGES)

    def within(self, max_steps: int) -> AbstractRun:
        """The same: the function sets its own limit."""
        del max_steps
        return self

    @property
    def max_steps(self) -> int | None:
        """Unknown."""
        return None


def rehearsed(run: AbstractRun) -> AbstractRun:
    """The run with its first step limit, so that shapes and program come from the trace that most runs use."""
    return run if run.max_steps is None else run.within(min(CAP, run.max_steps))


def out_of_steps(code: np.ndarray) -> np.ndarray:
    """Whether each run reached its limit of steps."""
    return code == MAX_STEPS


def _replaced(
    scene: Scene, arguments: Mapping[str, object], numbers: Mapping[str, object]
) -> tuple[Scene, dict[str, Any]]:
    """Scene and arguments of `simulate` with these numbers replaced, whole arrays or single entries."""
    changed, whole, single = dict(arguments), {}, {}
    known = scene_numbers(scene)
    for name, value in numbers.items():
        argument, _, index = name.partition("[")
        if name in known:
            whole[name] = value
        elif name in changed:
            changed[name] = value
        elif argument in changed:
            changed[argument] = jnp.asarray(changed[argument]).at[int(index.rstrip("]"))].set(value)
        else:
            single[name] = value
    return replace_elements(replace_numbers(scene, whole), single), changed


def _number_of(scene: Scene, arguments: Mapping[str, object], name: str) -> Array:
    """The number that `_replaced` would replace."""
    known = scene_numbers(scene)
    if name in known:
        return jnp.asarray(known[name])
    argument, _, index = name.partition("[")
    if argument in arguments:
        value = jnp.asarray(arguments[argument])
        return value[int(index.rstrip("]"))] if index else value
    leaf, place = elements(scene)[name]
    return jnp.asarray(known[leaf])[place]
