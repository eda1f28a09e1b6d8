"""The integrated state of a run, and its functions for diffrax."""

from collections.abc import Callable
from functools import partial, wraps
from typing import Any, NamedTuple, TypeAlias, TypeVar, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Float, PyTree

from ..mechanics import momentum, motion_equations, velocity
from ..mechanics import project as projected
from ..scene import (
    Power,
    Scene,
    State,
    forward_dynamics,
    from_dynamics,
    linear_solver,
    mode_numbers,
    scene_step,
    start,
    switch,
    vector_field,
)
from ..solvers import EventState

_Function = TypeVar("_Function", bound=Callable[..., Any])


def at_time(fn: _Function) -> _Function:
    """`fn(self, t, y, scene, ...)` with the signals of the scene at time `t`.

    diffrax passes time and scene separately; this binds the time into the scene at the boundary to diffrax.
    """

    @wraps(fn)
    def bound(self: object, t: Array, y: PyTree, scene: Scene, *more: PyTree) -> PyTree:
        return fn(self, t, y, scene.bind_time(t), *more)

    return cast(_Function, bound)


def project(t: Float[Array, ""], y: State, scene: Scene, mode: Array | None) -> State:
    """State moved onto the constraints of these modes; the scene is that of time `t`."""
    mass = motion_equations(scene.lagrangian, t, y.q, y.qd, scene.params).mass
    q, qd = projected(scene.constraints_in(mode), t, y.q, y.qd, scene.params, mass)
    return y._replace(q=q, qd=qd)


# Energy [J] supplied from outside and absorbed since t0, by the names of `Dynamics.power`.
Work: TypeAlias = dict[str, Power]


class AugmentedState(NamedTuple):
    """The integrated state of an audited run.

    - `motion`: a `State`, with momenta in the place of velocities if the run is canonical.
    - `work`: the energy supplied and absorbed.
    """

    motion: State
    work: Work


class IntegratedSystem(NamedTuple):
    """The integrated state: a `State`, with momenta in the place of velocities if `canonical`.

    In an `audited` run it is an `AugmentedState`. Arguments `t, ..., scene` are a scene at the time `t`, see `at_time`.
    """

    audited: bool
    canonical: bool

    @at_time
    def start(self, t: Array, state: State, scene: Scene, mode: Array | None) -> PyTree:
        """Initial integrated state."""
        y = self._inner(t, state, scene)
        if not self.audited:
            return y
        return AugmentedState(y, jtu.tree_map(jnp.zeros_like, forward_dynamics(t, state, scene, mode).power))

    def state(self, t: Array, y: PyTree, scene: Scene) -> State:
        """The `State` in the integrated state."""
        y = y.motion if isinstance(y, AugmentedState) else y
        if not self.canonical:
            return y
        return y._replace(qd=velocity(scene.lagrangian, t, y.q, y.qd, scene.params))

    def state_rate(self, t: Array, state: State, slope: PyTree, scene: Scene, mode: Array | None) -> State:
        """The rate of a `State`, from the rate of the integrated state."""
        if self.canonical:
            return vector_field(t, state, scene, mode)
        return slope.motion if isinstance(slope, AugmentedState) else slope

    def replace(self, t: Array, y: PyTree, state: State, scene: Scene) -> PyTree:
        """The integrated state with another `State`."""
        inner = self._inner(t, state, scene)
        return y._replace(motion=inner) if isinstance(y, AugmentedState) else inner

    def result(self, t: Array, y: PyTree, scene: Scene) -> PyTree:
        """The saved part: the `State`, in an audited run a pair of it and `Work`."""
        state = self.state(t, y, scene)
        return (state, y.work) if self.audited else state

    def derivative(self, t: Array, y: PyTree, scene: Scene, mode: Array | None, *limits: PyTree) -> tuple[PyTree, Any]:
        """Right-hand side, and from the same forces the guards, if there are limits for them."""
        audited = isinstance(y, AugmentedState)
        rate, power, guards = from_dynamics(
            lambda d: (
                d.canonical_rate if self.canonical else d.rate,
                d.power if audited else {},
                d.guards(*limits)[0] if limits else None,
            ),
            *(t, self.state(t, y, scene), scene, mode),
        )
        return AugmentedState(rate, power) if audited else rate, guards

    def advance(self, t0: Array, t1: Array, y: PyTree, scene: Scene) -> tuple[PyTree, Array]:
        """One step of `ImplicitFriction`, and whether it was solved; work uses the powers at its end."""
        state, solved = scene_step(scene, t0, t1, self.state(t0, y, scene))
        if not self.audited:
            return state, solved
        work = jtu.tree_map(
            lambda work, power: work + (t1 - t0) * power, y.work, forward_dynamics(t1, state, scene).power
        )
        return AugmentedState(state, work), solved

    @at_time
    def linear_solver(
        self, t: Array, y: State, scene: Scene, rate: State, shift: Array, pivot: bool
    ) -> Callable[[State], State]:
        """The linear systems of a step of `Rodas5P`, for a run that is neither audited nor canonical."""
        return linear_solver(t, y, rate.qd, scene, shift=shift, pivot=pivot)

    def _inner(self, t: Array, state: State, scene: Scene) -> State:
        if not self.canonical:
            return state
        return state._replace(qd=momentum(scene.lagrangian, t, state.q, state.qd, scene.params))


