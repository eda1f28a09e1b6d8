"""The two plug-ins that let events pass, in plain diffrax; and what diffrax's own terminating events do instead."""
# ruff: noqa: ARG001 (guards and fields have the arguments that diffrax passes, used or not)

import functools
from importlib.metadata import version
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest

from jaxmodsim import EventController, EventSolver, Rodas5P, StoredSteps

G = 9.81
TS = jnp.linspace(0.0, 2.0, 9)
SAVED = dfx.SaveAt(subs=(dfx.SubSaveAt(t1=True), dfx.SubSaveAt(ts=TS, fn=lambda t, s, args: s.y)))


def fall(t: Any, s: Any, args: Any) -> Any:
    return s.rate(jnp.stack([s.y[1], -G * jnp.ones_like(s.y[0])]))


def clock(t: Any, s: Any, args: Any) -> Any:
    return s.rate(jnp.ones_like(s.y))


def floor(t: Any, s: Any, args: Any) -> Any:
    return s.y[:1]


def bounce(t: Any, s: Any, args: Any, fired: Any) -> Any:
    return s._replace(y=jnp.stack([jnp.zeros_like(s.y[0]), -0.8 * s.y[1]]))


def count(t: Any, s: Any, args: Any, fired: Any) -> Any:
    return s._replace(mode=s.mode + fired)


@functools.partial(eqx.filter_jit, donate="none")
def solve(field: Any, guards: Any, reset: Any, y0: Any, t1: Any, **how: Any) -> Any:
    """One run with events; everything that is not an array is compiled in."""
    events = EventSolver(
        how.get("solver", dfx.Tsit5()),
        guards,
        reset,
        enforce=how.get("enforce", False),
        max_events=how.get("max_events", 16),
    )
    start = events.start(how.get("t0", 0.0), y0, how.get("mode"))
    return dfx.diffeqsolve(
        dfx.ODETerm(field),
        events,
        how.get("t0", 0.0),
        t1,
        how.get("dt0"),
        start,
        stepsize_controller=EventController(how.get("controller", dfx.PIDController(1e-8, 1e-10))),
        saveat=how.get("saveat", dfx.SaveAt(t1=True)),
        max_steps=4096,
        throw=False,
    )


def bounces(n: int) -> np.ndarray:
    """Times at which a ball dropped from 1 m with restitution 0.8 touches the floor."""
    first = np.sqrt(2 / G)
    return np.cumsum([first, *(2 * first * 0.8**k for k in range(1, n))])


SOLVERS = {
    "Tsit5": dfx.Tsit5(),
    "Dopri8": dfx.Dopri8(),
    "Rodas5P": Rodas5P(),
    "Kvaerno5": dfx.Kvaerno5(),
}


@pytest.mark.parametrize("name", SOLVERS)
def test_a_ball_bounces_with_any_solver(name: str) -> None:
    solution = solve(fall, floor, bounce, jnp.array([1.0, 0.0]), 2.0, solver=SOLVERS[name], saveat=SAVED)
    end, saved = solution.ys
    np.testing.assert_array_equal(end.events, [3.0])
    np.testing.assert_allclose(end.log.t[0, :3], bounces(3), rtol=1e-12)
    assert np.all(np.isinf(end.log.t[0, 3:]))
    # Dense output within the arcs between the bounces.
    speed = np.sqrt(2 * G)
    for t, (height, _) in zip(np.asarray(TS), np.asarray(saved), strict=True):
        n = int(np.sum(bounces(3) <= t))
        since = t - bounces(3)[n - 1] if n else t
        expected = 1 - 0.5 * G * t**2 if n == 0 else speed * 0.8**n * since - 0.5 * G * since**2
        np.testing.assert_allclose(height, expected, atol=1e-9)


def test_a_ball_bounces_with_a_fixed_step() -> None:
    how = {"controller": dfx.ConstantStepSize(), "dt0": 0.01, "solver": dfx.Midpoint()}
    solution = solve(fall, floor, bounce, jnp.array([1.0, 0.0]), 2.0, **how)
    np.testing.assert_allclose(solution.ys.log.t[0, :3], bounces(3), rtol=1e-12)
    # Steps of 10 ms, and for each bounce one that passes it and two around it. Near the tops of the arcs a few steps
    # are repeated: the dense output of the method is less exact than its steps.
    assert 206 <= solution.stats["num_steps"] <= 222


