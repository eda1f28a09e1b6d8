"""The solvers under all adjoints of diffrax, and in both directions of time: right, or refused by a sentence."""

from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmodsim import (
    Coulomb,
    EventController,
    EventSolver,
    Friction,
    Gauss,
    Regularized,
    Rodas5P,
    Scene,
    StoredSteps,
    Viscous,
    simulate,
)

from ..helpers.differences import central_difference

X = jnp.array([3.0, 2.0, -0.5])
METHODS: dict[str, tuple[Any, Any]] = {
    "Rodas5P": (Rodas5P(), dfx.PIDController(1e-9, 1e-9)),
    "Gauss": (Gauss(), dfx.ConstantStepSize()),
}
ADJOINTS = {
    "checkpoints": dfx.RecursiveCheckpointAdjoint(),
    "direct": dfx.DirectAdjoint(),
    "stored steps": StoredSteps(),
    "backsolve": dfx.BacksolveAdjoint(),
    "backsolve by another solver": dfx.BacksolveAdjoint(
        solver=dfx.Tsit5(), stepsize_controller=dfx.PIDController(1e-9, 1e-9)
    ),
    "forward": dfx.ForwardMode(),
}
TS = jnp.array([0.5, 1.3, 2.0])


def van_der_pol(t: Any, y: Any, mu: Any) -> Any:
    return y[1], mu * (1 - y[0] ** 2) * y[1] - y[0] + 0.1 * jnp.sin(t)


def total(x: Any, method: str, adjoint: Any) -> Any:
    """Sum of the positions at `TS` of an oscillator with mu = x[0] that starts at x[1:]."""
    solver, controller = METHODS[method]
    solution = dfx.diffeqsolve(
        dfx.ODETerm(van_der_pol),
        solver,
        0.0,
        2.0,
        0.01,
        (x[1], x[2]),
        args=x[0],
        saveat=dfx.SaveAt(ts=TS),
        stepsize_controller=controller,
        adjoint=adjoint,
        max_steps=256,
    )
    ys: Any = solution.ys
    return jnp.sum(ys[0])


@pytest.fixture(scope="module")
def slopes() -> np.ndarray:
    """Differences of the run by one method, whose own error is 1e-11: step 1e-3, rounding 1e-9."""
    value = jax.jit(lambda x: total(x, "Gauss", dfx.ForwardMode()))
    return np.array([central_difference(lambda x, i=i: value(X.at[i].set(x)), float(X[i]), 1e-3) for i in range(3)])


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("adjoint", ADJOINTS)
def test_every_adjoint_gives_the_gradient(method: str, adjoint: str, slopes: np.ndarray) -> None:
    way = jax.jacfwd if adjoint == "forward" else jax.grad
    gradient = jax.jit(way(lambda x: total(x, method, ADJOINTS[adjoint])))(X)
    np.testing.assert_allclose(gradient, slopes, rtol=1e-6)


@pytest.mark.parametrize("method", METHODS)
def test_time_may_run_backward(method: str) -> None:
    """There and back again, and against the closed form of an equation that depends on time."""
    solver, controller = METHODS[method]

    def solve(field: Any, t0: float, t1: float, y0: Any) -> Any:
        dt0 = 0.01 if t1 > t0 else -0.01
        return dfx.diffeqsolve(dfx.ODETerm(field), solver, t0, t1, dt0, y0, X[0], stepsize_controller=controller).ys

    start = jnp.array([2.0, -0.5])
    there = solve(lambda t, y, mu: jnp.stack(van_der_pol(t, y, mu)), 0.0, 1.0, start)[0]
    back = solve(lambda t, y, mu: jnp.stack(van_der_pol(t, y, mu)), 1.0, 0.0, there)[0]
    np.testing.assert_allclose(back, start, rtol=1e-6)
    decay = solve(lambda t, y, _: -0.5 * t * y, 1.0, -2.0, jnp.ones(1))
    np.testing.assert_allclose(decay, [[np.exp(0.25 * (1.0 - 4.0))]], rtol=1e-8)


@pytest.mark.parametrize("method", METHODS)
def test_dense_output_backward(method: str) -> None:
    """What is saved between the steps, of exp(-t) from t = 1 back to 0."""
    solver, controller = METHODS[method]
    ts = jnp.linspace(1.0, 0.0, 23)
    solution = dfx.diffeqsolve(
        dfx.ODETerm(lambda t, y, args: -y),
        solver,
        1.0,
        0.0,
        -0.03,
        jnp.exp(-1.0),
        saveat=dfx.SaveAt(ts=ts),
        stepsize_controller=controller,
    )
    ys: Any = solution.ys
    np.testing.assert_allclose(ys, np.exp(-ts), rtol=1e-7)


