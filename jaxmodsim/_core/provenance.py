"""Where a result comes from: machine, versions and commit."""

import os
import platform
from datetime import UTC, datetime
from functools import lru_cache
from pathlib import Path


def describe_machine(*packages: str, beside: tuple[str, ...] = ()) -> dict[str, object]:
    """Processor, versions of the packages, date and, of the repository in the working directory, the commit.

    Changes to the paths `beside`, from the root of the repository, do not count as uncommitted changes.
    """
    head, changed = _commit(os.getcwd(), beside)
    return {
        "cpu": _cpu_model(),
        "cores": os.cpu_count(),
        "system": platform.system(),
        "python": platform.python_version(),
        "versions": versions(*packages),
        "xla_flags": os.environ.get("XLA_FLAGS", ""),
        "commit": head,
        "uncommitted_changes": changed,
        "date": datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
    }


def versions(*packages: str) -> dict[str, str]:
    """Installed versions of packages, by name."""
    from importlib.metadata import version  # slow to import, as subprocess is below

    return {name: version(name) for name in packages}


def commit() -> str:
    """The commit of the repository in the working directory, if it is one, and whether there are changes beside it."""
    head, changed = _commit(os.getcwd(), ())
    return head + (" with uncommitted changes" if changed else "")


# Looked up once: code, too, is loaded once.
@lru_cache(maxsize=4)
def _commit(folder: str, beside: tuple[str, ...]) -> tuple[str, bool]:
    import subprocess

    paths = (":/", *(f":(top,exclude){path}" for path in beside))
    try:
        head, state = (
            subprocess.run(
                ["git", *words], cwd=folder, capture_output=True, text=True, check=True, timeout=20
            ).stdout.strip()
            for words in (("rev-parse", "HEAD"), ("status", "--porcelain", "--untracked-files=no", "--", *paths))
        )
    except (OSError, subprocess.SubprocessError):
        return "", False
    return head, bool(state)


def _cpu_model() -> str:
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or "unknown"
