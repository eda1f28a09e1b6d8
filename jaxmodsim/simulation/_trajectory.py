"""The result of a run."""

import math
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass, field, fields
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

import jax
import jax.core
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Float, Int, PyTree

from .._core.arrays import is_known
from .._core.compat import get_opaque_trace_state
from .._core.readable import AbstractReadable, Table, short, table_of
from ..mechanics import momentum
from ..scene import ConstraintReaction, Scene, State, forward_dynamics, mode_numbers, quantity_of
from ..solvers import EventLog
from ._accuracy import Accuracy
from ._columns import ByName, Columns, columns
from ._energy_ledger import EnergyLedger, at_events, ledger
from ._integrated_system import Series, Work
from ._outcome import SUCCESS, RunResult, SimulationError, outcome_messages
from ._run_request import RunRequest
from ._solve import RunOutput, solve, solve_start

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

_Value = TypeVar("_Value")


@jtu.register_dataclass
@dataclass(frozen=True, repr=False)
class Events(AbstractReadable):
    """Mode changes along a run in order of time; `print` shows them in words.

    Friction laws with stick, contacts and switches change modes. Elements that change at the same instant have one
    entry each. An impact is an entry of its contact, from open to open if the gap opens again. Inside `jax.jit`,
    `jax.vmap` and `jax.grad` the number of entries is fixed: the arrays are padded with infinity and -1. Elsewhere they
    are NumPy arrays of the entries alone.

    - `t`: time [s], differentiable.
    - `effect`: index of the effect in the scene; contacts follow the effects, in the order of the constraints.
    - `before`, `after`: mode before and after. Friction: 0 in stick, else the sign of the slip velocity, in the plane
      1. Contact: 0 if open, 1 if closed. Switch: the sign of its guard.
    - `labels`: name of each effect and contact, and the words for its modes.
    """

    t: Float[Array | np.ndarray, "*runs events"]
    effect: Int[Array | np.ndarray, "*runs events"]
    before: Int[Array | np.ndarray, "*runs events"]
    after: Int[Array | np.ndarray, "*runs events"]
    labels: tuple[tuple[str, tuple[tuple[int, str], ...]], ...] = field(default=(), metadata={"static": True})

    __repr__ = AbstractReadable.__str__

    def _in_words(self) -> tuple["ModeChange", ...]:
        """The entries in words, for `print` and `Trajectory.mode_changes`; outside of `jax.jit`."""
        columns = (np.asarray(x).tolist() for x in (self.t, self.effect, self.before, self.after))
        happened = [entry for entry in zip(*columns, strict=True) if entry[0] < math.inf]
        words = [(name, dict(modes)) for name, modes in self.labels]
        return tuple(ModeChange(t, words[i][0], words[i][1][a], words[i][1][b]) for t, i, a, b in happened)


class ModeChange(NamedTuple):
    """A change of the mode of a friction element, a contact or a switch, or an impact.

    - `t`: time [s]; `effect`: name of the element.
    - `before`, `after`: `"stick"`, or `"forward"` or `"backward"` for positive and negative slip, `"slip"` in the
      plane; for a contact `"open"` or `"closed"`; for a switch `"above"` or `"below"`.
    """

    t: float
    effect: str
    before: str
    after: str


_MODES, _PLANE_MODES = {0: "stick", 1: "forward", -1: "backward"}, {0: "stick", 1: "slip"}
_CONTACT_MODES, _SWITCH_MODES = {0: "open", 1: "closed"}, {1: "above", -1: "below"}


@jtu.register_dataclass
@dataclass(frozen=True, repr=False)
class Energy(AbstractReadable):
    """Energies along a run [J], shape `[time]` each.

    - `kinetic`, `potential`: energies of the Lagrangian; see `jaxmodsim.mechanics.energies`.
    - `stored`: energy in the states of friction laws (bristles).
    - `work_in`: energy supplied since t0 by applied forces, belts, moving constraints, and explicit time dependence of
      the Lagrangian.
    - `dissipated`: energy lost since t0 in friction and impacts, and at t0 if the initial state was projected. For
      dynamic laws with a `normal_force` the energy in the state counts as lost until it returns, because with a
      variable load it is no function of the state.
    - `balance`: kinetic + potential + stored + dissipated - work_in, less its value at t0: the error of the
      integration.
    """

    kinetic: Float[Array | np.ndarray, "*runs time"]
    potential: Float[Array | np.ndarray, "*runs time"]
    stored: Float[Array | np.ndarray, "*runs time"]
    work_in: Float[Array | np.ndarray, "*runs time"]
    dissipated: Float[Array | np.ndarray, "*runs time"]
    balance: Float[Array | np.ndarray, "*runs time"]

    __repr__ = AbstractReadable.__str__


