"""What is said of a law before it runs: passivity, damping, width and the largest explicit step."""

import math
from typing import Any, ClassVar

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxmodsim as jms
from jaxmodsim import asymmetric, check_passivity, damping_sigma1, max_stable_step, regularized_width, scaled_by
from jaxmodsim.friction import AbstractDynamicLaw, AbstractForceLaw
from jaxmodsim.scene import State, vector_field

# Canudas de Wit, Olsson, Astrom, Lischinsky 1995, and the box on the table.
SET_1995 = {"sigma0": 1e5, "sigma1": math.sqrt(1e5), "sigma2": 0.4, "Fc": 1.0, "Fs": 1.5, "vs": 1e-3}
BOX = {"sigma0": 750.0, "sigma1": 12.0, "sigma2": 2.0, "Fc": 1.5, "Fs": 1.75, "vs": 0.2}
STRIBECK = jms.Stribeck(Fc=1.5, Fs=1.75, vs=0.2, Fv=0.1)
ELASTO_PLASTIC = jms.ElastoPlastic(**{**BOX, "sigma2": 1.0}, Fba=1.0)
ELEMENTS = {"k": [10.0, 20.0], "Fc": [1.0, 2.0], "Fs": [1.5, 2.5], "vs": 0.1}
RK4 = dfx.ButcherTableau(
    c=np.array([0.5, 0.5, 1.0]),
    b_sol=np.array([1.0, 2.0, 2.0, 1.0]) / 6.0,
    b_error=np.zeros(4),
    a_lower=(np.array([0.5]), np.array([0.0, 0.5]), np.array([0.0, 0.0, 1.0])),
)

BRISTLES: dict[str, Any] = {
    "lugre 1995": jms.LuGre(**SET_1995),
    "lugre 1995, vd = vs": jms.LuGre(**SET_1995, vd=1e-3),
    "lugre 1995, vd = 30 vs": jms.LuGre(**SET_1995, vd=0.03),
    "lugre 1995, vd = 1000 vs": jms.LuGre(**SET_1995, vd=1.0),
    "lugre at the limit": jms.LuGre(**BOX),
    "lugre without damping": jms.LuGre(**{**BOX, "sigma1": 0.0}),
    "elasto-plastic": ELASTO_PLASTIC,
    "dahl": jms.Dahl(750.0, 1.5),
    "maxwell slip": jms.MaxwellSlip(**ELEMENTS, sigma2=0.3),
    "maxwell slip with attraction": jms.MaxwellSlip(**ELEMENTS, C=3.0),
    "armstrong": jms.Armstrong(1e4, 1.0, 1.5, 0.01, 0.2, 0.1, 1.0),
    "lugre asymmetric": asymmetric(jms.LuGre(**BOX), Fs=2.0),
    "dahl asymmetric": asymmetric(jms.Dahl(750.0, 1.5), Fc=2.0),
}


class Unknown(AbstractDynamicLaw):
    """A law that the package knows nothing of."""

    inner: AbstractDynamicLaw
    stiff: ClassVar[bool] = True

    def initial_state(self, v: Any) -> Any:
        return self.inner.initial_state(v)

    def zdot(self, v: Any, z: Any) -> Any:
        return self.inner.zdot(v, z)

    def force_given_zdot(self, v: Any, z: Any, rate: Any) -> Any:
        return self.inner.force_given_zdot(v, z, rate)

    def stored_energy(self, z: Any) -> Any:
        return self.inner.stored_energy(z)

    def step_exact(self, v: Any, z: Any, dt: Any) -> Any:
        return self.inner.step_exact(v, z, dt)


@pytest.mark.parametrize("name", BRISTLES)
def test_conditions_agree_with_the_dissipation_at_sampled_states(name: str) -> None:
    known, sampled = check_passivity(BRISTLES[name]), check_passivity(Unknown(BRISTLES[name]))
    assert bool(known) == known.ok == sampled.ok
    assert known.ok == (known.margin >= 0) == math.isinf(known.speed)
    # Samples are never worse than the bound, and near it at the highest speed, where 1/v is left of the dry part.
    # At the slowest speeds rounding of the powers is 1e-5 of a viscous one.
    assert (
        known.margin - 1e-5 * abs(known.margin) <= sampled.margin <= known.margin + 4e-3 * max(1.0, abs(known.margin))
    )
    if not known:
        assert known.speed <= sampled.speed <= 1.2 * known.speed


