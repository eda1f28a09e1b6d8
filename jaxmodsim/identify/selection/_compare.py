"""`compare`: several models fitted to the same records and ranked by held-out error."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ..._core.arguments import as_whole
from ..._core.arrays import on_device
from ..._core.parameters import ranges_of
from ..._core.progress import candidate_words, reported
from ...friction import AbstractLaw
from ...scene import Scene, State, scene_numbers
from ..data._record import Record, Runs, cut, runs_of
from ..estimate._initializers import AbstractInitializer, Continuation, FromSmaller, as_initializers, last_part
from ..estimate._prepare import FitOptions, StartState, initial_states, measured_start, prepare, prepare_law
from ..estimate._problem import AbstractLoss, FitProblem
from ..estimate._search import SearchOptions, SearchResult, SearchState, finished, solve, state_at
from ..model._engines import DELAY
from ..model._observe import Observable, by_channel, first_coordinate
from ..model._parameters import split_entries
from ..uncertainty._fit import fitted
from ..uncertainty._result import FitResult
from ._comparison import ENOUGH, Comparison, CrossValidated, Part, comparison_of
from ._evaluation import begin, check_lengths, opening, sample_counts, shown_starts

# Called after each iteration with the name of the model, the number of the held-out fold (None: the fit to everything),
# the number of the iteration and the root mean square of the residual.
CompareProgress: TypeAlias = Callable[[str, int | None, int, float], None]


@dataclass(frozen=True)
class Candidate:
    """A model for `compare`.

    **Arguments:**

    - `scene`: a scene or a friction law, with start values.
    - `free`: names of the numbers to fit, as for `fit`; for a law those of `fit_law`, None for its default.
    - `description`: for tables.
    """

    scene: Scene | AbstractLaw
    free: Sequence[str] | None
    description: str = ""


@dataclass(frozen=True, kw_only=True)
class CompareOptions:
    """The arguments of `compare` that are the same for all candidates; see there."""

    records: tuple[Record, ...]
    hold_out: tuple[Record, ...]
    folds: int
    fit: FitOptions
    initializers: tuple[AbstractInitializer, ...]
    max_steps: int

    def fit_of(self, scene: Scene, **starts: StartState) -> FitOptions:
        """The options of a fit of this scene, with the limits of its numbers."""
        names = _names(scene, self.records)
        # The limit of friction.Fs/friction.Fc is one of friction.Fs.
        limits = {name: each for name, each in self.fit.limits.items() if name.partition("/")[0] in names}
        return replace(self.fit, limits=limits, **starts)

    @property
    def windows(self) -> tuple[Record, ...]:
        """All records cut into their windows, as many as there are folds each."""
        spans = [float(record.t[-1] - record.t[0]) for record in self.records]
        return tuple(
            x for record, span in zip(self.records, spans, strict=True) for x in record.windows(span / self.folds)
        )


def compare(
    candidates: Mapping[str, Candidate | AbstractLaw],
    records: Record | Sequence[Record],
    *,
    folds: int = 4,
    hold_out: Record | Sequence[Record] = (),
    observe: Observable | Mapping[str, Observable] = first_coordinate,
    q0: StartState | None = None,
    qd0: StartState | None = None,
    limits: Mapping[str, tuple[float | None, float | None]] | None = None,
    loss: AbstractLoss | None = None,
    initializer: AbstractInitializer | Sequence[AbstractInitializer] = (),
    substeps: int = 1,
    max_steps: int = 400,
    progress: bool | CompareProgress = False,
) -> Comparison:
    """Fit several models to the same records, and rank them by held-out error.

    Each record is cut into `folds` windows. In turn one window of each record is held out: the model is fitted to the
    others, then run over the held-out window with these parameters. Every window starts from a state that its first
    samples show: 20, or as many more as show the velocity to 0.2 % of the speed of the record, at most a twentieth. The
    error is that of the other samples. The error with a start fitted to all samples is reported beside it, for
    information. The states of friction laws at the start of a window are those of the fit to whole records. With
    `hold_out` the model is fitted to `records`, and run over the whole of each held-out record in the same way.

    Friction laws are fitted to a measured force under a measured motion, as by `fit_law`. They run through whole
    records, from rest and unloaded, but the samples of the held-out window do not count in the fit.

    Models are fitted in the order of their numbers of parameters. Each starts also from the end of the largest earlier
    one whose parameters, by the last part of their names, it has all, so that it does not fit worse than its part.

    **Arguments:**

    - `candidates`: the models by name, all of scenes or all of laws; a law alone is `Candidate(law, None)`.
    - `records`: a record or several, as for `fit` or `fit_law`.
    - `folds`: windows of each record, >= 2; of a record in `hold_out` the parts from which the standard error comes.
    - `hold_out`: records that are only used for the held-out error; `records` are then not cut.
    - `observe`, `q0`, `qd0`, `loss`, `substeps`, `max_steps`: see `fit`.
    - `limits`, `initializer`: see `fit`; a limit of, or a `Continuation` in, a number that a candidate does not have is
      ignored for it.
    - `progress`: True for a line of text, or a function that is called after each iteration with the model's name,
      the held-out fold (None: the fit to everything), the iteration and the RMSE. Ctrl-C ends the comparison with the
      finished models.

    Laws use `folds`, `loss`, `initializer`, `max_steps` and `progress` alone.

    **Returns:**

    A `Comparison`. A model whose fit fails stays in it with the reason.

    **Raises:**

    - `ValueError` for fewer than two folds, parts that are too short, no candidates, laws beside scenes, laws with an
      argument for scenes, limits that no candidate has, and as `fit` does.
    """
    options = CompareOptions(
        records=(records,) if isinstance(records, Record) else tuple(records),
        hold_out=(hold_out,) if isinstance(hold_out, Record) else tuple(hold_out),
        folds=as_whole(folds, name="folds", least=2),
        fit=FitOptions(observe=observe, q0=q0, qd0=qd0, limits=limits, loss=loss, substeps=substeps),
        initializers=as_initializers(initializer),
        max_steps=as_whole(max_steps, name="max_steps"),
    )
    models = {name: x if isinstance(x, Candidate) else Candidate(x, None) for name, x in candidates.items()}
    laws = [name for name, each in models.items() if isinstance(each.scene, AbstractLaw)]
    if laws:
        for_scenes = {
            "hold_out": bool(options.hold_out), "observe": observe is not first_coordinate, "q0": q0 is not None,
            "qd0": qd0 is not None, "limits": limits is not None, "substeps": options.fit.substeps != 1,
        }  # fmt: skip
        if given := [name for name, is_given in for_scenes.items() if is_given]:
            raise ValueError(f"{laws[0]} is a friction law, but {given[0]} is for scenes: leave it out.")
        if others := [name for name in models if name not in laws]:
            raise ValueError(f"{laws[0]} is a friction law, but {others[0]} is none: compare laws or scenes, not both.")
    else:
        _check_scenes(models, options)
    sizes = {name: len(ranges_of(each.scene) if laws else each.free or ()) for name, each in models.items()}
    if not models:
        raise ValueError("There must be one candidate at least.")
    order = sorted(models, key=lambda name: sizes[name])
    judged: dict[str, CrossValidated] = {}
    failures: dict[str, str] = {}
    with reported(progress, "compare", candidate_words) as report:
        for name in order:
            try:
                judged[name] = _validated(options, name, models[name], report, judged)
            except KeyboardInterrupt:
                if not judged:
                    raise
                break
            except RuntimeError as error:
                failures[name] = str(error).splitlines()[0]
    left = tuple(name for name in order if name not in judged and name not in failures)
    descriptions = {name: candidate.description for name, candidate in models.items()}
    by = ", ".join(record.name for record in options.hold_out) or f"{options.folds} folds"
    return comparison_of(judged, failures, left, descriptions, by, new_records=bool(options.hold_out))


def _check_scenes(models: Mapping[str, Candidate], options: CompareOptions) -> None:
    """Refuse wrong names before the first model has taken its time."""
    known = set()
    for name, candidate in models.items():
        scene = candidate.scene
        if not isinstance(scene, Scene) or candidate.free is None:
            raise ValueError(f"{name}: compare needs a friction law, or a scene and the names of its free numbers.")
        known |= _names(scene, options.records)
        base = prepare(scene, options.records, candidate.free, options.fit_of(scene)).problem.base
        check_lengths(options.hold_out or options.windows, 0 if base is None else base.q.shape[1] + base.qd.shape[1])
    unknown = [name for name in options.fit.limits if name.partition("/")[0] not in known]
    unknown += [each.name for each in options.initializers if isinstance(each, Continuation) and each.name not in known]
    if unknown:
        raise ValueError(f"{unknown[0]} is no number of any candidate; there are: {', '.join(sorted(known))}.")


def _names(scene: Scene, records: tuple[Record, ...]) -> set[str]:
    """Names of all numbers that can have a limit."""
    return {*split_entries(scene_numbers(scene)), *(DELAY + name for record in records for name in record.inputs)}


def _from_smaller(free: Sequence[str], judged: Mapping[str, CrossValidated]) -> tuple[AbstractInitializer, ...]:
    """From the fit of the largest model all of whose parameters are among `free`, by the last parts of their names."""
    names = {last_part(name) for name in free}
    ends = [
        {last_part(name): on_device(each.values[name]) for name in each.search_for("A comparison").problem.free.names}
        for each, _, _ in judged.values()
    ]
    nested = [values for values in ends if set(values) <= names]
    return (FromSmaller(max(nested, key=len)),) if nested else ()


def _validated(
    options: CompareOptions,
    name: str,
    candidate: Candidate,
    report: CompareProgress | None,
    judged: Mapping[str, CrossValidated],
) -> CrossValidated:
    """The fit to everything, then the residuals of each held-out part in a fit without it."""
    model, free, folds, initializers = candidate.scene, candidate.free, options.folds, options.initializers

    def search_options(fold: int | None, rtol: float = ENOUGH) -> SearchOptions:
        show = report
        progress = None if show is None else lambda number, rms, _: show(name, fold, number, rms)
        return SearchOptions(rtol, options.max_steps, progress)

    if isinstance(model, AbstractLaw):
        prepared, free = prepare_law(model, options.records, free, options.fit.loss), tuple(ranges_of(model))
    else:
        assert free is not None
        prepared, numbers = prepare(model, options.records, free, options.fit_of(model)), _names(model, options.records)
        initializers = [each for each in initializers if not isinstance(each, Continuation) or each.name in numbers]
    initializers = (*initializers, *_from_smaller(free, judged))
    result = fitted(prepared, initializers, search_options(None, SearchOptions.rtol))
    search = finished(result.search_for("A comparison"))
    if isinstance(model, AbstractLaw):
        problem, x = search.problem, search.state.x
        block = _blocks(problem.runs, folds)
    elif options.hold_out:
        problem = _with_own_starts(model, options.hold_out, _measured_starts(search, options), search, options)
        block, x = _blocks(problem.runs, folds), _with_starts_of(problem, search)
        return CrossValidated(result, *_evaluated(problem, x, result, block, search_options(0)))
    else:
        problem = _with_own_starts(model, options.windows, _reached(search, options), search, options)
        block = np.broadcast_to(np.arange(problem.count)[:, None] % folds, problem.runs.t.shape)
        # Windows start as their first samples show. Free starts would take up errors of the model in the fitted
        # windows, and the parameters would then not fit a window whose start does not.
        x = _with_starts_of(problem, search)
        pinned = problem.pinned(x, result.estimate.information)
        problem = shown_starts(problem, finished(begin(pinned, x, search_options(None))))
        x = finished(solve(problem, x, search_options(None))).state.x
    parts = []
    for k in range(folds):
        without = finished(solve(problem.counting(block != k), x, search_options(k))).state.x
        parts.append(_evaluated(problem.counting(block == k), without, result, block, search_options(k)))
    held, start_fitted = zip(*parts, strict=True)
    return CrossValidated(result, sum(held, ()), sum(start_fitted, ()))


def _evaluated(
    problem: FitProblem,
    x: Float[Array, " n"],
    result: FitResult,
    block: Int[np.ndarray, "runs samples"],
    options: SearchOptions,
) -> tuple[tuple[Part, ...], tuple[Part, ...]]:
    """Residuals with the parameters at `x`, from starts that the first samples show, and from starts fitted to all.

    Of the samples that count, without the opening where there are starts.
    """
    pinned = problem.pinned(x, result.estimate.information)
    fixed = eqx.tree_at(lambda p: p.known, pinned, {name: 0 * each for name, each in problem.known.items()})
    if not problem.local:
        search = finished(solve(fixed, x, options))
        return _parts(search.problem, search.state, block), ()
    shown = finished(begin(fixed, x, options)).state.x
    best = finished(solve(fixed, shown, options)).state.x
    rest = fixed.counting(~opening(fixed.runs))
    held, start_fitted = (_parts(rest, state_at(rest, each), block) for each in (shown, best))
    return held, start_fitted


def _parts(problem: FitProblem, state: SearchState, block: Int[np.ndarray, "runs samples"]) -> tuple[Part, ...]:
    """Residuals in the units of their channels, for each run and block with samples that count."""
    parts: dict[tuple[int, int], Part] = {}
    for name, (residual, weight) in problem.by_channel(np.asarray(state.residual)).items():
        level = float(problem.noise[name])
        # Slip instants all go with the first sample of their run.
        number = block if block.shape == weight.shape else np.broadcast_to(block[:, :1], weight.shape)
        for run in range(problem.count):
            for k in np.unique(number[run][weight[run] > 0]):
                chosen = (number[run] == k) & (weight[run] > 0)
                parts.setdefault((run, int(k)), {})[name] = level * residual[run, chosen]
    return tuple(parts.values())


def _blocks(runs: Runs, folds: int) -> Int[np.ndarray, "runs samples"]:
    """Number of the block of each sample, with nearly the same number of samples in each block of a run."""
    return np.minimum(np.arange(runs.t.shape[1]) * folds // np.maximum(sample_counts(runs), 1), folds - 1)


def _with_starts_of(problem: FitProblem, search: SearchResult) -> Float[Array, " n"]:
    """The parameters of the search, and the starts of the problem."""
    size = len(problem.free.names)
    return on_device(np.concatenate([np.asarray(search.state.x)[:size], np.asarray(problem.x0)[size:]]))


def _with_own_starts(
    scene: Scene, records: tuple[Record, ...], starts: State, search: SearchResult, options: CompareOptions
) -> FitProblem:
    """The problem of records that each run from a free state, with the noise levels of the search."""
    free = (*search.problem.free.names, "q0", "qd0")
    problem = prepare(scene, records, free, options.fit_of(scene, q0=starts.q, qd0=starts.qd)).problem
    noise = {name: search.problem.noise.get(name, level) for name, level in problem.noise.items()}
    # Weights of zero: nothing is known of the starts yet, and nothing compiles again once it is.
    known = {name: on_device(np.zeros((problem.count, len(problem.local)))) for name in list(noise)[:1]}
    return eqx.tree_at(lambda p: (p.base, p.noise), replace(problem, known=known), (starts, noise))


def _reached(search: SearchResult, options: CompareOptions) -> State:
    """States of the fit where windows begin, with a leading axis of windows."""
    problem, x, records, folds = search.problem, search.state.x, options.records, options.folds
    edges = np.cumsum(np.reshape([len(window.t) for window in options.windows], (-1, folds)), axis=1)[:, :-1]
    before = []
    for i, (record, own) in enumerate(zip(records, edges.tolist(), strict=True)):
        before += [record.samples(0, edge + 1, f"{i} {edge}") for edge in own]
    runs = runs_of(tuple(before), cut(tuple(before), None))
    first, ends = _ends(problem, x, on_device(np.repeat(np.arange(len(records)), folds - 1)), runs)

    def merge(start: Array, end: Array) -> Array:
        later = np.asarray(end).reshape(len(records), folds - 1, *end.shape[1:])
        both = np.concatenate([np.asarray(start)[:, None], later], axis=1)
        return on_device(both.reshape(len(records) * folds, *end.shape[1:]))

    return jax.tree.map(merge, first, ends)


@eqx.filter_jit
def _ends(problem: FitProblem, x: Array, own: Int[Array, " runs"], runs: Runs) -> tuple[State, State]:
    """Where the records start, and where runs from the starts of the records `own` end."""
    values, first = problem.free.values(problem.split(x)[0]), problem.starts(x)
    assert first is not None  # of a scene
    starts = jax.tree.map(lambda leaf: leaf[own], first)
    return first, jax.vmap(lambda start, run: problem.engine(values, start, run).end)(starts, runs)


def _measured_starts(search: SearchResult, options: CompareOptions) -> State:
    """States where the held-out records begin: as measured, or else where the first fitted record begins."""
    base = search.problem.base
    assert base is not None
    observables = by_channel(options.fit.observe, options.hold_out)
    starts = [measured_start(record, observables, base.q.shape[1]) for record in options.hold_out]
    q, qd = (np.stack(each) for each in zip(*starts, strict=True))
    # Coordinates and velocities that are not measured are zero.
    q, qd = np.where(q != 0, q, base.q[0]), np.where(qd != 0, qd, base.qd[0])
    return initial_states(search.problem.engine.model, jnp.asarray(q), jnp.asarray(qd))