@pytest.mark.parametrize(
    ("controller", "dt0"), [(dfx.ConstantStepSize(), 0.01), (dfx.StepTo(jnp.linspace(0.0, 2.0, 201)), None)]
)
def test_given_steps_go_on_as_given_after_an_event(controller: Any, dt0: float | None) -> None:
    """The step after an event covers the rest: it was up to three times as long, beyond what the method may bear."""
    events = EventSolver(dfx.Tsit5(), floor, bounce, max_events=16)
    run = dfx.diffeqsolve(
        dfx.ODETerm(fall), events, 0.0, 2.0, dt0, events.start(0.0, jnp.array([1.0, 0.0])),
        stepsize_controller=EventController(controller), saveat=dfx.SaveAt(t0=True, steps=True),
    )  # fmt: skip
    assert run.ts is not None
    ends = np.asarray(run.ts)
    ends = ends[np.isfinite(ends)]
    given = np.concatenate([np.linspace(0.0, 2.0, 201), bounces(3)])
    np.testing.assert_allclose(ends, np.sort(given), rtol=0, atol=1e-12)
    assert run.stats["num_rejected_steps"] == 3


def test_the_log_holds_states_before_and_after() -> None:
    log = solve(fall, floor, bounce, jnp.array([1.0, 0.0]), 2.0).ys.log
    before, after = np.asarray(log.before[0][0, :3]), np.asarray(log.after[0][0, :3])
    np.testing.assert_allclose(before[:, 0], 0.0, atol=1e-14)
    np.testing.assert_allclose(before[:, 1], -np.sqrt(2 * G) * 0.8 ** np.arange(3), rtol=1e-10)
    np.testing.assert_allclose(after[:, 1], -0.8 * before[:, 1], rtol=1e-14)
    np.testing.assert_array_equal(log.fired[0, :3], 1.0)


def test_an_event_at_t1_belongs_to_the_run_that_ends_there() -> None:
    first = float(bounces(1)[0])
    one = solve(fall, floor, bounce, jnp.array([1.0, 0.0]), first)
    np.testing.assert_array_equal(one.ys.events, [1.0])
    np.testing.assert_allclose(one.ys.y[0], [0.0, 0.8 * np.sqrt(2 * G)], atol=1e-12)
    two = solve(fall, floor, bounce, one.ys.y[0], 2.0, t0=first)
    np.testing.assert_array_equal(two.ys.events, [2.0])
    np.testing.assert_allclose(two.ys.log.t[0, :2], bounces(3)[1:], rtol=1e-12)


@pytest.mark.parametrize(
    ("y0", "enforce", "events"),
    [
        ([0.0, 3.0], False, 0),  # zero and rising: not back within 0.3 s
        ([0.0, 3.0], True, 0),
        ([0.0, -3.0], False, 0),  # zero and falling: the event belongs to the run before
        ([0.0, -3.0], True, 1),  # unless the guard has to hold
        ([-0.1, 0.0], False, 0),  # violated on entry
    ],
)
def test_guards_at_the_start(y0: list[float], enforce: bool, events: int) -> None:
    run = solve(fall, floor, bounce, jnp.array(y0), 0.3, enforce=enforce)
    np.testing.assert_array_equal(run.ys.events, [float(events)])
    assert run.result == dfx.RESULTS.successful
    if events:
        np.testing.assert_allclose(run.ys.log.t[0, 0], 0.0, atol=1e-9)


def test_a_violated_guard_that_has_to_hold_and_cannot_is_named() -> None:
    """A ball below the floor is not lifted by a bounce."""
    run = solve(fall, floor, bounce, jnp.array([-0.1, 0.0]), 0.3, enforce=True, max_events=64)
    np.testing.assert_array_equal(run.ys.status, [1.0])
    assert run.result == dfx.RESULTS.dt_min_reached


