"""Laws with a state of their own: closed forms, limits, slip in the plane, and parameters that vary."""

from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.interpolate import CubicHermiteSpline

import jaxmodsim as jms
from jaxmodsim.friction import AbstractDynamicLaw, ArmstrongState
from jaxmodsim.identify import law_force

from ..helpers.differences import central_difference, gradient_by_differences


def mass(t: Any, q: Any, qd: Any, p: Any) -> Any:
    """A mass that moves freely, in as many coordinates as there are."""
    del t, q
    return 0.5 * p["m"] * jnp.sum(qd**2)


def pulled(t: Any, q: Any, qd: Any, p: Any) -> Any:
    """A mass pulled through a spring at constant speed."""
    return 0.5 * p["m"] * qd[0] ** 2 - 0.5 * p["k"] * (q[0] - p["v"] * t) ** 2


def cycled(law: Any, amplitude: float, cycles: int = 3, samples: int = 8000) -> tuple[np.ndarray, np.ndarray]:
    """Displacement and force of a law cycled between +-amplitude, the last cycle."""
    phase = np.linspace(0.0, 2 * np.pi * cycles, samples * cycles + 1)
    x = amplitude * np.sin(phase)
    force = np.asarray(law_force(law, jnp.asarray(phase), jnp.asarray(x)))
    return x[-samples - 1 :], force[-samples - 1 :]


def loss(x: np.ndarray, force: np.ndarray) -> float:
    """Work [J] of a force that is constant from sample to sample, taken at their middle."""
    return float(np.sum(0.5 * (force[1:] + force[:-1]) * np.diff(x)))


@pytest.mark.parametrize("amplitude", [3e-4, 2e-3, 2e-2])
def test_dahl_cycled_has_the_force_and_the_loss_of_its_closed_form(amplitude: float) -> None:
    sigma0, fc = 750.0, 1.5
    # As many cycles as the start takes to be forgotten.
    x, force = cycled(jms.Dahl(sigma0, fc), amplitude, cycles=30)
    turn = fc * np.tanh(sigma0 * amplitude / fc)
    np.testing.assert_allclose(force.max(), turn, rtol=1e-5)
    np.testing.assert_allclose(force.min(), -turn, rtol=1e-5)
    np.testing.assert_allclose(loss(x, force), 4 * (fc * amplitude - fc / sigma0 * turn), rtol=1e-5)


def test_one_maxwell_element_is_a_spring_in_series_with_coulomb_friction() -> None:
    """Loss per cycle 4 Fc (A - Fc/k), less `corner^2 Fc^2/k`: at either end a decay cuts a triangle off the corner."""
    k, fc, amplitude, corner = 750.0, 1.5, 6e-3, 0.04
    ideal = 4 * fc * (amplitude - fc / k)
    cut = loss(*cycled(jms.MaxwellSlip(k, fc, corner=corner), amplitude))
    np.testing.assert_allclose(ideal - cut, corner**2 * fc**2 / k, rtol=1e-3)
    np.testing.assert_allclose(loss(*cycled(jms.MaxwellSlip(k, fc, corner=1e-9), amplitude)), ideal, rtol=1e-6)


def test_one_stiff_maxwell_element_is_coulomb_friction() -> None:
    """A mass on a spring that comes to rest, against the exact run; the error falls with the stiffness."""

    def rest(law: Any) -> float:
        scene = jms.Scene(pulled, params={"m": 1.0, "k": 100.0, "v": 0.0}, effects=(jms.Friction(law),))
        return float(jms.simulate(scene, [0.1], [0.0], 0.9, rtol=1e-9, atol=1e-12).q[-1, 0])

    exact = rest(jms.Coulomb(1.5))
    errors = [abs(rest(jms.MaxwellSlip(k, 1.5)) - exact) for k in (1e4, 1e6)]
    # In proportion to the square root of the compliance.
    np.testing.assert_allclose(errors[0] / errors[1], 10.0, rtol=0.15)


