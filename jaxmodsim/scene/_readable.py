"""Tables of scenes and laws, and of gradients with their structure."""

from textwrap import shorten

import equinox as eqx

from .._core.functions import Function
from .._core.readable import Table, short, table_of
from ..friction import AbstractAsymmetric, AbstractLaw
from ._coordinates import Quantity
from ._names import scene_numbers, scene_units
from ._scene import Scene
from .forces._friction import Friction

# A gradient has the structure of its scene: the unit belongs to the number, not to the value in the table.
_HEAD = "number [unit]", "value"


def _numbers(thing: eqx.Module) -> list[tuple[str, ...]]:
    """Each number by its name and unit."""
    units = scene_units(thing)
    return [(Quantity(name, units.get(name, "")).label, short(x)) for name, x in scene_numbers(thing).items()]


def _called(law: AbstractLaw) -> str:
    """The law's kind, with the law inside a wrapper or a law for both directions."""
    both = isinstance(law, AbstractAsymmetric)
    inside = getattr(law, "forward" if both else "law", None)
    kind = "asymmetric" if both else type(law).__name__
    return f"{kind}({_called(inside)})" if isinstance(inside, AbstractLaw) else kind


@table_of.register
def _(law: AbstractLaw) -> Table:
    return Table(f"{_called(law)}: {law.description}".rstrip(": "), _HEAD, _numbers(law))


@table_of.register
def _(scene: Scene) -> Table:
    lagrangian = scene.lagrangian.fn if isinstance(scene.lagrangian, Function) else type(scene.lagrangian)
    title = f"Scene of {getattr(lagrangian, '__name__', 'a Lagrangian')}"
    if scene.coordinates:
        title += f" in {', '.join(scene.coordinates)}"
    effects = {
        name: _called(effect.law) if isinstance(effect, Friction) else type(effect).__name__
        for name, effect in zip(scene.names, scene.effects, strict=True)
    }
    parts = {"effects": effects, "constraints": dict.fromkeys(scene.constraint_names)}
    notes = tuple(
        f"{kind}: " + ", ".join(f"{name} ({what})" if what else name for name, what in named.items())
        for kind, named in parts.items()
        if named
    )
    return Table(shorten(title, 110, placeholder=" ..."), _HEAD, _numbers(scene), notes)
