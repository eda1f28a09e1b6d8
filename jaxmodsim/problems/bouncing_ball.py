"""A ball that bounces on the floor, with infinitely many events in a finite time."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float

from .._core.parameters import Number, check_ranges, parameter
from ..mechanics import Contact
from ..scene import Scene
from ..solvers import EventState


def falling(t: Array, q: Array, qd: Array, p: dict[str, Array]) -> Array:
    """Lagrangian [J] of a mass `m` [kg] at the height `q[0]` [m] under gravity `g` [m/s^2].

    **Returns:**

    The Lagrangian, shape `[]`.
    """
    return 0.5 * p["m"] * qd[0] ** 2 - p["m"] * p["g"] * q[0]


class BouncingBall(eqx.Module):
    """A point mass that bounces on a floor, as functions for `jaxmodsim.EventSolver`.

    The state is (height [m], velocity [m/s]), positive upwards, shape `[2]`. The mode is 0 in flight, and 1 at rest on
    the floor, where bounces accumulate. `bounces` has the times of the bounces, `motion` the motion, `rest` the time of
    the rest.

    **Arguments:**

    - `e`: coefficient of restitution, > 0; the ball comes to rest for e < 1.
    - `g`: gravity [m/s^2], > 0.

    **Raises:**

    - `ValueError` if a parameter is out of range or no number.

    **Example:**

    ```python
    ball = jms.problems.bouncing_ball.BouncingBall(e=0.5)
    solver = jms.EventSolver(diffrax.Tsit5(), ball.guards, ball.reset, carries_on=True)
    control = jms.EventController(diffrax.PIDController(rtol=1e-8, atol=1e-8))
    start, field = solver.start(0.0, ball.dropped(h=1.0), mode=0.0), diffrax.ODETerm(ball.field)
    solution = diffrax.diffeqsolve(field, solver, 0.0, 2.0, None, start, stepsize_controller=control)
    print(solution.ys.y, solution.ys.mode)  # at rest since 1.35 s
    ```

    ```text
    [[0. 0.]] [1.]
    ```
    """

    e: Number = parameter("e", "", lower=0.0, strict=True)
    g: Number = parameter("g", "m/s^2", lower=0.0, strict=True, default=9.81)

    def __check_init__(self) -> None:
        """Check the ranges of the parameters."""
        check_ranges(self)

    def dropped(self, h: ArrayLike) -> Float[Array, "2"]:
        """The state at rest at the height `h` [m], > 0."""
        h = jnp.asarray(h, self.g.dtype)
        return jnp.stack([h, jnp.zeros_like(h)])

    def field(self, t: object, s: EventState, args: object) -> EventState:
        """Rate of the state: free fall, or zero at rest on the floor."""
        return s.rate(jnp.where(s.mode > 0.5, 0.0, jnp.stack([s.y[1], -self.g])))

    def guards(self, t: object, s: EventState, args: object) -> Float[Array, "1"]:
        """Height above the floor [m]."""
        return s.y[:1]

    def reset(self, t: object, s: EventState, args: object, fired: Bool[Array, "1"]) -> EventState:
        """Bounce: multiply the velocity by -e. Where bounces accumulate, stop the ball on the floor."""
        assert s.dense is not None
        after = jnp.stack([jnp.zeros_like(s.y[0]), -self.e * s.y[1]])
        return s._replace(y=jnp.where(s.dense, 0.0, after), mode=jnp.where(s.dense, 1.0, s.mode))


def _height(t: Array, q: Array, p: dict[str, Array]) -> Array:
    return q[0]


def scene(*, e: ArrayLike, g: ArrayLike = 9.81, m: ArrayLike = 1.0) -> Scene:
    """The ball at the height `q[0]` [m] over the contact `floor`.

    **Arguments:**

    - `e`: coefficient of restitution, 0 to 1.
    - `g`: gravity [m/s^2], > 0.
    - `m`: mass [kg], > 0.

    **Returns:**

    A `Scene` with one coordinate [m]. Dropped from `h` it follows `motion`.

    **Raises:**

    - `ValueError` if `e` is out of range.
    """
    return Scene(falling, params={"m": m, "g": g}, constraints=(Contact(_height, restitution=e, name="floor"),))


def bounces(n: int, *, h: ArrayLike, e: ArrayLike, g: ArrayLike = 9.81) -> Float[Array, " n"]:
    """Times [s] of the first `n` bounces after a drop from `h` at t = 0: `sqrt(2 h/g) (1 + 2 (e + e^2 + ...))`.

    **Arguments:**

    - `n`: number of bounces, > 0.
    - `h`: height [m], > 0.
    - `e`: coefficient of restitution, > 0.
    - `g`: gravity [m/s^2], > 0.

    **Returns:**

    The times, shape `[n]`.
    """
    powers = jnp.asarray(e) ** jnp.arange(1, n)
    return jnp.sqrt(2.0 * h / jnp.asarray(g)) * jnp.concatenate([jnp.ones(1), 1.0 + 2.0 * jnp.cumsum(powers)])


def rest(*, h: ArrayLike, e: ArrayLike, g: ArrayLike = 9.81) -> Float[Array, ""]:
    """Time [s] at which the ball comes to rest: `sqrt(2 h/g) (1 + e)/(1 - e)` for e < 1; arguments as for `bounces`.

    **Returns:**

    The time, shape `[]`.
    """
    e = jnp.asarray(e)
    return jnp.sqrt(2.0 * h / jnp.asarray(g)) * (1.0 + e) / (1.0 - e)


def motion(
    t: Float[Array, "..."], *, h: ArrayLike, e: ArrayLike, g: ArrayLike = 9.81
) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
    """Height [m] and velocity [m/s] at the times `t` [s], after a drop from `h` at t = 0; shape as `t`.

    The time left before rest falls by the factor e from bounce to bounce, so its logarithm counts the bounces. After
    bounce n the motion is a throw at `e^n sqrt(2 g h)`. Arguments as for `rest`, t >= 0.

    **Returns:**

    Height and velocity, of the shape of `t` each; zero after the rest.
    """
    g = jnp.asarray(g)
    fall, end = jnp.sqrt(2.0 * h / g), rest(h=h, e=e, g=g)
    bouncing = (t >= fall) & (t < end)
    left = jnp.where(bouncing, (end - t) / (end - fall), 1.0)
    n = 1.0 + jnp.floor(jnp.log(left) / jnp.log(e))
    speed = e**n * g * fall
    since = t - (end - (end - fall) * e ** (n - 1.0))
    height = jnp.where(bouncing, speed * since - 0.5 * g * since**2, h - 0.5 * g * t**2)
    velocity = jnp.where(bouncing, speed - g * since, -g * t)
    return jnp.where(t < end, height, 0.0), jnp.where(t < end, velocity, 0.0)
