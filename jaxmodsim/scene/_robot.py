"""Scenes of robots from URDF and MJCF files."""

from collections.abc import Sequence
from os import PathLike
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._core.arrays import PerDof, Scalar
from .._core.system import extra
from ._scene import Scene
from .forces._effect import AbstractEffect

if TYPE_CHECKING:
    from mujoco._structs import MjModel

# Three numbers, or three rows of three, as static parts of a Lagrangian are hashed.
_Vector: TypeAlias = tuple[float, float, float]
_Matrix: TypeAlias = tuple[_Vector, _Vector, _Vector]
_OWN = ("gravity", "armature")
_FIXED: _Matrix = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


class _Joint(NamedTuple):
    """A joint in the frame of its body; its coordinate of this number is `reference` in the pose of the file."""

    name: str
    slides: bool
    axis: _Vector
    anchor: _Vector
    coordinate: int
    reference: float


class _Link(NamedTuple):
    """A body in the frame of its parent; the number of the ground is -1."""

    name: str
    parent: int
    offset: _Vector
    turn: _Matrix
    joints: tuple[_Joint, ...]


class _Frame(NamedTuple):
    """A frame: rotation matrix and origin in space; angular velocity and velocity of the origin in its axes."""

    turn: Float[Array, "3 3"]
    origin: Float[Array, "3"]
    w: Float[Array, "3"]
    v: Float[Array, "3"]

    def moved(self, by: Array) -> "_Frame":
        """Another origin of the same body."""
        return self._replace(origin=self.origin + _rotated(self.turn, by), v=self.v + _cross(self.w, by))

    def turned(self, turn: Array) -> "_Frame":
        """Other axes of the same body."""
        return _Frame(_product(self.turn, turn), self.origin, _rotated(turn.T, self.w), _rotated(turn.T, self.v))


class RobotLagrangian(eqx.Module):
    """Lagrangian of rigid links that joints connect to a tree."""

    links: tuple[_Link, ...] = eqx.field(static=True)

    def __call__(self, t: Scalar, q: PerDof, qd: PerDof, params: dict[str, Array | dict[str, Array]]) -> Scalar:
        """Kinetic energy of links and rotors less potential energy [J]."""
        gravity, armature = (jnp.asarray(params[name]) for name in _OWN)
        zero, total = jnp.zeros(3, q.dtype), 0.5 * jnp.sum(armature * qd**2)
        frames: list[_Frame] = []
        for link in self.links:
            frame = frames[link.parent] if link.parent >= 0 else _Frame(jnp.eye(3, dtype=q.dtype), zero, zero, zero)
            frame = frame.moved(jnp.asarray(link.offset, q.dtype))
            if link.turn != _FIXED:
                frame = frame.turned(jnp.asarray(link.turn, q.dtype))
            for joint in link.joints:
                frame = _through(frame, joint, q[joint.coordinate] - joint.reference, qd[joint.coordinate])
            frames.append(frame)
            own = params.get(link.name)
            if isinstance(own, dict):
                centre = frame.moved(own["center"])
                spin = jnp.sum(frame.w * _rotated(_symmetric(own["inertia"]), frame.w))
                mass = own["mass"]
                total = total + 0.5 * mass * jnp.sum(centre.v**2) + 0.5 * spin + mass * jnp.sum(gravity * centre.origin)
        return total


def read_robot(source: str | PathLike[str], effects: Sequence[AbstractEffect] = ()) -> Scene:
    """The scene of a robot from a URDF or MJCF file: links, revolute and prismatic joints, gravity.

    The joints are the coordinates, in the order of the file. Numbers of the links are entries of `params`, known or
    free in a fit: `params["link"]` has `mass` [kg], `center` (of mass, [m], shape `[3]`) and `inertia` (about it,
    xx, yy, zz, xy, xz, yz [kg m^2], shape `[6]`) in the axes of the link's frame. `params["armature"]` has the inertias
    of rotors, referred to the joints [kg m^2 or kg], shape `[dof]`, and `params["gravity"]` is in m/s^2, shape `[3]`.
    Branches, fixed joints and several joints of one link are supported. Friction, damping, actuators, limits and
    contacts in the file are ignored; add friction as `Friction(law, along=lambda q: q[i], name="joint")` in `effects`.

    **Arguments:**

    - `source`: path of the file, or its text, which begins with `<`.
    - `effects`: effects of the scene, such as friction of joints and drives. A drive with numbers of its own reads
      them from `params`: `Scene(robot.lagrangian, {**robot.params, "u": 0.0}, effects)`.

    **Returns:**

    A `Scene`; the names of the joints are those of its coordinates.

    **Raises:**

    - `ImportError` without mujoco, which reads the file; the extra `robots` installs it.
    - `ValueError` for a file that MuJoCo cannot read, and for free and ball joints, springs, tendons, closed loops and
      coupled joints (`equality`, `mimic`), which it names.
    """
    kind: type[MjModel] = extra("mujoco", "read_robot", "robots").MjModel
    text = str(source)
    is_text = text.lstrip().startswith("<")
    try:
        model = kind.from_xml_string(text) if is_text else kind.from_xml_path(text)
    except ValueError as error:
        raise ValueError(f"{'The text' if is_text else text} is no URDF or MJCF that MuJoCo reads: {error}") from error
    _check(model)
    links = tuple(_link(model, i) for i in range(1, model.nbody))
    params: dict[str, object] = {"gravity": model.opt.gravity.copy(), "armature": model.dof_armature.copy()}
    for i, link in enumerate(links, start=1):
        if link.name in _OWN:
            raise ValueError(f"A link must not have the name {link.name!r}, which params needs: call it otherwise.")
        if _moves(links, i - 1):
            turn, principal = _matrix(model.body_iquat[i]), model.body_inertia[i]
            tensor = turn @ np.diag(principal) @ turn.T
            params[link.name] = {
                "mass": float(model.body_mass[i]),
                "center": model.body_ipos[i].copy(),
                "inertia": tensor[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]],
            }
    joints = sorted((joint for link in links for joint in link.joints), key=lambda joint: joint.coordinate)
    names = tuple(f"{joint.name} [{'m' if joint.slides else 'rad'}]" for joint in joints)
    return Scene(RobotLagrangian(links), params, tuple(effects), coordinates=names)


