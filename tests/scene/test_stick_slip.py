"""Exact events of the box, belts with other laws, a pendulum and a bouncing ball against references."""

from collections.abc import Callable
from functools import partial
from typing import Any

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import jaxmodsim as jms
from jaxmodsim import problems

from ..helpers.differences import central_difference

TIGHT: dict[str, Any] = {"rtol": 1e-12, "atol": 1e-14, "max_events": 16}


def box(x: Any) -> Any:
    """The first event, to be differentiated by the numbers of the run, and the run."""
    law, ramp = x
    arguments: dict[str, Any] = {"ts": jnp.linspace(0.0, 3.0, 32), "adjoint": dfx.ForwardMode(), **TIGHT}
    run = jms.simulate(problems.ramped_box.scene(law, ramp=ramp), [0.0], [0.0], 3.0, throw=False, **arguments)
    events = run.events
    seen = run.t, run.q[:, 0], run.qd[:, 0], run.mode["friction"], run.forces, events, run.stats["num_events"]
    return events.t[0], seen


@pytest.mark.parametrize(
    ("law", "ramp"), [(jms.Coulomb(1.5, 1.75), 1.3), (problems.ramped_box.stribeck(), 1.0)], ids=["coulomb", "stribeck"]
)
def test_box_breaks_away_when_the_pull_reaches_the_limit(law: Any, ramp: float) -> None:
    slopes, seen = jax.jit(jax.jacfwd(box, has_aux=True))((law, jnp.array(ramp)))
    t, q, qd, mode, forces, events, count = jax.tree.map(np.asarray, seen)
    release = 1.75 / ramp
    np.testing.assert_allclose(events.t[0], release, atol=1e-10)
    np.testing.assert_allclose(slopes[0].Fs, 1 / ramp, atol=1e-8)
    np.testing.assert_allclose(slopes[0].Fc, 0.0, atol=1e-8)
    np.testing.assert_allclose(slopes[1], -1.75 / ramp**2, atol=1e-8)
    assert count == 1
    assert (events.effect[0], events.before[0], events.after[0]) == (1, 0, 1)
    sticks = t < release
    np.testing.assert_array_equal(mode, np.where(sticks, 0, 1))
    np.testing.assert_array_equal(qd[sticks], 0.0)
    np.testing.assert_array_equal(q[sticks], 0.0)
    np.testing.assert_allclose(forces["friction"][sticks], ramp * t[sticks], rtol=1e-15)
    t, q, qd = t[~sticks], q[~sticks], qd[~sticks]
    if isinstance(law, jms.Coulomb):
        # m v' = ramp t - Fc after the release, with a mass of 2 kg.
        v = (ramp * (t**2 - release**2) / 2 - 1.5 * (t - release)) / 2
        x = (ramp * ((t**3 - release**3) / 6 - release**2 * (t - release) / 2) - 1.5 * (t - release) ** 2 / 2) / 2
        np.testing.assert_allclose(qd, v, atol=1e-11)
        np.testing.assert_allclose(q, x, atol=1e-11)
    else:
        exact = solve_ivp(
            lambda t, y: [y[1], (ramp * t - 1.5 - 0.25 * np.exp(-((y[1] / 0.2) ** 2)) - 0.1 * y[1]) / 2],
            (release, 3.0),
            [0.0, 0.0],
            "DOP853",
            t,
            rtol=1e-13,
            atol=1e-15,
        )
        np.testing.assert_allclose(q, exact.y[0], atol=1e-9)
        np.testing.assert_allclose(qd, exact.y[1], atol=1e-9)


def solve_to(rate: Callable[..., Any], t0: float, y0: Any, t1: float, guards: list[Callable[..., Any]]) -> Any:
    """scipy's solution up to the first guard that falls through zero: its time, its index (or None) and the state."""
    events = []
    for guard in guards:

        def event(t: float, y: Any, guard: Any = guard) -> float:
            return guard(t, y)

        event.terminal, event.direction = True, -1.0  # pyright: ignore[reportFunctionMemberAccess]
        events.append(event)
    # Short steps, so that the event is as exact on the dense output as the steps are.
    found = solve_ivp(rate, (t0, t1), y0, "DOP853", rtol=1e-13, atol=1e-15, events=events, max_step=0.05)
    fired = [i for i, t in enumerate(found.t_events) if len(t)]
    return found.t[-1], fired[0] if fired else None, found.y[:, -1]


