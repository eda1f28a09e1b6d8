"""Wear of an axis: the level of its friction, followed by a Kalman filter while the axis moves.

The record is that of an axis of 1 kg under a sinusoidal force, whose friction rises by half from 8 s on.
`FrictionFilter` estimates the level with its 95 % band. The axis counts as worn when the lower limit exceeds 1.1.

Run it: `python examples/k1_wear_monitor.py [--smoke] [--out DIR]`.
"""

import argparse
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

import jaxmodsim as jms
from jaxmodsim.control import FrictionFilter
from jaxmodsim.scene import State, replace_elements, scene_step

LEVEL, HEALTHY, NOISE, H = "friction.normal_force", 1.1, 1e-5, 5e-3
# Steps of the true motion in one of the filter, whose own steps would be too good a model.
FINE = 100


def energy(_t, _q, qd, p):
    """Kinetic energy [J]."""
    return 0.5 * p["m"] * qd[0] ** 2


def motor(_t, _q, _qd, p):
    """Force of the motor [N]."""
    return jnp.reshape(p["u"], (1,))


def true_level(t):
    """Friction over that of a new axis."""
    return 1.0 + 0.5 * jnp.clip((t - 8.0) / 12.0, 0.0, 1.0)


def record(axis, t, u):
    """Measured positions [m], shape `[time, 1]`."""

    def step(y, each):
        t0, u = each
        worn = replace_elements(axis, {"u": u, LEVEL: true_level(t0)})
        h = H / FINE
        y = jax.lax.fori_loop(0, FINE, lambda k, y: scene_step(worn, t0 + k * h, t0 + k * h + h, y)[0], y)
        return y, y.q

    rest = State(jnp.zeros(1), jnp.zeros(1), axis.initial_state(jnp.zeros(1)))
    _, q = jax.lax.scan(step, rest, (t[:-1], u[:-1]))
    return jnp.concatenate([rest.q[None], q]) + NOISE * jax.random.normal(jax.random.key(0), (t.size, 1))


def main(out: Path, smoke: bool = False) -> None:
    """Make the record, filter it, say when its band left the limit, and draw it."""
    law = jms.LuGre(sigma0=1e4, sigma1=100.0, sigma2=1.0, Fc=2.0, Fs=3.0, vs=0.02)
    axis = jms.Scene(energy, {"m": 1.0, "u": 0.0}, (jms.AppliedForce(motor), jms.Friction(law, normal_force=1.0)))
    t = jnp.arange(0.0, 4.0 if smoke else 25.0, H)
    u = 6.0 * jnp.sin(2.0 * jnp.pi * t)
    drift = {"qd[0]": 0.02, "friction.z": 1e-4, LEVEL: 0.05}
    monitor = FrictionFilter(axis, NOISE, drift, numbers=(LEVEL,), rest=5e-3)
    start = monitor.start([0.0], [0.0], {"qd[0]": 0.01, LEVEL: 0.2})
    level, low, high = map(np.asarray, monitor.run(t, record(axis, t, u), {"u": u}, start).band(LEVEL))
    left = np.flatnonzero(low > HEALTHY)
    where = f"at {t[left[0]]:.1f} s, true level {true_level(t[left[0]]):.2f}" if left.size else "not yet"
    print(f"worn: the band exceeds {HEALTHY:g} {where}")
    print(f"at the end: level {level[-1]:.2f}, 95 % from {low[-1]:.2f} to {high[-1]:.2f}")
    figure = Figure(figsize=(8, 4), layout="constrained")
    axes = figure.subplots()
    axes.fill_between(t, low, high, color="#1f5fa8", alpha=0.25, label="95 % band")
    axes.plot(t, level, color="#1f5fa8", label="estimate")
    axes.plot(t, true_level(t), "--", color="#333333", label="true")
    axes.axhline(HEALTHY, color="#c2452d", lw=1.0, label="limit of a healthy axis")
    if left.size:
        axes.axvline(
            float(t[left[0]]), color="#c2452d", ls=":", label=f"band above the limit from {t[left[0]]:.1f} s on"
        )
    axes.set(xlabel="time [s]", ylabel="friction over that of a new axis [-]", ylim=(0.7, 1.7))
    axes.legend(fontsize=9, loc="upper left")
    out.mkdir(parents=True, exist_ok=True)
    figure.savefig(out / "k1_wear_monitor.png", dpi=110)
    print(f"wrote {out / 'k1_wear_monitor.png'}")


if __name__ == "__main__":
    jms.tune_cpu()
    jax.config.update("jax_enable_x64", True)
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--smoke", action="store_true", help="small and quick")
    parser.add_argument("--out", type=Path, default=Path("example-output"))
    main(**vars(parser.parse_args()))
