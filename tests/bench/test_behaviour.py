"""The behaviour bench: what laws do in the standard experiments, by numbers and closed forms."""

import dataclasses
import functools
import inspect
from typing import TypeVar

import numpy as np
import pytest

from bench.behaviour.drive import SAMPLES, path, respond
from bench.behaviour.experiment import DEFLECTION, FC, FS, SIGMA0, WIDTH, LawCase, LawMeasurement, Verdict, law_cases
from bench.behaviour.figure import behaviour_figure
from bench.behaviour.run import EXPERIMENTS, run_bench
from bench.layout import Recorded
from bench.studies import behaviour
from jaxmodsim import SimulationError, friction
from jaxmodsim._core.functions import StateDependent
from jaxmodsim._core.parameters import modules_of
from jaxmodsim.friction import AbstractLaw, Dahl, LuGre

BENCH = {each.name: each for each in law_cases()}
# Experiments with a prescribed motion compile in no time; those with a mass take some seconds for each law.
WITH_MASS = ("break-away", "stick-slip", "creep")
PRESCRIBED = {name: each for name, each in EXPERIMENTS.items() if name not in WITH_MASS}
# These stand for all: the bench runs the others, too.
KINDS = ("Coulomb", "Coulomb, stiction", "Regularized", "Dahl", "LuGre", "ElastoPlastic", "MaxwellSlip, 4, C")


@pytest.fixture(scope="module")
def prescribed():
    return run_bench(experiments=PRESCRIBED)


@functools.cache
def with_mass(law):
    return run_bench([BENCH[law]], {name: EXPERIMENTS[name] for name in WITH_MASS})[law]


@pytest.fixture(scope="module")
def outcomes(prescribed):
    return {name: each | (with_mass(name) if name in KINDS else {}) for name, each in prescribed.items()}


@pytest.mark.quick
def test_every_law_and_wrapper_is_on_the_bench():
    shown = set()
    for case in BENCH.values():
        parts = [module for _, module in modules_of(case.law)]
        shown |= {type(part).__name__ for part in parts}
        shown |= {"asymmetric" for part in parts if hasattr(part, "forward")}
        shown |= {"scaled_by" for part in parts if isinstance(part, StateDependent)}
        shown |= {fall.__name__ for part in parts if (fall := getattr(part, "fall", None)) is not None}
    public = {name: value for name, value in vars(friction).items() if not name.startswith(("_", "Abstract"))}
    laws = {name for name, value in public.items() if inspect.isclass(value) and issubclass(value, AbstractLaw)}
    functions = {name: inspect.signature(value) for name, value in public.items() if inspect.isfunction(value)}
    # A function that wraps a law returns one of the kind that it was given.
    wrappers = {name for name, signature in functions.items() if isinstance(signature.return_annotation, TypeVar)}
    wanted = laws | wrappers | {"exponential", "lorentzian"}
    assert len(laws) >= 12
    assert wrappers >= {"asymmetric", "scaled_by"}
    # Laws of gears need a torque, which no experiment has (tests/friction/test_geared.py); a bristle of Coulomb's
    # law is Dahl's.
    wanted -= {"Bristle", "Geared", "ServoGear"}
    assert wanted <= shown, f"not on the bench: {sorted(wanted - shown)}"


def test_no_law_fails_but_by_a_known_limitation(outcomes):
    failed = [
        f"{law}, {name}: {outcome.measured.number:.3g}. {outcome.measured.sentence}"
        for law, of in outcomes.items()
        for name, outcome in of.items()
        if outcome.verdict is Verdict.FAIL
    ]
    assert not failed, "\n".join(failed)


PASS, KNOWN, NOT = Verdict.PASS, Verdict.KNOWN_LIMITATION, Verdict.NOT_APPLICABLE