def test_maxwell_elements_remember_where_they_turned() -> None:
    """Non-local memory: a loop within the loop closes, and the outer loop goes on as if it had not been."""
    law = jms.MaxwellSlip(k=[500.0, 300.0, 100.0], Fc=[0.2, 0.5, 0.8], corner=1e-6)
    x = np.concatenate(
        [np.linspace(a, b, 400, endpoint=False) for a, b in [(0, 5e-3), (5e-3, 1e-3), (1e-3, 3e-3), (3e-3, 1e-3)]]
        + [np.linspace(1e-3, -2e-3, 400)]
    )
    inner = np.asarray(law_force(law, jnp.arange(len(x)) * 1.0, jnp.asarray(x)))
    plain = np.concatenate([x[:800], x[1600:]])
    outer = np.asarray(law_force(law, jnp.arange(len(plain)) * 1.0, jnp.asarray(plain)))
    np.testing.assert_allclose(inner[1600], inner[800], atol=1e-6)
    np.testing.assert_allclose(inner[1600:], outer[800:], atol=1e-6)
    # Which a law with one state cannot.
    dahl = np.asarray(law_force(jms.Dahl(900.0, 1.5), jnp.arange(len(x)) * 1.0, jnp.asarray(x)))
    assert abs(dahl[1600] - dahl[800]) > 0.02


def test_armstrong_stiction_comes_back_as_published() -> None:
    """By t/(t + gamma) from nothing, in steps of any length, and in the differential equation; and is kept in slip."""
    law = jms.Armstrong(sigma0=1e8, Fc=1.0, Fs=1.5, vs=1e-3, Fv=0.1, tau=0.01, gamma=0.7)
    z, zero = ArmstrongState(*(jnp.array(0.0),) * 4), jnp.array(0.0)
    for dt in (1e-3, 0.7, 1e4):
        np.testing.assert_allclose(law.step_exact(zero, z, jnp.array(dt)).rise, dt / (dt + 0.7), atol=1e-15)
    half = law.step_exact(zero, law.step_exact(zero, z, jnp.array(0.3)), jnp.array(0.4))
    np.testing.assert_allclose(half.rise, 0.5, rtol=1e-14)
    slope = law.zdot(zero, z._replace(rise=jnp.array(0.4))).rise
    np.testing.assert_allclose(slope, 0.6**2 / 0.7, rtol=1e-14)
    # A step that begins in stick and ends in slip: in slip the magnitude stays what the rest made it.
    at_once = law.step_exact(jnp.array(5e-3), law.initial_state(zero), jnp.array(2.0))
    np.testing.assert_allclose(law.force(jnp.array(5e-3), at_once), 1.0 + 0.5 / 26.0 + 0.1 * 5e-3, rtol=1e-4)
    # After a rest of gamma half of the stiction is there, and no more comes back in slow slip.
    rested = law.step_exact(zero, z, jnp.array(0.7))
    for dt in (0.1, 1e3):
        slow = law.step_exact(jnp.array(1e-5), rested, jnp.array(dt))
        np.testing.assert_allclose(law.force(jnp.array(1e-5), slow), 1.25, rtol=1e-3)


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_a_short_exact_step_of_armstrong_has_the_rates_of_its_equations(side: float) -> None:
    """Below and beyond the limit, which falls while the contact begins to slip, and after a reversal."""
    law = jms.Armstrong(sigma0=1e4, Fc=1.0, Fs=1.5, vs=0.05, Fv=0.1, tau=0.01, gamma=1.0)
    values = ([-0.5, 0.3, 0.995, 1.1], [0.0, 0.5], [1e-4, 0.02])
    u, share, speed = (x.ravel() for x in jnp.meshgrid(*map(jnp.array, values)))
    rise = jnp.full_like(u, 0.4)
    z = ArmstrongState(side * u * 1.2e-4, rise, 0.7 * jnp.ones_like(u), share * 2e-6)
    dt = 1e-11 / speed
    after = jax.vmap(law.step_exact)(side * speed, z, dt)
    scales = (speed, 100.0, 100.0, speed)
    for rate, x0, x1, scale in zip(jax.vmap(law.zdot)(side * speed, z), z, after, scales, strict=True):
        np.testing.assert_allclose((x1 - x0) / dt / scale, rate / scale, atol=1e-3)


