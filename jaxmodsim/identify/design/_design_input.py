"""`design_input`: the most informative input for the next measurement, by gradients of the Fisher information."""

from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from ..._core.arguments import as_float, as_whole
from ..._core.parameters import check_ranges, modules_of
from ..._core.progress import reported
from ...scene import Scene, State, check_scene, scene_numbers, scene_ranges
from ..model._observe import check_observables, first_coordinate
from ..model._parameters import FreeParameters, chosen_entries, split_entries, split_ranges
from ..uncertainty._estimate import correlation_of, floored_inverse
from ..uncertainty._result import FitResult
from ._input_design import (
    AxisLimits,
    DrivenAxis,
    Excitation,
    InputDesign,
    d_optimal,
    driven_motion,
    feed_forward,
    motion_basis,
    sensitivities,
)

# Called after each iteration with its number, over all starts, and the criterion as it stands.
DesignProgress: TypeAlias = Callable[[int, float], None]
Criterion: TypeAlias = Callable[[Array], Array]
# The search uses so many samples; the result is evaluated on all of them.
_COARSE = 625
# Number of random motions, and of the best ones that are improved.
_TRIED, _IMPROVED = 16, 2
# The smooth maximum of magnitudes is `log(sum(exp(_SHARP x)))/_SHARP`; for fifty equal ones it is 4 % too high.
_SHARP = 100.0
# Distance from every limit, against rounding in a file.
_MARGIN = 1e-3
# Largest weight, relative to the largest sine of its frequency.
_WIDEST = 2.0
# Value of a criterion that is not finite.
_NOT_FINITE = -1e6
# Relative standard error of a prior in the search: keeps the criterion finite for numbers without effect.
_IGNORANCE = 100.0
# Least number of samples in a period of the fastest harmonic.
_SAMPLES_A_PERIOD = 20
# Penalty of a deviation beyond the allowed one, in the criterion, and the share of it from which it applies.
_PRICE, _PRICED_FROM = 10.0, 1.05
# Relative tolerance of SLSQP.
_FTOL = 1e-4
# Tolerance with which a motion fills its limits; factor by which it shrinks to keep them; size at which it fails.
_FILLED, _SHRINK, _VANISHED = 1e-3, 0.8, 1e-13
# Smallest eigenvalue of a scaled information matrix, relative to the largest; addition to its diagonal, in eps.
_LEAST, _DEFINITE = 1e-15, 1e3
# Travel [m] of the first trial if only the force is limited.
_FAR = 1e3


class _Task(eqx.Module):
    """Samples, motions and limits of a design.

    - `axis`: the machine.
    - `t`: times, shape `[time]`.
    - `shapes`, `rates`: `motion_basis` at these times.
    - `inverse`: reciprocals of the limits of force, speed and travel, 0 for no limit, shape `[3]`.
    - `weight`: samples of the record for each of these.
    - `prior`: information of an earlier fit.
    - `uncertainty`: relative error of the current numbers.
    - `criterion`: function of the information matrix.
    """

    axis: DrivenAxis
    t: Float[Array, " time"]
    shapes: Float[Array, "time weights"]
    rates: Float[Array, "time weights"]
    inverse: Float[Array, " 3"]
    weight: Float[Array, ""]
    prior: Float[Array, "free free"]
    uncertainty: Float[Array, ""]
    criterion: Criterion = eqx.field(static=True)

    def motion(self, x: Float[Array, " weights"]) -> tuple[Float[Array, " time"], Float[Array, " time"]]:
        """Position and velocity."""
        return self.axis.q0 + self.shapes @ x, self.rates @ x

    def shares(self, x: Float[Array, " weights"], force: Float[Array, " time"]) -> Float[Array, "3 time"]:
        """Force, speed and travel, each as a share of its limit."""
        return jnp.stack([force, self.rates @ x, self.shapes @ x]) * self.inverse[:, None]


