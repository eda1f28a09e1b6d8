"""Examples of the Modelica Standard Library with clutches, brakes, freewheels, lossy gears and play, as scenes.

Their published results are those of Dymola 2020x at a tolerance of 1e-6, at the last sample of the files; mode changes
are the first sample in the new mode. The mode "free" of Modelica, a clutch without normal force, is slip without
friction here.
"""

import jax.numpy as jnp
import numpy as np

import jaxmodsim as jms
from bench.conformance import references
from bench.conformance.case import Numbers, Setup, modelica_case


def inertias(t, q, qd, p):
    """Lagrangian of inertias `J` on one axis."""
    return 0.5 * jnp.sum(p["J"] * qd**2)


def between(i):
    """Angle of coordinate i relative to the one before."""
    return lambda q: q[i] - q[i - 1]


def coupled_clutches(p: Numbers) -> Setup:
    """Four inertias in a row, driven at the first; three clutches are pressed at different times."""

    def clutch(i, load):
        return jms.Friction(
            jms.Coulomb(p["mu"], p["peak"] * p["mu"]), along=between(i), normal_force=load, name=f"clutch{i}"
        )

    def pressed_from(t):
        return jms.Signal([0.0, t], jnp.stack([0.0 * p["capacity"], p["capacity"]]))

    params = {"J": jnp.stack([p[f"J{i}"] for i in range(1, 5)]), "tau": p["torque"], "capacity": p["capacity"]}
    drive = jms.AppliedForce(lambda t, q, qd, p: p["tau"] * jnp.sin(10 * jnp.pi * t) * jnp.eye(4)[0])
    clutches = (
        clutch(1, lambda t, q, qd, p: p["capacity"] * jnp.cos(0.4 * jnp.pi * t)),
        clutch(2, lambda t, q, qd, p: p["load2"]),
        clutch(3, lambda t, q, qd, p: p["load3"]),
    )
    params |= {"load2": pressed_from(0.4), "load3": pressed_from(0.9)}
    return Setup(jms.Scene(inertias, params, (drive, *clutches)), np.zeros(4), np.array([10.0, 0.0, 0.0, 0.0]))


def friction(p: Numbers) -> Setup:
    """Motor, clutch, inertia, spring, inertia with a brake; coordinates are the angles of the inertias 3, 2, 1."""

    def lagrangian(t, q, qd, p):
        return inertias(t, q, qd, p) - 0.5 * p["c"] * (q[1] - q[2]) ** 2

    def forces(t, q, qd, p):
        damping = p["d"] * (qd[1] - qd[2])
        return jnp.stack([p["torque"] * p["motor"] * jnp.sin(100.0 * t), -damping, damping])

    params = {"J": jnp.stack([p["J3"], p["J2"], p["J1"]])} | {name: p[name] for name in ("c", "d", "torque", "brake")}
    params |= {"motor": jms.Signal([0.0, 0.5], [1.0, 0.0]), "on": jms.Signal([0.0, 0.5], [0.0, 1.0])}
    clutch = jms.Friction(jms.Coulomb(0.5), along=between(1), normal_force=p["capacity"], name="clutch")
    brake = jms.Friction(
        jms.Coulomb(0.5), along=lambda q: q[2], normal_force=lambda t, q, qd, p: p["brake"] * p["on"], name="brake"
    )
    scene = jms.Scene(lagrangian, params, (jms.AppliedForce(forces), clutch, brake))
    return Setup(scene, np.zeros(3), np.array([100.0, 90.0, 90.0]))


def freewheel(grip, stiction, pressed):
    """A one-way clutch: up to 100 N m against backward slip, and the friction of the pressed plates against forward."""
    wheel = jms.asymmetric(jms.Coulomb(0.0), Fc=100.0)
    plates = jms.Coulomb(grip, stiction)
    law = jms.Geared(wheel, drive=plates, torque=lambda t, q, qd, p: p[pressed], back=0.0)
    return jms.Friction(law, along=between(1), name="clutch")


def one_way_clutch(p: Numbers) -> Setup:
    """Two inertias with a one-way clutch between them, which is pressed at times."""
    params = {"J": jnp.stack([p["J1"], p["J2"]]), "torque": p["torque"]}
    params["pressed"] = jms.Signal([0.0, 0.3, 0.95, 1.6], [0.0, 1.0, 0.0, 1.0])
    drive = jms.AppliedForce(lambda t, q, qd, p: p["torque"] * jnp.sin(6 * jnp.pi * t) * jnp.array([1.0, 0.0]))
    grip = p["mu"] * p["capacity"]
    scene = jms.Scene(inertias, params, (drive, freewheel(grip, 25.0 * grip, "pressed")))
    return Setup(scene, np.zeros(2), np.array([-0.5, 0.0]))


