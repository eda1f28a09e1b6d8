"""References of the Modelica examples with masses on a line, by `motion.py`, NumPy and SciPy alone."""

import numpy as np

from bench.conformance.case import Reference
from bench.conformance.motion import Path, Wave, driven, integrated, linear, switched


def brake(m, capacity, mu) -> Reference:
    """Free, then with constant deceleration, then at rest."""
    deceleration = 2.0 * mu * capacity / m
    stop = 0.1 + 1.0 / deceleration
    return Reference(np.array([0.1 + 0.5 / deceleration, 0.0]), [(stop, "brake stick")])


def _sliding(sign, m, fv, fc, fs, fexp, force):
    """`m v' = force(t, x) - friction` in slip of one sign."""

    def field(t, y):
        friction = fc + fs * np.exp(-fexp * sign * y[1])
        return np.array([y[1], (force(t, y[0]) - sign * friction - fv * y[1]) / m])

    return integrated(field)


def friction(m, fv, fc, fs, fexp, force) -> Reference:
    """Rest up to 1.001 (Fc + Fs), then slip that reverses at once, as the force is above that limit there."""

    def push(t, x=0.0):
        return force * np.sin(0.5 * np.pi * t)

    held, limit = driven([([0.0], Wave(0.0))]), 1.001 * (fc + fs)
    path = Path([0.0, 0.0])
    path.to_zero(held, lambda t, y: push(t) - limit, 5.0, "stop1 forward")
    sign = 1.0
    while path.to_zero(_sliding(sign, m, fv, fc, fs, fexp, push), lambda t, y: y[1], 5.0):
        path.y[1] = 0.0
        if abs(push(path.t)) < limit:
            path.log("stop1 stick")
            direction = 1.0 if push(path.t + 1e-3) > push(path.t) else -1.0
            if not path.to_zero(held, lambda t, y, d=direction: d * push(t) - limit, 5.0):
                break
        sign = 1.0 if push(path.t) > 0 else -1.0
        path.log("stop1 forward" if sign > 0 else "stop1 backward")
    return Reference(path.y, path.events)


def friction_stop(m, fv, fc, fs, fexp, c) -> Reference:
    """Slip to the stop at -0.4 m, back from it at once, and half cycles until the spring is too weak."""

    def spring(t, x):
        return -c * (x + 0.25)

    path, sign, limit = Path([0.0, -5.0]), -1.0, 1.001 * (fc + fs)
    path.to_zero(_sliding(sign, m, fv, fc, fs, fexp, spring), lambda t, y: y[0] + 0.4, 5.0)
    path.y = np.array([-0.4, 0.0])
    while abs(spring(path.t, path.y[0])) > limit:
        sign = 1.0 if spring(path.t, path.y[0]) > 0 else -1.0
        path.log("stop2 forward" if sign > 0 else "stop2 backward")
        path.to_zero(_sliding(sign, m, fv, fc, fs, fexp, spring), lambda t, y: y[1], 5.0)
        path.y[1] = 0.0
    path.log("stop2 stick")
    return Reference(path.y, path.events)


def elasto_gap(m, c, d) -> Reference:
    """A mass with springs on both sides of it that push alone, and one with springs that also pull."""

    def guards(t, y):
        over = np.abs(y[0]) - 0.5
        return [y[0] - 0.5, -y[0] - 0.5, d * y[1] - c * over, d * y[1] + c * over]

    def field(t, y, signs):
        side = 1.0 if signs[0] > 0 else -1.0
        if signs[0] < 0 and signs[1] < 0:
            return np.array([y[1], 0.0])
        u, rate = side * y[0] - 0.5, side * y[1]
        above = signs[2] > 0 if side > 0 else signs[3] < 0
        below = signs[3] < 0 if side > 0 else signs[2] > 0
        damping = c * u if above else -c * u if below else d * rate
        return np.array([y[1], -side * (c * u + damping) / m])

    path = Path([2.0, 0.0])
    switched(path, field, guards, 5.0)
    plain = Path([2.0, 0.0])
    plain.until(linear(np.array([[0.0, 1.0], [-2.0 * c / m, -2.0 * d / m]]), np.zeros(2)), 5.0)
    return Reference(np.array([path.y[1], 2.0 - path.y[0], plain.y[1], 2.0 - plain.y[0]]), [])


# Overlaps of the four gaps of PreLoad: rows, in the displacements of two plates and the spool, and constants.
GAPS = np.array([[-1.0, 0.0, 0.0], [-1.0, 0.0, 1.0], [0.0, 1.0, -1.0], [0.0, 1.0, 0.0]])
OVERLAPS = np.array([0.0, 0.0, -0.00175, -0.00175])