def test_armstrong_friction_lags_by_its_time_constant() -> None:
    """A step of the velocity in slip: the Stribeck friction follows with exp(-t/tau)."""
    law = jms.Armstrong(sigma0=1e6, Fc=1.0, Fs=1.5, vs=1e-2, Fv=0.0, tau=0.02, gamma=1.0)
    t = jnp.linspace(0.0, 0.1, 2001)
    slow, fast = 5e-3, 4e-2
    settled = law.step_exact(jnp.array(slow), law.initial_state(jnp.array(0.0)), jnp.array(1e3))
    force = jax.vmap(lambda t: law.force(jnp.array(fast), law.step_exact(jnp.array(fast), settled, t)))(t)
    levels = [1.0 + 0.5 / (1 + (v / 1e-2) ** 2) for v in (slow, fast)]
    np.testing.assert_allclose(force, levels[1] + (levels[0] - levels[1]) * np.exp(-t / 0.02), rtol=2e-3)


@pytest.mark.parametrize(
    ("at", "varied"),
    [
        ({"m": 2.0, "k": 30.0, "belt": 0.13, "q0": 0.0, "qd0": 0.05, "Fs": 1.75, "tau": 0.05}, ("Fs", "tau", "k")),
        # A slip ends after 0.42 s: the magnitude, which has not moved in it, begins to follow the rise.
        (
            {"m": 0.543, "k": 31.93, "belt": 0.102, "q0": 0.303, "qd0": 0.0, "Fs": 1.75, "tau": 0.05},
            ("m", "k", "belt", "q0"),
        ),
    ],
    ids=["yields", "slip ends"],
)
def test_derivatives_of_armstrong_on_a_belt(at: dict[str, float], varied: tuple[str, ...]) -> None:
    """Against differences of tight runs: states whose derivatives are zero, or small, up to a kink."""

    def end(x: Any, rtol: Any, atol: Any) -> Any:
        n = at | dict(zip(varied, x, strict=True))
        law = jms.Armstrong(sigma0=750.0, Fc=1.5, Fs=n["Fs"], vs=0.2, Fv=0.1, tau=n["tau"], gamma=2.0)
        params = {"m": n["m"], "k": n["k"], "v": 0.0}
        scene = jms.Scene(pulled, params, (jms.Friction(law, belt_velocity=n["belt"]),))
        start = jnp.asarray([n["q0"]]), jnp.asarray([n["qd0"]])
        return jms.simulate(scene, *start, 1.0, rtol=rtol, atol=atol).q[-1, 0]

    x, run = jnp.array([at[name] for name in varied]), jax.jit(end)
    wanted = gradient_by_differences(lambda x: run(x, 1e-11, 1e-13), x, 1e-3)
    np.testing.assert_allclose(jax.jit(jax.grad(end))(x, 1e-6, 1e-9), wanted, rtol=1e-4)


def test_armstrong_in_single_precision() -> None:
    """The contact yields within 4e-5 m: float32 resolves that, also far from the start of time."""

    def end(kind: Any, t0: float) -> Any:
        number = lambda x: jnp.asarray(x, kind)  # noqa: E731
        law = jms.Armstrong(*map(number, (750.0, 1.5, 1.75, 0.2, 0.1, 0.05, 2.0)))
        params = {"m": number(0.543), "k": number(31.93), "v": number(0.0)}
        scene = jms.Scene(pulled, params, (jms.Friction(law, belt_velocity=number(0.102)),))
        run = jms.simulate(scene, number([0.303]), number([0.0]), number(t0 + 3.0), t0=number(t0), rtol=1e-5)
        assert run.q.dtype == kind
        return run.q[-1, 0]

    for t0 in (0.0, 10.0):
        np.testing.assert_allclose(end(jnp.float32, t0), end(jnp.float64, t0), rtol=1e-3)


