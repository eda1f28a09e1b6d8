"""Motions with impacts, summed flight by flight: references that know nothing of the event solver."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.optimize import brentq

# A flight shorter than this [s] is none, as rounding hides its height; so is one that begins with this velocity [m/s].
_NONE, _SLOW = 1e-7, 1e-9
# Looks at gaps and tables are this far apart [s].
_LOOK = 2e-4


class Settling(NamedTuple):
    """Times of impacts, when the contact closes and when it opens [s], and the motion at the times asked for."""

    strikes: list[float]
    closes: list[float]
    opens: list[float]
    q: np.ndarray
    qd: np.ndarray


def _root(fn: Callable[[float], float], low: float, high: float) -> float:
    return brentq(fn, low, high, xtol=1e-16)  # pyright: ignore[reportReturnType] - a number


def ball_on_table(
    table: Callable[[float], tuple[float, float, float]], h: float, e: float, ts: np.ndarray, g: float = 9.81
) -> Settling:
    """A ball dropped from rest at the height `h` [m] over a table with the position, velocity and acceleration given.

    Flights are parabolas to their first root; where the next flight is none the ball rests on the table, until that
    falls faster than the ball would.
    """
    strikes, closes, opens, pieces = [], [], [], []
    t, x, v, rests = 0.0, h, 0.0, False

    def gap(dt: float) -> float:
        return x + v * dt - 0.5 * g * dt * dt - table(t + dt)[0]

    while t < ts[-1]:
        pieces.append((t, x, v, rests))
        if rests:
            looks = np.arange(t, ts[-1] + _LOOK, _LOOK)
            falls = [i for i in range(len(looks) - 1) if table(looks[i])[2] + g > 0 >= table(looks[i + 1])[2] + g]
            if not falls:
                break
            t = _root(lambda t: table(t)[2] + g, looks[falls[0]], looks[falls[0] + 1])
            (x, v, _), rests = table(t), False
            opens.append(t)
            continue
        # From the shortest flight on, in steps that are fine beside it and beside the motion of the table.
        rate, pull = v - table(t)[1], table(t)[2] + g
        step = _LOOK if pull <= 0 or rate <= 0 else min(_LOOK, 0.2 * rate / pull)
        before = step
        while gap(before) <= 0:
            before *= 0.5
        after = before + step
        while gap(after) > 0:
            before, after = after, after + min(max(step, 0.05 * after), _LOOK)
        dt = _root(gap, before, after)
        t, x, v = t + dt, *table(t + dt)[:1], v - g * dt
        strikes.append(t)
        _, speed, acceleration = table(t)
        v = speed - e * (v - speed)
        if acceleration + g > 0 and 2.0 * (v - speed) < _NONE * (acceleration + g):
            rests = True
            closes.append(t)
    q, qd = [], []
    for at in ts:
        begin, x0, v0, rest = next(piece for piece in reversed(pieces) if piece[0] <= at)
        dt = at - begin
        q.append(table(at)[0] if rest else x0 + v0 * dt - 0.5 * g * dt * dt)
        qd.append(table(at)[1] if rest else v0 - g * dt)
    return Settling(strikes, closes, opens, np.array(q), np.array(qd))


def mass_in_a_dry_box(
    M: float, m: float, Fc: float, push: float, e: float, room: float, v: float, t1: float
) -> tuple[np.ndarray, int]:
    """A mass m is pushed by `push` < Fc [N] through a box of mass M against its end; the box has dry friction.

    It starts with the velocity v at `room` [m] from the end. Between impacts accelerations are constant: the box slips
    until friction has stopped it, and then rests. Returned are the box's place and the distance to the end at `t1`, and
    the number of impacts up to where the next flight is none.
    """
    t, x, gap, V, w = 0.0, 0.0, room, 0.0, -v  # w: rate of the gap
    count = 0
    while t < t1:
        slips = abs(V) > 0
        a_box = (-push - np.sign(V) * Fc) / M if slips else 0.0
        a_gap = a_box - push / m
        stop = -V / a_box if slips and V * a_box < 0 else np.inf
        # The root of gap + w t + a_gap t^2/2 behind zero, in the form that does not cancel.
        root = (2.0 * gap) / (np.sqrt(w * w - 2.0 * a_gap * gap) - w) if gap > 0 else 2.0 * w / -a_gap
        dt = min(stop, root, t1 - t)
        x, gap, V, w = (
            x + V * dt + 0.5 * a_box * dt**2,
            gap + w * dt + 0.5 * a_gap * dt**2,
            V + a_box * dt,
            w + a_gap * dt,
        )
        t += dt
        if dt == stop:
            V = 0.0
        elif dt == root:
            gap, before = 0.0, w
            w, V = -e * before, V - (1.0 + e) * before * m / (m + M)
            count += 1
            if w < _SLOW:
                # Both move together, and friction stops them.
                V0 = V
                a = (-np.sign(V0) * Fc) / (m + M)
                dt = min(-V0 / a, t1 - t) if V0 != 0 else 0.0
                return np.array([x + V0 * dt + 0.5 * a * dt**2, 0.0]), count
    return np.array([x, gap]), count
