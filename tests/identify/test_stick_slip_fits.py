"""Fits of scenes with set-valued laws: exact friction, noise of the residual, derivatives that do not hold."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxmodsim as jms
from jaxmodsim.identify import Controller, axis_models, axis_scene, estimate_axis, replay, warnings_for
from jaxmodsim.identify.data._signals import sample_noise

from ..helpers.axis_records import slide

TRUTH = {"m": 3.0, "offset": 0.3, "dry.Fc": 4.0, "viscous.Fv": 12.0}
NOISE = 2e-6


def drive(t):
    """Force [N] under which the axis stands still 14 times in 8 s, for a tenth of the time."""
    return 9.0 * (np.sin(2 * np.pi * 0.5 * t) + 0.5 * np.sin(2 * np.pi * 1.3 * t + 0.4))


def dwelling(seconds: float = 8.0, rate: float = 1000.0, seed: int = 0) -> jms.Record:
    t = np.arange(round(seconds * rate) + 1) / rate
    q = slide(t, drive(t), 0.0, *(TRUTH[name] for name in ("m", "dry.Fc", "viscous.Fv", "offset")))
    return jms.Record(t, q + NOISE * np.random.default_rng(seed).standard_normal(t.size), {"u": drive(t)})


@pytest.fixture(scope="module")
def record():
    return dwelling(4.0, 500.0)


def axis(friction, m: float = 3.02, k: float = 0.0) -> jms.Scene:
    return jms.Scene(
        lambda t, q, qd, p: 0.5 * p["m"] * qd[0] ** 2 - 0.5 * p["k"] * q[0] ** 2,
        params={"m": m, "k": k, "offset": 0.3, "u": 0.0},
        effects=(
            jms.AppliedForce(lambda t, q, qd, p: jnp.reshape(p["u"] - p["offset"], (1,)), name="drive"),
            jms.Friction(friction, name="dry"),
            jms.Friction(jms.Viscous(11.9), name="viscous"),
        ),
    )


def test_an_axis_that_stands_still_is_found_within_its_intervals():
    record, model = dwelling(), axis_models()["coulomb"]
    result = jms.fit(axis_scene(model, estimate_axis(record)), record, (*model.free, "q0", "qd0"))
    assert result.diagnostics.ending == "converged"
    for name, (low, high) in result.estimate.intervals().items():
        assert low < TRUTH.get(name, 0.0) < high, name
    assert result.errors["dry.Fc"] < 1e-4
    assert result.rmse == pytest.approx(NOISE, rel=0.05)
    assert not any("sample to sample" in warning for warning in warnings_for(result))


def test_a_small_constant_force_is_determined_if_its_error_is_small_beside_the_forces():
    t = np.arange(2001) / 500.0
    q = slide(t, drive(t), 0.0, 3.0, 4.0, 12.0, -0.002)
    record = jms.Record(t, q + 5e-3 * np.random.default_rng(2).standard_normal(t.size), {"u": drive(t)})
    result = jms.fit(axis(jms.Coulomb(4.01)), record, tuple(TRUTH))
    assert result.errors["offset"] > 0.5 * abs(result.values["offset"])
    assert result.errors["offset"] < 0.01
    assert not any("determine" in warning or "offset" in warning for warning in warnings_for(result))


def test_a_residual_above_the_noise_is_said(record):
    smooth = jms.fit(axis(jms.Regularized(jms.Coulomb(4.01), 5e-4)), record, tuple(TRUTH), substeps=8)
    assert smooth.rmse > 5 * NOISE
    assert any("is above the noise from sample to sample, 1.9e-06" in warning for warning in warnings_for(smooth))


@pytest.mark.parametrize(
    ("of", "level"),
    [
        ("motion", 0.0),
        ("white", 2e-6),
        ("quantised", 1e-3 / 12**0.5),
        ("outliers", 2e-6),
        ("impacts", 2e-6),
    ],
)
def test_noise_from_sample_to_sample(of, level):
    t = np.linspace(0.0, 8.0, 8001)
    rng, x = np.random.default_rng(0), 0.1 * np.sin(3.0 * t)
    if of != "motion":
        x = x + 2e-6 * rng.standard_normal(t.size)
    if of == "quantised":
        x = 1e-3 * np.round(x / 1e-3)
    if of == "outliers":
        x[rng.integers(0, t.size, 5)] += 0.05
    if of == "impacts":
        x = x + 0.1 * np.abs(np.sin(2.0 * t))
    assert sample_noise(x) == pytest.approx(level, rel=0.05, abs=1e-8)


@pytest.mark.parametrize("width", [1e-5, 1e-6])
def test_standard_errors_of_derivatives_that_do_not_hold_are_refused(width):
    # Steps of 1 ms do not resolve the width: the tangent grows by many powers of ten where the sign changes.
    record = dwelling()
    result = jms.fit(axis(jms.Regularized(jms.Coulomb(4.01), width)), record, tuple(TRUTH), max_steps=20)
    assert set(result.errors.values()) == {np.inf}
    said = warnings_for(result)
    assert any(warning.startswith("Standard errors are refused") for warning in said)
    assert not any("no effect" in warning or "told apart" in warning for warning in said)


def test_a_residual_of_nothing_but_rounding_gives_no_standard_errors():
    t = np.arange(801) / 500.0
    q = slide(t, drive(t), 0.0, *(TRUTH[name] for name in ("m", "dry.Fc", "viscous.Fv", "offset")))
    scene = axis(jms.Regularized(jms.Coulomb(4.01), 1.0))
    same = replay(scene, jnp.asarray(t), {"u": jnp.asarray(drive(t))}, jnp.zeros(1), jnp.zeros(1))
    result = jms.fit(scene, jms.Record(t, np.asarray(same), {"u": drive(t)}), ("m", "dry.Fc"), q0=[q[0]])
    assert set(result.errors.values()) == {np.inf}


def test_a_record_of_many_samples_and_a_scene_that_starts_far_away_are_fitted():
    record = dwelling(20.0)
    result = jms.fit(axis(jms.Coulomb(3.0), m=2.5), record, (*TRUTH, "q0", "qd0"))
    assert result.rmse == pytest.approx(NOISE, rel=0.05)


RUNS = {
    "stiction, held": (jms.Coulomb(4.0, 5.0), False),
    "stribeck, linear": (jms.Stribeck(Fc=3.0, Fs=4.5, vs=0.05, Fv=1.0), True),
    "asymmetric, held": (jms.friction.asymmetric(jms.Coulomb(4.0), Fc=3.5), False),
}


@pytest.mark.parametrize(("law", "linear"), RUNS.values(), ids=RUNS)
def test_steps_from_sample_to_sample_are_the_run_by_events(law, linear):
    t = np.arange(401) / 100.0
    u = jnp.asarray(drive(t))
    scene = axis(law, k=20.0)
    record = jms.Record(t, np.zeros(t.size), {"u": drive(t)}, linear=("u",) if linear else ())
    result = jms.fit(scene, record, ("m",), q0=[0.0], qd0=[0.1], substeps=16, max_steps=1)
    driven = eqx.tree_at(lambda s: s.params, scene, {**scene.params, "u": jms.Signal(t, u, linear=linear)})
    run = jms.simulate(driven, [0.0], [0.1], t[-1], ts=t, rtol=1e-11, atol=1e-13)
    assert int(np.isfinite(run.events.t).sum()) > 5
    np.testing.assert_allclose(result.simulated, run.q[:, 0], atol=1e-8)


def two_masses(p) -> jms.Scene:
    """A driven mass that carries another one, both under friction."""
    return jms.Scene(
        lambda t, q, qd, p: 0.5 * qd[0] ** 2 + 0.5 * p["m"] * qd[1] ** 2 - 0.5 * p["k"] * q[0] ** 2,
        params={"u": 0.0, **p},
        effects=(
            jms.AppliedForce(lambda t, q, qd, p: jnp.stack([p["u"], 0.0 * p["u"]]), name="drive"),
            jms.Friction(jms.Coulomb(1.5, 2.0), along=lambda q: q[0], name="ground"),
            jms.Friction(jms.Coulomb(0.8), along=lambda q: q[1] - q[0], name="between"),
        ),
    )


def test_two_elements_and_their_derivatives():
    t = jnp.arange(601) / 200.0
    u = 6.0 * jnp.sin(5.0 * t) + 2.0 * jnp.sin(13.0 * t)

    @jax.jit
    def end(k, m, v, steps=8):
        zero = jnp.zeros(2)
        return replay(two_masses({"k": k, "m": m}), t, {"u": u}, zero, jnp.stack([v, 0.0]), steps, lambda q, qd: q[1])

    point = (jnp.asarray(30.0), jnp.asarray(0.7), jnp.asarray(0.2))
    driven = two_masses({"k": 30.0, "m": 0.7})
    driven = eqx.tree_at(lambda s: s.params, driven, {**driven.params, "u": jms.Signal(t, u)})
    run = jms.simulate(driven, [0.0, 0.0], [0.2, 0.0], 3.0, ts=t, rtol=1e-11, atol=1e-13)
    np.testing.assert_allclose(end(*point), run.q[:, 1], atol=1e-7)
    slopes = jax.jacfwd(end, argnums=(0, 1, 2))(*point)
    for i, slope in enumerate(slopes):
        # Central differences: 1e-6 of the value balances the third derivative against rounding of the events, 1e-12.
        step = 1e-6 * point[i]
        up, down = (end(*(x + side * step * (j == i) for j, x in enumerate(point))) for side in (1.0, -1.0))
        np.testing.assert_allclose(slope, (up - down) / (2 * step), atol=2e-5 * float(jnp.max(jnp.abs(slope))))


def test_a_controller_and_an_observed_force_pass_stick():
    loop = Controller(lambda t, q, qd, memory, p: ({"u": p["P"] * (p["r"] - q[0]) - 20.0 * qd[0]}, memory))
    t = np.arange(801) / 200.0
    reference = 0.05 * np.sign(np.sin(3.0 * t))
    base = axis(jms.Coulomb(4.0), m=3.0)

    def scene(P, Fc):
        effects = (base.effects[0], jms.Friction(jms.Coulomb(Fc), name="dry"), base.effects[2])
        return jms.Scene(base.lagrangian, params={**base.params, "P": P, "r": 0.0}, effects=effects)

    seen = {"x": "q[0]", "F": "dry"}
    blank = jms.Record(
        t, {"x": np.zeros(t.size), "F": np.zeros(t.size)}, {"r": reference}, noise={"x": 1e-5, "F": 1e-2}
    )
    truth = jms.fit(scene(400.0, 4.0), blank, ("P",), observe=seen, q0=[0.0], controller=loop, max_steps=1)
    rng, outputs = np.random.default_rng(0), truth.provenance.outputs[0]
    stands = np.abs(outputs["F"]) < 3.999
    assert 0.2 < np.mean(stands) < 0.9  # at rest the force is what the others leave
    noisy = {name: outputs[name] + blank.noise[name] * rng.standard_normal(t.size) for name in outputs}
    record = jms.Record(t, noisy, {"r": reference}, noise=blank.noise)
    result = jms.fit(scene(380.0, 3.7), record, ("P", "dry.Fc"), observe=seen, q0=[0.0], controller=loop)
    for name, true in {"P": 400.0, "dry.Fc": 4.0}.items():
        assert abs(result.values[name] - true) < 4.5 * result.errors[name] < 0.05 * true


def test_a_velocity_that_stick_takes_away_has_no_effect():
    record = dwelling(8.0, 500.0, 110)  # its derivative is rounding, on which a search must not step
    scene, free = axis_scene(axis_models()["coulomb"], estimate_axis(record)), (*TRUTH, "q0", "qd0")
    result = jms.fit(scene, record, free, q0=[record.measured[0]], qd0=[0.0])
    assert "qd0[0] has no effect on this record." in warnings_for(result)
    assert result.diagnostics.ending == "converged"
    assert result.rmse == pytest.approx(NOISE, rel=0.05)
