"""Profile likelihood: the cost of the best fit with one parameter held at other values."""

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float
from scipy import special  # scipy.stats takes most of a second to import

from ..._core.arguments import as_share, as_whole
from ..._core.arrays import on_device
from ..estimate._problem import FitProblem, Prior
from ..estimate._search import SearchOptions, SearchResult, finished, linearised, solve
from ._estimate import BLOCKS, ROUNDING, ParameterEstimate, floored_inverse
from ._fit import searched_on
from ._result import FitResult

# Weight that holds the parameter, per standard error: it moves by a millionth of one.
_STIFF = 1e3
# How far to walk before an end is open: by this factor, or by so many sizes of a parameter of either sign.
_FAR_FACTOR, _FAR_SIZES = 1e4, 1e3
# A ratio of more thresholds than this at the next point is a jump.
_LEAP = 4.0
# Tolerance of the ratio at a point; largest tolerance, and most iterations, of a search.
_PRECISE, _LARGEST_RTOL, _ITERATIONS = 2e-3, 1e-4, 40
# Smallest and largest change of the step of the walk; tolerance of the end of an interval, as a share of the distance.
_SHORTER, _LONGER, _CLOSE = 0.3, 3.0, 1e-2
# The search continues from a point that fits better than the estimate by this share of the threshold.
_BELOW = 0.1
# Scatter over blocks below this share of the residual's variance is chance.
_LEAST_INFLATION = 0.5
# Unit of the walk without a standard error, as a share of the value.
_UNKNOWN_UNIT = 0.1


@dataclass(frozen=True, kw_only=True)
class Profile:
    """The likelihood along one parameter, all others fitted again at each of its values.

    - `name`, `unit`: of the parameter. `estimate`, `error`: as the fit gave them.
    - `values`: of the parameter, increasing, shape `[points]`.
    - `ratio`: increase of the sum of losses over that at the estimate, relative to the increase at one standard error
      of the covariance; shape `[points]`. For a linear model it is `((value - estimate)/error)^2`. It is twice the
      logarithm of the likelihood ratio with the estimated variance of the residual, divided by the ratio of
      `covariance` to `white` (at least 1/2), which accounts for correlation.
    - `cost`: half the sum of losses in noise levels, shape `[points]`.
    - `floor`: the number that the parameter must lie above, which is then walked in the logarithm; None for others.
    - `level`, `threshold`: of the interval, and the ratio at its ends: the quantile of F with 1 and 15 degrees of
      freedom (blocks of samples less one), the square of Student's t in the intervals of the estimate.
    - `interval`: where the ratio is below the threshold; infinite or on a limit if the record sets no end.
    - `notes`: reasons for open ends, in words.
    - `others`: the other parameters along it by name, shape `[points]` each.
    - `result`: the fit of this profile: the argument, or a better one that was reached from it.
    """

    name: str
    unit: str
    estimate: float
    error: float
    floor: float | None
    level: float
    threshold: float
    values: Float[np.ndarray, " points"]
    ratio: Float[np.ndarray, " points"]
    cost: Float[np.ndarray, " points"]
    interval: tuple[float, float]
    notes: tuple[str, ...]
    others: dict[str, Float[np.ndarray, " points"]]
    result: FitResult

    def __str__(self) -> str:
        """The interval and the reasons for open ends."""
        low, high = self.interval
        width = min(abs(self.estimate - low), abs(high - self.estimate))
        # Two digits of the width of the interval.
        share = width / abs(self.estimate) if self.estimate and math.isfinite(width) else 1.0
        digits = min(max(6, 2 - math.floor(math.log10(max(share, 1e-15)))), 16)
        head = (
            f"{self.name} = {self.estimate:.{digits}g} {self.unit or '(no unit)'}, {100 * self.level:g} % interval by"
            f" the profile likelihood {low:.{digits}g} to {high:.{digits}g}"
        )
        return "\n".join([head, *self.notes])


class _Point(NamedTuple):
    """A value of the parameter in the coordinate of the walk, x of the best fit there, its ratio and cost."""

    u: float
    x: np.ndarray
    ratio: float
    cost: float


class _End(NamedTuple):
    """The points of one side, away from the estimate, the coordinate of its end and the reason for an open one."""

    points: list[_Point]
    u: float
    note: str


