import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

import jaxmodsim as jms
from jaxmodsim.orbits import OrbitError
from jaxmodsim.problems import belt_oscillator, cartesian_pendulum

SPEED = "friction.belt_velocity"


def spring(_t, q, qd, p):
    return 0.5 * qd[0] ** 2 - 0.5 * q[0] ** 2 + 0.0 * p["mu"]


def van_der_pol(_t, q, qd, p):
    return jnp.stack([(p["mu"] - q[0] ** 2) * qd[0]])


def test_orbits_of_van_der_pol_begin_at_a_hopf_point():
    scene = jms.Scene(spring, params={"mu": -1.0}, effects=(jms.AppliedForce(van_der_pol),))
    rests = jms.continue_equilibria(scene, [0.1], "mu", (-1.0, 1.0), step=0.3)
    (point,) = rests.points
    assert point.kind == "Hopf"
    np.testing.assert_allclose(point.value, 0.0, atol=1e-10)
    np.testing.assert_allclose(point.orbit.period, 2 * np.pi, rtol=1e-10)
    assert list(rests.stable) == [mu < 0 for mu in rests.values]
    np.testing.assert_allclose(np.real(rests.eigenvalues[:, 0]), rests.values / 2, atol=1e-10)
    branch = jms.continue_orbits(scene, point, "mu", (-1.0, 0.3), step=0.5)
    mu = branch.values
    assert branch.stable.all()
    assert mu.min() < 5e-3
    # With sqrt(mu) as the unit of length it is van der Pol's equation with his number mu. Amplitude and frequency:
    # C. M. Andersen and J. F. Geer, Power series expansions for the frequency and period of the limit cycle of the van
    # der Pol equation, SIAM Journal on Applied Mathematics 42:678, 1982.
    np.testing.assert_allclose(
        branch.amplitude[:, 0], np.sqrt(mu) * (2 + mu**2 / 96 - 1033 * mu**4 / 552960), rtol=1e-6
    )
    np.testing.assert_allclose(2 * np.pi / branch.period, 1 - mu**2 / 16 + 17 * mu**4 / 3072, rtol=1e-6)


LAW = {"Fc": 5.0, "Fs": 8.0, "vs": 0.2}
C = 2.0


def belt(law, v, c=C):
    return belt_oscillator.scene(law, belt=v, c=c)


def force(v):
    return LAW["Fc"] + (LAW["Fs"] - LAW["Fc"]) * np.exp(-((v / LAW["vs"]) ** 2))


def slope(v):
    return -2 * v / LAW["vs"] ** 2 * (force(v) - LAW["Fc"])


@pytest.fixture(scope="module")
def sliding():
    return jms.continue_equilibria(belt(jms.Stribeck(**LAW), 1.0), [0.0], SPEED, (1.0, 0.2), step=0.2)


def test_steady_sliding_loses_its_stability_where_damping_and_slope_cancel(sliding):
    (point,) = sliding.points
    k = belt_oscillator.PARAMS["k"]
    exact: float = brentq(lambda v: C + slope(v), 0.2, 1.0, xtol=1e-14)  # pyright: ignore[reportAssignmentType]
    assert point.kind == "Hopf"
    np.testing.assert_allclose(point.value, exact, rtol=1e-10)
    np.testing.assert_allclose(point.orbit.period, 2 * np.pi / np.sqrt(k), rtol=1e-10)
    np.testing.assert_allclose([each.q[0] for each in sliding.orbits], force(sliding.values) / k, rtol=1e-12)
    rate = -(C + slope(sliding.values)) / 2
    np.testing.assert_allclose(sliding.eigenvalues[:, 0], rate + 1j * np.sqrt(k - rate**2), rtol=1e-10)
    assert list(sliding.stable) == [v > exact for v in sliding.values]
    assert "Hopf" in str(sliding)
    assert "unstable: an eigenvalue of" in str(sliding.orbits[-1])


def test_orbits_from_a_hopf_point_turn_back_at_the_onset_of_stick(sliding):
    branch = jms.continue_orbits(
        belt(jms.Stribeck(**LAW), 1.0), sliding.points[0], SPEED, (1.0, 0.3), step=0.5, rtol=1e-9
    )
    (corner,) = branch.points
    assert corner.kind == "onset of stick"
    np.testing.assert_allclose(corner.value, branch.values.max(), rtol=1e-5)
    # The slip velocity comes to zero there.
    np.testing.assert_allclose(np.max(corner.orbit.run.qd), corner.value, rtol=1e-4)
    sticks = np.array(["friction" in dict(x.stick) and x.stick["friction"] > 0 for x in branch.orbits])
    assert list(branch.stable) == list(sticks)
    assert np.abs(branch.multipliers[sticks, 1]).max() == 0.0
    assert branch.values[0] < sliding.points[0].value * 1.02
    assert branch.values[-1] < 0.31
    with pytest.raises(ValueError, match="must be within span"):
        jms.continue_orbits(belt(jms.Stribeck(**LAW), 1.0), sliding.points[0], SPEED, (1.0, 0.5))
    with pytest.raises(ValueError, match="neither period nor section"):
        jms.continue_orbits(belt(jms.Stribeck(**LAW), 1.0), sliding.points[0], SPEED, (1.0, 0.3), period=1.0)


