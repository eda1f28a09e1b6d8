"""Output of a model for a record: a scene by fixed steps or by events, a law under a measured motion."""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, TypeAlias, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int, PyTree

from ..._core.arrays import on_device
from ...friction import AbstractDynamicLaw, AbstractForceLaw, AbstractLaw
from ...scene import Scene, Signal, State, from_dynamics, replace_numbers, scene_numbers, start, switch, vector_field
from ...simulation import Trajectory, simulate
from ...solvers import RosenbrockTableau, rosenbrock_step
from ..data._record import Runs
from ._observe import Observables, first_coordinate, needs_forces, observed, observer
from ._parameters import join_entries

# Slip velocity [m/s] below which an element sticks; tolerance of the instant of a mode change, in steps.
_REST, _LANDED = 1e-12, 1e-9
# Largest number of trials of one step; number after which every other trial is a bisection.
_MOST, _NEWTON = 256, 8

_constant = jax.lax.stop_gradient
# Order 3, L-stable, stiffly accurate, three field evaluations (Sandu et al. 1997, Atmospheric Environment 31:3459).
# A held input leaves no smoothness for a higher order, and three evaluations instead of eight make the replay of a long
# record three times cheaper.
RODAS3 = RosenbrockTableau(
    gamma=0.5,
    stage=np.array([[0.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 0.0], [2.0, 0.0, 0.0, 0.0], [2.0, 0.0, 1.0, 0.0]]),
    coupling=np.array([[0.0, 0.0, 0.0, 0.0], [4.0, 0.0, 0.0, 0.0], [1.0, -1.0, 0.0, 0.0], [1.0, -1.0, -8 / 3, 0.0]]),
    nodes=np.array([0.0, 0.0, 1.0, 1.0]),
    time=np.array([0.5, 1.5, 0.0, 0.0]),
    solution=np.array([2.0, 0.0, 1.0, 1.0]),
    error=np.array([0.0, 0.0, 0.0, 1.0]),
)
# `observe(t, y, scene, mode)`, the observed quantities; the scene has its inputs at t, and the mode is None without
# set-valued laws.
Observe: TypeAlias = Callable[[Array, State, Scene, Array | None], PyTree[Array]]
Inputs: TypeAlias = dict[str, Float[Array, " samples"]]
# Largest number of steps of a run by events; each sample of a held input ends a step.
_STEPS_A_RUN, _STEPS_A_SAMPLE = 16384, 4
# Largest number of mode changes in a run by events; its absolute tolerance, relative to the relative one.
_MAX_EVENTS, _ATOL_SHARE = 1024, 1e-3
# Prefix of the names of delays of inputs.
DELAY = "delay."
_Model = TypeVar("_Model", bound=eqx.Module)


class _PartialStep(NamedTuple):
    """A partial step: the state at `t`, the rest of the step `left` [s], and the next trial.

    - `lower`, `upper`, `trial`: lengths [s]; the next change of mode is between the first two if `upper < left`.
    - `trials`: number of trials in this step so far.
    """

    t: Float[Array, ""]
    left: Float[Array, ""]
    y: State
    mode: Float[Array, " modes"]
    lower: Float[Array, ""]
    upper: Float[Array, ""]
    trial: Float[Array, ""]
    trials: Int[Array, ""]


# Compiled by themselves, since a step evaluates them several times: traced and linearised once.
@jax.jit
def _guards(t: Array, y: State, scene: Scene, mode: Array) -> Float[Array, " modes"]:
    """One for each element, positive while its mode holds."""
    rest = jnp.asarray(_REST, y.q.dtype)
    return from_dynamics(lambda d: d.guards(rest, (rest, rest)), t, y, scene, mode)[0]


_field = jax.jit(vector_field)
# Events of a record that is replayed do not accumulate, and its scene has no contacts.
_switch = jax.jit(lambda *instant: switch(*instant, dense=jnp.zeros((), bool), holds=False, rate=None)[:2])


