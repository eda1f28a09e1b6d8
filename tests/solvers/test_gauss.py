"""Gauss as a plug-in of plain diffrax, without anything else of this package."""

from typing import Any

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmodsim import Gauss
from jaxmodsim.solvers import FiniteSteps
from jaxmodsim.solvers._collocation import GAUSS, collocation_start, collocation_step

from ..helpers.differences import central_difference

STAGES = pytest.mark.parametrize("stages", [1, 2, 3])
T1 = 2.0
FINE = jnp.linspace(0.0, T1, 157)  # shares no inner point with the steps below


def solve(field: Any, y0: Any, t1: Any, dt: Any, args: Any = None, stages: int = 3, **options: Any) -> Any:
    options = {"max_steps": 4096, "solver": Gauss(stages), **options}
    return dfx.diffeqsolve(dfx.ODETerm(field), t0=jnp.zeros_like(t1), t1=t1, dt0=dt, y0=y0, args=args, **options)


@pytest.mark.quick
@STAGES
def test_order_conditions(stages: int) -> None:
    """B(2s) and C(s), which make order 2s; and the form that keeps the method symplectic in spite of rounding."""
    method = GAUSS[stages]
    b, c = method.weights, method.nodes
    a = method.coupling(np.float64) * b
    for k in range(1, 2 * stages + 1):
        np.testing.assert_allclose(b @ c ** (k - 1), 1.0 / k, rtol=1e-15)
    for k in range(1, stages + 1):
        np.testing.assert_allclose(a @ c ** (k - 1), c**k / k, atol=1e-16)
    for dtype in (np.float32, np.float64):
        m = method.coupling(dtype)
        assert m.dtype == dtype
        np.testing.assert_array_equal(m + m.T, np.ones((stages, stages)))
        # Equal also before the sum was rounded.
        np.testing.assert_array_equal(m.astype(np.longdouble) + m.T.astype(np.longdouble), 1.0)


def field(t: Any, y: Any, args: Any) -> Any:
    """Nonlinear and nonautonomous, in leaves of two shapes; `exact` solves it."""
    del args
    a, b = y["a"], y["b"]
    bend = -2.0 * t * b[0, 0]
    return {"a": bend * a, "b": jnp.stack([jnp.stack([bend * b[0, 0], b[0, 1] * jnp.cos(t) * a / b[0, 0]])])}


def exact(t: Any) -> dict[str, Any]:
    """`b_0 = a = 1/(1+t^2)` and `b_1 = exp(sin t)`."""
    bell = 1.0 / (1.0 + t**2)
    return {"a": bell, "b": jnp.stack([bell, jnp.exp(jnp.sin(t))], axis=-1)[..., None, :]}


@pytest.mark.quick
@STAGES
def test_observed_order(stages: int) -> None:
    """Twice the number of stages, at the ends of steps and between them."""

    @jax.jit
    def errors(dt: Any) -> Any:
        saveat = dfx.SaveAt(t1=True, ts=FINE, dense=True)
        steps = solve(field, exact(jnp.array(0.0)), T1, dt, stages=stages, saveat=saveat, max_steps=80)
        expected = exact(jnp.append(FINE, T1))
        saved = jax.tree.map(lambda x, y: jnp.abs(x - y), steps.ys, expected)
        dense = jax.tree.map(lambda x, y: jnp.max(jnp.abs(x - y[:-1])), jax.vmap(steps.evaluate)(FINE), expected)
        end, inside = (
            jnp.max(jnp.stack([jnp.max(x[part]) for x in saved.values()])) for part in (slice(-1, None), slice(0, -1))
        )
        return jnp.stack([end, inside, jnp.maximum(*dense.values())])

    counts = (10, 20, 40) if stages == 3 else (20, 40, 80)
    table = np.array([errors(T1 / n) for n in counts])
    orders = np.log2(table[:-1] / table[1:])
    np.testing.assert_allclose(orders[-1], 2.0 * stages, atol=0.35)
    # A method whose order is right but whose coefficients are in part not has a larger constant.
    assert table[-1].max() < {1: 1e-3, 2: 1e-6, 3: 1e-9}[stages]
    # SaveAt(ts) and dense output are the same polynomial.
    np.testing.assert_allclose(table[:, 1], table[:, 2], rtol=1e-6)


def henon_heiles(t: Any, y: Any, args: Any) -> Any:
    del t, args
    x, v = y[:2], y[2:]
    return jnp.stack([v[0], v[1], -x[0] - 2.0 * x[0] * x[1], -x[1] - x[0] ** 2 + x[1] ** 2])


