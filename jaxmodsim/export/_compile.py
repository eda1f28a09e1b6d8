"""C compilers for the binaries of an FMU."""

import importlib.util
import platform
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

# Extension of a shared library, and the target of Zig, by the platforms of FMI.
PLATFORMS = {
    "x86_64-linux": (".so", "x86_64-linux-gnu.2.17"),
    "aarch64-linux": (".so", "aarch64-linux-gnu.2.17"),
    "x86_64-windows": (".dll", "x86_64-windows-gnu"),
    "x86_64-darwin": (".dylib", "x86_64-macos"),
    "aarch64-darwin": (".dylib", "aarch64-macos"),
}
# Sums keep the order of JAX, and products are not fused with them.
_FLAGS = ("-std=c99", "-O2", "-shared", "-fPIC", "-fvisibility=hidden", "-ffp-contract=off")


def own_platform() -> str:
    """The platform of this machine, by its name in FMI."""
    machine = {"amd64": "x86_64", "arm64": "aarch64"}.get(platform.machine().lower(), platform.machine().lower())
    return f"{machine}-{platform.system().lower()}"


def compiler_of(target: str) -> list[str] | None:
    """The command that compiles for a platform: Zig, or the system's compiler for its own platform; None without."""
    if importlib.util.find_spec("ziglang") is not None:
        return [sys.executable, "-m", "ziglang", "cc", "-target", PLATFORMS[target][1], "-s"]
    system = next(filter(None, map(shutil.which, ("cc", "gcc", "clang"))), None)
    return [system] if system and target == own_platform() else None


def compile_library(sources: Sequence[Path], target: str, library: Path) -> None:
    """Compile sources to a shared library for a platform.

    **Raises:**

    - `RuntimeError` with the compiler's message.
    """
    command = compiler_of(target)
    assert command is not None
    library.parent.mkdir(parents=True, exist_ok=True)
    maths = [] if target.endswith("windows") else ["-lm"]
    done = subprocess.run(
        [*command, *_FLAGS, "-o", str(library), *map(str, sources), *maths], capture_output=True, text=True, check=False
    )
    if done.returncode:
        raise RuntimeError(f"fmu: {command[0]} did not compile the sources for {target}: {done.stderr.strip()[:2000]}")
    # Zig leaves an import library and debugging data beside a DLL.
    for other in library.parent.iterdir():
        if other != library:
            other.unlink()