def _check(model: "MjModel") -> None:
    """Refuse parts that the Lagrangian cannot represent."""
    kinds = {0: "free", 1: "ball"}
    for i, kind in enumerate(model.jnt_type.tolist()):
        name = model.joint(i).name or f"joint{i + 1}"
        if kind in kinds:
            raise ValueError(
                f"The joint {name!r} is {kinds[kind]}, but only revolute (hinge) and prismatic (slide) joints have one"
                " coordinate each: fix the base, or take three hinges."
            )
        if np.any(model.jnt_stiffness[i]):
            raise ValueError(f"The joint {name!r} has a spring: take it out, and add its energy to the Lagrangian.")
    if model.njnt == 0:
        raise ValueError("The robot has no joint that moves.")
    for count, what, mend in (
        (model.neq, "closed loops or coupled joints (equality, mimic)", "take them out, and add a Constraint"),
        (model.ntendon, "tendons", "take them out"),
    ):
        if count:
            raise ValueError(f"The robot has {what}, which are not supported: {mend}.")


def _link(model: "MjModel", i: int) -> _Link:
    first, count = int(model.body_jntadr[i]), int(model.body_jntnum[i])
    joints = tuple(
        _Joint(
            model.joint(j).name or f"joint{j + 1}",
            int(model.jnt_type[j]) == 2,
            _vector(model.jnt_axis[j]),
            _vector(model.jnt_pos[j]),
            int(model.jnt_dofadr[j]),
            float(model.qpos0[model.jnt_qposadr[j]]),
        )
        for j in range(first, first + count)
    )
    name, turn = model.body(i).name or f"link{i}", _matrix(model.body_quat[i])
    rows = _FIXED if np.array_equal(turn, np.eye(3)) else (_vector(turn[0]), _vector(turn[1]), _vector(turn[2]))
    return _Link(name, int(model.body_parentid[i]) - 1, _vector(model.body_pos[i]), rows, joints)


def _moves(links: tuple[_Link, ...], i: int) -> bool:
    return bool(links[i].joints) or (links[i].parent >= 0 and _moves(links, links[i].parent))


def _vector(x: np.ndarray) -> _Vector:
    return float(x[0]), float(x[1]), float(x[2])


def _matrix(quaternion: np.ndarray) -> np.ndarray:
    """Rotation matrix of a unit quaternion w, x, y, z."""
    w, x, y, z = quaternion
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def _through(frame: _Frame, joint: _Joint, q: Array, qd: Array) -> _Frame:
    """The frame beyond a joint."""
    axis = jnp.asarray(joint.axis, q.dtype)
    if joint.slides:
        frame = frame.moved(axis * q)
        return frame._replace(v=frame.v + axis * qd)
    anchor = jnp.asarray(joint.anchor, q.dtype)
    frame = frame.moved(anchor).turned(_rotation(joint.axis, q))
    return frame._replace(w=frame.w + axis * qd).moved(-anchor)


def _rotation(axis: _Vector, angle: Array) -> Float[Array, "3 3"]:
    """Rotation about a unit axis (Rodrigues)."""
    x, y, z = axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    outer = jnp.asarray(np.outer(axis, axis))
    return outer + jnp.cos(angle) * (jnp.eye(3, dtype=outer.dtype) - outer) + jnp.sin(angle) * cross


def _symmetric(x: Float[Array, "6"]) -> Float[Array, "3 3"]:
    return jnp.stack([jnp.stack([x[0], x[3], x[4]]), jnp.stack([x[3], x[1], x[5]]), jnp.stack([x[4], x[5], x[2]])])


# Sums of products, which `in_scalars` takes apart in the equations of motion.
def _rotated(turn: Array, x: Array) -> Array:
    return jnp.sum(turn * x[None, :], axis=1)


def _product(a: Array, b: Array) -> Array:
    return jnp.sum(a[:, :, None] * b[None, :, :], axis=1)


def _cross(a: Array, b: Array) -> Array:
    return jnp.stack([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])
