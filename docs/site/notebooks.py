"""Runs the notebooks as Jupyter does, and makes pages of them.

Their source is examples/notebooks/*.py, in the percent format of jupytext. What ran is kept in build/notebooks until
the file changes. `mkdocs build` runs those that are missing; `python docs/site/notebooks.py NOTEBOOK.py...` runs some.
"""

import base64
import hashlib
import os
import re
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import jupytext
import nbclient
import nbformat

ROOT = Path(__file__).resolve().parents[2]
CACHE = ROOT / "build" / "notebooks"
# What the package logs, which depends on how fast the machine is.
_SAID = "Compiling this scene took", "Further runs of a scene start at once"


@dataclass(frozen=True)
class NotebookPages:
    """What the site shows of a notebook: its page, the files that the page shows, the notebook without outputs."""

    page: str
    files: dict[str, bytes]
    plain: str


def notebooks() -> list[Path]:
    """The notebooks, in the order of their names."""
    return sorted((ROOT / "examples" / "notebooks").glob("*.py"))


def recorded(source: Path) -> NotebookPages:
    """The pages of a notebook, which is run where nothing is kept of it, or something older."""
    kept = CACHE / f"{source.stem}.ipynb"
    if not kept.exists() or nbformat.read(kept, as_version=4).metadata.get("source") != _digest(source):
        run(source)
    return _pages(source, nbformat.read(kept, as_version=4))


def run(source: Path) -> None:
    """Run a notebook in a folder of its own, and keep what it shows.

    **Raises:**

    - `RuntimeError` where a cell fails, or writes what is no output: warnings, for one.
    """
    notebook = jupytext.read(source)
    before = os.times()
    with tempfile.TemporaryDirectory() as folder:
        client = nbclient.NotebookClient(notebook, kernel_name="python3", coalesce_streams=True, timeout=600)
        client.execute(cwd=folder)
    after = os.times()
    for cell in notebook.cells:
        if cell.source.startswith("%pip"):  # it says that the kernel may need another start
            cell.outputs = []
        errors = [output for output in cell.get("outputs", ()) if output.get("name") == "stderr"]
        for line in "".join(output.text for output in errors).splitlines():
            if not line.startswith(_SAID):
                raise RuntimeError(f"{source.name} writes this beside its results: {line}")
        if cell.cell_type == "code":
            cell.outputs = [output for output in cell.outputs if output not in errors]
    notebook.metadata["source"] = _digest(source)
    seconds = after.children_user + after.children_system - before.children_user - before.children_system
    notebook.metadata["seconds"] = round(seconds, 1)
    CACHE.mkdir(parents=True, exist_ok=True)
    nbformat.write(notebook, CACHE / f"{source.stem}.ipynb")


def _pages(source: Path, notebook: nbformat.NotebookNode) -> NotebookPages:
    files: dict[str, bytes] = {}
    parts: list[str] = []
    for cell in notebook.cells:
        if cell.cell_type == "markdown":
            parts.append(cell.source)
            continue
        parts.append(f"```python\n{cell.source}\n```")
        parts += [_shown(output, f"{source.stem}_{len(files)}", files) for output in cell.outputs]
    if not any(name.endswith(".png") for name in files):
        raise RuntimeError(f"{source.name} shows no figure.")
    seconds = notebook.metadata["seconds"]
    parts.insert(
        1,
        f"*[The notebook]({source.stem}.ipynb), to download; {seconds:.0f} s of processor time here, start and"
        " compilation included.*",
    )
    plain = jupytext.writes(jupytext.read(source), fmt="ipynb")
    return NotebookPages("\n\n".join(parts) + "\n", files, plain)


def _shown(output: nbformat.NotebookNode, name: str, files: dict[str, bytes]) -> str:
    """Markdown of an output; figures and films go into files."""
    if output.output_type == "stream":
        return f"```text\n{output.text.rstrip()}\n```"
    data = output.data
    if "image/png" in data:
        files[f"{name}.png"] = base64.b64decode(data["image/png"])
        return f"![Figure]({name}.png)"
    html = data.get("text/html", "")
    if "<script" in html:
        files[f"{name}.html"] = html.encode()
        return f'<iframe src="{name}.html" title="Film" style="width: 100%; height: 36rem; border: 0"></iframe>'
    if "<table" in html:
        # In the style of the site's own tables.
        table = re.sub(r"<style.*?</style>|(?<=<table) [^>]*", "", html, flags=re.DOTALL)
        return '<div style="overflow-x: auto">' + re.sub(r"\s*\n\s*", "", table) + "</div>"
    return f"```text\n{data['text/plain']}\n```"


def _digest(source: Path) -> str:
    return hashlib.sha256(source.read_bytes()).hexdigest()


if __name__ == "__main__":
    for given in sys.argv[1:]:
        run(Path(given))
        print(f"{CACHE / Path(given).stem}.ipynb")
