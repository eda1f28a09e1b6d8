"""The ensembles of `ensemble` on a GPU, which JAX finds after `pip install "jax[cuda13]"`; nothing without one."""

from pathlib import Path

import jax

from bench.record import Result
from bench.studies.ensemble import measure_on


def main(smoke: bool, out: Path) -> Result | None:
    """Measure on the first GPU."""
    del out
    device = jax.devices()[0]
    if device.platform != "gpu":
        print("ensemble_gpu measures nothing: JAX finds no GPU.")
        return None
    return measure_on(device, "ensemble_gpu", smoke)
