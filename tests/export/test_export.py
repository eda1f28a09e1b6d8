"""Laws in other programs: MuJoCo's own runs against `simulate`, and Modelica's table against the law."""

import math
import re
import xml.etree.ElementTree as ET
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxmodsim as jms
from jaxmodsim import asymmetric, scaled_by, to_modelica, to_mujoco

MASS = 2.0
BOX = {"sigma0": 750.0, "sigma1": 12.0, "sigma2": 0.1, "Fc": 1.5, "Fs": 1.75, "vs": 0.2}
STRIBECK = jms.Stribeck(Fc=1.5, Fs=1.75, vs=0.2, Fv=0.1)
ELEMENTS: Any = jms.MaxwellSlip([10.0, 20.0], [1.0, 2.0])
VARYING: Any = scaled_by(jms.Viscous(1.0), lambda t, q, qd, p: 2.0)

MODEL = """
<mujoco>
  <option gravity="0 0 0"/>
  <worldbody><body><joint name="slide" type="slide" axis="1 0 0"/><geom size="0.1" mass="2"/></body></worldbody>
</mujoco>
"""


def mjcf(law: Any) -> str:
    """A mass on a slide, with the law put in as `to_mujoco` says: attributes on the joint, or an element beside."""
    model, element = ET.fromstring(MODEL), ET.fromstring(to_mujoco(law, "slide"))
    if element.tag == "actuator":
        model.append(element)
    else:
        joint = model.find("worldbody/body/joint")
        assert joint is not None
        joint.attrib.update(element.attrib)
    return ET.tostring(model, encoding="unicode")


def in_mujoco(law: Any, ramp: float, v0: float, step: float, t1: float = 3.0) -> tuple[float, float]:
    """Position and velocity at `t1` under a force that grows by `ramp` [N/s]."""
    mujoco = pytest.importorskip(
        "mujoco", minversion="4.0", reason="runs in MuJoCo 4.0, which has LuGre in a motor without current"
    )
    model = mujoco.MjModel.from_xml_string(mjcf(law))
    model.opt.timestep = step
    data = mujoco.MjData(model)
    data.qvel[0] = v0
    for i in range(round(t1 / step)):
        # Euler's method sees the force at the beginning of each step: half a step ahead it is of second order.
        data.qfrc_applied[0] = ramp * (i + 0.5) * step
        mujoco.mj_step(model, data)
    return float(data.qpos[0]), float(data.qvel[0])


def lagrangian(t: Any, q: Any, qd: Any, p: Any) -> Any:
    del t, q
    return 0.5 * p["m"] * qd[0] ** 2


def ramp_force(t: Any, q: Any, qd: Any, p: Any) -> Any:
    del q, qd
    return jnp.stack([p["ramp"] * t])


def in_ours(law: Any, ramp: float, t1: float = 3.0) -> tuple[float, float]:
    effects = (jms.AppliedForce(ramp_force), jms.Friction(law))
    scene = jms.Scene(lagrangian, params={"m": MASS, "ramp": ramp}, effects=effects)
    run = jms.simulate(scene, [0.0], [0.0], t1, rtol=1e-9, atol=1e-12)
    return float(run.q[-1, 0]), float(run.qd[-1, 0])


@pytest.mark.parametrize(
    "law",
    [jms.Viscous(0.4), jms.LuGre(**BOX), jms.LuGre(**{**BOX, "sigma1": 0.0}), jms.Dahl(750.0, 1.5)],
    ids=["viscous", "lugre", "lugre without damping", "dahl"],
)
def test_mujoco_goes_to_our_motion_as_its_step_falls(law: Any) -> None:
    """From rest over break-away at 1.5 or 1.75 s to fast slip; to the first order of MuJoCo's step."""
    ours = np.array(in_ours(law, 1.0))
    far, near = (np.abs(np.array(in_mujoco(law, 1.0, 0.0, step)) - ours) for step in (2e-3, 5e-4))
    assert (near < 1e-3 * ours).all(), (near, far, ours)
    np.testing.assert_allclose(far[0] / near[0], 4.0, rtol=0.1)


