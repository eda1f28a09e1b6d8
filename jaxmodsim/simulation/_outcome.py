"""Outcome of a run: a code inside compiled code, a sentence outside."""

from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from .._core.arrays import is_known
from .._core.cholesky import cholesky_pivots
from .._core.functions import depends_on
from .._core.parameters import check_ranges, modules_of, range_checks
from .._core.scalarise import in_scalars
from ..friction import AbstractLaw, Regularized
from ..mechanics import Contact, constraint_residual, motion_equations, quadratic
from ..scene import Scene, State, check_scene, describe_series, from_dynamics, quantity_of
from ..solvers import ACCUMULATION, TOO_MANY

# Codes of the outcomes of a run; `outcome_messages` has the sentence of each.
(
    SUCCESS,
    MAX_STEPS,
    STEP_TOO_SMALL,
    NOT_FINITE,
    MAX_EVENTS,
    MISSED_EVENT,
    INCONSISTENT,
    DRIFTED,
    NOT_QUADRATIC,
    TOO_NARROW,
    ILL_POSED,
    PENETRATES,
    FIRST_MASS,
) = range(13)

# Largest admissible correction of the initial state onto the constraints, relative to its size or to one.
_CONSISTENT = 1e-6
# Largest admissible correction of the last state.
_KEPT = 1e-2

_GENERAL = (
    "The run reached t1.",
    "The step limit was reached before t1: pass a larger max_steps, a larger dt or looser tolerances.",
    "The step size fell below what the time can resolve: the vector field jumps or is singular there. Pass atol > 0"
    " where something comes to rest. In float32 also try a larger rtol.",
    "The vector field gave a value that is not finite (NaN or infinity). A fixed step that is too long for the"
    " stiffness ends the same way: pass a smaller dt, or solver=jaxmodsim.Rodas5P().",
    "The limit of mode changes was reached before t1: pass a larger max_events.",
    "At a saved time an element sticks under a load beyond its limit: a short pulse was stepped over, as nothing moves"
    " in stick and the steps grow. Pass dtmax, the longest step that cannot miss it, or a fixed step dt.",
    "The initial state does not obey the constraints: pass q0, qd0 = jaxmodsim.project_initial_state(scene, q0, qd0),"
    " the nearest state that does.",
    "The constraints are not kept: they contradict each other here, have become dependent (a singular configuration),"
    " or drift without bound (project=False).",
    "Gauss works with momenta, and needs a Lagrangian that is quadratic in the velocities: use another solver.",
    "atol is above the width [m/s] of a Regularized law: the error control does not resolve motion within it, and"
    " a break-away comes late. Pass atol no larger than the width.",
    "The times or tolerances do not make a run: t1 must not be before t0, ts must increase within [t0, t1], dt and"
    " dtmax must be positive, rtol and atol not negative and not both zero, and all of them finite.",
    "A contact is violated: its gap is negative. A run must start with gaps that are zero or positive; a later negative"
    " gap is a missed impact: pass smaller tolerances or dtmax, or compute in float64.",
)

# Additions to the sentences of early ends for scenes whose forces may chatter, and for those with contacts.
_CHATTER = {
    MAX_STEPS: " A law that chatters (Sign, or jnp.sign of a velocity in a force of your own) never gets through its"
    " zero crossings with adaptive steps: Friction(Coulomb(Fc)) sticks exactly.",
    STEP_TOO_SMALL: " Run DeadZone and Sign with a fixed step (dt=...).",
}
_SOFTER = "lower its restitution, or make it compliant: restitution=jaxmodsim.HuntCrossley(stiffness)."


class _Offsets(NamedTuple):
    """The first code of each group of sentences that depends on the scene."""

    ranges: int
    chatter: int
    checks: int
    loads: int


def _offsets(scene: Scene, dof: int) -> _Offsets:
    ranges = FIRST_MASS + dof
    chatter = ranges + len(range_checks(scene))
    checks = chatter + sum(scene.mode_widths(dof))
    return _Offsets(ranges, chatter, checks, checks + len(scene.checks))


