"""`design_input`: what to measure next, by gradient on the Fisher information."""

from collections.abc import Callable, Sequence
from typing import Any, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from .._core.index_check import traced
from .._core.parameters import check_ranges, modules_of
from ..scene import Scene, State, check_scene, scene_numbers, scene_ranges
from ._entries import chosen_entries, split_entries, split_ranges
from ._excitation import Axis, driven_motion, feed_forward, motion_basis, relative_numbers, sensitivities
from ._goals import d_optimal
from ._input_design import Excitation, InputDesign, Limits
from ._observe import first_coordinate
from ._parameters import FreeParameters
from ._result import FitResult

# Called after each iteration with its number, over all starts, and the goal as it stands.
DesignProgress: TypeAlias = Callable[[int, float], None]
Goal: TypeAlias = Callable[[Array], Array]

# The search runs on so many samples; the result is judged on all of them.
_COARSE = 625
# Random motions that are tried, and how many of the best are improved.
_TRIED, _IMPROVED = 16, 2
# Sharpness of the smooth maximum: a peak that fifty samples share counts 4 % too high.
_SHARP = 100.0
# Kept from every limit, so that rounding in a file does no harm.
_MARGIN = 1e-3
# Largest weight, in amplitudes of the largest sine of its frequency.
_WIDEST = 2.0
# Stands for a goal that is not finite.
_NO_GOAL = -1e6
# Relative standard error that the search takes as known beforehand: keeps the goal finite where nothing is learned.
_IGNORANCE = 100.0


class _Task(eqx.Module):
    """Samples, motions and limits of a design.

    - `axis`: the machine.
    - `t`: times, shape `[time]`.
    - `shapes`, `rates`: `motion_basis` at these times.
    - `inverse`: one by the limits of force, speed and travel, 0 for no limit, shape `[3]`.
    - `weight`: samples of the record for one of these.
    - `prior`: information from before.
    - `uncertainty`: relative error that the numbers may have now.
    - `goal`: function of the information matrix.
    """

    axis: Axis
    t: Float[Array, " time"]
    shapes: Float[Array, "time weights"]
    rates: Float[Array, "time weights"]
    inverse: Float[Array, " 3"]
    weight: Float[Array, ""]
    prior: Float[Array, "free free"]
    uncertainty: Float[Array, ""]
    goal: Goal = eqx.field(static=True)

    def motion(self, x: Float[Array, " weights"]) -> tuple[Float[Array, " time"], Float[Array, " time"]]:
        """Position and velocity."""
        return self.axis.q0 + self.shapes @ x, self.rates @ x

    def shares(self, x: Float[Array, " weights"], force: Float[Array, " time"]) -> Float[Array, "3 time"]:
        """Force, speed and travel, each as a share of its limit."""
        return jnp.stack([force, self.rates @ x, self.shapes @ x]) * self.inverse[:, None]


