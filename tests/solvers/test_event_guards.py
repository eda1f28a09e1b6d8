"""The parts of the event solver by themselves, on functions and oscillators in closed form."""
# ruff: noqa: ARG001 (guards and fields have the arguments that diffrax passes, used or not)

from typing import Any

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmodsim import EventController, EventSolver
from jaxmodsim.solvers import FiniteSteps
from jaxmodsim.solvers.events._guard_scan import GuardScan, first_root, scan_guards
from jaxmodsim.solvers.events._passage import Landed, pass_event

ONE = jnp.ones(())
# A function of the fraction of a step, whether its guard is armed at the start, and the fraction of the event.
FALLS: dict[str, tuple[Any, bool, float | None]] = {
    "falls": (lambda s: (0.37 - s) * (1.0 + 0.3 * s * s), True, 0.37),
    "stays positive": (lambda s: 1.0 - 0.9 * s, True, None),
    "rises first, not armed": (lambda s: -(s - 0.2) * (s - 0.7), False, 0.7),
    "dips between two samples": (lambda s: (s - 0.42) ** 2 - 1e-3, True, 0.42 - 1e-3**0.5),
    "violated, not armed": (lambda s: -0.1 - s, False, None),
    "violated, armed": (lambda s: -0.1 - s, True, 0.0),
    "zero and rising, not armed": (lambda s: s * (0.8 - s), False, 0.8),
    "zero and rising, back before a sample": (lambda s: s * (0.2 - s), False, 0.2),
}


def scan(fn: Any, armed: bool, violated: bool = False) -> GuardScan:
    values = [jnp.asarray([fn(s)]) for s in (0.0, 1 / 3, 2 / 3, 1.0)]
    middle, tolerances = jnp.asarray([fn(0.5)]), (jnp.asarray(1e-9), jnp.zeros(1))
    flags = jnp.array([armed]), jnp.array([violated])
    return scan_guards((values[0], values[1], values[2], values[3]), middle, *flags, tolerances, 0 * ONE, ONE)


@pytest.mark.parametrize("name", FALLS)
def test_first_falls_of_cubics_are_found_as_aims_of_a_step(name: str) -> None:
    fn, armed, event = FALLS[name]
    seen = scan(fn, armed)
    assert bool(seen.crosses[0]) == (event is not None)
    np.testing.assert_allclose(first_root(seen, seen.crosses), 1.0 if event is None else event, atol=1e-6)


def test_a_guard_that_an_event_has_violated_falls_at_once_although_it_rises() -> None:
    for violated in (True, False):
        seen = scan(lambda s: s - 0.1, True, violated)
        assert bool(seen.crosses[0]) == violated
        assert first_root(seen, seen.crosses) == (0.0 if violated else 1.0)


def test_oscillations_within_a_step_are_not_resolved() -> None:
    """A step may grow where the guard is a line, and must shrink where it swings twice."""
    assert scan(lambda s: 1.0 - 0.1 * s, True).step_factor[0] > 10.0
    assert scan(lambda s: np.cos(12.0 * s), True).step_factor[0] < 0.5


def passed(angle: Any) -> Any:
    """State of x'' = -x, 1e-5 behind the fall of x through zero, where v becomes -0.8 v; and the time of the fall."""
    t, w = jnp.asarray(np.pi / 2 + 1e-5), jnp.ones(())
    y = jnp.stack([jnp.cos(t + angle), -jnp.sin(t + angle)])
    landed = Landed(
        t, y, w, jnp.array([True]), (jnp.zeros(()), -jnp.ones(())), jnp.asarray(True), jnp.asarray(1e-4), 0 * t,
        jnp.asarray(False),
    )  # fmt: skip
    passage = pass_event(
        landed,
        lambda t, y, mode, args: (jnp.stack([y[1], -mode * y[0]]), y[:1]),
        (None, None, None),
        lambda t, y: (jnp.stack([y[0], -0.8 * y[1]]), w),
    )
    return jnp.append(passage.y, passage.t)


def test_the_passage_through_an_event_has_its_derivatives() -> None:
    """Behind the event x = 0.8 sin(t - t_event), and t_event = pi/2 - angle."""

    def exact(angle: Any) -> Any:
        since = 1e-5 + angle
        return jnp.stack([0.8 * jnp.sin(since), 0.8 * jnp.cos(since), np.pi / 2 - angle])

    for derive in (lambda fn: fn, jax.jacfwd, jax.jacrev):
        np.testing.assert_allclose(derive(passed)(0.0), derive(exact)(0.0), atol=1e-9)
    # Second derivatives have an error of the length of the way to the root.
    np.testing.assert_allclose(jax.hessian(passed)(0.0), jax.hessian(exact)(0.0), atol=2e-5)


def clock(t: Any, s: Any, args: Any) -> Any:
    return s.rate(jnp.ones_like(s.y))


def test_a_step_reports_to_the_controller() -> None:
    """A guard 1 - t: a step to 1.5 passes its root; the next one ends there and resets; then comes the rest."""
    terms, t0 = dfx.ODETerm(clock), jnp.zeros(())
    solver = EventSolver(dfx.Euler(), lambda t, s, a: 1.0 - s.y, lambda t, s, a, fired: s._replace(mode=s.mode + 1.0))
    controller = EventController(FiniteSteps(), direction=1)
    start = solver.start(0.0, jnp.zeros(1), jnp.zeros(()))
    memory = solver.init(terms, t0, jnp.asarray(1.5), start, None)
    assert memory[1].armed.dtype == bool
    _, control = controller.init(terms, t0, jnp.asarray(9.0), start, jnp.asarray(1.5), None, solver.func, None)
    # End of an attempt, whether it is accepted, and the end of the next one.
    for end, accepted, following in ((1.5, False, 1.0), (1.0, True, 1.5)):
        t1 = jnp.asarray(end)
        after, error, _, kept, _ = solver.step(terms, t0, t1, start, None, memory, False)
        accept, _, t_next, jump, control, _ = controller.adapt_step_size(
            t0, t1, start, after, None, error, None, control
        )
        assert (bool(accept), bool(jump), after.events == 1.0) == (accepted, accepted, accepted)
        np.testing.assert_allclose(t_next, following, rtol=1e-12)
    log: Any = after.log
    np.testing.assert_allclose(log.t[0], 1.0, rtol=1e-12)
    assert (after.mode, kept[1].resets, bool(kept[1].armed[0])) == (1.0, 1, False)


def test_the_time_of_an_event_of_an_oscillator() -> None:
    """x'' = -w^2 x from (1, 0) falls through zero at pi/(2 w) and 5 pi/(2 w)."""

    def times(w: Any) -> Any:
        solver = EventSolver(
            dfx.Dopri8(), lambda t, s, w: s.y[:1], lambda t, s, w, fired: s._replace(mode=s.mode + 1.0)
        )
        solution = dfx.diffeqsolve(
            dfx.ODETerm(lambda t, s, w: s.rate(jnp.stack([s.y[1], -(w**2) * s.y[0]]))),
            solver,
            0.0,
            6.0,
            None,
            solver.start(0.0, jnp.array([1.0, 0.0]), jnp.zeros(()), w),
            w,
            stepsize_controller=EventController(dfx.PIDController(1e-11, 1e-11)),
            max_steps=256,
        )
        state: Any = solution.ys
        return state.log.t[0, :2]

    w = 1.5
    np.testing.assert_allclose(times(w), np.pi * np.array([0.5, 2.5]) / w, rtol=1e-10)
    np.testing.assert_allclose(jax.jit(jax.jacrev(times))(w), -np.pi * np.array([0.5, 2.5]) / w**2, rtol=1e-6)
