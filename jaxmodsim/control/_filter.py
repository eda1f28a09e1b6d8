"""Kalman filters of scenes with friction: motion, states of the laws, and slowly varying numbers."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jax.scipy.special import ndtri
from jaxtyping import Array, ArrayLike, Bool, Float

from .._core.arrays import Scalar, is_known
from ..export import function_to_c
from ..scene import (
    Scene,
    State,
    check_scene,
    check_step,
    elements,
    read_element,
    replace_elements,
    scene_ranges,
    scene_step,
    state_names,
)
from ._square_root import Correction, Gaussian, Step, Transform, correct, linearized, predict, smoothed


class FilterRun(eqx.Module):
    """Estimates along a record.

    - `t`: times [s], shape `[time]`.
    - `names`: names of the states.
    - `logarithmic`: which of them are estimated as logarithms.
    - `states`: the states after each measurement, or given all measurements, see `smooth`.
    - `steps`: predictions between the times.
    - `innovation`: innovations in units of their standard deviations, without correlation, shape `[time, m]`: white
      and standard normal if model and noise levels are right; NaN without a measurement.
    - `log_likelihood`: logarithm of the density of all measurements.
    """

    t: Float[Array, " time"]
    names: tuple[str, ...] = eqx.field(static=True)
    logarithmic: tuple[bool, ...] = eqx.field(static=True)
    states: Gaussian
    steps: Step
    innovation: Float[Array, "time m"]
    log_likelihood: Scalar

    def band(self, name: str, level: float = 0.95) -> tuple[Array, Array, Array]:
        """Estimate of a state or number along the record, and the limits of its interval.

        **Arguments:**

        - `name`: such as `qd[0]`, `friction.z`, or a name in `numbers`.
        - `level`: probability of the interval.

        **Returns:**

        Median, lower and upper limit, shape `[time]` each, in the unit of the number.

        **Raises:**

        - `ValueError` for an unknown name.
        """
        if name not in self.names:
            raise ValueError(f"The filter has no state {name!r}; it has {', '.join(self.names)}.")
        i = self.names.index(name)
        half = ndtri(0.5 + 0.5 * level) * self.states.std[..., i]
        middle = self.states.mean[..., i]
        values = (middle, middle - half, middle + half)
        return tuple(jnp.exp(x) for x in values) if self.logarithmic[i] else values  # pyright: ignore[reportReturnType]

    def smooth(self) -> "FilterRun":
        """The same record with states given all measurements, those after each time included.

        With `rest` > 0 the smoother is approximate: its recursion assumes the gain of least variance, which a filter
        that holds numbers in stick does not use. Their estimates in stick then follow the later measurements, and the
        covariance of the other states there is not exact.

        **Returns:**

        A `FilterRun` with other `states`.
        """

        def back(after: Gaussian, each: tuple[Gaussian, Step]) -> tuple[Gaussian, Gaussian]:
            before = smoothed(*each, after)
            return before, before

        last = jax.tree.map(lambda x: x[-1], self.states)
        first = jax.tree.map(lambda x: x[:-1], self.states)
        _, states = jax.lax.scan(back, last, (first, self.steps), reverse=True)
        states = jax.tree.map(lambda x, end: jnp.concatenate([x, end[None]]), states, last)
        return eqx.tree_at(lambda run: run.states, self, states)


class FrictionFilter(eqx.Module):
    """Kalman filter of a scene, with the states of its friction laws and some of its numbers among the states.

    A prediction is one step of `ImplicitFriction` from one time to the next, at the coordinates in the middle, and
    with coordinates that follow the mean velocity. Numbers, such as a level of friction or a load, vary slowly: they
    are random walks. Those that are positive, by their range or as a `normal_force`, are estimated as logarithms. A
    friction element with `normal_force=1.0` has its level as the number `friction.normal_force`, which scales the force
    of any law.

    In stick a measurement of the motion contains no information on the level of friction, but a bristle, or the creep
    of a smooth law, seems to contain some. While the estimated slip speed of an element is below `rest`, its numbers
    keep their values, and their variance grows by their drift (a consider filter).

    The extended filter (`linearized`) takes one derivative of the step, the unscented one (`unscented`) 2 n steps.
    Noise levels can be fitted by the gradient of the likelihood.

    **Arguments:**

    - `scene`: the `Scene`, as `ImplicitFriction` takes it: bristle laws, or `Regularized`.
    - `noise`: standard deviation of each measured channel, > 0, shape `[m]`, or a number for one channel.
    - `drift`: standard deviation of the change of a state in one second, by name. That of `qd[0]` [m/s per sqrt(s)]
      stands for unknown forces; that of a number that is a logarithm is relative. Other states follow the scene alone.
    - `numbers`: names of the numbers to estimate, as in `jaxmodsim.scene.elements`.
    - `measure`: `measure(t, q, qd, params)` -> the measured channels, shape `[m]`; by default the coordinates.
    - `transform`: `linearized` or `unscented`.
    - `rest`: slip speed [m/s or rad/s] of stick; 0 leaves the numbers free at any speed.
    - `dof`: number of coordinates.

    **Raises:**

    - `ValueError` for a scene that `ImplicitFriction` does not take, and unknown names.

    **Example:**

    ```python
    law = jms.LuGre(sigma0=1e4, sigma1=100.0, sigma2=1.0, Fc=2.0, Fs=3.0, vs=0.02)
    motor = jms.AppliedForce(lambda t, q, qd, p: jnp.reshape(p["u"], (1,)))
    axis = jms.Scene(
        lambda t, q, qd, p: 0.5 * p["m"] * qd[0] ** 2,
        {"m": 1.0, "u": 0.0},
        (motor, jms.Friction(law, normal_force=1.0)),
    )
    filter = jms.control.FrictionFilter(
        axis, noise=1e-5, drift={"qd[0]": 0.01, "friction.normal_force": 0.05}, numbers=("friction.normal_force",)
    )
    t = jnp.linspace(0.0, 1.0, 501)
    run = filter.run(t, 0.5 * t[:, None] ** 2, {"u": jnp.full(501, 4.0)}, filter.start([0.0], [0.0], {"qd[0]": 0.1}))
    print(f"{run.band('qd[0]')[0][-1]:.2f} m/s")
    ```

    ```text
    1.00 m/s
    ```
    """

    scene: Scene
    noise: Float[Array, " m"]
    drift: dict[str, Array]
    rest: Scalar
    numbers: tuple[str, ...] = eqx.field(static=True)
    measure: Callable[..., Array] = eqx.field(static=True)
    transform: Transform = eqx.field(static=True)
    dof: int = eqx.field(static=True)

    def __init__(
        self,
        scene: Scene,
        noise: ArrayLike | Sequence[float],
        drift: Mapping[str, ArrayLike],
        *,
        numbers: Sequence[str] = (),
        measure: Callable[..., Array] | None = None,
        transform: Transform = linearized,
        rest: ArrayLike = 0.0,
        dof: int = 1,
    ) -> None:
        check_step(scene)
        self.scene, self.numbers, self.dof, self.transform = scene, tuple(numbers), dof, transform
        self.measure = _coordinates if measure is None else measure
        kind = self._zero.q.dtype
        self.noise = jnp.atleast_1d(jnp.asarray(noise, kind))
        self.drift = {name: jnp.asarray(x, kind) for name, x in drift.items()}
        self.rest = jnp.asarray(rest, kind)
        check_scene(scene, self._zero)
        if unknown := [name for name in self.numbers if name not in elements(scene)]:
            raise ValueError(
                f"FrictionFilter: the scene has no number {unknown[0]!r}; see {', '.join(elements(scene))}."
            )
        self._vector(self.drift, "drift")

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the states."""
        return (*state_names(self._zero), *self.numbers)

    @property
    def logarithmic(self) -> tuple[bool, ...]:
        """Which states are logarithms."""
        positive = [_is_positive(self.scene, name) for name in self.numbers]
        return (*[False] * (len(self.names) - len(positive)), *positive)

    def start(
        self, q: ArrayLike | Sequence[float], qd: ArrayLike | Sequence[float], std: Mapping[str, ArrayLike]
    ) -> Gaussian:
        """State before the first measurement: unloaded laws, and the numbers of the scene.

        **Arguments:**

        - `q`, `qd`: coordinates and velocities, shape `[dof]`.
        - `std`: standard deviations of states by name; other states are known exactly.

        **Returns:**

        The state.

        **Raises:**

        - `ValueError` for an unknown name, and a number of zero that is estimated as a logarithm.
        """
        kind = self._zero.q.dtype
        y = State(jnp.asarray(q, kind), jnp.asarray(qd, kind), self._zero.z)
        values = []
        for name in self.numbers:
            x = jnp.asarray(read_element(self.scene, name), kind)
            if _is_positive(self.scene, name):
                if is_known(x) and not x > 0:
                    raise ValueError(
                        f"FrictionFilter estimates the logarithm of {name}, which starts at {x}: start above 0."
                    )
                x = jnp.log(x)
            values.append(x)
        mean = jnp.concatenate([ravel_pytree(y)[0], *[x[None] for x in values]])
        return Gaussian(mean, jnp.diag(self._vector(std, "std")))

    def predict(self, x: Gaussian, t0: Scalar, t1: Scalar, inputs: Mapping[str, Array]) -> Step:
        """The state at `t1` from that at `t0`, with inputs that are constant in between.

        **Returns:**

        A `Step`, whose `ahead` is the state.
        """
        noise = self._vector(self.drift, "drift") * jnp.sqrt(t1 - t0)
        return predict(lambda x: self._advance(x, t0, t1, inputs), x, noise, self.transform)

    def correct(self, x: Gaussian, t: Scalar, inputs: Mapping[str, Array], measured: Float[Array, " m"]) -> Correction:
        """The state after a measurement at `t`; channels that are NaN have none.

        **Returns:**

        A `Correction`, whose `state` is the state.
        """

        def channels(x: Array) -> Array:
            y, scene = self._split(x, inputs)
            return self.measure(t, y.q, y.qd, scene.params)

        return correct(channels, x, measured, self.noise, self.transform, self._free(x, t, inputs))

    def run(
        self,
        t: ArrayLike,
        measured: ArrayLike,
        inputs: Mapping[str, ArrayLike],
        start: Gaussian,
    ) -> FilterRun:
        """Filter a record; compiled inside.

        **Arguments:**

        - `t`: times [s], increasing, at any distance, shape `[time]`. Steps must resolve the motion of the mechanism:
          insert times without a measurement where they do not.
        - `measured`: channels at these times, NaN where there is none, shape `[time, m]`.
        - `inputs`: values of `params` by name, each held until the next time, shape `[time]`.
        - `start`: the state at the first time before its measurement, see `start`.

        **Returns:**

        A `FilterRun`.

        **Raises:**

        - `ValueError` for arrays that do not match, times that decrease, and unknown or estimated inputs.
        """
        kind = self._zero.q.dtype
        t, measured = jnp.asarray(t, kind), jnp.asarray(measured, kind)
        inputs = {name: jnp.asarray(x, kind) for name, x in inputs.items()}
        shapes = {"measured": measured.shape, **{name: x.shape for name, x in inputs.items()}}
        wanted = {"measured": (*t.shape, *self.noise.shape), **dict.fromkeys(inputs, t.shape)}
        if wrong := [name for name in shapes if shapes[name] != wanted[name]]:
            name = wrong[0]
            raise ValueError(f"FrictionFilter.run: {name} has shape {shapes[name]}, but {wanted[name]} is needed.")
        if unknown := [name for name in inputs if name not in elements(self.scene)]:
            raise ValueError(f"FrictionFilter.run: the scene has no number {unknown[0]!r} for an input.")
        if both := [name for name in inputs if name in self.numbers]:
            raise ValueError(f"FrictionFilter.run: {both[0]!r} is estimated, so it cannot be an input.")
        if is_known(t) and np.any(np.diff(np.asarray(t)) < 0):
            raise ValueError("FrictionFilter.run: t decreases, but times must increase.")
        return _run(self, t, measured, inputs, start)

    def to_c(self, name: str, inputs: Sequence[str] = ()) -> str:
        """C99 code of a filter's cycle: a prediction over the time h, then the correction by a measurement.

        `void NAME(h, u, y, x, s, x_after, s_after, innovation)` has the inputs during the time h in `u` (without
        inputs it is left out), the measurement in `y` (NaN for an absent channel), and the state as mean `x[n]` and
        factor `s[n * n]`. `x_after` and `s_after` may be the same arrays. The numbers of the scene are constants of the
        code; nothing may depend on time explicitly. The correction has the inputs `u`, too; `run` has those of the
        measurement, which differ where `measure` or a slip velocity depends on an input.

        **Arguments:**

        - `name`: of the function.
        - `inputs`: names of numbers of the scene, in the order of `u`.

        **Returns:**

        The text of one file.

        **Raises:**

        - `ValueError` as `function_to_c`.
        """
        zero = jnp.zeros((), self._zero.q.dtype)
        n, m = len(self.names), self.noise.shape[0]
        like = {"h": zero, **({"u": jnp.zeros(len(inputs), zero.dtype)} if inputs else {})}
        like |= {"y": jnp.zeros(m, zero.dtype), "x": jnp.zeros(n, zero.dtype), "s": jnp.zeros((n, n), zero.dtype)}

        def cycle(h: Array, *rest: Array) -> tuple[Array, Array, Array]:
            u, (measured, mean, factor) = rest[:-3], rest[-3:]
            held = {each: u[0][i] for i, each in enumerate(inputs)}
            ahead = self.predict(Gaussian(mean, factor), zero, h, held).ahead
            done = self.correct(ahead, h, held, measured)
            return done.state.mean, done.state.factor, done.innovation

        purpose = f"A cycle of the filter of {', '.join(self.names)}."
        return function_to_c(cycle, like, ("x_after", "s_after", "innovation"), name=name, purpose=purpose)

    @property
    def _zero(self) -> State:
        leaves = [x for x in jax.tree.leaves(self.scene) if eqx.is_inexact_array(x)]
        start = jnp.zeros(self.dof, jnp.result_type(*(leaves or [float])))
        return State(start, start, self.scene.initial_state(start))

    def _vector(self, values: Mapping[str, ArrayLike], owner: str) -> Float[Array, " n"]:
        if unknown := [name for name in values if name not in self.names]:
            raise ValueError(
                f"FrictionFilter: {owner} names {unknown[0]!r}, but the states are {', '.join(self.names)}."
            )
        kind = self._zero.q.dtype
        return jnp.stack([jnp.asarray(values.get(name, 0.0), kind) for name in self.names])

    def _split(self, x: Float[Array, " n"], inputs: Mapping[str, Array]) -> tuple[State, Scene]:
        """State of the mechanism, and the scene with its inputs and estimated numbers."""
        flat, unravel = ravel_pytree(self._zero)
        values: dict[str, Any] = dict(inputs)
        for i, name in enumerate(self.numbers, start=flat.size):
            values[name] = jnp.exp(x[i]) if _is_positive(self.scene, name) else x[i]
        return unravel(x[: flat.size]), replace_elements(self.scene, values)

    def _advance(self, x: Array, t0: Scalar, t1: Scalar, inputs: Mapping[str, Array]) -> Array:
        y, scene = self._split(x, inputs)
        # Coordinates follow the mean velocity: with that at t1, a velocity known by positions would lag by half a step.
        half = 0.5 * (t1 - t0)
        after, solved = scene_step(scene, t0, t1, State(y.q + half * y.qd, y.qd, y.z))
        flat = ravel_pytree(State(after.q - half * after.qd, after.qd, after.z))[0]
        return jnp.concatenate([jnp.where(solved, flat, jnp.nan), x[flat.size :]])

    def _free(self, x: Gaussian, t: Scalar, inputs: Mapping[str, Array]) -> Float[Array, " n"]:
        """Zero for the numbers of friction elements that stick, one for everything else."""
        y, scene = self._split(x.mean, inputs)
        slips: dict[str, Bool[Array, ""]] = {
            name: jnp.sum(jnp.square(effect.slip(t, y.q, y.qd, scene.params))) >= self.rest**2
            for name, effect in scene.friction.items()
        }
        free = [jnp.ones_like(self.rest)] * (len(self.names) - len(self.numbers))
        for name in self.numbers:
            of = [slip for effect, slip in slips.items() if name.startswith(f"{effect}.")]
            free.append(of[0].astype(self.rest.dtype) if of else jnp.ones_like(self.rest))
        return jnp.stack(free)


