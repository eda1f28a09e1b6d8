"""Modes of an FMU before its first step, after changes between steps, and after a jump of a load."""

from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

import jaxmodsim as jms

from ..helpers.compilers import OWN, needs_fmpy

fmpy = pytest.importorskip("fmpy", reason="needs FMPy, which runs FMUs")


def opened(kind: str, path: Path, **options: Any) -> tuple[Any, dict[str, int], list[bytes]]:
    """An instance of an FMU, of a class of `fmpy.fmi3`; the references of its variables; and what it will log."""
    from fmpy import fmi3

    description = fmpy.read_model_description(str(path))
    folder = fmpy.extract(str(path), str(path.with_suffix("")))
    one = getattr(fmi3, kind)(
        guid=description.guid, unzipDirectory=folder, modelIdentifier=path.stem, instanceName="one"
    )
    said: list[bytes] = []
    one.instantiate(logMessage=lambda _environment, _status, _category, message: said.append(message), **options)
    return one, {each.name: each.valueReference for each in description.modelVariables}, said


@needs_fmpy
def test_modes_are_decided_before_the_first_step_and_after_a_jump_of_a_load(tmp_path: Path) -> None:
    scene = jms.Scene(
        lambda t, q, qd, p: 0.5 * p["m"] * qd[0] ** 2,
        {"m": 1.0, "pull": 0.0},
        (
            jms.AppliedForce(lambda t, q, qd, p: (p["pull"] - t)[None], name="motor"),
            jms.Friction(jms.Coulomb(1.0, 1.5)),
        ),
    )
    path = jms.export.fmu(
        scene, [0.0], [0.3], tmp_path / "cart.fmu", inputs=["pull", "friction.belt_velocity"], platforms=[OWN]
    )
    one, place, said = opened("FMU3Slave", path)

    def check(force: float, rate: float) -> None:
        assert one.getFloat64([place["friction"], place["der(qd[0])"]]) == pytest.approx([force, rate])
        assert one.getInt32([place["friction.mode"]]) == [np.sign(force)]
        by = [place["der(qd[0])"]], [place["friction.Fc"]]
        assert one.getDirectionalDerivative(*by, [1.0]) == one.getAdjointDerivative(*by, [1.0]) == [-np.sign(force)]

    # Numbers out of range are refused when they are used: two that limit each other change one after the other.
    one.enterInitializationMode(tolerance=1e-6, startTime=0.0)
    for name, wrong, right in (("Fc", -1.0, 1.0), ("Fs", 0.5, 1.5)):
        one.setFloat64([place[f"friction.{name}"]], [wrong])
        with pytest.raises(Exception, match="fmi3GetFloat64 failed"):
            one.getFloat64([place["friction"]])
        with pytest.raises(Exception, match="fmi3ExitInitializationMode failed"):
            one.exitInitializationMode()
        one.setFloat64([place[f"friction.{name}"]], [right])
    assert said[0] == b"Coulomb: Fc must be finite and >= 0 [N] (at scene.effects[1].law)."
    assert said[-1] == b"Coulomb: Fs must be finite and >= Fc [N] (at scene.effects[1].law)."
    check(1.0, -1.0)
    one.exitInitializationMode()
    check(1.0, -1.0)
    one.setFloat64([place["friction.belt_velocity"]], [1.0])
    check(-1.0, 1.0)
    one.setFloat64([place["friction.belt_velocity"]], [0.0])
    one.setFloat64([place["friction.Fs"]], [0.5])
    with pytest.raises(Exception, match="fmi3DoStep failed"):
        one.doStep(0.0, 0.5)
    one.setFloat64([place["friction.Fs"]], [1.5])
    one.doStep(0.0, 0.5)
    assert one.getFloat64([place["qd[0]"]]) == [0.0]
    # The load jumps beyond break-away, and falls while friction still sticks.
    one.setFloat64([place["pull"]], [5.0])
    check(1.0, 3.5)
    one.doStep(0.5, 0.5)
    assert one.getFloat64([place["qd[0]"]]) == pytest.approx([1.625])
    one.freeInstance()


@needs_fmpy
def test_an_input_out_of_range_between_events_of_model_exchange_is_refused(tmp_path: Path) -> None:
    from fmpy.fmi3 import fmi3Float64

    scene = jms.Scene(lambda t, q, qd, p: 0.5 * qd[0] ** 2, effects=(jms.Friction(jms.Coulomb(1.0, 1.5)),))
    path = jms.export.fmu(scene, [0.0], [0.3], tmp_path / "box.fmu", inputs=["friction.Fs"], platforms=[OWN])
    one, place, said = opened("FMU3Model", path)
    one.enterInitializationMode(tolerance=1e-6, startTime=0.0)
    one.exitInitializationMode()
    one.updateDiscreteStates()
    one.enterContinuousTimeMode()
    rates, guards = (fmi3Float64 * 2)(), (fmi3Float64 * 1)()
    one.setFloat64([place["friction.Fs"]], [0.5])
    for use in (
        lambda: one.getContinuousStateDerivatives(rates, 2),
        lambda: one.getEventIndicators(guards, 1),
        lambda: one.getFloat64([place["friction"]]),
    ):
        with pytest.raises(Exception, match="failed"):
            use()
    assert said == 3 * [b"Coulomb: Fs must be finite and >= Fc [N] (at scene.effects[0].law)."]
    one.setFloat64([place["friction.Fs"]], [1.5])
    one.getContinuousStateDerivatives(rates, 2)
    assert list(rates) == [0.3, -1.0]
    one.freeInstance()


