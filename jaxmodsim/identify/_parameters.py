"""Free parameters: kept in their ranges by a transform to numbers without limits."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..numerics import Range


@dataclass(frozen=True)
class FreeParameters:
    """Names, start values and limits of the parameters of a fit.

    A parameter with a lower limit is `limit + (start - limit) exp(x)`, one with an upper limit as well moves between
    them by a logistic function, one without is `start + scale x`, with x free and zero at the start. A lower limit may
    be another parameter (Fs >= Fc). One that is not free itself, but whose limit is, keeps its distance from the limit:
    with Fs = Fc at the start, it stays so.

    - `names`: of the free parameters, in the order they were given.
    - `start`: values at the start, of these and of the ones that follow them, each after its limit.
    - `limits`: lower limit of each, if it has one: a number or a name.
    - `upper`: upper limits of those that have one.
    - `following`: names of the parameters that are not free but follow one that is.
    """

    names: tuple[str, ...]
    start: dict[str, float]
    limits: dict[str, float | str | None]
    upper: dict[str, float]
    following: tuple[str, ...]

    @staticmethod
    def of(numbers: Mapping[str, Any], ranges: Mapping[str, Range], free: Sequence[str]) -> "FreeParameters":
        """Choose `free` among `numbers`.

        **Raises:**

        - `ValueError` for a name that is unknown, given twice or no single number, or a start on its limit.
        """
        if isinstance(free, str) or not free:
            raise ValueError("free must name at least one number, as in free=('m', 'friction.Fc').")
        for name in free:
            if name not in numbers:
                raise ValueError(f"free names {name!r}, but the numbers are: {', '.join(numbers)}.")
            if list(free).count(name) > 1:
                raise ValueError(f"free names {name!r} twice.")
            if jnp.shape(numbers[name]) != ():
                raise ValueError(f"{name} is an array of shape {jnp.shape(numbers[name])}; only single numbers fit.")
        values = {name: float(x) for name, x in numbers.items() if jnp.shape(x) == ()}
        following: list[str] = []
        while more := [
            name for name, r in ranges.items() if name not in (*free, *following) and r.lower in (*free, *following)
        ]:
            following += more
        limits: dict[str, float | str | None] = {}
        for name in free:
            limit = ranges[name].lower if name in ranges else None
            lower = values[limit] if isinstance(limit, str) else limit
            if lower is not None and values[name] <= lower:
                shown = f"{limit} = {lower:g}" if isinstance(limit, str) else f"{lower:g}"
                raise ValueError(f"The start {name} = {values[name]:g} must lie above its limit {shown}.")
            # A limit that is fixed is a number.
            limits[name] = limit if limit in (*free, *following) else lower
        limits |= {name: ranges[name].lower for name in following}
        order: list[str] = []
        for name in (*free, *following):
            chain, limit = [name], limits[name]
            while isinstance(limit, str) and limit not in order:
                chain.append(limit)
                limit = limits[limit]
            order += [each for each in reversed(chain) if each not in order]
        upper: dict[str, float] = {}
        for name in free:
            most = ranges[name].upper if name in ranges else None
            if most is None:
                continue
            if isinstance(limits[name], str):
                raise ValueError(f"{name} is limited by {limits[name]} and by {most:g}: free only one of the two.")
            if values[name] >= most:
                raise ValueError(f"The start {name} = {values[name]:g} must lie below its limit {most:g}.")
            upper[name] = most
        return FreeParameters(tuple(free), {name: values[name] for name in order}, limits, upper, tuple(following))

    def values(self, x: Float[Array, " free"]) -> dict[str, Array]:
        """The parameters at `x`, and those that follow them."""
        values: dict[str, Array] = {}
        for name, start in self.start.items():
            limit = self.limits[name]
            if name in self.following:
                values[name] = values[str(limit)] + (start - self.start[str(limit)])
                continue
            here = x[self.names.index(name)]
            if limit is None and name in self.upper:
                values[name] = self.upper[name] - (self.upper[name] - start) * jnp.exp(here)
            elif limit is None:
                values[name] = start + max(abs(start), 1.0) * here
            elif isinstance(limit, str):
                values[name] = values[limit] + (start - self.start[limit]) * jnp.exp(here)
            elif name in self.upper:
                span = self.upper[name] - limit
                values[name] = limit + span * jax.nn.sigmoid(here + math.log((start - limit) / (limit + span - start)))
            else:
                values[name] = limit + (start - limit) * jnp.exp(here)
        return values

    def vector(self, x: Float[Array, " free"]) -> Float[Array, " free"]:
        """The parameters at `x` as a vector in the order of `names`."""
        values = self.values(x)
        return jnp.stack([values[name] for name in self.names])

    def slopes(self, x: Float[Array, " free"]) -> Float[Array, "free free"]:
        """Derivatives of the parameters by x."""
        return jax.jacfwd(self.vector)(x)