class Ending(NamedTuple):
    """The last event: whether it ended the run, and which guards fired in it."""

    status: Float[Array, ""]
    fired: Float[Array, " guards"]


class SimulationError(RuntimeError):
    """A run that ended early; the message has the cause, the time and the remedy.

    **Example:**

    ```python
    scene = jms.problems.braked_spring.scene()
    try:
        jms.simulate(scene, [1.0], [0.0], 100.0, max_steps=10)
    except jms.SimulationError as error:
        print(str(error).split(". ")[0])
    ```

    ```text
    The step limit was reached before t1: pass a larger max_steps, a larger dt or looser tolerances
    ```
    """


class RunResult(eqx.Module):
    """Outcome of a run.

    - `code`: 0 for a run that reached t1; an index into `messages` otherwise. Under `jax.vmap` one per run.
    - `messages`: the sentence for each code.
    """

    code: Int[Array, "..."]
    messages: tuple[str, ...] = eqx.field(static=True)

    @property
    def ok(self) -> Array:
        """Whether the run reached t1, elementwise."""
        return self.code == SUCCESS

    @property
    def message(self) -> str:
        """The sentence; for a batch of runs, one line for each outcome that occurs, with its count."""
        codes, counts = np.unique(np.asarray(self.code), return_counts=True)
        if np.ndim(self.code) == 0:
            return self.messages[int(codes[0])]
        return "\n".join(f"{n} x {self.messages[int(code)]}" for code, n in zip(codes, counts, strict=True))

    def __str__(self) -> str:
        """The sentence."""
        return "Traced: known outside of jax.jit." if not is_known(self.code) else self.message

    __repr__ = __str__


def outcome_messages(scene: Scene, dof: int) -> tuple[str, ...]:
    """The sentence for each outcome that a run of this scene can have.

    **Returns:**

    The sentences; the code of a run is an index into them.
    """
    mass = tuple(
        f"The mass matrix is singular or indefinite at coordinate {describe_series(scene, f'q[{i}]')}: its inertia is"
        " not positive" + (" once the motion of the coordinates before it is taken out." if i else ".")
        for i in range(dof)
    )
    ranges = tuple(text for text, _ in range_checks(scene))
    general: list[str] = list(_GENERAL)
    jumps = any(isinstance(module, AbstractLaw) and module.jumps for _, module in modules_of(scene))
    for code, asked in ((MAX_STEPS, jumps or not scene.contacts), (STEP_TOO_SMALL, jumps)):
        general[code] += _CHATTER[code] if asked else ""
    if scene.contacts:
        names = ", ".join(map(repr, scene.contacts))
        general[MAX_STEPS] += f" Where impacts of a contact ({names}) follow each other ever faster, {_SOFTER}"
    chatter = tuple(
        f"The crossings of {name!r} accumulate: its forces push back to guard = 0 from both sides (sliding mode). Make"
        " the force a continuous function of the guard near zero."
        if name in scene.switches
        else f"The step size fell below what the time can resolve at contact {name!r}: its impacts and openings follow"
        f" each other too fast. Pass larger tolerances, {_SOFTER}"
        if name in scene.contacts
        else f"The mode changes of {name!r} accumulate: chatter between stick and slip. Pass stick_on_chatter=True to"
        " keep it in stick from there on."
        for name, width in zip(scene.mode_names, scene.mode_widths(dof), strict=True)
        for _ in range(width)
    )
    loads = tuple(
        f"Friction {name!r}: normal_force depends on params alone, so it is a constant load and must be finite and >= 0"
        " [N], but it is negative or not finite. Correct its sign; a load that is below zero for a while depends on t,"
        " q or qd."
        for name in _load_functions(scene)
    )
    return tuple(general) + mass + ranges + chatter + scene.checks + loads


