"""Work-precision: errors kept apart, failures kept, references that must agree. Nothing here is about how long."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import diffrax as dfx
import jax.numpy as jnp
import numpy as np
import pytest

import jaxmodsim as jms
from jaxmodsim.analysis import Row, WorkPrecision, load_work_precision
from jaxmodsim.plot import work_precision_figure
from jaxmodsim.problems import belt_oscillator, braked_spring, named_problems, ramped_box

CASE = named_problems()["braked_spring"]()
LOOSE, TIGHT = 1e-4, 1e-7
WIDTHS = (1e-3, 1e-4)


def rows_of(found: WorkPrecision, method: str) -> list[Row]:
    return [row for row in found.rows if row.method == method]


def known(x: float | None) -> float:
    assert x is not None
    return x


@pytest.fixture(scope="module")
def found() -> WorkPrecision:
    """Exact friction by two solvers, smooth friction of two widths, and one that can not get through."""
    smooth = [jms.formulations(CASE.scene, width=width)["Regularized"] for width in WIDTHS]
    methods = {
        "Rodas5P": jms.Method(jms.Rodas5P()),
        "Tsit5": jms.Method(dfx.Tsit5()),
        "wide": jms.Method(jms.Rodas5P(), smooth[0]),
        "narrow": jms.Method(jms.Rodas5P(), smooth[1]),
        # Explicit Euler is unstable with the longer step, beyond all numbers.
        "Euler": jms.Method(dfx.Euler(), braked_spring.scene(jms.Viscous(1e3)), steps=(0.1, 1e-3)),
    }
    return jms.work_precision(**CASE.arguments, methods=methods, tolerances=(LOOSE, TIGHT), rounds=1, max_steps=3000)


@pytest.fixture(scope="module")
def small() -> WorkPrecision:
    """One method, of which one run has failed, as if."""
    methods, scene = {"Tsit5": jms.Method(dfx.Tsit5())}, braked_spring.scene()
    study = jms.work_precision(scene, [1.0], [0.0], 3.0, methods=methods, tolerances=(LOOSE, TIGHT), rounds=1)
    return dataclasses.replace(study, rows=(*study.rows, Row("Euler", None, 0.1, "float64", failed="out of range")))


def test_errors_fall_with_the_tolerance(found: WorkPrecision) -> None:
    for method in ("Rodas5P", "Tsit5"):
        loose, tight = rows_of(found, method)
        assert (loose.rtol, tight.rtol) == (LOOSE, TIGHT)
        assert known(tight.error) < 0.1 * known(loose.error) < 1e-2
        assert known(tight.steps) > known(loose.steps)
        assert tight.numerical == tight.error
        assert tight.model == 0.0
    assert found.disagreement < 1e-9
    np.testing.assert_allclose(found.scale, abs(known(CASE.exact)), rtol=1e-12)


def test_events(found: WorkPrecision) -> None:
    """Their times are as exact as the run; formulations have none."""
    loose, tight = rows_of(found, "Tsit5")
    assert 1e-6 < known(loose.events) < 1e-2
    assert known(tight.events) < 1e-2 * known(loose.events)
    assert all(row.events is None for row in rows_of(found, "wide"))


def test_the_modelling_error_is_separate(found: WorkPrecision) -> None:
    """It is of order 1 in the width and no tolerance changes it; the numerical error goes on to fall."""
    wide, narrow = rows_of(found, "wide"), rows_of(found, "narrow")
    assert wide[0].model == wide[1].model
    order = np.log10(known(wide[0].model) / known(narrow[0].model))
    np.testing.assert_allclose(order, 1.0, atol=0.05)
    for loose, tight in (wide, narrow):
        assert known(tight.numerical) < 1e-2 * known(loose.numerical)
        assert known(tight.numerical) < 1e-2 * known(tight.model)
        np.testing.assert_allclose(known(tight.error), known(tight.model), rtol=0.02)


def test_a_failed_method_has_a_row(found: WorkPrecision) -> None:
    """With its reason, in everything that is shown."""
    failed, fine = rows_of(found, "Euler")
    assert failed.dt == 0.1
    assert "SimulationError: The vector field gave a value that is not finite" in failed.failed
    assert failed.error is None
    assert failed.steps is None
    assert failed.failed in str(found)
    assert failed.failed in set(found.table()["failed"])
    # The steps of a ladder may be more than max_steps.
    assert (fine.dt, fine.rtol, fine.steps, fine.evaluations) == (1e-3, None, 20_000, 20_000)
    assert not fine.failed


def test_evaluations_are_those_of_the_stages_and_the_jacobian(found: WorkPrecision) -> None:
    explicit, rosenbrock = rows_of(found, "Tsit5")[0], rows_of(found, "Rodas5P")[0]
    assert explicit.evaluations == 6 * known(explicit.steps)
    # Eight stages, the derivative by time, and the Jacobian by position and velocity.
    assert rosenbrock.evaluations == (8 + 1 + 2) * known(rosenbrock.steps)


def test_the_cheapest(small: WorkPrecision) -> None:
    row = small.cheapest(1e-5)
    assert known(row.error) <= 1e-5
    assert row.time() == min(each.time() for each in small.rows if each.error is not None and each.error <= 1e-5)
    best = min(each.error for each in small.rows if each.error is not None)
    with pytest.raises(ValueError, match=f"the best is {best:.1e}") as said:
        small.cheapest(2.0 * small.disagreement)
    assert "tighter tolerances" in str(said.value)
    with pytest.raises(ValueError, match=r"has measured \(run\), but is 'vmap'"):
        small.cheapest(1e-3, cost="vmap")
    with pytest.raises(ValueError, match="references disagree"):
        small.cheapest(1e-18)


def test_a_study_survives_its_file(small: WorkPrecision, tmp_path: Path) -> None:
    path = tmp_path / "found.json"
    small.save(path)
    assert load_work_precision(path) == small
    assert {"cpu", "versions", "commit"} <= set(json.loads(path.read_text())["machine"])
    whole = path.read_bytes()
    spoilt = dataclasses.replace(small, scale=float("nan"))
    with pytest.raises(ValueError, match="JSON"):
        spoilt.save(path)
    assert path.read_bytes() == whole
    assert list(tmp_path.iterdir()) == [path]


def test_damaged_and_other_files_are_refused(small: WorkPrecision, tmp_path: Path) -> None:
    path = tmp_path / "found.json"
    for text, words in (("{", "damaged"), ('{"a": 1}', "not written by"), ("[]", "not written by")):
        path.write_text(text)
        with pytest.raises(ValueError, match=words):
            load_work_precision(path)
    small.save(path)
    body = json.loads(path.read_text())
    path.write_text(json.dumps({**body, "format": 0}))
    with pytest.raises(ValueError, match="format 0"):
        load_work_precision(path)
    path.write_text(json.dumps({name: x for name, x in body.items() if name != "scale"}))
    with pytest.raises(ValueError, match="damaged"):
        load_work_precision(path)


def test_the_figure_shows_every_method(found: WorkPrecision) -> None:
    figure = work_precision_figure(found)
    left, right = figure.axes
    labels = [text.get_text() for text in figure.legends[0].get_texts()]
    assert labels == ["Rodas5P", "Tsit5", "wide", "narrow", "Euler (1 of 2 failed)", "modelling error"]
    assert "failed: Euler, dt = 0.1 s: SimulationError" in figure.get_supxlabel()
    assert "[ms]" in left.get_ylabel()
    assert right.get_ylabel() == "evaluations of the vector field [1]"
    with pytest.raises(ValueError, match=r"has measured \(run\), but is 'forward'"):
        work_precision_figure(found, cost="forward")


def test_gradients_against_a_closed_form() -> None:
    """A free oscillator: x = x0 cos(w t), so dx/dk = -x0 sin(w t) t w/(2 k)."""
    m, k, x0, t1 = 1.3, 2.7, 1.0, 3.0
    w = np.sqrt(k / m)
    found = jms.work_precision(
        braked_spring.scene(m=m, k=k),
        [x0],
        [0.0],
        t1,
        reference=lambda t: x0 * np.cos(w * t),
        methods={"Tsit5": jms.Method(dfx.Tsit5())},
        tolerances=(1e-4, 1e-7),
        costs=("run", "vmap", "forward", "reverse"),
        wrt=["k", "q0[0]", "qd0[0]"],
        batch=3,
        rounds=1,
    )
    loose, tight = found.rows
    assert known(tight.gradient) < 1e-2 * known(loose.gradient) < 1e-2
    assert found.gradient_disagreement < 1e-9
    assert set(tight.times or {}) == {"run", "vmap", "forward", "reverse"}
    assert all(timing.low <= timing.median <= timing.high for timing in (tight.times or {}).values())
    columns = set(found.table().columns)
    assert {"error", "gradient error", "vmap median [s]", "reverse compile [s]"} <= columns


def test_over_time_and_by_a_function() -> None:
    """Velocity of the box without friction, v = t^2/4, at several times; a reference of another motion is refused."""
    scene, ts = ramped_box.scene(), np.linspace(0.0, 2.0, 5)
    methods = {"Tsit5": jms.Method(), "single": jms.Method(dtype="float32")}
    choices: dict[str, Any] = {"ts": ts, "methods": methods, "tolerances": (1e-5,), "rounds": 1}

    def speed(run: jms.Trajectory) -> Any:
        return run.qd[:, 0]

    found = jms.work_precision(scene, [0.0], [0.0], 2.0, observable=speed, reference=lambda t: t**2 / 4.0, **choices)
    assert found.observable == "speed"
    double, single = found.rows
    assert (double.dtype, single.dtype) == ("float64", "float32")
    assert known(double.error) < 1e-12 < 1e-9 < known(single.error) < 1e-5
    with pytest.raises(RuntimeError, match=r"references disagree: speed is 1\.1 .* and 1 ") as said:
        jms.work_precision(scene, [0.0], [0.0], 2.0, observable=speed, reference=1.1 * ts**2 / 4.0, **choices)
    assert "agreement" in str(said.value)


def test_two_solvers_that_disagree_are_refused() -> None:
    """From q = 1 an exact start would fall to the unstable rest; what the solvers do depends on their rounding."""
    scene = jms.Scene(lambda t, q, qd, p: 0.5 * (qd[0] ** 2 + q[0] ** 2))
    choices: dict[str, Any] = {"methods": {"Tsit5": jms.Method()}, "tolerances": (1e-6,), "rounds": 1}
    with pytest.raises(
        RuntimeError, match=r"disagree: q\[0\] is .* by Rodas5P at rtol = 1e-09 and .* by Dopri8"
    ) as said:
        jms.work_precision(scene, [1.0], [-1.0], 30.0, **choices)
    assert "Reduce t1" in str(said.value)


def test_formulations() -> None:
    scene = jms.Scene(
        lambda t, q, qd, p: 0.5 * (qd[0] ** 2 + qd[1] ** 2),
        effects=(
            jms.Friction(jms.Coulomb(1.0, 1.5), along=lambda q: q[0], name="one"),
            jms.Friction(jms.Viscous(0.3), along=lambda q: q[0], name="two"),
            jms.Friction(belt_oscillator.stribeck(), along=lambda q: q[1], belt_velocity=0.2, name="three"),
        ),
    )
    found = jms.formulations(scene, width=1e-3, sigma0=1e5, sigma1=3.0)
    assert list(found) == ["Regularized", "DeadZone", "LuGre"]
    assert not any(other.event_driven for other in found.values())
    one, two, three = (effect for effect in found["LuGre"].effects if isinstance(effect, jms.Friction))
    assert isinstance(one.law, jms.LuGre)
    assert (float(one.law.Fs), float(one.law.vs), float(one.law.sigma1)) == (1.5, 1e-3, 3.0)
    assert isinstance(two.law, jms.Viscous)
    assert isinstance(three.law, jms.LuGre)
    assert (float(three.law.vs), float(three.law.sigma2), float(jnp.asarray(three.belt_velocity))) == (0.2, 0.3, 0.2)
    assert set(jms.formulations(scene, width=1e-3)) == {"Regularized", "DeadZone"}
    with pytest.raises(ValueError, match="Gaussian Stribeck"):
        jms.formulations(
            jms.Scene(scene.lagrangian, effects=(jms.Friction(belt_oscillator.stribeck(1.0)),)), width=1.0, sigma0=1.0
        )
    with pytest.raises(ValueError, match="needs a set-valued law"):
        jms.formulations(found["LuGre"], width=1e-3)


@pytest.mark.parametrize(
    ("choices", "words"),
    [
        ({"methods": {"a": dfx.Tsit5()}}, r"methods\['a'\] must be a Method"),
        ({"methods": {}}, "methods is empty"),
        ({"tolerances": (1e-3, 0.0)}, "tolerances must be > 0"),
        ({"tolerances": ()}, "tolerances is empty"),
        ({"costs": "run"}, "costs must be"),
        ({"costs": ("run", "money")}, "costs must be"),
        ({"rounds": 0}, "rounds must be a positive integer"),
        ({"observable": 3.0}, "observable must be a function"),
        ({"reference": float("nan")}, "reference must be finite"),
        ({"costs": ("run", "forward"), "wrt": "mass"}, "wrt names 'mass'"),
    ],
)
def test_misuse(choices: dict[str, Any], words: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("jaxtyping.config.jaxtyping_disable", True)  # as users have it
    with pytest.raises(ValueError, match=words):
        jms.work_precision(**{**CASE.arguments, **choices})


def test_misuse_of_scenes_and_methods(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("jaxtyping.config.jaxtyping_disable", True)
    with pytest.raises(ValueError, match="needs a Scene, but 'braked_spring'"):
        jms.work_precision("braked_spring", [1.0], [0.0], 1.0)  # type: ignore[arg-type]
    settings: dict[str, Any]
    for settings, words in (({"steps": ()}, "fixed steps"), ({"dtype": "half"}, "'float32' or 'float64'")):
        with pytest.raises(ValueError, match=words):
            jms.Method(**settings)