def design_input(
    scene: Scene,
    free: Sequence[str],
    limits: AxisLimits,
    *,
    duration: float,
    noise: float,
    dt: float = 1e-3,
    q0: ArrayLike | list[float] | None = None,
    observe: Callable[[Array, Array], Array] = first_coordinate,
    input_name: str = "u",
    harmonics: int = 12,
    criterion: Criterion = d_optimal,
    prior: FitResult | None = None,
    uncertainty: float = 0.1,
    seed: int = 0,
    max_steps: int = 30,
    progress: bool | DesignProgress = False,
) -> InputDesign:
    """Design the input whose record is most informative about the numbers of an axis, within limits.

    The design is a motion, a sum of sines and cosines that fades in and out, since an axis under a designed force would
    drift away. The force for it follows from the model by inverse dynamics. The information is `J'J/noise^2`, with J
    the derivative, by the free numbers, of the open-loop simulation in `fit` under that force. The criterion is
    improved by sequential quadratic programming (SLSQP of SciPy) on exact gradients from several starts, on a coarser
    grid if there are many samples. The result is scaled to fill the limits on the full grid, in the reference and in
    runs of the model with one and with four integration steps for every sample.

    The information is largest for slow motion close to sticking, but a model with slightly wrong numbers does not
    follow such a motion. So an error of `uncertainty` in any one number may move the simulated record, to first order,
    by no more than the range of the record. A fit from such numbers may still not converge: start it from the numbers
    of the design, and compare its RMSE with the noise.

    A design is optimal for the numbers of the scene: use those of a first fit. Standard errors assume a right model and
    white noise.

    **Arguments:**

    - `scene`: model of one coordinate; its `params` must be a dict with an entry for the input.
    - `free`: names of the numbers to fit, as for `fit`.
    - `limits`: the `AxisLimits` of input, first coordinate and its velocity. Keep a reserve for errors of the model
      and for the drive's own controller.
    - `duration`: of the record [s].
    - `noise`: standard deviation of one sample of the observed quantity, in its unit, > 0.
    - `dt`: time between samples [s].
    - `q0`: position of rest at the start, shape `[1]`; by default zero.
    - `observe`: `observe(q, qd)`, the recorded quantity; by default the first coordinate.
    - `input_name`: name of the entry of `params` that is the driving force; the equations must be linear in it.
    - `harmonics`: highest frequency of the motion in periods per duration; the motion has twice as many weights.
    - `criterion`: function of the information matrix of the relative numbers, the larger the better: `d_optimal`,
      `a_optimal`, `e_optimal` or your own.
    - `prior`: an earlier fit, whose information about the free numbers is added to that of the record.
    - `uncertainty`: relative error of the current numbers of the scene, > 0: 0.1 for 10 %.
    - `seed`: of the random starts.
    - `max_steps`: limit of iterations from each start.
    - `progress`: True for a line of text, or a function that is called after each iteration with its number and the
      criterion of its motion, which may still exceed a limit. Ctrl-C ends the search with the best so far.

    **Returns:**

    An `InputDesign`.

    **Raises:**

    - `ValueError` for names that are unknown, a scene that has several coordinates or needs events, an input that is
      not in the scene or does not move it, or limits that allow no motion.
    """
    duration, dt = as_float(duration, name="duration [s]", lower=0.0), as_float(dt, name="dt [s]", lower=0.0)
    noise = as_float(noise, name="noise", lower=0.0)
    uncertainty = as_float(uncertainty, name="uncertainty", lower=0.0)
    harmonics, max_steps = as_whole(harmonics, name="harmonics"), as_whole(max_steps, name="max_steps")
    _check(duration, dt, harmonics, criterion)
    axis, parameters, scale = _axis(scene, free, q0, observe, input_name, noise)
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
        numbers = (t, shapes, rates, inverse, samples / count, prior_information, uncertainty)
        return _Task(axis, *(jnp.asarray(x, float) for x in numbers), criterion=criterion)

    fine, coarse = task(samples), task((samples - 1) // stride + 1)
    sines = [_fill(coarse, column) for column in np.eye(2 * harmonics)[:harmonics]]
    baseline = max(sines, key=lambda x: float(_judge(coarse, jnp.asarray(x, float))[0]))
    with reported(progress, "next input", lambda number, value: f"iteration {number}: criterion {value:.4g}") as report:
        best, ending = _improve(coarse, sines, baseline, seed, max_steps, report)
    designed, sine = (_excitation(fine, _fill(fine, x, (1, 4)), parameters.names, scale) for x in (best, baseline))
    units = {name: allowed.unit for name, allowed in split_ranges(scene_numbers(scene), scene_ranges(scene)).items()}
    return InputDesign(
        best=designed,
        baseline=sine,
        values={name: float(parameters.start[name]) for name in parameters.names},
        units={name: units.get(name, "") for name in parameters.names},
        limits=limits,
        noise=noise,
        ending=ending,
        single_precision=jnp.result_type(float) == jnp.float32,
    )


def _check(duration: float, dt: float, harmonics: int, criterion: object) -> None:
    samples = min(round(duration / dt) + 1, _COARSE)
    if samples < _SAMPLES_A_PERIOD * harmonics:
        raise ValueError(
            f"{duration:g} s in steps of {dt:g} s with {harmonics} harmonics leaves {samples / harmonics:.0f} samples"
            f" in a period of the fastest, but {_SAMPLES_A_PERIOD} are needed: give a longer duration, a shorter dt or"
            f" fewer harmonics (at most {_COARSE // _SAMPLES_A_PERIOD})."
        )
    if not callable(criterion):
        raise ValueError(
            f"criterion must be a function of the information matrix, as d_optimal is, but it is {criterion!r}."
        )


def _axis(
    scene: Scene,
    free: Sequence[str],
    q0: ArrayLike | list[float] | None,
    observe: Callable[[Array, Array], Array],
    input_name: str,
    noise: float,
) -> tuple[DrivenAxis, FreeParameters, Float[np.ndarray, " free"]]:
    """The machine, its free numbers, and their units."""
    params = scene.params
    if not isinstance(params, dict) or input_name not in params or jnp.shape(params[input_name]) != ():
        have = ", ".join(params) if isinstance(params, dict) else "no dict"
        raise ValueError(f"The input {input_name!r} must be a single number in the scene's params ({have}).")
    if scene.mode_names:
        raise ValueError(
            f"design_input differentiates a run with fixed steps, but {', '.join(scene.mode_names)} would need"
            " events: wrap a law, as in Regularized(law, width)."
        )
    if why := scene.without_derivatives:
        raise ValueError(why)
    if input_name in free:
        raise ValueError(f"{input_name} is the input and cannot be free.")
    position = jnp.asarray([0.0] if q0 is None else q0, float)
    if position.shape != (1,) or scene.constraints:
        raise ValueError(
            f"design_input designs the motion of one coordinate, so q0 must have the shape (1,) and the scene no"
            f" constraints, but q0 has the shape {position.shape} and there are {len(scene.constraints)} constraints."
            " For a mechanism of several coordinates, design for one axis with the others held."
        )
    for _, module in modules_of(scene):
        check_ranges(module)
    rest = State(position, jnp.zeros_like(position), scene.initial_state(position))
    check_scene(scene, rest)
    check_observables((("the record", observe),), scene, rest)
    whole = scene_numbers(scene)
    numbers, ranges = split_entries(whole), split_ranges(whole, scene_ranges(scene))
    parameters = FreeParameters.of(numbers, ranges, chosen_entries(whole, free))
    start, names = dict(parameters.start), parameters.names
    # The unit of a free number is the number itself, so that errors are relative; 1 for a number that is zero.
    scale = np.array([abs(float(start[name])) or 1.0 for name in names])
    slopes: dict[str, np.ndarray] = {}
    # Limits come before what they limit. A fixed number that is limited by a free one moves with it, as in a fit.
    for name in start:
        slopes[name] = scale * (np.array(names) == name) if name in names else slopes[parameters.following[name]]
    columns = {name: jnp.asarray(column, float) for name, column in slopes.items()}
    axis = DrivenAxis(scene, start, columns, position, jnp.asarray(noise, float), input_name, observe)
    still = jnp.full(3, position[0])
    force = feed_forward(axis, jnp.asarray([0.0, 1e-3, 2e-3]), still, jnp.zeros_like(still))
    if not np.all(np.isfinite(force)):
        raise ValueError(
            f"The input {input_name!r} does not move the first coordinate, or the model is not finite at rest."
        )
    return axis, parameters, scale


def _known(
    prior: FitResult, names: tuple[str, ...], scale: Float[np.ndarray, " free"]
) -> Float[np.ndarray, "free free"]:
    """Information of an earlier fit on the relative numbers; 0 for undetermined ones."""
    information = np.zeros((len(names), len(names)))
    known = [name for name in names if 0.0 < prior.errors.get(name, 0.0) < np.inf]
    if not known:
        raise ValueError(f"prior knows none of {', '.join(names)}; it fitted {', '.join(prior.values)}.")
    fitted = [list(prior.values).index(name) for name in known]
    here = [names.index(name) for name in known]
    errors = np.array([prior.errors[name] for name in known]) / scale[here]
    covariance = prior.estimate.correlation[np.ix_(fitted, fitted)] * np.outer(errors, errors)
    information[np.ix_(here, here)] = np.linalg.pinv(covariance, hermitian=True)
    return information


@eqx.filter_jit
def _share(task: _Task, x: Float[Array, " weights"], runs: tuple[int, ...] = ()) -> Float[Array, ""]:
    """The largest share of a limit, by the reference, its force, and `runs` with so many steps a sample."""
    axis = task.axis
    force = feed_forward(axis, task.t, *task.motion(x))
    shares = [jnp.max(jnp.abs(task.shares(x, force)))]
    for substeps in runs:
        q, qd = driven_motion(axis, task.t, force, substeps)
        shares += [task.inverse[1] * jnp.max(jnp.abs(qd)), task.inverse[2] * jnp.max(jnp.abs(q - axis.q0))]
    return jnp.max(jnp.stack(shares))


def _fill(task: _Task, x: Float[np.ndarray, " weights"], runs: tuple[int, ...] = ()) -> Float[np.ndarray, " weights"]:
    """The motion scaled to the limits; `runs` as in `_share`."""
    x = np.asarray(x)
    kinematic = np.array([np.max(np.abs(task.rates @ x)), np.max(np.abs(task.shapes @ x))])
    largest = np.max(kinematic * np.asarray(task.inverse[1:]))
    x = x / largest if largest > 0 else _FAR * x / kinematic[1]

    def share(factor: float) -> float:
        return float(_share(task, jnp.asarray(factor * x, float), runs))

    low = high = 1.0
    while not share(low) <= 1.0:
        low, high = _SHRINK * low, low
        if low < _VANISHED:
            raise ValueError(
                f"No motion keeps the limits: the axis at rest takes {100.0 * share(low):.0f} % of one. Raise the"
                " limit of force, or remove the constant load from the axis."
            )
    while high > (1.0 + _FILLED) * low:
        middle = 0.5 * (low + high)
        low, high = (middle, high) if share(middle) <= 1.0 else (low, middle)
    return low * x


def _worth(task: _Task, force: Float[Array, " time"]) -> Float[Array, " 2"]:
    """The criterion, and the largest deviation of the record by `uncertainty` in a number, relative to its range."""
    record, columns = sensitivities(task.axis, task.t, force)
    information = task.weight * columns.T @ columns + task.prior
    # Keeps a singular matrix from becoming indefinite by rounding.
    little = _DEFINITE * jnp.finfo(force.dtype).eps * jnp.diag(information) + 1.0 / _IGNORANCE**2
    deviation = task.uncertainty * columns / jnp.max(jnp.abs(record - record[0]))
    return jnp.stack([task.criterion(information + jnp.diag(little)), _largest(jnp.reshape(deviation, (1, -1)))[0]])


def _largest(x: Float[Array, "rows n"]) -> Float[Array, " rows"]:
    """Smooth largest magnitude of each row."""
    return jax.nn.logsumexp(_SHARP * jnp.concatenate([x, -x], axis=1), axis=1) / _SHARP


@eqx.filter_jit
def _judge(
    task: _Task, x: Float[Array, " weights"]
) -> tuple[Float[Array, ""], Float[Array, " weights"], Float[Array, " 4"], Float[Array, "4 weights"]]:
    """The criterion, and the shares of the limits of force, speed, travel and deviation, with their derivatives."""
    force, pull = jax.vjp(lambda x: feed_forward(task.axis, task.t, *task.motion(x)), x)

    def used(x: Array, force: Array) -> Array:
        return _largest(task.shares(x, force))

    (criterion, deviation), by_force = _worth(task, force), jax.jacrev(lambda force: _worth(task, force))(force)
    direct, through = jax.jacrev(used, argnums=(0, 1))(x, force)
    by_criterion, by_deviation, by_peak = jax.vmap(lambda row: pull(row)[0])(jnp.stack([*by_force, through[0]]))
    rows = jnp.concatenate([direct.at[0].add(by_peak), by_deviation[None]])
    return criterion, by_criterion, jnp.append(used(x, force), deviation), rows


def _merit(task: _Task, x: Float[np.ndarray, " weights"]) -> float:
    """The criterion, less a penalty of too large a deviation; scaling keeps the limits."""
    criterion, _, used, _ = _judge(task, jnp.asarray(x, float))
    return float(criterion) - _PRICE * max(float(used[3]) - _PRICED_FROM, 0.0)


def _improve(
    task: _Task,
    sines: list[np.ndarray],
    baseline: np.ndarray,
    seed: int,
    max_steps: int,
    progress: DesignProgress | None,
) -> tuple[Float[np.ndarray, " weights"], str]:
    """The best motion from the best of some random ones; the best sine if none is better."""
    # Weights in units of the largest sine of their frequency.
    lengths = np.tile([float(np.max(np.abs(x))) for x in sines], 2)
    rng = np.random.default_rng(seed)
    candidates = [_fill(task, lengths * rng.standard_normal(lengths.size)) for _ in range(_TRIED)]
    candidates.sort(key=lambda x: -_merit(task, x))
    best, best_merit, ending, count = baseline, _merit(task, baseline), "converged", 0
    for start in candidates[:_IMPROVED]:
        weights, how, count = _climb(task, start, lengths, max_steps, progress, count)
        filled = _fill(task, weights)
        merit = _merit(task, filled)
        if merit > best_merit:
            best, best_merit, ending = filled, merit, how
        if how.startswith("was interrupted"):
            return best, how
    return best, ending


def _climb(
    task: _Task, start: np.ndarray, lengths: np.ndarray, max_steps: int, progress: DesignProgress | None, count: int
) -> tuple[Float[np.ndarray, " weights"], str, int]:
    """Improve the criterion by SLSQP; returns also the ending and the number of iterations so far."""

    @lru_cache(maxsize=1)
    def judged_at(weights: bytes) -> list[np.ndarray]:
        judgement = [np.asarray(x, float) for x in _judge(task, jnp.asarray(lengths * np.frombuffer(weights), float))]
        if all(np.isfinite(x).all() for x in judgement):
            return judgement
        # Far beyond the limits the model is not finite: a bad value makes the line search turn back.
        return [np.full_like(x, _NOT_FINITE if i == 0 else 0.0) for i, x in enumerate(judgement)]

    def judged(y: np.ndarray) -> list[np.ndarray]:
        return judged_at(y.tobytes())

    from scipy import optimize  # slow to import, and only needed here

    latest = np.clip(start / lengths, -_WIDEST, _WIDEST)

    def report(y: np.ndarray) -> None:
        nonlocal latest, count
        count, criterion = count + 1, float(judged(y)[0])
        if criterion > _NOT_FINITE:
            latest = y.copy()
        if progress is not None:
            progress(count, criterion)

    limited = np.append(np.flatnonzero(np.asarray(task.inverse)), 3)
    within = {
        "type": "ineq",
        "fun": lambda y: 1.0 - judged(y)[2][limited],
        "jac": lambda y: -judged(y)[3][limited] * lengths,
    }
    try:
        optimum = optimize.minimize(
            lambda y: -float(judged(y)[0]),
            latest,
            jac=lambda y: -judged(y)[1] * lengths,
            method="SLSQP",
            # Far beyond the limits an axis is so sensitive that the criterion diverges.
            bounds=[(-_WIDEST, _WIDEST)] * latest.size,
            constraints=[within],
            callback=report,
            options={"maxiter": max_steps, "ftol": _FTOL},
        )
    except KeyboardInterrupt:
        return lengths * latest, "was interrupted", count
    ending = "converged" if optimum.success else f"stopped ({optimum.message})"
    return lengths * (optimum.x if judged(optimum.x)[0] > _NOT_FINITE else latest), ending, count


def _excitation(
    task: _Task, x: Float[np.ndarray, " weights"], names: tuple[str, ...], scale: Float[np.ndarray, " free"]
) -> Excitation:
    """A motion with its force, a run of the model, and the information in a record."""
    q_ref, qd_ref, force, q, qd, columns = (np.asarray(each, float) for each in _run(task, jnp.asarray(x, float)))
    information = columns.T @ columns
    whole = information + np.asarray(task.prior, float)
    silent, covariance = np.diag(whole) == 0, floored_inverse(whole, _LEAST)
    # Numbers without effect are not known at all.
    covariance[silent, :], covariance[:, silent] = 0.0, 0.0
    covariance[silent, silent] = np.inf
    errors = np.sqrt(np.diag(covariance)) * scale
    return Excitation(
        t=np.asarray(task.t, float),
        q_ref=q_ref,
        qd_ref=qd_ref,
        force=force,
        q=q,
        qd=qd,
        information=information,
        errors=dict(zip(names, errors.tolist(), strict=True)),
        correlation=correlation_of(covariance),
    )


@eqx.filter_jit
def _run(task: _Task, x: Float[Array, " weights"]) -> tuple[Array, ...]:
    """Reference, force, motion of the model and sensitivities."""
    axis, (q_ref, qd_ref) = task.axis, task.motion(x)
    force = feed_forward(axis, task.t, q_ref, qd_ref)
    return q_ref, qd_ref, force, *driven_motion(axis, task.t, force), sensitivities(axis, task.t, force)[1]