def _load_functions(scene: Scene) -> dict[str, Callable[..., Any]]:
    """Loads of friction elements that are functions, by name of the element."""
    loads = {name: each.normal_force for name, each in scene.friction.items()}
    return {name: load for name, load in loads.items() if callable(load)}


def _has_load(fn: Callable[..., Any], scene: Scene, t: Float[Array, ""], y: State) -> Bool[Array, ""]:
    """Whether a constant load is in range; True for a load that depends on time or state."""
    dof = y.q.shape[0]

    def load(state: Array) -> Array:
        t, q, qd = state[0], state[1 : dof + 1], state[dof + 1 :]
        return jnp.asarray(fn(t, q, qd, scene.bind_time(t).params))

    state = jnp.concatenate([t[None], y.q, y.qd])
    if depends_on(load, state):
        return jnp.asarray(True)
    value = load(state)
    return jnp.isfinite(value) & (value >= 0)


def start_code(
    scene: Scene,
    t: Float[Array, ""],
    y: State,
    rate: State,
    mode: Array | None,
    atol: Float[Array, ""] | None,
    canonical: bool,
) -> Int[Array, ""]:
    """Code of an error before the first step: a parameter out of range, a violated constraint, a field of NaN.

    `atol` is None in a run of fixed steps.
    """
    dof, now = y.q.shape[0], scene.bind_time(t)
    code = jnp.asarray(SUCCESS)
    finite = jnp.stack([jnp.all(jnp.isfinite(x)) for x in (y.q, y.qd, rate.qd)]).all()
    code = jnp.where(finite, code, NOT_FINITE)
    if canonical:
        code = jnp.where(quadratic(now.lagrangian, t, y.q, y.qd, now.params), code, NOT_QUADRATIC)
    offsets = _offsets(scene, dof)
    if scene.checks:
        code = jnp.where(_unique(now, t, y, mode), code, offsets.checks)
    code = _blame_mass(code, _pivots(now, t, y), 16 * dof * float(jnp.finfo(y.q.dtype).eps), True)
    if scene.constraints:
        code = _violation(now, now.constraints_in(mode), t, y, code)
    widths = [module.width for _, module in modules_of(scene) if isinstance(module, Regularized)]
    if atol is not None and widths:
        code = jnp.where(atol <= jnp.min(jnp.stack([jnp.min(width) for width in widths])), code, TOO_NARROW)
    for i, fn in enumerate(_load_functions(scene).values()):
        code = jnp.where(_has_load(fn, scene, t, y), code, offsets.loads + i)
    for i, (_, ok) in reversed(list(enumerate(range_checks(scene)))):
        code = jnp.where(ok, code, offsets.ranges + i)
    return code


@jax.jit
def violation_code(scene: Scene, t: Float[Array, ""], y: State) -> Int[Array, ""]:
    """Code of an initial state that violates constraints or contacts: a small program before that of the run."""
    check_scene(scene, y._replace(z=scene.initial_state(y.q)))
    now = scene.bind_time(t)
    return _violation(now, now.bilateral, t, y, jnp.asarray(SUCCESS))


def _violation(scene: Scene, constraints: Any, t: Array, y: State, code: Array) -> Int[Array, ""]:
    """`code`, or that of an initial state that violates these constraints, or that of a gap below zero."""
    if constraints:
        off, turned = constraint_residual(constraints, t, y.q, y.qd, scene.params)
        code = jnp.where((off <= _CONSISTENT) & (turned <= _CONSISTENT), code, INCONSISTENT)
    return jnp.where(_penetration(scene, t, y) <= _CONSISTENT, code, PENETRATES)


