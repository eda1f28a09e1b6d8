"""Formulas in LaTeX, `$...$` and blocks of ```` ```math ````, as MathML."""

import re
import xml.etree.ElementTree as etree

from latex2mathml.converter import convert
from markdown import Markdown
from markdown.extensions import Extension
from markdown.inlinepatterns import InlineProcessor
from markdown.preprocessors import Preprocessor

_BLOCK = re.compile(r"^```math\n(.*?)^```$", re.DOTALL | re.MULTILINE)


class _Blocks(Preprocessor):
    def run(self, lines: list[str]) -> list[str]:
        def stored(match: re.Match[str]) -> str:
            formula = convert(match[1].strip(), display="block")
            return "\n" + self.md.htmlStash.store(f'<div class="formula">{formula}</div>') + "\n"

        return _BLOCK.sub(stored, "\n".join(lines)).split("\n")


class _Inline(InlineProcessor):
    def handleMatch(self, m: re.Match[str], data: str) -> tuple[etree.Element | str | None, int | None, int | None]:
        del data
        return self.md.htmlStash.store(convert(m[1])), m.start(0), m.end(0)


class Formulas(Extension):
    """Extension of Python-Markdown."""

    def extendMarkdown(self, md: Markdown) -> None:
        """Before fenced code, and after code in a line."""
        md.preprocessors.register(_Blocks(md), "formula-blocks", 27)
        md.inlinePatterns.register(_Inline(r"\$([^$\n]+)\$", md), "formulas", 185)