def one_way_clutch_disengaged(p: Numbers) -> Setup:
    """The same without pressing, against a load."""

    def forces(t, q, qd, p):
        return jnp.stack([p["load"] + p["torque"] * jnp.sin(4 * jnp.pi * t), -p["load"]])

    params = {"J": jnp.stack([p["J1"], p["J2"]]), "torque": p["torque"], "load": p["load"], "pressed": 0.0}
    scene = jms.Scene(inertias, params, (jms.AppliedForce(forces), freewheel(1.5, 37.5, "pressed")))
    return Setup(scene, np.zeros(2), np.array([-0.5, 0.0]))


def lossy_gear(p: Numbers, *others) -> Setup:
    """A gear of ratio 2 with an efficiency, whose torque is that of the constraint."""

    def forces(t, q, qd, p):
        return jnp.stack([p["drive"] * jnp.sin(2 * jnp.pi * t), p["load"] * (0.25 * t - 1.0)])

    teeth = jms.Geared(jms.Coulomb(0.0), 1.0 / p["eta"] - 1.0, "mesh", 1.0 - p["eta"])
    gear = jms.Friction(teeth, along=lambda q: q[0], name="gear")
    mesh = jms.Constraint(lambda t, q, p: q[0] - 2.0 * q[1], name="mesh")
    params = {"J": jnp.stack([p["J1"], p["J2"]]), "drive": p["drive"], "load": p["load"]}
    scene = jms.Scene(inertias, params, (jms.AppliedForce(forces), gear, *others), constraints=(mesh,))
    return Setup(scene, np.zeros(2), np.zeros(2))


def lossy_gear_demo2(p: Numbers) -> Setup:
    """The same with friction in a bearing."""
    law = jms.Stribeck(Fc=p["bearing"], Fs=p["bearing"], vs=1.0, Fv=p["bearing"])
    return lossy_gear(p, jms.Friction(law, along=lambda q: q[0], name="bearing"))


def lossy_gear_demo3(p: Numbers) -> Setup:
    """Two inertias that turn and stop, with a bearing on either side of a gear with an efficiency of a quarter."""
    teeth = jms.Friction(jms.Geared(jms.Coulomb(0.0), 3.0, "mesh", 0.75), along=lambda q: q[0], name="gear")
    bearings = [
        jms.Friction(jms.Coulomb(p["bearing"]), along=lambda q, i=i: q[i], name=f"bearing{i + 1}") for i in (0, 1)
    ]
    load = jms.AppliedForce(lambda t, q, qd, p: jnp.stack([jnp.zeros_like(p["load"]), p["load"]]))
    mesh = jms.Constraint(lambda t, q, p: q[0] - q[1], name="mesh")
    params = {"J": jnp.stack([p["J1"], p["J2"]]), "load": jms.Signal([0.0, 0.5], [0.0, 1.0])}
    scene = jms.Scene(inertias, params, (load, teeth, *bearings), constraints=(mesh,))
    return Setup(scene, np.zeros(2), np.full(2, 10.0))


def gap_force(u, rate, c, d):
    """Force of a spring and damper that acts for u > 0; the force of the damper is at most that of the spring."""
    return jnp.where(u > 0, c * u + jnp.clip(d * rate, -c * u, c * u), 0.0)


def backlash(p: Numbers) -> Setup:
    """Two inertias on springs with dampers, the first one with play."""

    def forces(t, q, qd, p):
        c, d, half = p["c"], p["d"], 0.5 * p["b"]
        push = gap_force(-q[0] - half, -qd[0], c, d) - gap_force(q[0] - half, qd[0], c, d)
        return jnp.stack([push, -c * q[1] - d * qd[1]])

    params = {name: p[name] for name in ("c", "d", "b")} | {"J": jnp.stack([p["J"], p["J"]])}
    return Setup(jms.Scene(inertias, params, (jms.AppliedForce(forces),)), np.full(2, np.pi / 2), np.zeros(2))


def eddy_current_brake(p: Numbers) -> Setup:
    """A brake that heats itself by the kinetic energy that is gone."""

    def force(t, q, qd, p):
        heat = 0.5 * p["J"][0] * (400.0 - qd[0] ** 2)
        x = qd[0] / (p["speed"] * (1.0 + p["coefficient"] * heat / p["capacity"]))
        return (-2.0 * p["torque"] * x / (1.0 + x * x))[None]

    params = {name: p[name] for name in ("torque", "speed", "capacity", "coefficient")} | {"J": p["J"][None]}
    return Setup(jms.Scene(inertias, params, (jms.AppliedForce(force),)), np.zeros(1), np.array([20.0]))


