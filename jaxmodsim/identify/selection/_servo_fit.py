"""`fit_servo`: a servo from several records, judged by records that are left out, and its predictions with a band."""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path

import jax
import numpy as np
from jaxtyping import Float

from ..._core.arguments import as_share, axis_unit
from ..._core.arrays import on_device
from ..._core.system import jsonable
from ...scene import replace_numbers, scene_numbers, scene_ranges
from ..data._record import SINGLE, Record, cut, runs_of
from ..estimate._problem import FitProblem, Prior, SquaredLoss
from ..estimate._search import SearchOptions, SearchResult, channels_seen, solve
from ..model._parameters import FreeParameters
from ..model._servo import SERVO_LAWS, Servo, ServoEngine, servo_windows
from ..uncertainty._estimate import correlated
from ..uncertainty._fit import result_of
from ..uncertainty._result import FitResult

# Scale of the error of a model [rad], and number of independent samples in all records: they weigh the prior.
_ERROR, _INDEPENDENT = 0.02, 16.0
# Standard deviation of the prior around the start values, as a share of them; of an angle [rad].
_PRIOR, _PRIOR_ANGLE = 0.5, 0.05
# Limits where they are narrower than those of the law.
_LIMITS = {
    "kt": (0.02, 3.0), "R": (0.1, 60.0), "armature": (1e-5, 0.1), "gear.vs": (0.01, 10.0), "gear.alpha": (0.2, 5.0),
}  # fmt: skip
# Length of the windows of the first search [s]; iterations and tolerance of both searches.
_WINDOW, _MOST, _RTOL = 0.42, 40, 2e-3
# Error of a band [rad] before its factor, and shares of the travel that it may take as an error.
_LEAST, _SHARES = 0.01, (0.05, 0.1)
# Median absolute deviation of a normal distribution, in standard deviations.
_MAD = 0.6745
# Share of the standard deviation of the prior above which an error is that of the prior; correlation that is reported.
_VAGUE, _TOGETHER = 0.5, 0.9
_KIND = "jaxmodsim servo fit"
# Fields that are saved as they are.
_SAVED = ("law", "members", "left_out", "fitted", "band", "evaluations", "prior", "from_duty")

Numbers = dict[str, float]
PriorNumbers = Mapping[str, tuple[float, float]]


