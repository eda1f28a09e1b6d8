"""Start values without a guess: from dimensions, from the balance of forces in slip, from reversals."""

from collections.abc import Mapping
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from ...friction import AbstractDynamicLaw, AbstractForceLaw, AbstractLaw, AbstractSetValuedLaw
from ...scene import Friction, Scene, State, scene_ranges, vector_field
from ..data._signals import differentiate, smooth, smooth_span
from ..model._engines import driven, mass_of, with_values
from ..model._observe import coordinates_seen
from ._initializers import AbstractInitializer, Initialized
from ._problem import Box, FitProblem, SquaredLoss
from ._search import SearchOptions, SearchState, levenberg_marquardt_step, start_search

# Slip faster than this share of the top speed counts as steady: the states of friction laws have settled.
_STEADY = 0.02
_STEPS = 60
# A value that differs from the size of its unit by more than this factor is not plausible.
_FAR = 1e3
# Damping of the bristle at the start, as a share of what is critical for the mass in stick.
_DAMPING = 0.3
# Time [s] in which a bristle settles at any slip speed.
_LONG = 1e6
# A parameter shows in the balance of forces if its column is at least this share of the longest.
_SHOWS = 1e-6


class _Sampled(NamedTuple):
    """Time, position, velocity, acceleration, inputs, and the measured friction force or None.

    Shape `[samples]` each; inside `jax.vmap` at one of them.
    """

    t: Array
    q: Array
    v: Array
    a: Array
    inputs: dict[str, Array]
    force: Array | None


class Staged(AbstractInitializer):
    """Start values from the record itself, independent of the numbers of the scene, in stages.

    1. Parameters of friction laws get a size by their unit, from the greatest force, speed and travel.
    2. The balance of forces along the smoothed motion, with the friction of steady slip, gives all numbers that show in
       it (mass, offset, Fc, Fs, vs, sigma2) without a simulation.
    3. The slope of the force over the displacement after reversals gives stiffness (sigma0); the damping of a bristle
       starts at a share of the critical one.

    The fit then determines all parameters together. For one coordinate with measured position, and for laws under a
    measured motion.

    **Raises:**

    - `ValueError` (at the fit) for several coordinates, or without a measured position.
    """

    def initialize(self, problem: FitProblem, x: Float[Array, " n"], options: SearchOptions) -> Initialized:
        """Coordinates of the start values."""
        sampled = _sampled(problem)
        ranges = scene_ranges(problem.engine.model)
        units = {name: ranges[name].unit if name in ranges else "" for name in problem.free.names}
        values = {name: float(value) for name, value in problem.free.values(x[: len(units)]).items()}
        sizes = _sizes(problem, sampled, values)
        values |= {name: sizes[unit] for name, unit in units.items() if unit in sizes}
        balance, known = _fit_balance(problem, sampled, problem.free.coordinates(values), options)
        for name, value in balance.items():
            if known[name]:
                size = sizes.get(units[name])
                # The balance of forces may give an implausible value.
                fine = size is None or value == 0 or size / _FAR < abs(value) < _FAR * size
                values[name] = value if fine else float(np.copysign(size or 0.0, value))
        blind = [name for name in units if not known[name]]
        stiffness = _reversal_slope(problem, sampled, values) or sizes["N/m"]
        mass = _mass(problem, values)
        for name in blind:
            if units[name] == "N/m":
                values[name] = stiffness
            elif units[name] == "N s/m" and mass is not None:
                values[name] = _DAMPING * 2 * float(np.sqrt(mass * stiffness))
        return jnp.concatenate([problem.free.coordinates(values), x[len(units) :]]), ()


