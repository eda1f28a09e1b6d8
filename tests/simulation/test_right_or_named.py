"""Motions that were wrong under a success code, or ended without a reason, against references of their own."""

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import jaxmodsim as jms

BOX = {"m": 2.0, "A": 0.8441173414514593, "g": 0.09826644620612397, "w": 2.9358368442770417}
# On a grid of 0.2 ms; `test_piecewise` has it by matrix exponentials, too.
BOX_END = 0.0210472714


def box_lagrangian(t: Any, q: Any, qd: Any, p: Any) -> Any:
    del t, q
    return 0.5 * p["m"] * qd[0] ** 2


def growing_load(t: Any, q: Any, qd: Any, p: Any) -> Any:
    del q, qd
    return jnp.array([p["A"] * (1.0 + p["g"] * t) * jnp.sin(p["w"] * t)])


def shaken_box() -> jms.Scene:
    return jms.Scene(
        box_lagrangian, params=BOX, effects=(jms.AppliedForce(growing_load), jms.Friction(jms.Coulomb(1.0, 1.5)))
    )


@pytest.mark.parametrize(
    "how",
    [{}, {"rtol": 1e-9, "atol": 1e-12}, {"rtol": 1e-12, "atol": 1e-12}, {"ts": np.linspace(0.0, 10.0, 1001)}],
    ids=["default", "1e-9", "1e-12", "saved often"],
)
def test_a_box_at_rest_breaks_away_whenever_its_load_says_so(how: dict[str, Any]) -> None:
    run = jms.simulate(shaken_box(), [0.0], [0.0], 10.0, **how)
    assert int(run.stats["num_events"]) == 4
    assert float(run.q[-1, 0]) == pytest.approx(BOX_END, rel=10 * how.get("rtol", 1e-6), abs=1e-10)


def test_accuracy_of_a_box_at_rest_does_not_agree_with_itself() -> None:
    run = jms.simulate_to_accuracy(shaken_box(), [0.0], [0.0], 10.0, accuracy=1e-6)
    assert run.accuracy is not None
    assert abs(float(run.q[-1, 0]) - BOX_END) <= 3e-6 * BOX_END


def no_force(t: Any, q: Any, qd: Any, p: Any) -> Any:
    del t, q, qd
    return p["u"][None]


@pytest.mark.parametrize("linear", [False, True])
def test_a_slip_that_ends_just_before_or_behind_a_sample_ends(linear: bool) -> None:
    """v0 = 1, Fc/m = 1: rest at t = 1, q = 0.5."""
    gaps = np.geomspace(1e-15, 1e-3, 25)

    @jax.jit
    @jax.vmap
    def run(gap: Any) -> Any:
        signal = jms.Signal(jnp.array([0.0, 1.0, 1.5]) + gap * jnp.array([0.0, 1.0, 0.0]), jnp.zeros(3), linear=linear)
        effects = (jms.AppliedForce(no_force), jms.Friction(jms.Coulomb(1.0, 1.5)))
        scene = jms.Scene(box_lagrangian, params={"m": 1.0, "u": signal}, effects=effects)
        found = jms.simulate(scene, [0.0], [1.0], 2.0, throw=False)
        return found.code, found.q[-1, 0], found.stats["num_events"], found.stats["num_steps"]

    code, q, events, steps = run(np.concatenate([-gaps, [0.0], gaps]))
    assert not np.any(code)
    np.testing.assert_allclose(q, 0.5, rtol=1e-6)
    np.testing.assert_array_equal(events, 1)
    assert np.max(steps) < 100


# Two inertias on a spring, the torque in samples of 10 ms.
J1, J2, K, D1 = 2e-3, 8e-3, 30.0, 5e-3
FC, FS, VS, FV = 0.6, 0.9, 0.3, 1e-3
TIMES = np.arange(0.0, 5.0 + 1e-9, 0.01)
TORQUE = 1.2 * np.sin(2 * np.pi * 0.4 * TIMES) + 0.4 * np.sign(np.sin(2 * np.pi * 1.3 * TIMES))


