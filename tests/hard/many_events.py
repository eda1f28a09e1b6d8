"""Many events: accumulating, chattering, simultaneous, endlessly repeated, and touching without crossing."""

import math
from collections.abc import Callable
from typing import ClassVar

import diffrax as dfx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from jaxmodsim.friction import AbstractSetValuedLaw, Coulomb
from jaxmodsim.problems import belt_oscillator, bouncing_ball, braked_spring, coupled_belts, ramped_box
from jaxmodsim.scene import AppliedForce, Friction, Scene
from jaxmodsim.simulation import Trajectory
from jaxmodsim.solvers import EventController, EventSolver, EventState, StoredSteps

from .case import Answer, FunctionTask, HardCase, motion, position

FAMILY = "many events"
_G = 9.81


def _solve(
    field: Callable[..., EventState],
    solver: EventSolver,
    t1: float,
    start: EventState,
) -> tuple[Array, PyTree]:
    """Code and last state of a run of the event solver in plain diffrax."""
    dtype = start.t.dtype
    rtol = 1e-10 if dtype == jnp.float64 else 1e-6
    solution = dfx.diffeqsolve(
        dfx.ODETerm(field),
        solver,
        jnp.zeros((), dtype),
        jnp.asarray(t1, dtype),
        None,
        start,
        stepsize_controller=EventController(dfx.PIDController(rtol=rtol, atol=rtol)),
        adjoint=StoredSteps(),
        max_steps=4096,
        throw=False,
    )
    assert solution.ys is not None
    code = jnp.where(solution.result == dfx.RESULTS.successful, 0, 1)
    return code, solution.ys


def _bounce(e: Array, held: bool) -> Answer:
    ball = bouncing_ball.BouncingBall(e=e, g=jnp.asarray(_G, e.dtype))
    solver = EventSolver(dfx.Tsit5(), ball.guards, ball.reset, carries_on=held, max_events=512, log=0)
    start = solver.start(jnp.zeros((), e.dtype), ball.dropped(1.0), mode=jnp.zeros((), e.dtype))
    code, ys = _solve(ball.field, solver, 2.0, start)
    return Answer(code, ys.t[-1])


def _bounce_to_rest(e: Array) -> Answer:
    return _bounce(e, held=True)


def _bounce_unheld(e: Array) -> Answer:
    return _bounce(e, held=False)


def _zeno() -> list[HardCase]:
    def rest(e: float) -> float:
        return float(bouncing_ball.rest(h=1.0, e=e, g=_G))

    return [
        HardCase(
            "bouncing_ball",
            "A ball comes to rest after infinitely many bounces in 1.35 s.",
            "It falls through the floor when the bounces come closer than the event search resolves.",
            FunctionTask(_bounce_to_rest, 0.5, "coefficient of restitution"),
            rest,
            asks="time of rest [s]",
        ),
        HardCase(
            "bouncing_ball_unheld",
            "The same without a state of rest to go to.",
            "Smaller and smaller steps without end.",
            FunctionTask(_bounce_unheld, 0.5, "coefficient of restitution"),
            rest,
            asks="a named end, at the time of rest [s]",
            ends="ended early",
        ),
    ]


def _load_of_deflection(t: Array, q: Array, qd: Array, p: dict[str, Array]) -> Array:
    return p["k"] * jnp.abs(q[0])


def _shrinking_swing() -> HardCase:
    """Friction in proportion to the deflection: from turn to turn the swing shrinks by a factor, for ever.

    Towards the middle the spring acts as one of `k (1 - mu)`, away from it as one of `k (1 + mu)`.
    """
    m, mu, n = 1.0, 0.2, 100

    def factor(mu: float) -> float:
        return math.sqrt((1.0 - mu) / (1.0 + mu))

    t1 = n * 0.5 * math.pi * (1.0 / math.sqrt(1.0 - mu) + 1.0 / math.sqrt(1.0 + mu))

    def slope(mu: float) -> float:
        # The times of the turns move, too, but at a turn that is nothing.
        return -n / (1.0 - mu**2) * factor(mu) ** n

    friction = Friction(Coulomb(mu), normal_force=_load_of_deflection)
    scene = Scene(braked_spring.scene().lagrangian, params={"m": m, "k": 1.0}, effects=(friction,))
    numbers = {"rtol": 1e-10, "atol": 0.0}
    task = motion(scene, [1.0], [0.0], t1, by="friction.Fc", read=position, numbers=numbers, max_steps=65536)
    return HardCase(
        "shrinking_swing",
        "A hundred reversals, each swing 0.82 of the one before: 1.6e-9 m at the end, with atol = 0.",
        "Absolute tolerances stop it at their own size; thresholds in SI units take it for rest.",
        task,
        lambda mu: factor(mu) ** n,
        slope,
        asks="position at the 100th turn [m]",
        # At the last turn an error of its time, 1e-4 s of 321 s, is seen in the derivative alone.
        tolerance=1e-5,
        single=1e-2,
    )


