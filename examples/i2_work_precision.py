"""Work and precision: exact events against smoothed friction.

A mass on a spring that friction stops. What smoothing costs is an error that no tolerance takes away.

Run it: `python examples/i2_work_precision.py [--smoke] [--out DIR]`.
"""

import argparse
from pathlib import Path

import diffrax
import jax

import jaxmodsim as jms
from jaxmodsim.plot import work_precision_figure


def main(out: Path, smoke: bool = False) -> None:
    """Errors against a closed form, for three methods."""
    problem = jms.problems.named_problems()["braked_spring"]()
    smooth = jms.formulations(problem.scene, width=1e-3)["Regularized"]
    methods = {"exact": jms.Method(jms.Rodas5P())}
    if not smoke:
        methods |= {"exact, Tsit5": jms.Method(diffrax.Tsit5()), "smooth, 1 mm/s": jms.Method(scene=smooth)}
    tolerances = (1e-5,) if smoke else (1e-4, 1e-5, 1e-6, 1e-7, 1e-8)
    study = jms.work_precision(**problem.arguments, methods=methods, tolerances=tolerances)
    print(study)
    figure = work_precision_figure(study)
    out.mkdir(parents=True, exist_ok=True)
    figure.savefig(out / "i2_work_precision.png", dpi=110)
    print(f"wrote {out / 'i2_work_precision.png'}")


if __name__ == "__main__":
    jms.tune_cpu()
    jax.config.update("jax_enable_x64", True)
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--smoke", action="store_true", help="small and quick")
    parser.add_argument("--out", type=Path, default=Path("example-output"))
    main(**vars(parser.parse_args()))
