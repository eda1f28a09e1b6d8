"""Cases of other simulators with friction or impacts: EXUDYN, nosnoc, Chrono, Siconos."""

import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp

import jaxmodsim as jms
from bench.conformance.case import Case, Numbers, Reference, Setup
from bench.conformance.motion import Path, Wave, driven, integrated, linear
from jaxmodsim.friction import lorentzian

# Initial height of the centre of the rocking block [m]: a block of 1 m by 0.5 m stands on a corner at 60 degrees.
HEIGHT = 0.5 * np.sin(np.pi / 3.0) + 0.25 * np.cos(np.pi / 3.0)

BLOCK = "siconos/siconos-tutorials @ b6c9bfd1, examples/mechanics/RockingBlock/{}"
_BLOCK = ("y [m]", "angle [rad]", "dy/dt [m/s]", "rate [rad/s]")


def pulled_lugre(p: Numbers) -> Setup:
    """A mass pulled through a spring at 0.1 m/s, with LuGre friction."""

    def lagrangian(t, q, qd, p):
        return 0.5 * p["m"] * qd[0] ** 2 - 0.5 * p["k"] * (0.1 * t - q[0]) ** 2

    law = jms.LuGre(sigma0=1e5, sigma1=np.sqrt(1e5), sigma2=p["sigma2"], Fc=p["Fc"], Fs=p["Fs"], vs=1e-3)
    return Setup(jms.Scene(lagrangian, {"m": p["m"], "k": p["k"]}, (jms.Friction(law),)), np.zeros(1), np.zeros(1))


def exact_pulled_lugre(m, k, sigma2, Fc, Fs) -> Reference:
    """The three equations by hand, by Radau of SciPy at 1e-11."""
    sigma0, sigma1 = 1e5, np.sqrt(1e5)

    def field(t, y):
        level = Fc + (Fs - Fc) * np.exp(-((y[1] / 1e-3) ** 2))
        rate = y[1] - sigma0 * abs(y[1]) / level * y[2]
        return [y[1], (k * (0.1 * t - y[0]) - sigma0 * y[2] - sigma1 * rate - sigma2 * y[1]) / m, rate]

    done = solve_ivp(field, (0.0, 25.0), [0.0] * 3, "Radau", rtol=1e-11, atol=1e-15)
    return Reference(done.y[:2, -1], [])


def two_balls(p: Numbers) -> Setup:
    """Two balls on a line under gravity, joined by a spring; the lower one bounces."""

    def lagrangian(t, q, qd, p):
        spring = 0.5 * p["k"] * (q[1] - q[0] - 1.0) ** 2
        return 0.5 * jnp.sum(qd**2) - p["g"] * jnp.sum(q) - spring

    ground = jms.Contact(lambda t, q, p: q[0] - 0.2, restitution=p["e"], name="ground")
    scene = jms.Scene(lagrangian, {"k": p["k"], "g": p["g"]}, constraints=(ground,))
    return Setup(scene, np.array([1.0, 2.0]), np.zeros(2))


def exact_two_balls(k, g, e) -> Reference:
    """Exponentials of a matrix from impact to impact."""
    stiff = k * np.array([[-1.0, 1.0], [1.0, -1.0]])
    a = np.block([[np.zeros((2, 2)), np.eye(2)], [stiff, np.zeros((2, 2))]])
    piece = linear(a, np.array([0.0, 0.0, -g - k, -g + k]))
    path = Path([1.0, 2.0, 0.0, 0.0])
    while path.to_zero(piece, lambda t, y: y[0] - 0.2, 1.0, "ground open"):
        path.y[2] *= -e
    return Reference(path.y, path.events)


def slip_stick(p: Numbers) -> Setup:
    """A mass on a spring on a belt at 0.2 m/s, with friction that falls as 1/(1 + |v|)."""

    def lagrangian(t, q, qd, p):
        return 0.5 * p["m"] * qd[0] ** 2 - 0.5 * p["k"] * q[0] ** 2

    law = jms.Stribeck(Fc=0.0, Fs=p["Fs"], vs=1.0, exponent=1.0, fall=lorentzian)
    belt = jms.Friction(law, belt_velocity=0.2, name="belt")
    return Setup(jms.Scene(lagrangian, {"m": p["m"], "k": p["k"]}, (belt,)), np.array([-0.8]), np.array([-1.0]))


