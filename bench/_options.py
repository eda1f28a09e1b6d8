"""How every bench begins: its options, and the settings of JAX."""

import argparse
import tempfile
from dataclasses import dataclass
from pathlib import Path

import jax

import jaxmodsim as jms

RESULTS = Path(__file__).parent / "results"


@dataclass(frozen=True)
class Options:
    """What the command line says.

    - `smoke`: run a small configuration that shows that everything runs.
    - `out`: folder of the results; of a small run a temporary one, unless it was given.
    - `tuned`: whether `jaxmodsim.tune_cpu` was called.
    - `record`: file of a measured record.
    - `jaxonomy`: Python interpreter of an environment that has jaxonomy; None without.
    """

    smoke: bool
    out: Path
    tuned: bool
    record: Path
    jaxonomy: str | None


def begin(
    description: str,
    *,
    smoke: str = "small configuration that shows that everything runs",
    may_leave_untuned: bool = False,
    with_jaxonomy: bool = False,
    record: Path = Path(),
) -> Options:
    """Read the command line, tune the CPU and enable double precision; to be called before the first computation."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("--smoke", action="store_true", help=smoke)
    parser.add_argument("--out", type=Path, default=None, help="folder of the results; default bench/results")
    if may_leave_untuned:
        parser.add_argument("--no-tune", action="store_true", help="without jaxmodsim.tune_cpu(); files of their own")
    if record != Path():
        parser.add_argument("--record", type=Path, default=record, help="file of the measured record")
    if with_jaxonomy:
        parser.add_argument("--jaxonomy", default=None, help="Python interpreter of an environment that has jaxonomy")
    given = parser.parse_args()
    tuned = not getattr(given, "no_tune", False)
    if tuned:
        jms.tune_cpu()
    jax.config.update("jax_enable_x64", True)
    out = given.out or (Path(tempfile.mkdtemp()) if given.smoke else RESULTS)
    return Options(given.smoke, out, tuned, getattr(given, "record", record), getattr(given, "jaxonomy", None))
