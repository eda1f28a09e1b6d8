"""Hard cases: one of each kind, and that the checks themselves can fail."""

from dataclasses import replace
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

import jaxmodsim as jms
from jaxmodsim.cli import _hard
from jaxmodsim.plot import hard_figure
from jaxmodsim.problems import ramped_box
from jaxmodsim.validation import hard
from jaxmodsim.validation.hard import CaseReport, HardCase
from jaxmodsim.validation.hard._case import MeasuredNumber, RefusedCalls
from jaxmodsim.validation.hard._check import DTYPES, CheckFinding

CASES = hard.hard_cases()


def test_every_case_says_why_it_is_hard_and_what_is_right():
    assert len(CASES) >= 40
    assert {case.family for case in CASES.values()} == set(hard.FAMILIES)
    for name, case in CASES.items():
        assert case.name == name
        assert min(len(case.why), len(case.naive), len(case.asks)) > 5
        if not isinstance(case.task, RefusedCalls):
            assert case.exact or case.second or case.ends
        # A transform, or a transform in one type.
        assert set(case.skips) <= {
            *hard.TRANSFORMS,
            *(f"{transform} {dtype}" for transform in hard.TRANSFORMS for dtype in DTYPES),
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
    """Besides what `jaxmodsim hard --transforms alone` checks in `.ci/run`, which is all cases alone."""
    verdict = hard.check(CASES[name], transforms, ["float64"])
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
    assert hard.check(STEP, ["alone", "vmap", "forward", "energy"], ["float64"]).ok
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
        assert not hard.check(case, transforms, ["float64"]).ok, what
    # A derivative that exists is not flagged.
    claims = replace(CASES["equilibrium"], undefined="none, it is said")
    assert not hard.check(claims, ["reverse"], ["float64"]).ok


def test_what_is_asked_for_must_be_there():
    with pytest.raises(ValueError, match=r"transforms must be of alone, jit, .*, but 'alonee' was given"):
        hard.check(STEP, ["alonee"])
    with pytest.raises(ValueError, match=r"no hard case or family 'bristle_stif'.*Did you mean 'bristle_stiff'"):
        list(hard.check_many(["bristle_stif"]))


def test_command(run_command: Any, tmp_path: Any, monkeypatch: pytest.MonkeyPatch):
    assert "bristle_stiff" in run_command("hard", "stiffness", "--list")[1]
    code, out, _ = run_command("hard", "times_unfit", "--out", str(tmp_path / "hard"))
    assert code == 0
    assert "1 of 1 cases pass" in out
    assert {path.name for path in (tmp_path / "hard").iterdir()} == {"hard.csv", "hard.json", "hard.png"}
    code, _, errors = run_command("hard", "nonsense", "--out", str(tmp_path / "none"))
    assert (code, (tmp_path / "none").exists()) == (2, False)
    assert "no hard case or family 'nonsense'" in errors

    failed = CaseReport(STEP, (CheckFinding("alone", "float64", 3.0, False, "0.75, right is 0.25."),))

    def fails(*arguments: Any, **options: Any) -> Any:
        del arguments, options
        yield failed
        raise KeyboardInterrupt

    monkeypatch.setattr(_hard, "check_many", lambda *arguments, **options: iter([failed]))
    code, out, _ = run_command("hard", "step_longer_than_run", "--out", str(tmp_path / "fails"))
    assert code == 1
    assert "FAIL: step_longer_than_run, alone, float64: 0.75, right is 0.25." in out
    monkeypatch.setattr(_hard, "check_many", fails)
    code, _, errors = run_command("hard", "step_longer_than_run", "--out", str(tmp_path / "stopped"))
    assert code == 130
    assert "what was found on 1 of 1 cases is written" in errors
    assert (tmp_path / "stopped" / "hard.json").exists()


def test_figure_has_units():
    verdict = hard.check(STEP, ["alone"], ["float64"])
    (axis,) = hard_figure([verdict]).axes
    assert axis.get_xlabel() == "error over what is admissible [1]"
    assert [label.get_text() for label in axis.get_yticklabels()] == ["step_longer_than_run"]
