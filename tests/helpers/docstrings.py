"""Docstrings of the public names: `python -m tests.helpers.docstrings` runs their examples and writes what they print.

An example is a block of ```` ```python ```` under `**Example:**`. It runs in a namespace of its own, after `FIRST`. A
block of ```` ```text ```` right behind it is its output; `snippets` has the rules.
"""

import ast
import importlib
import inspect
import io
import re
import sys
import tempfile
import textwrap
from collections.abc import Iterator
from contextlib import chdir, redirect_stdout
from pathlib import Path
from types import FunctionType, ModuleType
from typing import Any

from . import snippets

ROOT = snippets.ROOT
PACKAGE = ROOT / "jaxmodsim"
FIRST = "import diffrax, jax, jax.numpy as jnp, numpy as np\nimport jaxmodsim as jms\n"
_BEFORE_DATA = ("__check_init__", "__init__", "__post_init__")


def public(room: str) -> Iterator[tuple[str, Any]]:
    """Functions and classes that a room exports, those of its public modules included, by their dotted names."""
    folder = importlib.import_module(f"jaxmodsim.{room}")
    for name in _exports(PACKAGE / room / "__init__.py"):
        thing = getattr(folder, name)
        if isinstance(thing, ModuleType):
            for inner, part in vars(thing).items():
                if not inner.startswith("_") and getattr(part, "__module__", None) == thing.__name__:
                    yield f"{room}.{name}.{inner}", part
        else:
            yield f"{room}.{name}", thing


def _exports(path: Path) -> list[str]:
    imports = [node for node in ast.parse(path.read_text()).body if isinstance(node, ast.ImportFrom) and node.level]
    return [alias.name for node in imports for alias in node.names if alias.asname == alias.name]


def definition(thing: Any) -> ast.FunctionDef | ast.ClassDef:
    """The source of a function or class."""
    (node,) = ast.parse(textwrap.dedent(inspect.getsource(inspect.unwrap(thing)))).body
    assert isinstance(node, ast.FunctionDef | ast.ClassDef)
    return node


def lacking(thing: Any) -> list[str]:
    """Sections that a docstring lacks: what the function returns, and what its own code or its constructor raises.

    Names other than functions and classes have no docstring. Methods have the section `Raises` if they do not implement
    a method of a base, which describes it.
    """
    if isinstance(thing, type):
        node = definition(thing)
        methods = [part for part in node.body if isinstance(part, ast.FunctionDef)]
        inherited = {name for base in thing.__mro__[1:] for name in vars(base)}
        found = ["Raises"] if any(part.name in _BEFORE_DATA and _raises(part) for part in methods) else []
        found = [section for section in found if f"**{section}:**" not in (thing.__doc__ or "")]
        own = [part for part in methods if not part.name.startswith("_") and part.name not in inherited]
        return found + [
            f"{part.name}: Raises"
            for part in own
            if _raises(part) and "**Raises:**" not in (ast.get_docstring(part) or "")
        ]
    if not isinstance(inspect.unwrap(thing), FunctionType):
        return []
    node = definition(thing)
    needed = {"Returns": _returns(node), "Raises": _raises(node)}
    return [section for section, yes in needed.items() if yes and f"**{section}:**" not in (thing.__doc__ or "")]


def _raises(node: ast.AST) -> bool:
    return any(isinstance(part, ast.Raise) for part in ast.walk(node))


def _returns(node: ast.AST) -> bool:
    """Whether a function returns anything but None; functions inside it do not count."""
    for part in ast.iter_child_nodes(node):
        if isinstance(part, ast.Return):
            if not (part.value is None or (isinstance(part.value, ast.Constant) and part.value.value is None)):
                return True
        elif not isinstance(part, ast.FunctionDef) and _returns(part):
            return True
    return False


def example(doc: str) -> str:
    """The section `Example` of a docstring, up to a reference; empty without one."""
    found = re.search(r"^\*\*Example:\*\*\n(.*?)(?=^\?\?\? cite|\Z)", inspect.cleandoc(doc), re.DOTALL | re.MULTILINE)
    return found[1].strip() + "\n" if found else ""


def printed_by(code: str) -> str:
    """Output of an example, which runs in a folder of its own."""
    out = io.StringIO()
    with tempfile.TemporaryDirectory() as folder, chdir(folder), redirect_stdout(out):
        exec(compile(FIRST + code, "example", "exec"), {"__name__": "example"})
    return out.getvalue()


def with_output(source: str) -> str:
    """A file of the package with the output behind the examples of its docstrings."""
    lines = source.split("\n")
    nodes = [node for node in ast.walk(ast.parse(source)) if isinstance(node, ast.FunctionDef | ast.ClassDef)]
    for node in sorted(nodes, key=lambda node: -node.lineno):
        first = node.body[0]
        if not (isinstance(first, ast.Expr) and "**Example:**" in (ast.get_docstring(node) or "")):
            continue
        begin, end, indent = first.lineno - 1, first.end_lineno, " " * first.col_offset
        text = textwrap.dedent("\n".join([indent + lines[begin].strip(), *lines[begin + 1 : end]]))
        section = example(text)
        printed = [printed_by(snippet.code) for snippet in snippets.snippets(section)]
        text = text.replace(section.rstrip(), snippets.with_output(section, printed).rstrip())
        lines[begin:end] = [indent + line if line else "" for line in text.split("\n")]
    return "\n".join(lines)


if __name__ == "__main__":
    import jax

    jax.config.update("jax_enable_x64", True)
    for path in map(Path, sys.argv[1:]):
        path.write_text(with_output(path.read_text()))
