"""Runs the examples, and shows them: figures, run times, thumbnails.

What an example wrote is kept in build/gallery until its file changes. `mkdocs build` runs those that are missing;
`python docs/site/gallery.py examples/a0_box_with_friction.py` runs one, and with `--smoke` in its small form, which the
site takes as well where the environment variable `GALLERY` is `smoke`.
"""

import argparse
import ast
import hashlib
import json
import os
import re
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

from PIL import Image

ROOT = Path(__file__).resolve().parents[2]
CACHE = ROOT / "build" / "gallery"
_ITEM = re.compile(r"^- \[(.+?)\]\(\.\./examples/(\w+)\.py\): (.+(?:\n  .+)*)$", re.MULTILINE)


@dataclass(frozen=True)
class Shown:
    """What an example wrote: figures, the first of them small, and the processor time it took [s]."""

    figures: list[Path]
    thumbnail: Path
    seconds: float
    printed: str


def examples() -> list[Path]:
    """The examples, in the order of their names."""
    return sorted((ROOT / "examples").glob("*.py"))


def recorded(example: Path) -> Shown:
    """What the example wrote; it is run where nothing is kept of it, or something older."""
    folder, small = CACHE / example.stem, os.environ.get("GALLERY") == "smoke"
    record = json.loads((folder / "record.json").read_text()) if (folder / "record.json").exists() else {}
    if record.get("source") != _digest(example) or (record["smoke"] and not small):
        record = run(example, small)
    figures = sorted(path for path in folder.iterdir() if path.suffix in (".png", ".gif") and path.stem != "thumbnail")
    if not figures:  # it needs a record that is not part of the repository
        figures = sorted((ROOT / "docs" / "figures").glob(f"{example.stem.split('_')[0]}_*.png"))
    thumbnail = folder / "thumbnail.png"
    with Image.open(next((path for path in figures if path.suffix == ".png"), figures[0])) as image:
        image.thumbnail((480, 360))
        image.convert("RGB").quantize(64).save(thumbnail, optimize=True)
    return Shown(figures, thumbnail, record["seconds"], record["printed"])


def run(example: Path, smoke: bool) -> dict[str, object]:
    """Run an example and keep what it wrote."""
    folder = CACHE / example.stem
    folder.mkdir(parents=True, exist_ok=True)
    for old in folder.iterdir():
        old.unlink()
    command = [sys.executable, str(example), "--out", str(folder), *(["--smoke"] if smoke else [])]
    before = os.times()
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"{example.name} ended with exit code {done.returncode}:\n{done.stdout}{done.stderr}")
    after = os.times()
    seconds = after.children_user + after.children_system - before.children_user - before.children_system
    record: dict[str, object] = {
        "source": _digest(example),
        "smoke": smoke,
        "seconds": round(seconds, 1),
        "printed": re.sub(r"wrote .*/", "wrote ", done.stdout),
    }
    (folder / "record.json").write_text(json.dumps(record))
    return record


def page(example: Path, shown: Shown) -> str:
    """Markdown of one example: what it is, its figures, what it prints, its code."""
    code = example.read_text()
    title, _, text = (ast.get_docstring(ast.parse(code)) or "").partition("\n")
    every = examples()
    place = every.index(example)
    before, after = every[place - 1], every[(place + 1) % len(every)]
    figures = "\n\n".join(f"![{title}]({path.name})" for path in shown.figures)
    return (
        f"# {title.rstrip('.').split(': ')[0]}\n\n"
        f"[Previous]({before.stem}.md) | [Gallery](../gallery.md) | [Next]({after.stem}.md)\n\n"
        f"{title}\n{text}\n\n{figures}\n\n"
        f"*{shown.seconds:.0f} s of processor time, start and compilation included. Output:*\n\n"
        f"```text\n{shown.printed}```\n\n`examples/{example.name}`:\n\n```python\n{code}```\n"
    )


def with_thumbnails(markdown: str) -> str:
    """The list of examples as cards with pictures."""

    def card(match: re.Match[str]) -> str:
        title, stem, text = match.groups()
        shown = recorded(ROOT / "examples" / f"{stem}.py")
        return (
            f"-   [![{title}](examples/{stem}.thumbnail.png)](examples/{stem}.md)\n\n"
            f"    [**{title}**](examples/{stem}.md) ({shown.seconds:.0f} s): {' '.join(text.split())}\n"
        )

    def cards(match: re.Match[str]) -> str:
        return f'<div class="grid cards" markdown>\n\n{_ITEM.sub(card, match[0])}\n</div>\n'

    return re.sub(r"(?:^- .+\n(?:  .+\n)*)+", cards, markdown, flags=re.MULTILINE)


def _digest(example: Path) -> str:
    return hashlib.sha256(example.read_bytes()).hexdigest()


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Run examples and keep what they write for the site.")
    parser.add_argument("examples", nargs="+", type=Path)
    parser.add_argument("--smoke", action="store_true", help="in their small form")
    given = parser.parse_args()
    for path in given.examples:
        print(path.name)
        print(run(path, given.smoke)["printed"])