def exact_slip_stick(m, k, Fs) -> Reference:
    """Slip on either side of the belt's velocity, and stick up to Fs."""

    def slip(sign):
        return integrated(lambda t, y: np.array([y[1], (-k * y[0] - sign * Fs / (1.0 + sign * (y[1] - 0.2))) / m]))

    path, sign = Path([-0.8, -1.0]), -1.0
    while path.to_zero(slip(sign), lambda t, y: y[1] - 0.2, 40.0):
        path.y[1] = 0.2
        if abs(k * path.y[0]) < Fs:
            path.log("belt stick")
            carried = driven([([0.0], Wave(0.0))])
            if not path.to_zero(carried, lambda t, y: k * y[0] - Fs, 40.0):
                break
        sign = -1.0 if path.y[0] > 0 else 1.0
        path.log("belt backward" if sign < 0 else "belt forward")
    return Reference(path.y, path.events)


def sliding_box(p: Numbers) -> Setup:
    """A box slides on a plate until it stops."""

    def lagrangian(t, q, qd, p):
        return 0.5 * p["m"] * jnp.sum(qd**2) - p["m"] * p["g"] * q[1]

    plate = jms.Contact(lambda t, q, p: q[1], name="plate")
    slip = jms.Friction(jms.Coulomb(p["mu"]), along=lambda q: q[0], normal_force="plate", name="box")
    scene = jms.Scene(lagrangian, {"m": p["m"], "g": p["g"]}, (slip,), constraints=(plate,))
    return Setup(scene, np.zeros(2), jnp.stack([p["v"], 0.0 * p["v"]]))


def exact_sliding_box(m, g, mu, v) -> Reference:
    """Constant deceleration, whatever the mass."""
    return Reference(np.array([0.5 * v**2 / (mu * g), 0.0 * m]), [(v / (mu * g), "box stick")])


def impacting_stick(p: Numbers) -> Setup:
    """A stick whose lower end strikes a floor with friction; coordinates are its centre and its angle."""

    def lagrangian(t, q, qd, p):
        return 0.5 * p["m"] * (qd[0] ** 2 + qd[1] ** 2 + p["length"] ** 2 / 12.0 * qd[2] ** 2) - p["m"] * p["g"] * q[1]

    floor = jms.Contact(lambda t, q, p: q[1] - 0.5 * p["length"] * jnp.cos(q[2]), restitution=p["e"], name="floor")

    def end(q, p):
        return q[0] + 0.5 * p["length"] * jnp.sin(q[2])

    slip = jms.Friction(jms.Coulomb(p["mu"]), along=end, normal_force="floor", name="end")
    scene = jms.Scene(lagrangian, {name: p[name] for name in ("m", "length", "g")}, (slip,), constraints=(floor,))
    q0 = np.array([0.5 * np.sin(np.pi / 4), 0.5 * np.cos(np.pi / 4) + 0.01, np.pi / 4])
    return Setup(scene, q0, np.array([-0.5, 0.1, 0.1]))


def exact_impacting_stick(m, length, g, e, mu) -> Reference:
    """Free flight, and impacts whose friction is that of the slip after them."""
    inertia, half = m * length**2 / 12.0, 0.5 * length
    path = Path([0.5 * np.sin(np.pi / 4), 0.5 * np.cos(np.pi / 4) + 0.01, np.pi / 4, -0.5, 0.1, 0.1])
    flight = driven([([0.0, -1.0, 0.0], Wave(g))])
    while path.to_zero(flight, lambda t, y: y[1] - half * np.cos(y[2]), 0.2, "floor open"):
        sin, cos = half * np.sin(path.y[2]), half * np.cos(path.y[2])
        normal, along = np.array([0.0, 1.0, sin]), np.array([1.0, 0.0, cos])
        mass, v = np.array([m, m, inertia]), path.y[3:]
        pushes = [(normal - sign * mu * along) / mass for sign in (1.0, -1.0)]
        after = [v - (1.0 + e) * (normal @ v) / (normal @ push) * push for push in pushes]
        path.y[3:] = next(w for sign, w in zip((1.0, -1.0), after, strict=True) if sign * (along @ w) > 0)
    return Reference(path.y, path.events)


