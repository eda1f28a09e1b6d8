"""A mass on a spring under dry friction, on a table and on a belt: exact events against closed forms."""

from functools import partial
from typing import Any, NamedTuple

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxmodsim as jms
from jaxmodsim import problems

TIMES, EVENTS = 61, 16


class Start(NamedTuple):
    """A run, and all numbers that it can be differentiated by."""

    scene: jms.Scene
    q0: Any
    qd0: Any


class Seen(NamedTuple):
    """What a run gives at the times asked for, and its events, padded with zeros."""

    q: Any
    qd: Any
    mode: Any
    force: Any
    events: Any
    after: Any
    count: Any


class End(NamedTuple):
    """What is differentiated: times of the events, padded with zeros, and the state at the end."""

    t: Any
    q: Any
    qd: Any


def run_it(start: Start, t1: Any, rtol: Any, **arguments: Any) -> jms.Trajectory:
    arguments |= {"rtol": rtol, "atol": 1e-2 * rtol, "max_events": EVENTS, "throw": False}
    return jms.simulate(start.scene, start.q0, start.qd0, t1, **arguments)


def observe(start: Start, ts: Any, rtol: Any) -> Seen:
    run = run_it(start, ts[-1], rtol, ts=ts)
    events = run.events
    t = jnp.where(jnp.isfinite(events.t), events.t, 0.0)
    seen = run.q[:, 0], run.qd[:, 0], run.mode["friction"], run.forces["friction"]
    return Seen(*seen, t, events.after, run.stats["num_events"])


def end(start: Start, t1: Any, adjoint: Any) -> End:
    run = run_it(start, t1, 1e-12, adjoint=adjoint)
    t = run.events.t
    return End(jnp.where(jnp.isfinite(t), t, 0.0), run.q[-1, 0], run.qd[-1, 0])


values = jax.jit(jax.vmap(observe, in_axes=(0, 0, None)))


@jax.jit
@jax.grad
def reverse(start: Start, t1: Any, weights: End) -> Any:
    products = jax.tree.map(lambda x, y: jnp.sum(x * y), weights, end(start, t1, None))
    return sum(products)


jacobian = jax.jit(jax.jacfwd(partial(end, adjoint=dfx.ForwardMode())))


def forward(start: Start, t1: Any, weights: End) -> Start:
    columns = jacobian(start, t1)
    parts = jax.tree.map(
        lambda w, column: jax.tree.map(lambda x: jnp.tensordot(w, x, w.ndim), column), weights, columns
    )
    return jax.tree.map(lambda *x: sum(x), *parts)


def pick(*, t: dict[int, float] | None = None, q: float = 0.0, qd: float = 0.0) -> End:
    """Weights of the numbers of an `End`: the derivatives are those of the weighted sum."""
    times = np.zeros(EVENTS)
    for i, weight in (t or {}).items():
        times[i] = weight
    return End(jnp.asarray(times), jnp.asarray(q), jnp.asarray(qd))


# On a table: several half cycles, with and without stiction, and a start within the range of rest.
SPRINGS = [
    problems.braked_spring.PARAMS,
    {"m": 0.7, "k": 3.1, "Fc": 0.2, "Fs": 0.2, "x0": 0.9},
    {"m": 2.0, "k": 40.0, "Fc": 1.0, "Fs": 2.5, "x0": 0.31},
    {"m": 1.0, "k": 1.0, "Fc": 1.0, "Fs": 1.5, "x0": 1.4},
]
# On a belt: the first three start in stick, the last one in slip.
BELTS = [
    problems.belt_oscillator.PARAMS,
    {"m": 2.3, "k": 61.0, "belt": 0.4, "Fc": 3.0, "Fs": 9.0},
    {"m": 0.5, "k": 300.0, "belt": 0.25, "Fc": 0.5, "Fs": 4.0},
    {"m": 1.4, "k": 150.0, "belt": 0.2, "Fc": 6.0, "Fs": 8.0},
]


def spring(numbers: dict[str, float]) -> Start:
    n = dict(numbers)
    scene = problems.braked_spring.scene(jms.Coulomb(n["Fc"], n["Fs"]), m=n["m"], k=n["k"])
    return Start(scene, jnp.array([n["x0"]]), jnp.zeros(1))


def belt(numbers: dict[str, float]) -> Start:
    n = dict(numbers)
    scene = problems.belt_oscillator.scene(jms.Coulomb(n.pop("Fc"), n.pop("Fs")), **n)
    slips = numbers is BELTS[-1]
    return Start(scene, jnp.array([0.1 if slips else 0.0]), jnp.array([0.0 if slips else n["belt"]]))


def spring_end(numbers: dict[str, float]) -> float:
    return 1.15 * float(problems.braked_spring.rest(**numbers).t) + 0.5