def stepping(path: Path) -> tuple[Any, dict[str, int]]:
    """An instance in step mode that returns at events, with the tolerance 1e-9; and the references of its variables."""
    one, place, _ = opened("FMU3Slave", path, eventModeUsed=True, earlyReturnAllowed=True)
    one.enterInitializationMode(tolerance=1e-9, startTime=0.0)
    one.exitInitializationMode()
    one.updateDiscreteStates()
    one.enterStepMode()
    return one, place


@needs_fmpy
def test_a_contact_that_opens_without_restitution_stays_open(tmp_path: Path) -> None:
    """The velocity of its gap is rounding, of either sign: it closed again, and a step never ended."""
    scene = jms.Scene(
        lambda t, q, qd, p: 0.5 * p["m"] * qd[0] ** 2 + (p["u"] + p["a"] * jnp.sin(p["w"] * t)) * q[0],
        {"m": 1.627597215428478, "a": 3.2879113866395064, "w": 5.701113437864923, "u": 0.6026897183986004},
        constraints=(
            jms.Contact(lambda t, q, p: q[0] + 0.057916205110450966, name="lower"),
            jms.Contact(lambda t, q, p: 0.09133682950280056 - q[0], restitution=0.434171525044368, name="upper"),
        ),
    )
    path = jms.export.fmu(
        scene, [-0.019056054820276398], [-0.471320541735349], tmp_path / "stops.fmu", inputs=["u"], platforms=[OWN]
    )
    one, place = stepping(path)
    times, t = [], 0.0
    for end, load in ((1.0, 0.42603236), (2.0, -1.86381767), (3.0, -0.28214342), (4.0, 0.0)):
        while t < end and len(times) < 50:
            event, _, _, t = one.doStep(t, end - t)
            if event:
                times.append(t)
            one.enterEventMode()
            if t >= end:
                one.setFloat64([place["u"]], [load])
            one.updateDiscreteStates()
            one.enterStepMode()
    one.freeInstance()
    # By SciPy's DOP853 at 1e-12, from event to event.
    exact = [0.0882771040, 0.4719734099, 0.8794351842, 1.0793057599, 1.5466246340]
    exact += [1.9780858752, 2.3099122565, 3.0511832705, 3.3213641776, 3.8241899467]
    np.testing.assert_allclose(times, exact, atol=1e-8, rtol=0)


@needs_fmpy
def test_a_long_step_out_of_stick_ends_on_the_first_break_away(tmp_path: Path) -> None:
    """The motion of stick has no error, so that its step is 1.5 s; the load passes the limit earlier, and again."""
    scene = jms.Scene(
        lambda t, q, qd, p: 0.5 * p["m"] * qd[0] ** 2 - 0.5 * p["k"] * q[0] ** 2 + p["a"] * jnp.sin(p["w"] * t) * q[0],
        {"m": 2.3759116815751313, "k": 14.814306529511397, "a": 1.9407638977265402, "w": 7.865160398608671},
        (jms.Friction(jms.Coulomb(1.453988632396544), belt_velocity=-0.17848703676370337),),
    )
    path = jms.export.fmu(scene, [-0.20360879473492388], [-0.17848703676370337], tmp_path / "m.fmu", platforms=[OWN])
    one, place = stepping(path)
    times, t = [], 0.0
    while t < 3.0:
        event, _, _, t = one.doStep(t, 3.0 - t)
        if event:
            times.append(t)
            one.enterEventMode()
            one.updateDiscreteStates()
            one.enterStepMode()
    # By SciPy's DOP853 at 1e-12, from event to event.
    exact = [1.4982244891, 1.5146932181, 1.6802298164, 2.1310398227, 2.3733306343]
    np.testing.assert_allclose(times, exact, atol=1e-8, rtol=0)
    assert one.getFloat64([place["q[0]"]]) == pytest.approx([-0.10962611], abs=1e-8)
    one.freeInstance()


