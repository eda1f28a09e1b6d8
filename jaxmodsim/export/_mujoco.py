"""Laws as MuJoCo has them."""

from xml.sax.saxutils import quoteattr

from jaxtyping import Array

from .._core.functions import need_values
from ..friction import AbstractLaw

# As hard as MuJoCo's dry friction gets: with its default the joint creeps a thousand times faster.
_HARD = "0.9999 0.9999 0.001"


def to_mujoco(law: AbstractLaw, joint: str = "joint") -> str:
    """MJCF, the XML of MuJoCo, for a law on a hinge or slide joint.

    `Viscous`, `Coulomb` without stiction and `Stribeck` with Fs = Fc become an element `joint` whose attributes belong
    on the joint of that name. `LuGre` and `Dahl` become an element `actuator` that goes into the model as it is: a
    motor without input or current, whose LuGre friction is the one here (from MuJoCo 4.0 on). A mass on a ramp of force
    agrees with `simulate` to the first order of MuJoCo's step.

    MuJoCo's dry friction is a soft constraint: in stick the joint creeps in proportion to the load. The constraint is
    given here as hard as it gets in `solimpfriction`, which may be left out.

    **Arguments:**

    - `law`: the law.
    - `joint`: name of the joint in the model.

    **Returns:**

    One XML element.

    **Raises:**

    - `ValueError` if MuJoCo has not the law, saying what it lacks and what to do; for a law by `scaled_by`.
    """
    if not isinstance(law, AbstractLaw):
        raise ValueError(f"to_mujoco needs a law, but {law!r} was given.")
    need_values(law, "to_mujoco")
    numbers = law.mujoco()
    if isinstance(numbers, str):
        raise ValueError(f"to_mujoco: MuJoCo has no {numbers}.")
    return _motor(joint, **numbers) if "lugre" in numbers else _joint(joint, **numbers)


def _joint(name: str, **numbers: Array) -> str:
    values = {key: float(value) for key, value in numbers.items()}
    attributes = [f'{key}="{value!r}"' for key, value in values.items()]
    if values.get("frictionloss"):
        attributes.append(f'solimpfriction="{_HARD}"')
    return f"<joint name={quoteattr(name)} {' '.join(attributes)}/>"


def _motor(joint: str, damping: float | Array, lugre: tuple[float | Array, ...]) -> str:
    bristle = " ".join(repr(float(x)) for x in lugre)
    return (
        "<actuator>\n"
        f'  <dcmotor name={quoteattr(joint + "_friction")} joint={quoteattr(joint)} input="none"'
        f' resistance="1" motorconst="0"\n'
        f'           damping="{float(damping)!r}" lugre="{bristle}"/>\n'
        "</actuator>"
    )
