"""The problem of a fit as arrays: coordinates in, weighted residuals and their Jacobian out."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from ..scene import State, replace_numbers, scene_numbers
from ._bounded import Box
from ._losses import AbstractLoss
from ._parameters import FreeParameters
from ._record import slip_channel
from ._runs import Runs
from ._starts import placed, taken


class Prior(eqx.Module):
    """What was known before: a mean and the inverse of a standard deviation for each parameter, 0 where nothing was."""

    mean: Float[Array, " free"]
    weight: Float[Array, " free"]


class Problem(eqx.Module):
    """Everything that the residual of a fit depends on.

    The vector x holds the coordinates of the free parameters, then, run by run, the free numbers of the initial states
    as differences from `base`.

    - `engine`: `engine(values, start, run)`, what the model sees.
    - `free`: the parameters. `local`: names of the free numbers of each initial state.
    - `base`: initial states, with a leading axis of runs; None where a model has none.
    - `runs`: the samples. `noise`: standard deviation of each channel.
    - `jump`: inverse standard deviation of the jump of each number of the state from one window to the next, 0 where
      windows do not go on; shape `[runs - 1, numbers]`; None where there are no windows.
    """

    engine: Any
    free: FreeParameters
    local: tuple[str, ...] = eqx.field(static=True)
    base: State | None
    runs: Runs
    noise: dict[str, Array]
    loss: AbstractLoss
    prior: Prior
    jump: Float[Array, "links numbers"] | None = None

    @property
    def count(self) -> int:
        """Number of runs."""
        return self.runs.t.shape[0]

    @property
    def x0(self) -> Float[Array, " n"]:
        """Where the search starts."""
        return jnp.concatenate([self.free.x0, jnp.zeros(self.count * len(self.local), self.free.x0.dtype)])

    @property
    def box(self) -> Box:
        """Bounds of x: those of the parameters; initial states are not limited."""
        lower, upper = self.free.bounds
        open_ = jnp.full(self.count * len(self.local), jnp.inf, lower.dtype)
        return Box(
            jnp.concatenate([lower, -open_]),
            jnp.concatenate([upper, open_]),
            jnp.concatenate([self.free.longest, open_]),
        )

    def split(self, x: Float[Array, " n"]) -> tuple[Float[Array, " free"], Float[Array, "runs local"]]:
        """Coordinates of the parameters, and those of the initial states."""
        size = len(self.free.names)
        return x[:size], jnp.reshape(x[size:], (self.count, len(self.local)))

    def start_of(self, base: State | None, moved: Float[Array, " local"]) -> State | None:
        """Initial state of one run."""
        if base is None or not self.local:
            return base
        return placed(base, self.local, self.taken(base) + moved)

    def taken(self, state: State) -> Float[Array, " local"]:
        """The free numbers of an initial state."""
        return taken(state, self.local)

    def starts(self, x: Float[Array, " n"]) -> State | None:
        """Initial states at `x`, with a leading axis of runs."""
        return jax.vmap(self.start_of)(self.base, self.split(x)[1])

    def seen(self, x: Float[Array, " n"]) -> Any:
        """What the model makes of each run, with a leading axis of runs."""
        values = self.free.values(self.split(x)[0])
        return jax.vmap(lambda start, run: self.engine(values, start, run))(self.starts(x), self.runs)

    def _weigh(self, seen: Any, run: Runs) -> Float[Array, " samples"]:
        """Differences in noise levels, channel after channel; 0 where a sample does not count."""
        parts = []
        for name in sorted(run.measured):
            difference = (seen.channels[name] - run.measured[name]) / self.noise[name]
            parts.append(jnp.where(run.weight[name] > 0, difference, 0.0))
        for effect in sorted(run.slips):
            difference = (seen.slips[effect] - run.slips[effect]) / self.noise[slip_channel(effect)]
            parts.append(jnp.where(run.slip_weight[effect] > 0, difference, 0.0))
        return jnp.concatenate(parts)

    def _one(self, base: State | None, run: Runs, x: Float[Array, " m"]) -> tuple[Array, Array, Array]:
        """Residual, initial and last state of one run; x holds the parameters' coordinates and the run's own."""
        size = len(self.free.names)
        start = self.start_of(base, x[size:])
        seen = self.engine(self.free.values(x[:size]), start, run)
        if self.jump is None:
            return self._weigh(seen, run), jnp.zeros(0, x.dtype), jnp.zeros(0, x.dtype)
        return self._weigh(seen, run), ravel_pytree(start)[0], ravel_pytree(seen.end)[0]

    def evaluate(self, x: Float[Array, " n"]) -> tuple[Float[Array, " rows"], Float[Array, "rows n"]]:
        """Residual and Jacobian: of all samples, of the links between windows, of what was known before.

        All columns of a run go side by side in one forward sweep, which keeps nothing of its steps.
        """
        shared, own = self.split(x)

        def run(base: State | None, run: Runs, own: Array) -> tuple[Any, Any]:
            point = jnp.concatenate([shared, own])
            unit = jnp.eye(point.shape[0], dtype=point.dtype)
            push = lambda e: jax.jvp(lambda x: self._one(base, run, x), (point,), (e,))  # noqa: E731
            return jax.vmap(push, out_axes=(None, -1))(unit)

        if self.count == 1:
            first = jtu.tree_map(lambda x: x[0], (self.base, self.runs, own))
            value, slope = jtu.tree_map(lambda x: x[None], run(*first))
        else:
            value, slope = jax.vmap(run)(self.base, self.runs, own)
        rows = [jnp.reshape(value[0], (-1,)), self.prior.weight * (self.free.vector(shared) - self.prior.mean)]
        columns = [self._spread(slope[0]), self._pad(self.prior.weight[:, None] * self.free.slopes(shared))]
        if self.jump is not None:
            rows.append(jnp.reshape(self.jump * (value[2][:-1] - value[1][1:]), (-1,)))
            here = self._spread(self.jump[:, :, None] * slope[2][:-1])
            there = self._spread(self.jump[:, :, None] * slope[1][1:], first=1)
            columns.append(here - there)
        return jnp.concatenate(rows), jnp.concatenate(columns)

    def _spread(self, slope: Float[Array, "some m k"], first: int = 0) -> Float[Array, "rows n"]:
        """Derivatives of runs `first` and on by their own x, as rows by all of x."""
        some, rows, _ = slope.shape
        size, own = len(self.free.names), len(self.local)
        shared = jnp.reshape(slope[..., :size], (some * rows, size))
        if not own:
            return shared
        place = jnp.arange(some)
        block = jnp.zeros((some, rows, self.count, own), slope.dtype)
        block = block.at[place, :, place + first, :].set(slope[..., size:])
        return jnp.concatenate([shared, jnp.reshape(block, (some * rows, self.count * own))], axis=1)

    def _pad(self, slope: Float[Array, "rows free"]) -> Float[Array, "rows n"]:
        return jnp.pad(slope, ((0, 0), (0, self.count * len(self.local))))

    def with_number(self, name: str, factor: float) -> "Problem":
        """The problem with a number of the scene, which is not free, this many times larger."""
        numbers = scene_numbers(self.engine.scene)
        if name not in numbers:
            raise ValueError(f"The scene has no number {name!r}; it has: {', '.join(numbers)}.")
        scene = replace_numbers(self.engine.scene, {name: factor * numbers[name]})
        return eqx.tree_at(lambda p: p.engine.scene, self, scene)

    @property
    def columns(self) -> dict[str, Float[Array, "runs samples"]]:
        """Weight of each channel by name, slip instants last, in the order of the residual."""
        # Compiled code sorts the entries of a dict, so the order is that of the names everywhere.
        columns = {name: self.runs.weight[name] for name in sorted(self.runs.weight)}
        return columns | {slip_channel(name): self.runs.slip_weight[name] for name in sorted(self.runs.slip_weight)}

    @property
    def samples(self) -> int:
        """Number of rows of the residual that are samples, those without weight included."""
        return sum(weight.size for weight in self.columns.values())

    @property
    def rows(self) -> int:
        """Number of all rows of the residual."""
        links = 0 if self.jump is None else self.jump.size
        return self.samples + len(self.free.names) + links

    @property
    def weights(self) -> Float[Array, " samples"]:
        """1 for each sample row that counts, 0 for the others."""
        return jnp.reshape(jnp.concatenate([*self.columns.values()], axis=1), (-1,))
