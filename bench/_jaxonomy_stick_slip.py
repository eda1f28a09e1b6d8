"""The belt oscillator in jaxonomy, which pins a JAX of its own and so runs in an environment of its own.

Started by `d0_stick_slip.py` with the interpreter of that environment; reads what to do as JSON from its input and
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
import numpy as np
from _workload import numpy_workload_s

# jaxmodsim is not there; its timing needs nothing but Python.
sys.path.append(str(Path(__file__).parents[1] / "jaxmodsim" / "_core"))
from timing import measure


class BeltOscillator(jaxonomy.LeafSystem):
    """Modes 0, stick, and 1, slip against the belt, with a guard that ends each."""

    def __init__(self) -> None:
        super().__init__(name="belt_oscillator")
        for name in ("Fc", "Fs", "k", "m", "vb"):
            self.declare_dynamic_parameter(name, 1.0)
        self.declare_continuous_state(default_value=jnp.zeros(2), ode=self.rate)
        self.declare_continuous_state_output(name="state")
        self.declare_default_mode(0)
        self.declare_zero_crossing(
            self.load_left, None, start_mode=0, end_mode=1, direction="positive_then_non_positive"
        )
        self.declare_zero_crossing(
            self.slip_velocity, self.stop, start_mode=1, end_mode=0, direction="negative_then_non_negative"
        )

    def rate(self, t: Any, state: Any, *_: Any, **p: Any) -> Any:
        """Velocity and acceleration."""
        del t
        x, v = state.continuous_state
        return jnp.array([v, jnp.where(state.mode == 0, 0.0, (p["Fc"] - p["k"] * x) / p["m"])])

    def load_left(self, t: Any, state: Any, *_: Any, **p: Any) -> Any:
        """Force that stick can still take [N]."""
        del t
        return p["Fs"] - p["k"] * state.continuous_state[0]

    def slip_velocity(self, t: Any, state: Any, *_: Any, **p: Any) -> Any:
        """Velocity relative to the belt [m/s]."""
        del t
        return state.continuous_state[1] - p["vb"]

    def stop(self, t: Any, state: Any, *_: Any, **p: Any) -> Any:
        """Take the velocity of the belt."""
        del t
        return state.with_continuous_state(jnp.array([state.continuous_state[0], p["vb"]]))


def end_position(system: Any, rtol: float, task: dict[str, Any], autodiff: bool) -> Any:
    """The position at the end as a function of (Fc, Fs, k, m, vb), to be traced."""
    options = jaxonomy.SimulatorOptions(
        math_backend="jax",
        enable_autodiff=autodiff,
        max_major_steps=task["max_events"],
        rtol=rtol,
        atol=task["atol"] * rtol,
    )

    def end(p: Any) -> Any:
        context = system.create_context().with_continuous_state(jnp.stack([jnp.zeros(()), p[4]]))
        for i, name in enumerate(("Fc", "Fs", "k", "m", "vb")):
            context.parameters[name] = p[i]
        run = jaxonomy.simulate(system, context, (0.0, task["t1"]), options=options)
        return run.context.continuous_state[0]

    return end


def main() -> None:
    """Errors at every tolerance; then the times of a run and of a gradient at those wanted."""
    task = json.loads(sys.stdin.read())
    jax.config.update("jax_enable_x64", True)
    if task["tuned"]:
        jax.config.update("jax_cpu_enable_async_dispatch", False)
    p, sets, system = jnp.asarray(task["nominal"]), jnp.asarray(task["sets"]), BeltOscillator()
    runs = {rtol: jax.jit(end_position(system, rtol, task, False)) for rtol in task["ladder"]}
    ends = {rtol: [float(run(row)) for row in sets] for rtol, run in runs.items()}
    gradient = jax.jit(jax.grad(end_position(system, task["rtol"], task, True)))
    calls = {f"run {rtol:g}": lambda run=run: run(p).block_until_ready() for rtol, run in runs.items()}
    calls["gradient"] = lambda: gradient(p).block_until_ready()
    before = numpy_workload_s()
    found = {
        "versions": {name: importlib.metadata.version(name) for name in ("jaxonomy", "jax", "jaxlib", "numpy")},
        "times": measure(calls, task["rounds"]),
        "ends": [[rtol, values] for rtol, values in ends.items()],
        "gradient": np.asarray(gradient(p)).tolist(),
        "numpy_workload_s": min(before, numpy_workload_s()),
    }
    print("RESULT", json.dumps(found))


if __name__ == "__main__":
    main()
