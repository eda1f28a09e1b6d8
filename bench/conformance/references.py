"""References of the Modelica examples with rotation: event by event, in closed form wherever one exists.

Each returns the outputs of the case of its name, and the events. They use `motion.py`, NumPy and SciPy alone.
"""

import numpy as np

from bench.conformance.case import Reference
from bench.conformance.motion import Path, Wave, driven, integrated, linear, switched

TWO_PI = 2.0 * np.pi


def _chain(inertia, drive, slip, stuck):
    """Accelerations of inertias in a row, with clutches between neighbours, and the torques of the stuck clutches.

    `drive`: torques on the inertias. `slip`: torques of the clutches in slip, positive against positive slip (that of
    the later inertia relative to the one before). `stuck`: indices of clutches without slip.
    """
    n = len(inertia)
    rows = np.eye(n)[1:] - np.eye(n)[:-1]
    free = (drive - rows.T @ slip) / inertia
    torque = np.zeros(n - 1)
    if stuck:
        held = rows[list(stuck)]
        torque[list(stuck)] = np.linalg.solve(held / inertia @ held.T, held @ free)
    return free - rows.T @ torque / inertia, torque


def coupled_clutches(j1, j2, j3, j4, capacity, mu, peak, torque) -> Reference:
    """Four inertias, three clutches; torques are functions of time alone, so that all speeds are integrals of sines."""
    inertia = np.array([j1, j2, j3, j4])
    # Terms: the driving torque, the fading capacity of clutch 1, the constant capacity of clutches 2 and 3.
    waves = [Wave(torque, 5.0 * TWO_PI), Wave(mu * capacity, 0.2 * TWO_PI, np.pi / 2), Wave(mu * capacity)]
    drives = [np.array([1.0, 0, 0, 0]), np.zeros(4), np.zeros(4)]
    unit = ([0, 1], [1, 2], [2, 2])  # clutch: (its row, its term)

    def terms(signs, stuck):
        found = [_chain(inertia, drives[k], np.array([s * (unit[i][1] == k) for i, s in enumerate(signs)]), stuck)
                 for k in range(3)]  # fmt: skip
        return driven([(a, w) for (a, _), w in zip(found, waves, strict=True)]), [f for _, f in found]

    def slip(i):
        return lambda t, y: y[4 + i] - y[3 + i]

    def over(forces, i, limit, sign):
        """Torque of clutch i beyond its limit."""
        return lambda t, y: sign * sum(f[i - 1] * w.value(t) for f, w in zip(forces, waves, strict=True)) - limit(t)

    def stiction(t):
        return peak * waves[1].value(t)

    path = Path([0.0] * 4 + [10.0, 0.0, 0.0, 0.0])
    path.until(terms((-1, 0, 0), ())[0], 0.4, "clutch3 backward")
    path.to_zero(terms((-1, -1, 0), ())[0], slip(2), 0.9, "clutch2 stick")
    path.to_zero(terms((-1, 0, 0), (1,))[0], slip(1), 0.9, "clutch1 stick")
    piece, forces = terms((0, 0, 0), (0, 1))
    path.to_zero(piece, over(forces, 1, stiction, -1.0), 0.9, "clutch1 backward")
    path.until(terms((-1, 0, 0), (1,))[0], 0.9)
    path.to_zero(terms((-1, 0, -1), (1,))[0], slip(1), 1.25, "clutch1 stick")
    piece, forces = terms((0, 0, -1), (0, 1))
    path.to_zero(piece, over(forces, 1, stiction, -1.0), 1.25, "clutch1 backward")
    path.to_zero(terms((-1, 0, -1), (1,))[0], slip(3), 1.25, "clutch3 stick")
    path.until(terms((-1, 0, 0), (1, 2))[0], 1.25)
    path.until(terms((0, 0, 0), (1, 2))[0], 1.5)
    q, w = path.y[:4], path.y[4:]
    return Reference(np.array([q[0], w[0], *np.diff(q), w[1] - w[0]]), path.events)


