"""How sure a fit is: causes in the motion, a profile of a simulated record, other records, files, figures."""

import json
import zipfile
from dataclasses import fields, replace
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

import jaxmodsim as jms
from jaxmodsim.identify import FitResult, evaluate_on, law_force, profile, replay, residual_tests, warnings_for
from jaxmodsim.identify.model._observe import RecordedMotion, Slip
from jaxmodsim.identify.uncertainty._estimate import (
    FitDiagnostics,
    FitProvenance,
    IdentifiabilityIssue,
    ParameterEstimate,
)
from jaxmodsim.identify.uncertainty._identifiability import RULES, Element, identifiability_issues, slow
from jaxmodsim.plot import result_figure
from jaxmodsim.scene import scene_numbers

from ..helpers.sprung import lagrangian, sprung

DT = 4e-3
T = np.linspace(0.0, 4.0, 2001)
LUGRE = {"sigma0": 1e4, "sigma1": 10.0, "sigma2": 1.0, "Fc": 1.0, "Fs": 1.5, "vs": 0.01}
SINE, SLOW_SINE = np.sin(2 * np.pi * T), np.sin(2 * np.pi * 0.5 * T)


def element(law, x, numbers=None, alike=None):
    slip = Slip(x, np.gradient(x, T))
    own = numbers or {k: float(v) for k, v in LUGRE.items()}
    return Element("", law, (slip,), {k: np.asarray(v) for k, v in own.items()}, tuple(own), alike or {})


def lugre(x, **alike):
    return element(jms.LuGre(**LUGRE), x, None, alike)


STRIBECK = {"Fc": 1.0, "Fs": 1.5, "vs": 0.01, "Fv": 0.5}
SIDES = {"forward.Fc": 1.0, "backward.Fc": 1.2}
MAXWELL = {"k": np.array([1e4, 1e4]), "Fc": np.array([0.1, 1.0])}


def stribeck(x):
    return element(jms.Regularized(jms.Stribeck(**STRIBECK), 1e-4), x, STRIBECK)


def sided(x):
    return element(jms.asymmetric(jms.Dahl(1e4, 1.0), Fc=1.2), x, SIDES)


def maxwell(x):
    found = element(jms.MaxwellSlip(**MAXWELL), x, MAXWELL)
    return found._replace(free=("Fc[0]", "Fc[1]"))


CASES = {
    "presliding": (lugre(2e-5 * SINE), lugre(1e-2 * SINE), ("sigma2", "Fc", "Fs", "vs"), "never leaves presliding"),
    "elements": (maxwell(2e-5 * SINE), maxwell(4e-4 * SINE), ("Fc[1]",), "never slip"),
    "never_sticks": (lugre(0.1 * T), lugre(0.1 * SINE), ("sigma0", "sigma1", "Fs", "vs"), "never sticks"),
    "one_direction": (lugre(0.1 * T, Fc=("offset",)), lugre(0.1 * SINE), ("Fc", "offset"), "one direction only"),
    "sides": (sided(0.1 * T), sided(0.1 * SINE), ("backward.Fc",), "nothing is seen of backward.Fc"),
    "stribeck_not_passed": (
        stribeck(1e-3 * SINE), stribeck(0.1 * SINE), ("Fc", "Fs", "vs", "Fv"), "speed never exceeds"
    ),
    "stribeck_unseen": (stribeck(0.1 * T), stribeck(0.1 * SLOW_SINE), ("Fs", "vs"), "Only 0 samples"),
    "one_speed": (stribeck(0.1 * T), stribeck(0.1 * SINE), ("Fc", "Fv"), "nearly one speed"),
}  # fmt: skip


@pytest.mark.quick
@pytest.mark.parametrize("case", CASES)
def test_causes_are_seen_in_the_motion(case):
    triggers, fine, about, sentence = CASES[case]
    issues, others = ([issue for rule in RULES if (issue := rule(x))] for x in (triggers, fine))
    assert [set(issue.about) for issue in issues if sentence in issue.sentence] == [set(about)]
    assert not any(sentence in issue.sentence for issue in others)


def test_slow_motion_does_not_show_the_mass():
    scene = sprung()
    numbers = {name: np.asarray(x) for name, x in scene_numbers(scene).items()}

    def motion(size):
        return (RecordedMotion(T, {0: size * SINE}, {0: size * 2 * np.pi * np.cos(2 * np.pi * T)}),)

    cause = slow(scene, motion(1e-4), numbers, ("m", "k"))
    assert cause is not None
    assert cause.about == ("m",)  # not the stiffness, which is no part of the mass
    assert "Inertia hardly shows" in cause.sentence
    assert slow(scene, motion(0.1), numbers, ("m", "k")) is None
    # Nothing is said of a parameter that the figures call certain.
    assert not identifiability_issues(scene, motion(1e-4), 1, numbers, ("m", "k"), {"k": ()})
    assert identifiability_issues(scene, motion(1e-4), 1, numbers, ("m", "k"), {"m": ()}) == (cause,)