def inertias_lagrangian(t: Any, q: Any, qd: Any, p: Any) -> Any:
    del t
    return 0.5 * p["J1"] * qd[0] ** 2 + 0.5 * p["J2"] * qd[1] ** 2 - 0.5 * p["k"] * (q[0] - q[1]) ** 2


def torque(t: Any, q: Any, qd: Any, p: Any) -> Any:
    del t, q, qd
    return jnp.array([p["u"], 0.0])


def first(q: Any) -> Any:
    return q[0]


def second(q: Any) -> Any:
    return q[1]


def inertias() -> jms.Scene:
    effects = (
        jms.AppliedForce(torque),
        jms.Friction(jms.Viscous(D1), along=first, name="bearing"),
        jms.Friction(jms.Stribeck(Fc=FC, Fs=FS, vs=VS, Fv=FV), along=second, name="brake"),
    )
    params = {"J1": J1, "J2": J2, "k": K, "u": jms.Signal(TIMES, TORQUE)}
    return jms.Scene(inertias_lagrangian, params=params, effects=effects)


def reference_of_inertias() -> tuple[np.ndarray, list[float]]:
    """End state and times of mode changes, by SciPy from event to event and from sample to sample."""

    def brake(v: float, mode: int) -> float:
        return mode * (FC + (FS - FC) * math.exp(-((v / VS) ** 2))) + FV * v

    def field(_: float, y: np.ndarray, u: float, mode: int) -> list[float]:
        spring = K * (y[0] - y[1])
        second = (spring - brake(y[3], mode)) / J2 if mode else 0.0
        return [y[2], y[3] if mode else 0.0, (u - spring - D1 * y[2]) / J1, second]

    def at_rest(y: np.ndarray) -> int:
        spring = K * (y[0] - y[1])
        return int(np.sign(spring)) if abs(spring) > FS else 0

    def guard(_: float, y: np.ndarray, __: float, mode: int) -> float:
        return mode * y[3] if mode else FS - abs(K * (y[0] - y[1]))

    guard.terminal, guard.direction = True, -1.0  # pyright: ignore[reportFunctionMemberAccess]
    y, mode, changes = np.zeros(4), 0, []
    for t0, t1, u in zip(TIMES[:-1], TIMES[1:], TORQUE[:-1], strict=True):
        t = t0
        while t < t1:
            part = solve_ivp(field, (t, t1), y, method="DOP853", events=guard, args=(u, mode), rtol=1e-12, atol=1e-14)
            t, y = part.t[-1], part.y[:, -1]
            if part.status == 1:
                y[3] = 0.0
                mode = at_rest(y) if mode else int(np.sign(K * (y[0] - y[1])))
                changes.append(t)
    return y, changes


def test_events_are_in_order_and_as_many_at_every_tolerance() -> None:
    end, changes = reference_of_inertias()
    for rtol in (1e-5, 1e-6, 1e-7, 1e-8, 1e-9):
        run = jms.simulate(inertias(), [0.0, 0.0], [0.0, 0.0], 5.0, rtol=rtol, atol=1e-3 * rtol)
        t = np.asarray(run.events.t)
        t = t[np.isfinite(t)]
        assert np.all(np.diff(t) >= 0.0)
        assert len(t) == int(run.stats["num_events"]) == len(changes)
        # Slip and its return enlarge the error of a step some hundred times.
        np.testing.assert_allclose(t, changes, atol=1e3 * rtol)
        np.testing.assert_allclose(run.q[-1], end[:2], atol=1e3 * rtol)


def test_gradients_pass_where_differences_converge() -> None:
    def end(scene: jms.Scene, simulate: Any = jms.simulate) -> Any:
        return simulate(scene, [0.0, 0.0], [0.0, 0.0], 1.43, rtol=1e-8, atol=1e-11).q[-1, 0]

    check = jms.check_gradients(end, inertias(), names=["k", "J2"])
    assert check.ok, str(check)