def stribeck_cycle(numbers: dict[str, float], n: int) -> np.ndarray:
    """Times of the first n events of a mass that starts in stick at q = 0, by scipy."""
    m, k, belt, p = numbers["m"], numbers["k"], numbers["belt"], numbers

    def rate(t: float, y: Any) -> list[float]:
        del t
        v = belt - y[1]
        force = p["Fc"] + (p["Fs"] - p["Fc"]) * np.exp(-((np.maximum(v, 0.0) / p["vs"]) ** p["exponent"])) + p["Fv"] * v
        return [y[1], (-k * y[0] + force) / m]

    t, x, times = 0.0, 0.0, []
    while len(times) < n:
        t += (p["Fs"] / k - x) / belt
        times.append(t)
        t, fired, y = solve_to(rate, t, [p["Fs"] / k, belt], t + 5.0, [lambda t, y: belt - y[1]])
        assert fired == 0
        assert abs(k * y[0]) < p["Fs"]
        x = y[0]
        times.append(t)
    return np.array(times[:n])


def changed_cycle(numbers: dict[str, float], name: str, x: float) -> np.ndarray:
    return stribeck_cycle({**numbers, name: x}, 3)


def stribeck_times(numbers: dict[str, Any], adjoint: Any) -> Any:
    p = dict(numbers)
    oscillator = {name: p.pop(name) for name in ("m", "k", "belt")}
    scene = problems.belt_oscillator.scene(jms.Stribeck(**p), **oscillator)
    # The law's second derivatives are singular at rest for exponents below 2. They enter the derivatives of an implicit
    # step, but not those of an explicit one.
    arguments = {"adjoint": adjoint, "throw": False, "solver": dfx.Tsit5(), **TIGHT}
    return jms.simulate(scene, jnp.zeros(1), jnp.reshape(oscillator["belt"], (1,)), 3.5, **arguments).events.t[:4]


@jax.jit
def stribeck_slopes(numbers: dict[str, Any]) -> Any:
    def times(x: Any) -> Any:
        t = stribeck_times(x, dfx.ForwardMode())
        return t, t

    return jax.jacfwd(times, has_aux=True)(numbers)


def test_belt_oscillator_under_a_law_that_falls() -> None:
    for exponent in (1.0, 2.0):
        numbers = {**problems.belt_oscillator.PARAMS, **problems.belt_oscillator.STRIBECK, "exponent": exponent}
        slopes, times = stribeck_slopes({name: jnp.asarray(x) for name, x in numbers.items()})
        np.testing.assert_allclose(times, stribeck_cycle(numbers, 4), atol=1e-9)
        for name, x in numbers.items():
            step = 1e-3 * x
            exact = central_difference(partial(changed_cycle, numbers, name), x, step)
            np.testing.assert_allclose(slopes[name][:3], exact, rtol=1e-6, atol=1e-7, err_msg=name)


BELTS = {**problems.coupled_belts.PARAMS}
LAWS = problems.coupled_belts.LAWS


def coupled_rate(modes: Any) -> Callable[..., Any]:
    """Two masses on the belt by Newton's law, with friction forces (on the mass) by modes."""
    c, m, k = BELTS["coupling"], (BELTS["m1"], BELTS["m2"]), (BELTS["k1"], BELTS["k2"])

    def rate(t: float, y: Any) -> list[float]:
        del t
        pull = -k[0] * y[0] - c * (y[0] - y[1]), -k[1] * y[1] + c * (y[0] - y[1])
        a = [0.0 if modes[i] == 0 else (pull[i] - modes[i] * LAWS[i]["Fc"]) / m[i] for i in (0, 1)]
        return [y[2], y[3], *a]

    return rate