@pytest.mark.quick
def test_lugre_by_its_published_condition() -> None:
    found = check_passivity(BRISTLES["lugre 1995"])
    assert not found
    np.testing.assert_allclose(SET_1995["sigma2"] - found.margin, 0.5 * math.sqrt(1e5), rtol=1e-12)
    assert "0.4 against 158.114 N s/m" in str(found)
    assert check_passivity(BRISTLES["lugre at the limit"]).margin == 0.0
    assert not check_passivity(jms.LuGre(**{**BOX, "sigma2": 1.999}))
    # Fading with vs is passive: the bristle falls back before the speed is high.
    assert check_passivity(BRISTLES["lugre 1995, vd = vs"]).margin == SET_1995["sigma2"]


@pytest.mark.parametrize("vd", [0.03, 1.0])
def test_fading_damping_needs_what_a_search_over_all_states_finds(vd: float) -> None:
    law = jms.LuGre(**SET_1995, vd=vd)
    v, z = jnp.geomspace(1e-4, 1e3, 2001), jnp.linspace(0.0, 1.0, 1001) * law.Fs / law.sigma0

    def index(v: jax.Array, z: jax.Array) -> jax.Array:
        return (v * law.force(v, z) - jax.grad(law.stored_energy)(z) * law.zdot(v, z)) / (v * v)

    least = float(jnp.min(jax.vmap(jax.vmap(index, (None, 0)), (0, None))(v, z)))
    np.testing.assert_allclose(check_passivity(law).margin, least, rtol=1e-4)


def test_a_jerk_after_slow_loading_draws_energy_where_the_condition_fails() -> None:
    """The work done on a law from its unloaded state is never negative if it is passive, and else it can be."""

    @jax.jit
    def push(law: jms.LuGre, z: jax.Array, v: jax.Array, length: jax.Array) -> tuple[jax.Array, jax.Array]:
        """State after the slip `length` at v, and the work for it."""
        dt = length / v / 2000

        def step(z: jax.Array, _: None) -> tuple[jax.Array, jax.Array]:
            after = law.step_exact(v, z, dt)
            return after, 0.5 * v * dt * (law.force(v, z) + law.force(v, after))

        z, works = jax.lax.scan(step, z, None, 2000)
        return z, jnp.sum(works)

    def work(law: jms.LuGre, jerk: float) -> float:
        z, loading = push(law, jnp.zeros(()), 1e-3 * law.vs, 8.0 * law.Fs / law.sigma0)
        return float(loading + push(law, z, jnp.asarray(jerk), 0.5 * law.Fc / law.sigma0)[1])

    failing = jms.LuGre(**{**BOX, "sigma2": 0.5})
    jerks = [work(failing, jerk) for jerk in (1e3, 1e4)]
    assert jerks[1] < 0
    # In proportion to the speed: no energy stored at the beginning accounts for it.
    np.testing.assert_allclose(jerks[1] / jerks[0], 10.0, rtol=0.1)
    assert all(work(jms.LuGre(**BOX), jerk) > 0 for jerk in (1e3, 1e4))


@pytest.mark.parametrize(
    ("law", "ok", "margin"),
    [
        (jms.Viscous(0.4), True, 0.4),
        (jms.Coulomb(1.5, 2.0), True, 0.0),
        (STRIBECK, True, 0.1),
        (jms.Regularized(STRIBECK, 1e-3), True, 0.1),
        (jms.Sign(STRIBECK), True, 0.1),
        (asymmetric(jms.Viscous(0.4), Fv=0.2), True, 0.2),
        (asymmetric(STRIBECK, Fv=0.05), True, 0.05),
        (jms.DeadZone(STRIBECK, 1e-3), False, -math.inf),
        (jms.Curve(lambda v: v**3 + 0.1 * v), True, 0.1),
        (jms.Curve(lambda v: v * (v * v - 0.2 * jnp.abs(v) + 0.005)), False, -0.005),
    ],
)
def test_functions_of_velocity(law: Any, ok: bool, margin: float) -> None:
    found = check_passivity(law)
    assert found.ok == ok
    np.testing.assert_allclose(found.margin, margin, rtol=1e-9, atol=1e-15)


