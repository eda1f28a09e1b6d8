"""What laws claim, over their whole parameter space: every number may be tiny or huge."""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

from jaxmodsim import Armstrong, Coulomb, Dahl, ElastoPlastic, LuGre, MaxwellSlip, Regularized, Stribeck
from jaxmodsim.friction import AbstractDynamicLaw

from ..helpers.law_cases import bristle, contact, elastic, elements, mirrored

# What a law is made of here: exponents of ten of a stiffness, a damping, a force and a velocity, and two shares.
Draw = tuple[Any, ...]


def dahl(k: Any, d: Any, f: Any, v: Any, a: Any, b: Any) -> Any:
    del d, v, a, b
    return Dahl(k, f)


def lugre(k: Any, d: Any, f: Any, v: Any, a: Any, b: Any) -> Any:
    # Passive by the condition sigma2 >= sigma1 (Fs - Fc)/Fc, met with equality where b = 0.
    return LuGre(k, d, d * a + d * b, f, f * (1.0 + a), v)


def elasto_plastic(k: Any, d: Any, f: Any, v: Any, a: Any, b: Any) -> Any:
    return ElastoPlastic(k, d, d * a + d * b, 0.98 * b * f, f, f * (1.0 + a), v)


def maxwell_slip(k: Any, d: Any, f: Any, v: Any, a: Any, b: Any) -> Any:
    stiffness, force = jnp.stack([k, 0.1 * k, 3.0 * k]), jnp.stack([f, 0.5 * f, 0.01 * f])
    return MaxwellSlip(stiffness, force, force * (1.0 + a), v, C=d * v, sigma2=d, corner=0.01 + 0.99 * b)


def armstrong(k: Any, d: Any, f: Any, v: Any, a: Any, b: Any) -> Any:
    return Armstrong(k, f, f * (1.0 + a), v, d, 1e-3 + b, 1e-2 + 10.0 * b)


def regularized(k: Any, d: Any, f: Any, v: Any, a: Any, b: Any) -> Any:
    del k
    return Regularized(Stribeck(f, f * (1.0 + a), v, d), 1e-3 * v + b * v)


def coulomb(k: Any, d: Any, f: Any, v: Any, a: Any, b: Any) -> Any:
    del k, d
    return Regularized(Coulomb(f, f * (1.0 + a)), v * (1e-6 + b))


LAWS = {
    "dahl": (dahl, bristle),
    "lugre": (lugre, bristle),
    "elasto-plastic": (elasto_plastic, bristle),
    "maxwell slip": (maxwell_slip, elements),
    "armstrong": (armstrong, contact),
    "regularized stribeck": (regularized, None),
    "regularized coulomb": (coulomb, None),
}


def limit_of(law: Any) -> Any:
    """Largest force of the elastic elements [N]."""
    base = getattr(law, "law", law)
    return jnp.sum(jnp.asarray(getattr(base, "Fs", base.Fc)))


@partial(jax.jit, static_argnums=0)
@partial(jax.vmap, in_axes=(None, 0))
def look(name: str, drawn: Any) -> dict[str, Any]:
    """Loss and its scale, the force and that of the mirrored state, the elastic force after a step, in limits.

    And the sizes of the parts that the force and the elastic force are sums of: what rounding goes by.
    """
    *numbers, v, share, dt = drawn
    build, loaded = LAWS[name]
    law = build(*numbers)
    if not isinstance(law, AbstractDynamicLaw):
        force, back, wet, limit = law.force(v), law.force(-v), law.law.viscous_force(v), limit_of(law)
        return {
            "loss": force * v,
            "scale": 0.0 * v,
            "force": force,
            "back": back,
            "parts": jnp.abs(force),
            "held": (force - wet) / limit,
            # A difference keeps the rounding of its parts, however small it is itself.
            "held_parts": 1.0 + jnp.abs(wet) / limit,
        }
    assert loaded is not None
    z = loaded(law, share)
    rate, force = law.zdot(v, z), law.force(v, z)
    stored = jax.jvp(law.stored_energy, (z,), (rate,))[1]
    spring = elastic(law, z, v)
    return {
        "loss": v * force - stored,
        "scale": jnp.abs(v) * (jnp.abs(force) + jnp.abs(spring)) + jnp.abs(stored),
        "force": force,
        "back": law.force(-v, mirrored(z)),
        "parts": jnp.abs(spring) + jnp.abs(force - spring),
        "held": elastic(law, law.step_exact(v, z, dt), v) / limit_of(law),
        "held_parts": 1.0 + 0.0 * v,
    }


def number(low: float, high: float) -> Any:
    """Ten to a power that is drawn."""
    return st.floats(low, high).map(lambda x: 10.0**x)


# At rest, too.
speeds = st.one_of(st.just(0.0), number(-9, 3)).flatmap(lambda v: st.sampled_from([v, -v]))
parameters = (number(1, 9), number(-3, 5), number(-3, 4), number(-5, 1), st.floats(0.0, 3.0), st.floats(0.0, 1.0))
# Many at once, because a call takes longer than what it computes.
draws = st.lists(st.tuples(*parameters, speeds, st.floats(-1.0, 1.0), number(-9, 3)), min_size=40, max_size=40)


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
@pytest.mark.parametrize("name", LAWS)
def test_dissipation_bound_and_symmetry_over_the_parameter_space(name: str, dtype: Any) -> None:
    eps = float(jnp.finfo(dtype).eps)

    def refuse(drawn: list[Draw], found: dict[str, Any], bad: Any) -> None:
        for i in np.flatnonzero(bad)[:1]:
            pytest.fail(f"{drawn[i]} gives { ({key: float(x[i]) for key, x in found.items()}) }")

    # Not shrunk: that takes minutes for so many numbers, and the message has the few that matter.
    @settings(
        max_examples=10,
        deadline=None,
        derandomize=True,
        phases=[Phase.generate],
        suppress_health_check=[HealthCheck.too_slow],
    )
    @given(draws)
    def check(drawn: list[Draw]) -> None:
        found = {key: np.asarray(x) for key, x in look(name, jnp.asarray(drawn, dtype)).items()}
        refuse(drawn, found, ~np.all([np.isfinite(x) for x in found.values()], axis=0))
        refuse(drawn, found, found["loss"] < -8 * eps * found["scale"])
        # Equal but for products and sums that XLA contracts into one rounding.
        refuse(drawn, found, abs(found["force"] + found["back"]) > 8 * eps * found["parts"])
        refuse(drawn, found, abs(found["held"]) > 1 + 8 * eps * found["held_parts"])

    check()
