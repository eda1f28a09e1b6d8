"""LuGre in stick: a bristle that rings, over sigma0 and sigma1.

The box under a rising force, 16 parameter sets in one vmap. More sigma1 damps the ringing; a softer sigma0 makes fewer,
slower and larger swings.

Run it: `python examples/f4_lugre_stick.py [--smoke] [--out DIR]`.
"""

import argparse
from pathlib import Path

import jax

import jaxmodsim as jms
from jaxmodsim.plot import stick_figure
from jaxmodsim.problems.testbench import stick_sweep


def main(out: Path, smoke: bool = False) -> None:
    """Run the grid and draw it; --smoke changes nothing."""
    grid = stick_sweep()
    i = list(grid["sigma0"]).index(750.0)
    for sigma1, amplitude in zip(grid["sigma1"], grid["oscillation"][i], strict=True):
        print(f"sigma0 750 N/m, sigma1 {sigma1:4.0f} N s/m: rings by {1e3 * amplitude:.3f} mN")
    shown = {f"sigma0 750, sigma1 {s1:g}": grid["gap"][i, j] for j, s1 in enumerate(grid["sigma1"])}
    zero = 0.0 * grid["t"]
    figure = stick_figure(grid["t"], shown, zero, grid["sigma0"], grid["sigma1"], grid["oscillation"])
    out.mkdir(parents=True, exist_ok=True)
    figure.savefig(out / "f4_lugre_stick.png", dpi=110)
    print(f"wrote {out / 'f4_lugre_stick.png'}")


if __name__ == "__main__":
    jms.tune_cpu()
    jax.config.update("jax_enable_x64", True)
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--smoke", action="store_true", help="small and quick")
    parser.add_argument("--out", type=Path, default=Path("example-output"))
    main(**vars(parser.parse_args()))