def test_the_speed_from_which_a_curve_gives_energy() -> None:
    """F/v = v^2 - 0.2 |v| + 0.005 is negative between 0.1 -+ sqrt(0.005)."""
    found = check_passivity(jms.Curve(lambda v: v * (v * v - 0.2 * jnp.abs(v) + 0.005)))
    np.testing.assert_allclose(found.speed, 0.1 - math.sqrt(0.005), rtol=1e-6)
    assert "0.1 m/s" in found.condition


def test_in_single_precision() -> None:
    law = jax.tree.map(lambda x: x.astype(jnp.float32), jms.LuGre(**BOX))
    assert check_passivity(law)
    assert check_passivity(jax.tree.map(lambda x: x.astype(jnp.float32), STRIBECK))


def test_damping_in_stick_has_the_ratio_asked_for() -> None:
    m, ratio, sigma2 = 3.0, 0.35, 5.0
    law = jms.LuGre(**{**BOX, "sigma1": damping_sigma1(m, BOX["sigma0"], ratio, sigma2), "sigma2": sigma2})
    scene = jms.Scene(lambda t, q, qd, p: 0.5 * p["m"] * qd[0] ** 2, params={"m": m}, effects=(jms.Friction(law),))
    zero = jnp.zeros(())

    def rates(y: jax.Array) -> jax.Array:
        rate = vector_field(zero, State(jnp.zeros(1), y[:1], {"friction": y[1]}), scene)
        return jnp.concatenate([rate.qd, rate.z["friction"][None]])

    eigenvalues = np.linalg.eigvals(np.asarray(jax.jacfwd(rates)(jnp.zeros(2))))
    np.testing.assert_allclose(-eigenvalues.real / np.abs(eigenvalues), ratio, rtol=1e-12)
    np.testing.assert_allclose(np.abs(eigenvalues), math.sqrt(750.0 / m), rtol=1e-12)


WIDTHS = {
    "coulomb": (jms.Coulomb(1.5), 1.0),
    "stiction, on the rising side": (jms.Coulomb(1.5, 2.5), 1.8),
    "stribeck, backwards": (STRIBECK, -1.6),
    "asymmetric, backwards": (asymmetric(jms.Coulomb(1.5), Fc=1.8), -1.6),
    "fall within the creep speed": (jms.Stribeck(Fc=1.5, Fs=1.75, vs=1e-4), 1.6),
}


@pytest.mark.parametrize("name", WIDTHS)
def test_a_width_for_a_creep_speed(name: str) -> None:
    law, load = WIDTHS[name]
    creep, m = 1e-3, 2.0
    found = regularized_width(law, creep, load, m)
    side = math.copysign(1.0, load)
    np.testing.assert_allclose(found.law.force(jnp.asarray(found.creep)), load, rtol=1e-7)
    below = jnp.linspace(0.0, 0.99, 5001) * found.creep
    assert (side * np.asarray(jax.vmap(found.law.force)(below)) < abs(load)).all()
    if "fall" in name:
        # Wider, the law would not carry the load before the creep speed at all.
        wider = jms.Regularized(law, found.width * 1.001)
        assert float(jnp.max(jax.vmap(wider.force)(jnp.linspace(0.0, creep, 5001)))) < load
        assert abs(found.creep) < creep
    else:
        np.testing.assert_allclose(abs(found.creep), creep, rtol=1e-9)
    limit = float(law.static_limit(jnp.asarray(side)))
    np.testing.assert_allclose(found.rate, (limit / found.width + getattr(law, "Fv", 0.0)) / m, rtol=1e-6)
    np.testing.assert_allclose(found.step, 2.0 / found.rate, rtol=1e-6)
    assert f"{found.width:.4g} m/s" in str(found)