@partial(
    jtu.register_dataclass,
    data_fields=("t", "q", "qd", "z", "modes", "counts", "code", "end", "request", "log", "work"),
    meta_fields=("accuracy",),
)
@dataclass(frozen=True, repr=False)
class Trajectory(AbstractReadable):
    """A run of a scene. Forces, events and energies are computed on first access.

    More than the first 16 events, and energies, are not saved during the run and require a second run. Each such run
    is made once, and its results stay with this object, not with copies of it by `jax.jit` or `jax.tree.map`. A branch
    or a loop in `jax.jit` (`jax.lax.cond`, `jax.lax.scan`) that reads them first makes its own run.
    `simulate(..., record=("events", "energy"))` records them in the run.

    - `t`: times [s], shape `[time]`; `ts`, or the end alone. Times after an early end are infinite.
    - `q`, `qd`: coordinates and velocities, shape `[time, dof]`.
    - `z`: states of effects, by effect name; each with a leading time axis.
    - `modes`: modes of event-driven friction elements, contacts and switches, shape `[time, modes]`, or None. By name:
      `mode`.
    - `counts`: `stats` as arrays.
    - `accuracy`: the report of `simulate_to_accuracy`; None without.

    Read a run of `jax.vmap` inside it, or by `jax.vmap(lambda run: run.forces)(runs)`.

    **Example:**

    ```python
    scene = jms.problems.belt_oscillator.scene()
    run = jms.simulate(scene, [0.0], [0.0], 3.0, ts=jnp.linspace(0.0, 3.0, 301))
    print(run.result, run.q.shape, run.stats["num_events"])
    print(f"friction at 0.5 s: {run.forces['friction'][50]:.3f} N")
    ```

    ```text
    The run reached t1. (301, 1) 6
    friction at 0.5 s: -4.900 N
    ```
    """

    t: Float[Array, " *time"]
    q: Float[Array, "*time dof"]
    qd: Float[Array, "*time dof"]
    z: dict[str, PyTree]
    modes: Float[Array, "*time elements"] | None
    counts: dict[str, Array]
    code: Int[Array, "..."]
    end: Float[Array, "..."] | None
    request: RunRequest
    # Records of the run: a log of its first events, and the work at the saved times.
    log: EventLog | None = None
    work: Work | None = None
    accuracy: Accuracy | None = None
    # Results of repeats of the run, by name; not in the pytree.
    _repeats: dict[str, Any] = field(default_factory=dict, init=False, repr=False, compare=False)
    # The trace in which results may be stored: those of an inner trace must not outlive it.
    _home: object = field(default_factory=get_opaque_trace_state, init=False, repr=False, compare=False)

    __repr__ = AbstractReadable.__str__

    def __reduce__(self) -> tuple[Callable[[], "Trajectory"], tuple[()]]:
        return partial(Trajectory, **{x.name: getattr(self, x.name) for x in fields(self) if x.init}), ()

    @property
    def scene(self) -> Scene:
        """The scene that was run."""
        return self.request.scene

    @property
    def stats(self) -> dict[str, Any]:
        """`num_steps`, `num_rejected_steps` of these, and `num_events` where laws run by events.

        Integers; arrays inside `jax.jit` and of batches. Elements that change at one instant count as one event.
        """
        return {name: int(x) if is_known(x) and x.ndim == 0 else x for name, x in self.counts.items()}

    @property
    def t_end(self) -> Float[Array, "..."]:
        """Time that the run reached [s]; t1 unless it ended early."""
        return self.t[..., -1] if self.end is None else self.end

    @property
    def result(self) -> RunResult:
        """Outcome of the run: `run.result.ok`, `run.result.message`."""
        return RunResult(self.code, outcome_messages(self.scene, self.q.shape[-1]))

    @property
    def forces(self) -> dict[str, Array]:
        """Force of each effect along the run, by effect name.

        For `Friction` the friction force [N], shape `[time]`, positive when it opposes positive slip; for
        `AppliedForce` the value of its function, shape `[time, ...]`.
        """
        self._one_run("forces")
        forces = _along(_forces, self.scene, self.t, self._states(), self.modes)
        # Compiled functions return them sorted by name.
        return ByName({name: forces[name] for name in self.scene.names})

    @property
    def reactions(self) -> dict[str, ConstraintReaction]:
        """Forces of each constraint along the run, by name: multipliers, generalised and Cartesian force."""
        self._one_run("reactions")
        reactions = _along(_reactions, self.scene, self.t, self._states(), self.modes)
        return ByName({name: reactions[name] for name in self.scene.constraint_names})

    @property
    def mode(self) -> dict[str, Array]:
        """Mode of each event-driven friction element, contact and switch, by name, shape `[time]`.

        Friction: 0 in stick, else the sign of slip, 1 in the plane, where `forces` has the direction. Contacts: 0 open,
        1 closed. Switches: the sign of the guard.
        """
        if self.modes is None:
            return ByName()
        modes = mode_numbers(self.modes, self.scene.mode_widths(self.q.shape[-1]))
        return ByName({name: modes[..., i] for i, name in enumerate(self.scene.mode_names)})

    @property
    def mode_labels(self) -> dict[str, dict[int, str]]:
        """Labels of the numbers of `mode`, by name, as in `ModeChange`."""
        scene = self.scene
        widths = dict(zip(scene.mode_names, scene.mode_widths(self.q.shape[-1]), strict=True))
        words = {name: _MODES if width == 1 else _PLANE_MODES for name, width in widths.items()}
        return words | dict.fromkeys(scene.contacts, _CONTACT_MODES) | dict.fromkeys(scene.switches, _SWITCH_MODES)

    @property
    def events(self) -> Events:
        """Mode changes along the run; if the run did not log all of them, the first access repeats the run."""
        self._one_run("events")
        if self.modes is None:
            none = jnp.zeros(0, int)
            return Events(jnp.zeros(0, self.t.dtype), none, none, none)
        return self._once("events", self._named_events)

    @property
    def mode_changes(self) -> tuple[ModeChange, ...]:
        """`events` in words; outside of `jax.jit`."""
        return self.events._in_words()

    @property
    def event_forces(self) -> dict[str, Array]:
        """Force of each effect just before and after each change of mode, by effect name; repeats the run as `events`.

        Shape `[instants, 2, ...]`, padded with NaN. At a break-away the force before is the limit in stick. Several
        elements that change at one instant have one entry.
        """
        self._one_run("event_forces")
        if self.modes is None:
            none = {name: jnp.zeros((0, 2, *force.shape[1:]), force.dtype) for name, force in self.forces.items()}
            return ByName(none)
        return ByName(self._once("event_forces", lambda: _event_forces(self.scene, self._log())))

    def event_sides(self, series: Series) -> Float[Array, "instants 2"]:
        """A series just before and after each change of mode; zero in unused entries."""
        if self.modes is None:
            return jnp.zeros((0, 2), self.t.dtype)
        log, (kind, effect, index) = self._log(), series
        if kind == "force":
            sides = jnp.nan_to_num(self.event_forces[effect])
        else:
            sides = jnp.stack([getattr(side[0], kind) for side in (log.before, log.after)], axis=1)
            sides = jnp.where(jnp.isfinite(log.t)[:, None, None], sides, 0.0)
        return sides if index is None else sides[..., index]

    @property
    def momentum(self) -> Float[Array, "*time dof"]:
        """Canonical momenta dL/dqd along the run, shape `[time, dof]` [kg m/s or kg m^2/s]."""
        self._one_run("momentum")
        return _along(_momentum, self.scene, self.t, self._states(), self.modes)

    @property
    def ledger(self) -> EnergyLedger:
        """Energies by place, and the work of each effect; the first access repeats the run with the work integrals.

        `jaxmodsim.energy_audit` sums them.
        """
        self._one_run("ledger")
        return self._once("ledger", self._booked)

    @property
    def event_losses(self) -> Float[Array, " time"]:
        """Energy [J] lost since t0 at events; repeats the run as `events`.

        An impact on a surface that moves loses what the surface supplies, less the gain in energy: the loss is the same
        for observers at rest and in motion.
        """
        self._one_run("event_losses")
        log = self._log() if self.scene.contacts else None
        return at_events(self.request, self.t, solve_start(self.request), log)[0]

    @property
    def energy(self) -> Energy:
        """Energies and their balance along the run, sums of `ledger`; losses of impacts count as dissipated."""
        self._one_run("energy")
        book, zero = self.ledger, jnp.zeros_like(self.t)
        stored, supplied, dissipated = (
            sum(each.values(), zero) for each in (book.stored, book.supplied, book.dissipated)
        )
        return Energy(book.kinetic, book.potential, stored, supplied, dissipated + book.lost, book.balance)

    @property
    def columns(self) -> Columns:
        """Coordinates, velocities, forces and modes at the times that the run reached, by name, with units."""
        return columns(self.scene, self.t, self.q, self.qd, self.forces, self.mode)

    def to_dataframe(self) -> "pd.DataFrame":
        """`columns` as a pandas DataFrame over time; `attrs["units"]` has the units."""
        return self.columns.to_dataframe()

    def to_xarray(self) -> "xr.Dataset":
        """`columns` as an xarray Dataset over time, with units as attributes."""
        return self.columns.to_xarray()

    @property
    def log_size(self) -> int:
        """Length of a log for all events, a power of two, as each length compiles a program."""
        count, size = self.stats.get("num_events", 0), self.request.choices.max_events
        return size if not is_known(count) else min(size, 1 << max(int(count), 8).bit_length())

    def _log(self) -> EventLog:
        """The log of all events: that of the run, if it is long enough, or that of a repeat."""
        most, count = self.request.choices.max_events, self.stats["num_events"]
        needed = min(int(count), most) if is_known(count) else most
        if self.log is not None and self.log.t.shape[0] >= needed:
            return self.log
        # Events do not depend on saved times; known ones are already checked.
        ts = None if is_known(self.request.ts) else self.request.ts
        again = self.request._replace(ts=ts).choosing(log=self.log_size, audited=False)
        return self._once("log", lambda: solve(again).log)

    def _named_events(self) -> Events:
        """Events with the words for their modes; as many as happened, where that is known."""
        t, *modes = _events(self.scene, self._log())
        if is_known(t):
            # JAX would give the last entry for an index beyond it; NumPy raises an IndexError.
            t, *modes = map(np.asarray, (t, *modes))
            t, *modes = (x[np.isfinite(t)] for x in (t, *modes))
        words = self.mode_labels
        labels = tuple((name, tuple(words.get(name, {}).items())) for name in self.scene.part_names)
        return Events(t, *modes, labels=labels)

    def _audited(self) -> tuple[Work, EventLog | None]:
        """The work at the saved times, and with contacts the log of all events, which has their losses.

        They come from this run if it recorded them, else from a repeat.

        **Raises:**

        - `SimulationError` if this run reached t1 and the repeat does not, due to rounding. Inside compiled code the
          work is infinite after the end of the repeat.
        """
        if self.work is not None:
            return self.work, self.log
        asked = self.request.choosing(log=self.log_size if self.scene.contacts else 0, audited=True)
        again = self._once("audited", lambda: solve(asked))
        if is_known(self.code, again.code) and int(self.code) == SUCCESS != int(again.code):
            raise SimulationError(
                "The run reached t1, but repeated with the work integrals beside it, it does not, so its energies are"
                f" not known: {outcome_messages(self.scene, self.q.shape[-1])[int(again.code)]}"
            )
        assert again.work is not None
        return again.work, again.log

    def _booked(self) -> EnergyLedger:
        work, log = self._audited()
        return ledger(self.request, self.t, self._states(), work, solve_start(self.request), log)

    def _once(self, name: str, make: Callable[[], _Value]) -> _Value:
        """A value from a repeat of the run, made once."""
        if name in self._repeats:
            return self._repeats[name]
        # The value of a run with known numbers is known, also if the caller is being traced.
        known = is_known(*jtu.tree_leaves(self))
        with jax.core.eval_context() if known else nullcontext():
            value = make()
        if known or get_opaque_trace_state() == self._home:
            self._repeats[name] = value
        return value

    def _states(self) -> State:
        return State(self.q, self.qd, self.z)

    def _one_run(self, what: str) -> None:
        if self.t.ndim != 1:
            raise ValueError(
                f"This Trajectory holds a batch of runs (times of shape {self.t.shape}); {what} reads one run:"
                f" use jax.vmap(lambda run: run.{what})(runs)."
            )