def end_code(
    scene: Scene,
    t: Float[Array, ""],
    y: State,
    rate: State,
    mode: Array | None,
    result: dfx.RESULTS,
    ending: Ending | None,
    ahead: Float[Array, ""],
) -> Int[Array, ""]:
    """Code of the outcome, from diffrax's result, the last state and the last event.

    `ahead` is the time [s] within which the next step may have failed.
    """
    early, now = ~dfx.is_okay(result), scene.bind_time(t)
    code = jnp.where(result == dfx.RESULTS.dt_min_reached, STEP_TOO_SMALL, NOT_FINITE)
    code = jnp.where(result == dfx.RESULTS.max_steps_reached, MAX_STEPS, code)
    code = jnp.where(early, code, SUCCESS)
    offsets = _offsets(scene, y.q.shape[0])
    if ending is not None:
        element = jnp.argmax(ending.fired)
        chatters, full = ending.status == ACCUMULATION, ending.status == TOO_MANY
        code = jnp.where(early & chatters, offsets.chatter + element, jnp.where(early & full, MAX_EVENTS, code))
    if scene.contacts:
        gaps = jnp.abs(_gaps(now, t, y))
        touches = jnp.min(gaps) <= _CONSISTENT * jnp.maximum(1.0, jnp.max(jnp.abs(y.q)))
        of_contact = offsets.checks - gaps.shape[0] + jnp.argmin(gaps)
        code = jnp.where((code == STEP_TOO_SMALL) & touches, of_contact, code)
    finite = jnp.stack([jnp.all(jnp.isfinite(x)) for x in (y.q, y.qd, rate.qd)]).all()
    code = jnp.where(early & ~finite, NOT_FINITE, code)
    if scene.checks:
        # The run ends just before the equations cease to hold: test the state a little later.
        beyond = y._replace(q=y.q + ahead * y.qd, qd=y.qd + ahead * rate.qd)
        looks = jtu.tree_map(lambda *x: jnp.stack(x), (t + ahead, beyond), (t, y))
        unique = jax.lax.map(lambda at: _unique(scene, at[0], at[1], mode), looks)  # traced and compiled once
        code = jnp.where(early & ~jnp.all(unique), offsets.checks, code)
    if scene.constraints:
        kept = constraint_residual(now.constraints_in(mode), t, y.q, y.qd, now.params)[0] <= _KEPT
        code = jnp.where(kept | ~finite, code, DRIFTED)
        code = jnp.where((_penetration(now, t, y) <= _CONSISTENT**0.5) | ~finite, code, PENETRATES)
    eps = float(jnp.finfo(y.q.dtype).eps)
    # A run that stopped before a singular mass matrix cannot be closer to it than its smallest step.
    tolerance = jnp.where(early, eps**0.5, 16 * y.q.shape[0] * eps)
    return _blame_mass(code, _pivots(now, t, y), tolerance, jnp.all(jnp.isfinite(y.q)) & jnp.all(jnp.isfinite(y.qd)))


def _gaps(scene: Scene, t: Array, y: State) -> Float[Array, " contacts"]:
    return jnp.concatenate([contact.error(t, y.q, scene.params) for contact in scene.contacts.values()])


def _penetration(scene: Scene, t: Array, y: State) -> Float[Array, ""]:
    """Largest penetration of a gap, relative to the coordinates or to one."""
    deepest = jnp.min(_gaps(scene, t, y)) if scene.contacts else jnp.zeros_like(t)
    return -deepest / jnp.maximum(1.0, jnp.max(jnp.abs(y.q)))


def _unique(scene: Scene, t: Array, y: State, mode: Array | None) -> Bool[Array, ""]:
    """Whether friction under reactions has a unique solution, in a scene with such friction."""
    margin = from_dynamics(lambda d: d.uniqueness, t, y, scene, mode)
    assert margin is not None
    return margin > 0


def _mass(scene: Scene, t: Float[Array, ""], y: State) -> Float[Array, "dof dof"]:
    return in_scalars(
        lambda t, q, qd: motion_equations(scene.lagrangian, t, q, qd, scene.params).mass, t, y.q, y.qd, seed=y.q
    )


def _pivots(scene: Scene, t: Float[Array, ""], y: State) -> Float[Array, " dof"]:
    return cholesky_pivots(_mass(scene, t, y))


