"""Predictions of a fit for a new record: prediction bands, and the selected law.

The records are synthetic pairs of an axis with LuGre friction. The friction level differs between both records and
depends on position, unlike in all candidates. Laws are fitted to the first record, and one is selected by
cross-validation on it; then all of them are run on the second record.
"""

from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import jaxmodsim as jms
from bench.record import Result
from jaxmodsim.identify import (
    Candidate,
    Comparison,
    axis_models,
    axis_scene,
    compare,
    estimate_axis,
    predict,
    replay,
)

# Mass [kg], parameters of LuGre except Fs [N], share and length [m] of the dependence on position, offset [N].
MASS, LUGRE, RIPPLE, PITCH, OFFSET = 50.0, (1e5, 1000.0, 120.0, 20.0, 0.03), 0.05, 0.005, 2.0
# Ratio of Fs to Fc.
STICTION = (1.1, 1.3)
SAMPLES, STEP, NOISE, LARGEST = 2000, 4e-3, 2e-6, 0.1
LAWS = ("coulomb", "asymmetric", "stribeck", "lugre")


def main(smoke: bool, out: Path) -> Result:
    """Run all pairs, half of them with low stiction and half with high stiction."""
    del out
    pairs, rng = 1 if smoke else 20, np.random.default_rng(0)
    result = Result("new_records", (), {"pairs": 2 * pairs, "largest": 100 * LARGEST})
    for stiction in STICTION[: 1 if smoke else 2]:
        found = [_pair(rng.uniform(-LARGEST, LARGEST), stiction, rng) for _ in range(pairs)]
        least = np.min([list(each.errors.values()) for each in found], axis=1)
        for name in ("chosen", *LAWS):
            laws = [each.chosen if name == "chosen" else name for each in found]
            error = np.array([each.errors[law] for each, law in zip(found, laws, strict=True)])
            held = np.mean([each.shares[law] for each, law in zip(found, laws, strict=True)])
            case = {"case": name, "at": f"Fs = {stiction} Fc"}
            result.add("samples in the band", 100 * float(held), "%", **case)
            result.add("within 10 % of the best", 100 * float(np.mean(error <= 1.1 * least)), "%", **case)
            result.add("median error", float(np.median(error)), "m", **case)
    return result


class _Pair(NamedTuple):
    """The law selected on the first record, and for every law its error [m] and band coverage on the second."""

    chosen: str
    errors: dict[str, float]
    shares: dict[str, float]


def _truth(level: float, stiction: float) -> jms.Scene:
    sigma0, sigma1, sigma2, Fc, vs = LUGRE
    law = jms.LuGre(sigma0, sigma1, sigma2, level * Fc, level * stiction * Fc, vs)
    uneven = jms.friction.scaled_by(law, _uneven, ["Fc", "Fs"])
    return jms.Scene(
        _lagrangian,
        params={"m": MASS, "u": 0.0, "offset": OFFSET, "ripple": RIPPLE, "pitch": PITCH},
        effects=(jms.AppliedForce(_drive, name="drive"), jms.Friction(uneven, name="friction")),
    )


def _lagrangian(t, q, qd, p):
    del t, q
    return 0.5 * p["m"] * qd[0] ** 2


def _drive(t, q, qd, p):
    del t, q, qd
    return jnp.reshape(p["u"] - p["offset"], (1,))


def _uneven(t, q, qd, p):
    del t, qd
    return 1.0 + p["ripple"] * jnp.sin(2 * jnp.pi * q[0] / p["pitch"])


_run = jax.jit(replay, static_argnums=5)


def record(level: float, stiction: float, rng: np.random.Generator, name: str) -> jms.Record:
    """A record of the axis with this friction level: the same motion with another disturbance each time."""
    t = STEP * np.arange(SAMPLES)
    u = OFFSET + 60.0 * np.sin(2 * np.pi * 0.5 * t) + 25.0 * np.sin(2 * np.pi * 1.3 * t + 1.0)
    u = u + sum(6.0 * np.sin(2 * np.pi * rate * t + rng.uniform(0, 2 * np.pi)) for rate in (0.8, 2.1, 3.7))
    zero = jnp.zeros(1)
    q = np.asarray(_run(_truth(level, stiction), jnp.asarray(t), {"u": jnp.asarray(u)}, zero, zero, 4))
    return jms.Record(t, q + NOISE * rng.standard_normal(SAMPLES), {"u": u}, name)


def _compared(one: jms.Record) -> Comparison:
    rough = estimate_axis(one)
    models = {name: axis_models()[name] for name in LAWS}
    candidates = {name: Candidate(axis_scene(model, rough), model.free) for name, model in models.items()}
    return compare(candidates, one, limits={"m": (0.0, None)})


def _pair(change: float, stiction: float, rng: np.random.Generator) -> _Pair:
    compared = _compared(record(1.0, stiction, rng, "one"))
    other = record(1.0 + change, stiction, rng, "other")
    predicted = {name: predict(result, other) for name, result in compared.results.items()}
    errors = {name: predicted[name].score.rmse["measured"] if name in predicted else np.inf for name in LAWS}
    shares = {name: predicted[name].shares["measured"] if name in predicted else 0.0 for name in LAWS}
    return _Pair(compared.simplest, errors, shares)
