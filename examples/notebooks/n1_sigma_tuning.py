# %% [markdown]
# # Tuning sigma0 and sigma1 by gradient
#
# In stick, a LuGre bristle is a spring: a mass on it rings, and gives way. Two wishes for a box of 2 kg whose pull
# rises by 1 N each second: at 1 N it has moved by 1 mm, and it does not ring. Adam of optax finds the numbers.

# %%
# %pip install -q "jaxmodsim[notebook]"

# %%
import jax
import jax.numpy as jnp
import optax

import jaxmodsim as jms
from jaxmodsim import plot
from jaxmodsim.problems import ramped_box

jms.tune_cpu()
jax.config.update("jax_enable_x64", True)

# %% [markdown]
# A run as a function of the two numbers. Their logarithms keep them positive, and make steps relative.

# %%
ts = jnp.linspace(0.0, 1.0, 101)


def pulled(numbers):
    law = ramped_box.lugre(**{name: jnp.exp(x) for name, x in numbers.items()})
    return jms.simulate(ramped_box.scene(law), q0=[0.0], qd0=[0.0], t1=1.0, ts=ts)


def cost(numbers):
    run = pulled(numbers)
    gives_way = 1e3 * run.q[-1, 0] - 1.0  # beyond the wanted millimetre [mm]
    rings = run.forces["friction"] - ts  # in calm stick, friction follows the pull of 1 N/s
    return gives_way**2 + 100.0 * jnp.mean(rings**2)


# %%
numbers = {"sigma0": jnp.log(300.0), "sigma1": jnp.log(5.0)}
before = pulled(numbers)
adam = optax.adam(0.1)
step, state = jax.jit(jax.value_and_grad(cost)), adam.init(numbers)
costs = []
for _ in range(300):
    value, slope = step(numbers)
    update, state = adam.update(slope, state)
    numbers = optax.apply_updates(numbers, update)
    costs.append(value)
sigma0, sigma1 = (float(jnp.exp(numbers[name])) for name in ("sigma0", "sigma1"))
print(f"sigma0 = {sigma0:.0f} N/m, sigma1 = {sigma1:.1f} N s/m; cost {costs[0]:.3g} to {costs[-1]:.2g}")
print(f"critical damping in stick: sigma1 = {jms.damping_sigma1(m=2.0, sigma0=sigma0, sigma2=0.1):.1f} N s/m")

# %%
after = pulled(numbers)
figure = plot.Figure(figsize=(9, 3), layout="constrained")
left, right = figure.subplots(1, 2)
for run, label in ((before, "start"), (after, "tuned")):
    left.plot(run.t, 1e3 * run.q[:, 0], label=label)
    right.plot(run.t, run.forces["friction"] - run.t, label=label)
left.set(xlabel="time [s]", ylabel="displacement [mm]")
left.legend()
right.set(xlabel="time [s]", ylabel="friction less pull [N]")
figure

# %% [markdown]
# A law with so much damping is no longer passive in fast slip, which the package can tell beforehand.

# %%
print(jms.check_passivity(ramped_box.lugre(sigma0=sigma0, sigma1=sigma1)))