def coupled_guards(modes: Any) -> list[tuple[int, int, Callable[..., Any]]]:
    """Element, its mode after, and the guard, for everything that may end these modes."""
    c, k, belt = BELTS["coupling"], (BELTS["k1"], BELTS["k2"]), BELTS["belt"]
    guards = []
    for i in (0, 1):

        def pull(y: Any, i: int = i) -> float:
            return -k[i] * y[i] + (-1 if i == 0 else 1) * c * (y[0] - y[1])

        if modes[i] == 0:
            guards.append((i, 1, lambda t, y, i=i, pull=pull: LAWS[i]["Fs"] - pull(y)))
            guards.append((i, -1, lambda t, y, i=i, pull=pull: LAWS[i]["Fs"] + pull(y)))
        else:
            guards.append((i, 0, lambda t, y, i=i, s=modes[i]: s * (y[2 + i] - belt)))
    return guards


COUPLED_STARTS = [([0.0, 0.0], [0.1, 0.1]), ([0.02, -0.05], [0.1, 0.1]), ([0.05, 0.05], [-0.3, 0.1])]


def test_coupled_belts_follow_scipy_through_their_modes() -> None:
    """Events are taken from the run; the reference finds the same ones first, at the same times."""

    longer: dict[str, Any] = TIGHT | {"max_events": 32}

    @jax.jit
    def observe(q0: Any, qd0: Any) -> Any:
        run = jms.simulate(problems.coupled_belts.scene(), q0, qd0, 4.0, throw=False, **longer)
        return run.events, run.q[-1], run.qd[-1]

    seen = set()
    for q0, qd0 in COUPLED_STARTS:
        events, q, qd = observe(jnp.array(q0), jnp.array(qd0))
        n = int(np.isfinite(events.t).sum())
        assert 10 < n < 32
        modes = [int(np.sign(round(v - BELTS["belt"], 12))) for v in qd0]
        t, y = 0.0, np.array([*q0, *qd0])
        for i in range(n):
            guards = coupled_guards(modes)
            t, fired, y = solve_to(coupled_rate(modes), t, y, 4.0, [guard for *_, guard in guards])
            assert fired is not None
            element, after, _ = guards[fired]
            assert (int(events.effect[i]), int(events.before[i])) == (element, modes[element])
            np.testing.assert_allclose(events.t[i], t, atol=1e-9)
            modes[element] = int(events.after[i])
            assert modes[element] == after
            if after == 0:
                y[2 + element] = BELTS["belt"]
            seen.add(tuple(modes))
        t, fired, y = solve_to(coupled_rate(modes), t, y, 4.0, [guard for *_, guard in coupled_guards(modes)])
        assert fired is None
        np.testing.assert_allclose([*q, *qd], y, atol=1e-8)
        if q0 == [0.0, 0.0]:
            limits = {"Fs1": LAWS[0]["Fs"], "Fs2": LAWS[1]["Fs"]}
            first = problems.coupled_belts.first_slip(**{k: BELTS[k] for k in ("k1", "k2", "belt")}, **limits)
            np.testing.assert_allclose(events.t[0], first.t, atol=1e-12)
            assert int(events.effect[0]) == int(first.which)
    assert {(0, 0), (-1, 0), (0, -1), (-1, -1)} <= seen


