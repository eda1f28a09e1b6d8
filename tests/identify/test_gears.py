"""Friction of servo gears from records: the richest model comes back within its intervals."""

from typing import Any

import jax.numpy as jnp
import numpy as np

import jaxmodsim as jms
from jaxmodsim import Bristle, ServoGear
from jaxmodsim.identify import FitResult, law_force, replay

TRUTH = {
    "Kc": 0.05, "Kv": 0.03, "Kcs": 0.1, "vs": 1.2, "alpha": 1.4, "Km": 0.2, "Ke": 0.05, "Kms": 0.15, "Kes": 0.08,
    "Kmq": 0.02, "Keq": 0.03,
}  # fmt: skip
H = 5e-3


def motor(t: Any, q: Any, qd: Any, p: Any) -> Any:
    del t, q, qd
    return p["motor"]


def external(t: Any, q: Any, qd: Any, p: Any) -> Any:
    del t, q, qd
    return p["external"]


def gravity(t: Any, q: Any, qd: Any, p: Any) -> Any:
    del t, qd
    return -p["mgl"] * jnp.sin(q[0])


def first(q: Any, qd: Any) -> Any:
    del qd
    return q[0]


def beside(sizes: tuple[float, float]) -> dict[str, float]:
    """The truth, every number off by one of the factors in turn."""
    return {name: value * sizes[i % 2] for i, (name, value) in enumerate(TRUTH.items())}


def misses(result: FitResult, prefix: str = "") -> np.ndarray:
    """Errors of the eleven numbers, in standard errors."""
    return np.array([(result.values[prefix + n] - x) / result.errors[prefix + n] for n, x in TRUTH.items()])


def test_the_richest_model_from_measured_torques() -> None:
    t = np.arange(0.0, 40.0, 5e-3)
    inputs = {
        "x": 0.8 * np.sin(1.7 * t) + 0.5 * np.sin(0.61 * t) + 0.9 * np.sin(0.23 * t) * np.sin(3.1 * t),
        "motor": 2.5 * np.sin(0.83 * t) + 1.5 * np.sin(2.9 * t + 1.0),
        "external": 2.0 * np.sin(1.13 * t + 2.0) + 1.5 * np.sin(0.37 * t),
    }
    given = {name: jnp.asarray(x) for name, x in inputs.items()}
    truth = Bristle(ServoGear(motor, external, **TRUTH), H)
    force = np.asarray(law_force(truth, jnp.asarray(t), given["x"], None, given))
    start = Bristle(ServoGear(motor, external, **beside((1.5, 0.6))), H)
    found = []
    for seed in range(4):
        noise = 2e-3 * np.random.default_rng(seed).standard_normal(t.size)
        result = jms.fit_law(start, jms.Record(t, force + noise, inputs))
        assert result.diagnostics.ending == "converged"
        assert result.diagnostics.evaluations <= 1000
        found.append(misses(result))
    # Of 44 draws 95 % are expected within 1.96; fewer than 38 have a probability below 2 %.
    assert np.sum(np.abs(found) < 1.96) >= 38
    assert np.max(np.abs(found)) < 4.0
    assert np.max(np.abs(found[0])) < 1.96


def swing(numbers: dict[str, float]) -> jms.Scene:
    """A pendulum on a servo."""

    def kinetic(t: Any, q: Any, qd: Any, p: Any) -> Any:
        del t, q
        return 0.5 * p["J"] * qd[0] ** 2

    def push(t: Any, q: Any, qd: Any, p: Any) -> Any:
        return jnp.stack([motor(t, q, qd, p) + gravity(t, q, qd, p)])

    law = Bristle(ServoGear(motor, gravity, **numbers), H)
    return jms.Scene(kinetic, {"J": 0.05, "mgl": 1.5, "motor": 0.0}, (jms.AppliedForce(push), jms.Friction(law)))


def test_the_richest_model_from_angles_of_a_pendulum() -> None:
    t, rest, records = np.arange(0.0, 20.0, 5e-3), jnp.zeros(1), []
    for i, (size, f, phase) in enumerate([(1.1, 0.31, 0.0), (0.8, 0.9, 1.2), (1.8, 1.7, 0.3), (1.1, 0.13, 2.0)]):
        fast = 0.3 * np.sin(2 * np.pi * 2.3 * f * t)
        torque = size * np.sin(2 * np.pi * f * t + phase) + fast + 0.2 * np.sin(1.1 * t)
        q = np.asarray(replay(swing(TRUTH), jnp.asarray(t), {"motor": jnp.asarray(torque)}, rest, rest, 1, first))
        q = q + 1e-4 * np.random.default_rng(i + 8).standard_normal(t.size)
        records.append(jms.Record(t, q, {"motor": torque}, name=f"record {i}"))
    free = [f"friction.{name}" for name in TRUTH]
    result = jms.fit(swing(beside((0.9, 1.1))), records, free, q0=[0.0])
    assert result.diagnostics.ending == "converged"
    assert result.diagnostics.evaluations <= 1000
    assert np.max(np.abs(misses(result, "friction."))) < 1.96