@STAGES
def test_one_step_is_symplectic(stages: int) -> None:
    """J^T Omega J = Omega for the Jacobian of a long step, forward and reverse."""
    solver, term, y0 = Gauss(stages), dfx.ODETerm(henon_heiles), jnp.array([0.3, -0.2, 0.4, 0.25])
    memory = solver.init(term, 0.0, 0.5, y0, None)

    def step(y: Any) -> Any:
        return solver.step(term, 0.0, 0.5, y, None, memory, False)[0]

    forward, reverse = jax.jit(lambda y: (jax.jacfwd(step)(y), jax.jacrev(step)(y)))(y0)
    np.testing.assert_allclose(forward, reverse, atol=1e-15)
    omega = np.kron([[0.0, 1.0], [-1.0, 0.0]], np.eye(2))
    np.testing.assert_allclose(forward.T @ omega @ forward, omega, atol=1e-14)


def kepler(t: Any, y: Any, args: Any) -> Any:
    del t, args
    (x, v), (a, b) = y
    pull = -1.0 / (x**2 + v**2) ** 1.5
    return (a, b), (pull * x, pull * v)


def kepler_start(eccentricity: float) -> Any:
    """At the pericentre, with a period of 2 pi."""
    speed = ((1.0 + eccentricity) / (1.0 - eccentricity)) ** 0.5
    return (jnp.array(1.0 - eccentricity), jnp.array(0.0)), (jnp.array(0.0), jnp.array(speed))


def energy(y: Any) -> np.ndarray:
    (x, v), (a, b) = (tuple(map(np.asarray, pair)) for pair in y)
    return 0.5 * (a**2 + b**2) - 1.0 / np.hypot(x, v)


def angular_momentum(y: Any) -> np.ndarray:
    (x, v), (a, b) = (tuple(map(np.asarray, pair)) for pair in y)
    return x * b - v * a


def drift(values: np.ndarray) -> float:
    """Mean of the last tenth less that of the first."""
    tenth = len(values) // 10
    return float(np.mean(values[-tenth:]) - np.mean(values[:tenth]))


