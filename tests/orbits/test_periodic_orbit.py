import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import jaxmodsim as jms
from jaxmodsim.orbits import OrbitError
from jaxmodsim.problems import belt_oscillator
from jaxmodsim.scene import replace_elements, scene_numbers

from ..problems import relief_valve, vibrating_table


def spring(_t, q, qd, _p):
    return 0.5 * qd[0] ** 2 - 0.5 * q[0] ** 2


def swing(t, _q, _qd, p):
    return jnp.array([jnp.cos(p["W"] * t + p["phase"])])


def of_frequency(p):
    return 2.0 * jnp.pi / p["W"]


def den_hartog(W, f, phase=0.0):
    """Mass and stiffness one under the force cos(W t + phase) and dry friction f."""
    friction = jms.Friction(jms.Coulomb(f))
    return jms.Scene(spring, params={"W": W, "phase": phase}, effects=(jms.AppliedForce(swing), friction))


def van_der_pol_force(_t, q, qd, p):
    return jnp.array([p["mu"] * (1.0 - q[0] ** 2) * qd[0]])


VAN_DER_POL = jms.Scene(spring, params={"mu": 1.0}, effects=(jms.AppliedForce(van_der_pol_force),))


@pytest.fixture(scope="module")
def belt():
    return jms.periodic_orbit(belt_oscillator.scene(), ([0.0], [0.0]), settle=20.0)


@pytest.fixture(scope="module")
def van_der_pol():
    return jms.periodic_orbit(VAN_DER_POL, ([0.0], [0.5]), settle=60.0)


def test_belt_oscillator_has_the_period_of_its_closed_form(belt):
    cycle = belt_oscillator.cycle(**belt_oscillator.PARAMS)
    np.testing.assert_allclose(belt.period, cycle.period, rtol=1e-9)
    np.testing.assert_allclose(belt.lowest[0], cycle.lowest, rtol=1e-8)
    np.testing.assert_allclose(belt.highest[0], cycle.highest, rtol=1e-8)
    np.testing.assert_allclose(belt.stick["friction"], cycle.stick / cycle.period, rtol=1e-8)
    # What friction takes: Fc over the way of the mass against the belt in slip; nothing in stick.
    lost = belt_oscillator.PARAMS["Fc"] * (belt_oscillator.PARAMS["belt"] * cycle.slip - (cycle.ends - cycle.begins))
    np.testing.assert_allclose(belt.energy, lost, rtol=1e-7)
    assert belt.autonomous
    assert {(before, after) for _, before, after in belt.sequence} == {("backward", "stick"), ("stick", "backward")}


def test_segments_of_a_period_change_nothing(belt):
    orbit = jms.periodic_orbit(belt_oscillator.scene(), belt, segments=4)
    assert len(orbit.runs) == 4
    assert list(orbit.multipliers) == [1.0, 0.0]
    assert orbit.sequence == belt.sequence
    for name in ("q", "qd", "period", "lowest", "highest", "energy"):
        np.testing.assert_allclose(getattr(orbit, name), getattr(belt, name), rtol=1e-9)
    np.testing.assert_allclose(orbit.stick["friction"], belt.stick["friction"], rtol=1e-9)


def test_multipliers_of_stick_and_of_an_unknown_period_are_exact(belt):
    assert list(belt.multipliers) == [1.0, 0.0]
    assert belt.stability == "stable"
    assert "stable" in str(belt)


def test_period_of_the_belt_has_the_derivatives_of_its_closed_form_forward_and_reverse(belt):
    scene = belt_oscillator.scene()
    exact = jax.grad(lambda p: belt_oscillator.cycle(**p).period)(dict(belt_oscillator.PARAMS))
    names = {"m": "m", "k": "k", "belt": "friction.belt_velocity", "Fc": "friction.Fc", "Fs": "friction.Fs"}

    def of_orbit(scene, segments=1):
        orbit = jms.periodic_orbit(scene, belt, segments=segments, rtol=1e-12, atol=1e-14)
        return orbit.period, orbit.amplitude[0]

    def amplitude(p):
        cycle = belt_oscillator.cycle(**p)
        return 0.5 * (cycle.highest - cycle.lowest)

    of_amplitude = jax.grad(amplitude)(dict(belt_oscillator.PARAMS))
    for segments in (1, 4):
        _, reverse = jax.vjp(lambda s, segments=segments: of_orbit(s, segments), scene)
        for right, seed in ((exact, (1.0, 0.0)), (of_amplitude, (0.0, 1.0))):
            (slopes,) = reverse(seed)
            for name, number in names.items():
                np.testing.assert_allclose(scene_numbers(slopes)[number], right[name], rtol=1e-8)
    # Forward, along all numbers at once.
    ones = jax.tree.map(jnp.ones_like, scene)
    _, along = jax.jvp(of_orbit, (scene,), (ones,))
    np.testing.assert_allclose(along[1], sum(of_amplitude.values()), rtol=1e-8)