def test_the_limit_cycle_of_the_1995_set() -> None:
    """Its period from upward crossings: converged to 1e-6, and a second, explicit solver agrees on it."""
    law = jms.LuGre(sigma0=1e5, sigma1=np.sqrt(1e5), sigma2=0.4, Fc=1.0, Fs=1.5, vs=1e-3)
    scene = jms.Scene(pulled, params={"m": 1.0, "k": 2.0, "v": 0.1}, effects=(jms.Friction(law),))
    ts = np.linspace(0.0, 30.0, 30001)

    def period(solver: dfx.AbstractSolver | None, rtol: float) -> float:
        run = jms.simulate(
            scene, [0.0], [0.0], 30.0, ts=ts, rtol=rtol, atol=1e-3 * rtol, solver=solver, max_steps=2 * 10**6
        )
        q, v, z = (np.asarray(x) for x in (run.q[:, 0], run.qd[:, 0], run.z["friction"]))
        friction = np.asarray(jax.vmap(law.force)(run.qd[:, 0], run.z["friction"]))
        rate = 2.0 * (0.1 * ts - q) - friction
        up = np.flatnonzero((v[:-1] < 0.05) & (v[1:] >= 0.05))
        times = []
        for i in up[-3:]:
            piece = CubicHermiteSpline(ts[i : i + 2], v[i : i + 2], rate[i : i + 2])
            times.append(float(piece.solve(0.05, extrapolate=False)[0]))
        np.testing.assert_allclose(times[2] - times[1], times[1] - times[0], rtol=1e-6)
        assert np.abs(z).max() <= 1.5e-5
        return times[2] - times[1]

    periods = [period(None, rtol) for rtol in (1e-8, 1e-10)]
    np.testing.assert_allclose(periods[0], periods[1], rtol=1e-6)
    np.testing.assert_allclose(period(dfx.Tsit5(), 1e-8), periods[1], rtol=1e-6)


LOADS = jms.AppliedForce(lambda t, q, qd, p: jnp.reshape(0.4 + 0.2 * jnp.sin(10 * jnp.pi * t), (1,)))


def test_elasto_plastic_stays_where_lugre_creeps() -> None:
    """A load below break-away with a vibration on it, 1995 set."""
    numbers = {"sigma0": 1e5, "sigma1": np.sqrt(1e5), "sigma2": 0.4, "Fc": 1.0, "Fs": 1.5, "vs": 1e-3}

    def drift(law: Any) -> float:
        scene = jms.Scene(mass, params={"m": 1.0}, effects=(LOADS, jms.Friction(law)))
        ts = [2.0, 10.0]
        x = jms.simulate(scene, [0.0], [0.0], 10.0, ts=ts, rtol=1e-8, atol=1e-14).q[:, 0]
        return float(x[1] - x[0])

    elastic = 0.6 / 1e5
    assert drift(jms.LuGre(**numbers)) > 2 * elastic
    assert abs(drift(jms.ElastoPlastic(**numbers, Fba=0.7))) < 1e-9


PLANAR = {"dahl": jms.Dahl(750.0, 1.5), "lugre": jms.LuGre(750.0, 12.0, 2.1, 1.5, 1.75, 0.2)}