def belt_end(numbers: dict[str, float]) -> float:
    return 4.6 * float(problems.belt_oscillator.cycle(**numbers).period)


def together(starts: list[Start], ends: list[float]) -> tuple[Start, Any]:
    stacked = jax.tree.map(lambda *x: jnp.stack(x), *starts)
    return stacked, jnp.stack([jnp.linspace(0.0, t1, TIMES) for t1 in ends])


def by_number(gradient: Start) -> dict[str, Any]:
    """Derivatives by the names of the parameters."""
    friction = gradient.scene.effects[0]
    assert isinstance(friction, jms.Friction)
    law = friction.law
    assert isinstance(law, jms.Coulomb)
    numbers = {"Fc": law.Fc, "Fs": law.Fs, "belt": friction.belt_velocity, "x0": gradient.q0[..., 0]}
    return numbers | dict(gradient.scene.params)


def test_braked_spring_and_belt_oscillator_against_their_closed_forms() -> None:
    """One test for both, and for the tolerance, as they share the compiled code."""
    check_springs()
    check_belts()
    check_tolerances()


def check_springs() -> None:
    """Where and when the mass comes to rest, and how."""
    _, ts = start = together([spring(n) for n in SPRINGS], [spring_end(n) for n in SPRINGS])
    every = values(*start, 1e-12)
    for i, numbers in enumerate(SPRINGS):
        seen, rest = jax.tree.map(lambda x, i=i: np.asarray(x[i]), every), problems.braked_spring.rest(**numbers)
        n = int(rest.half_cycles)
        assert seen.count == n
        half = np.pi * np.sqrt(numbers["m"] / numbers["k"])
        np.testing.assert_allclose(seen.events[:n], half * np.arange(1, n + 1), atol=1e-10)
        np.testing.assert_array_equal(seen.events[n:], 0.0)
        np.testing.assert_array_equal(seen.after[:n], [*(-1) ** np.arange(n)][: n - 1] + [0] * (n > 0))
        np.testing.assert_allclose(seen.q[-1], rest.x, atol=1e-10)
        x, v = problems.braked_spring.motion(ts[i], **numbers)
        np.testing.assert_allclose(seen.q, x, atol=1e-9)
        np.testing.assert_allclose(seen.qd, v, atol=1e-9)
        resting = ts[i] > rest.t + 1e-9
        assert resting.sum() > 5
        # Up to the rounding of the forces in balance.
        np.testing.assert_allclose(seen.qd[resting], 0.0, atol=1e-15)
        np.testing.assert_array_equal(seen.mode[resting], 0.0)
        np.testing.assert_allclose(seen.force[resting], -numbers["k"] * rest.x, atol=1e-9)


def check_belts() -> None:
    """Period, stick, slip and places of the limit cycle."""
    start, ts = together([belt(n) for n in BELTS], [belt_end(n) for n in BELTS])
    every = values(start, ts, 1e-12)
    # Again, with the state kept at the events.
    at = jnp.concatenate([every.events[:, :8], jnp.repeat(ts[:, -1:], TIMES - 8, axis=1)], axis=1)
    again = values(start, at, 1e-12)
    for i, numbers in enumerate(BELTS):
        seen, cycle = jax.tree.map(lambda x, i=i: np.asarray(x[i]), every), problems.belt_oscillator.cycle(**numbers)
        first = int(numbers is BELTS[-1])  # the first event that begins a slip
        np.testing.assert_array_equal(seen.after[:8], [-1, 0, -1, 0, -1, 0, -1, 0] if first == 0 else [0, -1] * 4)
        t, x = seen.events[first : first + 7], again.q[i, first : first + 7]
        np.testing.assert_allclose(t[2:] - t[:-2], cycle.period, atol=1e-10)
        np.testing.assert_allclose(t[1::2] - t[:-1:2], cycle.slip, atol=1e-10)
        np.testing.assert_allclose(t[2::2] - t[1::2], cycle.stick, atol=1e-10)
        np.testing.assert_allclose(x[::2], cycle.begins, atol=1e-10)
        np.testing.assert_allclose(x[1::2], cycle.ends, atol=1e-10)
        if first == 0:
            np.testing.assert_allclose(t[0], numbers["Fs"] / numbers["k"] / numbers["belt"], rtol=1e-12)
        # In stick with the belt; in slip on an ellipse whose ends are the turning points.
        later = ts[i] > seen.events[0]
        sticks, slips = later & (seen.mode == 0), later & (seen.mode == -1)
        assert min(sticks.sum(), slips.sum()) >= 5
        assert (sticks | slips | ~later).all()
        np.testing.assert_allclose(seen.qd[sticks], numbers["belt"], rtol=1e-14)
        np.testing.assert_allclose(seen.force[sticks], -numbers["k"] * seen.q[sticks], rtol=1e-12, atol=1e-13)
        np.testing.assert_allclose(seen.force[slips], -numbers["Fc"], rtol=1e-14)
        w = np.sqrt(numbers["k"] / numbers["m"])
        middle, reach = 0.5 * (cycle.highest + cycle.lowest), 0.5 * (cycle.highest - cycle.lowest)
        if first == 0:
            np.testing.assert_allclose(np.hypot(seen.q[slips] - middle, seen.qd[slips] / w), reach, rtol=1e-8)


