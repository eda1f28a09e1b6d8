"""One run of a sweep: numbers in, the outcome and what is observed out."""

import abc
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree

from ..scene import Scene, elements, replace_elements, replace_numbers, scene_numbers
from ..simulation import MAX_STEPS, Trajectory, simulate
from ._observe import Derivative, Observation, observed, real

# Steps that runs may take before they are set aside, where nothing is known of them.
CAP = 1024

# What a function that returns numbers ends with.
_FUNCTION_MESSAGES = ("The function gave numbers.", "The function gave NaN.")


class RunOutcome(eqx.Module):
    """What a run gives.

    - `code`: 0 where all went well, else an index into `messages`.
    - `num_steps`: steps of the run; 0 of a function that returns no run.
    - `values`: each observable by its name.
    """

    code: Array
    num_steps: Array
    values: dict[str, Array]
    messages: tuple[str, ...] = eqx.field(static=True)


class AbstractRun(abc.ABC):
    """What is computed of one run. Compared by value: it is compiled in."""

    @abc.abstractmethod
    def evaluate(self, fixed: PyTree, numbers: Mapping[str, Array]) -> RunOutcome:
        """Compute one run from what is common to all and its own numbers."""

    @abc.abstractmethod
    def within(self, max_steps: int) -> "AbstractRun":
        """The same, with runs that give up after so many steps."""

    @property
    @abc.abstractmethod
    def max_steps(self) -> int | None:
        """Limit of the steps of a run; None where it is not known here."""


@dataclass(frozen=True)
class SceneRun(AbstractRun):
    """A run of a scene; `fixed` is the scene and those arguments of `simulate` that are numbers.

    - `observe`: what is kept.
    - `choices`: arguments of `simulate` that are compiled in.
    """

    observe: tuple[Observation, ...]
    choices: tuple[tuple[str, Any], ...]

    def evaluate(self, fixed: PyTree, numbers: Mapping[str, Array]) -> RunOutcome:
        """Run the scene; in forward mode by the numbers that derivatives are wanted by."""
        scene, given = fixed
        scene, arguments = replaced(scene, given, numbers)
        wrt = list(dict.fromkeys(n for what in self.observe if isinstance(what.of, Derivative) for n in what.of.names))
        choices: dict[str, Any] = dict(self.choices)

        def at(x: dict[str, Array]) -> tuple[dict[str, Array], RunOutcome]:
            changed, called = replaced(scene, arguments, x)
            run = simulate(changed, **called, **choices, throw=False)
            values = {what.name: observed(what, run, "ts" not in given) for what in self.observe}
            return values, RunOutcome(run.code, run.stats["num_steps"], values, run.result.messages)

        if not wrt:
            return at({})[1]
        slopes, outcome = jax.jacfwd(at, has_aux=True)({name: number_of(scene, arguments, name) for name in wrt})
        return eqx.tree_at(lambda x: x.values, outcome, self._with_derivatives(outcome.values, slopes))

    def _with_derivatives(self, values: dict[str, Array], slopes: dict[str, dict[str, Array]]) -> dict[str, Array]:
        chosen = dict(values)
        for what in self.observe:
            if isinstance(what.of, Derivative):
                by = [slopes[what.name][name] for name in what.of.names]
                chosen[what.name] = by[0] if isinstance(what.of.wrt, str) else jnp.stack(by)
        return chosen

    def within(self, max_steps: int) -> AbstractRun:
        """The same with another step limit."""
        return SceneRun(self.observe, tuple({**dict(self.choices), "max_steps": max_steps}.items()))

    @property
    def max_steps(self) -> int | None:
        """The step limit."""
        return dict(self.choices)["max_steps"]


@dataclass(frozen=True)
class FunctionRun(AbstractRun):
    """A function of the numbers of the run that returns numbers, or a run that is then observed."""

    function: Callable[..., object]
    observe: tuple[Observation, ...] | None

    def evaluate(self, fixed: PyTree, numbers: Mapping[str, Array]) -> RunOutcome:
        """Call the function."""
        del fixed
        given = self.function(**numbers)
        if isinstance(given, Trajectory):
            if self.observe is None:
                raise ValueError("The function returns a run: say by observe= what to keep of it.")
            values = {what.name: observed(what, given, given.end is None) for what in self.observe}
            return RunOutcome(given.code, given.stats["num_steps"], values, given.result.messages)
        if self.observe is not None:
            raise ValueError(
                f"observe reads a run, but the function returned a {type(given).__name__}: leave observe out, and"
                " return a dictionary of what to keep."
            )
        values = dict(given) if isinstance(given, Mapping) else {"value": given}
        values = {str(name): real(str(name), value) for name, value in values.items()}
        nan = jnp.any(jnp.stack([jnp.any(jnp.isnan(x)) for x in values.values()]))
        return RunOutcome(nan.astype(int), jnp.zeros((), int), values, _FUNCTION_MESSAGES)

    def within(self, max_steps: int) -> AbstractRun:
        """The function itself says how many steps it allows."""
        del max_steps
        return self

    @property
    def max_steps(self) -> int | None:
        """Not known."""
        return None


def rehearsed(run: AbstractRun) -> AbstractRun:
    """The run with the step limit that most runs get first: looked at with it, it is traced only once."""
    return run if run.max_steps is None else run.within(min(CAP, run.max_steps))


def out_of_steps(code: np.ndarray) -> np.ndarray:
    """Runs that came to the end of the steps they were allowed."""
    return code == MAX_STEPS


def replaced(
    scene: Scene, arguments: Mapping[str, object], numbers: Mapping[str, object]
) -> tuple[Scene, dict[str, Any]]:
    """Scene and arguments of `simulate` with these numbers replaced, which are whole arrays or single entries."""
    given, whole, single = dict(arguments), {}, {}
    known = scene_numbers(scene)
    for name, value in numbers.items():
        argument, _, index = name.partition("[")
        if name in known:
            whole[name] = value
        elif name in given:
            given[name] = value
        elif argument in given:
            given[argument] = jnp.asarray(given[argument]).at[int(index.rstrip("]"))].set(value)
        else:
            single[name] = value
    return replace_elements(replace_numbers(scene, whole), single), given


def number_of(scene: Scene, arguments: Mapping[str, object], name: str) -> Array:
    """The number that `replaced` would replace."""
    known = scene_numbers(scene)
    if name in known:
        return jnp.asarray(known[name])
    argument, _, index = name.partition("[")
    if argument in arguments:
        value = jnp.asarray(arguments[argument])
        return value[int(index.rstrip("]"))] if index else value
    leaf, place = elements(scene)[name]
    return jnp.asarray(known[leaf])[place]
