"""Equations of a scene's run, gradient, Jacobian or batch, by the functions of the package that they come from.

python -m bench.census [NAME ...] [--of run|gradient|jacobian|batch] [--record]

Traced, not compiled: the counts are the same on every machine. An equation counts as often as XLA receives it: once in
the body of a loop or in a branch, and once for all calls of a function of `jax.jit` with the same shapes. Primitives
that `StoredSteps` makes of whole runs, which JAX traces as it lowers them, count with the equations that they become.
"""

import json
import logging
from collections import Counter
from collections.abc import Iterator
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any, Literal, TypeAlias

import jax
import jax.numpy as jnp
import typer

import jaxmodsim
from bench.scenes import SCENES

PACKAGE = f"{Path(jaxmodsim.__file__).parent}/"
RECORD = Path(__file__).parents[1] / "tests" / "equations.json"
LINES = 40
# "vprim" is one of the others in a batch.
_TRACED_LATER = ("run", "change_of_run", "vprim")
Chain: TypeAlias = tuple[Any, ...]
Way: TypeAlias = Literal["run", "gradient", "jacobian", "batch"]


def equations(jaxpr: Any, within: Chain = (), called: set[Any] | None = None) -> Iterator[Chain]:
    """All equations of a traced function, as often as XLA receives them, each with the equations that it is `within`.

    `called`: functions of `jax.jit` that have been counted.
    """
    called = set() if called is None else called
    for eqn in jaxpr.eqns:
        yield eqn, *within
        for inner in _inner(eqn):
            if eqn.primitive.name != "jit" or inner not in called:
                called.add(inner)
                yield from equations(inner, (eqn, *within), called)


def _inner(eqn: Any) -> list[Any]:
    if eqn.primitive.name in _TRACED_LATER:
        return [jax.make_jaxpr(partial(eqn.primitive.impl, **eqn.params))(*(x.aval for x in eqn.invars)).jaxpr]
    values = [x for value in eqn.params.values() for x in (value if isinstance(value, tuple | list) else (value,))]
    return [getattr(x, "jaxpr", x) for x in values if hasattr(getattr(x, "jaxpr", x), "eqns")]


def traced(name: str, way: Way) -> list[Chain]:
    """All equations of a scene."""
    task = SCENES[name]()
    return list(equations(jax.jit(task.ways()[way]).trace(jax.tree.map(jnp.asarray, task.numbers)).jaxpr.jaxpr))


def functions(chain: Chain) -> list[str]:
    """Functions of the package that emit an equation, innermost first."""
    tracebacks = [eqn.source_info.traceback for eqn in chain]  # each ends at the function of the next
    frames = (frame for each in tracebacks if each for frame in each.frames if frame.file_name.startswith(PACKAGE))
    return list(dict.fromkeys(f"{x.file_name.removeprefix(PACKAGE)}:{x.function_name}" for x in frames)) or ["(none)"]


def recorded() -> dict[str, dict[Way, int]]:
    """The recorded counts of the tests, by scene."""
    return json.loads(RECORD.read_text())["scenes"]


def main(
    names: Annotated[
        list[str] | None, typer.Argument(help="Scenes of bench/scenes.py; by default the recorded ones.")
    ] = None,
    of: Annotated[Way, typer.Option(help="Function to trace.")] = "run",
    record: Annotated[bool, typer.Option("--record", help="Record the counts for the tests.")] = False,
) -> None:
    """List the equations of scenes by the functions of the package that emit them.

    "own" are those of the function itself, "with inner" also those of functions that it calls.
    """
    for name in names or recorded():
        if name not in SCENES:
            raise typer.BadParameter(f"no scene is called {name!r}; there are: {', '.join(SCENES)}")
        if record:
            _record(name)
            continue
        found = [functions(chain) for chain in traced(name, of)]
        own = Counter(each[0] for each in found)
        print(f"{name}, {of}: {len(found)} equations\n{'with inner':>10} {'own':>8}")
        for function, count in Counter(each for names in found for each in names).most_common(LINES):
            print(f"{count:>10} {own[function]:>8}  {function}")


def _record(name: str) -> None:
    scenes = recorded()
    scenes[name] = {way: len(traced(name, way)) for way in scenes.get(name, ("run", "gradient", "batch"))}
    versions = {package: version(package) for package in ("jax", "diffrax", "equinox")}
    lines = ",\n".join(f"  {json.dumps(each)}: {json.dumps(ways)}" for each, ways in scenes.items())
    RECORD.write_text(f'{{\n "versions": {json.dumps(versions)},\n "scenes": {{\n{lines}\n }}\n}}\n')
    print(f"{name}: {scenes[name]}")


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    logging.getLogger("jaxmodsim").setLevel(logging.ERROR)  # no hints on speed, because nothing is run
    typer.run(main)