def first_modes(t: Array, y: State, scene: Scene) -> tuple[State, Float[Array, " modes"]]:
    """State and modes at the beginning of a run."""
    mode = jnp.zeros(scene.num_modes(y.q.shape[0]), y.q.dtype)
    return start(t, y, scene, mode, jnp.asarray(_REST, y.q.dtype))


def settle(t: Array, y: State, scene: Scene, mode: Array) -> tuple[State, Float[Array, " modes"]]:
    """State and modes at a sample, where inputs may jump."""
    return _switch(t, y, scene, mode, _guards(t, y, scene, mode) < 0, jnp.asarray(_REST, y.q.dtype))


def pass_modes(
    scene_at: Callable[[Array], Scene],
    t: Float[Array, ""],
    dt: Float[Array, ""],
    y: State,
    mode: Float[Array, " modes"],
) -> tuple[State, Float[Array, " modes"]]:
    """Advance a state by `dt`, through all changes of mode; NaN after too many.

    A trial step that violates a guard is shortened by Newton's method on the guard, within a bracket, until it ends on
    the change. The derivative of the instant is that of the guard over its rate, so forward derivatives have the right
    jump.

    **Arguments:**

    - `scene_at`: the scene with its inputs at a time.
    - `t`, `dt`: start and length of the step [s].
    - `y`, `mode`: consistent at `t`.
    """
    landed, rest = _LANDED * dt, jnp.asarray(_REST, y.q.dtype)

    def go_on(at: _PartialStep) -> Bool[Array, ""]:
        return (at.left > 0) & (at.trials < _MOST)

    def attempt(at: _PartialStep) -> _PartialStep:
        def field(t: Array, y: State) -> State:
            return _field(t, y, scene_at(t), at.mode)

        whole = at.trial >= at.left
        length = jnp.where(whole, at.left, at.trial)
        y1 = rosenbrock_step(RODAS3, field, at.t, length, at.y, pivot=True).y1
        t1 = at.t + length
        slope = field(t1, y1)
        guards, falls = jax.jvp(lambda t, y: _guards(t, y, scene_at(t), at.mode), (t1, y1), (jnp.ones_like(t1), slope))
        falls = _constant(falls)
        away = -_constant(guards) / jnp.where(falls < 0, falls, -1.0)
        fired = (falls < 0) & (jnp.abs(away) <= landed)
        missed = (guards < 0) & ~fired
        over = jnp.any(missed)
        lands = ~over & jnp.any(fired)
        passes = lands | (~over & whole)

        # The instant of the first guard that fires: the value of the trial with the derivative of the guard.
        first = fired & (away == jnp.min(jnp.where(fired, away, jnp.inf)))
        late = jnp.sum(jnp.where(first, (_constant(guards) - guards) / jnp.where(first, falls, 1.0), 0.0))
        late = jnp.where(lands, late / jnp.maximum(jnp.sum(first), 1), 0.0)
        before = jtu.tree_map(lambda y, f: y + late * f, y1, slope)
        instant, left = t1 + late, at.left - length - late
        after, mode = _switch(instant, before, scene_at(instant), at.mode, fired & lands, rest)
        after = jtu.tree_map(lambda a, b: jnp.where(lands, a, b), after, before)

        lower, upper = jnp.where(over, at.lower, length), jnp.where(over, length, at.upper)
        ahead = jnp.where(falls < 0, length + away, jnp.inf)
        newton = jnp.min(jnp.where(missed | ~over, ahead, jnp.inf))
        inside = (newton > lower) & (newton < upper) & ((at.trials < _NEWTON) | (at.trials % 2 == 0))
        trial = jnp.where(inside, newton, 0.5 * (lower + upper))
        retry = at._replace(lower=lower, upper=upper, trial=trial)
        onward = _PartialStep(
            instant, left, after, jnp.where(lands, mode, at.mode), jnp.zeros_like(dt), left, left, at.trials
        )
        moved = jtu.tree_map(lambda a, b: jnp.where(passes, a, b), onward, retry)
        lengths = {name: _constant(getattr(moved, name)) for name in ("lower", "upper", "trial")}
        return moved._replace(**lengths, trials=at.trials + 1)

    begin = _PartialStep(t, dt, y, mode, jnp.zeros_like(dt), dt, dt, jnp.zeros((), int))
    end = jax.lax.while_loop(go_on, attempt, begin)
    stuck = end.left > 0
    return jtu.tree_map(lambda x: jnp.where(stuck, jnp.nan, x), end.y), end.mode


