"""The benches, which are in a clone of the repository and not in the installed package."""

import subprocess
import sys
from pathlib import Path


def run_bench_suite(arguments: list[str]) -> int:
    """Run `python -m bench` in the clone around the working directory, or else in the one this package lies in.

    **Arguments:**

    - `arguments`: handed on as they are.

    **Returns:**

    Its exit code.

    **Raises:**

    - `ValueError` where there is no clone; the text says where it was looked for.
    """
    # The package's own comes last: in another clone it is that one's benches that are meant.
    places = [Path.cwd(), Path(__file__).resolve().parents[2]]
    root = next((place for place in places if (place / "bench" / "__main__.py").is_file()), None)
    if root is None:
        looked = " or ".join(str(place) for place in dict.fromkeys(places))
        raise ValueError(
            f"there is no folder bench in {looked}: benches are not installed with the package. Run this in a clone of"
            " the repository, installed by pip install -e '.[bench]'."
        )
    return _waited([sys.executable, str(root / "bench"), *arguments])


def _waited(command: list[str]) -> int:
    """Exit code of a command, which gets to end by itself on Ctrl-C."""
    with subprocess.Popen(command) as process:
        while True:
            try:
                return process.wait()
            except KeyboardInterrupt:
                continue
