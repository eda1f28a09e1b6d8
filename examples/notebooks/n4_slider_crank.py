# %% [markdown]
# # A mechanism: slider-crank
#
# Three bodies, two joints: each body by itself, the joints as constraints, and the forces in the joints come with the
# run. Nothing is reduced by hand.

# %%
# %pip install -q "jaxmodsim[notebook]"

# %%
import jax
import jax.numpy as jnp

import jaxmodsim as jms
from jaxmodsim import plot

jms.tune_cpu()
jax.config.update("jax_enable_x64", True)

# %% [markdown]
# Coordinates: the angles of crank and rod, and the place of the slider. Points lie in the plane of x and z, z upwards.


# %%
def tip(q, p):  # end of the crank
    return p["r"] * jnp.stack([jnp.cos(q[0]), 0.0, jnp.sin(q[0])])


def rod(q, p, share):  # a point of the rod
    return tip(q, p) + share * p["l"] * jnp.stack([jnp.cos(q[1]), 0.0, jnp.sin(q[1])])


def slider(q):
    return jnp.stack([q[2], 0.0 * q[2], 0.0 * q[2]])


crank_body = jms.rigid_body(
    lambda p: p["m1"], lambda p: p["m1"] * p["r"] ** 2 / 12, lambda q, p: 0.5 * tip(q, p), lambda q: q[0]
)
rod_body = jms.rigid_body(
    lambda p: p["m2"], lambda p: p["m2"] * p["l"] ** 2 / 12, lambda q, p: rod(q, p, 0.5), lambda q: q[1]
)
slider_body = jms.point_mass(lambda p: p["m3"], slider)


def gap(t, q, p):  # between the end of the rod and the slider, x and z
    return (rod(q, p, 1.0) - slider(q))[jnp.array([0, 2])]


scene = jms.Scene(
    crank_body + rod_body + slider_body,
    params={"m1": 0.6, "m2": 0.9, "m3": 1.4, "r": 0.3, "l": 0.8},
    effects=(
        jms.Friction(jms.Viscous(0.05), along=lambda q: q[0], name="bearing"),
        jms.Friction(jms.Regularized(jms.Coulomb(2.0), width=0.01), along=lambda q: q[2], name="guide"),
    ),
    constraints=(jms.Constraint(gap, name="pin"),),
    coordinates=("crank [rad]", "rod [rad]", "x [m]"),
)

# %% [markdown]
# `project_initial_state` moves an approximate start to the nearest state that closes the loop, in place and velocity.
# The crank, coordinate 0, keeps its angle and its speed.

# %%
q0, qd0 = jms.project_initial_state(scene, [0.6, -0.2, 1.0], [12.0, 0.0, 0.0], hold=(0,))
run = jms.simulate(scene, q0, qd0, 3.0, ts=jnp.linspace(0.0, 3.0, 601))
pin = run.reactions["pin"].multiplier
print(f"{run.result} The pin bears up to {float(jnp.max(jnp.linalg.norm(pin, axis=1))):.0f} N.")
plot.run(run)

# %% [markdown]
# The same, moving.


# %%
def links(q, p):
    return jnp.stack([jnp.zeros(3), tip(q, p), slider(q)])


plot.animate(run, links, fps=15)