def test_coulomb_creeps_as_the_inverse_of_tanh_says_and_a_run_shows() -> None:
    found = regularized_width(jms.Coulomb(1.5), 1e-3, 1.0, 2.0)
    np.testing.assert_allclose(found.width, 1e-3 / math.atanh(1.0 / 1.5), rtol=1e-9)
    # Euler's method from a small velocity at no load: bounded just below the step, growing just above.
    for factor, settles in ((0.99, True), (1.01, False)):
        v = 1e-9
        for _ in range(200):
            v -= factor * found.step * 1.5 * math.tanh(v / found.width) / 2.0
        assert (abs(v) < 1e-9) == settles


@pytest.mark.parametrize("v", [0.1, -3e-4])
def test_steps_of_a_bristle_at_a_prescribed_velocity(v: float) -> None:
    """Closed forms: 2 g/(sigma0 |v|) with Euler, 2.785 g/(sigma0 |v|) with RK4."""
    law = jms.LuGre(**SET_1995)
    unit = float(law.stribeck_curve(jnp.asarray(v))) / (1e5 * abs(v))
    for solver, reach in ((None, 2.0), (dfx.Heun(), 2.0), (RK4, 2.785293563405), (dfx.Bosh3(), 2.512745326618)):
        np.testing.assert_allclose(max_stable_step(law, v=v, solver=solver), reach * unit, rtol=1e-9)


def test_steps_below_are_stable_and_steps_above_are_not() -> None:
    """LuGre under a prescribed velocity, by diffrax itself."""
    solver = dfx.Tsit5()
    law, v = jms.LuGre(**SET_1995), jnp.asarray(0.1)
    h = max_stable_step(law, v=0.1, solver=solver)
    term = dfx.ODETerm(lambda t, z, args: law.zdot(v, z))
    steady = float(law.stribeck_curve(v) / law.sigma0)

    def off(step: float) -> float:
        end = dfx.diffeqsolve(
            term, solver, 0.0, 400 * step, step, jnp.asarray(1.01 * steady), max_steps=512, adjoint=dfx.DirectAdjoint()
        ).ys
        assert end is not None
        return abs(float(end[0]) / steady - 1.0) / 0.01

    assert off(0.99 * h) < 1.0 < off(1.01 * h)


def test_steps_of_a_mass_in_stick() -> None:
    """In `simulate`: below the step the vibration dies out, above it grows until the bristle gives way."""
    law, m = jms.LuGre(**{**BOX, "sigma1": 60.0}), 2.0
    h = max_stable_step(law, m, solver=dfx.Heun())
    scene = jms.Scene(lambda t, q, qd, p: 0.5 * p["m"] * qd[0] ** 2, params={"m": m}, effects=(jms.Friction(law),))
    ends = [
        jms.simulate(scene, [0.0], [1e-9], 60.5 * h, dt=factor * h, solver=dfx.Heun()).qd[-1, 0]
        for factor in (0.97, 1.03)
    ]
    assert abs(float(ends[0])) < 1e-9 < abs(float(ends[1]))
    # A spring beside it stiffens it, a hundredth of sigma0 by about as much.
    assert 0.9 * h < max_stable_step(law, m, k=7.5, solver=dfx.Heun()) < h


def test_undamped_vibrations() -> None:
    law = jms.LuGre(**{**BOX, "sigma1": 0.0, "sigma2": 0.0})
    assert max_stable_step(law, 2.0) == max_stable_step(law, 2.0, solver=dfx.Heun()) == 0.0
    # With a little damping Euler's method has its step, the damping over the stiffness.
    assert max_stable_step(BRISTLES["armstrong"], 2.0) == pytest.approx(0.2 / 1e4, rel=1e-4)
    np.testing.assert_allclose(max_stable_step(law, 2.0, solver=RK4), math.sqrt(8.0 * 2.0 / 750.0), rtol=1e-6)


