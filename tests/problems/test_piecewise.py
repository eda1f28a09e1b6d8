"""The reference by matrix exponentials, against closed forms and integrations that share nothing with it."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import root_scalar

from . import linear_stick_slip

# Amplitude [N], growth [1/s], angular frequency [rad/s].
SHAKEN = (0.8441173414514593, 0.09826644620612397, 2.9358368442770417)


def box(
    load: list[float],
    frequencies: tuple[float, ...] = (),
    *,
    m: float = 2.0,
    c: float = 0.0,
    k: float = 0.0,
    limits: tuple[float, float] = (1.0, 1.5),
    belt: list[float] | None = None,
) -> linear_stick_slip.LinearStickSlip:
    """One mass with one element."""
    count = 5 + 4 * len(frequencies)
    row = np.array([*load, *[0.0] * (count - len(load))])
    surface = np.array([*(belt or []), *[0.0] * (count - len(belt or []))])
    one = np.ones((1, 1))
    Fc, Fs = (np.array([x]) for x in limits)
    return linear_stick_slip.LinearStickSlip(
        m * one, c * one, k * one, one, Fc, Fs, np.array(frequencies), row[None], surface[None]
    )


def shaken(limits: tuple[float, float] = (1.0, 1.5)) -> linear_stick_slip.LinearStickSlip:
    a, g, w = SHAKEN
    return box([0.0, 0.0, 0.0, a, 0.0, a * g, 0.0], (w,), limits=limits)


def test_box_under_a_growing_harmonic():
    motion = linear_stick_slip.motion(shaken(), np.zeros(1), np.zeros(1), 10.0)
    assert motion.q[0] == pytest.approx(0.0210473, abs=5e-8)
    np.testing.assert_array_equal(motion.modes[:, 0], [0, -1, 0, 1, 0])
    assert motion.num_events == len(motion.times) == 4
    # Break-aways by the load alone.
    a, g, w = SHAKEN
    for t in motion.times[::2]:
        assert abs(a * (1.0 + g * t) * np.sin(w * t)) == pytest.approx(1.5, rel=1e-12)


def test_ramp_in_closed_form():
    motion = linear_stick_slip.motion(box([0.0, 1e-4]), np.zeros(1), np.zeros(1), 2e4)
    # Slip from 1.5e4 s on: 2 q'' = 0.5 + 1e-4 s.
    s = 5e3
    assert motion.times == pytest.approx([1.5e4], rel=1e-12)
    assert motion.q[0] == pytest.approx(0.125 * s**2 + 1e-4 * s**3 / 12.0, rel=1e-9)


def test_undamped_spring_stops_at_its_closed_form():
    """Every half swing loses 2 Fc/k: from 10.3 Fc/k five of them leave 0.3, where it sticks."""
    motion = linear_stick_slip.motion(box([], k=8.0, limits=(1.0, 1.0)), np.array([10.3 / 8.0]), np.zeros(1), 20.0)
    assert motion.q[0] == pytest.approx(-0.3 / 8.0, rel=1e-10)
    assert motion.times == pytest.approx(np.pi / 2.0 * np.arange(1, 6), rel=1e-12)


def test_belt_oscillator_breaks_away_at_the_limit():
    """A spring-held box on an even belt: it goes with the belt until the spring pulls with Fs."""
    motion = linear_stick_slip.motion(box([], m=1.0, k=4.0, belt=[0.1]), np.zeros(1), np.array([0.1]), 3.9)
    assert motion.times == pytest.approx([1.5 / 4.0 / 0.1], rel=1e-12)


@pytest.mark.parametrize("touch", [-1e-5, 1e-5])
def test_touching_is_not_crossing(touch: float):
    load = box([0.0, 0.0, 0.0, 1.5 * (1.0 + touch)], (2.0,), limits=(1.5, 1.5))
    motion = linear_stick_slip.motion(load, np.zeros(1), np.zeros(1), 1.5)
    assert (motion.num_events > 0) == (touch > 0)
    assert motion.margin == pytest.approx(1e-5, rel=1e-3)


def integrate(system: linear_stick_slip.LinearStickSlip, t1: float) -> tuple[float, int]:
    """Position and number of events of one mass from rest at 0, by DOP853 and its terminal events."""
    m, c, k, Fc, Fs = (
        float(np.ravel(x)[0]) for x in (system.mass, system.damping, system.stiffness, system.Fc, system.Fs)
    )

    def push(t: float, q: float, v: float) -> float:
        return float(system.load[0] @ system.loads(t)) - c * v - k * q

    def belt(t: float, order: int = 0) -> float:
        rate = np.linalg.matrix_power(system.load_rate, order)
        return float(system.belt[0] @ rate @ system.loads(t))

    t, q, v, mode, events = 0.0, 0.0, belt(0.0), 0, 0
    while True:
        if mode == 0:
            times = np.arange(t, t1, 1e-3)
            offset = q - belt_position(system, t)

            def force(s: float, offset: float = offset) -> float:
                return push(s, offset + belt_position(system, s), belt(s)) - m * belt(s, 1)

            over = [abs(force(s)) > Fs for s in times]
            if not any(over[1:]):
                return offset + belt_position(system, t1), events
            i = max(over.index(True), 1)
            t = float(root_scalar(lambda s: abs(force(s)) - Fs, bracket=(times[i - 1], times[i]), xtol=1e-14).root)
            q, v, mode = offset + belt_position(system, t), belt(t), int(np.sign(force(times[i])))
        else:
            sign, start = mode, t + 1e-6

            def slip(s: float, y: np.ndarray, sign: int = sign, start: float = start) -> float:
                return sign * (y[1] - belt(s)) + (1.0 if s < start else 0.0)

            slip.terminal, slip.direction = True, -1  # type: ignore[attr-defined]

            def field(s: float, y: np.ndarray, sign: int = sign) -> list[float]:
                return [y[1], (push(s, y[0], y[1]) - sign * Fc) / m]

            found = solve_ivp(field, (t, t1), [q, v], "DOP853", events=slip, rtol=1e-10, atol=1e-12, max_step=0.03)
            t, (q, v) = found.t[-1], found.y[:, -1]
            if found.status == 0:
                return q, events
            load = push(t, q, v) - m * belt(t, 1)
            mode = 0 if abs(load) <= Fs else -sign
        events += 1


def belt_position(system: linear_stick_slip.LinearStickSlip, t: float) -> float:
    """Integral of the belt's velocity b0 + b1 sin(w t)."""
    if not len(system.frequencies):
        return float(system.belt[0, 0] * t)
    w = system.frequencies[-1]
    return float(system.belt[0, 0] * t + system.belt[0, -6] / w * (1.0 - np.cos(w * t)))


