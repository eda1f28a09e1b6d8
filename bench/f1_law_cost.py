"""What a friction law costs: one evaluation of its force, and of the gradient of that, relative to Coulomb.

The evaluation is what a solver asks of a law at one state: the force and, of a law with a state, its rate. The gradient
is by velocity, state and every parameter, in reverse mode. A call alone would cost the hand-over from Python to
compiled code and nothing else; so many evaluations run in one loop, each of which depends on the last.
"""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from _measure import machine_line, measure
from _options import begin
from _report import new_result, write_result

import jaxmodsim as jms
from jaxmodsim.friction import AbstractDynamicLaw, AbstractSetValuedLaw

BATCH, LOOP = 4096, 2000
NUMBERS = {"sigma0": 1e4, "sigma1": 20.0, "sigma2": 0.4, "Fc": 1.0, "Fs": 1.5, "vs": 0.01}


def warmth(t: Any, q: Any, qd: Any, params: Any) -> Any:
    """A factor that depends on the place."""
    del t, qd, params
    return 1.0 + 0.1 * jnp.sin(q[0])


def laws() -> dict[str, Any]:
    """The laws of the bench."""
    stribeck = jms.Stribeck(Fc=1.0, Fs=1.5, vs=0.01, Fv=0.4)
    return {
        "Coulomb": jms.Coulomb(1.0, 1.5),
        "Viscous": jms.Viscous(0.4),
        "Stribeck": stribeck,
        "Regularized(Coulomb)": jms.Regularized(jms.Coulomb(1.0), 1e-3),
        "Regularized(Stribeck)": jms.Regularized(stribeck, 1e-3),
        "DeadZone(Stribeck)": jms.DeadZone(stribeck, 1e-3),
        "Dahl": jms.Dahl(1e4, 1.0),
        "LuGre": jms.LuGre(**NUMBERS),
        "LuGre, vd": jms.LuGre(**NUMBERS, vd=0.1),
        "LuGre, in the plane": jms.LuGre(**NUMBERS),
        "ElastoPlastic": jms.ElastoPlastic(**NUMBERS, Fba=0.7),
        "MaxwellSlip, 1 element": jms.MaxwellSlip(1e4, 1.0),
        "MaxwellSlip, 4 elements": jms.MaxwellSlip([4e3, 3e3, 2e3, 1e3], [0.25] * 4),
        "MaxwellSlip, 8 elements, Fs and C": jms.MaxwellSlip([1e3] * 8, [0.125] * 8, [0.2] * 8, 0.01, C=10.0),
        "Armstrong": jms.Armstrong(1e4, 1.0, 1.5, 0.01, 0.4, 0.01, 1.0),
        "asymmetric(LuGre)": jms.asymmetric(jms.LuGre(**NUMBERS), Fc=1.2),
        "scaled_by(LuGre)": jms.scaled_by(jms.LuGre(**NUMBERS), warmth),
    }


def evaluate(law: Any, v: Any, z: Any) -> Any:
    """Force and rate at one state, in one number."""
    law = law.bind_state(jnp.zeros(()), jnp.reshape(jnp.ravel(v)[0], (1,)), jnp.zeros(1), {})
    if isinstance(law, AbstractSetValuedLaw):
        return law.sliding_force(v) * jnp.sign(v) + law.viscous_force(v)
    if not isinstance(law, AbstractDynamicLaw):
        return law.force(v)
    rates = jax.tree.leaves(law.zdot(v, z))
    return jnp.sum(law.force(v, z)) + sum(jnp.sum(rate) for rate in rates)


@partial(jax.jit, static_argnums=0)
def chain(differentiate: bool, law: Any, v: Any, z: Any) -> Any:
    """So many evaluations one after the other."""

    def once(_: Any, v: Any) -> Any:
        if not differentiate:
            return v + 1e-9 * evaluate(law, v, z)
        slopes = jax.tree.leaves(jax.grad(evaluate, argnums=(0, 1, 2))(law, v, z))
        return v + 1e-15 * sum(jnp.sum(slope) for slope in slopes)

    return jax.lax.fori_loop(0, LOOP, once, v)


@partial(jax.jit, static_argnums=0)
def batch(differentiate: bool, law: Any, v: Any, z: Any) -> Any:
    """One evaluation in each of many lanes, each with numbers of its own."""
    fn = jax.grad(evaluate, argnums=(0, 1, 2)) if differentiate else evaluate
    return jax.vmap(fn)(law, v, z)


def calls(name: str, law: Any) -> dict[str, Any]:
    """What is timed of a law."""
    v = jnp.full((2,), 0.013) if "plane" in name else jnp.asarray(0.013)
    z = law.initial_state(v) if isinstance(law, AbstractDynamicLaw) else jnp.zeros(())
    many = jax.tree.map(lambda x: jnp.broadcast_to(x, (BATCH, *jnp.shape(x))) * 1.0, (law, v, z))
    found = {}
    for kind, differentiate in (("force", False), ("gradient", True)):
        found[f"{kind}, alone"] = lambda d=differentiate: jax.block_until_ready(chain(d, law, v, z))
        found[f"{kind}, vmap"] = lambda d=differentiate: jax.block_until_ready(batch(d, *many))
    return found


def main() -> None:
    """Time every law in turns with all others, and write `law_cost.json`."""
    options = begin(
        "Cost of one evaluation of each friction law.",
        smoke="one round, to a temporary folder",
    )
    timed = {name: calls(name, law) for name, law in laws().items()}
    flat = {f"{name}: {kind}": call for name, of in timed.items() for kind, call in of.items()}
    report = measure(flat, rounds=1 if options.smoke else 30)
    per_call = {"alone": LOOP, "vmap": BATCH}
    kinds = list(timed["Coulomb"])
    seconds = {
        name: {kind: report[f"{name}: {kind}"]["median_s"] / per_call[kind.split()[-1]] for kind in kinds}
        for name in timed
    }
    base = seconds["Coulomb"]
    rows = [[name, *(f"{of[kind] / base[kind]:.2g}" for kind in kinds)] for name, of in seconds.items()]
    rows.append(["Coulomb [ns]", *(f"{1e9 * base[kind]:.3g}" for kind in kinds)])
    content = new_result("law_cost", options) | {"seconds": seconds}
    caption = (
        "Time of one evaluation (force and rate) and of its gradient, in Coulomb's: one after the other, and per lane"
        f" of vmap({BATCH}) with parameters of its own; medians, all in one process. {machine_line(content['machine'])}"
    )
    content["tables"] = [{"columns": ["law", *kinds], "rows": rows, "caption": caption}]
    write_result(content, options)


if __name__ == "__main__":
    main()