@pytest.mark.parametrize("method", METHODS)
def test_terms_of_no_ordinary_differential_equation_are_refused(method: str) -> None:
    control = dfx.ControlTerm(lambda t, y, args: -y, lambda t0, t1: t1**2 - t0**2)
    for terms, kind in ((control, "ControlTerm"), (dfx.MultiTerm(dfx.ODETerm(lambda t, y, a: -y), control), "Multi")):
        with pytest.raises(ValueError, match=f"{method} solves ordinary differential equations, but a {kind}"):
            dfx.diffeqsolve(terms, METHODS[method][0], 0.0, 1.0, 0.1, jnp.ones(1))


def fall(t: Any, s: Any, g: Any) -> Any:
    del t
    return s.rate(jnp.stack([s.y[1], -g]))


def bounced(g: Any, t0: Any = 0.0, t1: Any = 1.0, adjoint: Any = None) -> Any:
    """Height [m] of a ball dropped from 1 m at t0, which bounces once."""
    solver = EventSolver(
        dfx.Tsit5(),
        lambda t, s, args: s.y[:1],
        lambda t, s, args, fired: s._replace(y=s.y * jnp.array([0.0, -0.8])),
        log=0,
    )
    solution = dfx.diffeqsolve(
        dfx.ODETerm(fall),
        solver,
        t0,
        t1,
        None,
        solver.start(t0, jnp.array([1.0, 0.0])),
        args=g,
        stepsize_controller=EventController(dfx.PIDController(1e-8, 1e-10)),
        adjoint=dfx.RecursiveCheckpointAdjoint() if adjoint is None else adjoint,
        max_steps=256,
    )
    ys: Any = solution.ys
    return ys.y[0, 0]


G = jnp.asarray(9.81)


def test_events_in_time_that_runs_backward_are_refused() -> None:
    with pytest.raises(RuntimeError, match="EventSolver runs forward in time, but t1 < t0: count time the other way"):
        bounced(G, 1.0, 0.0)
    run = eqx.filter_jit(bounced)
    assert run(G, 0.0, 1.0) > 0
    with pytest.raises(RuntimeError, match="EventSolver runs forward in time, but t1 < t0"):
        run(G, jnp.asarray(1.0), jnp.asarray(0.0))
    # A run of no length runs in no direction.
    assert bounced(G, 1.0, 1.0) == run(G, jnp.asarray(1.0), jnp.asarray(1.0)) == 1.0


def test_events_under_backsolve_are_refused() -> None:
    for transform in (jax.grad, lambda fn: jax.jit(jax.grad(fn))):
        with pytest.raises(ValueError, match=r"diffrax.BacksolveAdjoint does not pass events: leave the adjoint out"):
            transform(lambda g: bounced(g, adjoint=dfx.BacksolveAdjoint()))(G)


SPRING = Scene(
    lambda t, q, qd, p: 0.5 * qd[0] ** 2 - 0.5 * p["k"] * q[0] ** 2,
    params={"k": 4.0},
    effects=(Friction(Regularized(Coulomb(Fc=0.1), 0.5)),),
)
BRAKED = Scene(SPRING.lagrangian, params={"k": 4.0}, effects=(Friction(Coulomb(Fc=0.1)),))


@pytest.mark.quick
@pytest.mark.parametrize("scene", [SPRING, BRAKED], ids=["smooth", "events"])
def test_simulate_refuses_backsolve(scene: Scene) -> None:
    with pytest.raises(ValueError, match=r"simulate cannot use diffrax.BacksolveAdjoint, .*Leave adjoint out"):
        simulate(scene, [1.0], [0.0], 1.0, adjoint=dfx.BacksolveAdjoint())


@pytest.mark.parametrize("scene", [SPRING, BRAKED], ids=["smooth", "events"])
def test_simulate_takes_the_other_adjoints(scene: Scene) -> None:
    def end(k: Any, adjoint: Any, rtol: Any = 1e-6) -> Any:
        changed = eqx.tree_at(lambda s: s.params["k"], scene, k)
        options: dict[str, Any] = {"rtol": rtol, "atol": 1e-2 * rtol, "max_steps": 256}
        place = simulate(changed, [1.0], [0.0], 2.0, adjoint=adjoint, throw=False, **options).q[-1, 0]
        return place, place

    def slope(mode: Any, adjoint: Any, rtol: float) -> Any:
        return jax.jit(lambda: mode(end, has_aux=True)(k, adjoint, rtol)[0])()

    k = jnp.asarray(4.0)
    ahead = jax.jit(jax.jacfwd(lambda k, rtol: end(k, dfx.ForwardMode(), rtol), has_aux=True))
    forward, _ = ahead(k, 1e-6)
    # Steps of another size make another error, here of 1e-10 over a difference of 0.02.
    differences = central_difference(lambda x: ahead(jnp.asarray(x), 1e-10)[1], 4.0, 2e-2)
    np.testing.assert_allclose(forward, differences, rtol=1e-4)
    # With fewer checkpoints than steps some are made again, and their error estimate with another rounding: the steps
    # differ a little, the more the tighter the tolerance.
    for adjoint in (dfx.RecursiveCheckpointAdjoint(), dfx.DirectAdjoint()):
        np.testing.assert_allclose(slope(jax.grad, adjoint, 1e-6), forward, rtol=1e-5)
    tight, _ = ahead(k, 1e-9)
    for mode, every in ((jax.grad, 1), (jax.grad, 5), (jax.jacfwd, 1)):
        np.testing.assert_allclose(slope(mode, StoredSteps(every, probe=False), 1e-9), tight, rtol=1e-11)


