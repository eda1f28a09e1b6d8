"""The problem of a fit as arrays, from coordinates to weighted residuals and their Jacobian, and the losses."""

import abc
from collections.abc import Collection, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from ..._core.arguments import as_float
from ..._core.arrays import on_device
from ..._core.parameters import AbstractRanged, Number, parameter
from ...scene import State, replace_numbers, scene_numbers
from ..data._record import Runs, slip_channel
from ..model._engines import ModelOutput
from ..model._parameters import FreeParameters, ParameterPoint

if TYPE_CHECKING:
    from typing import ClassVar as AbstractClassVar
else:
    from equinox import AbstractClassVar

_Rows = TypeVar("_Rows", Array, np.ndarray)
# Inverse standard deviation of a start that is held, in noise levels.
_HELD = 1e6


class AbstractLoss(AbstractRanged):
    """Loss of a residual in units of its noise level, as a function of its square: `rho(s)`, rho = s for small s."""

    robust: AbstractClassVar[bool]

    @abc.abstractmethod
    def rho(self, s: Float[Array, "..."]) -> Float[Array, "..."]:
        """The loss where the square of the residual is `s`."""

    @eqx.filter_jit
    def cost(self, residual: Float[Array, " m"]) -> Float[Array, ""]:
        """Half the sum of the losses."""
        return 0.5 * jnp.sum(self.rho(residual**2))

    @eqx.filter_jit
    def weighted(
        self, residual: Float[Array, " m"], jacobian: Float[Array, "m n"]
    ) -> tuple[Float[Array, " m"], Float[Array, "m n"]]:
        """Residual and Jacobian of a least-squares problem with the gradient of the cost and nearly its curvature.

        Triggs et al. 2000, Bundle adjustment, section 4.3, without the second derivative of rho, which is negative
        and may make the matrix indefinite.
        """
        if not self.robust:
            return residual, jacobian
        weight = jnp.sqrt(jax.vmap(jax.grad(self.rho))(residual**2))
        return weight * residual, weight[:, None] * jacobian

    @eqx.filter_jit
    def influence(self, residual: Float[Array, " m"]) -> tuple[Float[Array, " m"], Float[Array, " m"]]:
        """Half the derivative of the loss by the residual, and the derivative of that."""
        first, second = jax.grad(self.rho), jax.grad(jax.grad(self.rho))
        s = residual**2
        weight = jax.vmap(first)(s)
        return weight * residual, weight + 2.0 * s * jax.vmap(second)(s)


class SquaredLoss(AbstractLoss):
    """Least squares: the maximum likelihood of normal noise."""

    robust: ClassVar[bool] = False

    def rho(self, s: Float[Array, "..."]) -> Float[Array, "..."]:
        """The loss where the square of the residual is `s`."""
        return s


class Huber(AbstractLoss):
    """Quadratic up to `limit` noise levels and linear beyond: the influence of outliers is bounded.

    **Arguments:**

    - `limit`: in noise levels, > 0; 1.345 keeps 95 % of the efficiency of least squares on normal noise (Huber 1964).

    **Raises:**

    - `ValueError` if `limit` is out of range or no number.
    """

    limit: Number = parameter("limit", "1", lower=0.0, strict=True, default=1.345)
    robust: ClassVar[bool] = True

    def rho(self, s: Float[Array, "..."]) -> Float[Array, "..."]:
        """The loss where the square of the residual is `s`."""
        inside = s <= self.limit**2
        return jnp.where(inside, s, 2 * self.limit * jnp.sqrt(jnp.where(inside, 1.0, s)) - self.limit**2)


class Cauchy(AbstractLoss):
    """`limit^2 log(1 + s/limit^2)`: the influence of far outliers vanishes.

    **Arguments:**

    - `limit`: in noise levels, > 0; 2.385 keeps 95 % of the efficiency of least squares on normal noise.

    **Raises:**

    - `ValueError` if `limit` is out of range or no number.
    """

    limit: Number = parameter("limit", "1", lower=0.0, strict=True, default=2.385)
    robust: ClassVar[bool] = True

    def rho(self, s: Float[Array, "..."]) -> Float[Array, "..."]:
        """The loss where the square of the residual is `s`."""
        return self.limit**2 * jnp.log1p(s / self.limit**2)