@pytest.mark.parametrize("name", PLANAR)
def test_slip_in_the_plane_along_a_line_is_slip_on_it(name: str) -> None:
    """And turning everything turns the force."""
    law = PLANAR[name]
    assert isinstance(law, AbstractDynamicLaw)
    line, other = jnp.array([0.6, -0.8]), jnp.array([1.0, 0.0])
    for v, z, dt in ((0.05, 1e-3, 0.01), (0.4, -5e-4, 0.2)):
        v, z, dt = jnp.array(v), jnp.array(z), jnp.array(dt)
        for direction in (line, other):
            np.testing.assert_allclose(law.zdot(v * direction, z * direction), law.zdot(v, z) * direction, rtol=1e-14)
            np.testing.assert_allclose(law.force(v * direction, z * direction), law.force(v, z) * direction, rtol=1e-14)
            step = law.step_exact(v * direction, z * direction, dt)
            np.testing.assert_allclose(step, law.step_exact(v, z, dt) * direction, rtol=1e-14)
        np.testing.assert_allclose(law.stored_energy(z * line), law.stored_energy(z), rtol=1e-14)


def disc(law: Any, **friction: Any) -> jms.Scene:
    """A mass on a table, thrown across it."""
    return jms.Scene(mass, params={"m": 1.3}, effects=(jms.Friction(law, along=lambda q: q, **friction),))


def test_planar_friction_couples_its_components_and_closes_the_energy_balance() -> None:
    ts = jnp.linspace(0.0, 0.5, 51)
    run = jms.simulate(disc(PLANAR["lugre"]), [0.0, 0.0], [1.0, 0.2], 0.5, ts=ts, rtol=1e-9, atol=1e-12)
    assert run.forces["friction"].shape == (51, 2)
    assert run.z["friction"].shape == (51, 2)
    np.testing.assert_allclose(run.energy.balance, 0.0, atol=1e-8)
    # In slip the force opposes the velocity as a vector, so the path is a straight line.
    np.testing.assert_allclose(run.q[1:40, 1] / run.q[1:40, 0], 0.2, rtol=1e-3)


def test_an_ellipse_of_friction_dissipates_as_much_as_it_can() -> None:
    """Coulomb force `-M^2 v Fc/|M v|` with M = diag(1, ratio): on the ellipse, its normal along the slip."""
    ratio, fc = 0.6, 1.5

    def check(v: Any, force: Any) -> None:
        expected = fc * v * [1.0, ratio**2] / np.linalg.norm(v * [1.0, ratio])
        np.testing.assert_allclose(force, expected, rtol=1e-4)
        np.testing.assert_allclose((force[0] / fc) ** 2 + (force[1] / (ratio * fc)) ** 2, 1.0, rtol=1e-4)

    t, q, v = jnp.array(0.0), jnp.zeros(2), jnp.array([1.0, -0.7])
    smooth = jms.Friction(jms.Regularized(jms.Coulomb(fc), 1e-4), along=lambda q: q, ellipse=ratio)
    action = smooth.act(t, q, v, None, {})
    check(np.asarray(v), np.asarray(action.force))
    np.testing.assert_allclose(action.generalised, -action.force)
    run = jms.simulate(disc(jms.Dahl(1e5, fc), ellipse=ratio), [0.0, 0.0], v, 0.2, rtol=1e-9, atol=1e-12)
    check(np.asarray(run.qd[-1]), np.asarray(run.forces["friction"][-1]))


@pytest.mark.parametrize(
    ("law", "friction", "text"),
    [
        (
            jms.ElastoPlastic(1e3, 0.0, 0.0, 0.5, 1.0, 1.0, 0.1),
            {},
            "Needed is a law that is the same in all directions: Coulomb",
        ),
        (jms.asymmetric(jms.Viscous(1.0), Fv=2.0), {}, "the same in all directions"),
        (jms.Viscous(1.0), {"along": lambda q: q[0], "ellipse": 0.5}, r"ellipse needs slip .* has the shape \(\)"),
        (
            jms.scaled_by(jms.Viscous(1.0), lambda t, q, qd, p: q),
            {"along": lambda q: q[0]},
            r"fn\(t, q, qd, params\) ret",
        ),
    ],
)
def test_what_cannot_slide_in_the_plane_is_refused(law: Any, friction: dict[str, Any], text: str) -> None:
    given: dict[str, Any] = {"along": lambda q: q, **friction}
    scene = jms.Scene(mass, params={"m": 1.0}, effects=(jms.Friction(law, **given),))
    with pytest.raises(ValueError, match=text):
        jms.simulate(scene, [0.0, 0.0], [1.0, 0.0], 1.0)


