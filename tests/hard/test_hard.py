"""Hard cases: one of each kind, and that the checks themselves can fail."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

import jaxmodsim as jms
from bench import figures
from bench.hard import add_errors
from bench.layout import Recorded
from bench.record import Result
from jaxmodsim.problems import ramped_box

from . import catalogue
from .case import HardCase, MeasuredNumber, RefusedCalls
from .check import DTYPES, TRANSFORMS, check

CASES = catalogue.hard_cases()


def test_every_case_says_why_it_is_hard_and_what_is_right():
    assert len(CASES) >= 40
    assert {case.family for case in CASES.values()} == set(catalogue.FAMILIES)
    for name, case in CASES.items():
        assert case.name == name
        assert min(len(case.why), len(case.naive), len(case.asks)) > 5
        if not isinstance(case.task, RefusedCalls):
            assert case.exact or case.second or case.ends
        # A transform, or a transform in one type.
        assert set(case.skips) <= {
            *TRANSFORMS,
            *(f"{transform} {dtype}" for transform in TRANSFORMS for dtype in DTYPES),
        }
        assert all(case.skips.values())


@pytest.mark.parametrize(
    ("name", "transforms"),
    [
        ("overflow_in_stribeck", ("forward",)),  # infinity times zero in the derivative
        ("nan_records", ("alone",)),
        ("bouncing_ball_unheld", ("vmap",)),
        ("equilibrium", ("reverse",)),
        ("step_limit_regularised", ("alone",)),
    ],
)
def test_a_case_of_each_kind(name: str, transforms: tuple[str, ...]):
    """Besides all cases alone, which `.ci/run` checks by tests/hard/every_case.py."""
    verdict = check(CASES[name], transforms, ["float64"])
    assert verdict.findings
    assert verdict.ok, [finding.sentence for finding in verdict.findings if not finding.ok]


def test_friction_keeps_its_limit_at_all_times_of_a_bristle_that_is_loaded_at_once():
    """At 10 m/s the bristle is at its limit within 2e-11 s, which a stiff step of 1e-3 s passes over."""
    law = jms.LuGre(sigma0=1e8, sigma1=0.0, sigma2=0.0, Fc=0.02, Fs=0.02, vs=0.1)
    ts = np.concatenate([[0.0], np.geomspace(1e-12, 1.0, 60)])
    run = jms.simulate(ramped_box.scene(law), [0.0], [10.0], 1.0, ts=ts)
    assert float(jnp.max(run.forces["friction"])) < 0.02 * (1.0 + 1e-3)


STEP = CASES["step_longer_than_run"]


def test_checks_fail_where_something_is_wrong():
    assert check(STEP, ["alone", "vmap", "forward", "energy"], ["float64"]).ok
    wrong = {
        "value": replace(STEP, exact=lambda ramp: ramp / 4.0 + 1e-5),
        "end": replace(STEP, ends="step limit"),
        "derivative": replace(STEP, exact=lambda ramp: 0.25 + 0.0 * ramp),
        "measured": HardCase("m", "", "", MeasuredNumber(lambda: 1.0), lambda _: 2.0),
        "refused": HardCase("r", "", "", RefusedCalls({"x": lambda: None}, {"x": "anything"})),
        "other text": HardCase("r", "", "", RefusedCalls({"x": lambda: jms.Coulomb(-1.0)}, {"x": "Fs must"})),
    }
    for what, case in wrong.items():
        transforms = ["forward"] if what == "derivative" else ["alone"]
        assert not check(case, transforms, ["float64"]).ok, what
    # A derivative that exists is not flagged.
    claims = replace(CASES["equilibrium"], undefined="none, it is said")
    assert not check(claims, ["reverse"], ["float64"]).ok


def test_transforms_and_types_must_exist():
    with pytest.raises(ValueError, match=r"transforms must be of alone, jit, .*, but 'alonee' was given"):
        check(STEP, ["alonee"])


def test_the_page_lists_every_case():
    """Written by `python -m tests.hard.catalogue`."""
    assert catalogue.PAGE.read_text() == catalogue.with_table(catalogue.PAGE.read_text())


def test_figure_has_units(tmp_path):
    result = Result("hard_cases")
    add_errors(result, [check(STEP, ["alone"], ["float64"])])
    result.write(tmp_path, smoke=True)
    (axis,) = figures.hard(Recorded.read(tmp_path / "hard_cases.json")).axes
    assert axis.get_xlabel() == "error over what is admissible [1]"
    assert [label.get_text() for label in axis.get_yticklabels()] == ["step_longer_than_run"]
