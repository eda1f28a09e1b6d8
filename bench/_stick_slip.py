"""The belt oscillator, its closed form, and the programs that run it.

A mass m on a spring k rides on a belt that moves at vb, with Coulomb friction Fc in slip and up to Fs in stick. It
starts at x = 0 at the speed of the belt, sticks until k x = Fs, then slips back: about one cycle a second, two events
each. `jaxmodsim` gets the scene. The others get what a careful user would write for this one oscillator, knowing that
stick and slip towards one side alternate for ever: the better bargain for them, as `jaxmodsim` looks for all three
modes.
"""

import math
from collections.abc import Callable
from typing import Any

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from scipy.integrate import solve_ivp

import jaxmodsim as jms

PARAMETERS = ("Fc", "Fs", "k", "m", "vb")
NOMINAL = np.array([5.0, 8.0, 100.0, 1.0, 0.1])
T1 = 60.0
# Absolute tolerance for a relative one: m and m/s, both of the order of 0.1 here.
ATOL = 1e-3
MAX_STEPS = 262_144


def parameter_sets(count: int) -> np.ndarray:
    """Sets of the five parameters, within 3 % of the nominal ones; always the same."""
    rng = np.random.default_rng(20240229)
    return NOMINAL * (1.0 + 0.03 * rng.uniform(-1.0, 1.0, (count, 5)))


def exact_cycle(p: Any) -> dict[str, Any]:
    """The limit cycle in closed form, reached at once: break-away position, centre and size of slip, times."""
    coulomb, static, k, m, vb = (p[i] for i in range(5))
    rate = jnp.sqrt(k / m)
    size = (static - coulomb) / k
    slip = 2.0 * (jnp.pi - jnp.arctan2(size * rate, vb)) / rate
    return {"rate": rate, "size": size, "centre": coulomb / k, "slip": slip, "period": slip + 2.0 * size / vb}


def exact_end(p: Any, t1: float = T1) -> Any:
    """Position [m] at `t1`, later than the first break-away, in closed form."""
    vb, cycle = p[4], exact_cycle(p)
    since = jnp.mod(t1 - p[1] / p[2] / vb, cycle["period"])
    angle = cycle["rate"] * since
    slips = cycle["centre"] + cycle["size"] * jnp.cos(angle) + vb / cycle["rate"] * jnp.sin(angle)
    sticks = cycle["centre"] - cycle["size"] + vb * (since - cycle["slip"])
    return jnp.where(since < cycle["slip"], slips, sticks)


def lagrangian(t: Any, q: Any, qd: Any, p: Any) -> Any:
    """A mass on a spring."""
    del t
    return 0.5 * p["m"] * qd[0] ** 2 - 0.5 * p["k"] * q[0] ** 2


def belt_oscillator(p: Any) -> jms.Scene:
    """The scene of the five parameters."""
    coulomb, static, k, m, vb = (p[i] for i in range(5))
    return jms.Scene(lagrangian, {"k": k, "m": m}, (jms.Friction(jms.Coulomb(coulomb, static), belt_velocity=vb),))


def our_end(p: Any, rtol: Any = 1e-6, t1: Any = T1, adjoint: Any = None) -> Any:
    """Position at `t1` by `simulate`, to be traced."""
    run = jms.simulate(
        belt_oscillator(p),
        jnp.zeros(1),
        p[4:],
        t1,
        rtol=rtol,
        atol=ATOL * rtol,
        adjoint=adjoint,
        max_steps=MAX_STEPS,
        max_events=4096,
    )
    return run.q[-1, 0]


def our_call(rtol: float = 1e-6, t1: float = T1) -> Callable[[], float]:
    """A whole call of `simulate`, as a user makes it."""
    scene = belt_oscillator(NOMINAL)
    start = [NOMINAL[4]]
    return lambda: float(jms.simulate(scene, [0.0], start, t1, rtol=rtol, atol=ATOL * rtol).q[-1, 0])


# Legs of plain diffrax, each ended by a terminating `diffrax.Event`.


def _stick_field(t: Any, y: Any, p: Any) -> Any:
    del t, p
    return y[1], jnp.zeros_like(y[1])


def _slip_field(t: Any, y: Any, p: Any) -> Any:
    del t
    return y[1], (p[0] - p[2] * y[0]) / p[3]


def _load_left(t: Any, y: Any, args: Any, **given: Any) -> Any:
    del t, given
    return args[1] - args[2] * y[0]