def test_orbits_with_stick_turn_back_where_stick_shrinks_to_a_point():
    scene, span = belt(jms.Stribeck(**LAW), 0.61), (0.61, 0.66)
    branch = jms.continue_orbits(scene, ([0.0], [0.61]), SPEED, span, settle=20.0, step=0.4, rtol=1e-9)
    (point,) = branch.points
    assert point.kind == "loss of stick"
    sticks = np.array([x.stick["friction"] > 0 for x in branch.orbits])
    assert list(branch.stable) == list(sticks)
    assert list(np.flatnonzero(sticks)) == list(range(point.index + 1))
    assert "end of the span" in branch.ending
    # From a touch of the speed of the belt the second solver slips to the next touch, at this speed alone.
    k, v = belt_oscillator.PARAMS["k"], point.value

    def rate(_, y):
        return [y[1], force(v - y[1]) - k * y[0] - C * y[1]]

    start = [(LAW["Fs"] - C * v) / k, v]
    run = solve_ivp(rate, (0, 1), start, "DOP853", events=lambda t, y: rate(t, y)[1], rtol=1e-12, atol=1e-13)
    assert run.y_events is not None
    np.testing.assert_allclose(np.max(run.y_events[0][1:, 1]), v, rtol=1e-6)


def test_hopf_point_with_bristles_has_the_eigenvalues_of_equations_written_by_hand():
    numbers = {"sigma0": 2e3, "sigma1": 5.0, "sigma2": 0.4, "Fc": 5.0, "Fs": 8.0, "vs": 0.2}
    rests = jms.continue_equilibria(belt(jms.LuGre(**numbers), 1.0), [0.0], SPEED, (1.0, 0.3), step=0.2)
    point = next(each for each in rests.points if each.kind == "Hopf")
    s0, s1, s2 = (numbers[name] for name in ("sigma0", "sigma1", "sigma2"))

    def rate(y):
        x, u, z = y
        v = u - point.value
        zd = v - s0 * abs(v) / force(v) * z
        return np.array([u, -100.0 * x - C * u - s0 * z - s1 * zd - s2 * v, zd])

    at = np.array([point.orbit.q[0], 0.0, point.orbit.z["friction"]])
    np.testing.assert_allclose(rate(at), 0.0, atol=1e-10)
    h = 1e-6 * np.diag([0.1, 1.0, 1e-2])
    by_hand = np.linalg.eigvals(np.stack([(rate(at + x) - rate(at - x)) / (2 * np.sum(x)) for x in h], axis=1))
    np.testing.assert_allclose(np.sort_complex(point.orbit.eigenvalues), np.sort_complex(by_hand), rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(np.real(point.orbit.eigenvalues[:2]), 0.0, atol=1e-8)


def fold_force(_t, q, qd, p):
    return jnp.stack([p["mu"] - q[0] ** 2 + q[0] - qd[0]])


def test_fold_of_equilibria_is_passed():
    scene = jms.Scene(spring, params={"mu": 1.0}, effects=(jms.AppliedForce(fold_force),))
    rests = jms.continue_equilibria(scene, [1.0], "mu", (1.0, -1.0), step=0.2)
    (point,) = rests.points
    assert point.kind == "fold"
    np.testing.assert_allclose([point.value, float(point.orbit.q[0])], 0.0, atol=1e-9)
    q = np.array([each.q[0] for each in rests.orbits])
    np.testing.assert_allclose(q**2, rests.values, atol=1e-10)
    assert list(rests.stable) == list(q > 0)
    assert q[-1] < -0.99
    with pytest.raises(ValueError, match="a period doubling or a Hopf point, but a fold"):
        jms.continue_orbits(scene, point, "mu", (1.0, -1.0))
    with pytest.raises(OrbitError, match="No convergence to an equilibrium"):
        jms.continue_equilibria(scene, [1.0], "mu", (-1.0, 1.0))


def buckling_force(_t, q, qd, p):
    return jnp.stack([p["mu"] * q[0] + q[0] - q[0] ** 3 - qd[0]])


def test_branch_point_where_a_spring_buckles():
    scene = jms.Scene(spring, params={"mu": -1.0}, effects=(jms.AppliedForce(buckling_force),))
    rests = jms.continue_equilibria(scene, [0.1], "mu", (-1.0, 0.9), step=0.3)
    (point,) = rests.points
    assert point.kind == "branch point"
    np.testing.assert_allclose(point.value, 0.0, atol=1e-10)
    assert np.isinf(rests.orbits[-1].period)


def incline(_t, q, qd, p):
    return 0.5 * p["m"] * qd[0] ** 2 - 0.5 * p["k"] * q[0] ** 2 + p["m"] * p["g"] * q[0]


def test_ends_of_the_set_of_equilibria_under_coulomb_friction():
    scene = jms.Scene(incline, params={"m": 2.0, "k": 50.0, "g": 0.5}, effects=(jms.Friction(jms.Coulomb(3.0, 5.0)),))
    for side in (1, -1):
        ends = {"friction": side}
        rests = jms.continue_equilibria(scene, [0.0], "k", (50.0, 100.0), ends=ends, step=0.5)
        np.testing.assert_allclose([each.q[0] for each in rests.orbits], (1.0 - side * 5.0) / rests.values, rtol=1e-12)
        assert not rests.points
        assert not rests.stable.any()
        by = jax.jacfwd(lambda s, ends=ends: jms.equilibrium(s, [0.3], ends=ends).q[0])(scene)
        np.testing.assert_allclose(by.effects[0].law.Fs, -side / 50.0, rtol=1e-12)
        np.testing.assert_allclose(by.params["k"], -(1.0 - side * 5.0) / 2500.0, rtol=1e-12)
    assert "about to slide: friction, backwards" in str(rests.orbits[0])
    # Just beyond an end it slides away, within it rests.
    for factor, moves in ((1.001, True), (0.999, False)):
        run = jms.simulate(scene, factor * rests.orbits[0].q, [0.0], 0.5)
        assert bool(run.q[0, 0] != factor * rests.orbits[0].q[0]) == moves
    with pytest.raises(ValueError, match=r"friction sticks.*pass ends=\{'friction': 1\}.*ends=None was given"):
        jms.equilibrium(scene, [0.0])


def two_blocks(_t, q, qd, p):
    return 0.5 * (qd[0] ** 2 + qd[1] ** 2) - 0.5 * p["k"] * (q[0] ** 2 + (q[1] - q[0]) ** 2)


def first(q):
    return q[0]


def second(q):
    return q[1]


def test_two_elements_have_four_corners():
    friction = (
        jms.Friction(jms.Coulomb(1.0), along=first, name="a"),
        jms.Friction(jms.Coulomb(2.0), along=second, name="b"),
    )
    scene = jms.Scene(two_blocks, params={"k": 10.0}, effects=friction)
    for a, b in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
        exact = np.linalg.solve([[20.0, -10.0], [-10.0, 10.0]], [-1.0 * a, -2.0 * b])
        np.testing.assert_allclose(jms.equilibrium(scene, [0.0, 0.0], ends={"a": a, "b": b}).q, exact, rtol=1e-12)


def test_constraints_reduce_the_number_of_eigenvalues():
    rest = jms.equilibrium(cartesian_pendulum.scene(l=2.0), [0.1, -0.9])
    np.testing.assert_allclose(rest.q, [0.0, -2.0], atol=1e-12)
    np.testing.assert_allclose(rest.eigenvalues, np.sqrt(9.81 / 2.0) * np.array([1j, -1j]), atol=1e-10)
    assert rest.stability.startswith("neutral: an eigenvalue is on")


def pulled(t, q, qd, p):
    return 0.5 * qd[0] ** 2 - 0.5 * (q[0] - p["mu"] * t) ** 2


def test_scenes_without_an_equilibrium_are_refused():
    with pytest.raises(OrbitError, match=r"depends on time.*lag behind a drive"):
        jms.equilibrium(jms.Scene(pulled, params={"mu": 1.0}), [0.0])
    with pytest.raises(OrbitError, match="one of a family"):
        jms.equilibrium(belt(jms.Dahl(sigma0=1e3, Fc=1.0), 0.0), [0.0])
    with pytest.raises(ValueError, match="nothing sticks"):
        jms.equilibrium(belt(jms.Stribeck(**LAW), 0.3), [0.0], ends={"friction": 1})
    rests = jms.continue_equilibria(belt(jms.Stribeck(**LAW), 0.3), [0.0], SPEED, (0.3, -0.3), step=0.2)
    assert "its surface is at rest" in rests.ending
    assert rests.values.min() >= 0.0
