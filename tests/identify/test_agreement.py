"""Records that agree are not said to differ, and those that do not are."""

import jax.numpy as jnp
import numpy as np
import pytest

import jaxmodsim as jms
from jaxmodsim.identify import agreement, axis_models, axis_scene, estimate_axis, law_force

from ..helpers.axis_records import slide

NUMBERS = {"Fs": 1.6, "vs": 0.02, "Fv": 2.0}
T = np.arange(0.0, 4.0, 5e-3)


def record(name: str, seed: int, Fc: float) -> jms.Record:
    """A measured friction force of a Stribeck law under a motion in both directions."""
    x = 0.05 * np.sin(2 * np.pi * 0.6 * T + 0.3 * seed) + 0.02 * np.sin(2 * np.pi * 1.7 * T)
    law = jms.Regularized(jms.Stribeck(Fc=Fc, **NUMBERS), 1e-3)
    force = np.asarray(law_force(law, jnp.asarray(T), jnp.asarray(x)))
    return jms.Record(T, force + 0.05 * np.random.default_rng(seed).standard_normal(T.size), {"x": x}, name)


def found(Fc: float, seed: int, count: int = 2) -> jms.identify.RecordAgreement:
    days = [record(f"day {i}", count * seed + i, Fc if i else 1.0) for i in range(count)]
    start = jms.Regularized(jms.Stribeck(Fc=0.8, Fs=1.5, vs=0.03, Fv=1.5), 1e-3)
    return agreement(jms.fit_law(start, days, ("Fc", "Fs", "vs", "Fv")))


def test_a_level_that_changed_is_named_and_nothing_else() -> None:
    each = found(1.07, 0)
    assert each.differing == ("Fc",)
    assert each.values[:, 0] == pytest.approx([1.0, 1.07], abs=0.02)
    assert "The records differ in Fc by" in str(each)
    assert "They do not show a difference in Fs, vs, Fv." in str(each)


def test_false_alarms_and_what_is_found() -> None:
    # Of 40 pairs 2 are expected to be said to differ at the level of 5 %; 7 or more happen in one of 200 such tests.
    alike = [found(1.0, seed) for seed in range(40)]
    assert sum(bool(each.differing) for each in alike) < 7
    p = np.sort([each.p[0] for each in alike])
    # Kolmogorov and Smirnov: 0.26 is exceeded once in 100 times by 40 uniform numbers.
    assert np.max(np.abs(p - np.linspace(0, 1, 40))) < 0.26
    assert sum("Fc" in found(1.05, seed).differing for seed in range(10)) >= 8


def axis_day(name: str, seed: int, Fc: float) -> jms.Record:
    """An axis of 50 kg under a force, and under a disturbance that no model knows."""
    rng, t = np.random.default_rng(seed), 4e-3 * np.arange(2000)
    u = 60.0 * np.sin(np.pi * t) + 25.0 * np.sin(2.6 * np.pi * t + 1.0)
    unknown = sum(0.3 * np.sin(2 * np.pi * rate * t + rng.uniform(0, 2 * np.pi)) for rate in (0.3, 0.7, 1.9))
    q = slide(t, u + unknown, 0.0, 50.0, Fc, 120.0, 2.0) + 2e-6 * rng.standard_normal(t.size)
    return jms.Record(t, q, {"u": u}, name)


def test_friction_that_changed_by_a_newton_is_seen_through_its_correlation_with_viscous_friction() -> None:
    model, found = axis_models()["coulomb"], []
    for seed in range(6):
        days = [axis_day("one", 2 * seed, 20.0), axis_day("other", 2 * seed + 1, 21.2)]
        scene = axis_scene(model, estimate_axis(days[0]))
        each = agreement(jms.fit(scene, days, model.free, limits={"m": (0.0, None)}))
        found.append(each.differing)
        k = each.names.index("dry.Fc")
        if "dry.Fc" in each.differing:
            assert np.diff(each.values[:, k]) == pytest.approx(1.2, abs=0.5)
    # Motions like these tell Coulomb from viscous friction badly: estimates correlate by -0.94.
    assert sum(bool({"dry.Fc", "viscous.Fv"} & {*names}) for names in found) >= 5


def test_what_cannot_be_compared_is_refused() -> None:
    start = jms.Regularized(jms.Stribeck(Fc=0.8, Fs=1.5, vs=0.03, Fv=1.5), 1e-3)
    alone = jms.fit_law(start, record("alone", 0, 1.0), ("Fc",))
    with pytest.raises(ValueError, match="1 were fitted in 1 parts"):
        agreement(alone)