@dataclass(frozen=True)
class _Line:
    """One parameter and the coordinate `u` of the walk: its logarithm if it must be positive.

    - `unit`: standard error in u, or a guess.
    - `inflation`: increase of the sum of losses at one standard error.
    - `reach`: how far to walk in u; `limits`: of u.
    - `best`: cost of the fit. `known`: mean and weight of the prior.
    """

    name: str
    problem: FitProblem
    index: int
    floor: float | None
    unit: float
    reach: float
    limits: tuple[float, float]
    inflation: float
    best: float
    known: tuple[float, float]

    def value(self, u: float) -> float:
        return u if self.floor is None else self.floor + math.exp(u)

    def coordinate(self, value: float) -> float:
        return value if self.floor is None else math.log(value - self.floor)

    def cost(self, residual: np.ndarray, value: float) -> float:
        """Cost without the row that holds the parameter, and with its prior."""
        rows = np.array(residual)
        rows[self.problem.samples + self.index] = self.known[1] * (value - self.known[0])
        return float(self.problem.loss.cost(on_device(rows)))

    def refit(self, u: float, guess: np.ndarray) -> _Point | None:
        """The best fit with the parameter at u; None if the model is not finite."""
        problem, i = self.problem, self.index
        value = self.value(u)
        slope = 1.0 if self.floor is None else value - self.floor
        dtype = problem.prior.mean.dtype
        mean, weight = np.array(problem.prior.mean), np.array(problem.prior.weight)
        mean[i], weight[i] = value, _STIFF / (self.unit * slope)
        held = eqx.tree_at(lambda p: p.prior, problem, Prior(on_device(mean), on_device(weight)))
        size = len(problem.free.names)
        here = problem.at(on_device(guess))
        here = problem.free.at(np.clip(guess[:size], here.lower, here.upper))
        x = np.array(guess, dtype)
        x[:size] = problem.free.coordinates({**here.values, self.name: value})
        rtol = min(_PRECISE * self.inflation / max(self.best, 1e-300), _LARGEST_RTOL)
        try:
            state = finished(solve(held, on_device(x), SearchOptions(rtol, _ITERATIONS))).state
        except RuntimeError:
            return None
        cost = self.cost(np.asarray(state.residual), value)
        return _Point(u, np.asarray(state.x), 2 * (cost - self.best) / self.inflation, cost)


def profile(result: FitResult, name: str, *, points: int = 6, level: float = 0.95, max_steps: int = 400) -> Profile:
    """Profile likelihood of one parameter: all others, and free initial states, are fitted again at each value.

    Unlike the intervals of the estimate it holds for models far from linear, and shows open intervals. It walks both
    ways from the estimate, in the logarithm of a parameter that must be positive, until the fit is worse than the level
    allows. The noise levels stay fixed. It costs a few evaluations a point, and compiles nothing.

    If a value fits better than the estimate, the search had ended too early, or in a worse minimum. It continues from
    there with all parameters, and the profile is that of its end, `Profile.result`; the notes report it.

    **Arguments:**

    - `result`: a fit that was not loaded from a file.
    - `name`: of a free parameter that is no initial state.
    - `points`: approximate number on either side, at least 2.
    - `level`: of the interval, between 0 and 1.
    - `max_steps`: limit of all iterations of searches that continue from better values.

    **Returns:**

    A `Profile`, drawn by `jaxmodsim.plot.profile_figure`.

    **Raises:**

    - `ValueError` for another name or level, or of a result that was loaded.
    """
    names = result.search_for("A profile").problem.free.names
    if name not in names:
        raise ValueError(f"{name!r} has no profile; the parameters that have one are: {', '.join(names)}.")
    level, points = as_share(level, name="level"), as_whole(points, name="points", least=2)
    limit = as_whole(max_steps, name="max_steps", least=0)
    first, left, times = result, limit, 0
    while isinstance(curve := _along(result, name, points, level, improve=left > 0), _Point):
        times += 1
        before = result.search_for("A profile")
        x = on_device(curve.x)
        result = searched_on(result, x, SearchOptions(max_steps=left), times, f"from a better value of {name}")
        left = max(left - result.search_for("A profile").iterations + before.iterations, 0)
    notes = list(curve.notes)
    if times:
        fell = ", ".join(f"{x:.6g} to {result.diagnostics.rmse[k]:.6g}" for k, x in first.diagnostics.rmse.items())
        notes.append(
            f"A value of {name} fitted better than the estimate: {'one search' if times == 1 else f'{times} searches'}"
            f" continued from there in {limit - left} iterations, and the RMSE fell from {fell}."
        )
    if np.min(curve.ratio) < -_BELOW * curve.threshold:
        notes.append(
            f"Some value of {name} fits better than the estimate, but the limit of {limit} iterations (max_steps) of"
            " searches that continue from there is reached."
        )
    return replace(curve, notes=tuple(notes))


