"""What a hard case is: something to compute, what is right, and why it is hard."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Int, PyTree

from jaxmodsim.scene import Scene, read_element, replace_elements
from jaxmodsim.simulation import Trajectory, simulate

# In float32 rounding leaves tighter tolerances nothing to work with.
_LEAST_RTOL = {"float64": 0.0, "float32": 3e-6}


class Answer(NamedTuple):
    """What a task gives: 0 or the code of an early end, and the number that is asked for."""

    code: Int[Array, ""]
    value: Float[Array, ""]


class SceneTask(eqx.Module):
    """A run of a scene.

    - `scene`, `q0`, `qd0`, `t1`: as for `simulate`.
    - `by`: the number that the answer is a function of: one of the scene as `sensitivity` calls it, `q0[i]` or
      `qd0[i]`.
    - `read`: the number asked for, of the `Trajectory`.
    - `numbers`: numbers for `simulate` by name: `rtol`, `atol`, `t0`, `ts`, `dt`, `dtmax`.
    - `choices`: what else is passed on: `solver`, `max_steps`, `max_events`, `stick_on_chatter`.
    """

    scene: Scene
    q0: Float[Array, " dof"]
    qd0: Float[Array, " dof"]
    t1: Float[Array, ""]
    by: str = eqx.field(static=True)
    read: Callable[[Trajectory], Array] = eqx.field(static=True)
    numbers: dict[str, Array]
    choices: tuple[tuple[str, PyTree], ...] = eqx.field(static=True)

    @property
    def x(self) -> float:
        """Value of the number `by`."""
        for name in ("q0", "qd0"):
            if self.by.startswith(f"{name}["):
                return float(getattr(self, name)[_index(self.by)])
        return read_element(self.scene, self.by)

    def cast(self, dtype: str) -> "SceneTask":
        """The same in another floating type, and no tighter tolerance than that carries."""
        cast = jtu.tree_map(lambda a: a.astype(dtype) if eqx.is_inexact_array(a) else a, self)
        numbers = cast.numbers | {"rtol": jnp.maximum(cast.numbers["rtol"], _LEAST_RTOL[dtype])}
        return eqx.tree_at(lambda task: task.numbers, cast, numbers)

    def run(self, x: Float[Array, ""]) -> Trajectory:
        """The run for another value of the number `by`."""
        scene, q0, qd0 = self.scene, self.q0, self.qd0
        if self.by.startswith("q0["):
            q0 = q0.at[_index(self.by)].set(x)
        elif self.by.startswith("qd0["):
            qd0 = qd0.at[_index(self.by)].set(x)
        else:
            scene = replace_elements(scene, {self.by: x})
        return simulate(scene, q0, qd0, self.t1, **self.numbers, **dict(self.choices), throw=False)

    def answer(self, x: Float[Array, ""]) -> Answer:
        """The number asked for."""
        run = self.run(x)
        return Answer(run.code, self.read(run))


class FunctionTask(eqx.Module):
    """Another computation of one number from one number: with the event solver alone, or with charts.

    - `fn`: `fn(x)` -> an `Answer`.
    - `x`: the number that it is a function of.
    - `by`: what that is.
    """

    fn: Callable[[Array], Answer] = eqx.field(static=True)
    x: float = eqx.field(static=True)
    by: str = eqx.field(static=True)

    def cast(self, dtype: str) -> "FunctionTask":
        """Itself: it computes in the floating type of its number."""
        del dtype
        return self

    def answer(self, x: Float[Array, ""]) -> Answer:
        """The number asked for."""
        return self.fn(x)


@dataclass(frozen=True)
class MeasuredNumber:
    """A number that is found by many runs, in double precision.

    - `fn`: finds it.
    """

    fn: Callable[[], float]


@dataclass(frozen=True)
class RefusedCalls:
    """Calls that must raise an error that names what is wrong.

    - `calls`: what is called, by name.
    - `match`: regular expression that the error's text of each must match, by name.
    """

    calls: dict[str, Callable[[], object]]
    match: dict[str, str]


@dataclass(frozen=True, eq=False)
class HardCase:
    """A case in which simulations go wrong.

    - `name`: as in `hard_cases`.
    - `why`: the reason it is hard.
    - `naive`: what a plain simulation does.
    - `task`: a `SceneTask`, a `FunctionTask`, `MeasuredNumber` or `RefusedCalls`.
    - `exact`: the right answer as a function of the number the task is a function of, in closed form.
    - `slope`: its derivative in closed form, where differences of `exact` do not give it.
    - `second`: the right answer by a second solver, where there is no closed form; the derivative is then held against
      finite differences of the answer.
    - `scale`: what errors are relative to, in the unit of the answer; by default the right answer's magnitude.
    - `tolerance`: admissible relative error in float64; of derivatives ten times that, relative to `scale` over the
      number, or to the derivative where that is larger.
    - `single`: the same in float32; None where it makes no sense there.
    - `ends`: part of the sentence with which the run must end; empty for one that reaches t1.
    - `single_ends`: part of a sentence with which the run may end in float32 instead: what cannot be resolved there is
      either right or says so, as rounding has it.
    - `undefined`: why there is no derivative; empty where there is one. Then `check_gradients` must say so.
    - `conserves`: whether the energy balance has to close: not where the run fails, or where fixed steps are long.
    - `skips`: entries of `TRANSFORMS` that are not run, in both types or in one ("reverse float32"), and the reason.
    - `asks`: what is asked for, with its unit; by default as the task says it.
    - `family`: as in `hard_cases`, which sets it.
    """

    name: str
    why: str
    naive: str
    task: SceneTask | FunctionTask | MeasuredNumber | RefusedCalls
    exact: Callable[[float], float] | None = None
    slope: Callable[[float], float] | None = None
    second: Callable[[], float] | None = None
    scale: float | None = None
    tolerance: float = 1e-6
    single: float | None = 1e-3
    ends: str = ""
    single_ends: str = ""
    undefined: str = ""
    conserves: bool = True
    skips: Mapping[str, str] = field(default_factory=dict)
    asks: str = ""
    family: str = ""

    def __post_init__(self) -> None:
        """What is asked for, where the task says it."""
        if not self.asks and isinstance(self.task, SceneTask) and self.task.read in (position, velocity):
            unit = "m" if self.task.read is position else "m/s"
            asks = f"{self.task.read.__name__} at {float(self.task.t1):g} s [{unit}]"
            object.__setattr__(self, "asks", asks)


def motion(
    scene: Scene,
    q0: object,
    qd0: object,
    t1: float,
    *,
    by: str,
    read: Callable[[Trajectory], Array],
    numbers: Mapping[str, ArrayLike | list[float]] | None = None,
    **choices: object,
) -> SceneTask:
    """A `SceneTask` from plain numbers; by default at `rtol=1e-9, atol=1e-11`."""
    given = {"rtol": 1e-9, "atol": 1e-11, **(numbers or {})}
    arrays = {name: jnp.asarray(np.asarray(value, float)) for name, value in given.items()}
    q, qd, end = (jnp.asarray(np.asarray(x, float)) for x in (q0, qd0, t1))
    return SceneTask(scene, q, qd, end, by, read, arrays, tuple(choices.items()))


def position(run: Trajectory) -> Array:
    """The first coordinate at the end."""
    return run.q[-1, 0]


def velocity(run: Trajectory) -> Array:
    """The first velocity at the end."""
    return run.qd[-1, 0]


def end_time(run: Trajectory) -> Array:
    """How far the run came."""
    return run.t_end


def _index(name: str) -> int:
    return int(name[name.index("[") + 1 : -1])


def differentiate(fn: Callable[[float], float], x: float, step: float = 1e-4) -> float:
    """Derivative by central differences of relative steps `step` and half of it, extrapolated once.

    Its error is that of `fn` over the step, and the step's fourth power.
    """
    h = step * (abs(x) or 1.0)

    def slope(h: float) -> float:
        return (float(fn(x + h)) - float(fn(x - h))) / (2.0 * h)

    return (4.0 * slope(0.5 * h) - slope(h)) / 3.0
