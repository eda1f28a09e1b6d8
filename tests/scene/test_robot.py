"""Robots read from files: mass matrix and forces against those of MuJoCo."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmodsim.mechanics import inverse_dynamics
from jaxmodsim.scene import Scene, read_robot, scene_numbers

mujoco = pytest.importorskip("mujoco")


def _nested(bodies: list[str]) -> str:
    return "".join(bodies) + "</body>" * len(bodies)


# Seven hinges, their axes, anchors, centres of mass and principal axes all askew.
ARM = (
    "<mujoco><option gravity='0.3 0 -9.7'/><compiler angle='radian'/><worldbody>"
    + _nested(
        [
            f"<body name='link{i}' pos='{0.02 * i} {0.01 * (-1) ** i} {0.3 - 0.02 * i}'"
            f" euler='{0.3 * i} {0.1 * i} 0.2'>"
            f"<joint name='joint{i}' axis='{i % 2} {(i + 1) % 2} {0.2 * (i % 3)}' pos='0.01 0 {0.01 * i}'"
            f" armature='{0.02 / i}' ref='{0.1 * (i == 3)}'/>"
            f"<inertial mass='{4.0 - 0.5 * i}' pos='0.01 -0.02 {0.1 - 0.01 * i}' quat='1 {0.1 * i} 0.2 0'"
            f" diaginertia='{0.05 / i} {0.04 / i} {0.02 / i}'/>"
            for i in range(1, 8)
        ]
    )
    + "</worldbody></mujoco>"
)
# Branches, a link welded to another, a prismatic joint, two joints of one link.
TREE = """<mujoco><worldbody><body name="base"><inertial mass="9" pos="0 0 0" diaginertia="1 1 1"/>
<body name="cart" pos="0 0 1"><joint name="rail" type="slide" axis="1 0.2 0"/>
<inertial mass="2" pos="0.1 0 0" diaginertia="0.1 0.2 0.15"/>
<body name="left" pos="0 0.3 0"><joint axis="0 1 0"/><joint name="wrist" axis="1 0 0" pos="0 0 -0.2"/>
<inertial mass="1" pos="0 0 -0.4" diaginertia="0.02 0.03 0.01"/>
<body name="tool" pos="0 0 -0.6" euler="10 20 30"><inertial mass="0.3" pos="0.02 0 0" diaginertia="1e-3 2e-3 2.5e-3"/>
</body></body>
<body name="right" pos="0 -0.3 0"><joint name="elbow" axis="0 1 1"/>
<inertial mass="1.5" pos="0 0 -0.3" diaginertia="0.05 0.05 0.01"/></body></body></body></worldbody></mujoco>"""
URDF = """<robot name="arm"><link name="ground"/>
<joint name="shoulder" type="revolute"><parent link="ground"/><child link="upper"/>
<origin xyz="0 0 0.5" rpy="0.1 0.2 0.3"/><axis xyz="0 1 0"/>
<limit lower="-3" upper="3" effort="9" velocity="9"/></joint>
<link name="upper"><inertial><origin xyz="0 0 0.2"/><mass value="2"/>
<inertia ixx="0.03" iyy="0.04" izz="0.02" ixy="0.001" ixz="0.002" iyz="0.003"/></inertial></link>
<joint name="slide" type="prismatic"><parent link="upper"/><child link="rod"/>
<origin xyz="0 0 0.4"/><axis xyz="0 0 1"/><limit lower="-3" upper="3" effort="9" velocity="9"/></joint>
<link name="rod"><inertial><origin xyz="0 0.1 0.2"/><mass value="0.5"/>
<inertia ixx="0.01" iyy="0.01" izz="0.005" ixy="0" ixz="0" iyz="0"/></inertial></link></robot>"""


@pytest.mark.parametrize("text", [ARM, TREE, URDF], ids=["seven joints", "tree", "urdf"])
def test_mass_matrix_and_forces_are_those_of_mujoco(text: str) -> None:
    scene, model = read_robot(text), mujoco.MjModel.from_xml_string(text)
    data, rng = mujoco.MjData(model), np.random.default_rng(0)
    force = jax.jit(lambda q, qd, qdd: inverse_dynamics(scene.lagrangian, jnp.zeros(()), q, qd, qdd, scene.params))
    for _ in range(3):
        data.qpos[:], data.qvel[:], data.qacc[:] = rng.standard_normal((3, model.nv))
        still = np.zeros(model.nv)
        weight = force(data.qpos, still, still)
        mass = np.stack([force(data.qpos, still, unit) - weight for unit in np.eye(model.nv)], axis=1)
        mujoco.mj_forward(model, data)
        expected = np.zeros((model.nv, model.nv))
        for i, unit in enumerate(np.eye(model.nv)):
            column = np.zeros(model.nv)
            mujoco.mj_mulM(model, data, column, unit)
            expected[:, i] = column
        np.testing.assert_allclose(mass, expected, rtol=0, atol=1e-10)
        data.qacc[:] = rng.standard_normal(model.nv)
        torque = np.zeros(model.nv)
        mujoco.mj_rne(model, data, 1, torque)
        rotors = np.asarray(scene.params["armature"]) * data.qacc
        np.testing.assert_allclose(force(data.qpos, data.qvel, data.qacc), torque + rotors, rtol=0, atol=1e-9)


def test_inertial_numbers_have_names_and_derivatives() -> None:
    scene = read_robot(URDF)
    assert scene.coordinates == ("shoulder [rad]", "slide [m]")
    assert {"upper.mass", "upper.center", "upper.inertia", "rod.mass", "gravity", "armature"} <= set(
        scene_numbers(scene)
    )

    def force(scene: Scene) -> jax.Array:
        q = jnp.asarray([0.3, 0.1])
        return inverse_dynamics(scene.lagrangian, jnp.zeros(()), q, 0 * q, 0 * q, scene.params)[1]

    # At rest the second joint bears the weight of the rod along its axis, so the derivative is that over the mass.
    slope = eqx.filter_grad(force)(scene).params["rod"]["mass"]
    assert float(slope) == pytest.approx(float(force(scene)) / 0.5, rel=1e-12)


@pytest.mark.parametrize(
    ("inside", "message"),
    [
        ("<body><freejoint name='base'/><inertial mass='1' pos='0 0 0' diaginertia='1 1 1'/></body>", "'base' is free"),
        ("<body><joint type='ball'/><inertial mass='1' pos='0 0 0' diaginertia='1 1 1'/></body>", "'joint1' is ball"),
        (
            "<body><joint name='a' stiffness='2'/><inertial mass='1' pos='0 0 0' diaginertia='1 1 1'/></body>",
            "'a' has a spring",
        ),
        ("<body><inertial mass='1' pos='0 0 0' diaginertia='1 1 1'/></body>", "no joint that moves"),
        (
            "<body name='gravity'><joint/><inertial mass='1' pos='0 0 0' diaginertia='1 1 1'/></body>",
            "must not have the name 'gravity'",
        ),
        ("<nonsense/>", "no URDF or MJCF"),
    ],
)
def test_what_is_not_supported_is_refused_by_name(inside: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        read_robot(f"<mujoco><worldbody>{inside}</worldbody></mujoco>")


def test_closed_loops_are_refused() -> None:
    body = "<body name='{0}' pos='{1} 0 0'><joint/><inertial mass='1' pos='0 0 0' diaginertia='1 1 1'/></body>"
    text = (
        f"<mujoco><worldbody>{body.format('a', 0)}{body.format('b', 1)}</worldbody>"
        "<equality><connect body1='a' body2='b' anchor='0.5 0 0'/></equality></mujoco>"
    )
    with pytest.raises(ValueError, match="closed loops"):
        read_robot(text)


def test_a_file_that_is_not_there_is_named(tmp_path) -> None:
    with pytest.raises(ValueError, match=r"nowhere\.xml is no URDF or MJCF"):
        read_robot(tmp_path / "nowhere.xml")


def test_without_mujoco_the_error_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "mujoco", None)
    with pytest.raises(ImportError, match=r"jaxmodsim\[robots\]"):
        read_robot(URDF)
