"""Hard cases in jaxonomy, which pins a JAX of its own and so runs in an environment of its own.

Started by `_hard_elsewhere.py` with the interpreter of that environment. Reads the name of a case and its numbers as
JSON from its input; prints `READY` when all is imported, and a line `RESULT` with `value` or `error`. Stick and bounces
are modes and zero crossings, as its documentation has them; a box that has not begun to slip is a mode of its own.
"""

import importlib.metadata
import json
import math
import sys
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import jaxonomy


class Bristle(jaxonomy.LeafSystem):
    """A box on a LuGre bristle under a force that rises with time: velocity and deflection."""

    def __init__(self, p: dict[str, float]) -> None:
        super().__init__(name="bristle")
        self.p = p
        self.declare_continuous_state(default_value=jnp.zeros(2), ode=self.rate)

    def rate(self, t: Any, state: Any, *_: Any, **__: Any) -> Any:
        """Acceleration, and rate of the deflection."""
        p, (v, z) = self.p, state.continuous_state
        level = p["Fc"] + (p["Fs"] - p["Fc"]) * jnp.exp(-((v / p["vs"]) ** 2))
        slide = v - p["sigma0"] * jnp.abs(v) / level * z
        force = p["sigma0"] * z + p["sigma1"] * slide + p["sigma2"] * v
        return jnp.array([(p["ramp"] * t - force) / p["m"], slide])


class Box(jaxonomy.LeafSystem):
    """A box under a force that rises with time: mode 0, stick, and 1, slip along the force."""

    def __init__(self, p: dict[str, float]) -> None:
        super().__init__(name="box")
        self.p = p
        self.declare_continuous_state(default_value=jnp.zeros(1), ode=self.rate)
        self.declare_default_mode(0)
        self.declare_zero_crossing(
            self.load_left, None, start_mode=0, end_mode=1, direction="positive_then_non_positive"
        )

    def rate(self, t: Any, state: Any, *_: Any, **__: Any) -> Any:
        """Acceleration."""
        p = self.p
        return jnp.where(state.mode == 0, 0.0, (p["ramp"] * t - p["Fc"]) / p["m"])[None]

    def load_left(self, t: Any, state: Any, *_: Any, **__: Any) -> Any:
        """Force that stick can still take [N]."""
        del state
        return self.p["Fc"] - self.p["ramp"] * t


class Ball(jaxonomy.LeafSystem):
    """A ball thrown up or dropped: height, velocity and the time of the last event; a floor, or a ceiling."""

    def __init__(self, p: dict[str, float]) -> None:
        super().__init__(name="ball")
        self.p = p
        start = jnp.array([p["y0"], p["v0"], -1.0])
        self.declare_continuous_state(default_value=start, ode=self.rate)
        self.declare_zero_crossing(self.room, self.meet, direction="positive_then_non_positive")

    def rate(self, t: Any, state: Any, *_: Any, **__: Any) -> Any:
        """Velocity and acceleration."""
        del t
        return jnp.array([state.continuous_state[1], -self.p["g"], 0.0])

    def room(self, t: Any, state: Any, *_: Any, **__: Any) -> Any:
        """Distance from the floor, or from the ceiling [m]."""
        del t
        height = state.continuous_state[0]
        return self.p["ceiling"] - height if "ceiling" in self.p else height

    def meet(self, t: Any, state: Any, *_: Any, **__: Any) -> Any:
        """Note the time; bounce off the floor."""
        y, v, _last = state.continuous_state
        if "ceiling" in self.p:
            return state.with_continuous_state(jnp.array([y, v, t]))
        return state.with_continuous_state(jnp.array([0.0, -self.p["e"] * v, t]))


# System, its start as a function of the case's numbers, and which of its states is the answer.
CASES: dict[str, tuple[Callable[[dict[str, float]], Any], int]] = {
    "bristle_stiff": (Bristle, 0),
    "zero_start": (Box, 0),
    "bouncing_ball": (Ball, 2),
    "grazing_ceiling": (Ball, 2),
}


def main() -> None:
    """Run the case."""
    jax.config.update("jax_enable_x64", True)
    task = json.loads(sys.stdin.readline())
    print("READY", flush=True)
    make, index = CASES[task["case"]]
    versions = {"versions": {"jaxonomy": importlib.metadata.version("jaxonomy")}}
    try:
        system = make(task["numbers"])
        options = jaxonomy.SimulatorOptions(
            math_backend="jax", ode_solver_method=task["method"], rtol=task["rtol"], atol=task["atol"]
        )
        run = jaxonomy.simulate(system, system.create_context(), (0.0, task["t1"]), options=options)
        value = float(run.context.continuous_state[index])
        found = {"value": value if math.isfinite(value) else str(value)}
    except Exception as error:  # a peer that fails is a result
        found = {"error": f"{type(error).__name__}: {(str(error).strip().splitlines() or ['without words'])[0][:200]}"}
    print("RESULT", json.dumps(found | versions), flush=True)


if __name__ == "__main__":
    main()