@pytest.fixture(scope="module")
def presliding() -> FitResult:
    t = np.arange(0.0, 2.0, 5e-3)
    x = 3e-5 * np.sin(2 * np.pi * t)
    truth = jms.LuGre(**LUGRE)
    force = np.asarray(law_force(truth, jnp.asarray(t), jnp.asarray(x)))
    noise = 2e-2 * np.random.default_rng(6).standard_normal(t.size)
    start = replace(truth, Fc=0.9, Fs=1.7, vs=0.02)
    return jms.fit_law(start, jms.Record(t, force + noise, {"x": x}), ("sigma0", "Fc", "Fs", "vs"), max_steps=30)


def test_a_record_in_presliding_says_so_once(presliding):
    about = [warning for warning in warnings_for(presliding) if "presliding" in warning]
    assert len(about) == 1, warnings_for(presliding)
    assert "Fc, Fs and vs cannot be told apart" in about[0]
    assert not any("Fs and" in warning and "hardly told apart" in warning for warning in warnings_for(presliding))
    assert presliding.diagnostics.issues[0].about == ("Fc", "Fs", "vs")


@pytest.fixture(scope="module")
def clean():
    t = np.arange(0.0, 5.0, DT)
    u = 4.0 * np.sin(2 * np.pi * 0.5 * t) + 2.0 * np.sin(2 * np.pi * 1.3 * t)
    start = jnp.asarray([0.05]), jnp.asarray([0.1])
    q = replay(sprung(), jnp.asarray(t), {"u": jnp.asarray(u)}, *start, 1, lambda q, qd: q[0])
    return t, u, np.asarray(q)


@pytest.fixture(scope="module")
def parts(clean) -> tuple[jms.Record, jms.Record]:
    t, u, q = clean
    noise = 1e-4 * np.random.default_rng(7).standard_normal(t.size)
    whole = jms.Record(t, {"x": q + noise}, {"u": u})
    return whole.samples(0, 750, "first part"), whole.samples(750, len(t), "second part")


TRACED = []


def position(q, qd):
    TRACED.append(qd)
    return q[0]


@pytest.fixture(scope="module")
def result(parts) -> FitResult:
    free = ("m", "friction.Fc", "viscous.Fv")
    start, limits = sprung(1.5, 1.0, 1.0), {"m": (0.0, None)}
    return jms.fit(start, parts[0], free, observe=position, q0=[0.05], qd0=[0.1], limits=limits)


@pytest.fixture(scope="module")
def scored(result, parts):
    return evaluate_on(result, parts[1])


def test_a_profile_of_a_simulated_record_compiles_nothing(result):
    before = len(TRACED)
    curve = profile(result, "friction.Fc", points=2)
    assert before > 0
    assert len(TRACED) == before  # nothing was traced again
    np.testing.assert_allclose(curve.interval, result.estimate.intervals()["friction.Fc"], rtol=1e-4)
    assert set(curve.others) == {"m", "viscous.Fv"}


@pytest.mark.parametrize(
    ("name", "options", "text"),
    [
        ("q0[0]", {}, "no profile; the parameters that have one are: m, friction.Fc"),
        ("m", {"level": 1.0}, "level must lie between"),
        ("m", {"points": 1}, "points must be an integer >= 2"),
    ],
)
def test_wrong_profiles_are_refused(result, name, options, text):
    with pytest.raises(ValueError, match=text):
        profile(result, name, **options)


def test_residuals_of_a_fit_are_tested_against_its_motion(result):
    (each,) = residual_tests(result).channels
    assert [trend.over for trend in each.trends] == ["q[0]", "qd[0]", "t"]
    assert set(each.inputs) == {"u"}
    assert each.whiteness > 1e-3
    text = str(residual_tests(result))
    assert "first part, x: 750 samples" in text
    assert "no trend over qd[0]" in text


