"""The table of friction laws that the contract is held against."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxmodsim import (
    Armstrong,
    Bristle,
    Coulomb,
    Curve,
    Dahl,
    DeadZone,
    ElastoPlastic,
    Geared,
    LuGre,
    MaxwellSlip,
    Regularized,
    ServoGear,
    Sign,
    Stribeck,
    Viscous,
    asymmetric,
    scaled_by,
)
from jaxmodsim._core.parameters import modules_of
from jaxmodsim.friction import AbstractDynamicLaw, AbstractSetValuedLaw, ArmstrongState, LawCase, laws, lorentzian

# The state at which laws of scaled_by are looked at, and their factor there.
TIME, POSITION, VELOCITY = jnp.array(0.7), jnp.array([0.3]), jnp.array([0.9])
PARAMS = {"warm": jnp.array(0.5)}
FACTOR = (1.0 + 0.4 * 0.3) * 1.25


def factor(t: Any, q: Any, qd: Any, params: Any) -> Any:
    """A load that depends on position and temperature."""
    del t, qd
    return (1.0 + 0.4 * q[0]) * (1.0 + params["warm"] ** 2)


class Case(NamedTuple):
    """A law and what it claims.

    - `bound`: limit of the force less its viscous part.
    - `viscous`: coefficient of the viscous part, towards positive and negative velocity.
    - `level`: force in fast slip less its viscous part, either way.
    - `smooth`: whether the derivative by velocity exists at v = 0.
    - `loaded`: state of a dynamic law, from the law and the share of its static limit that it carries, with its sign.
    """

    law: Any
    bound: float
    level: tuple[float, float]
    viscous: tuple[float, float] = (0.0, 0.0)
    odd: bool = True
    smooth: bool = True
    loaded: Callable[[Any, Any], Any] | None = None


def bristle(law: Any, share: Any) -> Any:
    """State of a law with one bristle."""
    return share * getattr(law, "Fs", law.Fc) / law.sigma0


def elements(law: Any, share: Any) -> Any:
    """State of Maxwell slip, all elements alike."""
    return share * (law.Fc if law.Fs is None else law.Fs) / law.k


def contact(law: Any, share: Any) -> Any:
    """State of Armstrong's law, part of the stiction back."""
    rise = jnp.asarray(0.6, law.Fc.dtype)
    deflection = share * (law.Fc + (law.Fs - law.Fc) * rise) / law.sigma0
    return ArmstrongState(deflection, rise, 0.8 + 0.0 * rise, 0.9 * 0.02 * law.Fc / law.sigma0 + 0.0 * rise)


def deflection(law: Any, share: Any) -> Any:
    """State of a bristle whose limit is 1."""
    return jnp.asarray(share, law.h.dtype)


def forward(loaded: Callable[[Any, Any], Any]) -> Callable[[Any, Any], Any]:
    """State of an asymmetric law, from its law for positive slip."""
    return lambda law, share: loaded(law.forward, share)


def drag(v: Any) -> Any:
    """A friction curve of one's own."""
    return 1.2 * jnp.tanh(v / 0.05) + 0.3 * v


STRIBECK = Stribeck(Fc=1.5, Fs=1.75, vs=0.2, Fv=0.1)
# Passive: sigma2 is above sigma1 (Fs - Fc)/Fc = 2.
LUGRE = LuGre(sigma0=750.0, sigma1=12.0, sigma2=2.1, Fc=1.5, Fs=1.75, vs=0.2)
ELASTO = ElastoPlastic(sigma0=750.0, sigma1=12.0, sigma2=2.1, Fba=1.0, Fc=1.5, Fs=1.75, vs=0.2)
MAXWELL = MaxwellSlip(k=[500.0, 250.0, 80.0], Fc=[0.8, 0.4, 0.3], Fs=[0.9, 0.5, 0.35], vs=0.2, C=4.0, sigma2=0.1)
ARMSTRONG = Armstrong(sigma0=750.0, Fc=1.5, Fs=1.75, vs=0.2, Fv=0.1, tau=0.05, gamma=2.0)

# Under 1 N m of the motor and 0.8 N m against it: 0.1 + 0.215 N m at any speed, and 0.5 N m more at rest.
SERVO = ServoGear(
    1.0, -0.8, Kc=0.1, Kv=0.1, Kcs=0.2, vs=0.2, Km=0.135, Ke=0.1, Kms=0.2, Kes=0.0725, Kmq=0.1, Keq=0.065625
)

