"""The page that simulates, in a browser: what it runs is what `simulate` runs."""

import importlib.util
import shutil
import sys
from pathlib import Path
from typing import Any

import pytest

LIVE = Path(__file__).parents[2] / "docs" / "live"
BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")


@pytest.fixture(scope="module")
def check() -> Any:
    """`docs/live/check.py`, which is a script."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(LIVE))
        spec = importlib.util.spec_from_file_location("check", LIVE / "check.py")
        assert spec
        assert spec.loader
        module = importlib.util.module_from_spec(spec)
        patch.setitem(sys.modules, "check", module)
        spec.loader.exec_module(module)
        yield module


def test_the_page_is_one_small_file_that_loads_nothing(check: Any, tmp_path: Path) -> None:
    text = check.build(tmp_path / "live.html").read_text()
    assert len(text) < 1_000_000
    for word in ("http:", "https:", "src=", "import ", "fetch("):
        assert word not in text


@pytest.mark.skipif(not any(map(shutil.which, BROWSERS)), reason=f"needs a browser: {', '.join(BROWSERS)}")
def test_the_page_runs_what_simulate_runs(check: Any, tmp_path: Path) -> None:
    browser = check.open_page(tmp_path)
    try:
        for machine, positions in check.CASES:
            assert check.largest_error(browser, machine, positions) < check.MOST_ERROR, (machine, positions)
    finally:
        browser.close()