def simple_gear_shift(p: Numbers) -> Setup:
    """A planetary gear shifted by a brake on its ring and a clutch; coordinates are the angles of sun and ring."""

    def carrier(x, p):
        return (x[0] + p["ratio"] * x[1]) / (1.0 + p["ratio"])

    def lagrangian(t, q, qd, p):
        return 0.5 * (p["engine"] * qd[0] ** 2 + p["load"] * carrier(qd, p) ** 2)

    def forces(t, q, qd, p):
        drag = p["drag"] * (carrier(qd, p) / 10.471975511966) ** 2 / (1.0 + p["ratio"])
        return jnp.stack([p["torque"] * p["on"] - drag, -p["ratio"] * drag])

    params = dict(p) | {"on": jms.Signal([0.0, 0.5], [0.0, 1.0])}
    params["share"] = jms.Signal([0.0, 2.0, 2.1], [0.0, 0.0, 1.0], linear=True)
    clutch = jms.Friction(
        jms.Coulomb(1.0), along=between(1), normal_force=lambda t, q, qd, p: p["capacity"] * p["share"], name="clutch"
    )
    brake = jms.Friction(
        jms.Coulomb(1.0),
        along=lambda q: q[1],
        normal_force=lambda t, q, qd, p: p["capacity"] * (1.0 - p["share"]),
        name="brake",
    )
    scene = jms.Scene(lagrangian, params, (jms.AppliedForce(forces), clutch, brake))
    return Setup(scene, np.zeros(2), np.zeros(2))


_ONE_WAY = ("inertiaIn.phi [rad]", "inertiaIn.w [rad/s]", "phi_rel [rad]", "w_rel [rad/s]")
_INERTIA_2 = ("Inertia2.phi [rad]", "Inertia2.w [rad/s]")


def _relative(q, qd):
    return q[0], qd[0], q[1] - q[0], qd[1] - qd[0]


def _second(q, qd):
    return q[1], qd[1]


