"""Relay oscillators of Siconos, linear systems of first order with a sign, as mechanisms of unit masses."""

import jax.numpy as jnp
import numpy as np

import jaxmodsim as jms
from bench.conformance.case import Case, Numbers, Reference, Setup
from bench.conformance.motion import Path, linear

SOURCE = "siconos/siconos-tutorials @ b6c9bfd1, examples/control/RelayOscillator/{}"
# Time of the comparison with sliding [s]. The attractor is aperiodic: errors of the published steps grow later.
END = 5.0
STATE = ("x1", "x2", "x3")


def unit_masses(t, q, qd, p):
    """Lagrangian of unit masses."""
    return 0.5 * jnp.sum(qd**2)


def relay(p: Numbers) -> Setup:
    """A mass on a spring and a damper, which a relay pushes against the integral of its displacement.

    Coordinates: the displacement x2, and the integral x1, which is a unit mass under the velocity of the first one.
    """

    def forces(t, q, qd, p):
        return jnp.stack([-p["c"] * q[0] - p["d"] * qd[0], qd[0]])

    def push(sign):
        return lambda t, q, qd, p: jnp.stack([sign * p["k"], 0.0 * p["k"]])

    switch = jms.Switch(lambda t, q, qd, p: q[1], above=push(-1.0), below=push(1.0), name="relay")
    scene = jms.Scene(unit_masses, dict(p), (jms.AppliedForce(forces), switch))
    return Setup(scene, jnp.stack([p["x2"], 0.0 * p["x2"]]), jnp.stack([0.0 * p["x2"], p["x2"]]))


def exact_relay(c, d, k, x2) -> Reference:
    """Exponentials of a matrix from switch to switch; the state is that of the source."""
    a = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.0, -c, -d]])
    path, sign = Path([0.0, x2, 0.0]), 1.0
    while path.to_first(linear(a, [0.0, 0.0, -sign * k]), lambda t, y, sign=sign: (sign * y[0],), 100.0) is not None:
        path.y[0], sign = 0.0, -sign
        path.log("relay above" if sign > 0 else "relay below")
    return Reference(path.y, path.events)


def polynomial(xsi, omega, lam):
    """Coefficients of (s + lam) (s^2 + 2 xsi omega s + omega^2), without the leading one."""
    return 2.0 * xsi * omega + lam, 2.0 * xsi * omega * lam + omega**2, lam * omega**2


def sliding_relay(p: Numbers) -> Setup:
    """A mass with Coulomb friction, whose velocity is x1; the velocities of two others are x2 + 2 x1 and x3 - x1.

    The relay acts on x1, x2 and x3, and cancels in these sums.
    """

    def forces(t, q, qd, p):
        x1, x2, x3 = qd[0], qd[1] - 2.0 * qd[0], qd[2] + qd[0]
        a, b, c = polynomial(p["xsi"], p["omega"], p["lam"])
        rate1, rate2, rate3 = x2 - a * x1, x3 - b * x1, -c * x1
        return jnp.stack([rate1, rate2 + 2.0 * rate1, rate3 - rate1])

    friction = jms.Friction(jms.Coulomb(p["k"]), along=lambda q: q[0], name="relay")
    scene = jms.Scene(unit_masses, dict(p), (jms.AppliedForce(forces), friction))
    return Setup(scene, np.zeros(3), jnp.stack([0.0 * p["x2"], p["x2"], 0.0 * p["x2"]]))


def exact_sliding_relay(xsi, omega, lam, k, x2) -> Reference:
    """Exponentials of a matrix between sticks, at which x1 = 0 and the relay carries -x2."""
    whole, b = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, 0.0]]), np.array([1.0, -2.0, 1.0])
    whole[:, 0] = -np.array(polynomial(xsi, omega, lam))
    held = whole - np.outer(b, whole[0])
    path = Path([0.0, x2, 0.0])
    while path.to_first(linear(held, np.zeros(3)), lambda t, y: (k - y[1], k + y[1]), END) is not None:
        sign = np.sign(path.y[1])
        while sign:
            path.log("relay forward" if sign > 0 else "relay backward")
            moving = linear(whole, -sign * k * b)
            if path.to_first(moving, lambda t, y, sign=sign: (sign * y[0],), END) is None:
                return Reference(path.y, path.events)
            path.y[0], sign = 0.0, -sign
            if abs(path.y[1]) < k:
                path.log("relay stick")
                sign = 0.0
    return Reference(path.y, path.events)


CASES = (
    Case(
        "Siconos RelayOscillator", SOURCE.format("RelayOscillator.py"), relay,
        {"c": 3.0, "d": 2.0, "k": 1.0, "x2": 3.0 * np.sqrt(2.0) / (2.0 * np.pi)}, 100.0,
        STATE, lambda q, qd: (q[1], q[0], qd[0]), (), exact_relay, by=("c", "d", "k"),
        options={"max_events": 64}, note="The repository has figures, and no numbers.",
    ),
    Case(
        "Siconos RelayOscillatorWithSliding", SOURCE.format("RelayOscillatorWithSliding.cpp"), sliding_relay,
        {"xsi": -0.07, "omega": 10.0, "lam": 0.05, "k": 1.0, "x2": 0.5}, END,
        STATE, lambda q, qd: (qd[0], qd[1] - 2.0 * qd[0], qd[2] + qd[0]),
        (-0.03462634971259529, -0.6124208145131526, -0.1915135002989594), exact_sliding_relay,
        by=("xsi", "omega", "lam"), results=SOURCE.format("RelayOscillatorWithSliding.ref"),
        note="Published: Euler-Moreau time-stepping with steps of 10 ms; the row at 5 s.",
    ),
)  # fmt: skip