def test_a_record_that_was_not_fitted_is_scored(scored, parts, clean):
    t, _, q = clean
    fitted = scored.start_fitted
    assert fitted.ending == "converged"
    assert fitted.rmse["x"] == pytest.approx(1e-4, rel=0.15)
    assert scored.rmse["x"] == pytest.approx(1e-4, rel=0.3)
    assert scored.fit["x"] == pytest.approx(100 * (1 - scored.rmse["x"] / np.std(parts[1].channels["x"])))
    # The initial state comes out as it was, the velocity of the true motion by difference.
    for each in (fitted, scored):
        assert each.q0 == pytest.approx(q[750], abs=1e-4)
        assert each.qd0 == pytest.approx(np.gradient(q, t)[750], abs=1e-2)
    assert set(fitted.away) == {"q0[0]", "qd0[0]"}
    assert max(abs(x) for x in fitted.away.values()) < 3
    assert scored.warnings == ()
    np.testing.assert_allclose(scored.residuals["x"], scored.outputs["x"] - parts[1].channels["x"])
    assert "fit 99.9" in str(scored)


def test_a_start_that_takes_up_an_error_of_the_model_is_a_warning(result, parts):
    other = jms.Record(parts[1].t, parts[1].channels, {"u": 0.8 * parts[1].inputs["u"]}, "weak")
    found = evaluate_on(result, other)
    assert found.start_fitted is not None
    assert found.start_fitted.rmse["x"] < found.rmse["x"]
    assert any("standard errors from what its first samples show" in each for each in found.warnings)
    nothing = jms.Record(parts[1].t, parts[1].channels, {"u": np.full(len(parts[1].t), 1e200)}, "overflow")
    with pytest.raises(RuntimeError, match="not finite"):
        evaluate_on(result, nothing)


def test_a_start_that_is_given_is_not_moved(result, parts):
    given = evaluate_on(result, parts[0], q0=[0.05], qd0=[0.1])
    np.testing.assert_allclose(given.outputs["x"], result.provenance.outputs[0]["x"], rtol=0, atol=1e-12)
    from_rest = evaluate_on(result, parts[0], q0=[0.05], qd0=[0.0])
    assert from_rest.rmse["x"] > 10 * given.rmse["x"]  # it was not at rest
    with pytest.raises(ValueError, match="give q0 and qd0, or neither"):
        evaluate_on(result, parts[0], q0=[0.05])
    with pytest.raises(ValueError, match=r"q0 must be finite and of the shape \(1,\)"):
        evaluate_on(result, parts[0], q0=[0.0, 0.0], qd0=[0.0])
    other = jms.Record(parts[0].t, {"y": parts[0].channels["x"]}, parts[0].inputs)
    with pytest.raises(ValueError, match="has the channel 'y', but the fit observed: x"):
        evaluate_on(result, other)
    with pytest.raises(ValueError, match="has the inputs none"):
        evaluate_on(result, jms.Record(parts[0].t, parts[0].channels))


def test_a_law_is_scored_on_another_motion(presliding):
    t = np.arange(0.0, 1.0, 5e-3)
    x = 2e-5 * np.sin(2 * np.pi * 2 * t)
    force = np.asarray(law_force(jms.LuGre(**LUGRE), jnp.asarray(t), jnp.asarray(x)))
    other = evaluate_on(presliding, jms.Record(t, force, {"x": x}, "other"))
    assert other.q0 is None
    assert other.rmse["measured"] < 0.02
    assert other.fit["measured"] > 85


def same(a, b):
    if isinstance(a, np.ndarray):
        return a.dtype == b.dtype and a.tobytes() == b.tobytes()
    if isinstance(a, jms.Record):
        return same(vars(a), vars(b))
    if isinstance(a, dict):
        return list(a) == list(b) and all(same(a[k], b[k]) for k in a)
    if isinstance(a, tuple) and not isinstance(a, IdentifiabilityIssue):
        return len(a) == len(b) and all(same(x, y) for x, y in zip(a, b, strict=True))
    return type(a) is type(b) and (a == b or (a != a and b != b))


@pytest.fixture(scope="module")
def odd(result) -> FitResult:
    """With what JSON does not know, and numbers whose decimals are long."""
    covariance = result.estimate.covariance.copy()
    covariance[0, 0], covariance[1, 1] = np.inf, np.nan
    issues = (IdentifiabilityIssue("Too slow.", ("m",)),)
    return replace(
        result,
        estimate=replace(result.estimate, covariance=covariance),
        diagnostics=replace(
            result.diagnostics,
            step_error=dict.fromkeys(result.diagnostics.rmse, 0.1 + 0.2),
            step_moves={},
            issues=issues,
        ),
    )


PARTS = {"estimate": ParameterEstimate, "diagnostics": FitDiagnostics, "provenance": FitProvenance}