@dataclass(frozen=True, kw_only=True)
class ServoFit:
    """A servo fitted to records, and the same fit without each group of them.

    - `law`: one of `SERVO_LAWS`. `result`: the fit to all records; None if it was loaded.
    - `model`: the servo with the fitted numbers. `members`: numbers of the fits without one group each, by group.
    - `left_out`, `fitted`: mean absolute error [rad] of each record of a group that was left out, and of the fit to
      all, by group and by record.
    - `band`: the half width of a band is `factor sqrt(least^2 + spread^2 + (share travel)^2)` at the level `level`.
    - `evaluations`: number of evaluations of the gradient, by fit.
    - `prior`: mean and standard deviation of each parameter. `from_duty`: whether the records have the measured duty.
    """

    law: str
    model: Servo
    members: dict[str, Numbers]
    left_out: dict[str, dict[str, float]]
    fitted: dict[str, float]
    band: dict[str, float]
    evaluations: dict[str, int]
    prior: dict[str, tuple[float, float]]
    from_duty: bool
    result: FitResult | None = None

    @property
    def left_out_error(self) -> float:
        """Mean absolute error [rad] of the records that were left out, each group weighing alike."""
        return float(np.mean([np.mean(list(group.values())) for group in self.left_out.values()]))

    @property
    def warnings(self) -> tuple[str, ...]:
        """Sentences on parameters that the records do not determine; none for a loaded fit."""
        if self.result is None:
            return ()
        errors, values = self.result.errors, self.result.values
        vague = [name for name, x in values.items() if not errors[name] < _VAGUE * self.prior[name][1]]
        pairs = correlated(list(values), self.result.estimate.correlation, _TOGETHER)
        lines = []
        if vague:
            lines.append(f"The records hardly determine {', '.join(vague)}: their errors are those of the prior.")
        if pairs:
            named = ", ".join(f"{a} and {b} ({c:+.2f})" for a, b, c in pairs)
            lines.append(f"Correlated, so that only combinations are determined: {named}.")
        apart = {name: np.ptp([own[name] for own in self.members.values()]) / abs(values[name]) for name in ("kt", "R")}
        lines.append(
            f"kt and R depend on the friction law: without one group of records kt changes by"
            f" {100 * apart['kt']:.0f} % and R by {100 * apart['R']:.0f} %. State those of a data sheet as a prior."
        )
        return tuple(lines)

    def to_dict(self) -> dict[str, object]:
        """Everything except the samples, in types of JSON."""
        numbers = {name: float(x) for name, x in scene_numbers(self.model).items()}
        fit = None if self.result is None else self.result.to_dict()
        return jsonable({"kind": _KIND, "numbers": numbers, "fit": fit, **{x: getattr(self, x) for x in _SAVED}})

    @staticmethod
    def load(path: str | PathLike[str]) -> "ServoFit":
        """The fit of a JSON file that holds `to_dict`, alone or as its entry `servo`.

        **Raises:**

        - `ValueError` for another file.
        """
        try:
            body = json.loads(Path(path).read_text("utf-8"))
        except ValueError as error:
            raise ValueError(f"{path} is no JSON file: {error}") from error
        body = body.get("servo", body) if isinstance(body, dict) else {}
        if body.get("kind") != _KIND:
            raise ValueError(f"{path} is no fit of a servo: its kind is not {_KIND!r}.")
        numbers = body["numbers"]
        model = Servo.start(body["law"], numbers["inertia"], numbers["gravity"])
        model = replace_numbers(model, {name: on_device(np.asarray(x, float)) for name, x in numbers.items()})
        saved = {name: body[name] for name in _SAVED}
        saved["prior"] = {name: (float(mean), float(deviation)) for name, (mean, deviation) in saved["prior"].items()}
        return ServoFit(model=model, **saved)


@dataclass(frozen=True, kw_only=True)
class ServoPrediction:
    """Angle of a servo with a band for the share `level` of its samples, shape `[samples]` each [rad].

    - `record`: the record. `q`, `lower`, `upper`: prediction and band.
    """

    record: Record
    q: Float[np.ndarray, " samples"]
    lower: Float[np.ndarray, " samples"]
    upper: Float[np.ndarray, " samples"]
    level: float

    @property
    def error(self) -> float:
        """Mean absolute error [rad] where the record has the measured angle."""
        return float(np.mean(np.abs(self.q - self.record.measured)))

    @property
    def half_band(self) -> float:
        """Mean half width of the band [rad]."""
        return float(np.mean(0.5 * (self.upper - self.lower)))

    @property
    def inside(self) -> float:
        """Share of the measured samples in the band."""
        return float(np.mean((self.lower <= self.record.measured) & (self.record.measured <= self.upper)))


