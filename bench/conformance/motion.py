"""Motions put together from pieces with equations of their own, at whose ends events happen; NumPy and SciPy alone.

A piece is a function of the initial time and state that returns the state as a function of time: a closed form, an
exponential of a matrix, or, where neither exists, an integration by DOP853 at 1e-13.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp
from scipy.linalg import expm
from scipy.optimize import brentq

State = Any
Solution = Callable[[Any], State]
Piece = Callable[[float, State, float], Solution]
# Points at which a piece is searched for a zero; fewer where several guards are watched.
POINTS, FEWER = 2001, 301


class Path:
    """A motion and its events.

    - `t` [s], `y`: time and state reached. `events`: times and labels.
    """

    def __init__(self, y0: Sequence[float], t0: float = 0.0) -> None:
        self.t, self.y, self.events = t0, np.array(y0, float), []

    def log(self, *labels: str) -> None:
        """Log events now."""
        self.events += [(self.t, label) for label in labels]

    def until(self, piece: Piece, end: float, *labels: str) -> None:
        """Advance to a time."""
        self.y, self.t = np.asarray(piece(self.t, self.y, end)(end), float), end
        self.log(*labels)

    def to_zero(self, piece: Piece, guard: Callable[[Any, Any], Any], end: float, *labels: str) -> bool:
        """Advance to the first zero of `guard(t, y)`, or to `end`; says whether there was one.

        A guard that is zero at the start counts with its sign soon after.
        """
        motion = piece(self.t, self.y, end)
        ts = np.linspace(self.t, end, POINTS)
        samples = getattr(motion, "samples", None)
        states = [motion(t) for t in ts] if samples is None else samples(ts)
        values = np.array([guard(t, y) for t, y in zip(ts, states, strict=True)])
        first = next((i for i in range(1, POINTS) if abs(values[i]) > 0.0), POINTS)
        change = next((i for i in range(first, POINTS) if values[i] * values[first] < 0), None)
        if change is None:
            self.until(piece, end)
            return False
        refined = getattr(motion, "refined", motion)
        root = brentq(lambda t: guard(t, refined(t)), ts[change - 1], ts[change], xtol=1e-15, rtol=8.9e-16)
        self.y, self.t = np.asarray(refined(root), float), float(root)
        self.log(*labels)
        return True

    def to_first(self, piece: Piece, guards: Callable[[Any, Any], Any], end: float, points: int = FEWER) -> int | None:
        """Advance to the first zero of `guards(t, y)`, all positive until then; its index, or None at `end`."""
        motion = piece(self.t, self.y, end)
        ts = np.linspace(self.t, end, points)
        samples = getattr(motion, "samples", None)
        states = [motion(t) for t in ts] if samples is None else samples(ts)
        refined = getattr(motion, "refined", motion)
        below = np.array([guards(t, y) for t, y in zip(ts, states, strict=True)]) < 0
        below[0] = False
        roots = [
            (_root(lambda t, i=i: guards(t, refined(t))[i], float(ts[k - 1]), float(ts[k])), i)
            for i, k in enumerate(np.argmax(below, axis=0)) if k
        ]  # fmt: skip
        if not roots:
            self.y, self.t = np.asarray(states[-1], float), end
            return None
        root, i = min(roots)
        self.y, self.t = np.asarray(refined(root), float), root
        return i


class Wave:
    """`amplitude sin(omega t + phase)`, or a power `amplitude t^power`, with its two antiderivatives."""

    def __init__(self, amplitude: float, omega: float = 0.0, phase: float = 0.0, power: int = 0) -> None:
        self.a, self.w, self.p, self.n = amplitude, omega, phase, power

    def value(self, t: Any) -> Any:
        """The function."""
        return self.a * np.sin(self.w * t + self.p) if self.w else self.a * t**self.n

    def once(self, t: Any) -> Any:
        """Antiderivative."""
        return -self.a / self.w * np.cos(self.w * t + self.p) if self.w else self.a * t ** (self.n + 1) / (self.n + 1)

    def twice(self, t: Any) -> Any:
        """Antiderivative of the antiderivative."""
        n = self.n
        return -self.value(t) / self.w**2 if self.w else self.a * t ** (n + 2) / ((n + 1) * (n + 2))


def driven(accelerations: Sequence[tuple[Any, Wave]]) -> Piece:
    """`q'' = sum of c_k b_k(t)`, in closed form; states are (q, q'), and c_k has an entry for each coordinate."""

    def piece(t0: float, y0: State, end: float) -> Solution:
        del end
        half = len(y0) // 2
        q0, w0 = y0[:half], y0[half:]

        def at(t: float) -> State:
            w = w0 + sum(np.asarray(c) * (b.once(t) - b.once(t0)) for c, b in accelerations)
            q = q0 + w0 * (t - t0)
            q = q + sum(np.asarray(c) * (b.twice(t) - b.twice(t0) - b.once(t0) * (t - t0)) for c, b in accelerations)
            return np.concatenate([q, w])

        return at

    return piece


def linear(a: Any, constant: Any, ramp: Any = None, sine: Any = None, omega: float = 0.0) -> Piece:
    """`y' = a y + constant + ramp t + sine sin(omega t)`, by the exponential of a matrix."""
    n = len(constant)
    whole = np.zeros((n + 4, n + 4))  # beside y: 1, t, sin, cos
    whole[:n, :n], whole[:n, n] = a, constant
    whole[:n, n + 1] = 0.0 if ramp is None else ramp
    whole[:n, n + 2] = 0.0 if sine is None else sine
    whole[n + 1, n] = 1.0
    whole[n + 2, n + 3], whole[n + 3, n + 2] = omega, -omega

    return lambda t0, y0, end: _Exponential(whole, omega, t0, y0)


class _Exponential:
    """A motion of a linear system: by the exponential of the whole time, or at equispaced times by that of one step."""

    def __init__(self, whole: Any, omega: float, t0: float, y0: State) -> None:
        self.whole, self.t0, self.n = whole, t0, len(y0)
        self.start = np.concatenate([y0, [1.0, t0, np.sin(omega * t0), np.cos(omega * t0)]])

    def __call__(self, t: float) -> State:
        return (expm((t - self.t0) * self.whole) @ self.start)[: self.n]

    def samples(self, ts: Any) -> list[State]:
        """States at equispaced times from the first one on."""
        step, state, states = expm((ts[1] - ts[0]) * self.whole), self.start, []
        for _ in ts:
            states.append(state[: self.n])
            state = step @ state
        return states


class _Integrated:
    """A motion by DOP853: dense output, and `refined`, which repeats a part of one step."""

    def __init__(self, field: Callable[[float, State], State], t0: float, y0: State, end: float) -> None:
        self.field, self.options = field, {"method": "DOP853", "rtol": 3e-14, "atol": 1e-15}
        self.done = solve_ivp(field, (t0, end), y0, dense_output=True, **self.options)

    def __call__(self, t: float) -> State:
        return self.done.y[:, -1] if t == self.done.t[-1] else self.done.sol(t)

    def refined(self, t: float) -> State:
        """The state at `t` without the error of the dense output."""
        i = max(0, int(np.searchsorted(self.done.t, t, side="right")) - 1)
        if self.done.t[i] == t:
            return self.done.y[:, i]
        return solve_ivp(self.field, (self.done.t[i], t), self.done.y[:, i], **self.options).y[:, -1]


def integrated(field: Callable[[float, State], State]) -> Piece:
    """`y' = field(t, y)`, smooth, by DOP853 at 3e-14."""
    return lambda t0, y0, end: _Integrated(field, t0, y0, end)


def switched(
    path: Path,
    field: Callable[[float, State, Sequence[float]], State],
    guards: Callable[[float, State], Sequence[float]],
    end: float,
) -> None:
    """Advance to `end` by `y' = field(t, y, signs)`, whose signs are those of the guards between their zeros.

    Fields must be smooth for constant signs, and continuous at the zeros.
    """
    count = len(guards(path.t, path.y))
    soon = path.y + 1e-9 * np.asarray(field(path.t, path.y, np.sign(guards(path.t, path.y))))
    signs = np.where(np.array(guards(path.t, soon)) >= 0, 1.0, -1.0)
    while path.t < end:
        piece = integrated(lambda t, y, signs=signs: field(t, y, signs))
        motion = piece(path.t, path.y, end)
        ts = np.linspace(path.t, end, FEWER)
        values = signs * np.array([guards(t, motion(t)) for t in ts])
        crossed = [(int(np.argmax(values[1:, i] < 0)), i) for i in range(count) if (values[1:, i] < 0).any()]
        if not crossed:
            path.until(piece, end)
            return

        def inside(i: int, t: float, motion: Any = motion, signs: Any = signs) -> float:
            return signs[i] * guards(t, motion.refined(t))[i]

        root, i = min((_root(partial(inside, i), ts[at], ts[at + 1]), i) for at, i in crossed)
        path.y, path.t = np.asarray(motion.refined(root), float), root
        signs = np.where(np.arange(count) == i, -signs, signs)


def _root(g: Callable[[float], float], low: float, high: float) -> float:
    return low if g(low) <= 0 else float(brentq(g, low, high, xtol=1e-15, rtol=8.9e-16))