def test_a_file_gives_back_every_bit(odd, tmp_path):
    path = tmp_path / "axis.fit"
    odd.save(path)
    assert [x.name for x in tmp_path.iterdir()] == ["axis.fit"]
    again = FitResult.load(path)
    for part, kind in PARTS.items():
        for field in fields(kind):
            if field.name != "model":
                kept, read = (getattr(getattr(each, part), field.name) for each in (odd, again))
                assert same(kept, read), field.name
    assert again.search is None
    assert again.model is None
    assert warnings_for(again) == warnings_for(odd)
    assert str(residual_tests(again)) == str(residual_tests(odd))
    result_figure(again)
    with pytest.raises(ValueError, match="loaded result"):
        profile(again, "m")
    with pytest.raises(ValueError, match="loaded result"):
        evaluate_on(again, odd.record)
    again.save(path)  # what was loaded can be kept again
    assert same(FitResult.load(path).provenance.numbers, odd.provenance.numbers)


def test_a_file_puts_its_numbers_into_a_model(result, presliding, tmp_path):
    path = tmp_path / "axis.fit"
    result.save(path)
    scene = FitResult.load(path, sprung(9.0, 9.0, 9.0)).model
    assert same(
        {k: np.asarray(x) for k, x in scene_numbers(scene).items()},  # pyright: ignore[reportArgumentType]
        {k: np.asarray(x) for k, x in scene_numbers(result.model).items()},  # pyright: ignore[reportArgumentType]
    )
    other = jms.Scene(lagrangian, params={"m": 1.0, "k": 1.0}, effects=(jms.Friction(jms.Coulomb(1.0)),))
    with pytest.raises(ValueError, match=r"not the fitted one: it lacks .*viscous.Fv"):
        FitResult.load(path, other)
    presliding.save(path)
    law = FitResult.load(path, jms.LuGre(**{**LUGRE, "sigma0": 1.0})).model
    assert isinstance(law, jms.LuGre)
    assert float(law.sigma0) == presliding.values["sigma0"]


@pytest.mark.parametrize(
    ("spoil", "text"),
    [
        (lambda path: path.write_text("m = 2.0"), "not written by FitResult.save, or it is damaged"),
        (lambda path: path.write_bytes(path.read_bytes()[:2000]), "not written by FitResult.save"),
        (lambda path: flip(path), "damaged"),
        (lambda path: rewrite(path, {"kind": "other"}), "is no result of a fit"),
        (lambda path: rewrite(path, {"format": 99}), "has the format 99, written by jaxmodsim"),
        (lambda path: rewrite(path, {"fields": {}}), "lacks bounds, coordinates"),
        (lambda path: rewrite(path, {}, "other.json"), r"holds no result\.json"),
    ],
)
def test_files_that_are_something_else_are_refused(result, tmp_path, spoil, text):
    path = tmp_path / "axis.fit"
    result.save(path)
    spoil(path)
    with pytest.raises(ValueError, match=text):
        FitResult.load(path)


def flip(path: Path) -> None:
    """Change one bit in the middle of the samples."""
    body = bytearray(path.read_bytes())
    body[len(body) // 2] ^= 1
    path.write_bytes(bytes(body))


def rewrite(path: Path, change, name: str = "result.json") -> None:
    with zipfile.ZipFile(path) as archive:
        parts = {name: archive.read(name) for name in archive.namelist()}
    parts[name] = json.dumps({**json.loads(parts.pop("result.json")), **change}).encode()
    with zipfile.ZipFile(path, "w") as archive:
        for name, part in parts.items():
            archive.writestr(name, part)


def test_a_save_that_fails_leaves_the_old_file(result, tmp_path):
    path = tmp_path / "axis.fit"
    result.save(path)
    before = path.read_bytes()
    with pytest.raises(TypeError, match="units"):
        replace(result, estimate=replace(result.estimate, units={"m": object()})).save(path)
    assert path.read_bytes() == before
    assert [x.name for x in tmp_path.iterdir()] == ["axis.fit"]


def test_the_figure_of_a_result_has_axes_with_units(result, presliding):
    figure = result_figure(result, units={"x": "m"})
    labels = {axis.get_ylabel() for axis in figure.axes} | {axis.get_xlabel() for axis in figure.axes}
    assert {"x [m]", "residual [mm]", "time [s]", "lag [s]", "autocorrelation"} <= labels
    assert "half-width of the 95 % interval [% of the value]" in labels
    figure.canvas.draw()  # layout and texts, warnings being errors
    result_figure(presliding).canvas.draw()  # with parameters that are not determined
    with pytest.raises(ValueError, match="record must be 0 to 0"):
        result_figure(result, record=1)
    with pytest.raises(ValueError, match="units names y"):
        result_figure(result, units={"y": "m"})