def test_an_ellipse_out_of_range_is_refused() -> None:
    with pytest.raises(ValueError, match="ellipse must be finite and > 0"):
        jms.Friction(jms.Viscous(1.0), ellipse=0.0)


def rail(t: Any, q: Any, qd: Any, p: Any) -> Any:
    """Periodic along the way, and weaker when warm."""
    del t, qd
    return (1.0 + 0.3 * jnp.sin(q[0] / 0.05)) * p["cold"]


PARAMS = {"m": 2.0, "cold": 0.8, "k": 60.0, "v": 0.05}


def ends(scene: jms.Scene) -> Any:
    return jms.simulate(scene, [0.0], [0.0], 2.0, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("law", [jms.Coulomb(1.5, 1.75), PLANAR["lugre"]], ids=["exact", "bristle"])
def test_a_scaled_law_is_the_law_under_a_load(law: Any) -> None:
    """Factor and load multiply the force alike, stick and slip included."""
    by_law = jms.Scene(pulled, params=PARAMS, effects=(jms.Friction(jms.scaled_by(law, rail)),))
    by_load = jms.Scene(pulled, params=PARAMS, effects=(jms.Friction(law, normal_force=rail),))
    np.testing.assert_allclose(ends(by_law).q, ends(by_load).q, rtol=1e-9)


def test_what_scales_a_law_has_its_gradient() -> None:
    law = jms.scaled_by(jms.Regularized(jms.Coulomb(1.5), 1e-2), rail)
    scene = jms.Scene(pulled, params=PARAMS, effects=(jms.Friction(law),))

    def end(cold: Any) -> Any:
        return ends(eqx.tree_at(lambda s: s.params["cold"], scene, cold)).q[-1, 0]

    cold = jnp.array(0.8)
    slope = jax.jit(jax.grad(end))(cold)
    assert abs(slope) > 1e-3
    # The run is right to about 1e-9 of 0.1 m, so the step of 1e-3 leaves 1e-7.
    np.testing.assert_allclose(slope, central_difference(lambda x: end(jnp.asarray(x)), 0.8, 1e-3), rtol=1e-5)


def test_a_plain_function_is_a_law() -> None:
    scene = jms.Scene(mass, params={"m": 2.0}, effects=(jms.Friction(lambda v: 0.5 * v),))
    run = jms.simulate(scene, [0.0], [3.0], 4.0, rtol=1e-9)
    np.testing.assert_allclose(run.qd[-1, 0], 3.0 * np.exp(-1.0), rtol=1e-8)
    with pytest.raises(ValueError, match="must return one number"):
        jms.simulate(jms.Scene(mass, params={"m": 2.0}, effects=(jms.Friction(lambda v: v[None]),)), [0.0], [1.0], 1.0)


def test_a_stribeck_curve_that_is_steep_at_rest_runs_exactly() -> None:
    """With an exponent below one the slope at rest has no bound; a loaded mass must not freeze there."""
    law = jms.Stribeck(1.0, 1.5, 0.1, exponent=0.5)
    exact, near = (
        ends(jms.Scene(pulled, params=PARAMS, effects=(jms.Friction(each),)))
        for each in (law, jms.Regularized(law, 1e-7))
    )
    assert exact.stats["num_events"] > 0
    # In stick the smooth law creeps by up to its width a second, and does not slip off at the same instant.
    np.testing.assert_allclose(exact.q, near.q, atol=3e-6)