class Controller(eqx.Module):
    """A controller that runs once per sample, as in a drive; its output is held until the next sample.

    **Arguments:**

    - `fn`: `fn(t, q, qd, memory, params) -> (outputs, memory)`: the entries of `params` that it sets, by name, and its
      own state (an integral, a filter) for the next sample. `params` holds the scene's numbers, so that gains can be
      fitted, and the inputs of the record, such as the reference.
    - `memory`: its state at the first sample, a pytree of numbers.
    """

    fn: Callable[..., tuple[dict[str, Array], PyTree]] = eqx.field(static=True)
    memory: PyTree[Array] = eqx.field(default=(), converter=lambda tree: jtu.tree_map(jnp.asarray, tree))


def run_samples(
    scene: Scene,
    t: Float[Array, " samples"],
    inputs: Inputs,
    y0: State,
    observe: Observe,
    *,
    substeps: int = 1,
    linear: frozenset[str] = frozenset(),
    controller: Controller | None = None,
) -> tuple[PyTree[Array], State]:
    """Run a scene over the samples of a record.

    Linearly implicit steps of fixed length: stable whatever the stiffness of the friction law, and cheap to
    differentiate forwards.

    **Arguments:**

    - `scene`: its `params` must be a dict that has the inputs' names.
    - `t`: times of the samples [s].
    - `inputs`: samples by name of the entry of `params` they drive.
    - `y0`: state at the first sample.
    - `observe`: the observed quantities at each sample.
    - `substeps`: steps from sample to sample.
    - `linear`: inputs that are interpolated linearly; the others are held.
    - `controller`: closes a loop around the scene.

    **Returns:**

    The observed quantities with a leading axis of samples, and the state at the last one.
    """
    exact = bool(scene.mode_names)

    def look(t: Array, at: tuple[State, Any], memory: PyTree, held: Inputs) -> tuple[Scene, Any, PyTree, PyTree]:
        """The scene with its inputs at a sample, state and modes, memory, and the observed quantities."""
        (y, mode), here = at, driven(scene, held)
        if controller is not None:
            outputs, memory = controller.fn(t, y.q, y.qd, memory, here.params)
            here = driven(here, outputs)
        if exact:
            y, mode = settle(t, y, here, mode)
        return here, (y, mode), memory, observe(t, y, here, mode)

    def advance(carry: tuple[Any, PyTree], sample: tuple[Array, Array, PyTree, PyTree]) -> tuple[Any, PyTree]:
        start, dt, held, slopes = sample
        here, (y, mode), memory, seen = look(start, *carry, held)

        def scene_at(t: Array) -> Scene:
            return driven(here, {k: held[k] + (t - start) * x for k, x in slopes.items()})

        def field(t: Array, y: State) -> State:
            return vector_field(t, y, scene_at(t))

        step = dt / substeps

        def substep(k: int | Array, at: tuple[State, Array | None]) -> tuple[State, Array | None]:
            y, mode = at
            if mode is not None:
                return pass_modes(scene_at, start + k * step, step, y, mode)
            return rosenbrock_step(RODAS3, field, start + k * step, step, y, pivot=True).y1, None

        moved = substep(0, (y, mode)) if substeps == 1 else jax.lax.fori_loop(0, substeps, substep, (y, mode))
        # Shorter records in a batch repeat their last time.
        moved = jtu.tree_map(lambda new, old: jnp.where(dt > 0, new, old), moved, (y, mode))
        return (moved, memory), seen

    dt = jnp.diff(t)
    slopes = {name: jnp.diff(inputs[name]) / jnp.where(dt > 0, dt, 1.0) for name in sorted(linear)}
    memory = () if controller is None else controller.memory
    samples = (t[:-1], dt, jtu.tree_map(lambda x: x[:-1], inputs), slopes)
    begin = first_modes(t[0], y0, driven(scene, jtu.tree_map(lambda x: x[0], inputs))) if exact else (y0, None)
    (at, memory), seen = jax.lax.scan(advance, (begin, memory), samples)
    _, (end, _), _, final = look(t[-1], at, memory, jtu.tree_map(lambda x: x[-1], inputs))
    return jtu.tree_map(lambda x, y: jnp.concatenate([x, jnp.asarray(y)[None]]), seen, final), end


