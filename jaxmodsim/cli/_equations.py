"""A model of an axis as equations in plain text."""

from ..scene import Friction, Scene


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
        first, *rest = effect.law.formulas()
        lines += [f"F_{effect.name} = {first}", *(f"    {line}" for line in rest)]
    return tuple(lines)
