# %% [markdown]
# # A record of your own
#
# An axis was moved by its drive: time, motor current and position are in CSV files, in the units of the drive. How
# heavy is it, and what friction does it have?

# %%
# %pip install -q "jaxmodsim[notebook]"

# %%
import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd

import jaxmodsim as jms
from jaxmodsim import identify, plot

jms.tune_cpu()
jax.config.update("jax_enable_x64", True)

# %% [markdown]
# In place of a measurement, a simulated axis with white noise of 20 um writes two files; put your own there.


# %%
def lagrangian(t, q, qd, p):
    return 0.5 * p["m"] * qd[0] ** 2


def drive(t, q, qd, p):
    return jnp.reshape(p["u"], (1,))


def axis(m, Fc, Fv):
    dry = jms.Friction(jms.Regularized(jms.Coulomb(Fc), width=2e-3), name="dry")
    effects = (jms.AppliedForce(drive), dry, jms.Friction(jms.Viscous(Fv), name="viscous"))
    return jms.Scene(lagrangian, {"m": m, "u": 0.0}, effects, coordinates=("x [m]",))


t, rest, rng = jnp.arange(0.0, 3.0, 2e-3), jnp.zeros(1), np.random.default_rng(0)
for name, slow, fast in (("axis_1", 60.0, 30.0), ("axis_2", 30.0, 40.0)):
    force = slow * jnp.sin(np.pi * t) + fast * jnp.sin(2.6 * np.pi * t)  # 12 N/A
    x = identify.replay(axis(24.0, 15.0, 40.0), t, {"u": force}, rest, rest, 10) + 2e-5 * rng.standard_normal(t.size)
    columns = {"time [ms]": 1e3 * t, "current [A]": force / 12.0, "position [mm]": 1e3 * x}
    pd.DataFrame(columns).to_csv(f"{name}.csv", index=False)

# %% [markdown]
# Read the files, and turn the units into seconds, newtons and metres. The second record is held out, to judge by.


# %%
def read(name):
    log = pd.read_csv(f"{name}.csv")
    return jms.Record(1e-3 * log["time [ms]"], 1e-3 * log["position [mm]"], {"u": 12.0 * log["current [A]"]}, name)


known, held_out = read("axis_1"), read("axis_2")

# %%
start = axis(m=10.0, Fc=5.0, Fv=10.0)  # wrong by factors of two to four
result = jms.fit(start, known, ("m", "dry.Fc", "viscous.Fv"), q0=[0.0], substeps=4, progress=True)
result

# %% [markdown]
# The truth was 24 kg, 15 N and 40 N s/m. What the records cannot tell, or the model misses, would be said here:

# %%
print(*identify.warnings_for(result) or ["No warnings."], sep="\n")
plot.fit_figure(result)

# %%
judged = identify.evaluate_on(result, held_out)
print(f"on the second record: {1e6 * judged.rmse['measured']:.1f} um, with noise of 20 um")

# %% [markdown]
# The same from the shell, without a line of code, models compared and a report written:
#
# `jaxmodsim fit axis_1.csv --held-out axis_2.csv --time "time [ms]" --position "position [mm]" --force "current [A]"
# --units force=12 --report report`
