"""A law in one place: a new one, defined here in one class and registered, is found by everything that lists laws."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest

import jaxmodsim as jms
from bench.behaviour.experiment import Verdict, law_cases
from bench.behaviour.run import run_bench
from jaxmodsim.friction import STANDARD, AbstractForceLaw, LawCase, _law, check_passivity, laws, parameter, register_law
from jaxmodsim.identify import axis_models, axis_scene, estimate_axis
from jaxmodsim.scene import scene_numbers

from ..helpers.law_cases import CASES, cases_of_registered_laws
from ..helpers.law_table import law_table
from . import test_laws as contract

Command = Callable[..., tuple[int, str, str]]


class SoftCoulomb(AbstractForceLaw):
    """`F = Fc v/sqrt(v^2 + width^2) + Fv v`."""

    Fc: Any = parameter("Fc", "N", lower=0.0)
    Fv: Any = parameter("Fv", "N s/m", lower=0.0)
    width: Any = parameter("width", "m/s", lower=0.0, strict=True, execution=True)
    stiff: ClassVar[bool] = True
    description: ClassVar[str] = "a root in place of the sign"
    equations: ClassVar[tuple[str, ...]] = ("Fc v/sqrt(v^2 + width^2) + Fv v",)

    def force(self, v: Any) -> Any:
        return self.Fc * v / jnp.sqrt(v * v + self.width * self.width) + self.Fv * v

    def modelica(self) -> str:
        return ""

    @classmethod
    def cases(cls) -> tuple[LawCase, ...]:
        return (LawCase("SoftCoulomb", cls.standard(), lambda v: STANDARD["Fc"] * np.sign(v) + STANDARD["Fv"] * v),)

    @classmethod
    def fit_start(cls, m: float, Fc: float, Fv: float, v_max: float) -> "SoftCoulomb":
        del m
        return cls(Fc, Fv, 1e-3 * v_max)


@pytest.fixture
def registered(monkeypatch: pytest.MonkeyPatch) -> type[SoftCoulomb]:
    """The new law, known for the time of one test."""
    monkeypatch.setattr(_law, "_LAWS", dict(_law._LAWS))
    return register_law(SoftCoulomb)


@pytest.mark.quick
def test_the_registry_lists_laws_in_order_and_refuses_what_is_none(registered: type[SoftCoulomb]) -> None:
    assert list(laws())[-1] == "SoftCoulomb"
    assert list(laws())[:4] == ["Viscous", "Curve", "Coulomb", "Stribeck"]
    with pytest.raises(ValueError, match="there is a law SoftCoulomb already"):
        register_law(registered)
    with pytest.raises(ValueError, match="needs a final class of laws"):
        register_law(AbstractForceLaw)
    with pytest.raises(ValueError, match=r"Known laws: Viscous, .*SoftCoulomb"):
        jms.Friction("soft")


@pytest.mark.quick
def test_no_test_leaves_a_law_behind() -> None:
    assert "SoftCoulomb" not in laws()


def test_the_contract_holds_for_it(registered: type[SoftCoulomb], monkeypatch: pytest.MonkeyPatch) -> None:
    del registered
    assert cases_of_registered_laws().keys() - CASES.keys() == {"softcoulomb"}
    case = cases_of_registered_laws()["softcoulomb"]
    np.testing.assert_allclose([case.bound, *case.level, *case.viscous], [1.0, 1.0, 1.0, 0.4, 0.4], rtol=1e-4)
    monkeypatch.setitem(CASES, "softcoulomb", case)
    contract.test_dissipation_is_never_negative("softcoulomb")
    contract.test_odd_in_slip("softcoulomb")
    contract.test_bounded_by_the_static_limit("softcoulomb")
    contract.test_jit_and_vmap_give_what_a_loop_gives("softcoulomb")
    contract.test_gradients_equal_finite_differences("softcoulomb")
    contract.test_at_rest_everything_is_finite_and_keeps_its_dtype("softcoulomb", jnp.float64)
    assert check_passivity(case.law)


def test_the_behaviour_bench_runs_it(registered: type[SoftCoulomb]) -> None:
    (case,) = (case for case in law_cases() if isinstance(case.law, registered))
    found = run_bench([case])["SoftCoulomb"]
    assert Verdict.FAIL not in [outcome.verdict for outcome in found.values()]
    assert found["characteristic"].verdict is Verdict.PASS
    for experiment, reason in case.law.known_limitations().items():
        assert found[experiment].reason == reason


SPEC = """
[scene]
problem = "belt_oscillator"
law = {kind = "SoftCoulomb", Fc = 5, Fv = 1, width = 1e-3}
[run]
q0 = [0.05]
qd0 = [0.0]
t1 = 0.5
[over]
k = [50, 80]
[observe]
end = {of = "qd[0]", take = "end"}
"""


def test_a_spec_file_may_name_it(registered: type[SoftCoulomb], run_command: Command, tmp_path: Path) -> None:
    del registered
    path = tmp_path / "spec.toml"
    path.write_text(SPEC)
    code, _, errors = run_command("sweep", str(path), "--dry-run")
    assert code == 0, errors
    path.write_text(SPEC.replace('"SoftCoulomb"', '"SoftCoulom"'))
    code, _, errors = run_command("sweep", str(path), "--dry-run")
    assert code == 2
    assert "kind must be one of Viscous" in errors
    assert "Did you mean 'SoftCoulomb'?" in errors


def test_it_is_a_candidate_of_a_fit(registered: type[SoftCoulomb], run_command: Command, tmp_path: Path) -> None:
    model = axis_models()["softcoulomb"]
    assert model.free == ("m", "offset", "friction.Fc", "friction.Fv")
    t = np.linspace(0.0, 6.0, 200)
    scene = axis_scene(model, estimate_axis(jms.Record(t, np.sin(t), {"u": np.cos(t)})))
    assert any(isinstance(getattr(effect, "law", None), registered) for effect in scene.effects)
    assert set(model.free) <= set(scene_numbers(scene)) | {"m", "offset"}
    path = tmp_path / "record.csv"
    pd.DataFrame({"t": t, "q": np.sin(t), "u": np.cos(t)}).to_csv(path, index=False)
    code, _, errors = run_command("fit", str(path), "--laws", "softcoulom")
    assert code == 2
    assert "softcoulomb" in errors.split("the laws are")[1]
    assert "Did you mean 'softcoulomb'?" in errors


@pytest.mark.quick
def test_exports_take_its_word(registered: type[SoftCoulomb]) -> None:
    law = registered(Fc=1.5, Fv=0.4, width=1e-3)
    with pytest.raises(ValueError, match="MuJoCo has no SoftCoulomb: its joints have friction that is constant"):
        jms.to_mujoco(law)
    assert jms.to_modelica(law, v_max=1.0).startswith(
        "Modelica.Mechanics.Translational.Components.SupportFriction friction(f_pos=[0, 0; "
    )


@pytest.mark.quick
def test_the_table_of_laws_has_it(registered: type[SoftCoulomb]) -> None:
    cells = (
        "`SoftCoulomb(Fc, Fv, width)`",
        registered.description,
        f"`{registered.equations[0]}`",
        "integrated directly",
    )
    row = f"| {' | '.join(cells)} |"
    assert row in law_table().splitlines()