def _slip_velocity(t: Any, y: Any, args: Any, **given: Any) -> Any:
    del t, given
    return y[1] - args[4]


def leg(t: Any, y: Any, p: Any, rtol: Any, t1: Any, *, sticks: bool) -> tuple[Any, Any]:
    """Time and state at the end of one leg: the next event, with the velocity reset there, or `t1`."""
    field, guard = (_stick_field, _load_left) if sticks else (_slip_field, _slip_velocity)
    # The load that is left falls through zero; the slip velocity starts at zero, is negative, and rises through it.
    event = dfx.Event(guard, optx.Newton(rtol, ATOL * rtol, optx.rms_norm), direction=not sticks)
    done = dfx.diffeqsolve(
        dfx.ODETerm(field),
        dfx.Tsit5(),
        t,
        t1,
        None,
        y,
        args=p,
        event=event,
        stepsize_controller=dfx.PIDController(rtol=rtol, atol=ATOL * rtol),
        max_steps=4096,
        throw=False,
    )
    x, v = (values[-1] for values in done.ys)
    t_end = done.ts[-1]
    return t_end, (x, v if sticks else jnp.where(t_end < t1, p[4], v))


def legs_unrolled(p: Any, rtol: Any = 1e-6, t1: Any = T1, *, legs: int) -> Any:
    """Position at `t1` by that many legs written one after the other."""
    t, y = jnp.zeros(()), (jnp.zeros(()), p[4])
    for number in range(legs):
        t, y = leg(t, y, p, rtol, t1, sticks=number % 2 == 0)
    return y[0]


def legs_scanned(p: Any, rtol: Any = 1e-6, t1: Any = T1, *, cycles: int) -> Any:
    """Position at `t1` by a `lax.scan` over cycles of two legs; those after `t1` have no length."""

    def cycle(carry: Any, _: None) -> tuple[Any, None]:
        for sticks in (True, False):
            carry = leg(*carry, p, rtol, t1, sticks=sticks)
        return carry, None

    start = (jnp.zeros(()), (jnp.zeros(()), p[4]))
    return jax.lax.scan(cycle, start, length=cycles)[0][1][0]


def legs_in_python(t1: float = T1) -> Callable[[np.ndarray, float], float]:
    """Position at `t1` by a Python loop over one jitted leg for either mode."""
    jitted = [jax.jit(lambda t, y, p, rtol, sticks=sticks: leg(t, y, p, rtol, t1, sticks=sticks)) for sticks in (1, 0)]

    def run(p: np.ndarray, rtol: float = 1e-6) -> float:
        t, y, number = 0.0, (0.0, p[4]), 0
        while t < t1:
            t, y = jitted[number % 2](t, y, p, rtol)
            number += 1
        return float(y[0])

    return run


def scipy_end(p: np.ndarray, rtol: float = 1e-6, t1: float = T1, *, method: str) -> float:
    """Position at `t1` by `solve_ivp` with terminal events, started anew at each."""
    coulomb, static, k, m, vb = p.tolist()

    def stick(t: float, y: Any) -> tuple[float, float]:
        del t
        return y[1], 0.0

    def slip(t: float, y: Any) -> tuple[float, float]:
        del t
        return y[1], (coulomb - k * y[0]) / m

    def load_left(t: float, y: Any) -> float:
        del t
        return static - k * y[0]

    def slip_velocity(t: float, y: Any) -> float:
        del t
        return y[1] - vb

    load_left.terminal = slip_velocity.terminal = True
    load_left.direction, slip_velocity.direction = -1, 1
    t, y, sticks = 0.0, (0.0, vb), True
    while True:
        field, guard = (stick, load_left) if sticks else (slip, slip_velocity)
        done = solve_ivp(field, (t, t1), y, method, events=guard, rtol=rtol, atol=ATOL * rtol)
        if not done.success:
            raise RuntimeError(done.message)
        if done.status == 0:
            return float(done.y[0, -1])
        t, y, sticks = done.t[-1], (done.y[0, -1], vb), not sticks


def events_until(t1: float) -> int:
    """Number of events of the nominal oscillator until `t1`."""
    cycle = exact_cycle(NOMINAL)
    since = t1 - NOMINAL[1] / NOMINAL[2] / NOMINAL[4]
    if since < 0:
        return 0
    whole, rest = divmod(since, float(cycle["period"]))
    return 2 * math.floor(whole) + (2 if rest >= float(cycle["slip"]) else 1)