def rocking_block(p: Numbers) -> Setup:
    """A block that falls on the corners of its lower side, free of friction; coordinates are its height and angle."""

    def lagrangian(t, q, qd, p):
        return 0.5 * (p["m"] * qd[0] ** 2 + p["J"] * qd[1] ** 2) - p["m"] * p["g"] * q[0]

    def corner(side):
        return lambda t, q, p: q[0] + 0.5 * (side * p["length"] * jnp.sin(q[1]) - p["height"] * jnp.cos(q[1]))

    contacts = [jms.Contact(corner(i), restitution=p["e"], name=name) for i, name in ((-1.0, "left"), (1.0, "right"))]
    params = {name: p[name] for name in ("m", "J", "g", "length", "height")}
    scene = jms.Scene(lagrangian, params, constraints=contacts)
    return Setup(scene, np.array([HEIGHT, np.pi / 3.0]), np.zeros(2))


def flat_block(p: Numbers) -> Setup:
    """The block falls flat, and both corners strike at once."""
    return rocking_block(p)._replace(q0=np.array([0.5, 0.0]))


def exact_rocking_block(m, J, g, length, height, e, step=0.0) -> Reference:
    """Free flight in closed form, and an impact of one corner at a time; with a `step`, impulses are its multiples."""
    sides, mass = np.array([-1.0, 1.0]), np.array([m, J])
    path = Path([HEIGHT, np.pi / 3.0, 0.0, 0.0])
    flight = driven([([-1.0, 0.0], Wave(g))])

    def gaps(t, y):
        return y[0] + 0.5 * (sides * length * np.sin(y[1]) - height * np.cos(y[1]))

    while (i := path.to_first(flight, gaps, 2.0)) is not None:
        arm = 0.5 * (sides[i] * length * np.cos(path.y[1]) + height * np.sin(path.y[1]))
        normal, v = np.array([1.0, arm]), path.y[2:]
        impulse = -(1.0 + e) * (normal @ v) / (normal / mass @ normal)
        path.y[2:] = v + (np.ceil(impulse / step) * step if step else impulse) * normal / mass
        path.log(("left open", "right open")[i])
    return Reference(path.y, path.events)


def exact_flat_block(m, J, g, length, height, e) -> Reference:
    """A bouncing ball."""
    path = Path([0.5, 0.0, 0.0, 0.0])
    while path.to_zero(driven([([-1.0, 0.0], Wave(g))]), lambda t, y: y[0] - 0.5 * height, 2.0):
        path.log("left open", "right open")
        path.y[2] *= -e
    return Reference(path.y, path.events)


def exact_block_on_a_corner(m, J, g, length, height, e) -> Reference:
    """The left corner slides on the ground, and the right one bounces from it: an equation of the angle alone.

    At an impact of the right corner, Newton's law keeps the left one at rest: its impulse is positive for
    `m length^2 > 4 J`, as that of the right one pushes it down.
    """

    def slopes(angle):
        sin, cos = np.sin(angle), np.cos(angle)
        return 0.5 * (length * cos - height * sin), -0.5 * (length * sin + height * cos)

    def field(t, y):
        first, second = slopes(y[0])
        return np.array([y[1], -m * first * (second * y[1] ** 2 + g) / (J + m * first**2)])

    path = Path([np.pi / 3.0, 0.0])
    while path.to_zero(integrated(field), lambda t, y: y[0], 1.2, "right open"):
        path.y[:] = 0.0, -e * path.y[1]
    angle, rate = path.y
    centre = 0.5 * (length * np.sin(angle) + height * np.cos(angle))
    return Reference(np.array([centre, angle, slopes(angle)[0] * rate, rate]), path.events)


def _end(q, qd):
    return q[0], qd[0]