def test_an_event_within_rounding_of_the_start_fires_once() -> None:
    """A guard that is known to the rounding of 10, and falls through zero sooner than float32 resolves at t1."""
    real, eps = jnp.float32, float(jnp.finfo(jnp.float32).eps)
    zero, one = jnp.zeros((), real), jnp.ones((), real)
    events = EventSolver(
        dfx.Tsit5(), lambda t, s, args: 10.0 + s.y - 10.0, lambda t, s, args, fired: s._replace(mode=s.mode + fired),
        dtmin=eps, max_events=4,
    )  # fmt: skip
    control = EventController(dfx.PIDController(1e-5, 1e-7, dtmin=eps, force_dtmin=False))

    @jax.jit
    @jax.vmap
    def run(y0: Any, rate: Any) -> Any:
        start = events.start(zero, y0[None], zero[None])
        field = dfx.ODETerm(lambda t, s, args: s.rate(jnp.where(s.mode > 0, zero, -rate)))
        how: dict[str, Any] = {"stepsize_controller": control, "throw": False}
        done: Any = dfx.diffeqsolve(field, events, zero, one, 1e-3 * one, start, **how)
        return done.result == dfx.RESULTS.successful, done.ys.events[-1], done.ys.log.t[-1, 0]

    # XLA of jaxlib 0.10 cancels the tens. From 0.11 on the guard is a staircase: it is zero at a start below half a
    # stair, and an event is up to 4 stairs early.
    cancels, stair = version("jaxlib").startswith("0.10."), float(np.spacing(np.float32(10.0)))
    rng = np.random.default_rng(0)
    y0, rate = 10.0 * eps * rng.uniform(0.0 if cancels else 0.5, 9.0, 128), 10.0 ** rng.uniform(-1.0, 6.0, 128)
    successful, count, t = run(jnp.asarray(y0, real), jnp.asarray(rate, real))
    assert np.all(successful)
    np.testing.assert_array_equal(count, 1.0)
    np.testing.assert_allclose(t * rate, y0, atol=10.0 * eps if cancels else 4.0 * stair)


@pytest.mark.parametrize(("begin", "root", "stair"), [(100.0, 4e-6, 0.0), (4.0, 0.0, 1e-6)])
def test_an_event_in_rounding_has_the_time_and_the_derivative_of_its_root(
    begin: float, root: float, stair: float
) -> None:
    """Thresholds of a sine in float32; `root`: the value of the guards at events, `stair`: their rounding."""
    real, eps = jnp.float32, float(jnp.finfo(jnp.float32).eps)

    def thresholds(t: Any, s: Any, above: Any) -> Any:
        values = jnp.stack([s.y[0] + 10.0, above - s.y[0]])
        if stair:
            values += jax.lax.stop_gradient(jnp.round(values / stair) * stair - values)
        return values, jnp.full_like(values, 4 * stair), jnp.full_like(values, root)

    shortest = eps * (begin + 1.6)
    events = EventSolver(dfx.Tsit5(), thresholds, count, rtol=1e-5, dtmin=shortest, max_events=4)
    control = EventController(dfx.PIDController(1e-5, 1e-7, dtmin=shortest, force_dtmin=False))

    @jax.jit
    @jax.vmap
    def passage(above: Any) -> Any:
        def time_of(above: Any) -> Any:
            start = events.start(jnp.asarray(begin, real), jnp.array([0.0, 1.0], real), jnp.zeros(2, real), above)
            field = dfx.ODETerm(lambda t, s, args: s.rate(jnp.stack([s.y[1], -s.y[0]])))
            how: dict[str, Any] = {"stepsize_controller": control, "adjoint": dfx.ForwardMode()}
            t0, t1 = jnp.asarray(begin, real), jnp.asarray(begin + 1.6, real)
            done: Any = dfx.diffeqsolve(field, events, t0, t1, 1e-3, start, above, throw=False, **how)
            return done.ys.log.t[-1, 0], done.result == dfx.RESULTS.successful

        return jax.jvp(time_of, (above,), (jnp.ones_like(above),), has_aux=True)

    above = np.linspace(0.05, 0.95, 512, dtype=np.float32)
    t, slope, successful = (np.asarray(x) for x in passage(jnp.asarray(above)))
    assert np.mean(successful) > 0.95  # stairs as wide as the resolution of time may end a run, but not in silence
    t, slope, exact = t[successful], slope[successful], above[successful].astype(float)
    np.testing.assert_allclose(t, begin + np.arcsin(exact), rtol=4 * eps, atol=10 * max(root, stair))
    np.testing.assert_allclose(slope, 1 / np.sqrt(1 - exact**2), rtol=1e-3)