class Box(NamedTuple):
    """Bounds of x, and the longest change of each in one iteration, shape `[n]` each."""

    lower: Float[Array, " n"]
    upper: Float[Array, " n"]
    longest: Float[Array, " n"]


def _flat_names(y: State) -> list[str]:
    """Name of each entry of the flattened state; "" for those that cannot be free."""
    dof = y.q.shape[0]
    names = [f"q0[{i}]" for i in range(dof)] + [f"qd0[{i}]" for i in range(dof)]
    for effect, z in sorted(y.z.items()):
        if isinstance(z, jnp.ndarray) and z.ndim < 2:
            names += [f"z0.{effect}"] if z.ndim == 0 else [f"z0.{effect}[{i}]" for i in range(z.shape[0])]
        else:
            names += [""] * sum(jnp.size(leaf) for leaf in jtu.tree_leaves(z))
    return names


def local_names(y: State) -> tuple[str, ...]:
    """Names of the numbers of an initial state: `q0[0]`, `qd0[0]`, `z0.friction`."""
    return tuple(filter(None, _flat_names(y)))


class Prior(eqx.Module):
    """Prior knowledge: a mean and the inverse of a standard deviation for each parameter, 0 for none."""

    mean: Float[Array, " free"]
    weight: Float[Array, " free"]

    @staticmethod
    def of(prior: Mapping[str, tuple[float, float]], names: tuple[str, ...]) -> "Prior":
        """From means and standard deviations by name.

        **Raises:**

        - `ValueError` for a name that is not free, and anything but a mean and a standard deviation > 0.
        """
        mean, weight = np.zeros(len(names)), np.zeros(len(names))
        for name, pair in prior.items():
            if name not in names:
                raise ValueError(f"prior names {name!r}, but the free parameters are: {', '.join(names)}.")
            numbers = [as_float(x, name=f"prior of {name!r}") for x in pair] if isinstance(pair, tuple | list) else []
            if len(numbers) != 2 or not numbers[1] > 0:
                raise ValueError(f"prior of {name} must be a mean and a standard deviation > 0, but it is {pair}.")
            mean[names.index(name)], weight[names.index(name)] = numbers[0], 1 / numbers[1]
        return Prior(*(on_device(x.astype(jnp.result_type(float))) for x in (mean, weight)))