def test_pendulum_loses_torque_times_angle_and_rests_within_the_range() -> None:
    numbers = {**problems.stick_slip_pendulum.PARAMS}
    fs, weight = numbers.pop("Fs"), numbers["m"] * numbers["g"] * numbers["l"]

    @jax.jit
    def observe(q0: Any, ts: Any) -> Any:
        scene = problems.stick_slip_pendulum.scene()
        run = jms.simulate(scene, q0, jnp.zeros(1), 12.0, ts=ts, throw=False, **TIGHT)
        return run.events, run.q[:, 0], run.qd[:, 0], run.mode["friction"], run.forces["friction"]

    rests = []
    for q0 in (1.4, -1.1, 0.75, 0.3, 0.1):
        ends = jnp.full(17, 12.0)
        events, *_ = observe(jnp.array([q0]), ends)
        n = int(np.isfinite(events.t).sum())
        # Again, with the angle kept at the reversals.
        _, q, qd, mode, force = observe(jnp.array([q0]), ends.at[:16].set(jnp.minimum(events.t, 12.0)))
        turns = [q0]
        while weight * abs(np.sin(turns[-1])) > fs:
            turns.append(float(problems.stick_slip_pendulum.turn(turns[-1], **numbers)))
        assert len(turns) == n + 1
        np.testing.assert_allclose(q[:n], turns[1:], atol=1e-10)
        np.testing.assert_allclose(qd[:n], 0.0, atol=1e-12)
        np.testing.assert_array_equal(events.after[: max(n - 1, 0)], np.sign(np.diff(turns))[1:])
        assert mode[-1] == 0
        np.testing.assert_allclose(q[-1], turns[-1], atol=1e-10)
        np.testing.assert_allclose(force[-1], -weight * np.sin(turns[-1]), atol=1e-9)
        # The energy that the angles lose, swing by swing, without the closed form.
        lost = weight * (np.cos(turns[1:]) - np.cos(turns[:-1]))
        np.testing.assert_allclose(lost, numbers["Fc"] * np.abs(np.diff(turns)), atol=1e-12)
        rests.append(weight * np.sin(turns[-1]))
    assert np.abs(rests).max() <= fs
    assert np.abs(rests).max() > 0.2 * fs
    slope = jax.grad(lambda fc: problems.stick_slip_pendulum.turn(1.4, **{**numbers, "Fc": fc}))(numbers["Fc"])
    by_steps = central_difference(
        lambda fc: problems.stick_slip_pendulum.turn(1.4, **{**numbers, "Fc": fc}), numbers["Fc"], 1e-3
    )
    np.testing.assert_allclose(slope, by_steps, rtol=1e-10)


def drop(ball: problems.bouncing_ball.BouncingBall, y0: Any, t1: Any, adjoint: Any = None, **options: Any) -> Any:
    hold, tol = options.pop("hold", False), options.pop("tol", 1e-12)
    solver = jms.EventSolver(
        dfx.Tsit5(), ball.guards, ball.reset, carries_on=hold, max_events=options.pop("max_events", 16)
    )
    return dfx.diffeqsolve(
        dfx.ODETerm(ball.field),
        solver,
        0.0,
        t1,
        None,
        solver.start(0.0, y0, 0.0),
        stepsize_controller=jms.EventController(dfx.PIDController(rtol=tol, atol=1e-2 * tol)),
        adjoint=dfx.RecursiveCheckpointAdjoint() if adjoint is None else adjoint,
        throw=False,
        **options,
    )


def bounces(x: Any, t1: Any, adjoint: Any = None) -> Any:
    ys = drop(problems.bouncing_ball.BouncingBall(e=x["e"], g=x["g"]), x["y0"], t1, adjoint).ys
    t = ys.log.t[0, :5]
    return jnp.where(jnp.isfinite(t), t, 0.0), ys.y[0]


@partial(jax.jacfwd, argnums=(0, 1, 2))
def exact_slopes(e: Any, h: Any, g: Any) -> Any:
    return problems.bouncing_ball.bounces(5, h=h, e=e, g=g)


@pytest.mark.parametrize("mode", ["forward", "reverse"])
def test_derivatives_of_bounces(mode: str) -> None:
    if mode == "forward":
        slopes = jax.jit(jax.jacfwd(partial(bounces, adjoint=dfx.ForwardMode())))
    else:
        slopes = jax.jit(jax.jacrev(bounces))
    x = {"e": jnp.array(0.7), "g": jnp.array(9.81), "y0": jnp.array([1.3, 0.0])}
    times, _ = slopes(x, 2.4)
    by_e, by_h, by_g = exact_slopes(0.7, 1.3, 9.81)
    np.testing.assert_allclose(times["e"], by_e, atol=1e-9)
    np.testing.assert_allclose(times["y0"][:, 0], by_h, atol=1e-9)
    np.testing.assert_allclose(times["g"], by_g, atol=1e-9)

    # The saltation matrix: the state after one bounce by the state before, less the free flights.
    fall = float(np.sqrt(2 * 1.3 / 9.81))
    _, jump = slopes(x, fall + 0.2)
    flight = [np.array([[1.0, t], [0.0, 1.0]]) for t in (fall, 0.2)]
    saltation = np.linalg.solve(flight[1], jump["y0"]) @ np.linalg.inv(flight[0])
    speed = -9.81 * fall
    np.testing.assert_allclose(saltation, [[-0.7, 0.0], [-9.81 * 1.7 / speed, -0.7]], atol=1e-9)