@pytest.mark.parametrize("name", ["Tsit5", "Rodas5P"])
def test_a_step_to_infinity_is_repeated_with_a_shorter_one(name: str) -> None:
    """A body that falls on a wall of `exp(-k y)`; a step ends deep in the wall, where the force overflows."""

    def field(t: Any, s: Any, args: Any) -> Any:
        return s.rate(jnp.stack([s.y[1], 1e6 * jnp.exp(-1e6 * s.y[0]) - G]))

    ground = lambda t, s, args: s.y[:1] + 1.0  # noqa: E731
    run = solve(field, ground, bounce, jnp.array([1.0, 0.0]), 0.8, solver=SOLVERS[name])
    assert run.result == dfx.RESULTS.successful
    height, speed = run.ys.y[-1]
    assert 0.5 * speed**2 + G * height == pytest.approx(G, rel=1e-6)


def test_a_guard_that_starts_at_zero_and_rises_fires_when_it_comes_down() -> None:
    run = solve(fall, floor, bounce, jnp.array([0.0, 3.0]), 1.0)
    np.testing.assert_allclose(run.ys.log.t[0, 0], 2 * 3.0 / G, rtol=1e-12)


@pytest.mark.parametrize("rate", [1.0, 50.0])
def test_each_crossing_counts_once_in_its_direction(rate: float) -> None:
    """Both directions of sin; the step grows without limit as the field is constant, the guards alone hold it."""
    guards = lambda t, s, args: jnp.stack([jnp.sin(rate * t), -jnp.sin(rate * t)])  # noqa: E731
    t1 = 20.0 / rate
    run = solve(clock, guards, count, jnp.zeros(1), t1, mode=jnp.zeros(2))
    np.testing.assert_array_equal(run.ys.mode[0], [3.0, 3.0])
    np.testing.assert_allclose(rate * run.ys.log.t[0, :6] / np.pi, np.arange(1, 7), rtol=1e-9)
    np.testing.assert_array_equal(run.ys.log.fired[0, :6, 0], [1, 0, 1, 0, 1, 0])