def replay(
    scene: Scene,
    t: Float[Array, " samples"],
    inputs: Inputs,
    q0: Float[Array, " dof"],
    qd0: Float[Array, " dof"],
    substeps: int = 1,
    observe: Callable[[Array, Array], Array] = first_coordinate,
) -> Float[Array, "samples ..."]:
    """Run a scene over the samples of a record, with the inputs held from each sample to the next.

    **Arguments:**

    - `scene`, `t`, `inputs`, `substeps`: see `run_samples`.
    - `q0`, `qd0`: state at the first sample.
    - `observe`: `observe(q, qd)`, the observed number or array; by default the first coordinate.

    **Returns:**

    The observed number at each sample, shape `[samples]`, or `[samples, ...]` of arrays.
    """
    y0 = State(q0, qd0, scene.initial_state(q0))

    def look(t: Array, y: State, scene: Scene, mode: Array | None) -> Array:
        del t, scene, mode
        return observe(y.q, y.qd)

    return run_samples(scene, t, inputs, y0, look, substeps=substeps)[0]


def driven(scene: Scene, held: Mapping[str, Array | Signal]) -> Scene:
    """The scene with inputs in its params."""
    return eqx.tree_at(lambda x: x.params, scene, {**scene.params, **held}) if held else scene


def mass_of(scene: Scene, t: Array, q: Float[Array, " one"], qd: Float[Array, " one"]) -> Float[Array, ""]:
    """Mass of a scene of one coordinate, from its Lagrangian."""
    return jax.hessian(lambda qd: scene.lagrangian(t, q, qd, scene.params))(qd)[0, 0]


class ModelOutput(NamedTuple):
    """Output of a model for one run: channels, slip instants, and the state at the last sample."""

    channels: dict[str, Float[Array, " samples"]]
    slips: dict[str, Float[Array, " instants"]]
    end: State | None


class ReplayEngine(eqx.Module):
    """A scene by fixed steps from sample to sample, through stick and slip along a line."""

    model: Scene
    delays: dict[str, Array]
    controller: Controller | None
    observables: Observables = eqx.field(static=True)
    linear: frozenset[str] = eqx.field(static=True)
    substeps: int = eqx.field(static=True)

    def __call__(self, values: dict[str, Array], start: State, run: Runs) -> ModelOutput:
        """Run the scene with these values over the samples."""
        late, t, inputs, parts = self.delays | values, run.t, run.inputs, 1
        if self.controller is None and any(DELAY + name in late for name in inputs):
            # A delayed input changes between samples: each step has its own value.
            parts = self.substeps
            t, inputs = split_samples(t, inputs, self.linear, parts)
        seen, end = run_samples(
            with_values(self.model, values),
            t,
            delayed(t, inputs, self.linear, late),
            start,
            observer(self.observables),
            substeps=self.substeps // parts,
            linear=self.linear,
            controller=self.controller,
        )
        return ModelOutput(jtu.tree_map(lambda x: x[::parts], seen), {}, end)