def test_bouncing_ball_to_the_end_of_all_bounces() -> None:
    for e in (0.5, 0.8):
        ball = problems.bouncing_ball.BouncingBall(e=e)
        stop = problems.bouncing_ball.rest(h=1.0, e=e)
        solution = drop(ball, ball.dropped(1.0), 1.5 * stop, max_events=128)
        assert float(solution.ys.status[0]) == 1.0
        assert solution.result == dfx.RESULTS.dt_min_reached
        np.testing.assert_allclose(solution.ys.t[0], stop, atol=1e-8)
        np.testing.assert_allclose(solution.ts[0], stop, atol=1e-8)
        n = int(solution.ys.events[0])
        exact = problems.bouncing_ball.bounces(n, h=1.0, e=e)
        np.testing.assert_allclose(solution.ys.log.t[0, :n], exact, atol=1e-10)


def test_bouncing_ball_comes_to_rest_where_it_may() -> None:
    e = 0.5
    ball, stop = problems.bouncing_ball.BouncingBall(e=e), float(problems.bouncing_ball.rest(h=1.0, e=e))
    ts = jnp.linspace(0.0, 1.5 * stop, 301)
    solution = drop(ball, ball.dropped(1.0), ts[-1], max_events=128, hold=True, saveat=dfx.SaveAt(ts=ts))
    assert solution.result == dfx.RESULTS.successful
    height, velocity = problems.bouncing_ball.motion(ts, h=1.0, e=e)
    np.testing.assert_allclose(solution.ys.y[:, 0], height, atol=1e-9)
    np.testing.assert_allclose(solution.ys.y[:, 1], velocity, atol=1e-9)
    resting = np.asarray(ts) > stop
    np.testing.assert_array_equal(solution.ys.mode, resting)
    np.testing.assert_array_equal(solution.ys.y[resting], 0.0)
    assert float(solution.ys.status[-1]) == 0.0


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_no_bouncing_ball_falls_through_the_floor(dtype: str) -> None:
    """The last bounces are so low that they are rounding, however large the steps are that look for the next one."""
    es = jnp.linspace(0.05, 0.9, 60).astype(dtype)

    def run(e: Any) -> Any:
        ball, t1 = problems.bouncing_ball.BouncingBall(e=e, g=jnp.asarray(9.81, dtype)), jnp.asarray(20.0, dtype)
        return drop(ball, ball.dropped(1.0), t1, max_events=256, tol=1e-6).ys

    last = jax.jit(jax.vmap(run))(es)
    np.testing.assert_array_equal(last.status[:, 0], 1.0)
    np.testing.assert_allclose(last.y[:, 0, 0], 0.0, atol=1e-8)
    rest = jax.vmap(lambda e: problems.bouncing_ball.rest(h=1.0, e=e))(es.astype(float))
    np.testing.assert_allclose(last.t[:, 0], rest, rtol=1e-4 if dtype == "float32" else 1e-8)


def test_an_element_below_a_hundredth_of_the_largest_limit_logs_its_slip_early_and_the_motion_is_exact() -> None:
    """Limits of 1 N and 5 mN on one coordinate, under a load that rises by 1 N/s."""
    small, large = (jms.Friction(jms.Coulomb(limit), name=name) for limit, name in ((0.005, "small"), (1.0, "large")))
    pull = jms.AppliedForce(lambda t, q, qd, p: jnp.reshape(t, (1,)))
    scene = jms.Scene(lambda t, q, qd, p: 0.5 * qd[0] ** 2, {}, (pull, small, large))
    run = jms.simulate(scene, [0.0], [0.0], 1.2, ts=[1.0, 1.2], rtol=1e-12, atol=1e-14)
    # Together they hold up to 1.005 N.
    np.testing.assert_allclose(run.q[:, 0], [0.0, (1.2 - 1.005) ** 3 / 6.0], atol=1e-14)
    first, second = run.mode_changes
    # The small one takes 1 % of the load of the large one, and so reaches its limit at 0.505 N, at rest.
    assert (first.effect, second.effect) == ("small", "large")
    np.testing.assert_allclose([first.t, second.t], [0.505, 1.005], atol=1e-12)