class Contradictory(AbstractSetValuedLaw):
    """Holds 1 N at most, but resists slip with 2 N: between the two it can neither stick nor slip."""

    stiff: ClassVar[bool] = False

    def sliding_force(self, v: Float[Array, ""]) -> Float[Array, ""]:
        """Friction in slip [N]."""
        return jnp.full_like(v, 2.0)

    def viscous_force(self, v: Float[Array, ""]) -> Float[Array, ""]:
        """No viscous part."""
        return jnp.zeros_like(v)

    def static_limit(self, direction: Float[Array, ""]) -> Float[Array, ""]:
        """Largest force in stick [N]."""
        return jnp.ones_like(direction)


def _chatter() -> list[HardCase]:
    scene = ramped_box.scene(Contradictory())
    why = "A law that holds 1 N but resists slip with 2 N: in between it can neither stick nor slip."
    naive = "Ever smaller steps; a fixed step averages to something."
    return [
        HardCase(
            "chatter_named",
            why,
            naive,
            motion(scene, [0.0], [0.0], 1.8, by="ramp", read=position),
            asks="the sentence",
            ends="mode changes of 'friction' accumulate: chatter",
        ),
        HardCase(
            "chatter_held",
            why,
            naive,
            motion(scene, [0.0], [0.0], 1.8, by="ramp", read=position, stick_on_chatter=True),
            lambda _: 0.0,
            asks="position at 1.8 s, held in stick [m]",
            scale=1.0,
        ),
    ]


def _cycles() -> list[HardCase]:
    belt = belt_oscillator.PARAMS["belt"]

    def place(t1: float, k: float) -> float:
        return float(belt_oscillator.motion(jnp.asarray(t1), **(belt_oscillator.PARAMS | {"k": k}))[0])

    def drift(k: float) -> float:
        """Derivative of the place after 1e5 cycles: differences of it would have to be of 1e-8."""
        return float(
            jax.grad(lambda k: belt_oscillator.motion(jnp.asarray(late), **(belt_oscillator.PARAMS | {"k": k}))[0])(k)
        )

    def together(t1: float) -> float:
        return place(t1, belt_oscillator.PARAMS["k"])

    law = Coulomb(belt_oscillator.PARAMS["Fc"], belt_oscillator.PARAMS["Fs"])
    twins = coupled_belts.scene((law, law), m1=1.0, m2=1.0, k1=100.0, k2=100.0, coupling=35.0)
    period = float(belt_oscillator.cycle(**belt_oscillator.PARAMS).period)
    late = (1e5 + 0.3) * period
    long = motion(
        belt_oscillator.scene(), [0.0], [belt], late, by="k", read=position, numbers={"rtol": 1e-11, "atol": 1e-13},
        solver=dfx.Dopri8(), max_steps=1 << 23, max_events=1 << 18,
    )  # fmt: skip
    return [
        HardCase(
            "simultaneous",
            "Two masses break away, and stick again, at the very same instants.",
            "One event of the two is handled, the other is behind the solver.",
            motion(twins, [0.0, 0.0], [belt, belt], 5.0, by="coupling", read=position),
            lambda _: together(5.0),
        ),
        HardCase(
            "cycles_100000",
            "1e5 cycles of stick and slip: an error of 1e-9 in each instant adds up, and so does any bias.",
            "Minutes of event search; a period that drifts with the tolerance.",
            long,
            lambda k: place(late, k),
            drift,
            asks="position after 100 000 cycles [m]",
            scale=0.06,
            tolerance=1e-4,
            # Times of 1e5 s are known to 8 ms in float32.
            single=None,
            skips={
                "vmap": "as alone, and it takes as long for every run",
                "reverse": "checkpoints of 2e6 steps take minutes; `forward` has the same saltation matrices",
                "energy": "sums over 1e5 cycles; audited on one cycle elsewhere",
            },
        ),
    ]


