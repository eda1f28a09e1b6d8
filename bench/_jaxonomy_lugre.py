"""The LuGre testbench in jaxonomy, which pins a JAX of its own and so runs in an environment of its own.

Started by `a0_lugre_testbench.py` with the interpreter of that environment; reads what to do as JSON from its input and
prints a line `RESULT` with what it found.
"""

import importlib.metadata
import json
import sys
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import jaxonomy
from _workload import numpy_workload_s

# jaxmodsim is not there; its timing needs nothing but Python.
sys.path.append(str(Path(__file__).parents[1] / "jaxmodsim" / "_core"))
from timing import measure


class Box(jaxonomy.LeafSystem):
    """The box with its bristle; the parameters of the law by `declare_dynamic_parameter`."""

    def __init__(self, names: list[str], numbers: list[float], mass: float) -> None:
        super().__init__(name="box")
        self.mass = mass
        for name, number in zip(names, numbers, strict=True):
            self.declare_dynamic_parameter(name, number)
        self.declare_continuous_state(default_value=jnp.zeros(3), ode=self.rate)
        self.declare_continuous_state_output(name="state")

    def rate(self, t: Any, state: Any, *_: Any, **p: Any) -> Any:
        """Velocity, acceleration, and rate of the deflection."""
        _, v, z = state.continuous_state
        level = p["Fc"] + (p["Fs"] - p["Fc"]) * jnp.exp(-((v / p["vs"]) ** 2))
        rate = v - p["sigma0"] * jnp.abs(v) / level * z
        force = p["sigma0"] * z + p["sigma1"] * rate + p["sigma2"] * v
        return jnp.array([v, (t - force) / self.mass, rate])


def end_velocity(system: Any, method: str, rtol: float, task: dict[str, Any]) -> Any:
    """The velocity at the end as a function of the parameters, to be traced."""
    options = jaxonomy.SimulatorOptions(
        math_backend="jax", ode_solver_method=method, enable_autodiff=False, rtol=rtol, atol=task["atol"] * rtol
    )

    def end(p: Any) -> Any:
        context = system.create_context()
        for i, name in enumerate(task["parameters"]):
            context.parameters[name] = p[i]
        return jaxonomy.simulate(system, context, (0.0, task["t1"]), options=options).context.continuous_state[1]

    return end


def main() -> None:
    """Error of the end velocity at every tolerance, and the time of a run."""
    task = json.loads(sys.stdin.read())
    jax.config.update("jax_enable_x64", True)
    if task["tuned"]:
        jax.config.update("jax_cpu_enable_async_dispatch", False)
    p, system = jnp.asarray(task["nominal"]), Box(task["parameters"], task["nominal"], task["mass"])
    calls, ends = {}, {}
    for method in ("dopri5", "bdf"):
        for rtol in task["ladder"]:
            run, label = jax.jit(end_velocity(system, method, rtol, task)), f"{method} {rtol:g}"
            try:
                ends[label] = float(run(p))
            except Exception as error:  # a peer that fails is a result
                ends[label] = f"{type(error).__name__}: {str(error).strip().splitlines()[0][:200]}"
                continue
            if abs(ends[label] / task["v_end"] - 1.0) <= task["goal"]:
                calls[label] = lambda run=run: run(p).block_until_ready()
                break
    before = numpy_workload_s()
    found = {
        "versions": {name: importlib.metadata.version(name) for name in ("jaxonomy", "jax", "jaxlib", "numpy")},
        "ends": ends,
        "times": measure(calls, task["rounds"]),
        "numpy_workload_s": min(before, numpy_workload_s()),
    }
    print("RESULT", json.dumps(found))


if __name__ == "__main__":
    main()