def test_an_axis_that_starts_at_break_away_slips_at_once() -> None:
    """Friction is at its limit up to rounding, and the integral of a controller raises the load."""
    kp, kd, inertia, weight, target, t1 = 300.0, 5.0, 0.4, 9.0, 0.5, 0.05
    law = jms.Stribeck(Fc=0.7, Fs=2.8, vs=0.28, exponent=2.0)
    friction = jms.Friction(law, along=lambda q: q[0], name="friction")

    def lagrangian(t: Any, q: Any, qd: Any, p: Any) -> Any:
        del t, p
        return 0.5 * inertia * qd[0] ** 2 + weight * jnp.cos(target + q[0]) + 0.5 * qd[1] ** 2

    def motor(t: Any, q: Any, qd: Any, p: Any) -> Any:
        # The integral of the error is a coordinate, of unit mass.
        del t
        return jnp.stack([-kp * q[0] - p["ki"] * q[1] - kd * qd[0], qd[0]])

    @jax.jit
    @jax.vmap
    def slips(x: Any, ki: Any, integral: Any) -> Any:
        scene = jms.Scene(lagrangian, {"ki": ki}, (jms.AppliedForce(motor), friction))
        start = jnp.stack([x, integral]), jnp.stack([jnp.zeros_like(x), x])
        run = jms.simulate(scene, *start, t1, ts=[t1], rtol=1e-10, atol=1e-13, throw=False)
        return run.q[-1, 0], run.events.t[0]

    rng = np.random.default_rng(0)
    x = rng.choice([-1.0, 1.0], 128) * 10.0 ** rng.uniform(-4.0, -1.0, 128)
    ki = 10.0 ** rng.uniform(1.0, 5.0, 128)
    integral = (-kp * x - weight * np.sin(target + x) + np.sign(x) * 2.8) / ki
    q, begin = slips(x, ki, integral)
    # The load is known to about 16 rounding units of its largest term, and rises by ki x.
    assert np.all((begin >= 0.0) & (begin * ki * np.abs(x) <= 1e-14 * np.maximum(30.0, kp * np.abs(x))))
    for k in range(0, 128, 8):

        def rates(t: float, y: Any, k: int = k) -> list[float]:
            del t
            force = -np.sign(x[k]) * (0.7 + 2.1 * np.exp(-((y[1] / 0.28) ** 2)))
            load = -kp * y[0] - ki[k] * y[2] - kd * y[1] - weight * np.sin(target + y[0])
            return [y[1], (load - force) / inertia, y[0]]

        exact = solve_ivp(rates, (0.0, t1), [x[k], 0.0, integral[k]], "DOP853", rtol=1e-12, atol=1e-14)
        np.testing.assert_allclose(q[k], exact.y[0, -1], rtol=1e-8, atol=1e-11)


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_what_starts_at_its_limit_lets_go_at_once(dtype: str) -> None:
    """A contact and two friction elements hold all but a rounding, or a little more, of loads that rise slowly or fast.

    The least load that a type resolves is reached within times that are far shorter than its rounding of t1.
    """
    t1, limits = 0.5, jnp.array([1.0, 2.0], dtype)
    load = jms.AppliedForce(lambda t, q, qd, p: p["limit"] - p["short"] + p["rate"] * t)

    def lagrangian(t: Any, q: Any, qd: Any, p: Any) -> Any:
        del t
        return 0.5 * jnp.sum(qd**2) - p["weight"] * q[0]

    def lifted(params: Any) -> Any:
        floor = jms.Contact(lambda t, q, p: q[0], restitution=0.5, name="floor")
        return jms.Scene(lagrangian, params | {"weight": 9.81, "limit": jnp.array([9.81], dtype)}, (load,), (floor,))

    def dragged(params: Any) -> Any:
        elements = (jms.Friction(jms.Coulomb(limits[i]), along=lambda q, i=i: q[i], name="ab"[i]) for i in (0, 1))
        return jms.Scene(lagrangian, params | {"weight": 0.0, "limit": limits}, (load, *elements))

    rng = np.random.default_rng(0)
    units = float(jnp.finfo(dtype).eps) * rng.choice([0.0, 0.1, 1.0, 8.0, 80.0], 128)
    rate = 10.0 ** rng.uniform(-1.0, 5.0, 128)
    params = {"short": jnp.asarray(units, dtype), "rate": jnp.asarray(rate, dtype)}
    for make, dof in ((lifted, 1), (dragged, 2)):

        @jax.jit
        @jax.vmap
        def end(params: Any, make: Any = make, dof: int = dof) -> Any:
            rest, rtol = jnp.zeros(dof, dtype), 1e-5 if dtype == "float32" else 1e-9
            run = jms.simulate(make(params), rest, rest, t1, ts=[t1], rtol=rtol, atol=1e-2 * rtol, throw=False)
            return run.q[-1]

        exact = rate * (t1 - units / rate) ** 3 / 6.0
        # Rounding of a load of 9.81 N is 8 units, and delays the least rates by that.
        np.testing.assert_allclose(end(params), np.stack([exact] * dof, 1), rtol=1e-3 if dtype == "float32" else 1e-11)