def check_tolerances() -> None:
    """The error of the period falls with the tolerance."""
    start, ts = together([belt(n) for n in BELTS], [belt_end(n) for n in BELTS])
    exact = np.array([problems.belt_oscillator.cycle(**n).period for n in BELTS])
    errors = []
    for rtol in (1e-4, 1e-7, 1e-10):
        t = values(start, ts, rtol).events
        errors.append(np.abs(np.asarray(t[:, 3] - t[:, 1]) - exact).max())
    assert errors[0] > 1e-7, "too good to show anything"
    assert errors[1] < 0.05 * errors[0]
    assert errors[2] < 0.05 * errors[1]
    assert errors[2] < 1e-8


def floats(numbers: dict[str, float]) -> dict[str, Any]:
    return {name: jnp.asarray(x) for name, x in numbers.items()}


rest_slopes = jax.jit(jax.jacrev(lambda n: problems.braked_spring.rest(**n)))
period_slopes = jax.jit(jax.grad(lambda n: problems.belt_oscillator.cycle(**n).period))


@pytest.mark.parametrize("derivatives", [forward, reverse], ids=["forward", "reverse"])
def test_derivatives_of_braked_spring_and_belt_oscillator(derivatives: Any) -> None:
    """One test for both, and for single events, as they share the compiled code."""
    for numbers in SPRINGS:
        start, t1 = spring(numbers), spring_end(numbers)
        exact, n = rest_slopes(floats(numbers)), int(problems.braked_spring.rest(**numbers).half_cycles)
        place = by_number(derivatives(start, t1, pick(q=1.0)))
        stop = by_number(derivatives(start, t1, pick(t={n - 1: 1.0} if n else None)))
        for name in numbers:
            np.testing.assert_allclose(place[name], exact.x[name], atol=1e-8, err_msg=f"place by {name}")
            np.testing.assert_allclose(stop[name], exact.t[name], atol=1e-8, err_msg=f"stop by {name}")
    for numbers in BELTS:
        period = by_number(derivatives(belt(numbers), belt_end(numbers), pick(t={3: 1.0, 1: -1.0})))
        exact = period_slopes(floats(numbers))
        for name in numbers:
            np.testing.assert_allclose(period[name], exact[name], rtol=1e-8, atol=1e-8, err_msg=f"period by {name}")
        # The cycle forgets where it began.
        np.testing.assert_allclose(period["x0"], 0.0, atol=1e-8)
    check_saltation(derivatives)


def check_saltation(derivatives: Any) -> None:
    """State after one event by the state before, less the way there and on: diag(1, a_plus/a_minus), diag(1, 0)."""
    m, k, fc, fs, x0, v0 = 1.3, 2.7, 0.4, 0.6, 0.5, 0.8
    w = np.sqrt(k / m)
    # Under +Fc the mass swings about -Fc/k.
    event = float(np.arctan2(v0 / w, x0 + fc / k) / w)
    top = np.hypot(x0 + fc / k, v0 / w) - fc / k

    def way(t: float) -> np.ndarray:
        c, s = np.cos(w * t), np.sin(w * t)
        return np.array([[c, s / w], [-w * s, c]])

    for low, high, after in ((fc, fs, "slip"), (fc, 3.0, "stick")):
        numbers = {"m": m, "k": k, "Fc": low, "Fs": high, "x0": x0}
        start = spring(numbers)._replace(qd0=jnp.array([v0]))
        rows = [derivatives(start, event + 0.2, weights) for weights in (pick(q=1.0), pick(qd=1.0))]
        after_by_before = np.array([[row.q0[0], row.qd0[0]] for row in rows])
        a_minus, a_plus = -k * top - low, -k * top + low
        if after == "slip":
            assert k * top > high
            exact, onward = np.diag([1.0, a_plus / a_minus]), way(0.2)
        else:
            exact, onward = np.diag([1.0, 0.0]), np.eye(2)
        saltation = np.linalg.solve(onward, after_by_before) @ np.linalg.inv(way(event))
        np.testing.assert_allclose(saltation, exact, atol=1e-9, err_msg=after)
