"""`fit_law`: parameters of a friction law from measured motion and force, without a mechanism."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._core.parameters import Range
from .._core.state_dependent import is_state_dependent
from ..friction import AbstractDynamicLaw, AbstractForceLaw, AbstractLaw
from ..scene import Scene, replace_numbers, scene_numbers, scene_ranges
from ._begin import AbstractBeginning, begin_all
from ._engines import Seen
from ._entries import chosen_entries, join_entries, split_entries, split_ranges
from ._losses import AbstractLoss, Squares
from ._model import PREFIX, holder_of, law_of
from ._parameters import FreeParameters
from ._problem import Prior, Problem
from ._record import Record
from ._result import FitResult, result_of
from ._runs import Runs, cut, runs_of
from ._solve import Options, Progress, solve_with_noise


def fit_law(
    law: AbstractLaw,
    record: Record | Sequence[Record],
    free: Sequence[str] | None = None,
    *,
    loss: AbstractLoss | None = None,
    begin: AbstractBeginning | Sequence[AbstractBeginning] = (),
    rtol: float = 1e-6,
    max_steps: int = 100,
    progress: Progress | None = None,
) -> FitResult:
    """Fit a friction law to a measured friction force under a measured motion.

    The law's state is advanced exactly over each sample at constant velocity, so any sampling rate is stable and
    the measured position needs no differentiation but in viscous terms.

    **Arguments:**

    - `law`: the law with start values; a dynamic law such as `LuGre`, or one that is a function of velocity.
    - `record`: a record, or several; `measured` is the friction force [N], positive when it opposes positive slip;
      `inputs` holds the slip displacement `x` [m] and, if the law's forces are per newton of load, the normal load
      `normal` [N]. The law starts at rest and unloaded.
    - `free`: names of the law's parameters to fit, `k[0]` for one entry of an array; by default all but those that
      start on their limit (`sigma1 = 0`) and the `width` of a wrapper and the `corner` of Maxwell slip, which are how
      the law is run and not what it is.
    - `loss`, `begin`, `rtol`, `max_steps`, `progress`: see `fit`.

    **Returns:**

    A `FitResult` whose `model` is the law.

    **Raises:**

    - `ValueError` for unknown names or inputs, or a law that cannot run by itself.
    """
    several = (record,) if isinstance(record, Record) else tuple(record)
    for each in several:
        if "x" not in each.inputs or not (is_state_dependent(law) or set(each.inputs) <= {"x", "normal"}):
            raise ValueError(
                "fit_law needs the input 'x' [m] and may take 'normal' [N], and more only for a law that scaled_by lets"
                f" depend on it; the record has: {', '.join(each.inputs)}."
            )
    holder = holder_of(law)
    numbers = {
        name.removeprefix(PREFIX): value
        for name, value in scene_numbers(holder).items()
        if name != PREFIX + "belt_velocity"
    }
    ranges = {}
    for name, allowed in scene_ranges(holder).items():
        lower = allowed.lower.removeprefix(PREFIX) if isinstance(allowed.lower, str) else allowed.lower
        ranges[name.removeprefix(PREFIX)] = replace(allowed, lower=lower)
    single, ranges = split_entries(numbers), split_ranges(numbers, ranges)
    chosen = _off_limits(single, ranges) if free is None else chosen_entries(numbers, free)
    parameters = FreeParameters.of(single, ranges, chosen)
    windows = cut(several, None)
    given = {name: level for each in several for name, level in each.noise.items()}
    size = float(np.std(np.concatenate([each.measured for each in several]))) or 1.0
    problem = Problem(
        LawEngine(holder),
        parameters,
        (),
        None,
        runs_of(several, windows),
        {name: jnp.asarray(given.get(name, size)) for name in several[0].channels},
        Squares() if loss is None else loss,
        Prior(jnp.zeros(len(parameters.names)), jnp.zeros(len(parameters.names))),
    )
    options = Options(rtol, max_steps, progress)
    x, starts = begin_all(begin, problem, options)
    found = solve_with_noise(problem, x, options, frozenset(given))
    per_load = " per N" if "normal" in several[0].inputs else ""
    units = {
        name: allowed.unit + (per_load if allowed.unit.startswith("N") else "") for name, allowed in ranges.items()
    }
    fitted = _law(holder, found.problem.free.values(found.search.x))
    return result_of(found, several, windows, units, fitted, None, starts)


class LawEngine(eqx.Module):
    """A law under the measured motion; the scene holds nothing else."""

    scene: Scene

    def __call__(self, values: dict[str, Array], start: None, run: Runs) -> Seen:
        """The force of the law with these values."""
        del start
        force = law_force(_law(self.scene, values), run.t, run.inputs["x"], run.inputs.get("normal"), run.inputs)
        return Seen(dict.fromkeys(run.measured, force), {}, None)


def _law(holder: Scene, values: dict[str, Array]) -> AbstractLaw:
    numbers = scene_numbers(holder)
    whole = join_entries(numbers, {PREFIX + name: value for name, value in values.items()})
    return law_of(replace_numbers(holder, whole))


def _off_limits(numbers: dict[str, Array], ranges: dict[str, Range]) -> tuple[str, ...]:
    """Names of the parameters that can be free where they start."""
    free = []
    for name, value in numbers.items():
        lower = ranges[name].lower if name in ranges else None
        limit = numbers[lower] if isinstance(lower, str) else lower
        if not (name in ranges and ranges[name].execution) and (limit is None or bool(value > limit)):
            free.append(name)
    return tuple(free)


def law_force(
    law: AbstractLaw,
    t: Float[Array, " samples"],
    x: Float[Array, " samples"],
    normal: Float[Array, " samples"] | None = None,
    inputs: dict[str, Float[Array, " samples"]] | None = None,
) -> Float[Array, " samples"]:
    """Friction force of a law under a sampled motion, from rest and unloaded.

    **Arguments:**

    - `law`: a dynamic law, or one that is a function of velocity.
    - `t`: times [s], increasing.
    - `x`: slip displacement [m] at these times; the velocity is constant from sample to sample.
    - `normal`: normal load [N] for laws whose forces are per newton of load.
    - `inputs`: what the functions of `scaled_by` find in `params`, by name.

    **Returns:**

    The force [N] at each sample, with the velocity of the interval that ends there (0 at the first).

    **Raises:**

    - `ValueError` for a law whose force depends on more than its own motion.
    """
    if not isinstance(law, AbstractDynamicLaw | AbstractForceLaw):
        raise ValueError(f"{type(law).__name__} cannot run by itself: its force depends on the load it holds.")
    dt = jnp.diff(t)
    v = jnp.diff(x) / jnp.where(dt > 0, dt, 1.0)  # records side by side repeat their last time

    def at(t: Array, x: Array, v: Array, params: Any) -> Any:
        return law.bind_state(t, x[None], v[None], params)

    def advance(z: Any, sample: Any) -> tuple[Any, Array]:
        t, x, v, params, dt = sample
        here = at(t, x, v, params)
        if isinstance(here, AbstractForceLaw):
            return z, here.force(v)
        z = here.step_exact(v, z, dt)
        return z, here.force(v, z)

    rest = jnp.zeros_like(x[0])
    z0 = law.initial_state(rest) if isinstance(law, AbstractDynamicLaw) else None
    first = at(t[0], x[0], rest, jax.tree.map(lambda each: each[0], inputs or {}))
    start = first.force(rest) if z0 is None else first.force(rest, z0)
    samples = (t[1:], x[1:], v, jax.tree.map(lambda each: each[1:], inputs or {}), dt)
    _, force = jax.lax.scan(advance, z0, samples)
    force = jnp.concatenate([jnp.reshape(start, (1,)), force])
    return force if normal is None else force * jnp.maximum(normal, 0.0)