@table_of.register
def _(run: Trajectory) -> Table:
    """The motion alone: forces and events take a computation, or another run."""
    notes = tuple(f"{name} {short(x)}" for name, x in run.counts.items())
    if not is_known(run.t, run.q) or run.t.ndim != 1:
        return Table(f"Trajectory, times of shape {run.t.shape}: {run.result}", (), [], notes)
    reached = np.isfinite(run.t)
    rows = []
    for kind, x in (("q", run.q), ("qd", run.qd)):
        for i, column in enumerate(np.asarray(x)[reached].T):
            edges = (column[0], column[-1], column.min(), column.max()) if len(column) else ()
            rows.append((quantity_of(run.scene, f"{kind}[{i}]").label, *map(short, edges), *[""] * (4 - len(edges))))
    t = f"{reached.sum()} of {len(run.t)} times up to {short(run.t_end)} s"
    head = ("", "first", "last", "least", "greatest")
    return Table(f"Trajectory, {t}: {run.result}", head, rows, (", ".join(notes),))


@table_of.register
def _(events: Events) -> Table:
    if not is_known(events.t) or events.t.ndim != 1:
        return Table(f"Events, times of shape {events.t.shape}", (), [])
    changes = events._in_words()
    rows = [(f"{x.t:.6g}", x.effect, x.before, "impact" if x.after == x.before else x.after) for x in changes]
    times = len({x.t for x in changes})
    at = "" if times == len(rows) else f" at {times} times"
    return Table(f"{len(rows)} mode changes{at}", ("t [s]", "effect", "before", "after"), rows)