# A new law gets one entry here, and one with each modifier.
CASES = {
    "viscous": Case(Viscous(0.4), 0.0, (0.0, 0.0), (0.4, 0.4)),
    "curve": Case(Curve(drag, 1.5), 1.8, (1.8, 1.8), (0.45, 0.45)),
    "coulomb": Case(Coulomb(1.5, 2.5), 2.5, (1.5, 1.5), smooth=False),
    "stribeck": Case(STRIBECK, 1.75, (1.5, 1.5), (0.1, 0.1), smooth=False),
    "stribeck lorentzian": Case(
        Stribeck(1.5, 1.75, 0.2, 0.1, fall=lorentzian), 1.75, (1.5, 1.5), (0.1, 0.1), smooth=False
    ),
    "stribeck exponential": Case(Stribeck(1.5, 1.75, 0.2, exponent=1.0), 1.75, (1.5, 1.5), smooth=False),
    "regularized coulomb": Case(Regularized(Coulomb(1.5), 0.05), 1.5, (1.5, 1.5)),
    "regularized coulomb with stiction": Case(Regularized(Coulomb(1.5, 2.5), 0.05), 2.5, (1.5, 1.5)),
    "regularized stribeck": Case(Regularized(STRIBECK, 0.05), 1.75, (1.5, 1.5), (0.1, 0.1)),
    "regularized stribeck, exponent 1/2": Case(
        Regularized(Stribeck(1.5, 1.75, 0.2, exponent=0.5), 0.05), 1.75, (1.5, 1.5)
    ),
    "sign": Case(Sign(STRIBECK), 1.75, (1.5, 1.5), (0.1, 0.1), smooth=False),
    "dead zone": Case(DeadZone(STRIBECK, 0.01), 1.75, (1.5, 1.5), (0.1, 0.1), smooth=False),
    "dahl": Case(Dahl(750.0, 1.5), 1.5, (1.5, 1.5), loaded=bristle),
    "lugre": Case(LUGRE, 1.75, (1.5, 1.5), (2.1, 2.1), loaded=bristle),
    # Not passive at high speed with constant sigma1, but with one that fades.
    "lugre, fading sigma1": Case(
        LuGre(sigma0=750.0, sigma1=12.0, sigma2=1.9, Fc=1.5, Fs=1.75, vs=0.2, vd=0.1), 1.75, (1.5, 1.5), (1.9, 1.9),
        loaded=bristle,
    ),
    "elasto-plastic": Case(ELASTO, 1.75, (1.5, 1.5), (2.1, 2.1), loaded=bristle),
    "maxwell slip, one element": Case(MaxwellSlip(750.0, 1.5), 1.5, (1.5, 1.5), loaded=elements),
    "maxwell slip": Case(MAXWELL, 1.75, (1.5, 1.5), (0.1, 0.1), loaded=elements),
    "armstrong": Case(ARMSTRONG, 1.75, (1.5, 1.5), (0.1, 0.1), loaded=contact),

    "geared": Case(
        Geared(STRIBECK, 0.2, jnp.array(2.0), 0.3), 2.35, (1.9, 2.1), (0.1, 0.1), odd=False, smooth=False
    ),
    "servo gear": Case(SERVO, 0.815, (0.315, 0.315), (0.1, 0.1), smooth=False),
    "bristle": Case(Bristle(Coulomb(1.5), 2e-3), 1.5, (1.5, 1.5), loaded=deflection),
    "bristle geared": Case(
        Bristle(Geared(Coulomb(1.5), 0.2, jnp.array(2.0), 0.3), 2e-3), 2.1, (1.9, 2.1), odd=False, loaded=deflection
    ),

    "viscous asymmetric": Case(
        asymmetric(Viscous(0.4), Fv=0.7), 0.0, (0.0, 0.0), (0.4, 0.7), odd=False, smooth=False
    ),
    "curve asymmetric": Case(
        asymmetric(Curve(drag, 1.5), gain=1.0), 1.8, (1.8, 1.2), (0.45, 0.3), odd=False, smooth=False
    ),
    "coulomb asymmetric": Case(asymmetric(Coulomb(1.5), Fc=2.0), 2.0, (1.5, 2.0), odd=False, smooth=False),
    "regularized asymmetric": Case(
        asymmetric(Regularized(STRIBECK, 0.05), Fc=1.7, Fs=2.5, Fv=0.3), 2.5, (1.5, 1.7), (0.1, 0.3),
        odd=False, smooth=False,
    ),
    "sign asymmetric": Case(asymmetric(Sign(Coulomb(1.5)), Fc=2.0), 2.0, (1.5, 2.0), odd=False, smooth=False),
    "dead zone asymmetric": Case(
        asymmetric(DeadZone(Coulomb(1.5), 0.01), Fc=2.0), 2.0, (1.5, 2.0), odd=False, smooth=False
    ),
    "dahl asymmetric": Case(asymmetric(Dahl(750.0, 1.5), Fc=1.2), 1.5, (1.5, 1.2), odd=False, loaded=forward(bristle)),
    "lugre asymmetric": Case(
        asymmetric(LUGRE, Fc=1.6, sigma2=3.0), 1.75, (1.5, 1.6), (2.1, 3.0), odd=False, loaded=forward(bristle)
    ),
    "elasto-plastic asymmetric": Case(
        asymmetric(ELASTO, Fc=1.6, sigma2=3.0), 1.75, (1.5, 1.6), (2.1, 3.0), odd=False, loaded=forward(bristle)
    ),
    "maxwell slip asymmetric": Case(
        asymmetric(MAXWELL, Fc=[0.6, 0.3, 0.2]), 1.75, (1.5, 1.1), (0.1, 0.1), odd=False, loaded=forward(elements)
    ),
    "geared asymmetric": Case(
        asymmetric(Geared(STRIBECK, 0.2, jnp.array(2.0), 0.3), Fc=1.6, Fv=0.3), 2.35, (1.9, 2.2), (0.1, 0.3),
        odd=False, smooth=False,
    ),
    "servo gear asymmetric": Case(
        asymmetric(SERVO, Kc=0.2, Kv=0.3), 0.915, (0.315, 0.415), (0.1, 0.3), odd=False, smooth=False
    ),
    "bristle asymmetric": Case(
        asymmetric(Bristle(Coulomb(1.5), 2e-3), Fc=1.2), 1.5, (1.5, 1.2), odd=False, loaded=deflection
    ),
    "armstrong asymmetric": Case(
        asymmetric(ARMSTRONG, Fc=1.2), 1.75, (1.5, 1.2), (0.1, 0.1), odd=False, loaded=forward(contact)
    ),
}  # fmt: skip


