"""A model of an axis as equations in plain text."""

from typing import Any

from .._core.parameters import ranges_of
from ..friction import AbstractAsymmetric, Coulomb, Dahl, LuGre, Regularized, Stribeck, Viscous
from ..scene import Friction, Scene

_LEVEL = "g(v) = Fc + (Fs - Fc) exp(-(v/vs)^2)"
_FORMULAS: dict[type, tuple[str, ...]] = {
    Coulomb: ("Fc sign(v)",),
    Viscous: ("Fv v",),
    Stribeck: ("g(v) sign(v) + Fv v", _LEVEL),
    Dahl: ("sigma0 z", "z' = v - sigma0 |v| z/Fc"),
    LuGre: ("sigma0 z + sigma1 z' + sigma2 v", "z' = v - sigma0 |v| z/g(v)", _LEVEL),
}


def equations(scene: Scene) -> tuple[str, ...]:
    """The equation of motion of an axis, then the force of each friction element.

    **Arguments:**

    - `scene`: from `jaxmodsim.identify.axis_scene`.
    """
    elements = [effect for effect in scene.effects if isinstance(effect, Friction)]
    params = scene.params
    assert isinstance(params, dict)
    terms = ["offset"] if float(params["offset"]) != 0 else []
    lines = [" - ".join(["m q'' = u", *terms, *(f"F_{effect.name}" for effect in elements)]) + ",   v = q'"]
    for effect in elements:
        first, *rest = _force(effect.law)
        lines += [f"F_{effect.name} = {first}", *(f"    {line}" for line in rest)]
    return tuple(lines)


def _force(law: Any) -> tuple[str, ...]:
    if isinstance(law, Regularized):
        first, *rest = _force(law.law)
        return first.replace("sign(v)", "tanh(v/width)"), *rest, f"width = {float(law.width):.4g} m/s"
    if isinstance(law, AbstractAsymmetric):
        names = ", ".join(law.backward)
        return *_force(law.forward), f"{names}: forward for v > 0, backward for v < 0"
    return _FORMULAS.get(type(law), (f"{type(law).__name__}({', '.join(ranges_of(law))})",))
