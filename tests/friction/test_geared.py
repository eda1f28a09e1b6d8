"""Friction that grows with a transmitted torque: efficiencies, self-locking, and its execution by a bristle."""

from typing import Any, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxmodsim as jms
from jaxmodsim import Bristle, Coulomb, Dahl, Geared, ServoGear, Stribeck, asymmetric, scaled_by
from jaxmodsim.friction._gears import published_servo_gears
from jaxmodsim.scene import State, vector_field

DRIVE, BACK, SPEED, LOAD = 0.25, 0.4, 3.0, 0.7


def spring(t: Any, q: Any, qd: Any, p: Any) -> Any:
    """Torque of the elastic joint between motor and load [N m]."""
    del t, qd
    return p["k"] * (q[0] - q[1])


def energy(t: Any, q: Any, qd: Any, p: Any) -> Any:
    """Motor and load with an elastic joint."""
    del t
    return 0.5 * (p["J1"] * qd[0] ** 2 + p["J2"] * qd[1] ** 2 - p["k"] * (q[0] - q[1]) ** 2)


def torques(t: Any, q: Any, qd: Any, p: Any) -> Any:
    """Of the motor, and of the load against it."""
    del q
    return jnp.stack([p["u"] * jnp.cos(p["w"] * t), -p["M"] - p["c"] * qd[1]])


def motor_angle(q: Any) -> Any:
    return q[0]


def joint(law: Any, u: Any = 0.0, *, w: float = 0.0, c: float = 0.0, load: Any = LOAD) -> jms.Scene:
    return jms.Scene(
        energy,
        params={"J1": 0.01, "J2": 0.05, "k": 20.0, "u": u, "w": w, "c": c, "M": load},
        effects=(jms.AppliedForce(torques), jms.Friction(law, along=motor_angle, name="gear")),
    )


rate_of = jax.jit(vector_field)


@pytest.mark.parametrize("direction", [1.0, -1.0])
@pytest.mark.parametrize("load", [LOAD, -LOAD])
def test_efficiency_in_steady_motion(direction: float, load: float) -> None:
    drives = direction * load > 0
    # Output over input power: the load over the motor where that drives, the motor over the load otherwise.
    u = load * (1.0 + DRIVE) if drives else load * (1.0 - BACK)
    speed = direction * SPEED
    scene = joint(Geared(Coulomb(0.0), DRIVE, spring, BACK), u, load=load)
    state = State(jnp.array([load / 20.0, 0.0]), jnp.array([speed, speed]), {})
    rate = rate_of(0.0, state, scene, np.array([direction, np.sign(load)]))
    np.testing.assert_allclose(rate.qd, 0.0, atol=1e-12)
    motor, other = u * speed, load * speed
    efficiency = other / motor if drives else motor / other
    assert efficiency == pytest.approx(1.0 / (1.0 + DRIVE) if drives else 1.0 - BACK, abs=1e-12)
    # With a bristle in place of events, where it has come to its limit.
    bent = joint(Bristle(Geared(Coulomb(0.0), DRIVE, spring, BACK), 1e-3), u, load=load)
    rate = rate_of(0.0, state._replace(z={"gear": jnp.array(direction)}), bent)
    np.testing.assert_allclose(rate.qd, 0.0, atol=1e-12)
    assert rate.z["gear"] == 0.0


@pytest.mark.parametrize("over", [1e-12, -1e-12])
def test_the_gear_locks_itself_from_a_coefficient_of_one_on(over: float) -> None:
    scene = joint(Geared(Coulomb(0.0), DRIVE, spring, 1.0 + over))
    run = jms.simulate(scene, [0.0, -LOAD / 20.0], [0.0, 0.0], 0.1)
    assert bool(run.mode["gear"][-1] == 0) == (over > 0)
    if over > 0:
        np.testing.assert_array_equal(run.q[-1], [0.0, -LOAD / 20.0])