def _along(result: FitResult, name: str, points: int, level: float, *, improve: bool) -> Profile | _Point:
    """The profile of a fit; with `improve`, the first point that fits clearly better instead, if there is one."""
    threshold = float(special.fdtri(1, BLOCKS - 1, level))
    least = -_BELOW * threshold if improve else -math.inf
    search = result.search_for("A profile")
    line, tangent = _line_of(result.estimate, search, name)
    estimate, names = result.values[name], search.problem.free.names
    start = _Point(line.coordinate(estimate), np.asarray(search.state.x), 0.0, line.best)
    sides = []
    for side in (-1.0, 1.0):
        sides.append(_walk(line, start, tangent, side, threshold, points, least))
        lowest = min([start, *sides[-1].points], key=lambda point: point.ratio)
        if lowest.ratio < least:
            return lowest
    down, up = sides
    path = [*reversed(down.points), start, *up.points]
    others = [line.problem.at(on_device(point.x)).values for point in path]
    ends = [end.u if math.isinf(end.u) else line.value(end.u) for end in (down, up)]
    if line.floor is not None and math.isinf(ends[0]):
        ends[0] = line.floor
    return Profile(
        name=name,
        unit=result.estimate.units[name],
        estimate=estimate,
        error=result.errors[name],
        floor=line.floor,
        level=level,
        threshold=threshold,
        values=np.array([line.value(point.u) for point in path]),
        ratio=np.array([point.ratio for point in path]),
        cost=np.array([point.cost for point in path]),
        interval=(ends[0], ends[1]),
        notes=tuple(end.note for end in (down, up) if end.note),
        others={k: np.array([float(values[k]) for values in others]) for k in names if k != name},
        result=result,
    )


def _line_of(estimate: ParameterEstimate, search: SearchResult, name: str) -> tuple[_Line, np.ndarray]:
    """The line, and the derivative of the best x by the parameter in the linear model."""
    problem, state = search.problem, search.state
    i = problem.free.names.index(name)
    value, error = estimate.values[name], estimate.errors[name]
    slopes = problem.slopes_at(state.x)[i]
    residual, jacobian = linearised(problem, state)
    rounding = ROUNDING * float(np.finfo(jacobian.dtype).eps)
    sensitivity = floored_inverse(jacobian.astype(float).T @ jacobian, rounding) @ slopes
    by_losses = float(slopes @ sensitivity)
    counted = float(np.sum(problem.weights > 0))
    variance = float(np.sum(residual[: problem.samples] ** 2)) / max(counted - state.x.shape[0], 1)
    # One standard error costs error^2 / by_losses: the variance, for white residuals. If one block of samples
    # determines the parameter, the scatter over blocks may be small by chance, so half the variance is the least.
    inflation = error**2 / by_losses if by_losses > 0 else math.nan
    inflation = max(inflation, _LEAST_INFLATION * variance) if math.isfinite(inflation) else variance
    inflation = max(inflation, 1e-300)
    floor, limits = None, problem.free[name].fixed_limits
    if name in estimate.logarithmic:
        floor = limits[0]
    size_of = abs(value) if floor is None else value - floor
    unit = error if math.isfinite(error) and error > 0 else _UNKNOWN_UNIT * (size_of or 1.0)
    if floor is None:
        reach = _FAR_SIZES * max(abs(value), unit)
        unit = min(unit, reach / _FAR_SIZES)
    else:
        unit, reach = min(unit / size_of, 1.0), math.log(_FAR_FACTOR)
        limits = (-math.inf, math.log(limits[1] - floor) if math.isfinite(limits[1]) else math.inf)
    known = float(problem.prior.mean[i]), float(problem.prior.weight[i])
    line = _Line(name, problem, i, floor, unit, reach, limits, inflation, 0.0, known)
    line = replace(line, best=line.cost(np.asarray(state.residual), value))
    return line, sensitivity / by_losses * (1.0 if floor is None else size_of)