@pytest.mark.parametrize(
    ("name", "v"),
    [
        ("elasto-plastic", -1.5),
        ("maxwell slip with attraction", 0.02),
        ("armstrong", 0.02),
    ],
)
def test_every_bristle_has_a_step_that_runs(name: str, v: float) -> None:
    """Euler at a prescribed velocity, from the steady state and a small deviation."""
    law, speed = BRISTLES[name], jnp.asarray(v)

    @jax.jit
    def euler(z: Any, step: float, steps: int) -> Any:
        return jax.lax.fori_loop(
            0, steps, lambda _, z: jax.tree.map(lambda a, b: a + step * b, z, law.zdot(speed, z)), z
        )

    h = max_stable_step(law, v=v)
    assert 0 < h < math.inf
    z = euler(law.initial_state(speed), 0.3 * h, 100_000)

    def off(step: float) -> float:
        """Largest relative deviation of a deflection in the end, from 1e-6 at the beginning."""
        end = euler(jax.tree.map(lambda z: z * (1.0 - 1e-6), z), step, 400)
        a, b = jax.tree.leaves(end)[0], jax.tree.leaves(z)[0]
        return float(jnp.max(jnp.abs(a - b) / jnp.abs(b)))

    assert off(0.99 * h) < 5e-7
    # With attraction the step is that of the stiffer side of a kink, and the other side damps.
    assert not off(1.03 * h) <= 1e-6 or "attraction" in name  # NaN has grown, too


def test_functions_of_velocity_have_a_step_and_growing_modes_have_none() -> None:
    assert max_stable_step(jms.Viscous(0.5), 2.0) == pytest.approx(8.0)
    assert max_stable_step(jms.Viscous(0.5), v=1.0) == math.inf
    assert max_stable_step(jms.Curve(lambda v: -v), 2.0) == math.inf


VARYING: Any = scaled_by(jms.LuGre(**BOX), lambda t, q, qd, p: 2.0)


class NotFinite(AbstractForceLaw):
    stiff: ClassVar[bool] = False

    def force(self, v: Any) -> Any:
        return v / (jnp.abs(v) - 1e3)


@pytest.mark.parametrize(
    ("call", "text"),
    [
        (lambda: check_passivity(VARYING), r"Pass the law at a state, law.bind_state\(t, q, qd, params\)"),
        (lambda: max_stable_step(VARYING), r"Pass the law at a state, law.bind_state\(t, q, qd, params\)"),
        (lambda: check_passivity(jms.Viscous(1.0), v_max=0.0), "v_max must be finite"),
        (lambda: check_passivity(NotFinite()), "not finite at v = 1000 m/s"),
        (lambda: damping_sigma1(0.0, 1.0), "m must be finite and > 0"),
        (lambda: damping_sigma1(1.0, 1.0, sigma2=-1.0), "sigma2 must be finite and >= 0"),
        (lambda: damping_sigma1(1.0, 1.0, sigma2=3.0), "alone gives the damping ratio 1.5"),
        (lambda: regularized_width(jms.Coulomb(1.5), 0.0, 1.0, 1.0), "creep must be finite and > 0"),
        (lambda: regularized_width(jms.Coulomb(1.5), 1e-3, 1.5, 1.0), "below the limit of stick, 1.5 N"),
        (lambda: regularized_width(jms.Coulomb(1.5, 2.5), 1e-3, 2.4, 1.0), "reaches 1.87354 N at most"),
        (lambda: regularized_width(jms.Stribeck(1.5, 1.6, 0.1, 9.0), 1.0, 1.0, 1.0), "any width will do"),
        (lambda: max_stable_step(jms.Coulomb(1.0), 1.0), "the force of Coulomb jumps"),
        (lambda: max_stable_step(jms.Sign(jms.Coulomb(1.0)), 1.0), "the force of Sign jumps"),
        (lambda: max_stable_step(jms.DeadZone(jms.Coulomb(1.0), 0.1), 1.0), "no slope in its band"),
        (lambda: max_stable_step(jms.Viscous(1.0), 1.0, solver=dfx.Kvaerno3()), "explicit Runge-Kutta"),
        (lambda: max_stable_step(jms.Viscous(1.0), 1.0, solver=jms.Rodas5P()), "explicit Runge-Kutta"),
        (lambda: max_stable_step(jms.Viscous(1.0), k=1.0), "with a mass"),
        (lambda: max_stable_step(jms.Viscous(1.0), -1.0), "m > 0"),
    ],
)
def test_what_is_refused(call: Any, text: str) -> None:
    with pytest.raises(ValueError, match=text):
        call()