class EventEngine(eqx.Module):
    """A scene by error-controlled steps with events, for contacts and slip instants; NaN if the run ends early."""

    model: Scene
    delays: dict[str, Array]
    observables: Observables = eqx.field(static=True)
    linear: frozenset[str] = eqx.field(static=True)
    slips: tuple[str, ...] = eqx.field(static=True)
    rtol: float = eqx.field(static=True)

    def __call__(self, values: dict[str, Array], start: State, run: Runs) -> ModelOutput:
        """Run the scene with these values over the samples."""
        scene = with_values(self.model, values)
        inputs = delayed(run.t, run.inputs, self.linear, self.delays | values)
        scene = driven(scene, {name: Signal(run.t, x, linear=name in self.linear) for name, x in inputs.items()})
        done = simulate(
            scene,
            start.q,
            start.qd,
            run.t[-1],
            t0=run.t[0],
            ts=run.t,
            z0=start.z,
            rtol=self.rtol,
            atol=_ATOL_SHARE * self.rtol,
            max_steps=_STEPS_A_RUN + _STEPS_A_SAMPLE * run.t.shape[0],
            max_events=_MAX_EVENTS,
            throw=False,
        )
        fine = done.code == 0
        forces = done.forces if any(needs_forces(x) for _, x in self.observables) else {}
        channels = {
            name: jnp.where(
                fine, jax.vmap(lambda q, qd, f, x=x: observed(x, q, qd, f))(done.q, done.qd, forces), jnp.nan
            )
            for name, x in self.observables
        }
        end = State(done.q[-1], done.qd[-1], jax.tree.map(lambda x: x[-1], done.z))
        return ModelOutput(channels, self._slips(scene, done, run), end)

    def _slips(self, scene: Scene, done: Trajectory, run: Runs) -> dict[str, Array]:
        """The first instants at which elements break away; the end of the run for missing ones."""
        if not self.slips:
            return {}
        events, instants = done.events, {}
        for effect in self.slips:
            broke = (events.effect == scene.names.index(effect)) & (events.before == 0)
            times = jnp.sort(jnp.where(broke, events.t, jnp.inf))[: run.slips[effect].shape[0]]
            short = run.slips[effect].shape[0] - times.shape[0]
            times = jnp.pad(times, (0, max(short, 0)), constant_values=jnp.inf)
            instants[effect] = jnp.where(jnp.isfinite(times), times, run.t[-1])
        return instants


def with_values(model: _Model, values: Mapping[str, ArrayLike]) -> _Model:
    """The scene or law with numbers of these names replaced; delays are ignored."""
    own = {
        name: x if isinstance(x, jax.Array) else on_device(x)
        for name, x in values.items()
        if not name.startswith(DELAY)
    }
    return replace_numbers(model, join_entries(scene_numbers(model), own))


def split_samples(
    t: Float[Array, " samples"], inputs: Inputs, linear: frozenset[str], parts: int
) -> tuple[Float[Array, " times"], dict[str, Float[Array, " times"]]]:
    """Times and inputs with each interval of the samples in `parts` equal parts."""
    shares = jnp.arange(parts, dtype=t.dtype) / parts

    def split(x: Array, rise: Array) -> Array:
        return jnp.concatenate([jnp.reshape(x[:-1, None] + rise[:, None] * shares[None, :], (-1,)), x[-1:]])

    return split(t, jnp.diff(t)), {k: split(x, jnp.diff(x) * (k in linear)) for k, x in inputs.items()}