def friction(j1, j2, j3, capacity, brake, c, d, torque) -> Reference:
    """Motor, clutch, spring, brake, inertia: a linear system in each set of modes."""
    path = Path([0.0, 0.0, 0.0, 100.0, 90.0, 90.0])  # phi3, phi2, phi1, w3, w2, w1

    def piece(stuck, clutch=0.0, braking=0.0, motor=True, held=False):
        """`stuck`: the clutch; `clutch`, `braking`: torques in slip; `held`: the brake."""
        mass = np.diag([j3, j2, j1])
        stiff = np.array([[0.0, 0, 0], [0, 1, -1], [0, -1, 1]])
        keep = np.eye(3)
        if stuck:
            keep[:, :2] = 0.5 * keep[:, :2].sum(axis=1, keepdims=True)
            total = j3 + j2
            inverse = np.array([[1 / total, 1 / total, 0], [1 / total, 1 / total, 0], [0, 0, 1 / j1]])
        else:
            inverse = np.linalg.inv(mass)
        if held:
            inverse[2, 2] = 0.0
        a = np.zeros((6, 6))
        a[:3, 3:] = np.eye(3)
        a[3:, :3], a[3:, 3:] = -c * inverse @ stiff, -d * inverse @ stiff
        constant = np.concatenate([np.zeros(3), inverse @ np.array([clutch, -clutch, -braking])])
        sine = np.concatenate([np.zeros(3), inverse @ np.array([torque if motor else 0.0, 0.0, 0.0])])
        return linear(a, constant, sine=sine, omega=100.0)

    def held_torque(t, y, motor):
        """Torque of the stuck clutch against positive slip of inertia 2 relative to inertia 3."""
        spring = c * (y[1] - y[2]) + d * (y[4] - y[5])
        drive = torque * np.sin(100.0 * t) if motor else 0.0
        return (-spring * j3 - drive * j2) / (j2 + j3)

    grip = 0.5 * capacity
    path.to_zero(piece(False, -grip), lambda t, y: y[4] - y[3], 0.5, "clutch stick")
    path.to_zero(piece(True), lambda t, y: held_torque(t, y, True) + grip, 0.5, "clutch backward")
    path.to_zero(piece(False, -grip), lambda t, y: y[4] - y[3], 0.5, "clutch stick")
    path.until(piece(True), 0.5)
    stop = 0.5 * brake
    path.to_zero(piece(True, 0, stop, False), lambda t, y: held_torque(t, y, False) + grip, 3.0, "clutch backward")
    path.to_zero(piece(False, -grip, stop, False), lambda t, y: y[5], 3.0, "brake stick")
    path.y[5] = 0.0
    path.to_zero(piece(False, -grip, 0.0, False, True), lambda t, y: y[4] - y[3], 3.0, "clutch stick")
    path.until(piece(True, 0.0, 0.0, False, True), 3.0)
    phi, w = path.y[:3], path.y[3:]
    return Reference(np.array([phi[1] - phi[0], phi[0], w[0], phi[2] - phi[1], w[2] - w[1]]), path.events)


def one_way_clutch(j1, j2, capacity, mu, torque) -> Reference:
    """A freewheel beside a clutch that is pressed from 0.3 s to 0.95 s and from 1.6 s on."""
    wave, grip = Wave(torque, 3.0 * TWO_PI), Wave(mu * capacity)
    unloaded = driven([([1 / j1, 0.0], wave)])
    pressed = driven([([1 / j1, 0.0], wave), ([1 / j1, -1 / j2], grip)])
    held = driven([([1 / (j1 + j2)] * 2, wave)])

    def slip(t, y):
        return y[3] - y[2]

    def drive(t, y):
        return wave.value(t)

    path = Path([0.0, 0.0, -0.5, 0.0])
    path.to_zero(unloaded, slip, 0.3, "clutch stick")
    path.to_zero(held, drive, 0.3, "clutch forward")
    path.until(unloaded, 0.3)
    path.to_zero(pressed, slip, 0.95, "clutch stick")
    path.until(held, 0.95, "clutch forward")
    path.to_zero(unloaded, slip, 1.6, "clutch stick")
    path.to_zero(held, drive, 1.6, "clutch forward")
    path.until(unloaded, 1.6)
    path.to_zero(pressed, slip, 2.0, "clutch stick")
    path.until(held, 2.0)
    return Reference(np.array([path.y[0], path.y[2], path.y[1] - path.y[0], path.y[3] - path.y[2]]), path.events)


