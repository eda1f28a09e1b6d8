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
