"""A model of an axis as equations in plain text."""

from ..scene import Friction, Scene

# What the drive has beside its force, by the name of the param without which it is none.
_TERMS = {"offset": "offset", "drift": "drift exp(-(t - t0)/tau)"}


def equations(scene: Scene) -> tuple[str, ...]:
    """The equation of motion of an axis, then the force of each friction element.

    **Arguments:**

    - `scene`: from `jaxmodsim.identify.axis_scene`.
    """
    elements = [effect for effect in scene.effects if isinstance(effect, Friction)]
    params = scene.params
    assert isinstance(params, dict)
    terms = [term for name, term in _TERMS.items() if float(params[name]) != 0]
    lines = [" - ".join(["m q'' = u", *terms, *(f"F_{effect.name}" for effect in elements)]) + ",   v = q'"]
    for effect in elements:
        first, *rest = effect.law.formulas()
        lines += [f"F_{effect.name} = {first}", *(f"    {line}" for line in rest)]
    return tuple(lines)