class FitProblem(eqx.Module):
    """Everything that the residual of a fit depends on.

    The vector x holds the coordinates of the free parameters, then, run by run, the free numbers of the initial states
    as differences from `base`.

    - `engine`: `engine(values, start, run)`, the output of the model.
    - `free`: the parameters. `local`: names of the free numbers of each initial state; the last `nuisance` of them are
      unknown, so they are fitted, but not reported.
    - `base`: initial states, with a leading axis of runs; None for a model without states.
    - `runs`: the samples. `noise`: standard deviation of each channel.
    - `jump`: inverse standard deviation of the jump of each number of the state from one window to the next, 0 where
      a window does not continue; shape `[runs - 1, numbers]`; None without windows.
    - `known`: knowledge of the initial states from the first samples of a channel: inverse standard deviations of the
      differences from `base`, times the noise of that channel, 0 for none; by channel, shape `[runs, local]`.
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
    nuisance: int = eqx.field(static=True, default=0)
    known: dict[str, Float[Array, "runs local"]] = eqx.field(default_factory=dict)

    @property
    def start_weights(self) -> Float[Array, "runs local"] | None:
        """Inverse standard deviations of the free numbers of the initial states; None if nothing is known."""
        weights = [each / self.noise[name] for name, each in self.known.items()]
        return jnp.sum(jnp.stack(weights), axis=0) if weights else None

    @property
    def held(self) -> "FitProblem":
        """The problem whose unreported starts stay at `base`: only arrays differ, so nothing compiles again.

        In a search far from the optimum they would otherwise take up the errors of the parameters.
        """
        if not self.nuisance:
            return self
        unreported = jnp.arange(len(self.local)) >= self.reported
        known = {name: jnp.where(unreported[None, :], _HELD, each) for name, each in self.known.items()}
        return eqx.tree_at(lambda p: p.known, self, known)

    def pinned(
        self, x: Float[Array, " n"], information: Float[np.ndarray, "known known"], free: Collection[str] = ()
    ) -> "FitProblem":
        """The problem with all parameters but `free` held at `x`, by a prior: only arrays differ.

        Each parameter moves by no more than a millionth of its standard error by `information`, the Fisher information
        of the parameters. The weight leaves a quarter of the digits, so that the normal equations are well scaled.
        """
        mean = self.at(x).vector
        stiff = float(np.finfo(mean.dtype).eps) ** -0.25
        known = np.sqrt(np.maximum(np.diag(information)[: len(mean)], 0.0))  # rounding may make it negative
        size = np.abs(mean)
        weight = stiff * np.maximum(known, 1 / np.where(size > 0, size, 1.0))
        moves = np.array([name in free for name in self.free.names], bool)
        held = Prior(
            on_device(np.where(moves, np.asarray(self.prior.mean), mean)),
            on_device(np.where(moves, np.asarray(self.prior.weight), weight).astype(mean.dtype)),
        )
        return eqx.tree_at(lambda p: p.prior, self, held)

    def counting(self, mask: Bool[np.ndarray, "runs samples"], *, slips: bool = True) -> "FitProblem":
        """The problem in which only the samples of the mask count, and with `slips` the slip instants of their runs."""
        own = np.any(mask, axis=1, keepdims=True) & slips
        runs = self.runs._replace(
            weight={name: on_device(np.asarray(weight) * mask) for name, weight in self.runs.weight.items()},
            slip_weight={name: on_device(np.asarray(weight) * own) for name, weight in self.runs.slip_weight.items()},
        )
        return eqx.tree_at(lambda p: p.runs, self, runs)

    def of_runs(self, rows: Int[Array, " some"] | slice) -> "FitProblem":
        """The problem of some of the runs."""
        base, runs, known = jtu.tree_map(lambda leaf: leaf[rows], (self.base, self.runs, self.known))
        return replace(self, base=base, runs=runs, known=known)

    @property
    def reported(self) -> int:
        """Number of the entries of `local` that are reported, the first ones."""
        return len(self.local) - self.nuisance

    @property
    def count(self) -> int:
        """Number of runs."""
        return self.runs.t.shape[0]

    @property
    def x0(self) -> Float[Array, " n"]:
        """Start of the search."""
        x0 = np.asarray(self.free.x0)
        return on_device(np.concatenate([x0, np.zeros(self.count * len(self.local), x0.dtype)]))

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

    def at(self, x: ArrayLike) -> ParameterPoint:
        """The parameters at a known x, shape `[n]`."""
        return self.free.at(np.asarray(x)[: len(self.free.names)])

    def slopes_at(self, x: ArrayLike) -> Float[np.ndarray, "n n"]:
        """Derivatives by x, shape `[n]`, of the parameters and of the free numbers of the initial states."""
        slopes, size = np.eye(np.size(x)), len(self.free.names)
        slopes[:size, :size] = self.at(x).slopes
        return slopes

    def start_of(self, base: State | None, moved: Float[Array, " local"]) -> State | None:
        """Initial state of one run."""
        if base is None or not self.local:
            return base
        flat, unflatten = ravel_pytree(base)
        return unflatten(flat.at[self._free_entries(base)].add(moved))

    def local_values(self, state: State) -> Float[Array, " local"]:
        """The free numbers of an initial state."""
        return ravel_pytree(state)[0][self._free_entries(state)]

    def _free_entries(self, state: State) -> Int[np.ndarray, " local"]:
        names = _flat_names(state)
        return np.array([names.index(name) for name in self.local], int)

    def starts(self, x: Float[Array, " n"]) -> State | None:
        """Initial states at `x`, with a leading axis of runs."""
        return jax.vmap(self.start_of)(self.base, self.split(x)[1])

    def seen(self, x: Float[Array, " n"]) -> ModelOutput:
        """Output of the model for each run, with a leading axis of runs."""
        values = self.free.values(self.split(x)[0])
        return jax.vmap(lambda start, run: self.engine(values, start, run))(self.starts(x), self.runs)

    def _weigh(self, seen: ModelOutput, run: Runs) -> Float[Array, " samples"]:
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
        """Residual and Jacobian: of all samples, the prior, the links between windows, the knowledge of the starts.

        All columns of a run are computed in one forward sweep, which stores no steps.
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
        of_prior = self.prior.weight[:, None] * self.free.slopes(shared)
        columns = [self._spread(slope[0]), jnp.pad(of_prior, ((0, 0), (0, self.count * len(self.local))))]
        if self.jump is not None:
            rows.append(jnp.reshape(self.jump * (value[2][:-1] - value[1][1:]), (-1,)))
            ends = self._spread(self.jump[:, :, None] * slope[2][:-1])
            columns.append(ends - self._spread(self.jump[:, :, None] * slope[1][1:], first=1))
        known = self.start_weights
        if known is not None:
            rows.append(jnp.reshape(known * own, (-1,)))
            columns.append(jnp.pad(jnp.diag(jnp.reshape(known, (-1,))), ((0, 0), (shared.shape[0], 0))))
        jacobian = jnp.concatenate(columns)
        # Columns of nothing but rounding become zero: those of a velocity that stick takes away at the start.
        size = jnp.sqrt(jnp.sum(jacobian**2, axis=0))
        tiny = float(jnp.finfo(size.dtype).eps) ** 1.5 * jnp.max(size)
        return jnp.concatenate(rows), jnp.where(size > tiny, jacobian, 0.0)

    def _spread(self, slope: Float[Array, "some m k"], first: int = 0) -> Float[Array, "rows n"]:
        """Derivatives of the runs from `first` on by their own x, as rows by all of x."""
        some, rows, _ = slope.shape
        size, own = len(self.free.names), len(self.local)
        shared = jnp.reshape(slope[..., :size], (some * rows, size))
        if not own:
            return shared
        place = jnp.arange(some)
        block = jnp.zeros((some, rows, self.count, own), slope.dtype)
        block = block.at[place, :, place + first, :].set(slope[..., size:])
        return jnp.concatenate([shared, jnp.reshape(block, (some * rows, self.count * own))], axis=1)

    def with_number(self, name: str, factor: float) -> "FitProblem":
        """The problem with a fixed number of the model multiplied by a factor."""
        numbers = scene_numbers(self.engine.model)
        if name not in numbers:
            raise ValueError(f"The model has no number {name!r}; it has: {', '.join(numbers)}.")
        model = replace_numbers(self.engine.model, {name: on_device(factor * np.asarray(numbers[name]))})
        return eqx.tree_at(lambda p: p.engine.model, self, model)

    @property
    def columns(self) -> dict[str, Float[Array, "runs samples"]]:
        """Weight of each channel by name, slip instants last, in the order of the residual."""
        # Compiled code sorts the entries of a dict, so all orders are those of the names.
        columns = {name: self.runs.weight[name] for name in sorted(self.runs.weight)}
        return columns | {slip_channel(name): self.runs.slip_weight[name] for name in sorted(self.runs.slip_weight)}

    def by_channel(self, rows: _Rows) -> dict[str, tuple[_Rows, _Rows]]:
        """Rows of the residual, shape `[rows]`, and weights of each channel, shape `[runs, samples]` each."""
        table, split, at = rows[: self.samples].reshape(self.count, -1), {}, 0
        for name, weight in self.columns.items():
            own = np.asarray(weight) if isinstance(rows, np.ndarray) else weight
            split[name] = table[:, at : at + weight.shape[1]], own
            at += weight.shape[1]
        return split

    @property
    def samples(self) -> int:
        """Number of rows of the residual that are samples, those without weight included."""
        return sum(weight.size for weight in self.columns.values())

    @property
    def rows(self) -> int:
        """Number of all rows of the residual."""
        links = 0 if self.jump is None else self.jump.size
        starts = self.count * len(self.local) if self.known else 0
        return self.samples + len(self.free.names) + links + starts

    @property
    def weights(self) -> Float[np.ndarray, " samples"]:
        """1 for each sample row that counts, 0 for the others."""
        return np.concatenate([np.asarray(weight) for weight in self.columns.values()], axis=1).reshape(-1)