@table_of.register
def _(energy: Energy) -> Table:
    columns = {each.name: getattr(energy, each.name) for each in fields(energy)}
    if not is_known(*columns.values()) or energy.balance.ndim != 1:
        return Table(f"Energy, shape {energy.balance.shape}", (), [])
    reached = {name: np.asarray(x)[np.isfinite(x)] for name, x in columns.items()}
    rows = [(f"{name} [J]", *map(short, (x[0], x[-1], x.min(), x.max()))) for name, x in reached.items() if len(x)]
    return Table("Energy", ("", "first", "last", "least", "greatest"), rows)


def trajectory(request: RunRequest, solved: RunOutput) -> Trajectory:
    """The trajectory of a solved run."""
    y, end = solved.y, None if solved.end is None else solved.end[0]
    motion = solved.t, y.q, y.qd, y.z, solved.mode
    return Trajectory(*motion, solved.stats, solved.code, end, request, solved.log, solved.work)


def _forces(scene: Scene, t: Array, y: State, mode: Array | None) -> dict[str, Array]:
    return forward_dynamics(t, y, scene, mode).forces


def _reactions(scene: Scene, t: Array, y: State, mode: Array | None) -> dict[str, ConstraintReaction]:
    return forward_dynamics(t, y, scene, mode).reactions


