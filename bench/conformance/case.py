"""A public case, and what is measured of it: values, modes and derivatives against an independent reference."""

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import jaxmodsim as jms

# Tolerances of our runs.
RTOL, ATOL = 1e-12, 1e-14

Numbers = dict[str, Any]
Event = tuple[float, str]


class Setup(NamedTuple):
    """A scene and its initial state."""

    scene: jms.Scene
    q0: Any
    qd0: Any


class Reference(NamedTuple):
    """Outputs at the end of a motion, and its events: times and labels such as `clutch stick`."""

    values: Any
    events: list[Event]


@dataclass(frozen=True)
class Case:
    """A case that others published.

    - `source`: repository, commit and path. `results`: the same for its published results.
    - `make`: builds scene and initial state from `numbers`, the parameters by name.
    - `outputs`: names and units of the numbers that `observe(q, qd)` returns at `t1` [s].
    - `published`: published outputs, None for those that are not. `modes`: published mode changes.
    - `reference`: outputs and events from the same numbers by position, by a method that knows nothing of `jaxmodsim`.
    - `compared`: names of effects whose events are compared; all by default.
    - `by`: parameters of the derivative. `step`: of its central differences of the reference, relative to a number.
    - `note`: what differs from the published model, or why the case fails.
    """

    name: str
    source: str
    make: Callable[[Numbers], Setup]
    numbers: Mapping[str, float]
    t1: float
    outputs: tuple[str, ...]
    observe: Callable[[Any, Any], Any]
    published: tuple[float | None, ...]
    reference: Callable[..., Reference]
    modes: tuple[Event, ...] = ()
    compared: tuple[str, ...] = ()
    by: tuple[str, ...] = ()
    step: float = 1e-3
    note: str = ""
    results: str = ""
    options: Mapping[str, Any] = field(default_factory=dict)

    def exact(self, **changed: float) -> Reference:
        """The reference, with some numbers changed."""
        return self.reference(*(dict(self.numbers) | changed).values())

    def exact_derivatives(self) -> np.ndarray:
        """Derivatives of the outputs by the numbers `by`, shape `[by, outputs]`: central differences of sixth order."""
        rows = []
        for name in self.by:
            h = self.step * (abs(self.numbers[name]) or 1.0)
            ends = [self.exact(**{name: self.numbers[name] + k * h}).values for k in (-3, -2, -1, 1, 2, 3)]
            weights = np.array([-1.0, 9.0, -45.0, 45.0, -9.0, 1.0]) / (60.0 * h)
            rows.append(weights @ np.array(ends, float))
        return np.array(rows)

    def simulate(self, p: Numbers, **options: Any) -> jms.Trajectory:
        """Our run."""
        scene, q0, qd0 = self.make(p)
        given = {"rtol": RTOL, "atol": ATOL, "max_events": 32, "throw": False} | dict(self.options) | options
        return jms.simulate(scene, q0, qd0, self.t1, **given)

    def outputs_of(self, chosen: Numbers, **options: Any) -> tuple[Any, jms.Trajectory]:
        """Outputs of our run as a function of some numbers, with the run."""
        p = {name: jnp.asarray(float(value)) for name, value in self.numbers.items()} | chosen
        run = self.simulate(p, **options)
        return jnp.stack([jnp.asarray(x) for x in self.observe(run.q[-1], run.qd[-1])]), run

    def ours(self, derivatives: bool = True) -> "Outcome":
        """Values, events, derivatives and the time of the second call, in one compilation."""
        chosen = {name: jnp.asarray(float(self.numbers[name])) for name in self.by}

        def outputs(chosen: Numbers) -> tuple[Any, tuple[Any, jms.Trajectory]]:
            values, run = self.outputs_of(chosen)
            return values, (values, run)

        if not (derivatives and self.by):
            values, run = self.outputs_of(chosen)
            _need_success(run)
            return Outcome(np.asarray(values), events_of(run, self.compared), None, np.nan)
        slopes = jax.jit(jax.jacfwd(outputs, has_aux=True))
        slopes(chosen)
        began = time.perf_counter()
        jacobian, (values, run) = jax.block_until_ready(slopes(chosen))
        seconds = time.perf_counter() - began
        _need_success(run)
        rows = np.array([np.asarray(jacobian[name]) for name in self.by])
        return Outcome(np.asarray(values), events_of(run, self.compared), rows, seconds)


def _need_success(run: jms.Trajectory) -> None:
    """Raise an error with the message of a run that ended early."""
    if not str(run.result).startswith("The run reached t1"):
        raise RuntimeError(str(run.result))


def modelica_case(name: str, *given: Any, **more: Any) -> Case:
    """A case of the Modelica Standard Library, `name` such as `Rotational.First`; text after a comma is ours."""
    path = "Modelica/Mechanics/{}/Examples/{}".format(*name.partition(",")[0].split("."))
    results = f"modelica/MAP-LIB_ReferenceResults @ d6a2b9b2, {path}/{path.rpartition('/')[2]}.csv"
    return Case(name, f"modelica/ModelicaStandardLibrary @ bd753330a, {path}.mo", *given, results=results, **more)


class Outcome(NamedTuple):
    """What our run gives: outputs, events, derivatives of shape `[by, outputs]`, and seconds of run and derivative."""

    values: np.ndarray
    events: list[Event]
    derivatives: np.ndarray | None
    seconds: float


def events_of(run: jms.Trajectory, compared: tuple[str, ...]) -> list[Event]:
    """Events of a run, as times and labels."""
    return [(c.t, f"{c.effect} {c.after}") for c in run.mode_changes if not compared or c.effect in compared]


def same_order(wanted: tuple[Event, ...] | list[Event], found: list[Event]) -> float | None:
    """Largest difference of times [s] if the events `wanted` occur in `found` in their order; None if they do not."""
    left, largest = list(found), 0.0
    for t, label in wanted:
        while left and left[0][1] != label:
            left.pop(0)
        if not left:
            return None
        largest = max(largest, abs(left.pop(0)[0] - t))
    return largest