@pytest.mark.parametrize(("W", "f"), [(0.7, 0.2), (1.5, 0.3), (0.45, 0.1)])
def test_den_hartog(W, f):
    orbit = jms.periodic_orbit(den_hartog(W, f), ([0.0], [0.0]), period=of_frequency, settle=100 * 2 * np.pi / W)
    V, U = 1 / (1 - W**2), np.sin(np.pi / W) / (W * (1 + np.cos(np.pi / W)))
    np.testing.assert_allclose(orbit.amplitude[0], np.sqrt(V**2 - f**2 * U**2), rtol=1e-8)
    assert orbit.stick == {"friction": 0.0}
    assert orbit.stability == "stable"


def spring_of_any_size(_t, q, qd, _p):
    return 0.5 * jnp.sum(qd**2) - 0.5 * jnp.sum(q**2)


def swing_along(t, _q, _qd, p):
    return jnp.cos(p["W"] * t) * p["axis"]


def the_plane(q):
    return q


def test_dry_friction_in_the_plane_has_the_orbit_of_that_along_the_force():
    axis = np.array([0.6, 0.8])
    effects = (jms.AppliedForce(swing_along), jms.Friction(jms.Coulomb(0.5), along=the_plane))
    scene = jms.Scene(spring_of_any_size, params={"W": 0.35, "axis": axis}, effects=effects)
    plane = jms.periodic_orbit(scene, ([0.1, 0.2], [0.0, 0.0]), period=of_frequency)
    line = jms.periodic_orbit(den_hartog(0.35, 0.5), ([0.1], [0.0]), period=of_frequency)
    np.testing.assert_allclose(plane.highest, axis * line.highest, rtol=1e-8)
    np.testing.assert_allclose(plane.stick["friction"], line.stick["friction"], rtol=1e-9)
    # That of the line, that of the motion across it, and two of stick.
    np.testing.assert_allclose(plane.multipliers[0], line.multipliers[0], rtol=1e-7)
    assert list(plane.multipliers[2:]) == [0.0, 0.0]
    assert [after for _, _, after in plane.sequence] == ["slip", "stick"] * 2


def test_a_family_of_orbits_is_refused():
    # At W = 1/2 any part of a free swing, which closes in a half period, may be added; this is an orbit without one.
    f, at = 0.05, 1.0
    start = ([4 / 3 * np.cos(at) + f * (1 - np.cos(2 * at))], [-2 / 3 * np.sin(at) + f * np.sin(2 * at)])
    with pytest.raises(OrbitError, match="one of a family: it has another multiplier of exactly 1"):
        jms.periodic_orbit(den_hartog(0.5, f, at), start, period=of_frequency, settle=0.0)


def test_a_scene_that_depends_on_time_needs_its_period():
    scene = den_hartog(0.7, 0.2)
    with pytest.raises(OrbitError, match="The scene depends on time"):
        jms.periodic_orbit(scene, ([1.0], [0.0]), settle=60.0)
    with pytest.raises(OrbitError, match="do not repeat after the period 3 s"):
        jms.periodic_orbit(scene, ([1.0], [0.0]), period=3.0, settle=60.0)