@pytest.mark.parametrize(
    ("system", "t1"),
    [
        (shaken(), 10.0),
        (replace(shaken((1.0, 1.0)), load=1.5 * shaken().load), 6.0),
        (box([], (1.7,), m=1.0, c=0.1, k=4.0, belt=[0.2, 0.0, 0.0, 0.3]), 10.0),
        (box([0.2, 0.1, 0.0, 0.7], (3.1,), m=1.0, k=3.0, limits=(1.0, 1.2)), 8.0),
    ],
)
def test_against_integration_with_short_steps(system: linear_stick_slip.LinearStickSlip, t1: float):
    motion = linear_stick_slip.motion(system, np.zeros(1), system.belt @ system.loads(0.0), t1)
    q, events = integrate(system, t1)
    assert motion.q[0] == pytest.approx(q, rel=1e-8, abs=1e-10)
    assert motion.num_events == events
    assert events > 2


def step_in_time(system: linear_stick_slip.LinearStickSlip, t1: float, count: int) -> np.ndarray:
    """Coordinates from rest at 0 by time-stepping with impulses (J. J. Moreau, 1988), without stiction; order 1."""
    h, n = t1 / count, system.size
    q, qd, impulse = np.zeros(n), np.zeros(n), np.zeros(len(system.Fc))
    respond = np.linalg.inv(system.mass + h * system.damping + h**2 * system.stiffness)
    rows, coupling = system.directions, system.directions @ respond @ system.directions.T
    for i in range(1, count + 1):
        load = system.load @ system.loads(i * h)
        free = respond @ (system.mass @ qd + h * (load - system.stiffness @ q))
        drive = rows @ free - system.belt @ system.loads(i * h)
        for _ in range(30):
            for j in range(len(impulse)):
                change = (drive[j] - coupling[j] @ impulse) / coupling[j, j]
                impulse[j] = np.clip(impulse[j] + change, -h * system.Fc[j], h * system.Fc[j])
        qd = free - respond @ (rows.T @ impulse)
        q = q + h * qd
    return q


def test_chain_with_friction_between_neighbours():
    """Five elements on three coordinates: which of them hold is not unique, but the motion is."""
    k = np.array([[6.0, -3.0, 0.0], [-3.0, 6.0, -3.0], [0.0, -3.0, 3.0]])
    rows = np.array([[1.0, 0, 0], [0, 1, 0], [0, 0, 1], [-1, 1, 0], [0, -1, 1]])
    limits = np.array([0.4, 0.3, 0.5, 0.35, 0.25])
    load = np.zeros((3, 9))
    load[0, 3], load[2, 3], load[2, 0] = 2.5, -0.8, 0.4
    system = linear_stick_slip.LinearStickSlip(
        np.diag([1.0, 1.3, 0.8]), 0.05 * k, k, rows, limits, limits, np.array([1.9]), load, np.zeros((5, 9))
    )
    motion = linear_stick_slip.motion(system, np.zeros(3), np.zeros(3), 5.0)
    assert len(motion.times) > 10
    coarse, fine = (step_in_time(system, 5.0, count) for count in (1000, 2000))
    assert np.max(np.abs(motion.q - (2.0 * fine - coarse))) < 2e-3 * np.max(motion.q_scale)