def _sampled(problem: FitProblem) -> _Sampled:
    """All runs, concatenated, without their ends, which smoothing distorts."""
    parts, position, law_alone = [], "", problem.base is None
    if problem.base is not None:
        if problem.base.q.shape[1] != 1:
            raise ValueError("Staged() needs a scene with one coordinate; pass start values, or MultiStart(...).")
        seen = coordinates_seen(problem.engine.observables, 1)
        position = next((name for name, entry in seen.items() if entry == "q[0]"), "")
        if not position:
            raise ValueError(
                "Staged() needs a channel that is the position, observe='q[0]'; pass start values, or MultiStart(...)."
            )
    for run in range(problem.count):
        samples = jax.tree.map(lambda x, run=run: np.asarray(x[run]), problem.runs)
        weight = next(iter(samples.weight.values()))
        count = int(np.flatnonzero(weight)[-1]) + 1
        t = samples.t[:count]
        inputs = {name: column[:count] for name, column in samples.inputs.items()}
        x = inputs["x"] if law_alone else samples.measured[position][:count]
        motion, span = differentiate(t, x), smooth_span(count)
        force = None
        if law_alone:
            force = smooth(next(iter(samples.measured.values()))[:count], span)
            if "normal" in inputs:
                force = force / np.maximum(inputs["normal"], 1e-12)
        smoothed = {name: smooth(column, span)[motion.inside] for name, column in inputs.items()}
        columns = (x[motion.inside] for x in (t, motion.x, motion.v, motion.a))
        parts.append((*columns, smoothed, None if force is None else force[motion.inside]))
    return _Sampled(*jax.tree.map(lambda *x: jnp.asarray(np.concatenate(x)), *parts))


def _sizes(problem: FitProblem, sampled: _Sampled, values: dict[str, float]) -> dict[str, float]:
    """Sizes that go with a unit."""
    speed = float(jnp.max(jnp.abs(sampled.v))) or 1.0
    travel = float(jnp.max(sampled.q) - jnp.min(sampled.q)) or 1.0
    force = float(jnp.sqrt(jnp.mean(_required(problem, sampled, values) ** 2))) or 1.0
    return {"N": force, "m/s": 0.05 * speed, "N s/m": 0.1 * force / speed, "N/m": 1e2 * force / travel}


def _required(problem: FitProblem, sampled: _Sampled, values: Mapping[str, ArrayLike]) -> Float[Array, " samples"]:
    """Generalised friction force: measured, or by the equations of motion without friction."""
    if sampled.force is not None:
        return sampled.force
    scene = with_values(problem.engine.model, values)
    others = tuple(effect for effect in scene.effects if not isinstance(effect, Friction))

    def required(s: _Sampled) -> Array:
        here = driven(scene, s.inputs)
        bare = Scene(here.lagrangian, params=here.params, effects=others)
        q, qd = s.q[None], s.v[None]
        free = vector_field(s.t, State(q, qd, bare.initial_state(q)), bare).qd[0]
        return mass_of(here, s.t, q, qd) * (free - s.a)

    return jax.jit(jax.vmap(required))(sampled)  # each operation alone would compile, too


def _settled(law: AbstractLaw, v: Array) -> Array:
    """Force of a law in steady slip."""
    if isinstance(law, AbstractDynamicLaw):
        z = law.step_exact(v, law.initial_state(v), jnp.asarray(_LONG, v.dtype))
        return law.force(v, z)
    if isinstance(law, AbstractSetValuedLaw):
        return jnp.sign(v) * law.sliding_force(v) + law.viscous_force(v)
    if isinstance(law, AbstractForceLaw):
        return law.force(v)
    raise ValueError(f"Staged() does not know the force of {type(law).__name__} in steady slip; pass start values.")


def _friction(problem: FitProblem, sampled: _Sampled, values: Mapping[str, ArrayLike]) -> Float[Array, " samples"]:
    """Generalised friction force in steady slip."""
    scene = with_values(problem.engine.model, values)
    if isinstance(scene, AbstractLaw):
        return jax.vmap(lambda s: _settled(scene.bind_state(s.t, s.q[None], s.v[None], s.inputs), s.v))(sampled)
    elements = list(scene.friction.values())

    def friction(s: _Sampled) -> Array:
        here = driven(scene, s.inputs)
        q, qd, total = s.q[None], s.v[None], jnp.zeros_like(s.v)
        for effect in elements:
            settled = effect.bind_state(s.t, q, qd, here.params)
            force = _settled(settled.law, settled.slip(s.t, q, qd, here.params))
            load = settled.load(s.t, q, qd, here.params)
            total = total - settled.apply_force(q, force if load is None else load * force, here.params)[0]
        return total

    return jax.vmap(friction)(sampled)