def test_ball_on_a_vibrating_table():
    p = {**vibrating_table.PARAMS, "A": 0.9e-3}
    T = 2 * np.pi / p["omega"]
    phase = float(vibrating_table.bounce_phase(**{k: p[k] for k in ("g", "A", "omega", "e")}))
    since = T - phase / p["omega"]
    start = [p["A"] * np.sin(phase) + p["g"] * since * (T - since) / 2], [p["g"] * (T / 2 - since)]
    scene, guess = vibrating_table.scene(**p), ([start[0][0] * 1.001], start[1])
    orbit = jms.periodic_orbit(scene, guess, period=lambda p: 2 * jnp.pi / p["omega"], settle=0.0)
    np.testing.assert_allclose([orbit.q, orbit.qd], start, rtol=1e-8)
    # The linearised map of one bounce has the determinant e^2.
    trace = 1 + p["e"] ** 2 - (1 + p["e"]) ** 2 * p["A"] * p["omega"] ** 2 * np.sin(phase) / p["g"]
    np.testing.assert_allclose(np.sum(orbit.multipliers).real, trace, rtol=1e-7)
    np.testing.assert_allclose(np.prod(orbit.multipliers).real, p["e"] ** 2, rtol=1e-8)
    assert orbit.sequence == (("table", "open", "open"),)
    struck = p["A"] * np.sin(phase)
    np.testing.assert_allclose([orbit.lowest[0], orbit.highest[0]], [struck, struck + p["g"] * T**2 / 8], rtol=1e-9)


def test_the_lowest_of_a_valve_that_strikes_is_its_seat():
    """The greatest lift is that of samples, and derivatives are differences, which of the seat is zero."""

    def orbit(flow):
        return jms.periodic_orbit(relief_valve.scene(flow=flow), ([0.5], [0.0]), settle=100.0)

    def extent(flow):
        return jnp.stack([orbit(flow).lowest[0], orbit(flow).amplitude[0]])

    made, h = orbit(6.0), 1e-3
    ts = np.linspace(0.0, float(made.period), 4001)
    run = jms.simulate(made.run.scene, made.q, made.qd, ts[-1], ts=ts, z0=made.z, rtol=1e-10, atol=1e-12)
    assert abs(made.lowest[0]) < 1e-12
    np.testing.assert_allclose(2.0 * made.amplitude[0], np.max(run.q), rtol=1e-6)
    differences = (extent(6.0 + h) - extent(6.0 - h)) / (2.0 * h)
    np.testing.assert_allclose(jax.jacfwd(extent)(6.0), differences, rtol=1e-5, atol=1e-8)


def test_van_der_pol(van_der_pol):
    # The digits by a second solver: DOP853 at 1e-13, below.
    np.testing.assert_allclose(van_der_pol.period, 6.6632868593231, rtol=1e-8)

    second = solve_ivp(
        lambda t, y: [y[1], (1 - y[0] ** 2) * y[1] - y[0]], (0, 60), [2.0, 0.0], "DOP853",
        events=lambda t, y: y[1], rtol=1e-13, atol=1e-14,
    )  # fmt: skip
    times, turns = second.t_events, second.y_events
    assert times is not None
    assert turns is not None
    np.testing.assert_allclose(van_der_pol.period, times[0][-1] - times[0][-3], rtol=1e-8)
    np.testing.assert_allclose(van_der_pol.highest[0], np.max(turns[0][-2:, 0]), rtol=1e-8)
    # By Liouville's formula, the mean of mu (1 - q^2).
    t = np.linspace(0, float(van_der_pol.period), 2001)
    run = jms.simulate(VAN_DER_POL, van_der_pol.q, van_der_pol.qd, t[-1], ts=t, rtol=1e-11, atol=1e-13)
    exponent = float(np.trapezoid(1 - np.asarray(run.q[:, 0]) ** 2, t))
    np.testing.assert_allclose(van_der_pol.multipliers, [1.0, np.exp(exponent)], rtol=1e-6)
    assert van_der_pol.multipliers[0] == 1.0


def test_multipliers_of_random_scenes_are_those_of_finite_differences():
    random, checked = np.random.default_rng(3), 0
    while checked < 50:
        W, f = random.uniform(0.6, 2.0), random.uniform(0.05, 0.6)
        if abs(W - 1) < 0.05:
            continue
        scene = den_hartog(W, f, random.uniform(0.0, 6.0))
        orbit = jms.periodic_orbit(scene, ([0.0], [0.0]), period=of_frequency, settle=150.0)
        x = np.array([orbit.q[0], orbit.qd[0]])

        def after(x, scene=scene, T=orbit.period):
            run = jms.simulate(scene, x[:1], x[1:], T, rtol=1e-11, atol=1e-13)
            return np.array([run.q[-1, 0], run.qd[-1, 0]])

        # The error of the step falls with its square, rounding and the tolerance rise with its inverse.
        h = 1e-4
        rows = [(after(x + h * e) - after(x - h * e)) / (2 * h) for e in np.eye(2)]
        near = np.array([(after(x + h / 2 * e) - after(x - h / 2 * e)) / h for e in np.eye(2)])
        monodromy = ((4 * near - rows) / 3).T
        # Coefficients of the characteristic polynomial: roots that are nearly double amplify errors.
        np.testing.assert_allclose(np.sum(orbit.multipliers).real, np.trace(monodromy), atol=1e-6)
        np.testing.assert_allclose(np.prod(orbit.multipliers).real, np.linalg.det(monodromy), atol=1e-6)
        checked += 1