def fit_servo(
    records: Sequence[Record],
    law: str = "MQ",
    *,
    inertia: float,
    gravity: float,
    groups: Mapping[str, Sequence[str]] | None = None,
    prior: PriorNumbers | None = None,
    level: float = 0.9,
    progress: Callable[[str], None] | None = None,
) -> ServoFit:
    """Fit a servo with a pendulum to records in open loop, then again without each group of records.

    The first search runs in overlapping windows of 0.4 s, which has few local minima, the second over whole records.

    **Arguments:**

    - `records`: from `servo_record`, all with `kp` or all with `duty`.
    - `law`: one of `SERVO_LAWS`.
    - `inertia`: of the pendulum [kg m^2]. `gravity`: its torque at a right angle [N m].
    - `groups`: names of records that are left out together, by the name of the group; by default each record alone.
      A group of all records is not left out.
    - `prior`: mean and standard deviation by name, such as those of a data sheet: `{"kt": (0.37, 0.05)}`.
    - `level`: share of the samples in a band, 0 < level < 1.
    - `progress`: called with the name of each fit that begins.

    **Returns:**

    A `ServoFit`.

    **Raises:**

    - `ValueError` for an unknown law or record, fewer than two records, or no group of some of them.
    """
    if law not in SERVO_LAWS:
        raise ValueError(f"law must be one of {', '.join(SERVO_LAWS)}, but {law!r} was given.")
    records, level = tuple(records), as_share(level, name="level")
    names = [record.name for record in records]
    groups = {name: (name,) for name in names} if groups is None else {k: tuple(v) for k, v in groups.items()}
    unknown = [name for group in groups.values() for name in group if name not in names]
    if unknown:
        raise ValueError(f"groups names {unknown[0]!r}, but the records are: {', '.join(names)}.")
    if len(records) < 2:
        raise ValueError("fit_servo needs two records at least, since it leaves out one after the other.")
    groups = {name: group for name, group in groups.items() if group and not set(names) <= set(group)}
    if not groups:
        raise ValueError("groups needs a group of some of the records, but every group given has none or all of them.")
    start = Servo.start(law, inertia, gravity)
    whole = _problem(start, law, records, prior or {})
    parts = [servo_windows(record, _WINDOW) for record in records]
    owner = np.repeat(np.arange(len(records)), [len(own) for own in parts])
    first = _problem(start, law, tuple(window for own in parts for window in own), prior or {})
    measured, counts = np.asarray(whole.runs.measured[SINGLE]), np.asarray(whole.runs.weight[SINGLE]) > 0
    evaluations: dict[str, int] = {}

    def search(name: str, keep: np.ndarray) -> SearchResult:
        if progress is not None:
            progress(name)
        some = first.counting(np.broadcast_to(keep[owner][:, None], first.runs.t.shape), slips=False)
        one = solve(some, some.x0, SearchOptions(_RTOL, _MOST))
        rest = whole.counting(np.broadcast_to(keep[:, None], whole.runs.t.shape), slips=False)
        two = solve(rest, one.state.x, SearchOptions(_RTOL, _MOST))
        evaluations[name] = one.iterations + two.iterations
        return two

    def error(angles: np.ndarray, i: int | np.integer) -> float:
        return float(np.mean(np.abs(angles[i] - measured[i])[counts[i]]))

    everything = search("all records", np.ones(len(records), bool))
    members, without, left_out = {}, [], {}
    for name, group in groups.items():
        out = np.isin(names, group)
        x = search(f"without {name}", ~out).state.x
        members[name] = {k: float(v) for k, v in whole.at(x).values.items()}
        angles = np.asarray(channels_seen(whole, x)[SINGLE])
        without.append((np.flatnonzero(out), angles))
        left_out[name] = {names[i]: error(angles, i) for i in np.flatnonzero(out)}
    x = everything.state.x
    model, centre = replace_numbers(start, dict(whole.at(x).values)), np.asarray(channels_seen(whole, x)[SINGLE])
    units = {name: axis_unit(allowed.unit, True) for name, allowed in scene_ranges(start).items()}
    return ServoFit(
        law=law, model=model, members=members, left_out=left_out,
        fitted={names[i]: error(centre, i) for i in range(len(records))},
        band=_calibrated(centre, without, measured, counts, level),
        evaluations=evaluations, prior=_priors(start, law, prior or {}), from_duty="duty" in records[0].inputs,
        result=result_of(everything, records, cut(records, None), units, model),
    )  # fmt: skip