def test_the_gear_drives_locks_and_is_driven_back() -> None:
    law = Geared(Stribeck(Fc=0.05, Fs=0.08, vs=0.1, Fv=0.01), Stribeck(0.2, 0.25, 0.1), spring, 0.3)
    scene = joint(law, 2.0, w=0.7, c=0.3)
    options: dict[str, Any] = {"t1": 2.2, "rtol": 1e-9, "atol": 1e-11}
    run = jms.simulate(scene, [0.0, 0.0], [0.0, 0.0], ts=jnp.linspace(0.0, 2.2, 221), **options)
    mode, power = np.asarray(run.mode["gear"]), np.asarray(20.0 * (run.q[:, 0] - run.q[:, 1]) * run.qd[:, 0])
    assert {*np.unique(mode)} == {-1.0, 0.0, 1.0}
    assert np.any(power[mode != 0] > 0.1)
    assert np.any(power[mode != 0] < -0.1)
    assert float(jnp.max(jnp.abs(run.energy.balance))) < 1e-6
    assert float(jnp.min(jnp.diff(run.energy.dissipated))) > -1e-9

    def end(scene: jms.Scene, simulate: Any = jms.simulate) -> Any:
        return simulate(scene, [0.0, 0.0], [0.0, 0.0], **options).q[-1, 1]

    names = ("gear.drive.Fc", "gear.back.Fc", "k")
    check = jms.check_gradients(end, scene, names=names)
    assert check.ok, str(check)


@pytest.mark.parametrize("side", [1.0, -2.0])
def test_a_rigid_gear_drives_and_is_driven_in_one_slip(side: float) -> None:
    """Under the torques 3 and 12 - 8 t that in the mesh changes its sign: the speed is a polynomial on either side.

    The scale and the sign of the constraint do not matter.
    """
    c, J1, J2, T1, w0, t1 = 0.3, 0.4, 2.0, 3.0, 6.0, 1.4

    def push(t: Any, q: Any, qd: Any, p: Any) -> Any:
        del q, qd, p
        return jnp.stack([T1 + 0.0 * t, 12.0 - 8.0 * t])

    def kinetic(t: Any, q: Any, qd: Any, p: Any) -> Any:
        del t, q, p
        return 0.5 * (J1 * qd[0] ** 2 + J2 * qd[1] ** 2)

    def mesh(t: Any, q: Any, p: Any) -> Any:
        del t
        return side * (p * q[1] - q[0])

    def speed(x: Any) -> Any:
        drive, back, ratio = x
        gear = jms.Friction(Geared(Coulomb(c), drive, "mesh", back), along=motor_angle, name="gear")
        scene = jms.Scene(kinetic, ratio, (jms.AppliedForce(push), gear), (jms.Constraint(mesh, name="mesh"),))
        run = jms.simulate(scene, [0.0, 0.0], jnp.stack([w0, w0 / ratio]), t1)
        return run.qd[-1, 0], run.stats["num_events"]

    def exact(x: Any) -> Any:
        drive, back, ratio = x
        k = J2 / (J1 * ratio**2)
        turn = (12.0 - ratio * k * (T1 - c)) / 8.0  # where k (T1 - c) = (12 - 8 t)/ratio
        ends = [0.0, turn, t1]
        gained = 0.0
        for start, end, slope in zip(ends[:-1], ends[1:], (1.0 - back, 1.0 + drive), strict=True):
            mean = (k * (T1 - c) - (12.0 - 4.0 * (start + end)) / ratio) / (1.0 + k * slope)
            gained += (end - start) * (T1 - c - slope * mean) / J1
        return w0 + gained

    x = jnp.array([0.5, 0.3, 1.6])
    slopes, (found, events) = jax.jacfwd(lambda x: (speed(x)[0], speed(x)), has_aux=True)(x)
    assert int(events) == 0
    assert float(found) == pytest.approx(float(exact(x)), abs=1e-9)
    np.testing.assert_allclose(slopes, jax.jacfwd(exact)(x), atol=1e-8)