def one_way_clutch_disengaged(j1, j2, load, torque) -> Reference:
    """A freewheel between a driven inertia and a load."""
    wave, one = Wave(torque, 2.0 * TWO_PI), Wave(load)
    apart = driven([([1 / j1, 0.0], wave), ([1 / j1, -1 / j2], one)])
    held = driven([([1 / (j1 + j2)] * 2, wave)])

    def lock(t, y):
        """Torque that the locked freewheel takes, negative while it drives the load."""
        return -load - wave.value(t) * j2 / (j1 + j2)

    path = Path([0.0, 0.0, -0.5, 0.0])
    while path.t < 2.0:
        if path.to_zero(apart, lambda t, y: y[3] - y[2], 2.0, "clutch stick"):
            path.to_zero(held, lock, 2.0, "clutch forward")
    return Reference(np.array([path.y[0], path.y[2], path.y[1] - path.y[0], path.y[3] - path.y[2]]), path.events)


# A lossy gear of ratio r: J1 r w' = tau1 - lambda - F, J2 w' = r lambda + tau2 with the speed w of inertia 2, the
# torque lambda > 0 in the mesh, and F = k lambda: k = 1/eta - 1 if the gear drives (w > 0), and -(1 - eta) if it is
# driven.
def lossy_gear_demo1(j1, j2, eta, drive, load) -> Reference:
    """A gear with losses locks, drives and is driven; torques are functions of time alone."""
    wave, push = Wave(drive, TWO_PI), [Wave(-load), Wave(0.25 * load, power=1)]

    def factor(sign):
        return 0.5 * (1.0 / eta if sign > 0 else eta)

    def rolling(sign):
        k, rate = factor(sign), 1.0 / (2.0 * j1 + factor(sign) * j2)
        return driven([([rate], wave), *(([k * rate], each) for each in push)])

    def released(sign):
        return lambda t, y: wave.value(t) + factor(sign) * sum(each.value(t) for each in push)

    held = driven([([0.0], wave)])
    path = Path([0.0, 0.0])
    for sign, label in ((-1, ""), (1, "gear forward"), (-1, "gear backward")):
        if label:
            path.to_zero(held, released(sign), 0.5, label)
        if path.to_zero(rolling(sign), lambda t, y: y[1], 0.5, "gear stick"):
            path.y[1] = 0.0
    return Reference(path.y, path.events)


def lossy_gear_demo2(j1, j2, eta, drive, load, bearing) -> Reference:
    """The same with friction `bearing (1 + |w1|)` in the bearing of inertia 1: a linear system in each mode.

    At rest both elements hold, and no equation says which share of the torque each has. The one that lets go last
    begins the motion: the gear forwards, the bearing backwards.
    """

    def factor(sign):
        return 0.5 * (1.0 / eta if sign > 0 else eta)

    def rolling(sign):
        k = factor(sign)
        rate = 1.0 / (2.0 * j1 + k * j2)
        a = np.array([[0.0, 1.0], [0.0, -2.0 * bearing * rate]])
        constant = np.array([0.0, rate * (-k * load - sign * bearing)])
        return linear(a, constant, np.array([0.0, 0.25 * k * load * rate]), np.array([0.0, drive * rate]), TWO_PI)

    def released(sign):
        return lambda t, y: drive * np.sin(TWO_PI * t) - sign * bearing + factor(sign) * load * (0.25 * t - 1.0)

    held = driven([([0.0], Wave(0.0))])
    path = Path([0.0, 0.0])
    for sign, label in ((-1, ""), (1, "gear forward"), (-1, "bearing backward")):
        if label:
            path.to_zero(held, released(sign), 0.5, label)
        if path.to_zero(rolling(sign), lambda t, y: y[1], 0.5, "gear stick"):
            path.y[1] = 0.0
    return Reference(path.y, path.events)


def lossy_gear_demo3(j1, j2, bearing) -> Reference:
    """Equal inertias and bearings stop together, without a torque in the mesh; the later load does not move them."""
    stop = 10.0 * (j1 + j2) / (2.0 * bearing)
    return Reference(np.array([5.0 * stop, 0.0]), [(stop, "gear stick")])


def gap_force(u, rate, c, d):
    """Force of a spring and damper that acts for u > 0, whose damping is at most the force of the spring."""
    return np.where(u > 0, c * u + np.clip(d * rate, -c * u, c * u), 0.0)


