"""LuGre fitted to measured presliding loops: the friction law alone, from measured motion and force.

The record is `test_data_2.txt` of FrictionModels.jl (J. Christopherson, MIT licence), converted to SI; it is read
from where it lies and not part of this repository.

Run it: `python examples/b1_presliding_loops.py [--record CSV] [--smoke] [--out DIR]`.
"""

import argparse
from pathlib import Path

import jax
import numpy as np

import jaxmodsim as jms
from jaxmodsim.plot import loops_figure

RECORD = Path(__file__).parents[2] / "shared" / "data" / "presliding" / "hysteresis.csv"
SOURCE = "Record: FrictionModels.jl, Copyright (c) 2021 Jason Christopherson and contributors, MIT"


def main(record_file: Path, out: Path, smoke: bool = False) -> None:
    """Fit stiffness and level per newton of load, draw the loops, and say what the record leaves open."""
    if not record_file.exists():
        print(f"skipped: there is no record at {record_file}")
        return
    t, normal, x, friction = np.loadtxt(record_file, delimiter=",", skiprows=1).T
    if smoke:
        t, normal, x, friction = (column[:8000] for column in (t, normal, x, friction))
    record = jms.Record(t, friction, {"x": x, "normal": normal}, name="Presliding")
    # Forces per newton of load: Fc is a coefficient of friction. With Fs = Fc there is no Stribeck effect, and as Fs is
    # not free, it follows Fc.
    start = jms.LuGre(sigma0=2e4, sigma1=0.0, sigma2=0.0, Fc=0.45, Fs=0.45, vs=1e-3)
    result = jms.fit_law(start, record, ("sigma0", "Fc"))
    print(result)
    if not smoke:
        wide = jms.LuGre(sigma0=7e3, sigma1=10.0, sigma2=1.0, Fc=0.5, Fs=0.55, vs=1e-4)
        print("\nAll six parameters free:")
        print(jms.fit_law(wide, record))
    out.mkdir(parents=True, exist_ok=True)
    loops_figure(result, caption=SOURCE).savefig(out / "b1_presliding.png", dpi=130)
    print(f"wrote {out / 'b1_presliding.png'}")


if __name__ == "__main__":
    jms.tune_cpu()
    jax.config.update("jax_enable_x64", True)
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--record", type=Path, default=RECORD)
    parser.add_argument("--smoke", action="store_true", help="the first cycles alone")
    parser.add_argument("--out", type=Path, default=Path("example-output"))
    arguments = parser.parse_args()
    main(arguments.record, arguments.out, arguments.smoke)