def test_two_blocks_that_let_go_or_turn_together_have_the_derivatives_of_one_after_the_other() -> None:
    """Equal blocks with a spring between them: the events of both are at one instant, or less than 1e-7 s apart."""

    def lagrangian(t: Any, q: Any, qd: Any, p: Any) -> Any:
        del t, p
        return 0.5 * jnp.sum(qd**2) - 2.5 * (q[0] - q[1]) ** 2 - jnp.sum(q**2)

    push = jms.AppliedForce(lambda t, q, qd, p: p["a"] * jnp.sin(2.0 * t))
    law = jms.Coulomb(1.0, Fs=1.4)
    friction = [jms.Friction(law, along=lambda q, i=i: q[i], name=f"friction_{i}") for i in (0, 1)]

    @jax.jit
    def end(a: Any, v0: Any) -> Any:
        scene = jms.Scene(lagrangian, {"a": a}, (push, *friction))
        return jms.simulate(scene, [0.0, 0.0], v0, 3.0, rtol=1e-11, atol=1e-13, max_events=16).q[-1]

    slopes = jax.jit(jax.jacfwd(end))
    for v0 in (jnp.zeros(2), jnp.full(2, 0.8)):
        for apart in (0.0, 1e-9, 1e-7):
            a = jnp.array([3.0, 3.0 + apart])
            expected = central_difference(lambda x, a=a, v0=v0: end(a.at[0].set(x), v0), 3.0, 1e-3)
            np.testing.assert_allclose(slopes(a, v0)[:, 0], expected, atol=1e-5)


def test_a_limit_near_zero_under_a_load_with_a_kink_takes_few_steps() -> None:
    """Nothing happens before the kink, where the guard is nearly zero; from there the mass moves as (t - 0.2)^3/3."""

    @jax.jit
    def run(limit: Any) -> Any:
        ramp = jms.AppliedForce(lambda t, q, qd, p: 2.0 * jnp.maximum(t - 0.2, 0.0)[None])
        scene = jms.Scene(lambda t, q, qd, p: 0.5 * qd[0] ** 2, effects=(ramp, jms.Friction(jms.Coulomb(limit))))
        run = jms.simulate(scene, [0.0], [0.0], 1.2)
        return run.q[-1, 0], run.events.t[0], run.stats["num_steps"]

    for limit in (0.0, 1e-12):
        q, break_away, steps = run(limit)
        np.testing.assert_allclose(q, 1.0 / 3.0, rtol=1e-6)
        np.testing.assert_allclose(break_away, 0.2, atol=1e-9)
        assert steps < 200