def scaled(case: Case) -> Case:
    """The case of a law whose force depends on the state of the mechanism."""
    forward, backward = case.viscous
    level = (case.level[0] * FACTOR, case.level[1] * FACTOR)
    return case._replace(
        law=scaled_by(case.law, factor),
        bound=case.bound * FACTOR,
        level=level,
        viscous=(forward * FACTOR, backward * FACTOR),
    )


def cases_of_registered_laws() -> dict[str, Case]:
    """The table, and of each registered law that is not in it the first example, with what its closed form claims."""
    by_hand = {type(module) for case in CASES.values() for _, module in modules_of(case.law)}
    new = {name: law.cases()[0] for name, law in laws().items() if law not in by_hand and law.cases()}
    return CASES | {name.lower(): from_example(example) for name, example in new.items()}


def from_example(example: LawCase) -> Case:
    """What the force in steady slip claims, of a law without a state."""
    speeds = np.geomspace(1e-6, 1e6, 2001)
    far = example.steady(np.array([1e6, 2e6, -1e6, -2e6]))
    viscous = (float(far[1] - far[0]) / 1e6, float(far[2] - far[3]) / 1e6)
    dry = [
        abs(example.steady(side * speeds) - side * slope * speeds) for side, slope in zip((1, -1), viscous, strict=True)
    ]
    level = (float(dry[0][-1]), float(dry[1][-1]))
    return Case(example.law, float(np.max(dry)), level, viscous, odd=np.allclose(dry[0], dry[1]), smooth=False)


# Of each kind one, wrapped and asymmetric ones among them.
CASES |= {
    f"{name} scaled": scaled(CASES[name])
    for name in (
        "viscous", "curve", "coulomb", "stribeck", "regularized stribeck", "sign", "dead zone", "dahl", "lugre",
        "elasto-plastic", "maxwell slip", "armstrong", "regularized asymmetric", "lugre asymmetric",
        "geared", "servo gear", "bristle",
    )
}  # fmt: skip


def settled(law: Any) -> Any:
    """The law at the state of the table."""
    return law.bind_state(TIME, POSITION, VELOCITY, PARAMS)


def force(name: str, law: Any, v: Any, share: Any = 0.5) -> Any:
    """Force of the law of a case; a dynamic one is loaded to `share` of its limit, to the side of the slip."""
    law, case = settled(law), CASES[name]
    if isinstance(law, AbstractSetValuedLaw):
        return law.sliding_force(v) * jnp.sign(v) + law.viscous_force(v)
    if not isinstance(law, AbstractDynamicLaw):
        return law.force(v)
    assert case.loaded is not None
    return law.force(v, case.loaded(law, share * jnp.where(v < 0, -1.0, 1.0)))


def elastic(law: Any, z: Any, like: Any) -> Any:
    """Force of a dynamic law at rest: that of its elastic elements."""
    return law.force(jnp.zeros_like(like), z)


def mirrored(z: Any) -> Any:
    """The state seen from the other side."""
    return z._replace(z=-z.z) if isinstance(z, ArmstrongState) else jax.tree.map(jnp.negative, z)
