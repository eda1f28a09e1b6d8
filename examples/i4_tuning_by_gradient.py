"""Tuning by gradient: a friction law that follows a wanted record.

Adam on LuGre's sigma0, sigma1 and Fc, through the simulation; the start is wrong by factors of two to five.

Run it: `python examples/i4_tuning_by_gradient.py [--smoke] [--out DIR]`.
"""

import argparse
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from matplotlib.figure import Figure

import jaxmodsim as jms
from jaxmodsim.problems import ramped_box


def main(out: Path, smoke: bool = False) -> None:
    """Descend on the logarithms of the three numbers."""
    ts = jnp.linspace(0.0, 3.0, 151)

    def velocity(numbers):
        law = ramped_box.lugre(**{name: jnp.exp(x) for name, x in numbers.items()}, Fs=3.0)
        return jms.simulate(ramped_box.scene(law), [0.0], [0.0], 3.0, ts=ts).qd[:, 0]

    goal = velocity({"sigma0": jnp.log(750.0), "sigma1": jnp.log(20.0), "Fc": jnp.log(1.5)})
    start = numbers = {"sigma0": jnp.log(300.0), "sigma1": jnp.log(4.0), "Fc": jnp.log(1.0)}

    def cost(numbers):
        return jnp.mean((velocity(numbers) - goal) ** 2) / jnp.mean(goal**2)

    adam, costs = optax.adam(0.05), []
    step, state = eqx.filter_jit(jax.value_and_grad(cost)), adam.init(numbers)
    for _ in range(3 if smoke else 150):
        value, slope = step(numbers)
        update, state = adam.update(slope, state)
        numbers = optax.apply_updates(numbers, update)
        costs.append(float(value))
    print(", ".join(f"{name} {float(jnp.exp(x)):.4g}" for name, x in numbers.items()) + f"; cost {costs[-1]:.1e}")
    figure = Figure(figsize=(9, 4), layout="constrained")
    left, right = figure.subplots(1, 2)
    left.plot(ts, goal, color="#8a8a8a", lw=4, label="wanted")
    left.plot(ts, velocity(start), color="#c2452d", label="start")
    left.plot(ts, velocity(numbers), color="#1f5fa8", label="tuned")
    left.set(xlabel="time [s]", ylabel="velocity [m/s]")
    left.legend()
    right.semilogy(costs)
    right.set(xlabel="step", ylabel="relative mean square error")
    out.mkdir(parents=True, exist_ok=True)
    figure.savefig(out / "i4_tuning_by_gradient.png", dpi=110)
    print(f"wrote {out / 'i4_tuning_by_gradient.png'}")


if __name__ == "__main__":
    jms.tune_cpu()
    jax.config.update("jax_enable_x64", True)
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--smoke", action="store_true", help="small and quick")
    parser.add_argument("--out", type=Path, default=Path("example-output"))
    main(**vars(parser.parse_args()))
