"""Two coordinates, friction in a joint and on a rail, a push at a point: forces where they act.

A pendulum hangs from a cart on a rail. The rail has regularised Coulomb friction, the pivot LuGre friction along the
pendulum's angle, and a gust pushes the bob horizontally, given as a Cartesian force at the bob.

Run it: `python examples/a1_pendulum_on_cart.py [--smoke] [--out DIR]`.
"""

import argparse
from pathlib import Path

import jax
import jax.numpy as jnp
from matplotlib.figure import Figure

import jaxmodsim as jms


def bob(q):
    """Position of the bob [m]: q = (position of the cart [m], angle from straight down [rad])."""
    return jnp.stack([q[0] + 0.5 * jnp.sin(q[1]), -0.5 * jnp.cos(q[1])])


def lagrangian(t, q, qd, p):
    """Cart and bob, gravity along -y [J]."""
    position, velocity = jax.jvp(bob, (q,), (qd,))
    return 0.5 * p["cart"] * qd[0] ** 2 + 0.5 * p["bob"] * velocity @ velocity - p["bob"] * 9.81 * position[1]


def gust(t, q, qd, p):
    """A push on the bob for half a second [N]."""
    return jnp.stack([p["gust"] * jnp.exp(-(((t - 0.5) / 0.2) ** 2)), 0.0 * t])


def main(out: Path, smoke: bool = False) -> None:
    """Simulate, check the energy, differentiate the resting place of the cart."""
    scene = jms.Scene(
        lagrangian,
        params={"cart": 1.0, "bob": 0.3, "gust": 4.0},
        effects=(
            jms.AppliedForce(gust, at=bob, name="gust"),
            jms.Friction(jms.Regularized(jms.Coulomb(0.8), width=1e-3), along=lambda q: q[0], name="rail"),
            jms.Friction(
                jms.LuGre(sigma0=40.0, sigma1=0.05, sigma2=1e-3, Fc=0.02, Fs=0.03, vs=0.05),
                along=lambda q: q[1],
                name="pivot",
            ),
        ),
    )
    t1 = 2.0 if smoke else 8.0
    run = jms.simulate(scene, [0.0, 0.0], [0.0, 0.0], t1, ts=jnp.linspace(0.0, t1, 801))
    energy = run.energy
    print(f"{run.result} The gust brought in {energy.work_in[-1]:.4f} J, friction took {energy.dissipated[-1]:.4f} J,")
    print(f"the balance is off by {float(jnp.max(jnp.abs(energy.balance))):.1e} J.")

    def place(scene):
        return jms.simulate(scene, [0.0, 0.0], [0.0, 0.0], t1).q[-1, 0]

    end, gradient = jax.value_and_grad(place)(scene)
    print(f"The cart ends at {1e3 * end:.2f} mm; by the rail's Fc that changes")
    print(f"by {1e3 * float(gradient.effects[1].law.law.Fc):.1f} mm/N.")

    figure = Figure(figsize=(11, 5.5), layout="constrained")
    (a, b), (c, d) = figure.subplots(2, 2, sharex=True)
    a.plot(run.t, 1e3 * run.q[:, 0])
    a.set(ylabel="cart [mm]", title="Motion")
    c.plot(run.t, jnp.rad2deg(run.q[:, 1]))
    c.set(ylabel="angle [deg]", xlabel="time [s]")
    b.plot(run.t, run.forces["rail"], label="rail")
    b.set(ylabel="rail friction [N]", title="Friction")
    d.plot(run.t, 1e3 * run.forces["pivot"], color="#c2452d")
    d.set(ylabel="pivot friction [mN m]", xlabel="time [s]")
    out.mkdir(parents=True, exist_ok=True)
    figure.savefig(out / "a1_pendulum_on_cart.png", dpi=130)
    print(f"wrote {out / 'a1_pendulum_on_cart.png'}")


if __name__ == "__main__":
    jms.tune_cpu()
    jax.config.update("jax_enable_x64", True)
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--smoke", action="store_true", help="small and quick")
    parser.add_argument("--out", type=Path, default=Path("example-output"))
    arguments = parser.parse_args()
    main(arguments.out, arguments.smoke)
