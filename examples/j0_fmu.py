"""Stick-slip as an FMU: a component of a system simulator, with exact events.

A mass on a belt is exported by `jms.export.fmu` and run by FMPy, which changes the belt velocity at 5 s. The FMU
contains C code and locates its events; coordinates agree with two runs of `simulate`.

Needs FMPy, and a C compiler for this platform. Run it: `python examples/j0_fmu.py [--smoke] [--out DIR]`.
"""

import argparse
from pathlib import Path

import equinox as eqx
import fmpy
import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

import jaxmodsim as jms
from jaxmodsim.export._compile import own_platform
from jaxmodsim.problems import belt_oscillator


def main(out: Path, smoke: bool = False) -> None:
    """Export, run in FMPy, and compare; --smoke changes nothing."""
    out.mkdir(parents=True, exist_ok=True)
    scene, belt = belt_oscillator.scene(), "friction.belt_velocity"
    path = jms.export.fmu(scene, [0.0], [0.1], out / "belt.fmu", inputs=[belt], t1=10.0, platforms=[own_platform()])
    given = np.array([(0.0, 0.1), (5.0, 0.1), (5.0, 0.2), (10.0, 0.2)], dtype=[("time", float), (belt, float)])
    rows = fmpy.simulate_fmu(
        str(path), fmi_type="CoSimulation", stop_time=10.0, output_interval=0.02, relative_tolerance=1e-8, input=given
    )
    ts = jnp.linspace(0.0, 5.0, 251)
    first = jms.simulate(scene, [0.0], [0.1], 5.0, ts=ts, rtol=1e-8, atol=1e-11)
    faster = eqx.tree_at(lambda s: s.effects[0].belt_velocity, scene, jnp.asarray(0.2))
    second = jms.simulate(faster, first.q[-1], first.qd[-1], 5.0, ts=ts, rtol=1e-8, atol=1e-11)
    t, x = np.concatenate([ts, 5.0 + ts]), np.concatenate([first.q[:, 0], second.q[:, 0]])
    error = np.max(np.abs(np.interp(t, rows["time"], rows["x"]) - x))
    print(f"{path.name}: {len(rows)} rows, largest difference from simulate {error:.1e} m")
    figure = Figure(figsize=(8, 4), layout="constrained")
    axis = figure.subplots()
    axis.plot(rows["time"], rows["x"], color="#1f5fa8", label="FMU in FMPy")
    axis.plot(t[::10], x[::10], "o", ms=3, color="#c2452d", label="simulate")
    axis.set(xlabel="time [s]", ylabel="x [m]", title="The belt goes twice as fast from 5 s on")
    axis.legend()
    figure.savefig(out / "j0_fmu.png", dpi=110)
    print(f"wrote {out / 'j0_fmu.png'}")


if __name__ == "__main__":
    jms.tune_cpu()
    jax.config.update("jax_enable_x64", True)
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--smoke", action="store_true", help="small and quick")
    parser.add_argument("--out", type=Path, default=Path("example-output"))
    main(**vars(parser.parse_args()))