CASES = (
    Case(
        "EXUDYN lugreFrictionTest", "jgerstmayr/EXUDYN @ e44aca1b, main/pythonDev/Examples/lugreFrictionTest.py",
        pulled_lugre, {"m": 1.0, "k": 2.0, "sigma2": 0.4, "Fc": 1.0, "Fs": 1.5}, 25.0, ("x [m]", "v [m/s]"), _end,
        (1.908839199226505, 9.424154590959904e-06), exact_pulled_lugre, by=("k", "Fc", "Fs"),
        options={"atol": 1e-15, "rtol": 1e-11},
        note="Published: DOPRI5 with steps of 50 us. Reference: Radau of SciPy, whose own error is about 1e-10.",
    ),
    Case(
        "nosnoc two_balls_cls", "nosnoc/nosnoc @ 0abef401, benchmarks/two_balls_cls/two_balls_spring_matlab.m",
        two_balls, {"k": 1e4, "g": 9.81, "e": 0.8}, 1.0, ("q1 [m]", "q2 [m]", "v1 [m/s]", "v2 [m/s]"),
        lambda q, qd: (*q, *qd), (), exact_two_balls, by=("e", "k", "g"),
        note="The repository compares with ode15s and has no numbers.",
    ),
    Case(
        "nosnoc periodic_slip_stick_codim1",
        "nosnoc/nosnoc @ 0abef401, examples/periodic_slip_stick/periodic_slip_stick_codim1.m",
        slip_stick, {"m": 1.0, "k": 1.0, "Fs": 1.0}, 40.0, ("x1 [m]", "x2 [m/s]"), _end, (), exact_slip_stick,
        by=("m", "k", "Fs"), note="The repository has figures, and no numbers.",
    ),
    Case(
        "Chrono SlidingGravityTest",
        "projectchrono/chrono @ 7689fbc0, src/tests/unit_tests/smc_contact/sequential/utest_SMC_sliding_gravity.cpp",
        sliding_box, {"m": 1.0, "g": 9.81, "mu": 0.5, "v": 5.0}, 2.0, ("travel [m]", "v [m/s]"), _end,
        (25.0 / 9.81, None), exact_sliding_box, by=("mu", "v", "g"), compared=("box",),
        note="Published: the closed form. The test accepts an error of 0.5 %, with contacts as springs and dampers.",
    ),
    Case(
        "Siconos ImpactingStick",
        "siconos/siconos-tutorials @ b6c9bfd1, examples/mechanics/ImpactingStick/ImpactingStick.cpp",
        impacting_stick, {"m": 1.0, "length": 1.0, "g": 10.0, "e": 1.0, "mu": 0.01}, 0.2,
        ("x [m]", "y [m]", "angle [rad]", "dx/dt [m/s]", "dy/dt [m/s]", "rate [rad/s]"), lambda q, qd: (*q, *qd),
        (2.529172311983667e-01, 2.471693300826099e-01, 1.081891493988364, -5.068672606709300e-01, -1.213273932906967,
         3.212070578753687), exact_impacting_stick, by=("g", "e", "mu"), compared=("floor",),
        results="siconos/siconos-tutorials @ b6c9bfd1, examples/mechanics/ImpactingStick/ImpactingStick.ref",
        note="Published: Moreau-Jean time-stepping of first order with steps of 0.1 ms.",
    ),
    Case(
        "Siconos RockingBlock",
        BLOCK.format("RockingBlockED_Lsodar_LZBimpact.cpp"),
        rocking_block, {"m": 1.0, "J": 1.25 / 12.0, "g": 9.81, "length": 0.2, "height": 0.1, "e": 0.8}, 2.0,
        _BLOCK, lambda q, qd: (*q, *qd),
        (0.06718552403460872, -2.093984548445607, 0.07069999999445728, -4.152292733753275), exact_rocking_block,
        by=("g", "J", "e"),
        modes=((0.3016807020283281, "left open"), (0.7850142235821842, "left open"), (1.178736161714749, "left open"),
               (1.41752252299837, "right open"), (1.64974638740134, "right open"), (1.835747166785115, "right open"),
               (1.989038206431418, "right open")),
        results=BLOCK.format("RockingBlockED_Lsodar_LZBimpact.ref"),
        note="Published: LSODAR from impact to impact, with impulses in steps of 5e-5 N s. The mass and the inertia are"
             " those of a block of 1 m by 0.5 m, and the corners those of a block of 0.2 m by 0.1 m.",
    ),
    Case(
        "Siconos RockingBlock, flat", BLOCK.format("RockingBlockED.cpp"), flat_block,
        {"m": 1.0, "J": 0.05 / 12.0, "g": 9.81, "length": 0.2, "height": 0.1, "e": 0.9}, 2.0,
        _BLOCK, lambda q, qd: (*q, *qd), (), exact_flat_block, by=("g", "e", "height"),
        note="The repository has no results of this one.",
    ),
    Case(
        "Siconos RockingBlock, on a corner", BLOCK.format("RockingBlockED_Lsodar_LZBimpact.cpp"), rocking_block,
        {"m": 1.0, "J": 1.25 / 12.0, "g": 9.81, "length": 1.0, "height": 0.5, "e": 0.8}, 1.2,
        _BLOCK, lambda q, qd: (*q, *qd), (), exact_block_on_a_corner, by=("m", "g", "e"),
        modes=((0.5874779745738901, "right open"),), results=BLOCK.format("resultED_LZBmodel_LsodarOSI.ref"),
        note="Published: the first impact, and afterwards another law, by which the impact lifts the resting corner.",
    ),
)  # fmt: skip
