"""Coverage of 95 % confidence intervals: the six parameters of LuGre, and fits with default initial states.

A mass on a spring is driven through stick and slip, with 2 000 samples of its position. Every repeat has its own noise,
white or correlated, starts from parameters wrong by up to a factor of ten, and is fitted in one batch with the others.
Then the default `fit` estimates mass, Coulomb and viscous friction from records of 600 samples, each of another motion:
with white noise, a sensor resolution of 1 mm, or a sensor offset of 5 mm, for which a warning is right too.
"""

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np

import jaxmodsim as jms
from bench.record import Result
from jaxmodsim.identify import Staged, coverage, replay, warnings_for

NOISE = 1e-5
TRUTH, WRONG = (1e4, 40.0, 2.0, 1.0, 1.5, 0.02), (1e5, 4.0, 0.2, 0.3, 2.0, 0.1)
DRY = {"m": 2.0, "Fc": 1.5, "Fv": 0.6}
Measure: TypeAlias = Callable[[np.ndarray, np.random.Generator], np.ndarray]
SENSORS: dict[str, Measure] = {
    "white noise of 0.2 mm": lambda q, rng: q + 2e-4 * rng.standard_normal(q.shape),
    "steps of 1 mm": lambda q, rng: np.round(q / 1e-3) * 1e-3,  # noqa: ARG005
    "offset of 5 mm, noise of 0.2 mm": lambda q, rng: q + 5e-3 + 2e-4 * rng.standard_normal(q.shape),
}


def main(smoke: bool, out: Path) -> Result:
    """Fit once, then repeat with synthetic records."""
    del out
    repeats = 4 if smoke else 200
    free = tuple(f"friction.{name}" for name in ("sigma0", "sigma1", "sigma2", "Fc", "Fs", "vs"))
    fitted = jms.fit(sprung(*WRONG), driven_record(), free, q0=[0.0], initializer=Staged())
    result = Result("coverage", (), {"repeats": repeats})
    for label, memory in (("white", 0.0), ("correlation 0.9 from sample to sample", 0.9))[: 1 if smoke else 2]:
        started = time.perf_counter()
        found = coverage(fitted, repeats, memory=memory, initializer=Staged())
        result.add("time", time.perf_counter() - started, "s", case=label)
        result.add("converged", found.converged, case=label)
        for name, share in found.shares.items():
            result.add("share", 100.0 * share, "%", case=label, at=name.removeprefix("friction."))
    for label, measure in SENSORS.items():
        _default_start(result, label, measure, repeats)
    return result


def _default_start(result: Result, label: str, measure: Measure, repeats: int) -> None:
    """Measure the coverage of default fits, and the share of fits with a warning on a sensor offset."""
    rng, t, zero = np.random.default_rng(0), 5e-3 * np.arange(600), jnp.zeros(1)
    rates = 2 * np.pi * rng.uniform([0.15, 0.7, 1.5], [0.55, 1.1, 1.9], (repeats, 3))
    phases = rng.uniform(0, 2 * np.pi, (repeats, 3, 1))
    forces = np.sum(np.array([2.0, 1.5, 2.0])[:, None] * np.sin(rates[..., None] * t + phases), axis=1)
    run = jax.jit(jax.vmap(lambda u: replay(dry(**DRY), jnp.asarray(t), {"u": u}, zero, zero, 4)))
    held, warned, right = np.zeros(3), 0, 0
    for u, q in zip(forces, np.asarray(run(jnp.asarray(forces))), strict=True):
        record = jms.Record(t, measure(q, rng), {"u": u})
        fitted = jms.fit(dry(1.6, 1.0, 0.9), record, ("m", "friction.Fc", "viscous.Fv"), substeps=4)
        spans = fitted.estimate.intervals().values()
        inside = [low <= true <= high for true, (low, high) in zip(DRY.values(), spans, strict=True)]
        said = any("constant offset" in each for each in warnings_for(fitted))
        held, warned, right = held + inside, warned + said, right + (said or all(inside))
    for name, count in zip(DRY, held, strict=True):
        result.add("held", 100.0 * float(count) / repeats, "%", case=label, at=name)
    result.add("warning on an offset", 100.0 * warned / repeats, "%", case=label)
    result.add("warning, or all hold", 100.0 * right / repeats, "%", case=label)


def _lagrangian(t: Any, q: Any, qd: Any, p: Any) -> Any:
    del t
    return 0.5 * p["m"] * qd[0] ** 2 - 0.5 * p["k"] * q[0] ** 2


def _drive(t: Any, q: Any, qd: Any, p: Any) -> Any:
    del t, q, qd
    return jnp.reshape(p["u"], (1,))


DRIVE = jms.AppliedForce(_drive)


def sprung(*numbers: float) -> jms.Scene:
    """A driven mass on a spring with LuGre friction of these six parameters."""
    friction = jms.Friction(jms.LuGre(*numbers))
    return jms.Scene(_lagrangian, params={"m": 1.0, "k": 200.0, "u": 0.0}, effects=(DRIVE, friction))


def dry(m: float, Fc: float, Fv: float) -> jms.Scene:
    """A driven mass on a spring with smooth Coulomb friction and viscous friction."""
    friction = jms.Friction(jms.Regularized(jms.Coulomb(Fc), 1e-2), name="friction")
    effects = (DRIVE, friction, jms.Friction(jms.Viscous(Fv), name="viscous"))
    return jms.Scene(_lagrangian, params={"m": m, "k": 20.0, "u": 0.0}, effects=effects)


def driven_record() -> jms.Record:
    """2 000 samples of the position under a force of three sines."""
    t, zero = np.arange(2000) * 2e-3, jnp.zeros(1)
    u = 3 * np.sin(2 * np.pi * 0.7 * t) + 2 * np.sin(2 * np.pi * 1.9 * t) + 1.2 * np.sin(2 * np.pi * 0.31 * t)
    run = jax.jit(replay, static_argnums=(5, 6))
    q = run(sprung(*TRUTH), jnp.asarray(t), {"u": jnp.asarray(u)}, zero, zero)
    return jms.Record(t, np.asarray(q), {"u": u}, noise=NOISE)
