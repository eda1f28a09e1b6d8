"""Run one bench in this process, and write its result and figures into a folder, as `python -m bench` does.

python -m bench.one NAME OUT [--smoke]
"""

import importlib
import os
import sys
from pathlib import Path


def main(name: str, out: Path, *, smoke: bool) -> None:
    """Run a bench in float64, and tuned for the CPU unless its name ends in `_untuned`."""
    if smoke:  # times are meaningless, so programs are compiled without optimisation
        os.environ["JAX_DISABLE_MOST_OPTIMIZATIONS"] = "1"
    import jax
    import matplotlib as mpl

    import jaxmodsim as jms

    mpl.use("Agg")
    if not name.endswith("_untuned"):
        jms.tune_cpu()
    jax.config.update("jax_enable_x64", True)
    from bench import figures
    from bench.layout import Recorded
    from bench.render import report

    out.mkdir(parents=True, exist_ok=True)
    if (Path(__file__).parent / "studies" / f"{name}.py").exists():
        result = importlib.import_module(f"bench.studies.{name}").main(smoke, out)
    else:
        from bench.cases import CASES
        from bench.quantities import run_case

        result = run_case(CASES[name], smoke)
    if result is None:
        return
    result.write(out, smoke=smoke)
    recorded = Recorded.read(out / f"{name}.json")
    print(report(recorded), report(recorded, targets=True))
    figures.write(recorded, out)


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]), smoke="--smoke" in sys.argv[3:])