class Series(NamedTuple):
    """A series along a run: `q` or `qd` of the coordinate `i`, or the component `i` of the `force` of an `effect`."""

    kind: str
    effect: str
    i: int | None


class Instant(NamedTuple):
    """The rate of a state, and the excess of the force of each sticking element over its limit, in limits."""

    rate: State
    stick_violation: Float[Array, "..."]


# A step of a scene with events or constraints evaluates large fields a dozen times. As functions of jit they are
# traced, linearised and transposed once.
_derivative = partial(jax.jit, static_argnums=0)(at_time(IntegratedSystem.derivative))
_guards = jax.jit(lambda t, y, scene, mode, *limits: from_dynamics(lambda d: d.guards(*limits), t, y, scene, mode))


class RunFunctions(eqx.Module):
    """The functions of a run; for runs with modes those of a state `s` are functions of `EventSolver`."""

    system: IntegratedSystem = eqx.field(static=True)
    # Speed of rest [m/s].
    rest: Float[Array, ""]
    # Relative tolerance of the limits of stick, absolute tolerance of slip velocities.
    tolerances: tuple[Float[Array, ""], Float[Array, ""]]
    # Whether each step ends with a projection onto the constraints, and onto zero slip in stick, which drift.
    projects: bool = eqx.field(static=True)
    sticks: bool = eqx.field(static=True)
    # Whether chatter is held in stick.
    holds: bool = eqx.field(static=True)
    # Number of entries of each mode.
    widths: tuple[int, ...] = eqx.field(static=True)

    def plain_derivative(self, t: Any, y: PyTree, scene: Scene, mode: Array | None = None) -> PyTree:
        """Right-hand side for these modes; None in a run without modes."""
        return _derivative(self.system, t, y, scene, mode)[0]

    def derivative(self, t: Any, s: EventState, scene: Scene) -> EventState:
        """Right-hand side."""
        return s.rate(_derivative(self.system, t, s.y, scene, s.mode)[0])

    def derivative_and_guards(self, t: Any, s: EventState, scene: Scene) -> tuple[PyTree, Array]:
        """Right-hand side and guards."""
        return _derivative(self.system, t, s.y, scene, s.mode, self.rest, self.tolerances)

    @at_time
    def guards(self, t: Array, s: EventState, scene: Scene) -> tuple[Array, ...]:
        """Guards of the modes, their tolerances, and in scenes with contacts their values at events."""
        return _guards(t, self.system.state(t, s.y, scene), scene, s.mode, self.rest, self.tolerances)

    @at_time
    def begin(self, t: Array, y: PyTree, scene: Scene, mode: Array) -> tuple[PyTree, Array]:
        """Initial state and modes; only the shape of `mode` counts."""
        state = self.system.state(t, y, scene)
        state, mode = start(t, state, scene, mode, self.rest)
        return self.system.replace(t, y, state, scene), mode

    @at_time
    def reset(self, t: Array, s: EventState, scene: Scene, fired: Array) -> EventState:
        """State after changes of modes and impacts; the same state without them."""
        before = self.system.state(t, s.y, scene)
        rate = self.system.state_rate(t, before, s.slope, scene, s.mode) if scene.contacts else None
        assert s.dense is not None
        state, mode, touching = switch(t, before, scene, s.mode, fired, self.rest, s.dense, self.holds, rate)
        after = self.system.replace(t, s.y, state, scene)
        if scene.contacts:  # a contact may have closed; the derivative, too, or the next step would move it
            after = self.project(t, after, scene, touching)
        # Without an impact or another mode only rounding has changed: a sample of an input in stick is no event.
        changed = jnp.any(self.event_mode(mode) != self.event_mode(s.mode))
        if scene.contacts:
            changed |= jnp.any(scene.split_modes(fired)[1]) & jnp.any(state.qd != before.qd)
        return s._replace(y=jtu.tree_map(lambda a, b: jnp.where(changed, a, b), after, s.y), mode=mode)

    def event_mode(self, mode: Array) -> Array:
        """The parts of the modes that an event changes: without the reference velocities of planes, and kinks."""
        return mode_numbers(mode, self.widths)

    def _stick(self, t: Array, s: EventState, scene: Scene) -> EventState:
        state = from_dynamics(lambda d: d.stick(s.mode), t, self.system.state(t, s.y, scene), scene, s.mode)
        return s._replace(y=self.system.replace(t, s.y, state, scene))

    @at_time
    def project(self, t: Array, y: PyTree, scene: Scene, mode: Array | None = None) -> PyTree:
        """The integrated state, projected onto the constraints."""
        if not self.projects:
            return y
        return self.system.replace(t, y, project(t, self.system.state(t, y, scene), scene, mode), scene)

    @at_time
    def project_and_stick(self, t: Array, s: EventState, scene: Scene) -> EventState:
        """The state, projected onto the constraints and into stick."""
        s = s._replace(y=self.project(t, s.y, scene, s.mode))
        return self._stick(t, s, scene) if self.sticks else s

    @at_time
    def observe(
        self, t: Array, y: PyTree, scene: Scene, mode: Array | None, series: Series
    ) -> tuple[Float[Array, ""], Float[Array, ""] | None]:
        """A series at a state, and its rate; None for the rate of a force."""
        state = self.system.state(t, y, scene)
        if series.kind == "q":
            return state.q[series.i], state.qd[series.i]
        if series.kind == "qd":
            return state.qd[series.i], from_dynamics(lambda d: d.rate, t, state, scene, mode).qd[series.i]
        force = from_dynamics(lambda d: d.forces[series.effect], t, state, scene, mode)
        return force if series.i is None else force[series.i], None

    @at_time
    def keep(self, t: Array, y: PyTree, scene: Scene, mode: Array | None) -> tuple[PyTree, Instant | None]:
        """The saved part of a state of dense output, projected; in a run with modes an `Instant`, too."""
        y = self.project(t, y, scene, mode)
        if mode is None:
            return self.system.result(t, y, scene), None
        state = self.system.state(t, y, scene)
        state, instant = from_dynamics(
            lambda d: (d.stick(mode) if self.sticks else d.y, Instant(d.rate, d.stick_violation)),
            *(t, state, scene, mode),
        )
        y = self.system.replace(t, y, state, scene) if self.sticks else y
        return self.system.result(t, y, scene), jax.lax.stop_gradient(instant)