def predict_servo(fit: ServoFit, record: Record) -> ServoPrediction:
    """The angle of a fitted servo for a record of commands, with a band.

    **Arguments:**

    - `fit`: from `fit_servo` or `ServoFit.load`.
    - `record`: from `servo_record`, with or without the measured angle.

    **Returns:**

    A `ServoPrediction`.
    """
    run = jax.tree.map(lambda x: x[0], runs_of((record,), cut((record,), None)))
    engine = jax.jit(lambda values: ServoEngine(fit.model)(values, None, run).channels[SINGLE])
    numbers = scene_numbers(fit.model)
    q = np.asarray(engine({name: numbers[name] for name in Servo.free(fit.law)}))
    members = [
        np.asarray(engine({k: on_device(np.asarray(v, float)) for k, v in member.items()}))
        for member in fit.members.values()
    ]
    half = _half(fit.band, _spread(q, np.stack(members)), q)
    return ServoPrediction(record=record, q=q, lower=q - half, upper=q + half, level=fit.band["level"])


def _spread(q: np.ndarray, members: np.ndarray) -> np.ndarray:
    """Standard deviation of the fits without one group around the fit to all, robust against single ones."""
    return np.median(np.abs(members - q), axis=0) / _MAD


def _half(band: Mapping[str, float], spread: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Half width of the band; the travel is the largest distance from the start so far."""
    travel = np.maximum.accumulate(np.abs(q - q[..., :1]), axis=-1)
    return band["factor"] * np.sqrt(band["least"] ** 2 + spread**2 + (band["share"] * travel) ** 2)


def _calibrated(
    centre: np.ndarray,
    without: list[tuple[np.ndarray, np.ndarray]],
    measured: np.ndarray,
    counts: np.ndarray,
    level: float,
) -> dict[str, float]:
    """The narrowest band that holds the share `level` of the samples of records that were left out.

    Each record weighs alike. `centre`: angles of the fit to all records. `without`: for each group the records that
    were left out, and the angles of the fit without them.
    """
    spread = _spread(centre, np.stack([angles for _, angles in without]))
    errors = [(i, np.abs(angles[i] - measured[i])[counts[i]]) for out, angles in without for i in out]
    bands = []
    for share in _SHARES:
        unit = _half({"factor": 1.0, "least": _LEAST, "share": share}, spread, centre)
        units = [unit[i][counts[i]] for i, _ in errors]
        ratios = [error / own for (_, error), own in zip(errors, units, strict=True)]
        weights = np.concatenate([np.full(x.size, 1.0 / x.size) for x in ratios])
        factor = float(np.quantile(np.concatenate(ratios), level, weights=weights, method="inverted_cdf"))
        width = float(np.mean([np.mean(factor * own) for own in units]))
        bands.append({"level": level, "factor": factor, "least": _LEAST, "share": share, "mean": width})
    return min(bands, key=lambda band: band["mean"])


def _problem(start: Servo, law: str, records: tuple[Record, ...], prior: PriorNumbers) -> FitProblem:
    """The problem of a fit of these records, with the noise of `_INDEPENDENT` samples."""
    numbers, ranges, names = scene_numbers(start), dict(scene_ranges(start)), Servo.free(law)
    for name in names:
        low, high = _LIMITS.get(name, (ranges[name].lower, ranges[name].upper))
        ranges[name] = replace(ranges[name], lower=low, upper=high, strict=low is not None)
    free = FreeParameters.of(numbers, ranges, names)
    runs = runs_of(records, cut(records, None))
    samples = float(np.sum(np.asarray(runs.weight[SINGLE])))
    noise = on_device(np.asarray(_ERROR * np.sqrt(samples / _INDEPENDENT)))
    return FitProblem(
        ServoEngine(start), free, (), None, runs, {SINGLE: noise}, SquaredLoss(),
        Prior.of(_priors(start, law, prior), names),
    )  # fmt: skip


def _priors(start: Servo, law: str, prior: PriorNumbers) -> dict[str, tuple[float, float]]:
    """Mean and standard deviation of each free parameter."""
    numbers = {name: float(scene_numbers(start)[name]) for name in Servo.free(law)}
    own = {name: (x, _PRIOR_ANGLE if name == "tilt" else _PRIOR * x) for name, x in numbers.items()}
    return own | {name: (float(mean), float(deviation)) for name, (mean, deviation) in prior.items()}