@pytest.mark.parametrize(
    ("law", "experiment", "verdict"),
    [
        ("LuGre", "creep", KNOWN),
        ("Dahl", "creep", KNOWN),
        ("Regularized", "creep", KNOWN),
        ("ElastoPlastic", "creep", PASS),
        ("MaxwellSlip, 4, C", "creep", PASS),
        ("Coulomb", "creep", PASS),
        ("MaxwellSlip, 4", "memory", PASS),
        ("MaxwellSlip, 4, C", "memory", PASS),
        ("LuGre", "memory", KNOWN),
        ("ElastoPlastic", "memory", KNOWN),
        ("Stribeck, Gauss", "memory", NOT),
        ("Dahl", "presliding", PASS),
        ("Stribeck, Gauss", "presliding", KNOWN),
        ("DeadZone", "presliding", NOT),
        ("DeadZone", "passivity", NOT),
        ("LuGre", "break-away", PASS),
        ("Coulomb, stiction", "break-away", KNOWN),
        ("LuGre", "lag", PASS),
        ("Armstrong", "lag", PASS),
        ("Stribeck, Gauss", "lag", KNOWN),
        ("Dahl", "lag", KNOWN),
        ("LuGre", "stick-slip", PASS),
        ("Coulomb, stiction", "stick-slip", PASS),
        ("Coulomb", "stick-slip", KNOWN),
        ("Dahl", "stick-slip", KNOWN),
        ("LuGre", "passivity", KNOWN),
        ("LuGre, vd", "passivity", PASS),
        ("Dahl", "passivity", PASS),
        ("MaxwellSlip, 4, C", "passivity", PASS),
    ],
)
def test_verdicts(prescribed, law, experiment, verdict):
    outcome = (with_mass(law) if experiment in WITH_MASS else prescribed[law])[experiment]
    assert outcome.verdict is verdict, outcome.measured.sentence
    assert (verdict is PASS) == (outcome.reason == "")


def test_every_law_has_its_steady_curve(prescribed):
    for law, of in prescribed.items():
        # Armstrong's stiction is not all back after a reversal; forward its curve is right, too.
        assert of["characteristic"].verdict is (KNOWN if law == "Armstrong" else PASS), law


def test_numbers_that_are_known(outcomes):
    # Without rate dependence the break-away force is the stiction, seen in samples of the load, 0.64 mN apart.
    stiction = outcomes["Coulomb, stiction"]["break-away"].measured.lines[0].y
    np.testing.assert_allclose(stiction, FS, atol=7e-4)
    # Slowly loaded, LuGre comes near its stiction force; fast, all that is left is the Coulomb force.
    lugre = outcomes["LuGre"]["break-away"].measured.lines[0].y
    assert (np.diff(lugre[:-1]) < 0).all()
    assert (lugre[-2:] > FC).all()
    assert (lugre[-2:] < 1.1 * FC).all()
    assert 0.97 * FS < lugre[0] < FS
    # A smooth law moves at the velocity at which it balances the load, between means that are 8 s apart.
    load = 0.4 + 0.2 * np.sin(2.0 * np.pi * np.arange(1000) / 1000)
    expected = 8e6 * WIDTH * np.mean(np.arctanh(load / FS))
    assert outcomes["Regularized"]["creep"].measured.number == pytest.approx(expected, rel=1e-3)


def test_dahl_keeps_its_closed_forms():
    amplitude, leg = 1.3 * DEFLECTION, SAMPLES // 16
    x = path(0.0, *(amplitude, -amplitude) * 8, samples=leg)
    dx = np.diff(x, prepend=0.0)
    run = respond(Dahl(SIGMA0, FC), np.sign(dx), np.abs(dx))
    saturation = FC * np.tanh(SIGMA0 * amplitude / FC)
    # The last leg but one ends at the upper turn.
    assert run.force[-leg - 1] == pytest.approx(saturation, rel=1e-9)
    assert run.force[-1] == pytest.approx(-saturation, rel=1e-9)
    loss = 4.0 * FC * (amplitude - FC / SIGMA0 * np.tanh(SIGMA0 * amplitude / FC))
    # The trapezoidal rule over legs of 512 samples.
    assert float(np.sum(run.work[-2 * leg :])) == pytest.approx(loss, rel=1e-4)