def test_derivatives_of_random_belts_are_those_of_finite_differences(belt):
    random, scene = np.random.default_rng(5), belt_oscillator.scene()
    usual = {name: float(x) for name, x in scene_numbers(scene).items()}
    for _ in range(50):
        numbers = {name: x * random.uniform(0.8, 1.25) for name, x in usual.items()}
        orbit = jms.periodic_orbit(replace_elements(scene, numbers), belt, settle=20.0)

        def of_orbit(scene, orbit=orbit):
            orbit = jms.periodic_orbit(scene, orbit, rtol=1e-12, atol=1e-14)
            return orbit.period, orbit.amplitude[0]

        def moved(name, part, numbers=numbers, of_orbit=of_orbit):
            return np.array(of_orbit(replace_elements(scene, {**numbers, name: numbers[name] * (1 + part)})))

        _, reverse = jax.vjp(of_orbit, replace_elements(scene, numbers))
        slopes = [scene_numbers(reverse(seed)[0]) for seed in ((1.0, 0.0), (0.0, 1.0))]
        for name, x in numbers.items():
            # The error of the step falls with its square, to 1e-8; that of the orbits, 1e-12, rises with its inverse.
            h = 1e-4
            differences = (moved(name, h) - moved(name, -h)) / (2 * h)
            of = np.array([orbit.period, orbit.amplitude[0]])
            np.testing.assert_allclose(np.array([each[name] for each in slopes]) * x / of, differences / of, atol=1e-6)


def test_a_section_is_where_the_orbit_begins(van_der_pol):
    orbit = jms.periodic_orbit(VAN_DER_POL, ([0.0], [0.5]), settle=60.0, section=lambda q, qd: -qd[0])
    np.testing.assert_allclose(orbit.q, van_der_pol.highest, rtol=1e-8)
    np.testing.assert_allclose(orbit.qd, 0.0, atol=1e-12)
    np.testing.assert_allclose(orbit.period, van_der_pol.period, rtol=1e-10)


def test_failures_raise_errors_that_name_the_cause(van_der_pol):
    start = ([0.0], [0.5])
    with pytest.raises(OrbitError, match="not crossed from below"):
        jms.periodic_orbit(VAN_DER_POL, start, settle=60.0, section=lambda q, qd: q[0] - 5.0)
    with pytest.raises(OrbitError, match="section is degenerate"):
        jms.periodic_orbit(VAN_DER_POL, van_der_pol, section=lambda q, qd: 0.0 * q[0])
    with pytest.raises(OrbitError, match="comes to rest"):
        jms.periodic_orbit(VAN_DER_POL, ([0.0], [0.0]), settle=60.0)
    with pytest.raises(OrbitError, match="does not return"):
        jms.periodic_orbit(VAN_DER_POL, start, settle=3.0)
    with pytest.raises(OrbitError, match="No convergence"):
        jms.periodic_orbit(VAN_DER_POL, van_der_pol, section=lambda q, qd: q[0] - 5.0)
    with pytest.raises(ValueError, match="needs settle"):
        jms.periodic_orbit(VAN_DER_POL, start)
    with pytest.raises(ValueError, match="period must be one finite number > 0"):
        jms.periodic_orbit(VAN_DER_POL, start, period=-1.0)
    with pytest.raises(ValueError, match="section is for orbits of unknown period"):
        jms.periodic_orbit(VAN_DER_POL, start, period=1.0, section=lambda q, qd: q[0])
    with pytest.raises(ValueError, match="guess must have q0 and qd0 of the shape"):
        jms.periodic_orbit(VAN_DER_POL, ([0.0], [0.0, 1.0]), settle=60.0)
    with pytest.raises(ValueError, match="outside"):
        jax.jit(lambda s: jms.periodic_orbit(s, start, settle=60.0).period)(VAN_DER_POL)
    single = eqx.tree_at(lambda s: s.params["mu"], VAN_DER_POL, jnp.float32(1.0))
    with pytest.raises(ValueError, match="needs float64"):
        jms.periodic_orbit(single, start, settle=60.0)