def _walk(
    line: _Line, start: _Point, tangent: np.ndarray, side: float, threshold: float, points: int, least: float
) -> _End:
    """Walk away from the estimate until the ratio reaches the threshold, a limit or the reach.

    A ratio below `least` also ends the walk: there is a better fit.
    """
    aim = math.sqrt(threshold) / points
    pace, slope, path = aim * line.unit, tangent, [start]
    limit = line.limits[0] if side < 0 else line.limits[1]
    word = "lower" if side < 0 else "upper"
    while len(path) <= 6 * points:
        last = path[-1]
        if side * (limit - last.u) <= 0:
            return _End(path[1:], last.u, f"{line.name} reaches its limit {line.value(limit):g} within this interval.")
        if abs(last.u - start.u) >= line.reach:
            text = f"{line.name} has no {word} limit from this record"
            return _End(
                path[1:], side * math.inf, f"{text}: as far as {line.value(last.u):.3g} nothing speaks against."
            )
        u = start.u + side * min(abs(last.u + side * pace - start.u), line.reach)
        u = limit if side * (limit - u) < 0 else u
        point = _try(line, u, last, slope)
        if point is not None and point.ratio > _LEAP * threshold:
            # A jump may be a failed search from a guess too far away.
            again = line.refit(point.u, last.x)
            point = point if again is None or again.ratio > point.ratio else again
        if point is None:
            text = f"The model cannot be run with {line.name} much beyond {line.value(last.u):.4g}: its {word} limit"
            return _End(path[1:], side * math.inf, f"{text} is not known.")
        path.append(point)
        if point.ratio < least:
            return _End(path[1:], point.u, "")
        if point.ratio > threshold:
            inside, crossing = _crossing(line, last, point, threshold)
            path[-1:] = [*inside, point] if inside else [point]
            return _End(sorted(path[1:], key=lambda p: side * p.u), crossing, "")
        grown = _root(point) - _root(last)
        pace *= min(max(aim / grown, _SHORTER), _LONGER) if grown > 0 else _LONGER
        slope = (point.x - last.x) / (point.u - last.u)
    text = f"{line.name} has no {word} limit from this record as far as {line.value(path[-1].u):.4g}"
    return _End(path[1:], side * math.inf, f"{text}, where the walk ended.")


def _try(line: _Line, u: float, last: _Point, slope: np.ndarray) -> _Point | None:
    """A point at u, or nearer to the last one if the model is not finite there."""
    for _ in range(5):
        for guess in (last.x + slope * (u - last.u), last.x):
            point = line.refit(u, guess)
            if point is not None:
                return point
        u = last.u + 0.3 * (u - last.u)
    return None


def _root(point: _Point) -> float:
    return math.sqrt(max(point.ratio, 0.0))


def _crossing(line: _Line, inner: _Point, outer: _Point, threshold: float) -> tuple[list[_Point], float]:
    """Points between two on either side of the threshold, and the coordinate where the ratio crosses it.

    The root of the ratio is interpolated, since it is linear for a linear model.
    """
    wanted, added = math.sqrt(threshold), []

    def between(a: _Point, b: _Point) -> float:
        return a.u + (b.u - a.u) * (wanted - _root(a)) / (_root(b) - _root(a))

    for k in range(4):
        u = between(inner, outer) if k < 3 else 0.5 * (inner.u + outer.u)
        share = (u - inner.u) / (outer.u - inner.u) if outer.ratio < _LEAP * threshold else 0.0
        point = line.refit(u, inner.x + share * (outer.x - inner.x))
        if point is None:
            break
        added.append(point)
        if point.ratio > threshold:
            outer = point
        else:
            inner = point
        if abs(_root(point) - wanted) < _CLOSE * wanted:
            break
    return added, between(inner, outer)
