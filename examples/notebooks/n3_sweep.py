# %% [markdown]
# # A sweep: when does it chatter?
#
# A mass on a spring, carried by a belt, with friction that holds more than it brakes: at some speeds it sticks and
# slips, at others it slides on. Two numbers of the machine are varied, and each run is one cell of a map.

# %%
# %pip install -q "jaxmodsim[notebook]"

# %%
import jax
import jax.numpy as jnp
import numpy as np

import jaxmodsim as jms
from jaxmodsim import metrics, plot
from jaxmodsim.problems import belt_oscillator

jms.tune_cpu()
jax.config.update("jax_enable_x64", True)

belt = belt_oscillator.scene(law=jms.Coulomb(Fc=5.0, Fs=8.0), c=2.0)
belt

# %% [markdown]
# Numbers are varied by their names above; what is kept of a run is a metric, a name such as `q[0]`, or a function.

# %%
runs = jms.sweep(
    belt,
    over={"k": np.geomspace(20.0, 400.0, 24), "friction.belt_velocity": np.geomspace(0.04, 0.6, 24)},
    observe={"swing": (lambda run: 1e3 * jnp.ptp(run.q[:, 0]), "mm"), "share": metrics.stick_share()},
    q0=[0.0],
    qd0=[0.0],
    t1=12.0,
    ts=jnp.linspace(7.0, 12.0, 201),
    progress=True,
)
runs

# %% [markdown]
# The swing of the mass after seven seconds: in the dark part it has come to rest on the sliding belt.

# %%
plot.map2d(runs, "swing")

# %% [markdown]
# A result is an `xarray.Dataset`, with the numbers it follows from in its attributes.

# %%
at_100 = runs.sel(k=100.0, method="nearest")
slides = at_100["friction.belt_velocity"].where(at_100["swing"] < 1.0, drop=True)
print(f"with {float(at_100['k']):.0f} N/m it slides from {float(slides.min()):.2f} m/s on")
