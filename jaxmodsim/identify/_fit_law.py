"""`fit_law`: parameters of a friction law from measured motion and force, without a mechanism."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..effects import Friction
from ..friction import AbstractDynamicLaw, AbstractForceLaw, AbstractLaw
from ..numerics import Range, varies
from ..scene import Scene, replace_numbers, scene_numbers, scene_ranges
from ._entries import chosen_entries, join_entries, split_entries, split_ranges
from ._fit_result import FitResult
from ._least_squares import Progress, least_squares
from ._parameters import FreeParameters
from ._record import Record


def fit_law(
    law: AbstractLaw,
    record: Record,
    free: Sequence[str] | None = None,
    *,
    rtol: float = 1e-6,
    max_steps: int = 100,
    progress: Progress | None = None,
) -> FitResult:
    """Fit a friction law to a measured friction force under a measured motion.

    The law's state is advanced exactly over each sample at constant velocity, so any sampling rate is stable and
    the measured position needs no differentiation but in viscous terms.

    **Arguments:**

    - `law`: the law with start values; a dynamic law such as `LuGre`, or one that is a function of velocity.
    - `record`: `measured` is the friction force [N], positive when it opposes positive slip; `inputs` holds the slip
      displacement `x` [m] and, if the law's forces are per newton of load, the normal load `normal` [N]. The law
      starts at rest and unloaded.
    - `free`: names of the law's parameters to fit, `k[0]` for one entry of an array; by default all but those that
      start on their limit (`sigma1 = 0`) and the `width` of a wrapper and the `corner` of Maxwell slip, which are how
      the law is run and not what it is.
    - `rtol`, `max_steps`, `progress`: see `fit`.

    **Returns:**

    A `FitResult` whose `model` is the law.

    **Raises:**

    - `ValueError` for unknown names or inputs, or a law that cannot run by itself.
    """
    if "x" not in record.inputs or not (varies(law) or set(record.inputs) <= {"x", "normal"}):
        raise ValueError(
            "fit_law needs the input 'x' [m] and may take 'normal' [N], and more only for a law that scaled_by lets"
            f" depend on it; the record has: {', '.join(record.inputs)}."
        )
    # A scene of the law alone gives its numbers their names and ranges.
    holder = Scene(_nothing, effects=(Friction(law, name="law"),))
    prefix = "law."
    numbers = {
        name.removeprefix(prefix): value
        for name, value in scene_numbers(holder).items()
        if name != prefix + "belt_velocity"
    }
    ranges = {}
    for name, allowed in scene_ranges(holder).items():
        lower = allowed.lower.removeprefix(prefix) if isinstance(allowed.lower, str) else allowed.lower
        ranges[name.removeprefix(prefix)] = replace(allowed, lower=lower)
    single, ranges = split_entries(numbers), split_ranges(numbers, ranges)
    chosen = _off_limits(single, ranges) if free is None else chosen_entries(numbers, free)
    parameters = FreeParameters.of(single, ranges, chosen)

    def with_values(values: dict[str, Array]) -> AbstractLaw:
        whole = {prefix + name: value for name, value in join_entries(numbers, values).items()}
        friction = replace_numbers(holder, whole).effects[0]
        assert isinstance(friction, Friction)
        return friction.law

    def residual(values: dict[str, Array], data: Any) -> Array:
        t, inputs, measured = data
        return law_force(with_values(values), t, inputs["x"], inputs.get("normal"), inputs) - measured

    data = record.arrays
    estimate = least_squares(residual, parameters, data, rtol=rtol, max_steps=max_steps, progress=progress)
    per_load = " per N" if "normal" in record.inputs else ""
    units = {
        name: allowed.unit + (per_load if allowed.unit.startswith("N") else "") for name, allowed in ranges.items()
    }
    return FitResult.of(estimate, with_values(estimate.found), record, units)


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
    v = jnp.diff(x) / dt

    def at(t: Array, x: Array, v: Array, params: Any) -> Any:
        return law.at(t, x[None], v[None], params)

    def advance(z: Any, sample: Any) -> tuple[Any, Array]:
        t, x, v, params, dt = sample
        here = at(t, x, v, params)
        if isinstance(here, AbstractForceLaw):
            return z, here.force(v)
        z = here.advance(v, z, dt)
        return z, here.force(v, z)

    rest = jnp.zeros_like(x[0])
    z0 = law.state0(rest) if isinstance(law, AbstractDynamicLaw) else None
    first = at(t[0], x[0], rest, jax.tree.map(lambda each: each[0], inputs or {}))
    start = first.force(rest) if z0 is None else first.force(rest, z0)
    samples = (t[1:], x[1:], v, jax.tree.map(lambda each: each[1:], inputs or {}), dt)
    _, force = jax.lax.scan(advance, z0, samples)
    force = jnp.concatenate([jnp.reshape(start, (1,)), force])
    return force if normal is None else force * jnp.maximum(normal, 0.0)


def _nothing(t: Array, q: Array, qd: Array, p: Any) -> Array:
    del t, q, p
    return 0.0 * qd[0]
