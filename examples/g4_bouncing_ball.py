"""Bouncing ball: infinitely many bounces in a finite time.

Events without a scene: `EventSolver` in plain diffrax. The bounces accumulate at 1.92 s; from there on the ball is held
on the floor. The height agrees with the closed form all the way.

Run it: `python examples/g4_bouncing_ball.py [--smoke] [--out DIR]`.
"""

import argparse
from pathlib import Path

import diffrax
import jax
import jax.numpy as jnp
from matplotlib.figure import Figure

import jaxmodsim as jms
from jaxmodsim.problems import bouncing_ball


def main(out: Path, smoke: bool = False) -> None:
    """Drop it, hold it, and compare; --smoke changes nothing."""
    ball, h, e, t1 = bouncing_ball.BouncingBall(e=0.62), 1.0, 0.62, 3.0
    solver = jms.EventSolver(diffrax.Tsit5(), ball.guards, ball.reset, carries_on=True, max_events=64)
    done = diffrax.diffeqsolve(
        diffrax.ODETerm(ball.field),
        solver,
        0.0,
        t1,
        None,
        solver.start(0.0, ball.dropped(h=h), mode=0.0),
        saveat=diffrax.SaveAt(ts=jnp.linspace(0.0, t1, 1501)),
        stepsize_controller=jms.EventController(diffrax.PIDController(rtol=1e-8, atol=1e-10)),
    )
    exact, _ = bouncing_ball.motion(done.ts, h=h, e=e)
    print(f"at rest from {float(bouncing_ball.rest(h=h, e=e)):.4f} s on, by the closed form")
    print(f"largest error of the height: {float(jnp.max(jnp.abs(done.ys.y[:, 0] - exact))):.1e} m")
    figure = Figure(figsize=(8, 4), layout="constrained")
    axis = figure.subplots()
    axis.plot(done.ts, done.ys.y[:, 0], color="#1f5fa8", label="simulated")
    axis.plot(done.ts[::30], exact[::30], "o", ms=3, color="#c2452d", label="closed form")
    axis.set(xlabel="time [s]", ylabel="height [m]", title="A ball that keeps 62 % of its speed at each bounce")
    axis.legend()
    out.mkdir(parents=True, exist_ok=True)
    figure.savefig(out / "g4_bouncing_ball.png", dpi=110)
    print(f"wrote {out / 'g4_bouncing_ball.png'}")


if __name__ == "__main__":
    jms.tune_cpu()
    jax.config.update("jax_enable_x64", True)
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--smoke", action="store_true", help="small and quick")
    parser.add_argument("--out", type=Path, default=Path("example-output"))
    main(**vars(parser.parse_args()))
