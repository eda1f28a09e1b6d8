"""What mkdocs does beside its plugins: pages made from other files, links that hold on a forge and on the site.

Pages under docs/ link to files of the repository (`../examples/a0_box_with_friction.py`, `../CHANGELOG.md`), which a
forge shows. Here those links lead to pages that are made from these files: the changelog, one page for each example,
one for each notebook and one for each room of the package.
"""

import re
import subprocess
import sys
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(Path(__file__).resolve().parent))

import api  # noqa: E402
import formulas  # noqa: E402
import gallery  # noqa: E402
import notebooks  # noqa: E402

_COPIES = {"CHANGELOG.md": "changelog.md", "CONTRIBUTING.md": "contributing.md"}
_LINK = re.compile(r"\]\((?:\.\./)+([\w./]+?)(#[\w-]*)?\)")
_LIVE = ROOT / "docs" / "live" / "build.py"
_SHIM = "https://unpkg.com/iframe-worker/shim"
_SIMULATE = """# Live

Every move of a slider runs the machine again, here in the browser. [Open full screen](live.html)

<iframe src="live.html" title="Simulation" style="width: 100%; height: 80vh; border: 0"></iframe>
"""


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Formulas become MathML, which browsers draw without scripts; the page that simulates gets its entry."""
    config.markdown_extensions.append(formulas.Formulas())  # pyright: ignore[reportArgumentType]
    if _LIVE.exists() and config.nav:
        config.nav.insert(2, {"Live": "simulate.md"})
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages that are made from other files, and the figures of the examples, which are run for that."""
    for source, target in _COPIES.items():
        text = (ROOT / source).read_text().replace("](docs/", "](").replace("](README.md", "](index.md")
        files.append(File.generated(config, target, content=text))
    for name in ("worker.js", "site.css"):
        path = Path(__file__).with_name(name)
        files.append(File.generated(config, f"assets/{name}", abs_src_path=str(path)))
    for room in api.rooms():
        files.append(File.generated(config, f"api/{room}.md", content=api.page(room)))
    for example in gallery.examples():
        shown = gallery.recorded(example)
        files.append(File.generated(config, f"examples/{example.stem}.md", content=gallery.page(example, shown)))
        files.append(
            File.generated(config, f"examples/{example.stem}.thumbnail.png", abs_src_path=str(shown.thumbnail))
        )
        for figure in shown.figures:
            files.append(File.generated(config, f"examples/{figure.name}", abs_src_path=str(figure)))
    for notebook in notebooks.notebooks():
        shown, place = notebooks.recorded(notebook), "examples/notebooks"
        files.append(File.generated(config, f"{place}/{notebook.stem}.md", content=shown.page))
        files.append(File.generated(config, f"{place}/{notebook.stem}.ipynb", content=shown.plain))
        for name, content in shown.files.items():
            files.append(File.generated(config, f"{place}/{name}", content=content))
    if _LIVE.exists():
        made = ROOT / "build" / "live.html"
        subprocess.run([sys.executable, str(_LIVE), str(made)], cwd=ROOT, check=True)
        files.append(File.generated(config, "live.html", abs_src_path=str(made)))
        files.append(File.generated(config, "simulate.md", content=_SIMULATE))
    return files


def on_page_markdown(markdown: str, *, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Lead links to files of the repository to the pages made from them; the gallery gets its thumbnails."""
    del config, files
    if page.file.src_uri == "gallery.md":
        markdown = gallery.with_thumbnails(markdown)
    here = page.file.src_uri.count("/")

    def to_page(match: re.Match[str]) -> str:
        path, anchor = match[1], match[2] or ""
        if path == "README.md":
            target = "index.md"
        elif path in _COPIES:
            target = _COPIES[path]
        elif path == "docs/live/page.html":
            target = "simulate.md"
        elif path.startswith("examples/"):
            target = path.removesuffix(".py") + ".md"
        elif path.startswith("jaxmodsim/"):
            target = f"api/{path.split('/')[1]}.md"
        else:
            return match[0]
        return f"]({'../' * here}{target}{anchor})"

    return _LINK.sub(to_page, markdown)


def on_post_build(config: MkDocsConfig) -> None:
    """Refuse a site on which a public name is missing, or that needs the network."""
    site = Path(config.site_dir)
    for room in api.rooms():
        html = (site / "api" / f"{room}.html").read_text()
        missing = [name for name in api.public_names(room) if f'id="{name}"' not in html]
        if missing:
            raise PluginError(f"The page of {room} has no entry for {', '.join(missing)}.")
    for path in site.rglob("*.html"):
        # What the plugin `offline` takes from the network comes from the site itself.
        text = path.read_text().replace(_SHIM, "../" * (len(path.relative_to(site).parts) - 1) + "assets/worker.js")
        path.write_text(text)
        if loaded := re.findall(r"<(?:script|link|img|iframe)[^>]+(?:src|href)=\"(https?:[^\"]+)", text):
            raise PluginError(f"{path.name} needs the network, for {', '.join(loaded)}.")