CASES = (
    modelica_case(
        "Rotational.CoupledClutches", coupled_clutches,
        {"J1": 1.0, "J2": 1.0, "J3": 1.0, "J4": 1.0, "capacity": 20.0, "mu": 0.5, "peak": 1.1, "torque": 10.0}, 1.5,
        ("J1.phi [rad]", "J1.w [rad/s]", "clutch1.phi_rel [rad]", "clutch2.phi_rel [rad]", "clutch3.phi_rel [rad]",
         "clutch1.w_rel [rad/s]"),
        lambda q, qd: (q[0], qd[0], q[1] - q[0], q[2] - q[1], q[3] - q[2], qd[1] - qd[0]),
        (7.4860921838966794, 3.2470345652406571, -3.3789424987018508, -1.3966728682610889, -1.5367256646014142,
         -0.78382696434297217),
        references.coupled_clutches, by=("capacity", "mu", "J2"), options={"rtol": 1e-13, "atol": 1e-15},
        modes=((0.709621463833, "clutch2 stick"), (0.79165828432, "clutch1 stick"), (0.83110850627, "clutch1 backward"),
               (0.906849137544, "clutch1 stick"), (1.00029586011, "clutch1 backward"),
               (1.14396963043, "clutch3 stick")),
    ),
    modelica_case(
        "Rotational.Friction", friction,
        {"J1": 1.0, "J2": 0.05, "J3": 1.0, "capacity": 160.0, "brake": 1600.0, "c": 160.0, "d": 1.0, "torque": 200.0},
        3.0,
        ("clutch.phi_rel [rad]", "inertia3.phi [rad]", "inertia3.w [rad/s]", "spring.phi_rel [rad]",
         "spring.w_rel [rad/s]"),
        lambda q, qd: (q[1] - q[0], q[0], qd[0], q[2] - q[1], qd[2] - qd[1]),
        (-47.210622017430047, 101.56499939089694, 2.289890998276737, 0.1959851558674667, -2.289890998276777),
        references.friction, by=("capacity", "brake", "J2"),
        modes=((0.00677970899984, "clutch stick"), (0.0593400563591, "clutch backward"),
               (0.109289495222, "clutch stick"), (0.534248645375, "clutch backward"), (0.640613805353, "brake stick"),
               (1.66363978373, "clutch stick")),
    ),
    modelica_case(
        "Rotational.OneWayClutch", one_way_clutch,
        {"J1": 1.0, "J2": 1.0, "capacity": 3.0, "mu": 0.5, "torque": 10.0}, 2.0,
        _ONE_WAY, _relative,
        (-0.21233087268389922, -0.24997891423672405, 0.48573261789939198, -5.1443863131176207e-16),
        references.one_way_clutch, by=("capacity", "mu", "J2"),
        note="Up to 100 N m hold against backward slip, where Modelica has no limit.",
    ),
    modelica_case(
        "Rotational.OneWayClutchDisengaged", one_way_clutch_disengaged,
        {"J1": 1.0, "J2": 1.0, "load": 0.3, "torque": 10.0}, 2.0,
        _ONE_WAY, _relative,
        (-0.31287750498835681, -0.97145839861444794, 1.2173496429705832, 1.4429789225677909),
        references.one_way_clutch_disengaged, by=("load", "J1", "J2"),
        note="As before.",
    ),
    modelica_case(
        "Rotational.LossyGearDemo1", lossy_gear, {"J1": 1.0, "J2": 1.5, "eta": 0.5, "drive": 10.0, "load": 10.0}, 0.5,
        _INERTIA_2, _second, (1.6621687167841887e-05, -0.016261924038578124),
        references.lossy_gear_demo1, by=("eta", "J1", "J2"),
        modes=((0.0804771289481, "gear stick"), (0.199519900848, "gear forward"), (0.371342745024, "gear stick"),
               (0.464539461637, "gear backward")),
    ),
    modelica_case(
        "Rotational.LossyGearDemo2", lossy_gear_demo2,
        {"J1": 1.0, "J2": 1.5, "eta": 0.5, "drive": 10.0, "load": 10.0, "bearing": 0.5}, 0.5,
        _INERTIA_2, _second, (-0.00058918332306942534, -0.0096242780930112012),
        references.lossy_gear_demo2, by=("eta", "bearing", "J1"),
        modes=((0.0635911045847, "gear stick"), (0.230374015885, "gear forward"), (0.308306846101, "gear stick"),
               (0.456242660485, "gear backward"), (0.472738310501, "bearing backward")),
        note="At rest gear and bearing hold together, and their shares are not unique.",
    ),
    modelica_case(
        "Rotational.LossyGearDemo3", lossy_gear_demo3, {"J1": 1e-3, "J2": 1e-3, "bearing": 0.5}, 1.0,
        _INERTIA_2, _second, (0.099999999016922012, -1.0000009709187907e-09),
        references.lossy_gear_demo3, by=("bearing",), modes=((0.020000000002, "gear stick"),),
        note="As before. By one inertia alone the torque between the teeth has a kink at zero: no derivative.",
    ),
    modelica_case(
        "Rotational.Backlash", backlash, {"J": 5.0, "c": 20e3, "d": 50.0, "b": 0.7853981633974483}, 1.0,
        ("elastoBacklash.phi_rel [rad]", "elastoBacklash.w_rel [rad/s]", "springDamper.phi_rel [rad]",
         "springDamper.w_rel [rad/s]"),
        lambda q, qd: (q[0], qd[0], q[1], qd[1]),
        (-0.15557036723690312, -7.0229304031262032, 0.010518034816392985, -0.14370331391695884),
        references.backlash, by=("c", "d", "b"),
    ),
    modelica_case(
        "Rotational.EddyCurrentBrake", eddy_current_brake,
        {"J": 1.0, "torque": 100.0, "speed": 10.0, "capacity": 1.0, "coefficient": 3.92e-3}, 1.0,
        ("inertia.phi [rad]", "heatCapacitor.T [K]"),
        lambda q, qd: (q[0], 293.15 + 0.5 * (400.0 - qd[0] ** 2)),
        (2.5622780615885228, 493.14984771874254), references.eddy_current_brake, by=("torque", "coefficient"),
    ),
    modelica_case(
        "Rotational.SimpleGearShift", simple_gear_shift,
        {"engine": 1.0, "load": 10.0, "ratio": 1.5, "capacity": 100.0, "torque": 20.0, "drag": 20.0}, 5.0,
        ("clutch.phi_rel [rad]", "engine.phi [rad]", "engine.w [rad/s]", "load.phi [rad]", "load.w [rad/s]"),
        lambda q, qd: (q[1] - q[0], q[0], qd[0], (q[0] + 1.5 * q[1]) / 2.5, (qd[0] + 1.5 * qd[1]) / 2.5),
        (-9.5159634821341577, 29.074823481107469, 8.0900299437797401, 23.365245391826978, 8.0900299437797596),
        references.simple_gear_shift, by=("capacity", "load", "drag"),
        modes=((2.04081635816, "brake forward"), (2.11079037915, "clutch stick")),
    ),
)  # fmt: skip
