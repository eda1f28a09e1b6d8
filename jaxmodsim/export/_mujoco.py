"""Laws as MuJoCo has them."""

from typing import Any
from xml.sax.saxutils import quoteattr

from ..friction import (
    AbstractAsymmetric,
    AbstractLaw,
    Armstrong,
    Coulomb,
    Dahl,
    DeadZone,
    ElastoPlastic,
    LuGre,
    MaxwellSlip,
    Regularized,
    Sign,
    Stribeck,
    Viscous,
)
from ._numbers import need_numbers

# As hard as MuJoCo's dry friction gets: with its default the joint creeps a thousand times faster.
_HARD = "0.9999 0.9999 0.001"

# What MuJoCo lacks of the laws that it has not, and what to do.
_INSTEAD: tuple[tuple[Any, str], ...] = (
    (
        ElastoPlastic,
        "its bristle has no break-away force: LuGre with the same sigma0, sigma1, sigma2, Fc, Fs and vs is the nearest,"
        " and creeps under a vibrating load",
    ),
    (MaxwellSlip, "its bristle yields all the way, and not at a limit: fit a Dahl or LuGre and export that"),
    (Armstrong, "the stiction of its bristle neither rises with time nor has a memory: fit a LuGre and export that"),
    (
        (Regularized, DeadZone, Sign),
        "it runs dry friction in its own way, by a constraint: export the law inside",
    ),
)


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
    need_numbers(law, "to_mujoco")
    if isinstance(law, Viscous):
        return _joint(joint, damping=law.Fv)
    if isinstance(law, Coulomb) and (law.Fs is None or float(law.Fs) == float(law.Fc)):
        return _joint(joint, frictionloss=law.Fc)
    if isinstance(law, Stribeck) and float(law.Fs) == float(law.Fc):
        return _joint(joint, frictionloss=law.Fc, damping=law.Fv)
    if isinstance(law, Dahl):  # LuGre without damping and Stribeck effect, at any Stribeck velocity
        return _bristle(joint, law.sigma0, 0.0, law.Fc, law.Fc, 1.0, 0.0)
    if isinstance(law, LuGre) and law.vd is None:
        return _bristle(joint, law.sigma0, law.sigma1, law.Fc, law.Fs, law.vs, law.sigma2)
    raise ValueError(f"to_mujoco: MuJoCo has no {_lacks(law)}.")


def _joint(name: str, **numbers: Any) -> str:
    values = {key: float(value) for key, value in numbers.items()}
    attributes = [f'{key}="{value!r}"' for key, value in values.items()]
    if values.get("frictionloss"):
        attributes.append(f'solimpfriction="{_HARD}"')
    return f"<joint name={quoteattr(name)} {' '.join(attributes)}/>"


def _bristle(joint: str, sigma0: Any, sigma1: Any, Fc: Any, Fs: Any, vs: Any, sigma2: Any) -> str:
    lugre = " ".join(repr(float(x)) for x in (sigma0, sigma1, Fc, Fs, vs))
    return (
        "<actuator>\n"
        f'  <dcmotor name={quoteattr(joint + "_friction")} joint={quoteattr(joint)} input="none"'
        f' resistance="1" motorconst="0"\n'
        f'           damping="{float(sigma2)!r}" lugre="{lugre}"/>\n'
        "</actuator>"
    )


def _lacks(law: AbstractLaw) -> str:
    """What MuJoCo lacks to express the law, and what to do."""
    name = type(law).__name__
    if isinstance(law, AbstractAsymmetric):
        return "friction that depends on the direction: export the law of one direction, or the mean of both"
    if isinstance(law, LuGre):
        return "LuGre whose sigma1 fades (vd): leave vd out, and see check_passivity(law) for what that means"
    if isinstance(law, Coulomb | Stribeck):
        return (
            f"{name} with Fs > Fc: its dry friction is one force, in stick and in slip. Export a LuGre with the same Fc"
            " and Fs, and sigma0 as stiff as the step allows, or leave the stiction out"
        )
    for kind, words in _INSTEAD:
        if isinstance(law, kind):
            return f"{name}, for {words}"
    return (
        f"{name}: its joints have friction that is constant, viscous, or LuGre. Fit one of these, with fit_law, and"
        " export that"
    )