def test_a_torque_that_a_reversal_turns_for_a_part_of_a_step() -> None:
    """Slip reverses at 0.45 s; the torque in the mesh is negative from then to 0.451 s, within a step."""
    c, drive, back, T, reversal, turn, t1 = 0.5, 0.4, 0.3, 2.0, 0.45, 0.451, 2.0

    def push(t: Any, q: Any, qd: Any, p: Any) -> Any:
        del q, qd, p
        return jnp.stack([T + 0.0 * t, T - c + turn - t])

    def gained(start: float, end: float, side: float, slope: float) -> float:
        """Change of speed, where the friction is `side c` and `slope` per torque."""
        load = 0.5 * (start + end) - turn - T + c
        return (end - start) * (T - side * c - (1.0 + slope) * load) / (2.0 + slope)

    gear = jms.Friction(Geared(Coulomb(c), drive, "mesh", back), along=motor_angle, name="gear")
    mesh = jms.Constraint(lambda t, q, p: q[0] - q[1], name="mesh")

    def kinetic(t: Any, q: Any, qd: Any, p: Any) -> Any:
        del t, q, p
        return 0.5 * jnp.sum(qd**2)

    masses = jms.Scene(kinetic, effects=(jms.AppliedForce(push), gear), constraints=(mesh,))
    before = gained(0.0, reversal, -1.0, -back)
    run = jms.simulate(masses, [0.0, 0.0], [-before, -before], t1)
    np.testing.assert_allclose(run.events.t, [reversal], rtol=1e-9)
    after = gained(reversal, turn, 1.0, -back) + gained(turn, t1, 1.0, drive)
    np.testing.assert_allclose(run.qd[-1], after, rtol=1e-9)


def test_a_bristle_has_the_levels_of_its_law_in_steady_slip() -> None:
    tau, v = jnp.array(-0.9), jnp.array(0.37)
    inside = Geared(asymmetric(Stribeck(0.1, 0.2, 0.3, 0.05), Fc=0.15), Stribeck(0.2, 0.3, 0.4), tau, 0.35)
    law = Bristle(inside, 1e-3)
    for side in (1.0, -1.0):
        steady = law.force(side * v, jnp.array(side))
        exact = side * inside.sliding_force(side * v) + inside.viscous_force(side * v)
        assert float(steady) == pytest.approx(float(exact), abs=1e-15)
        assert law.zdot(side * v, jnp.array(side)) == 0.0
    # Without the other parts it is mu_avg |tau| z + mu_dif tau z^2, at every z.
    average, difference = 0.5 * (DRIVE + BACK), 0.5 * (DRIVE - BACK)
    gear = Bristle(Geared(Coulomb(0.0), DRIVE, tau, BACK), 1e-3)
    for z in jnp.linspace(-1.0, 1.0, 9):
        expected = average * abs(tau) * z + difference * tau * z**2
        assert float(gear.force(v, z)) == pytest.approx(float(expected), abs=1e-15)


def test_a_bristle_of_coulomb_is_dahl() -> None:
    bristle, dahl = Bristle(Coulomb(1.5), 2e-3), Dahl(1.5 / 2e-3, 1.5)
    z, v, dt = jnp.array(0.4), jnp.array(-0.3), jnp.array(1e-3)
    assert float(bristle.force(v, z)) == pytest.approx(float(dahl.force(v, 2e-3 * z)), rel=1e-14)
    assert float(bristle.zdot(v, z)) == pytest.approx(float(dahl.zdot(v, 2e-3 * z)) / 2e-3, rel=1e-14)
    assert float(bristle.step_exact(v, z, dt)) == pytest.approx(
        float(dahl.step_exact(v, 2e-3 * z, dt)) / 2e-3, rel=1e-12
    )
    assert float(bristle.stored_energy(z)) == pytest.approx(float(dahl.stored_energy(2e-3 * z)), rel=1e-14)
    assert jms.check_passivity(Bristle(Geared(Coulomb(0.1), DRIVE, 2.0, BACK), 1e-3))