def backlash(j, c, d, b) -> Reference:
    """An inertia on a spring and damper with play, released at 90 degrees, and one without play."""

    def guards(t, y):
        over = np.sign(y[0]) * y[0] - 0.5 * b
        return [y[0] - 0.5 * b, -y[0] - 0.5 * b, d * y[1] - c * over, d * y[1] + c * over]

    def field(t, y, signs):
        side = 1.0 if signs[0] > 0 else -1.0
        u, rate = side * y[0] - 0.5 * b, side * y[1]
        if signs[0] < 0 and signs[1] < 0:
            return np.array([y[1], 0.0])
        # Signs of d w - c u and d w + c u say whether the damping is limited above or below.
        above = signs[2] > 0 if side > 0 else signs[3] < 0
        below = signs[3] < 0 if side > 0 else signs[2] > 0
        damping = c * u if above else -c * u if below else d * rate
        return np.array([y[1], -side * (c * u + damping) / j])

    path = Path([np.pi / 2, 0.0])
    switched(path, field, guards, 1.0)
    plain = Path([np.pi / 2, 0.0])
    plain.until(linear(np.array([[0.0, 1.0], [-c / j, -d / j]]), np.zeros(2)), 1.0)
    return Reference(np.concatenate([path.y, plain.y]), [])


def eddy_current_brake(j, torque, speed, capacity, coefficient) -> Reference:
    """A brake that heats itself; its temperature follows from the energy."""

    def field(t, y):
        warm = 1.0 + coefficient * 0.5 * j * (400.0 - y[1] ** 2) / capacity
        x = y[1] / (speed * warm)
        return np.array([y[1], -2.0 * torque * x / (1.0 + x * x) / j])

    path = Path([0.0, 20.0])
    path.until(integrated(field), 1.0)
    heat = 293.15 + 0.5 * j * (400.0 - path.y[1] ** 2) / capacity
    return Reference(np.array([path.y[0], heat]), [])


def simple_gear_shift(engine, load, ratio, capacity, torque, drag) -> Reference:
    """A planetary gear, a brake on its ring, and a clutch between ring and sun, shifted from one to the other."""
    a = np.array([1.0, ratio]) / (1.0 + ratio)
    inverse = np.linalg.inv(np.diag([engine, 0.0]) + load * np.outer(a, a))
    speed = 10.471975511966

    def field(t, y, brake=0, clutch=0, held=None, on=1.0):
        """`brake`, `clutch`: signs of their slips. `held`: the direction that sticks. `on`: the motor."""
        share = min(max((t - 2.0) / 0.1, 0.0), 1.0)
        w = y[2:]
        f = np.array([torque * on, 0.0]) - drag * (a @ w / speed) ** 2 * a
        f = f - capacity * (clutch * share * np.array([-1.0, 1.0]) + brake * (1.0 - share) * np.array([0.0, 1.0]))
        acceleration = inverse @ f
        if held is not None:
            hold = (held @ acceleration) / (held @ inverse @ held)
            acceleration = acceleration - inverse @ held * hold
        return np.concatenate([w, acceleration])

    ring, both = np.array([0.0, 1.0]), np.array([-1.0, 1.0])

    def load_of_brake(t, y):
        free = field(t, y, clutch=-1)[2:]
        return ring @ free / (ring @ inverse @ ring) - capacity * (1.0 - (t - 2.0) / 0.1)

    path = Path([0.0] * 4)
    path.until(driven([([0.0, 0.0], Wave(0.0))]), 0.5, "clutch backward")
    path.until(integrated(lambda t, y: field(t, y, held=ring)), 2.0)
    path.to_zero(integrated(lambda t, y: field(t, y, clutch=-1, held=ring)), load_of_brake, 2.1, "brake forward")
    path.until(integrated(lambda t, y: field(t, y, brake=1, clutch=-1)), 2.1)
    path.to_zero(integrated(lambda t, y: field(t, y, clutch=-1)), lambda t, y: y[3] - y[2], 5.0, "clutch stick")
    path.until(integrated(lambda t, y: field(t, y, held=both)), 5.0)
    phi, w = path.y[:2], path.y[2:]
    return Reference(np.array([phi[1] - phi[0], phi[0], w[0], a @ phi, a @ w]), path.events)
