"""From a scene, records and options to the arrays of a `FitProblem`."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, ArrayLike, Float

from ..._core.arguments import as_float, as_mapping, as_names, as_reals, as_whole
from ..._core.arrays import on_device
from ..._core.functions import is_state_dependent
from ..._core.parameters import Range, check_not_nan, check_ranges, modules_of
from ...friction import AbstractLaw
from ...scene import Scene, State, check_scene, scene_numbers, scene_ranges
from ..data._record import Record, Window, cut, runs_of, slip_channel
from ..data._signals import start_errors, start_state
from ..model._engines import DELAY, Controller, EventEngine, LawEngine, ReplayEngine
from ..model._observe import Observable, Observables, by_channel, check_observables, coordinates_seen
from ..model._parameters import FreeParameters, chosen_entries, split_entries, split_ranges
from ._problem import AbstractLoss, FitProblem, Prior, SquaredLoss, local_names
from ._search import SearchResult, channels_seen

# Factor of the integration steps that shows their error in the output.
_FINER = 4
# Standard deviation of the velocity at the start around that of the first samples, in its standard errors: large
# enough that the samples, which are fitted as well, hardly count twice.
_DOUBT = 4.0
# Coordinates or velocities at the first sample, shape `[dof]` or `[records, dof]`.
StartState: TypeAlias = ArrayLike | Sequence[ArrayLike] | Sequence[Sequence[ArrayLike]]


@dataclass(frozen=True)
class MultipleShooting:
    """Multiple shooting: a record is run in windows, each from its own initial state, which is fitted, too.

    For records too long, or motions too unstable, for one run from the first sample to the last.

    **Arguments:**

    - `window`: length [s].
    - `jump`: standard deviations of the jumps of positions [m or rad] and of velocities [m/s or rad/s] from the end of
      one window to the start of the next, both > 0: the error of the model and of disturbances over one window. The
      states of friction laws count as positions. None: the windows are independent, and friction laws start unloaded.

    **Raises:**

    - `ValueError` for jumps that are not positive, and (at the fit) for a window that is too short.
    """

    window: float
    jump: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        """Refuse jumps that are not positive."""
        if self.jump is not None and not (len(self.jump) == 2 and all(np.isfinite(x) and x > 0 for x in self.jump)):
            raise ValueError(f"jump must be two numbers > 0, of positions and of velocities, but it is {self.jump!r}.")


class FitOptions(eqx.Module):
    """The arguments of `fit` that define the problem, converted and checked; see there."""

    observe: Observable | Mapping[str, Observable]
    q0: StartState | None = None
    qd0: StartState | None = None
    delay: Mapping[str, float] = eqx.field(
        default=None, converter=partial(as_mapping, name="delay", example="{'u': 1e-3}")
    )
    limits: Mapping[str, tuple[float | None, float | None]] = eqx.field(
        default=None, converter=partial(as_mapping, name="limits", example="{'m': (0.0, 5.0)}")
    )
    passive: tuple[str, ...] = eqx.field(default=(), converter=partial(as_names, name="passive"))
    prior: Mapping[str, tuple[float, float]] = eqx.field(
        default=None, converter=partial(as_mapping, name="prior", example="{'m': (95.0, 5.0)}")
    )
    loss: AbstractLoss = eqx.field(default=None, converter=lambda loss: SquaredLoss() if loss is None else loss)
    controller: Controller | None = None
    shooting: MultipleShooting | None = None
    substeps: int = eqx.field(default=1, converter=partial(as_whole, name="substeps"))
    accuracy: float = eqx.field(default=1e-8, converter=partial(as_float, name="accuracy", lower=0.0))

    def __check_init__(self) -> None:
        for name, value, kind, words in (
            ("loss", self.loss, AbstractLoss, "a loss such as Huber()"),
            ("controller", self.controller, Controller | None, "a Controller"),
            ("shooting", self.shooting, MultipleShooting | None, "a MultipleShooting"),
        ):
            if not isinstance(value, kind):
                raise ValueError(f"{name} must be {words}, but {value!r} was given.")


@dataclass(frozen=True)
class Prepared:
    """A problem, its records and windows, and units by name."""

    problem: FitProblem
    records: tuple[Record, ...]
    windows: tuple[Window, ...]
    units: dict[str, str]

    @property
    def known_noise(self) -> frozenset[str]:
        """The channels whose noise the records state."""
        return frozenset(name for record in self.records for name in record.noise)


def prepare(scene: Scene, records: Record | Sequence[Record], free: Sequence[str], options: FitOptions) -> Prepared:
    """Check everything, with the errors of `fit`, and build the problem."""
    if not isinstance(scene, Scene):
        raise ValueError(f"scene must be a Scene, but {scene!r} was given.")
    if why := scene.without_derivatives:
        raise ValueError(why)
    several = records_of(records)
    _check_inputs(scene, several)
    for _, module in modules_of(scene):
        check_ranges(module)
    observables = by_channel(options.observe, several)
    states = _states(scene, several, observables, options)
    first = jax.tree.map(lambda x: on_device(np.asarray(x)[0]), states)
    check_scene(scene, first)
    check_observables(observables, scene, first)
    own = local_names(first)
    local, shared = _split_free(free, own)
    if options.shooting is not None:
        linked = options.shooting.jump is not None
        local = tuple(name for name in own if linked or not name.startswith("z0"))
    unknown = _unknown(options, observables, own, local)
    numbers, ranges = _numbers(scene, several, options)
    whole = scene_numbers(scene)
    undriven = {name: x for name, x in whole.items() if name not in several[0].inputs}
    check_not_nan(undriven.values(), lambda: undriven)
    chosen = chosen_entries({**whole, **numbers}, shared)
    driven = sorted(set(chosen) & set(several[0].inputs))
    if driven:
        raise ValueError(f"{driven[0]} is driven by the record and cannot be free.")
    parameters = FreeParameters.of(numbers, ranges, chosen, _passive(options.passive, numbers))
    windows = cut(several, None if options.shooting is None else options.shooting.window)
    runs = runs_of(several, windows)
    base = _bases(scene, several, windows, states, observables)
    engine = _engine(scene, options, observables, several[0].linear, tuple(runs.slips), states.q.shape[1])
    names = (*runs.measured, *map(slip_channel, runs.slips))
    noise = {name: on_device(noise_level(name, several)) for name in names}
    problem = FitProblem(
        engine,
        parameters,
        (*local, *unknown),
        base,
        runs,
        noise,
        options.loss,
        Prior.of(options.prior, parameters.names),
        _jump(options.shooting, windows, base),
        len(unknown),
        _shown_by_opening(several, observables, (*local, *unknown), unknown, states.q.shape[1]),
    )
    return Prepared(problem, several, windows, {name: allowed.unit for name, allowed in ranges.items()})


def prepare_law(
    law: AbstractLaw, records: Record | Sequence[Record], free: Sequence[str] | None, loss: AbstractLoss | None
) -> Prepared:
    """Check everything, with the errors of `fit_law`, and build the problem."""
    several = records_of(records)
    for each in several:
        if "x" not in each.inputs or not (is_state_dependent(law) or set(each.inputs) <= {"x", "normal"}):
            raise ValueError(
                "fit_law needs the input 'x' [m] and may take 'normal' [N], and more only for a law that scaled_by lets"
                f" depend on it; the record has: {', '.join(each.inputs)}."
            )
    numbers, ranges = scene_numbers(law), scene_ranges(law)
    single, ranges = split_entries(numbers), split_ranges(numbers, ranges)
    chosen = _off_limits(single, ranges) if free is None else chosen_entries(numbers, free)
    parameters = FreeParameters.of(single, ranges, chosen)
    windows = cut(several, None)
    problem = FitProblem(
        LawEngine(law),
        parameters,
        (),
        None,
        runs_of(several, windows),
        {name: on_device(noise_level(name, several)) for each in several for name in each.channels},
        SquaredLoss() if loss is None else loss,
        Prior.of({}, parameters.names),
    )
    per_load = " per N" if "normal" in several[0].inputs else ""
    units = {
        name: allowed.unit + (per_load if allowed.unit.startswith("N") else "") for name, allowed in ranges.items()
    }
    return Prepared(problem, several, windows, units)


def _off_limits(numbers: dict[str, Array], ranges: dict[str, Range]) -> tuple[str, ...]:
    """Names of the parameters that start off their limits and are not numerical."""
    free = []
    for name, value in numbers.items():
        lower = ranges[name].lower if name in ranges else None
        limit = numbers[lower] if isinstance(lower, str) else lower
        if not (name in ranges and ranges[name].execution) and (limit is None or bool(value > limit)):
            free.append(name)
    return tuple(free)


def records_of(records: object) -> tuple[Record, ...]:
    """One record or several, of different names and the same inputs."""
    several = (records,) if isinstance(records, Record) else records
    if not isinstance(several, tuple | list) or not several or not all(isinstance(x, Record) for x in several):
        raise ValueError(f"records must be a Record or several of them, but {records!r} was given.")
    names = [record.name for record in several]
    for name in names:
        if names.count(name) > 1:
            raise ValueError(f"Two records have the name {name!r}; pass name= to tell them apart.")
    for record in several[1:]:
        if set(record.inputs) != set(several[0].inputs) or record.linear != several[0].linear:
            one, other = (f"{x.name} has {sorted(x.inputs)}, linear {sorted(x.linear)}" for x in (several[0], record))
            raise ValueError(f"All records need the same inputs: {one}; {other}.")
    return tuple(several)


def _check_inputs(scene: Scene, records: tuple[Record, ...]) -> None:
    inputs = records[0].inputs
    if inputs and (not isinstance(scene.params, dict) or not set(inputs) <= set(scene.params)):
        have = ", ".join(scene.params) if isinstance(scene.params, dict) else "no dict"
        raise ValueError(f"The record's inputs ({', '.join(inputs)}) must be entries of the scene's params ({have}).")
    for record in records:
        for effect in record.slips:
            if effect not in scene.event_driven:
                raise ValueError(
                    f"{record.name} has slip instants of {effect!r}, but the effects that run by events are:"
                    f" {', '.join(scene.event_driven) or 'none'}."
                )


def _states(scene: Scene, records: tuple[Record, ...], observables: Observables, options: FitOptions) -> State:
    """Initial states of the records, with a leading axis of records."""
    count, known = len(records), {"q0": options.q0, "qd0": options.qd0}
    known = {name: x if x is None else as_reals(x, name=name) for name, x in known.items()}
    dof = max((np.shape(x)[-1] for x in known.values() if x is not None and np.ndim(x) > 0), default=1)
    measured = [np.stack(each) for each in zip(*(measured_start(x, observables, dof) for x in records), strict=True)]
    starts = []
    for value, shown in zip(known.values(), measured, strict=True):
        array = shown if value is None else value
        if array.shape not in ((dof,), (count, dof)) or not np.isfinite(array).all():
            raise ValueError(
                f"q0 and qd0 must be finite and of one shape [dof] or [records, dof], but q0 = {options.q0} and"
                f" qd0 = {options.qd0}."
            )
        starts.append(np.broadcast_to(array, (count, dof)))
    q, qd = (on_device(np.array(x, jnp.result_type(float))) for x in starts)
    return initial_states(scene, q, qd)


@eqx.filter_jit
def initial_states(scene: Scene, q: Float[Array, "runs dof"], qd: Float[Array, "runs dof"]) -> State:
    """States with the effects at rest, with a leading axis of runs."""
    return jax.vmap(lambda q, qd: State(q, qd, scene.initial_state(q)))(q, qd)


def _unknown(
    options: FitOptions, observables: Observables, own: tuple[str, ...], local: tuple[str, ...]
) -> tuple[str, ...]:
    """Names of the unknown coordinates and velocities at the first sample that a channel shows."""
    if options.shooting is not None:
        return ()
    dof = sum(name.startswith("q0[") for name in own)
    seen = set(coordinates_seen(observables, dof).values())
    shown = {f"q0[{i}]": {f"q[{i}]"} for i in range(dof)} | {f"qd0[{i}]": {f"q[{i}]", f"qd[{i}]"} for i in range(dof)}
    names = [name for name, by in shown.items() if by & seen and name not in local]
    return tuple(name for name in names if getattr(options, name.partition("[")[0]) is None)


def _shown_by_opening(
    records: tuple[Record, ...],
    observables: Observables,
    local: tuple[str, ...],
    unknown: tuple[str, ...],
    dof: int,
) -> dict[str, Array]:
    """Knowledge of unknown velocities from the first samples of positions; see `FitProblem.known`.

    It holds them in the search: a machine in stick loses its first velocity at once, so no other sample shows it.
    """
    known = {}
    for channel, seen in coordinates_seen(observables, dof).items():
        name, weights = f"qd0[{seen.removeprefix('q[')}", np.zeros((len(records), len(local)))
        if name in unknown:
            weights[:, local.index(name)] = [
                1 / (_DOUBT * start_errors(record, channel)) if channel in record.channels else 0.0
                for record in records
            ]
        known[channel] = on_device(weights)
    return known if unknown else {}


def _split_free(free: Sequence[str], own: tuple[str, ...]) -> tuple[tuple[str, ...], Sequence[str]]:
    """Names of initial states in `free`, and the other names."""
    if isinstance(free, str):
        return (), free  # refused where it is used
    free = as_names(free, name="free")
    local: list[str] = []
    shared: list[str] = []
    for name in free:
        entries = [each for each in own if each == name or each.split("[")[0].split(".")[0] == name]
        (local.extend(entries) if entries else shared.append(name))
    return tuple(local), tuple(shared)


def _numbers(
    scene: Scene, records: tuple[Record, ...], options: FitOptions
) -> tuple[dict[str, Array], dict[str, Range]]:
    """All numbers that can be free, delays included, and their ranges, entry by entry."""
    whole = scene_numbers(scene)
    ranges = split_ranges(whole, scene_ranges(scene))
    delays = {name: options.delay.get(name, 0.0) for name in records[0].inputs}
    for name, delay in options.delay.items():
        late = as_float(delay, name=f"delay of {name!r}")
        if name not in delays or late < 0:
            raise ValueError(
                f"delay of {name!r} is {late!r}, but it must be a time >= 0 of one of the inputs"
                f" {', '.join(delays) or '(there are none)'}."
            )
    numbers = split_entries(whole) | {DELAY + name: on_device(float(late)) for name, late in delays.items()}
    ranges |= {DELAY + name: Range("s", 0.0) for name in delays}
    for name, span in options.limits.items():
        if not isinstance(span, tuple | list) or len(span) != 2:
            raise ValueError(
                f"limits of {name!r} must be (lower, upper), None for none, as in (0.0, None), but {span!r} was given."
            )
        low, high = (None if x is None else as_float(x, name=f"limits of {name!r}") for x in span)
        upper, _, base = name.partition("/")
        if base and upper in ranges and ranges[upper].lower == base:
            ranges[upper] = replace(ranges[upper], most=high)
            continue
        if name not in numbers:
            raise ValueError(f"limits: {name} is no number of the scene; there are: {', '.join(numbers)}.")
        declared = ranges.get(name, Range(""))
        if isinstance(declared.lower, str) and low is not None:
            raise ValueError(f"limits: {name} is already limited by {declared.lower}.")
        if low is not None and (declared.lower is None or float(low) >= float(declared.lower)):
            declared = replace(declared, lower=float(low), strict=low == 0)
        if high is not None and (declared.upper is None or float(high) <= declared.upper):
            declared = replace(declared, upper=float(high))
        ranges[name] = declared
        if not isinstance(declared.lower, str) and not declared.holds(np.asarray(numbers[name]), {}):
            raise ValueError(f"limits: {name} must be {declared.text}, but it is {numbers[name]}.")
    return numbers, ranges


def _passive(effects: tuple[str, ...], numbers: Mapping[str, Array]) -> dict[str, tuple[str, str, str]]:
    floors = {}
    for effect in effects:
        sigma1, Fs, Fc = (f"{effect}.{name}" for name in ("sigma1", "Fs", "Fc"))
        missing = [name for name in (f"{effect}.sigma2", sigma1, Fs, Fc) if name not in numbers]
        if missing:
            raise ValueError(f"passive names {effect!r}, but there is no {missing[0]}: it must have a LuGre law.")
        floors[f"{effect}.sigma2"] = (sigma1, Fs, Fc)
    return floors


def _bases(
    scene: Scene,
    records: tuple[Record, ...],
    windows: tuple[Window, ...],
    states: State,
    observables: Observables,
) -> State:
    """Initial state of each run: that of its record, or what was measured where a window begins."""
    q, qd = (np.asarray(each)[[window.record for window in windows]] for each in (states.q, states.qd))
    for run, window in enumerate(windows):
        if window.first > 0:
            record = records[window.record]
            rest = record.samples(window.first, len(record.t))
            q[run], qd[run] = measured_start(rest, observables, q.shape[1])
    return initial_states(scene, on_device(q), on_device(qd))


def _engine(
    scene: Scene,
    options: FitOptions,
    observables: Observables,
    linear: frozenset[str],
    slips: tuple[str, ...],
    dof: int,
) -> ReplayEngine | EventEngine:
    delays = {DELAY + name: on_device(float(late)) for name, late in options.delay.items()}
    fixed_steps = not scene.mode_names or (not scene.constraints and set(scene.mode_widths(dof)) == {1})
    if fixed_steps and not slips:
        return ReplayEngine(scene, delays, options.controller, observables, linear, options.substeps)
    if options.controller is not None:
        raise ValueError(
            "A controller runs with fixed steps, which pass stick and slip along a line, but neither constraints, nor"
            " slip in a plane, nor slip instants in a record: wrap the laws, as in Regularized(law, width)."
        )
    return EventEngine(scene, delays, observables, linear, slips, options.accuracy)


def noise_level(channel: str, records: tuple[Record, ...]) -> float:
    """Known noise level, or the standard deviation of the channel to begin with.

    **Raises:**

    - `ValueError` if it differs between the records.
    """
    known = [record.noise[channel] for record in records if channel in record.noise]
    if known:
        if len(set(known)) > 1:
            raise ValueError(f"noise of {channel!r} differs between the records: {known}. Pass one for all of them.")
        return known[0]
    values = [record.channels[channel] for record in records if channel in record.channels]
    # The interval of the samples, for slip instants.
    size = float(np.std(np.concatenate(values))) if values else float(np.median(np.diff(records[0].t)))
    return size or 1.0


def _jump(shooting: MultipleShooting | None, windows: tuple[Window, ...], base: State) -> Array | None:
    if shooting is None or shooting.jump is None or len(windows) == 1:
        return None
    position, velocity = shooting.jump
    first = jax.tree.map(lambda x: x[0], base)
    sizes = State(
        jnp.full_like(first.q, position),
        jnp.full_like(first.qd, velocity),
        jax.tree.map(lambda x: jnp.full_like(x, position), first.z),
    )
    flat, _ = ravel_pytree(sizes)
    return jnp.asarray([window.linked for window in windows[:-1]], float)[:, None] / flat[None, :]


def step_changes(search: SearchResult) -> dict[str, Float[np.ndarray, "runs samples"]]:
    """Changes of the output by channel with four times as many integration steps; none without such steps."""
    problem, changes = search.problem, {}
    if not isinstance(problem.engine, ReplayEngine):
        return changes
    finer = replace(problem.engine, substeps=_FINER * problem.engine.substeps)
    fine = channels_seen(eqx.tree_at(lambda p: p.engine, problem, finer), search.state.x)
    for name, (residual, weight) in search.residuals.items():
        coarse = residual * float(problem.noise[name])
        moved = np.asarray(fine[name]) - np.asarray(problem.runs.measured[name]) - coarse
        changes[name] = np.where(weight > 0, moved, 0.0)
    return changes


def measured_start(record: Record, observables: Observables, dof: int) -> tuple[np.ndarray, np.ndarray]:
    """Measured coordinates and velocities at the first sample; zero for the others."""
    q, qd = np.zeros(dof), np.zeros(dof)
    # Velocities last: a measured one replaces the slope of a position.
    for channel, name in sorted(coordinates_seen(observables, dof).items(), key=lambda each: each[1]):
        i = int(name.split("[")[1][:-1])
        if channel in record.channels and i < dof:
            if name.startswith("qd"):
                qd[i] = start_state(record, channel)[0]
            else:
                q[i], qd[i] = start_state(record, channel)
    return q, qd