def warmth(t: Any, q: Any, qd: Any, p: Any) -> Any:
    """A factor by temperature and position."""
    del t, qd
    return jnp.exp(-0.02 * (p["temperature"] - 20.0)) * (1.0 + 0.1 * jnp.sin(q[0]))


def test_temperature_and_position_scale_it() -> None:
    base: Any = Geared(Stribeck(0.1, 0.2, 0.3, 0.05), DRIVE, spring, BACK)
    params = {"k": jnp.array(20.0), "temperature": jnp.array(45.0)}
    at = jnp.array(0.0), jnp.array([0.3, 0.25]), jnp.array([2.0, 2.0]), params
    factor, v = warmth(*at), jnp.array(-0.4)
    plain, scaled = base.bind_state(*at), scaled_by(base, warmth).bind_state(*at)
    assert float(plain.torque) == pytest.approx(1.0)
    np.testing.assert_allclose(scaled.sliding_force(v), factor * plain.sliding_force(v), rtol=1e-14)
    np.testing.assert_allclose(scaled.viscous_force(v), factor * plain.viscous_force(v), rtol=1e-14)
    np.testing.assert_allclose(scaled.static_limit(-v), factor * plain.static_limit(-v), rtol=1e-14)
    inside: Any = Geared(scaled_by(base.law, warmth), DRIVE, spring, BACK)
    inside = inside.bind_state(*at)
    load = plain.sliding_force(v) - plain.law.sliding_force(v)
    np.testing.assert_allclose(inside.sliding_force(v), factor * plain.law.sliding_force(v) + load, rtol=1e-14)


def test_it_stands_beside_lugre_and_an_elastic_joint() -> None:
    """Motor bearings with LuGre friction, and a mesh whose friction grows with the torque."""
    bearings = jms.LuGre(sigma0=200.0, sigma1=0.5, sigma2=0.01, Fc=0.05, Fs=0.08, vs=0.1)
    mesh = Geared(Coulomb(0.0), DRIVE, spring, BACK)
    scene = joint(Bristle(mesh, 2e-3), 2.0, w=2.0, c=0.3)
    both = jms.Scene(
        scene.lagrangian, scene.params, (*scene.effects, jms.Friction(bearings, along=motor_angle, name="bearings"))
    )
    run = jms.simulate(both, [0.0, 0.0], [0.0, 0.0], 2.0, ts=jnp.linspace(0.0, 2.0, 101), rtol=1e-8)
    assert float(jnp.max(jnp.abs(run.energy.balance))) < 1e-5
    torque = 20.0 * (run.q[:, 0] - run.q[:, 1])
    limit = max(DRIVE, BACK) * np.abs(torque)
    assert np.all(np.abs(run.forces["gear"]) <= limit * (1.0 + 1e-9) + 1e-12)
    held = jms.simulate(both, [0.0, 0.0], [0.0, 0.0], 2.0, dt=2e-4, solver=jms.ImplicitFriction())
    np.testing.assert_allclose(held.q[-1], run.q[-1], atol=5e-3)