def _blame_mass(
    code: Int[Array, ""], pivots: Float[Array, " dof"], tolerance: Array | float, known: Array | bool
) -> Int[Array, ""]:
    """Replace `code` by that of the first coordinate whose pivot is not above `tolerance`, if `known`."""
    bad = ~(pivots > tolerance)
    return jnp.where(jnp.any(bad) & known, FIRST_MASS + jnp.argmax(bad), code)


def describe_start(scene: Scene, t: float, y: State, code: int) -> str:
    """The sentence for a known initial state with a `violation_code`: worst contact or constraint, and the remedy."""
    time = jnp.asarray(t, y.q.dtype)
    now, state = scene.bind_time(time), f"The state at t = {t:.9g} is {_state(scene, y)}."
    if code == PENETRATES:
        return f"The initial state violates {_deepest(now, time, y)} Change q0 until no gap is negative. {state}"
    found = []
    for name, each in zip(now.constraint_names, now.constraints, strict=True):
        if not isinstance(each, Contact):
            distances = constraint_residual((each,), time, y.q, y.qd, now.params)
            residuals = each.error(time, y.q, now.params), each.rate(time, y.q, y.qd, now.params)
            for kind, distance, residual in zip(("position", "velocity"), distances, residuals, strict=True):
                found.append((np.nan_to_num(distance, nan=np.inf), name, kind, residual))
    _, name, kind, residual = max(found, key=lambda each: each[0])
    largest = max(np.ravel(residual), key=abs)
    return f"{_GENERAL[code]} The {kind} residual of {name!r} is {largest:.6g}, but zero is needed. {state}"


def _deepest(scene: Scene, t: Array, y: State) -> str:
    """A sentence with the contact of the smallest gap."""
    gaps = {name: float(np.min(each.error(t, y.q, scene.params))) for name, each in scene.contacts.items()}
    name = min(gaps, key=gaps.__getitem__)
    return f"contact {name!r}: its gap is negative, {gaps[name]:.6g}."


def describe_failure(scene: Scene, t: float, y: State, code: int) -> str:
    """The sentence for a failed run with known values, with time, state, and the coordinates or value in error."""
    dof = y.q.shape[0]
    text = outcome_messages(scene, dof)[code]
    if code == PENETRATES:
        time = jnp.asarray(t, y.q.dtype)
        text = f"The run missed an impact at {_deepest(scene.bind_time(time), time, y)}"
        text += " Pass smaller tolerances or dtmax, or compute in float64."
    if FIRST_MASS <= code < FIRST_MASS + dof:
        time = jnp.asarray(t, y.q.dtype)
        mass = np.asarray(_mass(scene.bind_time(time), time, y))
        text += f" Mass matrix {np.array2string(mass, precision=4)}"
        if np.all(np.isfinite(mass)):
            values, vectors = np.linalg.eigh(mass)
            involved = [describe_series(scene, f"q[{i}]") for i in range(dof) if abs(vectors[i, 0]) > 0.05]
            text += f", smallest eigenvalue {values[0]:.3g}, coordinates involved: {', '.join(involved)}"
        text += "."
    for path, module in modules_of(scene):
        try:
            check_ranges(module)
        except ValueError as error:
            text = f"{error} (at scene{path})"
    stopped = f"The run stopped at t = {t:.9g} with {_state(scene, y)}"
    return f"{text} {stopped}; throw=False returns what was computed up to there."


def _state(scene: Scene, y: State) -> str:
    if not scene.coordinates:
        q, qd = (np.array2string(np.asarray(x), precision=6) for x in (y.q, y.qd))
        return f"q = {q}, qd = {qd}"
    series = {f"{name}[{i}]": float(x) for name in ("q", "qd") for i, x in enumerate(getattr(y, name))}
    quantities = {quantity_of(scene, name): x for name, x in series.items()}
    return ", ".join(f"{name} = {x:.6g} {unit}".rstrip() for (name, unit), x in quantities.items())
