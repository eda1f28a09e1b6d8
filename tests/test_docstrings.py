"""Docstrings of the public names: sections, and examples that run."""

from typing import Any

import pytest

import jaxmodsim

from .helpers import docstrings, snippets

ROOMS = sorted({path.parent.name for path in docstrings.PACKAGE.glob("*/__init__.py")} - {"_core", "cli"})
PUBLIC = {name: thing for room in ROOMS for name, thing in docstrings.public(room)}
EVERYDAY = {name: getattr(jaxmodsim, name) for name, folder in jaxmodsim._FOLDERS.items()}
EXAMPLES = {
    name: section
    for name, thing in {**PUBLIC, "_core.speed.tune_cpu": jaxmodsim.tune_cpu}.items()
    if isinstance(thing.__doc__, str) and (section := docstrings.example(thing.__doc__))
}


@pytest.mark.quick
@pytest.mark.parametrize("name", EVERYDAY)
def test_every_name_of_the_top_level_has_an_example(name: str) -> None:
    assert "```python" in docstrings.example(EVERYDAY[name].__doc__)


@pytest.mark.quick
@pytest.mark.parametrize("room", ROOMS)
def test_every_section_of_a_docstring_is_there(room: str) -> None:
    """`Returns` for every function with a result, `Raises` for every function and class that raises."""
    lacking = {name: docstrings.lacking(thing) for name, thing in docstrings.public(room)}
    assert not {name: sections for name, sections in lacking.items() if sections}


@pytest.mark.quick
def test_sections_that_lack_are_seen() -> None:
    class Part:
        """A part."""

        def __init__(self, n: int) -> None:
            if n < 0:
                raise ValueError(n)

        def cut(self) -> None:
            """Cut it."""
            raise ValueError

    def count(n: Any) -> int:
        """Count it.

        **Raises:**

        - `ValueError` always.
        """

        def inner() -> int:
            return 1

        if n:
            raise ValueError(n)
        return inner()

    def nothing() -> None:
        """Nothing."""

        def inner() -> int:
            return 1

        inner()

    assert docstrings.lacking(Part) == ["Raises", "cut: Raises"]
    assert docstrings.lacking(count) == ["Returns"]
    assert docstrings.lacking(nothing) == []


@pytest.mark.parametrize("name", EXAMPLES)
def test_an_example_prints_what_its_docstring_shows(name: str) -> None:
    """Written by `python -m tests.helpers.docstrings FILE`."""
    blocks = snippets.snippets(EXAMPLES[name])
    assert [docstrings.printed_by(block.code) for block in blocks] == [block.printed for block in blocks]


@pytest.mark.parametrize("name", EXAMPLES)
def test_every_block_of_an_example_runs_or_says_why_not(name: str) -> None:
    not_run = EXAMPLES[name].count("*Not run in the tests: ")
    assert EXAMPLES[name].count("```python\n") == len(snippets.snippets(EXAMPLES[name])) + not_run


@pytest.mark.parametrize("room", ROOMS)
def test_code_stands_under_example(room: str) -> None:
    for name, thing in docstrings.public(room):
        doc = thing.__doc__ or ""
        assert doc.count("```python") == docstrings.example(doc).count("```python"), name
