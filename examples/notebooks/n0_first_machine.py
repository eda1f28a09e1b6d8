# %% [markdown]
# # A first machine: a belt drive
#
# A motor turns a pulley, an elastic belt pulls a carriage, and the guide of the carriage sticks. Two coordinates: the
# angle of the motor and the position of the carriage. The torque comes from a CSV file.

# %%
# %pip install -q "jaxmodsim[notebook]"

# %%
import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd

import jaxmodsim as jms
from jaxmodsim import plot

jms.tune_cpu()
jax.config.update("jax_enable_x64", True)

# %% [markdown]
# The drive's logger would write the torque. Here it is made: back and forth, and then a slow rise from rest.

# %%
t = np.arange(0.0, 3.0, 0.02)
torque = np.select([t < 0.5, t < 1.0, t < 1.5], [0.8, -0.8, 0.0], 0.4 * (t - 1.5))
pd.DataFrame({"time [s]": t, "torque [N m]": torque}).to_csv("torque.csv", index=False)

log = pd.read_csv("torque.csv")
log.tail(3)


# %% [markdown]
# Energy as on paper, then the effects: the torque, the damping of the belt, and dry friction in the guide.


# %%
def lagrangian(t, q, qd, p):
    angle, x = q
    kinetic = 0.5 * p["J"] * qd[0] ** 2 + 0.5 * p["m"] * qd[1] ** 2
    return kinetic - 0.5 * p["k"] * (p["r"] * angle - x) ** 2


def motor(t, q, qd, p):
    return jnp.array([p["torque"], 0.0])


def stretch(q, p):
    return p["r"] * q[0] - q[1]


scene = jms.Scene(
    lagrangian,
    params={"J": 4e-4, "m": 3.0, "k": 6e3, "r": 0.03, "torque": jms.Signal(log["time [s]"], log["torque [N m]"])},
    effects=(
        jms.AppliedForce(motor, name="motor"),
        jms.Friction(jms.Viscous(20.0), along=stretch, name="belt"),
        jms.Friction(jms.Coulomb(Fc=8.0, Fs=10.0), along=lambda q: q[1], name="guide"),
    ),
    coordinates=("angle [rad]", "x [m]"),
)
scene

# %%
run = jms.simulate(scene, q0=[0.0, 0.0], qd0=[0.0, 0.0], t1=3.0, ts=jnp.linspace(0.0, 3.0, 1501))
print(run)

# %% [markdown]
# A figure shows itself; where the guide sticks is shaded.

# %%
plot.run(run)

# %% [markdown]
# What sticks, when, and what it costs: events in words, the energy, and a table for everything else.

# %%
for change in run.mode_changes:
    print(f"{change.t:.3f} s, {change.effect}: {change.before} to {change.after}")
print(f"{float(run.energy.dissipated[-1]):.1f} J are lost to friction")
run.to_dataframe().iloc[::300]
