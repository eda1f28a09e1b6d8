"""`fit`: numbers of a scene from measured records."""

from collections.abc import Mapping, Sequence
from typing import Any

from jaxtyping import ArrayLike

from .._core.arguments import as_float, as_mapping, as_names, as_whole
from ..scene import Scene
from ._begin import AbstractBeginning, begin_all
from ._engines import with_values
from ._losses import AbstractLoss, Squares
from ._observe import Observable, first_coordinate
from ._prepare import Settings, Shooting, prepare, step_error
from ._record import Record
from ._replay import Controller
from ._result import FitResult, result_of
from ._solve import Options, Progress, solve_with_noise

_WORDS = {
    "scene": "a Scene",
    "loss": "a loss such as Huber()",
    "controller": "a Controller",
    "shooting": "a Shooting",
}


def fit(
    scene: Scene,
    records: Record | Sequence[Record],
    free: Sequence[str],
    *,
    observe: Observable | Mapping[str, Observable] = first_coordinate,
    q0: ArrayLike | list[Any] | None = None,
    qd0: ArrayLike | list[Any] | None = None,
    delay: Mapping[str, float] | None = None,
    limits: Mapping[str, tuple[float | None, float | None]] | None = None,
    passive: Sequence[str] = (),
    prior: Mapping[str, tuple[float, float]] | None = None,
    loss: AbstractLoss | None = None,
    controller: Controller | None = None,
    shooting: Shooting | None = None,
    begin: AbstractBeginning | Sequence[AbstractBeginning] = (),
    substeps: int = 1,
    accuracy: float = 1e-8,
    rtol: float = 1e-6,
    max_steps: int = 100,
    progress: Progress | None = None,
) -> FitResult:
    """Fit numbers of a scene so that its simulation follows measured records.

    The inputs drive the scene, nothing measured is fed back, and the sum of squares of `observe - measured`, each
    channel in units of its noise, is minimised over all samples by Levenberg-Marquardt within bounds, on the exact
    derivatives of the simulated run. Scenes without set-valued laws are run by fixed steps from sample to sample,
    those with such laws by events.

    **Arguments:**

    - `scene`: the model with start values; its `params` must be a dict with an entry for each input of the records.
    - `records`: a `Record` or several; each has the same inputs.
    - `free`: names of the numbers to fit, as `jaxmodsim.scene.scene_numbers` gives them: `("m", "friction.Fc")`;
      the name of an array stands for all its entries, `friction.k[0]` for one. Of initial states `q0[0]`, `qd0[0]`,
      `z0.friction` (or `q0`, `qd0`, `z0` for all), fitted for each record by itself; of the delay [s] of an input
      `delay.u`. Laws' parameters stay in their ranges; one that is not free but limited by one that is (Fs by Fc)
      keeps its distance from it.
    - `observe`: what a record measured: a function `observe(q, qd)` that returns one number, `"q[0]"`, `"qd[0]"`, or
      the name of an effect, whose force is meant; with several channels a dict of these by channel.
    - `q0`, `qd0`: state at the first sample, shape `[dof]` or `[records, dof]`; by default the first measured value
      of each coordinate that was measured, the others 0, and rest. `jaxmodsim.identify.start_state` estimates one.
    - `delay`: by how much inputs come later than recorded [s], >= 0; where they start if they are free.
    - `limits`: lower and upper limits of numbers beyond the declared ones, None for none: `{"m": (0.0, 5.0)}`. A lower
      limit of 0 is excluded.
    - `passive`: names of the friction effects with a LuGre law that has to be passive, `sigma2 >= sigma1 (Fs - Fc)/Fc`;
      their sigma2 must be free.
    - `prior`: what was known before: mean and standard deviation by name, `{"m": (95.0, 5.0)}`.
    - `loss`: of a residual in noise levels; `Squares` by default, `Huber` and `Cauchy` where there are outliers.
    - `controller`: a `Controller` that closes a loop around the scene.
    - `shooting`: `Shooting`, to run in windows.
    - `begin`: how to find where to begin, one after the other: `Staged()`, `MultiStart(...)`, `Continuation(...)`.
    - `substeps`: integration steps between two samples.
    - `accuracy`: relative tolerance of runs by events.
    - `rtol`: relative change of the residual at which the search ends.
    - `max_steps`: limit of iterations.
    - `progress`: called after each iteration with its number, the RMSE and the parameters. Ctrl-C ends the fit
      with the best so far.

    **Returns:**

    A `FitResult`.

    **Raises:**

    - `ValueError` for names that are unknown, a start beyond its limits, inputs the scene has no entry for.
    - `RuntimeError` if the model is not finite at its start values.
    """
    loss = Squares() if loss is None else loss
    _check_kinds(scene, loss, controller, shooting, progress)
    begin = _beginnings(begin)
    settings = Settings(
        observe,
        q0,
        qd0,
        as_mapping(delay, name="delay", example="{'u': 1e-3}"),
        as_mapping(limits, name="limits", example="{'m': (0.0, 5.0)}"),
        as_names(passive, name="passive"),
        as_mapping(prior, name="prior", example="{'m': (95.0, 5.0)}"),
        loss,
        controller,
        shooting,
        as_whole(substeps, name="substeps"),
        as_float(accuracy, name="accuracy", lower=0.0),
    )
    options = Options(as_float(rtol, name="rtol", lower=0.0), as_whole(max_steps, name="max_steps"), progress)
    prepared = prepare(scene, records, free, settings)
    x, starts = begin_all(begin, prepared.problem, options)
    found = solve_with_noise(prepared.problem, x, options, prepared.given)
    values = found.problem.free.values(found.problem.split(found.search.x)[0])
    error = step_error(found)
    return result_of(
        found, prepared.records, prepared.windows, prepared.units, with_values(scene, values), error, starts
    )


def _check_kinds(scene: Any, loss: Any, controller: Any, shooting: Any, progress: Any) -> None:
    """Refuse objects of another kind."""
    for name, value, kind in (
        ("scene", scene, Scene),
        ("loss", loss, AbstractLoss),
        ("controller", controller, Controller | None),
        ("shooting", shooting, Shooting | None),
    ):
        if not isinstance(value, kind):
            raise ValueError(f"{name} must be {_WORDS[name]}, but {value!r} was given.")
    if not (progress is None or callable(progress)):
        raise ValueError(f"progress must be a function, but {progress!r} was given.")


def _beginnings(begin: Any) -> tuple[AbstractBeginning, ...]:
    several = (begin,) if isinstance(begin, AbstractBeginning) else begin
    if not isinstance(several, tuple | list) or not all(isinstance(each, AbstractBeginning) for each in several):
        raise ValueError(f"begin must be a beginning such as Staged(), or several of them, but {begin!r} was given.")
    return tuple(several)
