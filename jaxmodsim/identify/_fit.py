"""`fit`: numbers of a scene from a measured record."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike

from ..numerics import Range, check_ranges, modules_of
from ..scene import Scene, State, check_scene, replace_numbers, scene_numbers, scene_ranges
from ._entries import chosen_entries, join_entries, split_entries, split_ranges
from ._fit_result import FitResult
from ._least_squares import Progress, least_squares
from ._parameters import FreeParameters
from ._record import Record
from ._replay import replay


def first_coordinate(q: Array, qd: Array) -> Array:
    """The first coordinate, which is what a position sensor on one axis sees."""
    del qd
    return q[0]


def fit(
    scene: Scene,
    record: Record,
    free: Sequence[str],
    *,
    q0: ArrayLike | list[float] | None = None,
    qd0: ArrayLike | list[float] | None = None,
    observe: Callable[[Array, Array], Array] = first_coordinate,
    lower: Mapping[str, float] | None = None,
    substeps: int = 1,
    rtol: float = 1e-6,
    max_steps: int = 100,
    progress: Progress | None = None,
) -> FitResult:
    """Fit numbers of a scene so that its open-loop simulation follows a record.

    The inputs drive the scene, nothing measured is fed back, and the sum of squares of `observe - measured` over all
    samples is minimised by Levenberg-Marquardt on the exact derivatives of the simulated run.

    **Arguments:**

    - `scene`: the model with start values; its `params` must be a dict with an entry for each input of the record.
    - `record`: the `Record`.
    - `free`: names of the numbers to fit, as `jaxmodsim.scene.scene_numbers` gives them: `("m", "friction.Fc")`;
      the name of an array stands for all its entries, `friction.k[0]` for one.
      Laws' parameters stay in their ranges.
    - `q0`, `qd0`: state at the first sample, shape `[dof]`; by default, for one coordinate, the first measured value
      and rest.
    - `observe`: `observe(q, qd)`, what the record measured; by default the first coordinate.
    - `lower`: lower limits, excluded, of numbers that declare none: `{"m": 0.0}`.
    - `substeps`: integration steps between two samples.
    - `rtol`: relative tolerance on parameters and loss at which the search ends.
    - `max_steps`: limit of iterations.
    - `progress`: called after each iteration with its number, the RMSE and the parameters. Ctrl-C ends the fit
      with the best so far.

    **Returns:**

    A `FitResult`.

    **Raises:**

    - `ValueError` for names that are unknown, a start on the limit of its range, inputs the scene has no entry for.
    - `RuntimeError` if the model is not finite at its start values.
    """
    if not isinstance(scene.params, dict) or not set(record.inputs) <= set(scene.params):
        have = ", ".join(scene.params) if isinstance(scene.params, dict) else "no dict"
        raise ValueError(
            f"The record's inputs ({', '.join(record.inputs)}) must be entries of the scene's params ({have})."
        )
    if scene.exact:
        raise ValueError(
            f"fit integrates with fixed steps and knows no events, but {', '.join(scene.exact)} would need them:"
            " wrap the law, as in Regularized(law, width)."
        )
    for label, count in (("substeps", substeps), ("max_steps", max_steps)):
        if isinstance(count, bool) or not isinstance(count, int) or count < 1:
            raise ValueError(f"{label} must be at least 1, an integer, but {count!r} was given.")
    driven = sorted(set(free) & set(record.inputs))
    if driven:
        raise ValueError(f"{driven[0]} is driven by the record and cannot be free.")
    for _, module in modules_of(scene):
        check_ranges(module)
    whole = scene_numbers(scene)
    numbers = split_entries(whole)
    limits = {name: Range("", limit, strict=True) for name, limit in (lower or {}).items()}
    for name, limit in limits.items():
        if name not in numbers or not bool(limit.holds(numbers[name], {})):
            raise ValueError(
                f"lower: {name} must be {limit.text}, but it is {numbers.get(name, 'no number of the scene')}."
            )
    ranges = split_ranges(whole, scene_ranges(scene))
    for name, limit in limits.items():
        declared = ranges.get(name, limit)
        if isinstance(declared.lower, str):
            raise ValueError(f"lower: {name} is limited by {declared.lower} already.")
        tighter = declared.lower is None or float(limit.lower or 0.0) >= declared.lower
        ranges[name] = replace(declared, lower=limit.lower, strict=True) if tighter else declared
    parameters = FreeParameters.of(numbers, ranges, chosen_entries(whole, free))
    start = [record.measured[0]] if q0 is None else q0
    position = jnp.asarray(start, float)
    velocity = jnp.zeros_like(position) if qd0 is None else jnp.asarray(qd0, float)
    if position.ndim != 1 or position.shape != velocity.shape or not jnp.isfinite(position + velocity).all():
        raise ValueError(f"q0 and qd0 must be finite and of one shape [dof], but q0 = {start} and qd0 = {qd0}.")
    check_scene(scene, State(position, velocity, scene.state0(position)))
    shape = getattr(jax.eval_shape(observe, position, velocity), "shape", None)
    if shape != ():
        raise ValueError(f"observe(q, qd) returned the shape {shape}, but one number, shape (), is needed.")

    def residual(values: dict[str, Array], data: Any) -> Array:
        t, inputs, measured = data
        model = replace_numbers(scene, join_entries(whole, values))
        return replay(model, t, inputs, position, velocity, substeps, observe) - measured

    data = record.arrays
    estimate = least_squares(residual, parameters, data, rtol=rtol, max_steps=max_steps, progress=progress)
    units = {name: allowed.unit for name, allowed in ranges.items()}
    model = replace_numbers(scene, join_entries(whole, estimate.found))
    t, inputs, measured = data
    fine = replay(model, t, inputs, position, velocity, 4 * substeps, observe) - measured
    step_error = float(jnp.sqrt(jnp.mean((fine - estimate.residual) ** 2)))
    return FitResult.of(estimate, model, record, units, step_error)