def design_input(
    scene: Scene,
    free: Sequence[str],
    limits: Limits,
    *,
    duration: float,
    noise: float,
    dt: float = 1e-3,
    q0: ArrayLike | list[float] | None = None,
    observe: Callable[[Array, Array], Array] = first_coordinate,
    input: str = "u",
    harmonics: int = 12,
    goal: Goal = d_optimal,
    prior: FitResult | None = None,
    uncertainty: float = 0.1,
    seed: int = 0,
    max_steps: int = 30,
    progress: DesignProgress | None = None,
) -> InputDesign:
    """Design the input whose record tells most about the numbers of an axis, within limits.

    What is designed is a motion, a sum of sines and cosines that fades in and out, because an axis led by a force alone
    drifts away; the force for it follows from the model by inverse dynamics. The information is `J'J/noise^2`, with J
    the derivative by the free numbers of what `fit` simulates, open loop, under that force. The goal is improved by
    sequential quadratic programming (SLSQP of scipy) on exact gradients from several starts, on a coarser grid if there
    are many samples. The result is scaled to fill the limits on the full grid, in the reference and in runs of the
    model with one and with four integration steps for every sample.

    Slow motion on the brink of sticking tells most on paper, but a model whose numbers are a little off leaves such a
    motion altogether. So an error of `uncertainty` in any one number may move the simulated record, to first order, by
    no more than the record's own reach. That does not promise that a fit converges from numbers which are so far
    off: start it from the numbers the design was made for, and judge it by its RMSE against the noise.

    A design is the best one for the numbers the scene has: take those of a first fit. Standard errors are those of a
    right model and white noise.

    **Arguments:**

    - `scene`: model of one coordinate; its `params` must be a dict with an entry for the input.
    - `free`: names of the numbers that are to be found, as for `fit`.
    - `limits`: the `Limits` of input, first coordinate and its velocity. Keep a reserve for what the model does not
      know, and for the drive's own controller.
    - `duration`: of the record [s].
    - `noise`: standard deviation of one sample of what is observed, in its unit, > 0.
    - `dt`: time between samples [s].
    - `q0`: position of rest at the start, shape `[1]`; by default zero.
    - `observe`: `observe(q, qd)`, what will be recorded; by default the first coordinate.
    - `input`: name of the entry of `params` that is the driving force; the equations must be linear in it.
    - `harmonics`: highest frequency of the motion in periods per duration; the motion has twice as many weights.
    - `goal`: function of the information matrix of the relative numbers, the larger the better: `d_optimal`,
      `a_optimal`, `e_optimal` or one's own.
    - `prior`: an earlier fit, whose knowledge of the free numbers is added to that of the record.
    - `uncertainty`: relative error that the numbers of the scene may have now, > 0: 0.1 for 10 %.
    - `seed`: of the random starts.
    - `max_steps`: limit of iterations from each start.
    - `progress`: called after each iteration with its number and the goal of its motion, which may still be beyond a
      limit. Ctrl-C ends the search with the best so far.

    **Returns:**

    An `InputDesign`.

    **Raises:**

    - `ValueError` for names that are unknown, a scene that has several coordinates or needs events, an input that is
      not in the scene or does not move it, limits that allow no motion.
    """
    _check({"duration": duration, "dt": dt}, {"noise": noise, "uncertainty": uncertainty}, harmonics, max_steps, goal)
    axis, parameters, scale = _axis(scene, free, q0, observe, input, noise)
    samples = round(duration / dt) + 1
    stride = max((samples - 1) // _COARSE, 1)
    prior_information = np.zeros((len(scale), len(scale)))
    if prior is not None:
        prior_information = _known(prior, parameters.names, scale)

    def task(count: int) -> _Task:
        t = np.linspace(0.0, duration, count)
        shapes, rates = motion_basis(t, harmonics)
        # None is a limit of infinity.
        inverse = [1.0 / (limit or np.inf) / (1.0 - _MARGIN) for limit in (limits.force, limits.speed, limits.travel)]
        numbers = {
            "t": t,
            "shapes": shapes,
            "rates": rates,
            "inverse": inverse,
            "weight": samples / count,
            "prior": prior_information,
            "uncertainty": uncertainty,
        }
        return _Task(axis=axis, goal=goal, **{name: jnp.asarray(x, float) for name, x in numbers.items()})

    fine, coarse = task(samples), task((samples - 1) // stride + 1)
    sines = [_fill(_coarse_share, coarse, column) for column in np.eye(2 * harmonics)[:harmonics]]
    plain = max(sines, key=lambda x: float(_judge(coarse, jnp.asarray(x, float))[0]))
    best, ending = _improve(coarse, sines, plain, seed, max_steps, progress)
    designed, compared = (
        _excitation(fine, _fill(_fine_share, fine, x), parameters.names, scale) for x in (best, plain)
    )
    units = {name: allowed.unit for name, allowed in split_ranges(scene_numbers(scene), scene_ranges(scene)).items()}
    return InputDesign(
        designed,
        compared,
        {name: float(parameters.start[name]) for name in parameters.names},
        {name: units.get(name, "") for name in parameters.names},
        limits,
        noise,
        ending,
        jnp.result_type(float) == jnp.float32,
    )


def _check(times: dict[str, float], numbers: dict[str, float], harmonics: int, max_steps: int, goal: Any) -> None:
    for unit, given in ((" s", times), ("", numbers)):
        for label, number in given.items():
            if not np.isfinite(number) or number <= 0:
                raise ValueError(f"{label} must be finite and > 0{unit}, but {number!r} was given.")
    for label, count in (("harmonics", harmonics), ("max_steps", max_steps)):
        if isinstance(count, bool) or not isinstance(count, int) or count < 1:
            raise ValueError(f"{label} must be at least 1, an integer, but {count!r} was given.")
    duration, dt = times["duration"], times["dt"]
    samples = min(round(duration / dt) + 1, _COARSE)
    if samples < 20 * harmonics:
        raise ValueError(
            f"{duration:g} s in steps of {dt:g} s with {harmonics} harmonics leaves {samples / harmonics:.0f} samples"
            " in a period of the fastest, but 20 are needed: give a longer duration, a shorter dt or fewer harmonics"
            f" (at most {_COARSE // 20})."
        )
    if not callable(goal):
        raise ValueError(f"goal must be a function of the information matrix, as d_optimal is, but it is {goal!r}.")


def _axis(
    scene: Scene,
    free: Sequence[str],
    q0: ArrayLike | list[float] | None,
    observe: Callable[[Array, Array], Array],
    input: str,
    noise: float,
) -> tuple[Axis, FreeParameters, Float[np.ndarray, " free"]]:
    """The machine, its free numbers, and their units."""
    params = scene.params
    if not isinstance(params, dict) or input not in params or jnp.shape(params[input]) != ():
        have = ", ".join(params) if isinstance(params, dict) else "no dict"
        raise ValueError(f"The input {input!r} must be a single number in the scene's params ({have}).")
    if scene.event_driven:
        raise ValueError(
            f"design_input differentiates a run with fixed steps, but {', '.join(scene.event_driven)} would need"
            " events: wrap the law, as in Regularized(law, width)."
        )
    if input in free:
        raise ValueError(f"{input} is the input and cannot be free.")
    position = jnp.asarray([0.0] if q0 is None else q0, float)
    if position.shape != (1,) or scene.constraints:
        raise ValueError(
            f"design_input leads one coordinate along a motion, so q0 must have the shape (1,) and the scene no"
            f" constraints, but q0 has the shape {position.shape} and there are {len(scene.constraints)} constraints."
            " For a mechanism of several coordinates, design for one axis with the others held."
        )
    for _, module in modules_of(scene):
        check_ranges(module)
    rest = State(position, jnp.zeros_like(position), scene.initial_state(position))
    check_scene(scene, rest)
    shape = getattr(traced(observe, name="observe(q, qd)", q=rest.q, qd=rest.qd), "shape", None)
    if shape != ():
        raise ValueError(f"observe(q, qd) returned the shape {shape}, but one number, shape (), is needed.")
    whole = scene_numbers(scene)
    numbers, ranges = split_entries(whole), split_ranges(whole, scene_ranges(scene))
    parameters = FreeParameters.of(numbers, ranges, chosen_entries(whole, free))
    start = dict(parameters.start)
    scale, slopes = relative_numbers({k: float(x) for k, x in start.items()}, parameters.followed, parameters.names)
    columns = {name: jnp.asarray(column, float) for name, column in slopes.items()}
    axis = Axis(scene, start, columns, position, jnp.asarray(noise, float), input, observe)
    still = jnp.full(3, position[0])
    force = feed_forward(axis, jnp.asarray([0.0, 1e-3, 2e-3]), still, jnp.zeros_like(still))
    if not np.all(np.isfinite(force)):
        raise ValueError(f"The input {input!r} does not move the first coordinate, or the model is not finite at rest.")
    return axis, parameters, scale


def _known(
    prior: FitResult, names: tuple[str, ...], scale: Float[np.ndarray, " free"]
) -> Float[np.ndarray, "free free"]:
    """Information of an earlier fit on the relative numbers; none on those it did not determine."""
    information = np.zeros((len(names), len(names)))
    known = [name for name in names if 0.0 < prior.errors.get(name, 0.0) < np.inf]
    if not known:
        raise ValueError(f"prior knows none of {', '.join(names)}; it fitted {', '.join(prior.values)}.")
    there = [list(prior.values).index(name) for name in known]
    here = [names.index(name) for name in known]
    errors = np.array([prior.errors[name] for name in known]) / scale[here]
    covariance = prior.correlation[np.ix_(there, there)] * np.outer(errors, errors)
    information[np.ix_(here, here)] = np.linalg.pinv(covariance, hermitian=True)
    return information


@eqx.filter_jit
def _coarse_share(task: _Task, x: Float[Array, " weights"]) -> Float[Array, ""]:
    """The largest share of a limit, by the reference and the force for it."""
    return jnp.max(jnp.abs(task.shares(x, feed_forward(task.axis, task.t, *task.motion(x)))))


@eqx.filter_jit
def _fine_share(task: _Task, x: Float[Array, " weights"]) -> Float[Array, ""]:
    """The largest share of a limit, also by the model under the force, with one and four steps for every sample."""
    axis = task.axis
    force = feed_forward(axis, task.t, *task.motion(x))
    shares = [jnp.max(jnp.abs(task.shares(x, force)))]
    for substeps in (1, 4):
        q, qd = driven_motion(axis, task.t, force, substeps)
        shares += [task.inverse[1] * jnp.max(jnp.abs(qd)), task.inverse[2] * jnp.max(jnp.abs(q - axis.q0))]
    return jnp.max(jnp.stack(shares))


def _fill(
    share: Callable[[_Task, Array], Array], task: _Task, x: Float[np.ndarray, " weights"]
) -> Float[np.ndarray, " weights"]:
    """The motion made as large as the limits allow."""
    x = np.asarray(x)
    kinematic = np.array([np.max(np.abs(task.rates @ x)), np.max(np.abs(task.shapes @ x))])
    largest = np.max(kinematic * np.asarray(task.inverse[1:]))
    # With a limit of force alone, a kilometre is beyond any.
    x = x / largest if largest > 0 else 1e3 * x / kinematic[1]

    def fits(factor: float) -> bool:
        return bool(share(task, jnp.asarray(factor * x, float)) <= 1.0)

    low = high = 1.0
    while not fits(low):
        low, high = 0.8 * low, low
        if low < 1e-13:
            needed = 100.0 * float(share(task, jnp.asarray(low * x, float)))
            raise ValueError(
                f"No motion keeps the limits: the axis at rest takes {needed:.0f} % of one. Raise the limit of force,"
                " or take the constant load off the axis."
            )
    while high > (1.0 + 1e-3) * low:
        middle = 0.5 * (low + high)
        low, high = (middle, high) if fits(middle) else (low, middle)
    return low * x


def _worth(task: _Task, force: Float[Array, " time"]) -> Float[Array, " 2"]:
    """The goal, and the largest deviation of the record, in its reach, by a number that is as wrong as it may be."""
    record, columns = sensitivities(task.axis, task.t, force)
    information = task.weight * columns.T @ columns + task.prior
    # Rounding must not make a singular matrix indefinite.
    little = 1e3 * jnp.finfo(force.dtype).eps * jnp.diag(information) + 1.0 / _IGNORANCE**2
    deviation = task.uncertainty * columns / jnp.max(jnp.abs(record - record[0]))
    return jnp.stack([task.goal(information + jnp.diag(little)), _largest(jnp.reshape(deviation, (1, -1)))[0]])


def _largest(x: Float[Array, "rows n"]) -> Float[Array, " rows"]:
    """Smooth largest magnitude of each row."""
    return jax.nn.logsumexp(_SHARP * jnp.concatenate([x, -x], axis=1), axis=1) / _SHARP


@eqx.filter_jit
def _judge(
    task: _Task, x: Float[Array, " weights"]
) -> tuple[Float[Array, ""], Float[Array, " weights"], Float[Array, " 4"], Float[Array, "4 weights"]]:
    """The goal, and the use of what is allowed of force, speed, travel and deviation, with their derivatives."""
    force, pull = jax.vjp(lambda x: feed_forward(task.axis, task.t, *task.motion(x)), x)

    def used(x: Array, force: Array) -> Array:
        return _largest(task.shares(x, force))

    (goal, deviation), by_force = _worth(task, force), jax.jacrev(lambda force: _worth(task, force))(force)
    direct, through = jax.jacrev(used, argnums=(0, 1))(x, force)
    by_goal, by_deviation, by_peak = jax.vmap(lambda row: pull(row)[0])(jnp.stack([*by_force, through[0]]))
    rows = jnp.concatenate([direct.at[0].add(by_peak), by_deviation[None]])
    return goal, by_goal, jnp.append(used(x, force), deviation), rows


def _merit(task: _Task, x: Float[np.ndarray, " weights"]) -> float:
    """The goal, less a price of too large a deviation; the limits are held otherwise."""
    goal, _, used, _ = _judge(task, jnp.asarray(x, float))
    return float(goal) - 10.0 * max(float(used[3]) - 1.05, 0.0)


def _improve(
    task: _Task,
    sines: list[np.ndarray],
    plain: np.ndarray,
    seed: int,
    max_steps: int,
    progress: DesignProgress | None,
) -> tuple[Float[np.ndarray, " weights"], str]:
    """The best motion found from the best of some random ones; the best sine if none is better."""
    # Weights in units of the largest sine of their frequency.
    lengths = np.tile([float(np.max(np.abs(x))) for x in sines], 2)
    rng = np.random.default_rng(seed)
    tried = [_fill(_coarse_share, task, lengths * rng.standard_normal(lengths.size)) for _ in range(_TRIED)]
    tried.sort(key=lambda x: -_merit(task, x))
    best, best_merit, ending, count = plain, _merit(task, plain), "converged", 0
    for start in tried[:_IMPROVED]:
        found, how, count = _climb(task, start, lengths, max_steps, progress, count)
        filled = _fill(_coarse_share, task, found)
        merit = _merit(task, filled)
        if merit > best_merit:
            best, best_merit, ending = filled, merit, how
        if how.startswith("was interrupted"):
            return best, how
    return best, ending


def _climb(
    task: _Task,
    start: np.ndarray,
    lengths: np.ndarray,
    max_steps: int,
    progress: DesignProgress | None,
    count: int,
) -> tuple[Float[np.ndarray, " weights"], str, int]:
    """Improve the goal by SLSQP; also says how it ended, and counts the iterations on."""
    seen: dict[bytes, list[np.ndarray]] = {}

    def judged(y: np.ndarray) -> list[np.ndarray]:
        key = y.tobytes()
        if key not in seen:
            seen.clear()
            found = [np.asarray(x, float) for x in _judge(task, jnp.asarray(lengths * y, float))]
            # A step far beyond the limits, where the model is not finite: bad enough for the line search to turn back.
            finite = all(np.isfinite(x).all() for x in found)
            seen[key] = found if finite else [np.full_like(x, _NO_GOAL if i == 0 else 0.0) for i, x in enumerate(found)]
        return seen[key]

    from scipy import optimize  # slow to import, and only needed here

    latest = np.clip(start / lengths, -_WIDEST, _WIDEST)

    def report(y: np.ndarray) -> None:
        nonlocal latest, count
        count, goal = count + 1, float(judged(y)[0])
        if goal > _NO_GOAL:
            latest = y.copy()
        if progress is not None:
            progress(count, goal)

    there = np.append(np.flatnonzero(np.asarray(task.inverse)), 3)
    within = {
        "type": "ineq",
        "fun": lambda y: 1.0 - judged(y)[2][there],
        "jac": lambda y: -judged(y)[3][there] * lengths,
    }
    try:
        found = optimize.minimize(
            lambda y: -float(judged(y)[0]),
            latest,
            jac=lambda y: -judged(y)[1] * lengths,
            method="SLSQP",
            # Far beyond the limits an axis is so sensitive that the goal runs away.
            bounds=[(-_WIDEST, _WIDEST)] * latest.size,
            constraints=[within],
            callback=report,
            options={"maxiter": max_steps, "ftol": 1e-4},
        )
    except KeyboardInterrupt:
        return lengths * latest, "was interrupted", count
    ending = "converged" if found.success else f"stopped ({found.message})"
    return lengths * (found.x if judged(found.x)[0] > _NO_GOAL else latest), ending, count


def _excitation(
    task: _Task, x: Float[np.ndarray, " weights"], names: tuple[str, ...], scale: Float[np.ndarray, " free"]
) -> Excitation:
    """A motion with its force, a run of the model, and what a record would tell."""
    q_ref, qd_ref, force, q, qd, columns = (np.asarray(each, float) for each in _run(task, jnp.asarray(x, float)))
    information = columns.T @ columns
    covariance = _inverse(information + np.asarray(task.prior, float))
    errors = np.sqrt(np.diag(covariance))
    safe = np.where(np.isfinite(errors), errors, 1.0)
    correlation = np.where(np.isfinite(covariance), covariance, 0.0) / np.outer(safe, safe)
    np.fill_diagonal(correlation, 1.0)
    absolute = dict(zip(names, (errors * scale).tolist(), strict=True))
    return Excitation(np.asarray(task.t, float), q_ref, qd_ref, force, q, qd, information, absolute, correlation)


@eqx.filter_jit
def _run(task: _Task, x: Float[Array, " weights"]) -> tuple[Array, ...]:
    """Reference, force, motion of the model and sensitivities."""
    axis, (q_ref, qd_ref) = task.axis, task.motion(x)
    force = feed_forward(axis, task.t, q_ref, qd_ref)
    return q_ref, qd_ref, force, *driven_motion(axis, task.t, force), sensitivities(axis, task.t, force)[1]


def _inverse(information: Float[np.ndarray, "free free"]) -> Float[np.ndarray, "free free"]:
    """Inverse with eigenvalues kept off zero; infinite variance where nothing is known."""
    scale = np.sqrt(np.diag(information))
    silent = scale == 0
    scale = np.where(silent, 1.0, scale)
    values, vectors = np.linalg.eigh(information / np.outer(scale, scale))
    inverse = vectors / np.maximum(values, 1e-15 * max(values[-1], 1.0)) @ vectors.T / np.outer(scale, scale)
    inverse[silent, :], inverse[:, silent] = 0.0, 0.0
    inverse[silent, silent] = np.inf
    return inverse
