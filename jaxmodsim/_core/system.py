"""Optional packages, files that are written atomically, and a description of the machine. Imports no JAX."""

import importlib
import math
import os
import platform
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from functools import lru_cache
from pathlib import Path
from types import ModuleType
from typing import Any, BinaryIO


def extra(name: str, user: str = "sweep", of: str = "sweep") -> ModuleType:
    """Import a package of the extra `of`, for the function `user`.

    **Raises:**

    - `ImportError` with the command that installs it.
    """
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        raise ImportError(f'{user} needs {error.name}: pip install "jaxmodsim[{of}]".') from error


@contextmanager
def written_whole(path: str | os.PathLike[str]) -> Iterator[BinaryIO]:
    """A file that replaces `path` once it is complete; after an error the previous file remains."""
    target = Path(path)
    temporary = target.with_name(f".{target.name}.{uuid.uuid4().hex}.part")
    try:
        with open(temporary, "xb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, target)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def jsonable(value: Any) -> Any:
    """Convert to the types of JSON: arrays become lists, numbers that are not finite become null."""
    if isinstance(value, dict):
        return {key: jsonable(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [jsonable(item) for item in value]
    if hasattr(value, "tolist"):
        return jsonable(value.tolist())
    return None if isinstance(value, float) and not math.isfinite(value) else value


def describe_machine(*packages: str, beside: tuple[str, ...] = ()) -> dict[str, object]:
    """Processor, versions of the packages, date, and the commit of the repository in the working directory.

    Changes to the paths `beside`, relative to the root of the repository, do not count as uncommitted changes.
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
    """Commit of the repository in the working directory, and whether it has uncommitted changes; "" without one."""
    head, changed = _commit(os.getcwd(), ())
    return head + (" with uncommitted changes" if changed else "")


# Cached, since the process also loads the code only once.
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