def delayed(
    t: Float[Array, " samples"],
    inputs: dict[str, Float[Array, " samples"]],
    linear: frozenset[str],
    values: dict[str, Array],
) -> dict[str, Float[Array, " samples"]]:
    """Inputs delayed by the `delay.*` [s] among the values, which may be a fraction of a sample.

    A held input that jumps between two samples is replaced by its mean over the interval. So the impulse is exact, and
    the derivative by the delay exists. The motion is exact to second order in the interval.
    """
    shifted = dict(inputs)
    for name, x in inputs.items():
        if DELAY + name not in values:
            continue
        tau = values[DELAY + name]
        if name in linear:
            shifted[name] = jnp.interp(t - tau, t, x)
            continue
        dt = jnp.diff(t)
        impulse = jnp.concatenate([jnp.zeros(1, x.dtype), jnp.cumsum(dt * x[:-1])])
        # The first and the last sample continue outside the record.
        late = t - tau
        at = (
            jnp.interp(late, t, impulse) + x[0] * jnp.minimum(late - t[0], 0.0) + x[-1] * jnp.maximum(late - t[-1], 0.0)
        )
        mean = jnp.diff(at) / jnp.where(dt > 0, dt, 1.0)
        shifted[name] = jnp.concatenate([jnp.where(dt > 0, mean, x[:-1]), x[-1:]])
    return shifted


class LawEngine(eqx.Module):
    """A law under the measured motion."""

    model: AbstractLaw

    def __call__(self, values: dict[str, Array], start: None, run: Runs) -> ModelOutput:
        """The force of the law with these values."""
        del start
        force = law_force(with_values(self.model, values), run.t, run.inputs["x"], run.inputs.get("normal"), run.inputs)
        return ModelOutput(dict.fromkeys(run.measured, force), {}, None)


def law_force(
    law: AbstractLaw,
    t: Float[Array, " samples"],
    x: Float[Array, " samples"],
    normal: Float[Array, " samples"] | None = None,
    inputs: dict[str, Float[Array, " samples"]] | None = None,
) -> Float[Array, " samples"]:
    """Friction force of a law under a sampled motion, from rest and unloaded.

    **Arguments:**

    - `law`: a dynamic law, or one that is a function of velocity.
    - `t`: times [s], increasing.
    - `x`: slip displacement [m] at these times; the velocity is constant from sample to sample.
    - `normal`: normal load [N] for laws whose forces are per newton of load.
    - `inputs`: entries of `params` for the functions of `scaled_by`, by name.

    **Returns:**

    The force [N] at each sample, with the velocity of the interval that ends there (0 at the first).

    **Raises:**

    - `ValueError` for a law whose force depends on more than its own motion.
    """
    if not isinstance(law, AbstractDynamicLaw | AbstractForceLaw):
        raise ValueError(f"{type(law).__name__} cannot run by itself: its force depends on the load.")
    dt = jnp.diff(t)
    v = jnp.diff(x) / jnp.where(dt > 0, dt, 1.0)  # shorter records in a batch repeat their last time

    def at(t: Array, x: Array, v: Array, params: PyTree) -> Any:
        return law.bind_state(t, x[None], v[None], params)

    def advance(z: PyTree, sample: tuple[PyTree, ...]) -> tuple[PyTree, Array]:
        t, x, v, params, dt = sample
        here = at(t, x, v, params)
        if isinstance(here, AbstractForceLaw):
            return z, here.force(v)
        z = here.step_exact(v, z, dt)
        return z, here.force(v, z)

    rest = jnp.zeros_like(x[0])
    z0 = law.initial_state(rest) if isinstance(law, AbstractDynamicLaw) else None
    first = at(t[0], x[0], rest, jax.tree.map(lambda each: each[0], inputs or {}))
    start = first.force(rest) if z0 is None else first.force(rest, z0)
    samples = (t[1:], x[1:], v, jax.tree.map(lambda each: each[1:], inputs or {}), dt)
    _, force = jax.lax.scan(advance, z0, samples)
    force = jnp.concatenate([jnp.reshape(start, (1,)), force])
    return force if normal is None else force * jnp.maximum(normal, 0.0)