@pytest.mark.quick
@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Geared(cast(Any, jms.Viscous(0.1)), 0.1, spring), "Geared needs a set-valued law"),
        (lambda: Geared(Coulomb(0.1), -0.1, spring), "Fc must be finite and >= 0"),
        (lambda: Geared(Coulomb(0.1), "a", spring), "Geared drive and back must be a real number"),
        (lambda: Geared(Coulomb(0.1), 0.1, [1.0]), "Geared torque must be a real number"),
        (lambda: Bristle(cast(Any, jms.Viscous(0.1)), 1e-3), "Bristle needs a set-valued law"),
        (lambda: Bristle(Coulomb(0.1), 0.0), "h must be finite and > 0"),
        (
            lambda: jms.to_mujoco(Geared(Coulomb(0.1), 0.2, 1.0)),
            "MuJoCo has no Geared: the friction of its joints does not depend",
        ),
        (lambda: jms.to_mujoco(Bristle(Coulomb(0.1), 1e-3)), "MuJoCo has no Bristle"),
        (lambda: jms.to_modelica(Geared(Coulomb(0.1), 0.2, 1.0), 1.0), "needs rotary=True, .* but rotary=False"),
        (lambda: jms.to_modelica(Geared(Coulomb(0.1), 0.2, 1.0, 1.1), 1.0, rotary=True), "up to 1.1"),
        (lambda: jms.to_modelica(Geared(Coulomb(0.1, 0.2), 0.2, 1.0), 1.0, rotary=True), r"no stiction \(Fs = Fc\)"),
        (lambda: jms.to_modelica(ServoGear(1.0, 1.0, 0.1, 0.1), 1.0), "have no friction that depends on the torques"),
        (lambda: jms.check_passivity(Geared(Coulomb(0.1), 0.2, spring)), "depend on the state of the mechanism"),
    ],
)
def test_bad_gears_are_refused(make: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make()


def test_modelica_has_it_as_a_lossy_gear() -> None:
    law = Geared(Stribeck(0.1, 0.1, 0.3, 0.05), Stribeck(0.25, 0.25, 0.1, 0.02), spring, 0.4)
    text = jms.to_modelica(law, 2.0, name="gear", rotary=True, rtol=1e-6)
    assert text.startswith("Modelica.Mechanics.Rotational.Components.LossyGear gear(ratio=1, lossTable=[0, ")
    rows = np.array([[float(x) for x in row.split(",")] for row in text.split("[")[1].split("]")[0].split(";")])
    for w in (0.0, 0.4, 1.7):
        eta1, eta2, tau1, tau2 = (np.interp(w, rows[:, 0], column) for column in rows[:, 1:].T)
        # The component's loss at the torque u of the motor, against the law at the torque that is left.
        for u, loss in ((2.0, (1.0 - eta1) * 2.0 + tau1), (-1.5, (1.0 - 1.0 / eta2) * -1.5 + tau2)):
            gear = Geared(law.law, law.drive, u - loss, law.back)
            v = jnp.array(w)
            assert loss == pytest.approx(float(gear.sliding_force(v) + gear.viscous_force(v)), rel=1e-5)


def test_a_torque_of_the_wrong_shape_is_refused() -> None:
    scene = joint(Geared(Coulomb(0.1), 0.2, lambda t, q, qd, p: q))
    with pytest.raises(ValueError, match=r"the torque\(t, q, qd, params\) returned the shape \(2,\)"):
        jms.simulate(scene, [0.0, 0.0], [0.0, 0.0], 1.0)


ACTUATORS = ("mx64", "mx106", "erob80_50", "erob80_100")
PUBLISHED = published_servo_gears()


def reference(p: dict[str, float], tau_m: float, tau_e: float, v: float) -> float:
    """The friction torque of the models M1 to M6 in plain numbers, for v > 0."""
    Km, Kms, Kmq = (p.get(name, 0.0) for name in ("Km", "Kms", "Kmq"))
    Ke, Kes, Keq = p.get("Ke", Km), p.get("Kes", Kms), p.get("Keq", Kmq)
    dry = p["Kc"] + abs(Km * tau_m - Ke * tau_e)
    if "vs" in p:
        quadratic = Keq * tau_e**2 if abs(tau_m) > abs(tau_e) else Kmq * tau_m**2
        quadratic *= tau_m * tau_e < 0
        fall = np.exp(-((v / p["vs"]) ** p.get("alpha", 2.0)))
        dry += fall * (p.get("Kcs", 0.0) + abs(Kms * tau_m - Kes * tau_e) + quadratic)
    return dry + p["Kv"] * v


@pytest.mark.parametrize("model", ["M1", "M2", "M3", "M4", "M5", "M6"])
@pytest.mark.parametrize("actuator", ACTUATORS)
def test_the_published_models_are_their_formulas(actuator: str, model: str) -> None:
    numbers, speeds = PUBLISHED[actuator][model], np.array([1e-3, 0.4, 1.7, 5.0])
    for tau_m, tau_e in ((1.3, -0.8), (0.5, -0.9), (-1.1, 0.4), (0.6, 0.3)):
        law = ServoGear.published(actuator, model, tau_m, tau_e)
        force = jax.vmap(lambda v, law=law: law.sliding_force(v) + law.viscous_force(v))(jnp.asarray(speeds))
        np.testing.assert_allclose(force, [reference(numbers, tau_m, tau_e, v) for v in speeds], rtol=1e-9)
        assert float(law.static_limit(jnp.array(1.0))) == pytest.approx(reference(numbers, tau_m, tau_e, 0.0), rel=1e-9)


@pytest.mark.parametrize("actuator", ACTUATORS)
def test_efficiency_and_self_locking_of_the_directional_model(actuator: str) -> None:
    p = {**PUBLISHED[actuator]["M5"], "Kc": 0.0, "Kcs": 0.0, "Kv": 0.0}
    for v in (1e-3, 0.5, 4.0):
        fall = np.exp(-((v / p["vs"]) ** p["alpha"]))
        Km, Ke = p["Km"] + fall * p["Kms"], p["Ke"] + fall * p["Kes"]

        def friction(tau_m: float, tau_e: float, v: float = v) -> float:
            law = ServoGear(tau_m, tau_e, **p)
            return float(law.sliding_force(jnp.array(v)) + law.viscous_force(jnp.array(v)))

        # Steady motion of the motor, and of the load: the larger torque is the smaller one and friction.
        driving, driven = (1.0 - Km) / (1.0 + Ke), (1.0 - Ke) / (1.0 + Km)
        assert friction(1.0, -driving) == pytest.approx(1.0 - driving, abs=1e-12)
        assert friction(driven, -1.0) == pytest.approx(1.0 - driven, abs=1e-12)
        # The same gear in terms of the transmitted torque, which is that of the load.
        mu_drive, mu_back = (Km + Ke) / (1.0 - Km), (Km + Ke) / (1.0 + Km)
        assert driving == pytest.approx(1.0 / (1.0 + mu_drive), abs=1e-12)
        assert driven == pytest.approx(1.0 - mu_back, abs=1e-12)
        gear = Geared(Coulomb(0.0), mu_drive, driving, mu_back)
        assert float(gear.sliding_force(jnp.array(v))) == pytest.approx(friction(1.0, -driving), abs=1e-12)
    limit = {**p, "Kes": 1.0 - p["Ke"]}
    # At rest without the motor the load alone meets its own size in friction.
    assert float(ServoGear(0.0, -2.0, **limit).static_limit(jnp.array(-1.0))) == pytest.approx(2.0, abs=1e-12)


def motor(t: Any, q: Any, qd: Any, p: Any) -> Any:
    """A position controller that has to lift."""
    del qd
    goal = jnp.sin(2.0 * t) * jnp.sin(0.7 * t)
    return jnp.clip(p["gain"] * (goal - q[0]), -4.0, 4.0)


def gravity(t: Any, q: Any, qd: Any, p: Any) -> Any:
    del t, qd
    return -p["m"] * 9.81 * p["l"] * jnp.sin(q[0])


def arm(law: Any) -> jms.Scene:
    """The pendulum of the test bench behind such measurements."""

    def kinetic(t: Any, q: Any, qd: Any, p: Any) -> Any:
        del t, q
        return 0.5 * (p["armature"] + p["m"] * p["l"] ** 2) * qd[0] ** 2

    def push(t: Any, q: Any, qd: Any, p: Any) -> Any:
        return jnp.stack([motor(t, q, qd, p) + gravity(t, q, qd, p)])

    params = {"gain": 20.0, "m": 1.0, "l": 0.15, "armature": 0.026}
    return jms.Scene(kinetic, params, (jms.AppliedForce(push), jms.Friction(law)), coordinates=("angle [rad]",))


def test_a_servo_on_a_pendulum_sticks_and_slips() -> None:
    scene = arm(ServoGear.published("mx106", "M6", motor, gravity))
    run = jms.simulate(scene, [0.0], [0.0], 2.0, ts=jnp.linspace(0.0, 2.0, 201), rtol=1e-8, atol=1e-10)
    assert {*np.unique(np.asarray(run.mode["friction"]))} == {-1.0, 0.0, 1.0}
    assert float(jnp.max(jnp.abs(run.energy.balance))) < 1e-5


def test_derivatives_of_the_richest_model_equal_differences() -> None:
    law: Any = ServoGear(1.3, -0.8, **PUBLISHED["mx106"]["M6"])

    def force(law: ServoGear, v: Any) -> Any:
        return law.sliding_force(v) + law.viscous_force(v)

    for v in (0.3, -1.2):
        slopes = jax.grad(lambda law, v=v: force(law, jnp.array(v)))(law)
        for name in ("motor", "external", *PUBLISHED["mx106"]["M6"]):
            step = 1e-6 * max(float(getattr(law, name)), 1e-2)
            sides = [
                eqx.tree_at(lambda x, n=name: getattr(x, n), law, getattr(law, name) + side * step) for side in (1, -1)
            ]
            difference = (force(sides[0], jnp.array(v)) - force(sides[1], jnp.array(v))) / (2.0 * step)
            assert float(getattr(slopes, name)) == pytest.approx(float(difference), abs=1e-8)


@pytest.mark.parametrize("slip", [1.0, -1.0])
def test_a_torque_of_zero_has_the_derivative_of_one_side(slip: float) -> None:
    v, zero = jnp.array(slip), jnp.array(0.0)
    laws: dict[str, tuple[Any, set[float]]] = {
        "one coefficient": (lambda torque: Geared(Coulomb(0.1), DRIVE, torque), {DRIVE, -DRIVE}),
        "two": (lambda torque: Geared(Coulomb(0.1), DRIVE, torque, BACK), {slip * DRIVE, -slip * BACK}),
        "servo": (lambda torque: ServoGear(torque, 0.0, Kc=0.1, Kv=0.0, Km=DRIVE), {DRIVE, -DRIVE}),
    }
    for name, (make, sides) in laws.items():
        slope = float(jax.grad(lambda torque, make=make: make(torque).sliding_force(v))(zero))
        assert slope in sides, name


@pytest.mark.parametrize("torques", [(1.3, -0.8), (-1.3, 0.8)])
def test_coefficients_of_zero_have_the_derivative_of_growth(torques: tuple[float, float]) -> None:
    def force(coefficients: Any) -> Any:
        Km, Ke = coefficients
        return ServoGear(*torques, Kc=0.1, Kv=0.0, Km=Km, Ke=Ke).sliding_force(jnp.array(1.0))

    np.testing.assert_allclose(jax.grad(force)(jnp.zeros(2)), np.abs(torques), rtol=1e-15)


def test_wrong_published_names_are_refused() -> None:
    with pytest.raises(ValueError, match=r"actuators mx64, mx106, .* models M1, .* but 'mx64' and 'M7' were given"):
        ServoGear.published("mx64", "M7", 1.0, 1.0)


def test_derivatives_over_zeros_of_the_torque_equal_differences_in_single_precision() -> None:
    def end(x: Any, **options: Any) -> Any:
        k, w, drive = x
        scene = joint(Geared(Coulomb(jnp.full_like(k, 0.05)), drive, spring, BACK), 2.0, w=w, c=0.3, load=0.0)
        inertias = jnp.array(0.5), jnp.array(1.0)
        scene = eqx.tree_at(lambda x: (x.params["k"], x.params["J1"], x.params["J2"]), scene, (k, *inertias))
        scene, rest = jax.tree.map(lambda leaf: jnp.asarray(leaf, k.dtype), scene), jnp.zeros(2, k.dtype)
        run = jms.simulate(scene, rest, rest, 6.0, **options)
        return jnp.concatenate([run.q[-1], run.qd[-1]]), run.stats["num_events"]

    x = np.array([30.0, 2.0, 0.2])
    slopes, events = jax.jacfwd(end, has_aux=True)(jnp.asarray(x, jnp.float32))
    tight = jax.jit(lambda x: end(x, rtol=1e-11, atol=1e-13)[0])
    exact = np.stack([(tight(x + h) - tight(x - h)) / 2e-5 for h in 1e-5 * np.eye(3)], axis=1)
    assert int(events) == 6
    np.testing.assert_allclose(
        np.asarray(slopes) / np.abs(exact).max(axis=0), exact / np.abs(exact).max(axis=0), atol=1e-3
    )


def test_a_jump_of_the_quadratic_terms_is_in_the_derivative() -> None:
    """Torques `p t` and -1 on a mass of 1 in slip: the friction jumps from Kmq to Keq at `t = 1/p`."""

    def kinetic(t: Any, q: Any, qd: Any, p: Any) -> Any:
        del t, q, p
        return 0.5 * qd[0] ** 2

    def motor(t: Any, q: Any, qd: Any, p: Any) -> Any:
        del q, qd
        return p["p"] * t

    def push(t: Any, q: Any, qd: Any, p: Any) -> Any:
        return (motor(t, q, qd, p) - 1.0) * jnp.ones_like(q)

    def speed(x: Any) -> Any:
        law = ServoGear(motor, -1.0, Kc=0.1, Kv=0.0, Kcs=0.2, vs=1e6, Kmq=x[1], Keq=x[2])
        scene = jms.Scene(kinetic, {"p": x[0]}, (jms.AppliedForce(push), jms.Friction(law)))
        return jms.simulate(scene, [0.0], [5.0], 3.0, rtol=1e-9, atol=1e-11).qd[-1, 0]

    def exact(x: Any) -> Any:
        p, Kmq, Keq = x
        return 5.0 + 4.5 * p - 3.0 - 0.9 - Kmq / (3.0 * p) - Keq * (3.0 - 1.0 / p)

    x = jnp.array([0.8, 0.2, 0.05])
    slopes, found = jax.jacfwd(lambda x: 2 * (speed(x),), has_aux=True)(x)  # in one program
    assert found == pytest.approx(float(exact(x)), abs=1e-9)
    np.testing.assert_allclose(slopes, jax.jacfwd(exact)(x), atol=1e-8)


def test_a_rigid_gear_without_load_at_rest_takes_few_steps() -> None:
    """Pad, spring, gear 2:1 and bearing: until the pad slips at 0.5 s, the load of the gear is an error of rounding.

    Then the spring pulls with 2 s - 0.2 sin(10 s), s = t - 0.5, and the bearing holds half of 0.5 N, and friction of
    the gear a quarter of that.
    """

    def lagrangian(t: Any, q: Any, qd: Any, p: Any) -> Any:
        del t, p
        return 0.5 * jnp.sum(qd**2) - 50.0 * (q[1] - q[0]) ** 2

    def pull(t: Any, q: Any, qd: Any, p: Any) -> Any:
        del q, qd, p
        return jnp.stack([2.0 * t, 0.0, 0.0])

    effects = (
        jms.AppliedForce(pull),
        jms.Friction(Coulomb(1.0), along=lambda q: q[0], name="pad"),
        jms.Friction(Geared(Coulomb(0.0), 0.25, "mesh", 0.2), along=lambda q: q[1], name="gear"),
        jms.Friction(Coulomb(0.5), along=lambda q: q[2], name="bearing"),
    )
    mesh = jms.Constraint(lambda t, q, p: q[1] - 2.0 * q[2], name="mesh")
    run = jms.simulate(jms.Scene(lagrangian, effects=effects, constraints=(mesh,)), [0.0] * 3, [0.0] * 3, 0.8)
    slips = {change.effect: change.t for change in run.mode_changes}
    s = slips["bearing"] - 0.5
    np.testing.assert_allclose([slips["pad"], 2.0 * s - 0.2 * np.sin(10.0 * s)], [0.5, 0.25 + 0.25 * 0.25], atol=1e-6)
    assert run.stats["num_steps"] < 200
