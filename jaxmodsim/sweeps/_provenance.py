"""Where numbers come from: what was asked, of what code, by which versions."""

import hashlib
from functools import cache

import jax
import jax.tree_util as jtu
import numpy as np

from .._core.system import versions
from ..scene import scene_numbers
from ..simulation import default_solver
from ._compute import Work, program
from ._request import Request

_PACKAGES = ("jaxmodsim", "jax", "jaxlib", "diffrax", "equinox", "numpy")
# Arrays of more numbers than these are told apart by a checksum.
_SHORT = 16


def provenance(request: Request, work: Work, extent: tuple[int, ...]) -> dict[str, object]:
    """All that the numbers of a sweep follow from, as values for JSON: where it is the same, so are they."""
    scene, arguments = request.fixed or (None, {})
    numbers = {} if scene is None else scene_numbers(scene)
    choices = dict(getattr(work.run, "choices", ()))
    swept = request.grid.values
    return {
        "over": {name: f"{x.shape} {x.dtype} {_digest(x)}" for name, x in swept.items()},
        "numbers": {name: _value(x) for name, x in numbers.items() if name not in swept},
        "arguments": {
            jtu.keystr(path, simple=True, separator="."): _value(x)
            for name, value in sorted(arguments.items())
            if name not in swept
            for path, x in jtu.tree_leaves_with_path({name: value})
        },
        "options": {name: repr(value) for name, value in sorted(choices.items())},
        "program": program(work.run, work.fixed, request.grid.first),
        "versions": package_versions(),
        "backend": jax.default_backend(),
        "chunks": list(extent),
        "runs in a group": work.group,
    }


@cache
def package_versions() -> dict[str, str]:
    """Versions of the packages that numbers depend on."""
    return versions(*_PACKAGES)


def describe(request: Request) -> str:
    """The system that is swept, in words."""
    if request.fixed:
        scene = request.fixed[0]
        return f"{_called(scene.lagrangian)}; " + ", ".join(
            f"{name}: {type(getattr(effect, 'law', effect)).__name__}"
            for name, effect in zip(scene.names, scene.effects, strict=True)
        )
    return _called(getattr(request.run, "function", None))


def solver_of(request: Request) -> str:
    """The solver that runs a scene, given or chosen for it; "" where a function chooses its own."""
    if not request.fixed:
        return ""
    scene, arguments = request.fixed
    chosen = dict(getattr(request.run, "choices", ())).get("solver")
    return repr(default_solver(scene, np.size(arguments["q0"]), "dt" in arguments) if chosen is None else chosen)


def differences(then: dict[str, object], now: dict[str, object]) -> list[str]:
    """What is not the same in two provenances, in words."""
    texts = []
    for part in [*then, *(name for name in now if name not in then)]:
        old, new = then.get(part), now.get(part)
        if isinstance(old, dict) and isinstance(new, dict):
            for name in [*old, *(name for name in new if name not in old)]:
                if old.get(name) != new.get(name):
                    texts.append(f"{part}: {name} was {old.get(name, 'not there')}, is {new.get(name, 'not there')}")
        elif old != new:
            what = "the code of the scene, the observables, or this library" if part == "program" else None
            texts.append(f"{what} has changed" if what else f"{part} was {old}, is {new}")
    return texts


def _called(function: object) -> str:
    function = getattr(function, "fn", function)  # a plain function in a scene is wrapped
    return str(getattr(function, "__qualname__", type(function).__name__))


def _digest(x: object) -> str:
    return hashlib.sha256(np.ascontiguousarray(x).tobytes()).hexdigest()[:16]


def _value(x: object) -> object:
    x = np.asarray(x)
    return x.tolist() if x.size <= _SHORT else f"{x.shape} {x.dtype} {_digest(x)}"
