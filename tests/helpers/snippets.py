"""Code of the pages and what it prints: `python -m tests.helpers.snippets PAGE...` runs it and writes that down.

Every block of ```` ```python ```` runs, one after the other in one namespace for each page, after the lines that
`docs/start.md` says all code begins with. A block of ```` ```text ```` right behind it is what it prints. A block that
is not run has a line above it that says so, and why: `*Not run in the tests: ...*`
"""

import json
import os
import re
import subprocess
import sys
import tempfile
import textwrap
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[2]
_BLOCK = re.compile(
    r"^(?P<not_run> *\*Not run in the tests: [^\n]+\*\n\n)?(?P<code> *```python\n.*?^ *```\n)"
    r"(?:\n```text\n(?P<printed>.*?)^```\n)?",
    re.DOTALL | re.MULTILINE,
)
_RUN = """
import contextlib, io, json, sys
printed, names = [], {"__name__": "page"}
for code in json.load(sys.stdin):
    out = io.StringIO()
    with contextlib.redirect_stdout(out):
        exec(compile(code, f"block {len(printed)}", "exec"), names)
    printed.append(out.getvalue())
print(json.dumps(printed))
"""


class Snippet(NamedTuple):
    """A block of code that runs, and what the page says that it prints."""

    code: str
    printed: str


def snippets(text: str) -> list[Snippet]:
    """Blocks of a page that run."""
    return [
        Snippet(_code(match), match["printed"] or "") for match in _BLOCK.finditer(text) if match["not_run"] is None
    ]


def printed_by(page: Path) -> list[str]:
    """What each block of a page prints."""
    first = snippets((ROOT / "docs" / "start.md").read_text())[0].code
    blocks = [snippet.code for snippet in snippets(page.read_text())]
    if page.name != "start.md":
        blocks[0] = first + blocks[0]
    with tempfile.TemporaryDirectory() as folder:
        done = subprocess.run(
            [sys.executable, "-c", _RUN],
            input=json.dumps(blocks),
            cwd=folder,
            # What is compiled without optimization is there sooner, and prints the same digits.
            env={"JAX_DISABLE_MOST_OPTIMIZATIONS": "1", **os.environ, "PYTHONPATH": str(ROOT)},
            capture_output=True,
            text=True,
            check=False,
        )
    if done.returncode:
        raise RuntimeError(f"The code of {page.name} ends with an error:\n{done.stderr[-3000:]}")
    return json.loads(done.stdout)


def with_output(text: str, printed: list[str]) -> str:
    """The page with what its blocks print behind each of them."""
    rest = iter(printed)

    def block(match: re.Match[str]) -> str:
        if match["not_run"] is not None:
            return match[0]
        now = next(rest)
        return match["code"] + (f"\n```text\n{now}```\n" if now else "")

    return _BLOCK.sub(block, text)


def _code(match: re.Match[str]) -> str:
    return textwrap.dedent(match["code"]).removeprefix("```python\n").removesuffix("```\n")


if __name__ == "__main__":
    for given in sys.argv[1:]:
        path = Path(given)
        path.write_text(with_output(path.read_text(), printed_by(path)))