def test_a_passive_lugre_passes_and_a_miss_that_nothing_explains_fails():
    bristle = BENCH["LuGre"].law
    assert isinstance(bristle, LuGre)
    passivity = EXPERIMENTS["passivity"]
    # The condition of the class: sigma2 > sigma1 (Fs - Fc)/Fc = 0.5 sigma1.
    damped = dataclasses.replace(bristle, sigma2=0.6 * bristle.sigma1)
    assert passivity(LawCase("passive", damped, BENCH["LuGre"].steady)).verdict is PASS
    fake = dataclasses.replace(passivity, measure=lambda case: LawMeasurement(-1.0, "gives energy"))
    assert fake(BENCH["LuGre"]).verdict is KNOWN
    assert fake(BENCH["Dahl"]).verdict is Verdict.FAIL
    assert fake(BENCH["LuGre, vd"]).verdict is Verdict.FAIL
    none = dataclasses.replace(passivity, measure=lambda case: LawMeasurement(float("nan"), "nothing to see"))
    assert none(BENCH["LuGre"]).verdict is NOT


def test_a_run_that_ends_early_fails():
    def stop(case):
        del case
        raise SimulationError("The step limit was reached.")

    outcome = dataclasses.replace(EXPERIMENTS["creep"], measure=stop)(BENCH["LuGre"])
    assert outcome.verdict is Verdict.FAIL
    assert "step limit" in outcome.measured.sentence


def test_limitations_name_experiments_and_every_one_is_missed(outcomes):
    for name, case in BENCH.items():
        limitations = case.law.known_limitations()
        assert set(limitations) <= set(EXPERIMENTS)
        for experiment in set(limitations) & set(outcomes[name]):
            assert outcomes[name][experiment].verdict in (KNOWN, NOT), f"{name} keeps the limit of {experiment}"
    assert "passivity" not in BENCH["LuGre, vd"].law.known_limitations()
    assert "creep" in BENCH["LuGre, asymmetric"].law.known_limitations()


def test_figures_have_a_panel_for_each_law_and_labelled_axes(prescribed):
    for name, experiment in PRESCRIBED.items():
        of = {law: found[name] for law, found in prescribed.items()}
        figure = behaviour_figure(experiment, of)
        titles = [axis.get_title(loc="left") for axis in figure.axes]
        assert [title for title in titles if title] == list(of)
        labels = [axis.get_ylabel() for axis in figure.axes if axis.get_ylabel()]
        assert labels
        assert all("[" in label or "/" in label for label in labels)


def test_the_study_records_verdicts_and_draws_figures(tmp_path, monkeypatch, outcomes):
    found = {law: outcomes[law] for law in ("Coulomb", "LuGre", "ElastoPlastic")}
    monkeypatch.setattr(behaviour, "run_bench", lambda laws, progress: found)
    behaviour.main(False, tmp_path).write(tmp_path, smoke=True)
    pictures = ["behaviour_creep.png", "behaviour_memory.png"]
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted([*pictures, "behaviour.json"])
    recorded = Recorded.read(tmp_path / "behaviour.json")
    rows = [row for row in recorded.rows if row["quantity"] == "verdict"]
    assert len(rows) == 3 * len(EXPERIMENTS)
    assert {"number", "unit", "limit", "finding", "reason"} <= {row["quantity"] for row in recorded.rows}
    assert str(recorded.get("verdict", case="creep", peer="LuGre")).startswith("**no**")
    assert "yields" in str(recorded.get("reason", case="creep", peer="LuGre"))
    assert recorded.get("reason", case="creep", peer="ElastoPlastic") is None


def test_a_failure_ends_the_study_with_an_error(tmp_path, monkeypatch, prescribed):
    failure = dataclasses.replace(with_mass("Dahl")["creep"], verdict=Verdict.FAIL, reason="")
    failed = {"Dahl": prescribed["Dahl"] | with_mass("Dahl") | {"creep": failure}}
    monkeypatch.setattr(behaviour, "run_bench", lambda laws, progress: failed)
    with pytest.raises(RuntimeError, match="FAIL: Dahl, creep, 1"):
        behaviour.main(False, tmp_path)