@needs_fmpy
def test_a_jump_of_an_input_breaks_stick_although_the_load_falls_back_within_the_step(tmp_path: Path) -> None:
    """The load exceeds the limit at the beginning of a step alone: the mass did not move, but for 0.229 m."""
    scene = jms.Scene(
        lambda t, q, qd, p: 0.5 * qd[0] ** 2,
        {"pull": 0.0},
        (jms.AppliedForce(lambda t, q, qd, p: (p["pull"] - t)[None]), jms.Friction(jms.Coulomb(1.0, 1.5))),
    )
    path = jms.export.fmu(scene, [0.0], [0.0], tmp_path / "cart.fmu", inputs=["pull"], platforms=[OWN])
    one, place, _ = opened("FMU3Slave", path)
    one.enterInitializationMode(tolerance=1e-9, startTime=0.0)
    one.exitInitializationMode()
    one.doStep(0.0, 1.0)
    one.setFloat64([place["pull"]], [2.7])
    one.doStep(1.0, 2.0)
    # v = 0.7 s - s^2/2 for s = t - 1, until v = 0.
    assert one.getFloat64([place["q[0]"], place["qd[0]"]]) == pytest.approx([1.4**3 / 12.0, 0.0], abs=1e-9)
    one.freeInstance()


@needs_fmpy
def test_an_importer_does_not_lose_a_contact_whose_last_rebounds_it_does_not_resolve(tmp_path: Path) -> None:
    """The sign of its errors in a gap was an event, and the next fall none: for a while friction did not act."""
    floor = jms.Contact(lambda t, q, p: q[1], restitution=0.5, name="floor")
    rubs = jms.Friction(jms.Coulomb(0.25), along=lambda q: q[0], normal_force="floor")
    scene = jms.Scene(lambda t, q, qd, p: 0.5 * jnp.sum(qd**2) - 4.0 * q[1], {}, (rubs,), constraints=(floor,))
    path = jms.export.fmu(scene, [0.0, 0.5], [2.0, 0.0], tmp_path / "puck.fmu", platforms=[OWN])
    for restitution in (0.15, 0.4):
        rows = fmpy.simulate_fmu(
            str(path),
            fmi_type="ModelExchange",
            stop_time=3.0,
            output_interval=0.2,
            relative_tolerance=1e-7,
            start_values={"floor.restitution": restitution},
        )
        # A series of parabolas with impulses of friction between them, then sliding: the same for all restitutions.
        assert [rows["q[0]"][-1], rows["q[1]"][-1]] == pytest.approx([2.125, 0.0], abs=1e-5)


@needs_fmpy
def test_chatter_is_an_error_in_a_scene_with_a_contact_elsewhere(tmp_path: Path) -> None:
    """Only impacts that accumulate leave their contact closed: the switch kept its side, and the mass was lost."""
    push = jms.Switch(
        lambda t, q, qd, p: q[0] + qd[0],
        above=lambda t, q, qd, p: -2.0 + 0.0 * q,
        below=lambda t, q, qd, p: 2.0 + 0.0 * q,
    )
    far = jms.Contact(lambda t, q, p: q[0] + 100.0, name="far")
    scene = jms.Scene(lambda t, q, qd, p: 0.5 * qd[0] ** 2, {}, (push,), constraints=(far,))
    path = jms.export.fmu(scene, [1.0], [0.0], tmp_path / "push.fmu", platforms=[OWN])
    one, _, said = opened("FMU3Slave", path)
    one.enterInitializationMode(tolerance=1e-6, startTime=0.0)
    one.exitInitializationMode()
    with pytest.raises(Exception, match="fmi3DoStep failed"):
        one.doStep(0.0, 4.0)
    assert b"chatter" in said[-1]
    one.freeInstance()


@needs_fmpy
def test_an_input_that_breaks_a_stick_after_a_slip_does_so_at_its_instant(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The load of a sticking element has a rate of rounding there, which said where the root is, and if it is one."""
    from fmpy.sundials import CVodeSolver

    rates = CVodeSolver.f

    def with_inputs(self: Any, t: float, *rest: Any) -> Any:
        """Rates with the inputs at t, where FMPy has those of another time."""
        self.input.apply(t, discrete=False)
        return rates(self, t, *rest)

    monkeypatch.setattr(CVodeSolver, "f", with_inputs)
    scene = jms.Scene(
        lambda t, q, qd, p: 0.5 * p["m"] * qd[0] ** 2 - 0.5 * p["k"] * q[0] ** 2,
        {"m": 1.3, "k": 4.0, "pull": 0.0},
        (jms.AppliedForce(lambda t, q, qd, p: p["pull"][None]), jms.Friction(jms.Stribeck(1.0, 1.5, 0.2, 0.1))),
    )
    path = jms.export.fmu(scene, [0.0], [0.0], tmp_path / "ramp.fmu", inputs=["pull"], platforms=[OWN])
    ramp = np.array([(0.0, 2.5), (4.0, 0.3)], dtype=[("time", "f8"), ("pull", "f8")])
    rows = fmpy.simulate_fmu(
        str(path), fmi_type="ModelExchange", stop_time=4.0, output_interval=0.1, input=ramp, relative_tolerance=1e-6
    )
    # By SciPy with events: it stops at 0.48238 m, and breaks away at 3.764 s.
    np.testing.assert_allclose(rows["q[0]"][-1], 0.481473070, atol=1e-5)