def test_derivatives_of_a_resting_place_are_exact_to_rounding() -> None:
    """x'' + x in -[-1, 1] from (12, 6): half circles about +-1, the first of radius sqrt(13^2 + 6^2), to a rest.

    The place is +-(sqrt(205) - 2 n + 1), so its derivatives are -13/sqrt(205) and -6/sqrt(205); the run errs by 1e-14.
    A derivative of steps that are made again is off by 1e-5.
    """
    scene = Scene(SPRING.lagrangian, params={"k": 1.0}, effects=(Friction(Coulomb(Fc=1.0)),))

    def rest(x: Any, rtol: Any) -> Any:
        return simulate(scene, x[:1], x[1:], 30.0, rtol=rtol, atol=1e-2 * rtol, throw=False).q[-1, 0]

    exact = np.array([-13.0, -6.0]) / np.sqrt(205.0)
    for mode in (jax.grad, jax.jacfwd):
        slope = jax.jit(mode(rest))
        for rtol, admissible in ((1e-9, 1e-10), (1e-11, 1e-12)):
            np.testing.assert_allclose(slope(jnp.array([12.0, 6.0]), rtol), exact, rtol=admissible)


@pytest.mark.parametrize("solver", [dfx.Tsit5(), Rodas5P()])
def test_derivatives_by_a_start_that_is_almost_at_rest(solver: dfx.AbstractSolver) -> None:
    m, k, c, t1 = 1.3, 4.0, 0.3, 3.7
    scene = Scene(lambda t, q, qd, p: 0.5 * m * qd[0] ** 2 - 0.5 * k * q[0] ** 2, {}, (Friction(Viscous(c)),))

    @jax.jit
    def slopes(x: jax.Array) -> jax.Array:
        def end(x: jax.Array) -> jax.Array:
            run = simulate(scene, x[:1], x[1:], t1, solver=solver)
            return jnp.concatenate([run.q[-1], run.qd[-1]])

        return jax.jacfwd(end)(x)

    exact = jax.scipy.linalg.expm(t1 * jnp.array([[0.0, 1.0], [-k / m, -c / m]]))
    for size in (1e-18, 1e-14, 1e-10, 1e-6, 1e-3):
        assert np.abs(slopes(size * jnp.array([1.0, 0.1])) - exact).max() < 5e-6


def test_second_derivatives_through_events() -> None:
    """Place of rest of a braked spring by its stiffness, twice: (-1)^n (x0 - 2 n Fc/k).

    The times of the steps count as constants in both derivatives, so the second has an error of the method. An explicit
    one: its derivatives are compiled soonest.
    """

    def rest(k: Any, adjoint: Any = None) -> Any:
        scene = Scene(SPRING.lagrangian, params={"k": k}, effects=(Friction(Coulomb(Fc=0.1)),))
        return simulate(scene, [1.0], [0.0], 15.0, rtol=1e-9, adjoint=adjoint, solver=dfx.Tsit5()).q[-1, 0]

    k = 0.7
    n = float(np.ceil((1.0 - 0.1 / k) / (2 * 0.1 / k)))
    sign = (-1.0) ** n
    np.testing.assert_allclose(rest(k), sign * (1.0 - 2 * n * 0.1 / k), rtol=1e-8)
    second = jax.jit(jax.hessian(rest))(k)
    ahead = jax.jit(jax.jacfwd(jax.jacfwd(lambda k: rest(k, dfx.ForwardMode()))))(k)
    np.testing.assert_allclose(second, ahead, rtol=1e-9)
    np.testing.assert_allclose(second, -sign * 4 * n * 0.1 / k**3, rtol=1e-5)


def test_simulate_looks_at_no_direction_of_time_in_the_run() -> None:
    """It checks the times itself: a look in the run would call back to Python, and keep the run out of JAX's cache."""
    run = lambda t1: simulate(BRAKED, [1.0], [0.0], t1, throw=False).q  # noqa: E731
    assert "forward in time" not in str(jax.make_jaxpr(run)(1.0))
    plain = jax.make_jaxpr(lambda t1: bounced(G, 0.0, t1))(1.0)
    assert "callback" in str(plain)