def test_energy_does_not_drift_in_2000_periods() -> None:
    """A Kepler orbit: Gauss at 20 steps per period against Tsit5 at as many evaluations of the field."""
    periods, y0 = 2000, kepler_start(0.2)

    def run(solver: Any, steps: int, every: int) -> Any:
        # The step is no simple fraction of the period, so that means over steps are means over phases.
        count = steps * periods
        dt = 2.0 * np.pi / (steps + 0.1234)
        saveat = dfx.SaveAt(steps=every)
        ys = solve(kepler, y0, count * dt, dt, solver=solver, saveat=saveat, max_steps=count).ys
        return jax.tree.map(lambda x: x[: count // every], ys)

    kept = run(Gauss(), 20, 1)
    level = energy(kept)
    # The error has the period of the orbit and stays within bounds.
    assert np.ptp(level) < 5e-7
    assert abs(drift(level)) < 2e-10
    # Angular momentum is a quadratic invariant: a random walk of 4e4 roundings, made smaller by carrying them along.
    moment = angular_momentum(kept)
    assert np.max(np.abs(moment - moment[0])) < 1e-14 * moment[0]
    # About 18 evaluations of three stages per step, against six per step of Tsit5.
    lost = energy(run(dfx.Tsit5(), 20 * 18 * 3 // 6, 9))
    assert abs(drift(lost)) > 1e-7


def pendulum(t: Any, y: Any, args: Any) -> Any:
    del t
    return y[1], -args * jnp.sin(y[0])


def test_time_reversal() -> None:
    """With its momentum turned round, a run goes back to where it came from."""
    run = jax.jit(lambda y0: solve(pendulum, y0, 30.0, 0.3, jnp.array(1.0)).ys)
    y0 = (jnp.array(2.0), jnp.array(0.5))
    q, p = (x[0] for x in run(y0))
    assert abs(q - y0[0]) > 0.1
    q, p = (x[0] for x in run((q, -p)))
    np.testing.assert_allclose((q, -p), y0, atol=1e-13)


def test_derivatives_forward_and_reverse() -> None:
    """Of a pendulum's end by its parameter and its start, against finite differences; second derivatives, too."""

    def end(x: Any, adjoint: Any) -> Any:
        return solve(pendulum, (x[1], x[2]), 3.0, 0.25, x[0], adjoint=adjoint, max_steps=16).ys[0][0]

    point = jnp.array([1.3, 1.0, -0.5])
    value = jax.jit(lambda x: end(x, dfx.DirectAdjoint()))
    reverse = jax.jit(jax.grad(lambda x: end(x, dfx.RecursiveCheckpointAdjoint())))
    forward = jax.jacfwd(lambda x: end(x, dfx.ForwardMode()))
    gradient, hessian = jax.jit(lambda x: (forward(x), jax.jacfwd(forward)(x)))(point)
    np.testing.assert_allclose(gradient, reverse(point), rtol=1e-12)
    # With a fixed step the run is one smooth function. Step 1e-3 of each number: truncation 1e-12, rounding 1e-12.
    for i in range(3):
        x0, step = float(point[i]), 1e-3 * abs(float(point[i]))
        np.testing.assert_allclose(
            gradient[i], central_difference(lambda x, i=i: value(point.at[i].set(x)), x0, step), rtol=1e-8
        )
        np.testing.assert_allclose(
            hessian[i], central_difference(lambda x, i=i: reverse(point.at[i].set(x)), x0, step), rtol=1e-8, atol=1e-9
        )


def test_derivatives_against_a_closed_form() -> None:
    """Of an oscillator by its frequency: within the method's own error."""

    def end(w: Any) -> Any:
        return solve(turning, (jnp.array(1.0), jnp.array(0.0)), T1, 0.1, w, max_steps=32).ys[0][0]

    value, slope = jax.jit(jax.value_and_grad(end))(1.7)
    np.testing.assert_allclose(value, np.cos(1.7 * T1), rtol=1e-8)
    np.testing.assert_allclose(slope, -T1 * np.sin(1.7 * T1), rtol=1e-7)


def test_unrolled_and_lapack_paths_agree() -> None:
    """Twelve unknowns are solved in scalars, fifteen by LAPACK; a state of thirteen is one vector: the same numbers."""

    def rates(t: Any, y: Any, args: Any) -> Any:
        head = y[:4]
        rate = args * jnp.sin(jnp.roll(head, 1)) * jnp.cos(t + jnp.roll(head, -1)) - head**3
        return jnp.concatenate([rate, jnp.zeros(y.size - 4)])

    def end(a: Any, n: int) -> Any:
        y = jnp.concatenate([jnp.linspace(-1.0, 1.5, 4), jnp.full(n - 4, 0.25)])
        y = Gauss().step(term, 0.1, 0.4, y, a, Gauss().init(term, 0.1, 0.4, y, a), False)[0]
        return jnp.sum(y[:4] ** 3), y

    term = dfx.ODETerm(rates)
    (small, small_slope), *others = (
        jax.jit(jax.value_and_grad(lambda a, n=n: end(a, n), has_aux=True))(1.1) for n in (4, 5, 13)
    )
    for (value, y1), slope in others:
        np.testing.assert_allclose(value, small[0], rtol=1e-14)
        np.testing.assert_allclose(slope, small_slope, rtol=1e-13)
        np.testing.assert_array_equal(y1[4:], 0.25)


def test_lanes_that_finish_early_or_fail_harm_no_other() -> None:
    """Under vmap and reverse mode: unequal numbers of steps, and one lane too stiff for its step."""

    def end(a: Any, t1: Any) -> Any:
        y0, controller = (jnp.array(1.0), jnp.array(0.0)), FiniteSteps()
        solution = solve(pendulum, y0, t1, 0.2, a, stepsize_controller=controller, throw=False, max_steps=32)
        ok = solution.result == dfx.RESULTS.successful
        return jnp.where(ok, solution.ys[0][0], 0.0), ok

    def total(a: Any, scales: Any, t1: Any) -> Any:
        values, ok = jax.vmap(lambda s, t: end(a * s, t))(scales, t1)
        return jnp.sum(values), (values, ok)

    run = jax.jit(jax.value_and_grad(total, has_aux=True))
    scales, t1 = jnp.array([1.0, 1.5, 1e4, 2.0]), jnp.array([0.5, 3.0, 2.0, 5.0])
    (_, (_, ok)), slope = run(1.0, scales, t1)
    np.testing.assert_array_equal(ok, [True, True, False, True])
    healthy = jnp.array([0, 1, 3, 3])
    (_, (_, ok)), expected = run(1.0, scales[healthy], t1[healthy])
    assert ok.all()
    (_, _), last = run(1.0, scales[jnp.array([3, 3, 3, 3])], t1[jnp.array([3, 3, 3, 3])])
    np.testing.assert_allclose(slope, expected - last / 4.0, rtol=1e-11)


def turning(t: Any, y: Any, w: Any) -> Any:
    del t
    return w * y[1], -w * y[0]


def stiff(t: Any, y: Any, args: Any) -> Any:
    return -args * (y - jnp.cos(t).astype(y.dtype))


@pytest.mark.parametrize("start", [0.5, 1.0])
def test_a_step_too_long_for_the_stiffness_is_no_number(start: float) -> None:
    """Also from the slow solution, where the first guess is nearly right."""
    run = jax.jit(lambda y0, a: solve(stiff, y0, 1.0, 0.1, a, throw=False))
    fails = run(jnp.array([start]), jnp.array(40.0))
    assert fails.result == dfx.RESULTS.nonlinear_divergence
    assert np.isnan(fails.ys).all()
    assert run(jnp.array([start]), jnp.array(10.0)).result == dfx.RESULTS.successful


def test_failure_with_finite_steps_keeps_the_last_state() -> None:
    """The stiffness grows until the steps are too long."""
    solution = solve(
        lambda t, y, args: -args * t * y,
        jnp.array([1.0]),
        1.0,
        0.05,
        80.0,
        stepsize_controller=FiniteSteps(),
        throw=False,
    )
    assert solution.result == dfx.RESULTS.nonlinear_divergence
    assert 3 < solution.stats["num_accepted_steps"] < 20
    t = 0.05 * float(solution.stats["num_accepted_steps"])
    np.testing.assert_allclose(solution.ys, np.exp(-40.0 * t**2), rtol=1e-2)


def test_the_guess_saves_iterations() -> None:
    """From the slopes of the step before, against a constant slope."""
    y0, dt = (jnp.array(1.0), jnp.array(0.3)), jnp.array(jnp.pi / 10.0)

    def field(t: Any, y: Any) -> Any:
        return turning(t, y, 1.0)

    def step(i: Any, carry: Any) -> Any:
        y, memory, counts = carry
        fresh = collocation_start(3, field, jnp.array(0.0), y)
        ends = [collocation_step(3, field, jnp.array(0.0), dt, y, before) for before in (fresh, memory)]
        return ends[1].y1, ends[1].memory, counts.at[i].set(jnp.stack([end.iterations for end in ends]))

    start = (y0, collocation_start(3, field, jnp.array(0.0), y0), jnp.zeros((20, 2), int))
    counts = np.asarray(jax.lax.fori_loop(0, 20, step, start)[2])
    assert counts.max() <= 20
    assert counts[:, 1].mean() < counts[:, 0].mean() - 1.0


def test_leaves_of_unequal_precision() -> None:
    """Each keeps its own, also in derivatives."""

    def end(w: Any) -> Any:
        y0 = (jnp.float32(1.0), jnp.float64(0.0))
        # Double precision in the times would raise all leaves to it.
        return solve(turning, y0, jnp.float32(T1), jnp.float32(0.1), w, max_steps=32, adjoint=dfx.ForwardMode()).ys

    (q, p), (dq, dp) = jax.jit(lambda w: jax.jvp(end, (w,), (1.0,)))(1.7)
    assert (q.dtype, p.dtype) == (dq.dtype, dp.dtype) == (np.float32, np.float64)
    np.testing.assert_allclose((dq[0], dp[0]), (-T1 * np.sin(1.7 * T1), -T1 * np.cos(1.7 * T1)), rtol=1e-5)


@STAGES
def test_single_precision_stays_single(stages: int) -> None:
    """And its stages are found to its own rounding."""
    w, t1 = jnp.float32(2.0), jnp.float32(40.0)
    y0 = (jnp.float32(1.0), jnp.float32(0.0))
    saveat = dfx.SaveAt(steps=True)
    solution = solve(turning, y0, t1, jnp.float32(0.125), w, stages, saveat=saveat, max_steps=320)
    q, p = (np.asarray(x) for x in solution.ys)
    assert q.dtype == p.dtype == np.float32
    np.testing.assert_allclose(q.astype(float) ** 2 + p.astype(float) ** 2, 1.0, atol=1e-6)
    if stages == 3:
        np.testing.assert_allclose(q[-1], np.cos(80.0), atol=1e-5)


def test_a_jump_drops_what_rounding_left() -> None:
    """After a jump the state may be much smaller than what was left of it before."""
    solver, term, y0 = Gauss(1), dfx.ODETerm(stiff), jnp.array([1e-12])
    memory = solver.init(term, 0.0, 0.1, y0, jnp.array(0.0))._replace(rest=[jnp.array(1e-11)])
    ends = [solver.step(term, 0.0, 0.1, y0, jnp.array(0.0), memory, jump)[0][0] for jump in (False, True)]
    np.testing.assert_allclose(ends, [1.1e-11, 1e-12], rtol=1e-12)


@pytest.mark.parametrize("stages", [0, 4, True])
def test_other_numbers_of_stages_are_refused(stages: Any) -> None:
    with pytest.raises(ValueError, match=rf"1, 2 or 3 stages, but stages = {stages}"):
        Gauss(stages)


@pytest.mark.parametrize("y0", [jnp.array([1.0 + 1.0j]), jnp.array([1])])
def test_states_that_are_not_real_are_refused(y0: jax.Array) -> None:
    with pytest.raises(ValueError, match=r"real floating numbers, but one of its arrays has the type (complex|int)"):
        Gauss().init(dfx.ODETerm(stiff), 0.0, 1.0, y0, None)


def test_adaptive_steps_are_refused() -> None:
    with pytest.raises(RuntimeError, match="does not provide error estimates"):
        solve(stiff, jnp.array([1.0]), 1.0, 0.1, 1.0, stepsize_controller=dfx.PIDController(1e-6, 1e-6))