def _momentum(scene: Scene, t: Array, y: State, mode: Array | None) -> Array:
    del mode
    now = scene.bind_time(t)
    return momentum(now.lagrangian, t, y.q, y.qd, now.params)


@partial(jax.jit, static_argnums=0)
def _along(get: Callable[..., PyTree], scene: Scene, t: Array, y: State, mode: Array | None) -> PyTree:
    """`get(scene, t, y, mode)` at each time of a run, infinite at times after an early end."""
    tree = jax.vmap(partial(get, scene))(t, y, mode)
    return jtu.tree_map(lambda x: jnp.where(jnp.expand_dims(jnp.isfinite(t), range(1, x.ndim)), x, jnp.inf), tree)


@jax.jit
def _event_forces(scene: Scene, log: EventLog) -> dict[str, Array]:
    happened = jnp.isfinite(log.t)
    t = jnp.where(happened, log.t, 0.0)
    sides = [jax.vmap(partial(_forces, scene))(t, *side) for side in (log.before, log.after)]
    both = jtu.tree_map(lambda *each: jnp.stack(each, axis=1), *sides)
    return jtu.tree_map(lambda x: jnp.where(jnp.expand_dims(happened, range(1, x.ndim)), x, jnp.nan), both)


@jax.jit
def _events(scene: Scene, log: EventLog) -> tuple[Array, Array, Array, Array]:
    """Columns of `Events`, padded: one entry for each element that changed its mode, from a log of the instants."""
    widths = scene.mode_widths(log.before[0].q.shape[-1])
    before, after, fired = (mode_numbers(x, widths) for x in (log.before[1], log.after[1], log.fired))
    indices = jnp.asarray([scene.part_names.index(name) for name in scene.mode_names])
    # Every firing of a contact is an event, also an impact that leaves it open.
    strikes = jnp.asarray([[name in scene.contacts for name in scene.mode_names]]) & (fired > 0.5)
    changed = jnp.ravel(((before != after) | strikes) & jnp.isfinite(log.t)[:, None])
    order = jnp.argsort(~changed, stable=True)

    def column(x: Array, filler: float | int) -> Array:
        return jnp.where(changed, jnp.ravel(jnp.broadcast_to(x, before.shape)), filler)[order]

    return (
        column(log.each[:, np.cumsum([0, *widths[:-1]])], jnp.inf),
        column(indices[None, :], -1),
        column(before.astype(int), -1),
        column(after.astype(int), -1),
    )