def preload(c, d, spring, drag, force) -> Reference:
    """A linear system for every set of closed gaps and limited dampers, by exponentials of a matrix.

    Guards of a gap: its overlap u, and `d u' - c u` and `d u' + c u`, whose signs say whether the damping is limited.
    """
    mass, pull, weights = np.array([0.01, 0.01, 0.15]), np.array([-1.0, 1.0, 0.0]), ((1.0, 0.0), (-c, d), (c, d))
    rows = np.concatenate([[[*(a * gap), *(b * gap)] for a, b in weights] for gap in GAPS])
    constants = np.concatenate([[a * u for a, _ in weights] for u in OVERLAPS])

    def piece(signs):
        stiff, constant = spring * np.outer(pull, pull), 0.00325 * spring * pull
        damping = np.diag([0.0, 0.0, drag])
        for gap, u, (touches, above, below) in zip(GAPS, OVERLAPS, signs.reshape(4, 3), strict=True):
            if touches > 0:
                free = above < 0 < below
                k = c if free else 2.0 * c if above > 0 else 0.0
                stiff, constant = stiff + k * np.outer(gap, gap), constant - k * u * gap
                damping = damping + d * free * np.outer(gap, gap)
        a = np.block([[np.zeros((3, 3)), np.eye(3)], [-stiff / mass[:, None], -damping / mass[:, None]]])
        sine = np.array([0.0, 0.0, 0.0, 0.0, 0.0, force / mass[2]])
        return linear(a, np.concatenate([np.zeros(3), constant / mass]), sine=sine, omega=0.02 * np.pi)

    # The spring presses the first plate onto stop and spool, whose gaps are zero at the start.
    path, ahead = Path([0.0] * 6), 1e-6
    signs = np.array([1.0, 1.0, 1.0, 1.0, 1.0, 1.0, -1.0, 1.0, -1.0, -1.0, 1.0, -1.0])
    while path.t < 100.0:
        now = signs.copy()
        end = min(path.t + ahead, 100.0)
        i = path.to_first(piece(now), lambda t, y, now=now: now * (rows @ y + constants), end, 101)
        ahead = 1e-6 if i is not None else min(4.0 * ahead, 1.0)
        if i is not None:
            signs[i] *= -1.0
    (a, b, s), (va, vb, vs) = np.split(path.y, 2)
    return Reference(np.array([vs, 0.001 + a - s, 0.00275 + s - b, va, 0.00325 - b, -vb]), [])


def heat_losses(c, d, force, normal, support, peak, shared=False) -> Reference:
    """Four masses, three of them with friction, which changes its mode by itself in each; the last one has stops.

    `shared`: the stop also changes the velocity of the third mass by that of the last, as `reinit` does in Modelica
    where the difference of both is the state. The stop is a mode of friction there.
    """
    names, stops = ("support", "brake", "mass"), (0.05, 0.35)

    def loads(t, y, gap):
        """Forces on the masses without friction."""
        x, v = y[:4], y[4:]
        u, w = 0.03 - x[0], -v[0]
        push = 0.0 if gap[0] < 0 else c * u + (2.0 * d * w if gap[1] < 0 < gap[2] else c * u if gap[1] > 0 else -c * u)
        first, second = c * (x[1] - x[0] - 0.1) + d * (v[1] - v[0]), c * (x[2] - x[1] - 0.1)
        third = 1e4 * (x[3] - x[2] - 0.1) + 1e3 * (v[3] - v[2])
        drive = force * np.sin(2.0 * np.pi * t) + push - d * v[0]
        return np.array([drive + first, second - first, third - second, -third])

    def limits(t, on):
        return np.array([support, 0.5 * normal * np.sin(4.0 * np.pi * t) * on, 1.001 * (1.0 + peak)])

    path, gap, modes, side = Path([0.0, 0.1, 0.2, 0.3] + [0.0] * 4), np.array([1.0, -1.0, 1.0]), np.zeros(3), 0
    for quarter in range(8):
        end, on = 0.25 * (quarter + 1), quarter % 2 == 0
        while path.t < end:
            closed, now = gap.copy(), modes.copy()

            def field(t, y, gap=closed, m=now, on=on):
                slip = limits(t, on)
                slip[2] = 1.0 + peak * np.exp(-2.0 * abs(y[7])) + 0.5 * abs(y[7])
                f = loads(t, y, gap)
                return np.concatenate([y[4:], f[:1], np.where(m == 0, 0.0, f[1:] - m * slip)])

            def guards(t, y, gap=closed, m=now, on=on, side=side):
                """Gap, three times mode or load of either sign, and stops."""
                u, w = c * (0.03 - y[0]), -2.0 * d * y[4]
                f, most = loads(t, y, gap)[1:], limits(t, on)
                up, down = np.where(m == 0, most - f, m * y[5:]), np.where(m == 0, most + f, 1.0)
                walls = [y[3] - stops[0], stops[1] - y[3]] if m[2] else [1.0, 1.0]
                up[2], down[2] = (1.0 if side > 0 else up[2]), (1.0 if side < 0 else down[2])
                return np.concatenate([gap * [u, w - u, w + u], up, down, walls])

            i = path.to_first(integrated(field), guards, end)
            if i is None:
                break
            if i < 3:
                gap[i] *= -1.0
            elif i >= 9:
                side, hit = (1 if i == 10 else -1), path.y[7]
                path.y[3], path.y[7], modes[2] = stops[i - 9], 0.0, 0.0
                if shared:
                    path.log("mass stick")
                    path.y[6] -= hit
                    modes[1] = np.sign(path.y[6])
            else:
                k = (i - 3) % 3
                sign = 1.0 if i < 6 else -1.0
                if modes[k]:
                    path.y[5 + k], load = 0.0, loads(path.t, path.y, gap)[1 + k]
                    sign = np.sign(load) if abs(load) > limits(path.t, on)[k] else 0.0
                modes[k], side = sign, 0 if k == 2 else side
                path.log(f"{names[k]} {('stick', 'forward', 'backward')[int(sign)]}")
    x, v = path.y[:4], path.y[4:]
    values = [0.05 - x[0], -v[0], x[3], v[3], x[1] - x[0] - 0.1, v[1] - v[0], x[3] - x[2] - 0.1, v[3] - v[2]]
    return Reference(np.array(values), path.events)