def test_mujoco_has_coulomb_friction_but_for_its_creep() -> None:
    law = jms.Coulomb(1.5)
    # Slides from 1.5 s on: v = (t - 1.5)^2/4.
    np.testing.assert_allclose(in_mujoco(law, 1.0, 0.0, 5e-4), (0.28125, 0.5625), rtol=1e-3)
    # Comes to rest after v^2 m/(2 Fc), and stays.
    np.testing.assert_allclose(in_mujoco(law, 0.0, 1.0, 5e-4), (1.0 / 1.5, 0.0), rtol=2e-3, atol=1e-9)
    # Creeps in stick, by less than a micrometre a second.
    moved, speed = in_mujoco(law, 0.4, 0.0, 1e-3)
    assert 0 < speed < 1e-6
    assert 0 < moved < 1e-6


def test_coulomb_and_viscous_together() -> None:
    """`m v' = -Fc - Fv v` from 2 m/s, still in slip after one second."""
    Fc, Fv, v0 = 1.0, 0.4, 2.0
    level, fall = Fc / Fv, math.exp(-Fv / MASS)
    exact = ((v0 + level) * MASS / Fv * (1.0 - fall) - level, (v0 + level) * fall - level)
    law = jms.Stribeck(Fc=Fc, Fs=Fc, vs=0.1, Fv=Fv)
    np.testing.assert_allclose(in_mujoco(law, 0.0, v0, 5e-4, t1=1.0), exact, rtol=1e-3)


@pytest.mark.quick
def test_mjcf_as_text() -> None:
    assert to_mujoco(jms.Viscous(0.4), "slide") == '<joint name="slide" damping="0.4"/>'
    assert 'frictionloss="1.5"' in to_mujoco(jms.Coulomb(1.5, 1.5))
    motor = ET.fromstring(to_mujoco(jms.LuGre(**BOX), 'a "strange" <name>'))[0]
    assert motor.attrib["joint"] == 'a "strange" <name>'
    assert [float(x) for x in motor.attrib["lugre"].split()] == [750.0, 12.0, 1.5, 1.75, 0.2]
    assert motor.attrib["damping"] == "0.1"


def table(text: str) -> tuple[np.ndarray, float]:
    """Rows and `peak` of a declaration."""
    found = re.search(r"_pos=\[(.*)\], peak=(.*)\);", text)
    assert found
    return np.array([[float(x) for x in row.split(",")] for row in found[1].split(";")]), float(found[2])


SET_VALUED: dict[str, Any] = {
    "viscous": jms.Viscous(0.4),
    "coulomb": jms.Coulomb(1.5),
    "coulomb with stiction": jms.Coulomb(1.5, 2.0),
    "stribeck": STRIBECK,
    "narrow stribeck": jms.Stribeck(1.0, 1.5, 1e-4, 0.4),
    "stribeck, exponent 1/2": jms.Stribeck(1.5, 1.75, 0.2, 0.1, exponent=0.5),
    "lorentzian": jms.Stribeck(1.5, 3.0, 0.05, 0.1, fall=jms.friction.lorentzian),
}


@pytest.mark.parametrize("name", SET_VALUED)
@pytest.mark.parametrize("rtol", [1e-2, 1e-4])
def test_modelica_tables_follow_the_law(name: str, rtol: float) -> None:
    law, v_max = SET_VALUED[name], 3.0
    rows, peak = table(to_modelica(law, v_max, rtol=rtol))
    assert (np.diff(rows[:, 0]) > 0).all()
    assert rows[0, 0] == 0
    assert rows[-1, 0] == v_max
    v = np.unique(np.concatenate([np.geomspace(1e-13, v_max, 30_011), np.linspace(0.0, v_max, 30_011)]))
    if isinstance(law, jms.Viscous):
        force = np.asarray(jax.vmap(law.force)(jnp.asarray(v)))
    else:
        force = np.asarray(jax.vmap(lambda v: law.sliding_force(v) + law.viscous_force(v))(jnp.asarray(v)))
        # The limit of stick.
        np.testing.assert_allclose(peak * rows[0, 1], law.static_limit(jnp.ones(())), rtol=1e-9)
    assert (np.abs(np.interp(v, *rows.T) - force) <= rtol * force + 1e-300).all()
    # No more rows than it needs: straight laws have two, others some hundreds at most.
    assert len(rows) == 2 if name in ("viscous", "coulomb", "coulomb with stiction") else 2 < len(rows) < 300


