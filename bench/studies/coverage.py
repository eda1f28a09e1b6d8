"""Whether 95 % intervals hold the truth 95 times in 100: LuGre's six parameters from 200 noisy records.

A mass on a spring, driven through stick and slip, 2 000 samples of its position. Every repeat has noise of its own,
white or with a memory, starts from parameters wrong by up to a factor of ten, and is fitted side by side with the
others.
"""

import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxmodsim as jms
from bench.record import Result
from jaxmodsim.identify import Staged, coverage, replay

NOISE = 1e-5
TRUTH, WRONG = (1e4, 40.0, 2.0, 1.0, 1.5, 0.02), (1e5, 4.0, 0.2, 0.3, 2.0, 0.1)


def main(smoke: bool, out: Path) -> Result:
    """Fit once, then repeat on synthetic records."""
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
    return result


def _lagrangian(t: Any, q: Any, qd: Any, p: Any) -> Any:
    del t
    return 0.5 * p["m"] * qd[0] ** 2 - 0.5 * p["k"] * q[0] ** 2


def _drive(t: Any, q: Any, qd: Any, p: Any) -> Any:
    del t, q, qd
    return jnp.reshape(p["u"], (1,))


DRIVE = jms.AppliedForce(_drive)


def sprung(*numbers: float) -> jms.Scene:
    """A driven mass on a spring with LuGre friction of these six numbers."""
    friction = jms.Friction(jms.LuGre(*numbers))
    return jms.Scene(_lagrangian, params={"m": 1.0, "k": 200.0, "u": 0.0}, effects=(DRIVE, friction))


def driven_record() -> jms.Record:
    """2 000 samples of its position under a drive of three sines."""
    t, zero = np.arange(2000) * 2e-3, jnp.zeros(1)
    u = 3 * np.sin(2 * np.pi * 0.7 * t) + 2 * np.sin(2 * np.pi * 1.9 * t) + 1.2 * np.sin(2 * np.pi * 0.31 * t)
    run = jax.jit(replay, static_argnums=(5, 6))
    q = run(sprung(*TRUTH), jnp.asarray(t), {"u": jnp.asarray(u)}, zero, zero)
    return jms.Record(t, np.asarray(q), {"u": u}, noise=NOISE)