def test_the_earliest_comes_first_and_simultaneous_ones_together() -> None:
    guards = lambda t, s, args: jnp.stack([1.3 - t, 1.0 - t, 1.0 - t, 1.3 + 1e-3 - t])  # noqa: E731
    run = solve(clock, guards, count, jnp.zeros(1), 3.0, mode=jnp.zeros(4))
    np.testing.assert_allclose(run.ys.log.t[0, :3], [1.0, 1.3, 1.301], rtol=1e-12)
    np.testing.assert_array_equal(run.ys.log.fired[0, :3], [[0, 1, 1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])
    np.testing.assert_array_equal(run.ys.mode[0], [1.0, 1.0, 1.0, 1.0])


def test_a_reset_that_violates_another_guard_lets_it_fire_at_once() -> None:
    guards = lambda t, s, args: jnp.stack([1.0 - t, 1.0 - s.y[0] + t])  # noqa: E731
    push = lambda t, s, args, fired: s._replace(  # noqa: E731
        y=jnp.where(fired[0], s.y + 5.0, s.y - 10.0), mode=s.mode + fired
    )
    run = solve(clock, guards, push, jnp.zeros(1), 2.0, mode=jnp.zeros(2))
    np.testing.assert_array_equal(run.ys.mode[0], [1.0, 1.0])
    np.testing.assert_allclose(run.ys.log.t[0, :2], [1.0, 1.0], atol=1e-8)
    np.testing.assert_allclose(run.ys.y[0, 0], 2.0 + 5.0 - 10.0, atol=1e-8)


def test_a_double_crossing_inside_a_step_is_found_if_a_cubic_sees_it() -> None:
    dip = lambda t, s, args: ((t - 5.0) ** 2 - 1e-4)[None]  # noqa: E731
    run = solve(clock, dip, count, jnp.zeros(1), 10.0, mode=jnp.zeros(1))
    np.testing.assert_allclose(run.ys.log.t[0, 0], 4.99, rtol=1e-9)
    # The stated limit: a spike between the four points of a long step is missed.
    spike = lambda t, s, args: (1 - 2 * jnp.exp(-((50 * (t - 5.0)) ** 2)))[None]  # noqa: E731
    missed = solve(clock, spike, count, jnp.zeros(1), 10.0, mode=jnp.zeros(1))
    np.testing.assert_array_equal(missed.ys.events, [0.0])
    caught = solve(
        clock,
        spike,
        count,
        jnp.zeros(1),
        10.0,
        mode=jnp.zeros(1),
        controller=dfx.PIDController(1e-8, 1e-10, dtmax=0.05),
    )
    np.testing.assert_allclose(caught.ys.log.t[0, 0], 5 - np.sqrt(np.log(2)) / 50, rtol=1e-9)


def test_the_limit_of_events_ends_the_run_and_keeps_what_it_has() -> None:
    run = solve(fall, floor, bounce, jnp.array([1.0, 0.0]), 5.0, max_events=3)
    assert run.result == dfx.RESULTS.max_steps_reached
    np.testing.assert_array_equal(run.ys.status, [2.0])
    # The run ends on the step that landed, within the landing distance; the log has the root.
    np.testing.assert_allclose(run.ts, bounces(4)[-1:], atol=1e-5)
    np.testing.assert_allclose(run.ys.log.t[0], bounces(3), rtol=1e-12)


def test_dense_output_and_steps_pass_through_events() -> None:
    run = solve(fall, floor, bounce, jnp.array([1.0, 0.0]), 2.0, saveat=dfx.SaveAt(dense=True, steps=True))
    touch = float(bounces(1)[0])
    # At the event the value after it; just before, the one before.
    assert run.evaluate(touch - 1e-6).y[1] < 0 < run.evaluate(touch + 1e-6).y[1]
    np.testing.assert_allclose(run.evaluate(0.3).y[0], 1 - 0.5 * G * 0.09, rtol=1e-9)
    assert int(np.sum(np.isfinite(run.ts))) == run.stats["num_accepted_steps"]


def test_an_implicit_solver_with_fixed_steps_does_not_pass_in_silence() -> None:
    """diffrax gives an implicit solver the tolerances of the controller; constant steps have none."""
    run = solve(
        fall,
        floor,
        bounce,
        jnp.array([1.0, 0.0]),
        0.1,
        solver=dfx.Kvaerno3(),
        controller=dfx.ConstantStepSize(),
        dt0=0.01,
    )
    assert run.result != dfx.RESULTS.successful


# What a user of diffrax's own Event meets, and why modes do not stand on it.


def terminating(cond: Any, y0: Any, t1: float, direction: Any = None, dt0: float | None = None) -> Any:
    controller = dfx.PIDController(1e-8, 1e-10) if dt0 is None else dfx.ConstantStepSize()
    return dfx.diffeqsolve(
        dfx.ODETerm(lambda t, y, args: jnp.stack([y[1], -G * jnp.ones_like(y[0])])),
        dfx.Tsit5(),
        0.0,
        t1,
        dt0,
        jnp.asarray(y0),
        event=dfx.Event(cond, optx.Newton(1e-10, 1e-10, optx.rms_norm), direction),
        stepsize_controller=controller,
        throw=False,
    )


def test_trap_a_guard_at_zero_at_the_start() -> None:
    """A ball thrown from the floor: diffrax stops at once, ours when it is back."""
    height = lambda t, y, args, **kw: y[0]  # noqa: E731
    back = 2 * 3.0 / G
    theirs = terminating(height, [0.0, 3.0], 1.0)
    assert abs(float(theirs.ts[0]) - back) > 0.1
    ours = solve(fall, floor, bounce, jnp.array([0.0, 3.0]), 1.0)
    np.testing.assert_allclose(ours.ys.log.t[0, 0], back, rtol=1e-12)


def test_trap_two_guards_in_one_step() -> None:
    """Of two guards crossed in one step diffrax takes the first in the tree, ours the earliest."""
    late = lambda t, y, args, **kw: 0.09 - t  # noqa: E731
    early = lambda t, y, args, **kw: 0.05 - t  # noqa: E731
    theirs = terminating([late, early], [1.0, 0.0], 0.1, dt0=0.1)
    np.testing.assert_allclose(theirs.ts[0], 0.09, atol=1e-8)
    guards = lambda t, s, args: jnp.stack([0.09 - t, 0.05 - t])  # noqa: E731
    ours = solve(clock, guards, count, jnp.zeros(1), 0.1, mode=jnp.zeros(2), controller=dfx.ConstantStepSize(), dt0=0.1)
    np.testing.assert_allclose(ours.ys.log.t[0, :2], [0.05, 0.09], rtol=1e-12)


def test_trap_a_double_crossing_in_one_step() -> None:
    """Below zero and up again within a step: diffrax sees nothing, ours does."""
    dip = lambda t, y, args, **kw: (t - 0.05) ** 2 - 1e-4  # noqa: E731
    theirs = terminating(dip, [1.0, 0.0], 0.1, dt0=0.1)
    assert theirs.result == dfx.RESULTS.successful
    guards = lambda t, s, args: ((t - 0.05) ** 2 - 1e-4)[None]  # noqa: E731
    ours = solve(clock, guards, count, jnp.zeros(1), 0.1, mode=jnp.zeros(1), controller=dfx.ConstantStepSize(), dt0=0.1)
    np.testing.assert_allclose(ours.ys.log.t[0, 0], 0.04, rtol=1e-12)


def test_batches_with_different_numbers_of_events_do_not_disturb_each_other() -> None:
    """Values and gradients of a batch, one lane of which accumulates events, equal those of the runs alone."""

    def end(e: Any, v: Any) -> Any:
        reset = lambda t, s, args, fired: s._replace(y=jnp.stack([0.0 * s.y[0], -args * s.y[1]]))  # noqa: E731
        events = EventSolver(dfx.Tsit5(), floor, reset, max_events=64, log=0)
        solution = dfx.diffeqsolve(
            dfx.ODETerm(fall),
            events,
            0.0,
            1.7,
            None,
            events.start(0.0, jnp.stack([jnp.ones_like(v), v]), None, e),
            args=e,
            stepsize_controller=EventController(dfx.PIDController(1e-8, 1e-10)),
            max_steps=2048,
            throw=False,
        )
        state: Any = solution.ys
        times: Any = solution.ts
        return state.y[0, 1], (state.status[0], times[0])

    both = jax.jit(jax.value_and_grad(end, argnums=(0, 1), has_aux=True))
    e, v = jnp.array([0.8, 0.3, 0.5]), jnp.array([0.0, 0.5, -1.0])
    (value, (status, t)), gradient = jax.jit(jax.vmap(both))(e, v)
    np.testing.assert_array_equal(status, [0.0, 1.0, 1.0])
    assert t[0] == 1.7
    assert np.all(np.asarray(t[1:]) < 1.7)
    for i in range(3):
        (alone, _), slope = both(e[i], v[i])
        # Where events accumulate, the last velocity is a product of many small ones, and so is its rounding error.
        close = 1e-9 if i == 0 else 1e-2
        np.testing.assert_allclose(value[i], alone, rtol=close)
        np.testing.assert_allclose(np.array(gradient)[:, i], np.array(slope), rtol=close)


def test_guards_that_fire_together_have_the_derivatives_of_their_own_times() -> None:
    """Two balls that are dropped from the same height, or nearly, and bounce on their own: a height and a time each."""
    t1 = 0.8

    def after_one(h: Any) -> Any:
        since = t1 - jnp.sqrt(2 * h / G)
        return 0.8 * jnp.sqrt(2 * G * h) * since - 0.5 * G * since**2

    def both_bounce(t: Any, s: Any, args: Any, fired: Any) -> Any:
        return s._replace(y=jnp.where(fired, jnp.stack([0.0 * s.y[0], -0.8 * s.y[1]]), s.y))

    def simulated(h: Any) -> Any:
        events = EventSolver(dfx.Tsit5(), lambda t, s, args: s.y[0], both_bounce, max_events=4)
        solution = dfx.diffeqsolve(
            dfx.ODETerm(fall),
            events,
            0.0,
            t1,
            None,
            events.start(0.0, jnp.stack([h, 0.0 * h])),
            stepsize_controller=EventController(dfx.PIDController(1e-10, 1e-12)),
            adjoint=StoredSteps(),
            max_steps=512,
        )
        state: Any = solution.ys
        return jnp.stack([state.y[0, 0], state.log.each[0, 0]])

    def exact(h: Any) -> Any:
        return jnp.stack([after_one(h), jnp.sqrt(2 * h / G)])

    apart = jnp.array([0.0, 1e-12, -1e-9])
    heights = 1.0 + jnp.stack([0.0 * apart, apart], axis=1)
    for derivative in (jax.jacfwd, jax.jacrev):
        slopes = jax.jit(jax.vmap(derivative(simulated)))(heights)
        np.testing.assert_allclose(slopes, jax.vmap(jax.jacfwd(exact))(heights), rtol=1e-8, atol=1e-8)


def test_an_event_that_follows_at_once_has_its_own_time_and_derivative() -> None:
    """Of three equal balls in a row the first strikes the second; that strikes the third after a small gap."""

    def field(t: Any, s: Any, args: Any) -> Any:
        return s.rate(jnp.concatenate([s.y[3:], jnp.zeros(3)]))

    def gaps(t: Any, s: Any, args: Any) -> Any:
        return jnp.diff(s.y[:3])

    def exchange(t: Any, s: Any, args: Any, fired: Any) -> Any:
        v = s.y[3:]
        v = jnp.where(fired[0], v[jnp.array([1, 0, 2])], v)
        return s._replace(y=s.y.at[3:].set(jnp.where(fired[0], v, v[jnp.array([0, 2, 1])])))

    def run(x: Any) -> Any:
        y0 = jnp.zeros(6).at[jnp.array([0, 2, 3])].set(x * jnp.array([-1.0, 1.0, 1.0]))
        state = solve(field, gaps, exchange, y0, 1.0).ys
        return jnp.concatenate([state.y[0], state.log.t[0, :2]])

    def exact(x: Any) -> Any:
        first, second = x[0] / x[2], (x[0] + x[1]) / x[2]
        rest = jnp.zeros_like(first)
        return jnp.stack([rest, x[1], x[1] + x[2] * (1.0 - second), rest, rest, x[2], first, second])

    derivative = jax.jit(jax.jacrev(run))
    for gap in (1e-2, 1e-7, 1e-9):
        x = jnp.array([0.3, gap, 2.0])
        np.testing.assert_allclose(run(x), exact(x), atol=1e-12)
        np.testing.assert_allclose(derivative(x), jax.jacrev(exact)(x), atol=1e-9)


def test_second_derivatives_pass_through_events() -> None:
    """Height at 1.5 s, after two bounces, by the height of the drop and by gravity, against the closed form."""

    def after_two(x: Any) -> Any:
        h, g = x
        fall_time, speed = jnp.sqrt(2 * h / g), jnp.sqrt(2 * g * h)
        since = 1.5 - fall_time * (1 + 2 * 0.8)
        return 0.8**2 * speed * since - 0.5 * g * since**2

    def simulated(x: Any) -> Any:
        events = EventSolver(dfx.Tsit5(), floor, bounce, max_events=4, log=0)
        solution = dfx.diffeqsolve(
            dfx.ODETerm(lambda t, s, g: s.rate(jnp.stack([s.y[1], -g]))),
            events,
            0.0,
            1.5,
            None,
            events.start(0.0, jnp.stack([x[0], jnp.zeros_like(x[0])]), None, x[1]),
            args=x[1],
            stepsize_controller=EventController(dfx.PIDController(1e-10, 1e-12)),
            adjoint=dfx.ForwardMode(),
            max_steps=2048,
        )
        state: Any = solution.ys
        return state.y[0, 0]

    x = jnp.array([1.0, G])
    np.testing.assert_allclose(simulated(x), after_two(x), rtol=1e-10)
    hessian = jax.jit(jax.jacfwd(jax.jacfwd(simulated)))(x)
    np.testing.assert_allclose(hessian, jax.hessian(after_two)(x), rtol=1e-7)