def _coordinates(t: Scalar, q: Array, qd: Array, params: Any) -> Array:
    del t, qd, params
    return q


def _is_positive(scene: Scene, name: str) -> bool:
    leaf, _ = elements(scene)[name]
    allowed = scene_ranges(scene).get(leaf)
    return leaf.endswith(".normal_force") or (
        allowed is not None and np.isscalar(allowed.lower) and allowed.lower == 0.0
    )


@eqx.filter_jit
def _run(self: FrictionFilter, t: Array, measured: Array, inputs: dict[str, Array], start: Gaussian) -> FilterRun:
    def at(k: int | Array) -> dict[str, Array]:
        return {name: x[k] for name, x in inputs.items()}

    def cycle(
        x: Gaussian, each: tuple[Array, Array, Array, dict[str, Array], dict[str, Array]]
    ) -> tuple[Gaussian, Any]:
        t0, t1, y, held, now = each
        step = self.predict(x, t0, t1, held)
        done = self.correct(step.ahead, t1, now, y)
        return done.state, (done, step)

    first = self.correct(start, t[0], at(0), measured[0])
    before, now = ({name: x[part] for name, x in inputs.items()} for part in (slice(None, -1), slice(1, None)))
    _, (done, steps) = jax.lax.scan(cycle, first.state, (t[:-1], t[1:], measured[1:], before, now))
    states, innovation, density = jax.tree.map(lambda x, more: jnp.concatenate([x[None], more]), first, done)
    return FilterRun(t, self.names, self.logarithmic, states, steps, innovation, jnp.sum(density))
