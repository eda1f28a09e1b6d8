"""Servos: the simulation against SciPy with events, recovery of known parameters, bands, and measured records."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmodsim.friction import ServoGear
from jaxmodsim.identify import Record, Servo, ServoFit, fit_servo, predict_servo, servo_record
from jaxmodsim.identify.data._record import cut, runs_of
from jaxmodsim.identify.model._servo import ServoEngine, conducting_voltage

from ..helpers.servo import PENDULUM, TRUE, clock, commands, simulate_servo

XL330 = Path(__file__).parents[3] / "shared" / "data" / "xl330"
MODEL = Servo(
    ServoGear(0.0, 0.0, **{name: TRUE[name] for name in ("Kc", "Kv", "Kcs", "vs", "Km", "Ke")}, alpha=1.0),
    **PENDULUM,
    **{name: TRUE[name] for name in ("kt", "R", "armature", "tilt", "Kq")},
)


def fitted(records: Sequence[Record], law: str = "MQ", groups: Mapping[str, Sequence[str]] | None = None) -> ServoFit:
    return fit_servo(records, law, inertia=PENDULUM["inertia"], gravity=PENDULUM["gravity"], groups=groups)


def synthetic(kind: str, kp: float, seconds: float = 2.5, noise: float = 0.0) -> Record:
    rng = np.random.default_rng(round(kp))
    t = clock(seconds, rng)
    (goal, on), volts = commands(t, kind), np.full_like(t, 7.3)
    q = simulate_servo(t, goal, volts, on, kp, TRUE, 0.0) + noise * rng.standard_normal(t.size)
    return servo_record(t, q, goal, volts, on, kp=kp, q0=0.0, name=f"kp{kp:g}_{kind}")


def simulated(record: Record, substeps: int = 3) -> np.ndarray:
    run = jax.tree.map(lambda x: x[0], runs_of((record,), cut((record,), None)))
    return np.asarray(jax.jit(lambda run: ServoEngine(MODEL, substeps)({}, None, run).channels["measured"])(run))


@pytest.mark.parametrize(("kind", "kp"), [("sine", 100.0), ("sine", 400.0), ("lift", 200.0)])
def test_simulation_is_that_of_scipy_with_events(kind: str, kp: float) -> None:
    record = synthetic(kind, kp)
    errors = [np.max(np.abs(simulated(record, substeps) - record.measured)) for substeps in (3, 48)]
    assert errors[0] < 6e-3
    assert errors[1] < 5e-4  # a third of a count of the encoder
    assert np.ptp(record.measured) > 0.3


def test_stick_is_exact() -> None:
    record = synthetic("lift", 200.0, 4.0)
    rest = simulated(record)[-100:]
    assert np.all(rest == rest[0])
    assert abs(float(rest[0])) > 1e-3  # friction holds it away from the lowest position


def test_gradients_are_those_of_differences() -> None:
    record = synthetic("sine", 200.0, 0.3)  # before the first stop, where the output is smooth
    run = jax.tree.map(lambda x: x[0], runs_of((record,), cut((record,), None)))

    def end(R: jax.Array) -> jax.Array:
        return ServoEngine(MODEL)({"R": R}, None, run).channels["measured"][-1]

    step = 1e-5  # relative errors of 1e-10 from the step and of 1e-10 from rounding
    slope = (end(jnp.asarray(2.6 + step)) - end(jnp.asarray(2.6 - step))) / (2 * step)
    assert jax.jit(jax.grad(end))(jnp.asarray(2.6)) == pytest.approx(float(slope), rel=1e-5)


@pytest.fixture(scope="module")
def fit() -> ServoFit:
    kinds = [("sine", 100.0), ("sine", 400.0), ("lift", 200.0), ("lift", 400.0), ("chirp", 200.0)]
    return fitted([synthetic(kind, kp, noise=4e-4) for kind, kp in kinds])


def test_known_parameters_are_recovered(fit: ServoFit) -> None:
    assert fit.result is not None
    values, errors = fit.result.values, fit.result.errors
    true = {name if name in ("kt", "R", "armature", "tilt", "Kq") else f"gear.{name}": x for name, x in TRUE.items()}
    assert max(fit.fitted.values()) < 5e-3
    for name in ("kt", "R", "armature", "gear.Km"):
        assert values[name] == pytest.approx(true[name], rel=0.2), (name, errors[name])
    assert values["kt"] / values["R"] == pytest.approx(TRUE["kt"] / TRUE["R"], rel=0.1)
    assert sum(fit.evaluations.values()) <= 1000


def test_new_command_and_gain_are_predicted_in_the_band(fit: ServoFit, tmp_path: Path) -> None:
    new = synthetic("chirp", 150.0)
    prediction = predict_servo(fit, new)
    assert prediction.error < 8e-3
    assert prediction.inside > 0.85
    path = tmp_path / "fit.json"
    path.write_text(json.dumps(fit.to_dict()))
    again = predict_servo(ServoFit.load(path), new)
    np.testing.assert_allclose(again.q, prediction.q, rtol=0, atol=1e-12)
    np.testing.assert_allclose(again.upper, prediction.upper, rtol=0, atol=1e-12)


@pytest.mark.skipif(not XL330.exists(), reason="no records of the servo in ../shared/data/xl330")
def test_measured_records_left_out_are_predicted_better_than_by_published_parameters() -> None:
    records = []
    for path in sorted(XL330.glob("*.csv")):
        d = np.genfromtxt(path, delimiter=",", names=True)
        columns = d["t"], d["q"], d["q_goal"], d["volts"], d["torque_enable"]
        records.append(servo_record(*columns, kp=float(path.stem[2:5]), name=path.stem))
    names = [record.name for record in records]
    groups = {kind: [name for name in names if kind in name] for kind in ("lift_and_drop", "sin_sin", "up_and_down")}
    fit = fitted(records, groups=groups)
    assert fit.left_out_error < 0.036  # the published M6 at these gains
    at_100 = [group[name] for group in fit.left_out.values() for name in group if name.startswith("kp100")]
    assert np.mean(at_100) < 0.0185
    assert any("kt and R" in line for line in fit.warnings)


def test_supply_of_pulses_is_found_among_aliased_samples() -> None:
    t = np.arange(400) * 5e-3
    volts = np.where(np.random.default_rng(0).uniform(size=400) < 0.5, 6.4, 8.2)
    assert np.max(np.abs(conducting_voltage(t, volts) - 6.4)) < 1e-9


def test_wrong_arguments_are_named() -> None:
    record = synthetic("sine", 100.0, 0.5)
    t = record.t
    with pytest.raises(ValueError, match="gain kp of its position loop or the measured duty"):
        servo_record(t, None, t, t, t)
    with pytest.raises(ValueError, match="law must be one of M1"):
        fitted([record, record], "M9")
    with pytest.raises(ValueError, match="two records at least"):
        fitted([record], "M1")
    with pytest.raises(ValueError, match="groups needs a group of some of the records"):
        fitted([record, record], groups={})
    with pytest.raises(ValueError, match="groups needs a group of some of the records"):
        fitted([record, record], groups={"all": [record.name]})
    with pytest.raises(ValueError, match="groups names 'other'"):
        fitted([record], "M1", {"a": ["other"]})
    with pytest.raises(ValueError, match="kt must be"):
        Servo(MODEL.gear, **PENDULUM, kt=-1.0)


def test_file_of_another_kind_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "fit.json"
    path.write_text("{}")
    with pytest.raises(ValueError, match="no fit of a servo"):
        ServoFit.load(path)
