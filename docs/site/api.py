"""Pages of the API: every public name of every room, from its `__init__.py`."""

import ast
from pathlib import Path

PACKAGE = Path(__file__).resolve().parents[2] / "jaxmodsim"
# Rooms without an interface: the command line has a page of its own, what is in _core is private.
_NONE = ("_core", "cli")
# Names with which most users begin, then those that `jaxmodsim` itself exports, come first on a page.
_FIRST = (
    "simulate",
    "Trajectory",
    "Scene",
    "Friction",
    "AppliedForce",
    "fit",
    "Record",
    "FitResult",
    "sweep",
)
_ELSEWHERE = "*The names above are in `jaxmodsim` itself, those below in this module alone.*"


def rooms() -> list[str]:
    """Names of the rooms with public names."""
    return sorted(path.parent.name for path in PACKAGE.glob("*/__init__.py") if path.parent.name not in _NONE)


def public_names(room: str) -> list[str]:
    """Dotted names that a room makes public, in the order of its file; its public modules and folders last."""
    names, modules = _exports(f"jaxmodsim.{room}")
    folders = [f"jaxmodsim.{room}.{path.parent.name}" for path in sorted((PACKAGE / room).glob("*/__init__.py"))]
    of_folders = [name for folder in folders for name in _exports(folder)[0]]
    return [*names, *of_folders, *modules]


def page(room: str) -> str:
    """Markdown of a room: its docstring, then an entry for each name."""
    summary = ast.get_docstring(ast.parse((PACKAGE / room / "__init__.py").read_text()))
    lines = [f"# {room}", "", summary or "", ""]
    everyday = _everyday()
    names = sorted(public_names(room), key=lambda name: _rank(name, everyday))  # equal ranks stay in order
    for name, before in zip(names, [names[0], *names], strict=False):
        short = name.rpartition(".")[2]
        if before.rpartition(".")[2] in everyday and short not in everyday:
            lines += [_ELSEWHERE, ""]
        # Constants have no docstring, and some are names of an unpacked tuple, which mkdocstrings does not see.
        lines += [f"## `{short}` {{#{name}}}", "", _comment(name), ""] if short.isupper() else [f"::: {name}", ""]
    return "\n".join(lines)


def _everyday() -> set[str]:
    """Names that `jaxmodsim` itself exports."""
    nodes = ast.walk(ast.parse((PACKAGE / "__init__.py").read_text()))
    return {alias.name for node in nodes if isinstance(node, ast.ImportFrom) and node.level for alias in node.names}


def _rank(name: str, everyday: set[str]) -> int:
    short = name.rpartition(".")[2]
    if short in _FIRST:
        return _FIRST.index(short)
    return len(_FIRST) + (short not in everyday)


def _comment(name: str) -> str:
    """The comment above the assignment of a constant."""
    module, _, short = name.rpartition(".")
    folder = PACKAGE.joinpath(*module.split(".")[1:])
    for node in ast.parse((folder / "__init__.py").read_text()).body:
        if isinstance(node, ast.ImportFrom) and node.level and short in [alias.name for alias in node.names]:
            lines = folder.joinpath(*(node.module or "").split(".")).with_suffix(".py").read_text().splitlines()
            break
    else:
        raise ValueError(f"{name} is not imported in {folder}.")
    first = next(
        statement.lineno - 1
        for statement in ast.parse("\n".join(lines)).body
        if isinstance(statement, ast.Assign | ast.AnnAssign)
        and short in [part.id for part in ast.walk(statement) if isinstance(part, ast.Name)]
    )
    last = first
    while first and lines[first - 1].startswith("#"):
        first -= 1
    if first == last:
        raise ValueError(f"{name} needs a comment above its assignment, which says what it is.")
    return "\n".join(line.removeprefix("# ") for line in lines[first:last])


def _exports(module: str) -> tuple[list[str], list[str]]:
    """Objects and modules that the `__init__.py` of a module exports as `X as X`."""
    folder = PACKAGE.joinpath(*module.split(".")[1:])
    objects, modules = [], []
    for node in ast.parse((folder / "__init__.py").read_text()).body:
        if isinstance(node, ast.ImportFrom) and node.level:
            names = [f"{module}.{alias.name}" for alias in node.names if alias.asname == alias.name]
            (objects if node.module else modules).extend(names)
    return objects, modules