def _changes(run: Trajectory) -> Array:
    return jnp.asarray(run.stats["num_events"], float)


def _smooth_break_away() -> HardCase:
    belt = belt_oscillator.PARAMS["belt"]
    task = motion(
        belt_oscillator.scene(belt_oscillator.stribeck()), [0.0], [belt], 5.0, by="k", read=_changes,
        numbers={"rtol": 1e-12, "atol": 1e-14}, max_steps=65536,
    )  # fmt: skip
    return HardCase(
        "smooth_break_away",
        "Friction goes on from Fs without a jump as slip begins: at break-away slip and the net force both vanish.",
        "It sticks and breaks away again a few times within a microsecond, as rounding has it.",
        task,
        # Four cycles of break-away and stick.
        lambda _: 8.0,
        asks="number of mode changes in 5 s [1]",
    )


def _swell(t: Array, q: Array, qd: Array, p: dict[str, Array]) -> Array:
    return jnp.reshape(p["F"] * jnp.sin(t), (1,))


def _mass(t: Array, q: Array, qd: Array, p: dict[str, Array]) -> Array:
    return 0.5 * p["m"] * qd[0] ** 2


def _grazing() -> HardCase:
    scene = Scene(
        _mass, params={"m": 2.0, "F": 1.5}, effects=(AppliedForce(_swell, name="pull"), Friction(Coulomb(1.5)))
    )
    return HardCase(
        "grazing_limit",
        "The load swells up to the limit of stick, touches it and falls again.",
        "An event or none, as rounding has it; the derivative is that of one of the two.",
        motion(scene, [0.0], [0.0], 3.0, by="F", read=position, numbers={"dtmax": 0.1}),
        lambda _: 0.0,
        scale=1.0,
        # As the square root of 2e-16: what rounding makes of touching.
        tolerance=1e-6,
        undefined="below Fc the box rests, above it moves by a distance that is no linear function of the force",
    )


def _below_ceiling(t: object, s: EventState, args: object) -> Array:
    return 1.0 - s.y[:1]


def _caught(t: object, s: EventState, args: object, fired: Array) -> EventState:
    return s._replace(y=0.0 * s.y + 1.0, mode=jnp.ones_like(s.mode))


def _throw(v0: Array) -> Answer:
    """A ball is thrown up and caught where it touches the ceiling, one metre above."""
    one = jnp.ones((), v0.dtype)
    solver = EventSolver(dfx.Tsit5(), _below_ceiling, _caught, log=0)
    start = solver.start(0.0 * one, jnp.stack([0.0 * one, v0]), mode=0.0 * one)

    def field(t: object, s: EventState, args: object) -> EventState:
        return s.rate(jnp.where(s.mode > 0.5, 0.0, jnp.stack([s.y[1], -_G * one])))

    code, ys = _solve(field, solver, 1.0, start)
    return Answer(code, ys.t[-1])


def _ceiling() -> HardCase:
    def exact(v0: float) -> float:
        return 2.0 / (v0 + math.sqrt(v0**2 - 2.0 * _G))

    def slope(v0: float) -> float:
        left = math.sqrt(v0**2 - 2.0 * _G)
        return -2.0 / (v0 + left) ** 2 * (1.0 + v0 / left)

    v0 = math.sqrt(2.0 * _G) * (1.0 + 1e-8)
    return HardCase(
        "grazing_ceiling",
        "A ball touches the ceiling at 6e-4 m/s: the time of touching goes as a square root of what is left.",
        "The touch lies between two steps and is missed; the derivative, -700, is off by as much.",
        FunctionTask(_throw, v0, "initial velocity [m/s]"),
        exact,
        slope,
        asks="time of touching [s]",
        tolerance=1e-5,
        # In float32 the ball does not reach the ceiling: 1e-8 is below its rounding.
        single=None,
    )


def cases() -> list[HardCase]:
    """The cases of this family."""
    return [*_zeno(), _shrinking_swing(), *_chatter(), *_cycles(), _smooth_break_away(), _grazing(), _ceiling()]
