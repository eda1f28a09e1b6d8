"""`fit` and `fit_law`: numbers of a scene, or of a law by itself, from measured records."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..._core.arguments import as_float, as_whole
from ..._core.progress import iteration_words, reported
from ...friction import AbstractLaw
from ...scene import Scene, scene_numbers
from ..data._record import Record, Window
from ..data._signals import outliers, sampling_gaps
from ..estimate._initializers import AbstractInitializer, as_initializers, run_initializers
from ..estimate._prepare import (
    FitOptions,
    MultipleShooting,
    Prepared,
    StartState,
    prepare,
    prepare_law,
    step_changes,
)
from ..estimate._problem import AbstractLoss, SquaredLoss
from ..estimate._search import Progress, SearchOptions, SearchResult, continued, solve_freed, solve_with_noise
from ..model._engines import Controller, with_values
from ..model._observe import Observable, coordinates_seen, first_coordinate
from ._estimate import (
    FitDiagnostics,
    FitProvenance,
    IdentifiabilityIssue,
    ParameterEstimate,
    covariance_of,
    natural_scales,
    offset_issues,
    step_moves,
)
from ._identifiability import identifiability_issues
from ._result import FitResult, uncertain_of

_ROUGH = (
    "Standard errors are refused: over a tenth of a standard error the output does not change as its derivatives"
    " predict, because of rounding or the integration steps. Raise substeps; pass a set-valued law such as Coulomb"
    " itself, without Regularized. If the residual is only rounding, there is nothing to estimate."
)


def fit(
    scene: Scene,
    records: Record | Sequence[Record],
    free: Sequence[str],
    *,
    observe: Observable | Mapping[str, Observable] = first_coordinate,
    q0: StartState | None = None,
    qd0: StartState | None = None,
    delay: Mapping[str, float] | None = None,
    limits: Mapping[str, tuple[float | None, float | None]] | None = None,
    passive: Sequence[str] = (),
    prior: Mapping[str, tuple[float, float]] | None = None,
    loss: AbstractLoss | None = None,
    controller: Controller | None = None,
    shooting: MultipleShooting | None = None,
    initializer: AbstractInitializer | Sequence[AbstractInitializer] = (),
    substeps: int = 1,
    accuracy: float = 1e-8,
    rtol: float = 1e-6,
    max_steps: int = 400,
    progress: bool | Progress = False,
) -> FitResult:
    """Fit numbers of a scene so that its simulation follows measured records.

    The inputs drive the scene, without feedback of measured values. Levenberg-Marquardt within bounds, on the exact
    derivatives of the simulation, minimises the sum of squares of `observe - measured` over all samples, each channel
    in units of its noise. The simulation has fixed steps from sample to sample. Set-valued laws stick and slip exactly,
    and every change of mode is located. Scenes with contacts or constraints under set-valued laws, slip in a plane, and
    records with slip instants use error-controlled steps.

    **Arguments:**

    - `scene`: the model with start values; its `params` must be a dict with an entry for each input of the records.
    - `records`: a `Record` or several; each has the same inputs.
    - `free`: names of the numbers to fit, as `jaxmodsim.scene.scene_numbers` gives them: `("m", "friction.Fc")`;
      the name of an array stands for all its entries, `friction.k[0]` for one. Initial states are `q0[0]`, `qd0[0]`,
      `z0.friction` (or `q0`, `qd0`, `z0` for all), fitted for each record separately; the delay [s] of an input is
      `delay.u`. Parameters of laws stay in their ranges; a fixed one that is limited by a free one (Fs by Fc) keeps its
      distance from it.
    - `observe`: the measured quantity: a function `observe(q, qd)` that returns one number, `"q[0]"`, `"qd[0]"`, or
      the name of an effect, for its force; with several channels a dict of these by channel.
    - `q0`, `qd0`: state at the first sample, shape `[dof]` or `[records, dof]`, if it is known exactly. By default
      coordinates that a channel shows, and their velocities, are fitted for each record separately, and not reported;
      the others start at 0, at rest.
    - `delay`: delays of inputs relative to the record [s], >= 0; start values if they are free.
    - `limits`: lower and upper limits of numbers beyond the declared ones, None for none: `{"m": (0.0, 5.0)}`. A lower
      limit of 0 is excluded. The limit of Fs is 5 Fc, or the ratio at the start;
      `{"friction.Fs/friction.Fc": (None, 8.0)}` sets another limit of such a ratio, None for none.
    - `passive`: names of the friction effects with a LuGre law that must be passive, `sigma2 >= sigma1 (Fs - Fc)/Fc`;
      their sigma2 must be free.
    - `prior`: prior knowledge: mean and standard deviation by name, `{"m": (95.0, 5.0)}`.
    - `loss`: of a residual in noise levels; `SquaredLoss` by default, `Huber` or `Cauchy` for outliers.
    - `controller`: a `Controller` that closes a loop around the scene.
    - `shooting`: `MultipleShooting`, to run in windows.
    - `initializer`: of the search, one or several in sequence: `Staged()`, `MultiStart(...)`, `Continuation(...)`.
    - `substeps`: integration steps between two samples. They also resolve inputs that a delay moves between samples.
    - `accuracy`: relative tolerance of error-controlled steps.
    - `rtol`: relative change of the residual at which the search ends.
    - `max_steps`: limit of iterations. The damping is reset after every hundred of them; the result reports how often.
    - `progress`: True for a line of text, or a function that is called after each iteration with its number, the RMSE
      and the parameters. Ctrl-C ends the fit with the best so far.

    **Returns:**

    A `FitResult`.

    **Raises:**

    - `ValueError` for unknown names, a start beyond its limits, or inputs without an entry in the scene.
    - `RuntimeError` if the model is not finite at its start values.

    **Example:**

    ```python
    t = jnp.linspace(0.0, 4.0, 201)
    inputs = {"u": 6.0 * jnp.sin(3.0 * t)}
    machine = jms.problems.braked_spring.driven_spring(jms.Viscous(1.5), m=2.0)
    x = jms.identify.replay(machine, t, inputs, jnp.zeros(1), jnp.zeros(1))  # a synthetic record
    record = jms.Record(t, x + 1e-5 * jax.random.normal(jax.random.key(0), x.shape), inputs)
    start = jms.problems.braked_spring.driven_spring(jms.Viscous(1.0), m=2.5)
    result = jms.fit(start, record, ("m", "friction.Fv"))
    print({name: round(value, 3) for name, value in result.values.items()})
    ```

    ```text
    {'m': 2.0, 'friction.Fv': 1.5}
    ```
    """
    options = FitOptions(
        observe=observe,
        q0=q0,
        qd0=qd0,
        delay=delay,
        limits=limits,
        passive=passive,
        prior=prior,
        loss=loss,
        controller=controller,
        shooting=shooting,
        substeps=substeps,
        accuracy=accuracy,
    )
    initializers = as_initializers(initializer)
    rtol, max_steps = as_float(rtol, name="rtol", lower=0.0), as_whole(max_steps, name="max_steps")
    with reported(progress, "fit", iteration_words) as report:
        return fitted(prepare(scene, records, free, options), initializers, SearchOptions(rtol, max_steps, report))


def fitted(prepared: Prepared, initializers: Sequence[AbstractInitializer], options: SearchOptions) -> FitResult:
    """Search from the start of the initializers, and the result of its end."""
    problem = prepared.problem
    x, starts = run_initializers(initializers, problem.held, options)
    search = solve_freed(problem, x, options, prepared.known_noise)
    model = with_values(problem.engine.model, problem.at(search.state.x).values)
    return result_of(search, prepared.records, prepared.windows, prepared.units, model, starts)


def fit_law(
    law: AbstractLaw,
    record: Record | Sequence[Record],
    free: Sequence[str] | None = None,
    *,
    loss: AbstractLoss | None = None,
    initializer: AbstractInitializer | Sequence[AbstractInitializer] = (),
    rtol: float = 1e-6,
    max_steps: int = 400,
    progress: bool | Progress = False,
) -> FitResult:
    """Fit a friction law to a measured friction force under a measured motion.

    The law's state is advanced exactly over each sample at constant velocity. So any sampling rate is stable, and only
    viscous terms differentiate the measured position.

    **Arguments:**

    - `law`: the law with start values; a dynamic law such as `LuGre`, or one that is a function of velocity.
    - `record`: a record, or several; `measured` is the friction force [N], positive when it opposes positive slip;
      `inputs` holds the slip displacement `x` [m] and, if the law's forces are per newton of load, the normal load
      `normal` [N]. The law starts at rest and unloaded.
    - `free`: names of the law's parameters to fit, `k[0]` for one entry of an array; by default all but those that
      start on their limit (`sigma1 = 0`) and the `width` of a wrapper and the `corner` of Maxwell slip, which are
      numerical.
    - `loss`, `initializer`, `rtol`, `max_steps`, `progress`: see `fit`.

    **Returns:**

    A `FitResult` whose `model` is the law.

    **Raises:**

    - `ValueError` for unknown names or inputs, inputs or noise that differ between the records, or a law that cannot
      run by itself.

    **Example:**

    ```python
    t = jnp.linspace(0.0, 2.0, 401)
    x = 1e-3 * jnp.sin(jnp.pi * t)
    force = jms.identify.law_force(jms.Dahl(sigma0=2e4, Fc=3.0), t, x)  # a synthetic record
    noisy = force + 1e-3 * jax.random.normal(jax.random.key(0), t.shape)
    result = jms.fit_law(jms.Dahl(sigma0=1e4, Fc=2.0), jms.Record(t, noisy, {"x": x}))
    print({name: f"{value:.4g}" for name, value in result.values.items()})
    ```

    ```text
    {'sigma0': '2e+04', 'Fc': '3'}
    ```
    """
    prepared = prepare_law(law, record, free, loss)
    with reported(progress, "fit", iteration_words) as report:
        options = SearchOptions(rtol, as_whole(max_steps, name="max_steps"), report)
        return fitted(prepared, as_initializers(initializer), options)


def result_of(
    search: SearchResult,
    records: tuple[Record, ...],
    windows: tuple[Window, ...],
    units: dict[str, str],
    model: eqx.Module,
    starts: tuple[float, ...] = (),
) -> FitResult:
    """The result of a search: estimate, diagnostics, provenance."""
    problem, state, free = search.problem, search.state, search.problem.free
    names, size, shown = list(free.names), len(free.names), problem.reported
    values, at_start = problem.at(state.x).vector.tolist(), [float(free.start[name]) for name in names]
    entries = list(range(size))
    if problem.base is not None and len(windows) == len(records):
        before = np.asarray(jax.vmap(problem.local_values)(problem.base))[:, :shown]
        after = before + np.asarray(problem.split(state.x)[1])[:, :shown]
        for i, record in enumerate(records):
            prefix = "" if len(records) == 1 else f"{record.name}/"
            names += [prefix + name for name in problem.local[:shown]]
            at_start += before[i].tolist()
            values += after[i].tolist()
            entries += [size + i * len(problem.local) + k for k in range(shown)]
    covariance = covariance_of(problem, state, entries)
    outputs, rmse = _stitched(search, records, windows)
    scales = natural_scales(problem, state, entries)
    signed = [kind == "line" for kind in free.kinds] + [True] * (len(names) - size)
    estimate = ParameterEstimate(
        values=dict(zip(names, values, strict=True)),
        start=dict(zip(names, at_start, strict=True)),
        units={name: units.get(name, "") for name in names},
        covariance=covariance.covariance,
        white=covariance.white,
        information=covariance.information,
        logarithmic=tuple(name for name, kind in zip(free.names, free.kinds, strict=True) if kind == "log"),
        bounds=free.limits(state.x[:size]) | {name: (-np.inf, np.inf) for name in names[size:]},
        natural={name: float(x) if each else 0.0 for name, x, each in zip(names, scales, signed, strict=True)},
    )
    if problem.base is None:
        coordinates = {"x": "q[0]"} if "x" in problem.runs.inputs else {}
    else:
        coordinates = coordinates_seen(problem.engine.observables, problem.base.q.shape[-1])
    provenance = FitProvenance(
        records=records,
        outputs=outputs,
        coordinates=coordinates,
        numbers={name: np.asarray(x) for name, x in scene_numbers(model).items()},
        model=model,
    )
    changes = step_changes(search)
    diagnostics = FitDiagnostics(
        rmse=rmse,
        noise={name: float(x) for name, x in problem.noise.items()},
        ending=search.ending,
        evaluations=search.iterations,
        step_error={
            name: np.sqrt(np.sum(x**2) / np.sum(search.residuals[name][1] > 0)).item() for name, x in changes.items()
        },
        step_moves=step_moves(problem, state, entries, estimate.errors, changes),
        starts=starts,
        single_precision=jnp.result_type(float) == jnp.float32,
        issues=(
            *offset_issues(problem, state, entries, np.array(list(estimate.errors.values()))),
            *_issues(estimate, provenance, search, covariance.refused),
        ),
    )
    return FitResult(
        estimate=estimate,
        diagnostics=diagnostics,
        provenance=provenance,
        search=replace(search, windows=windows),
    )


def searched_on(result: FitResult, x: Float[Array, " n"], options: SearchOptions, times: int, where: str) -> FitResult:
    """The result of the same fit with its search continued from `x`; `times`, `where`: of continuations, in words."""
    before, provenance = result.search_for("A continued search"), result.provenance
    assert provenance.model is not None
    known = frozenset(name for record in provenance.records for name in record.noise)
    search = solve_with_noise(before.problem, x, options, known)
    ending = continued(search.ending, times, where)
    search = replace(search, iterations=before.iterations + search.iterations, ending=ending)
    model = with_values(provenance.model, search.problem.at(search.state.x).values)
    units, starts = result.estimate.units, result.diagnostics.starts
    return result_of(search, provenance.records, before.windows, units, model, starts)


def _issues(
    estimate: ParameterEstimate, provenance: FitProvenance, search: SearchResult, refused: bool
) -> tuple[IdentifiabilityIssue, ...]:
    """Causes in the motion of uncertain parameters, or the reason for refused standard errors."""
    uncertain, model, base = uncertain_of(estimate), provenance.model, search.problem.base
    of_samples = _sample_issues(provenance.records, isinstance(search.problem.loss, SquaredLoss))
    if refused:
        shows = np.any(np.asarray(search.state.jacobian) != 0, axis=0)
        about = tuple(name for name, column in zip(estimate.values, shows, strict=False) if column)
        return (IdentifiabilityIssue(_ROUGH, about), *of_samples)
    if not uncertain or not isinstance(model, Scene | AbstractLaw):
        return of_samples
    dof = 1 if base is None else base.q.shape[-1]
    free = search.problem.free.names
    issues = identifiability_issues(model, provenance.motions, dof, provenance.numbers, free, uncertain)
    return (*of_samples, *issues)


def _sample_issues(records: tuple[Record, ...], squares: bool) -> tuple[IdentifiabilityIssue, ...]:
    """Gaps, and outliers in a fit by least squares."""
    issues = []
    for record in records:
        gaps = sampling_gaps(record)
        if gaps and record.inputs:
            k = gaps[0]
            more = f", and {len(gaps) - 1} times more" if len(gaps) > 1 else ""
            issues.append(
                f"{record.name}: samples are missing from {record.t[k]:g} to {record.t[k + 1]:g} s{more}. Inputs are"
                " held or interpolated over the gap, which is hardly right: cut the record there (Record.part)."
            )
        for channel, x in record.channels.items() if squares else ():
            count = int(np.count_nonzero(outliers(x)))
            if count:
                issues.append(
                    f"{record.name}: {count} of {x.size} samples of {channel} stand far out from their neighbours. A"
                    " robust loss, Huber() or Cauchy(), gives them less weight (on the command line --loss huber)."
                )
    return tuple(IdentifiabilityIssue(sentence, ()) for sentence in issues)


def _stitched(
    search: SearchResult, records: tuple[Record, ...], windows: tuple[Window, ...]
) -> tuple[tuple[dict[str, np.ndarray], ...], dict[str, float]]:
    """The model's output along each record, and the root mean squares of the differences."""
    problem = search.problem
    outputs: list[dict[str, np.ndarray]] = [
        {name: np.array(x) for name, x in record.channels.items()} for record in records
    ]
    rmse = {}
    for name, (residual, weight) in search.residuals.items():
        level = float(problem.noise[name])
        rmse[name] = level * float(np.sqrt(np.sum(residual[weight > 0] ** 2) / max(np.sum(weight > 0), 1)))
        for run, (i, first, last, _) in enumerate(windows):
            if name in outputs[i]:
                counted = np.flatnonzero(weight[run, : last - first + 1] > 0)
                outputs[i][name][first + counted] += level * residual[run, counted]
    return tuple(outputs), rmse