def _slip(problem: FitProblem, sampled: _Sampled) -> Float[Array, " samples"]:
    """The smallest slip speed of the friction elements: all must slip in the balance of forces."""
    scene = problem.engine.model
    if isinstance(scene, AbstractLaw) or not scene.friction:
        return jnp.abs(sampled.v)
    elements = list(scene.friction.values())

    def slip(s: _Sampled) -> Array:
        here = driven(scene, s.inputs)
        return jnp.min(jnp.stack([jnp.abs(x.slip(s.t, s.q[None], s.v[None], here.params)) for x in elements]))

    return jax.vmap(slip)(sampled)


def _fit_balance(
    problem: FitProblem, sampled: _Sampled, x: Float[Array, " free"], options: SearchOptions
) -> tuple[dict[str, float], dict[str, bool]]:
    """Parameters by the balance of forces in steady slip, and whether they show in it."""
    state = start_search(x, sampled.v.shape[0])
    for _ in range(_STEPS):
        state = _balance_step(problem, sampled, state, jnp.asarray(options.rtol, x.dtype))
        if int(state.done):
            break
    size = jnp.sqrt(jnp.sum(state.jacobian**2, axis=0))
    shows = np.asarray(size > _SHOWS * jnp.max(size))
    values, names = problem.free.values(state.x), problem.free.names
    return {name: float(values[name]) for name in names}, dict(zip(names, shows.tolist(), strict=True))


@eqx.filter_jit
def _balance_step(problem: FitProblem, sampled: _Sampled, state: SearchState, rtol: Array) -> SearchState:
    slip = _slip(problem, sampled)
    steady = (slip > _STEADY * jnp.max(slip)).astype(slip.dtype)

    def residual(x: Array) -> Array:
        values = problem.free.values(x)
        return steady * (_friction(problem, sampled, values) - _required(problem, sampled, values))

    lower, upper = problem.free.bounds
    box = Box(lower, upper, problem.free.longest)
    return levenberg_marquardt_step(lambda x: (residual(x), jax.jacfwd(residual)(x)), SquaredLoss(), box, state, rtol)


def _reversal_slope(problem: FitProblem, sampled: _Sampled, values: dict[str, float]) -> float | None:
    """Median slope [N/m] of the friction force over the displacement after reversals, until its sign has changed."""
    x, v, force = (np.asarray(each) for each in (sampled.q, sampled.v, _required(problem, sampled, values)))
    level = np.median(np.abs(force))
    turns = np.flatnonzero(np.sign(v[1:]) * np.sign(v[:-1]) < 0) + 1
    slopes = []
    for start, end in zip(turns, [*turns[1:], len(x)], strict=True):
        moved, risen = np.abs(x[start:end] - x[start]), np.abs(force[start:end] - force[start])
        over = np.flatnonzero(risen > level)
        if over.size and over[0] > 0 and moved[over[0]] > 0:
            slopes.append(risen[over[0]] / moved[over[0]])
    return float(np.median(slopes)) if slopes else None


def _mass(problem: FitProblem, values: dict[str, float]) -> float | None:
    """Mass at the first state; None for a law by itself."""
    if problem.base is None:
        return None
    inputs, q = {name: column[0, 0] for name, column in problem.runs.inputs.items()}, problem.base.q[0]
    scene = driven(with_values(problem.engine.model, values), inputs)
    return float(mass_of(scene, problem.runs.t[0, 0], q, jnp.zeros_like(q)))