def test_modelica_declarations() -> None:
    assert to_modelica(jms.Coulomb(1.5, 2.25), 1.0) == (
        "Modelica.Mechanics.Translational.Components.SupportFriction friction(f_pos=[0, 1.5; 1, 1.5], peak=1.5);"
    )
    rounded = jms.Stribeck(Fc=6.105694180095081, Fs=15.013859993693833, vs=0.1)  # Fc + (Fs - Fc) > Fs
    assert to_modelica(rounded, 1.0, rtol=0.05).endswith("peak=1);")
    rotary = to_modelica(STRIBECK, 1.0, name="bearing", rotary=True)
    assert rotary.startswith("Modelica.Mechanics.Rotational.Components.BearingFriction bearing(tau_pos=[0, 1.75; ")


@pytest.mark.parametrize(
    ("law", "mujoco", "modelica"),
    [
        (jms.Coulomb(1.5, 2.0), "one force, in stick and in slip", None),
        (STRIBECK, "one force, in stick and in slip", None),
        (jms.LuGre(**BOX, vd=0.1), r"sigma1 fades \(vd\)", "state of their own, which LuGre has"),
        (jms.LuGre(**BOX), None, "state of their own, which LuGre has"),
        (jms.Dahl(1.0, 1.0), None, "state of their own, which Dahl has"),
        (jms.ElastoPlastic(**BOX, Fba=1.0), "no break-away force", "which ElastoPlastic has"),
        (ELEMENTS, "not at a limit", "which MaxwellSlip has"),
        (jms.Armstrong(1e4, 1.0, 1.5, 0.01, 0.2, 0.1, 1.0), "has no memory", "which Armstrong has"),
        (jms.Regularized(STRIBECK, 0.1), "Export the wrapped law", "Export that"),
        (jms.DeadZone(STRIBECK, 0.1), "Export the wrapped law", "Export that"),
        (jms.Sign(STRIBECK), "Export the wrapped law", "Export that"),
        (jms.Curve(jnp.tanh), "has no Curve", "no Curve"),
        (asymmetric(jms.Coulomb(1.0), Fc=2.0), "depends on the direction", "depends on the direction"),
        (asymmetric(jms.Viscous(1.0), Fv=2.0), "depends on the direction", "depends on the direction"),
        (asymmetric(jms.LuGre(**BOX), Fs=2.0), "depends on the direction", "depends on the direction"),
        (VARYING, r"Pass the law at a state, law.bind_state\(t", r"Pass the law at a state, law.bind_state\(t"),
        (jms.Coulomb(0.0, 1.0), "one force", "must be > 0 if the limit"),
    ],
)
def test_laws_that_the_target_has_not_are_refused(law: Any, mujoco: str | None, modelica: str | None) -> None:
    for export, text in ((to_mujoco, mujoco), (lambda law: to_modelica(law, 1.0), modelica)):
        if text is not None:
            with pytest.raises(ValueError, match=text):
                export(law)


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        ({"v_max": 0.0}, "v_max > 0"),
        ({"v_max": math.inf}, "v_max > 0"),
        ({"v_max": 1.0, "rtol": 0.0}, "0 < rtol < 1"),
        ({"v_max": 1.0, "name": "a b"}, "must be an identifier"),
    ],
)
def test_wrong_arguments_are_refused(arguments: dict[str, Any], text: str) -> None:
    with pytest.raises(ValueError, match=text):
        to_modelica(STRIBECK, **arguments)
