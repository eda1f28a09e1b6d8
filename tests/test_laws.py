"""The contract of friction laws: one table, and everything that each law in it must keep."""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmodsim import Coulomb, DeadZone, LuGre, Regularized, Sign, Stribeck, Viscous, asymmetric, friction
from jaxmodsim.friction import AbstractDynamicLaw
from jaxmodsim.numerics import modules_of, ranges_of

from .differences import flat, gradient_by_differences

BRISTLE = LuGre(sigma0=750.0, sigma1=0.0, sigma2=0.1, Fc=1.5, Fs=1.75, vs=0.2)
STRIBECK = Stribeck(Fc=1.5, Fs=1.75, vs=0.2, Fv=0.1)


class Case(NamedTuple):
    """A law and what it claims.

    - `bound`: limit of the force less its viscous part; None where it claims none.
    - `viscous`: coefficient of the viscous part, towards positive and negative velocity.
    - `smooth`: whether the derivative by velocity exists at v = 0.
    """

    law: Any
    bound: float | None
    viscous: tuple[float, float] = (0.0, 0.0)
    odd: bool = True
    smooth: bool = True


# A new law gets one entry here.
CASES = {
    "viscous": Case(Viscous(0.4), 0.0, (0.4, 0.4)),
    "viscous asymmetric": Case(asymmetric(Viscous(0.4), Fv=0.7), 0.0, (0.4, 0.7), odd=False, smooth=False),
    "regularized coulomb": Case(Regularized(Coulomb(1.5), 0.05), 1.5),
    "regularized coulomb with stiction": Case(Regularized(Coulomb(1.5, 2.5), 0.05), 2.5),
    "regularized stribeck": Case(Regularized(STRIBECK, 0.05), 1.75, (0.1, 0.1)),
    "regularized stribeck, exponent 1/2": Case(Regularized(Stribeck(1.5, 1.75, 0.2, exponent=0.5), 0.05), 1.75),
    "regularized coulomb asymmetric": Case(
        Regularized(asymmetric(Coulomb(1.5), Fc=2.0), 0.05), 2.0, odd=False, smooth=False
    ),
    "regularized stribeck asymmetric": Case(
        Regularized(asymmetric(STRIBECK, Fc=1.7, Fs=2.5, Fv=0.3), 0.05), 2.5, (0.1, 0.3), odd=False, smooth=False
    ),
    "sign": Case(Sign(STRIBECK), 1.75, (0.1, 0.1), smooth=False),
    "dead zone": Case(DeadZone(STRIBECK, 0.01), 1.75, (0.1, 0.1), smooth=False),
    "dead zone asymmetric": Case(
        DeadZone(asymmetric(Coulomb(1.5), Fc=2.0), 0.01), 2.0, odd=False, smooth=False
    ),
    # Passive: sigma2 is above sigma1 (Fs - Fc)/Fc = 2.
    "lugre": Case(LuGre(sigma0=750.0, sigma1=12.0, sigma2=2.1, Fc=1.5, Fs=1.75, vs=0.2), 1.75, (2.1, 2.1)),
}  # fmt: skip

every_law = pytest.mark.parametrize("name", CASES)

# Slip velocities [m/s] from presliding to fast slip, of both signs, none within a step of a finite difference of zero.
SPEEDS = np.array([0.003, 0.02, 0.0417, 0.11, 0.35, 1.3, 7.0])
SLIPS = jnp.asarray(np.concatenate([-SPEEDS[::-1], SPEEDS]))


def force(law: Any, v: Any, load: float = 0.5) -> Any:
    """Force of any law; a bristle is deflected to `load` of its largest deflection, to the side of the slip."""
    if isinstance(law, AbstractDynamicLaw):
        assert isinstance(law, LuGre)
        return law.force(v, load * jnp.sign(v) * law.Fs / law.sigma0)
    return law.force(v)


forces: Callable[..., jax.Array] = jax.jit(jax.vmap(force, in_axes=(None, 0)))


@pytest.mark.quick
@every_law
def test_dissipation_is_never_negative(name: str) -> None:
    law = CASES[name].law
    if isinstance(law, LuGre):
        # All velocities at all deflections, less the power that goes into the bristle's spring.
        v, z = map(jnp.ravel, jnp.meshgrid(SLIPS, jnp.linspace(-1.0, 1.0, 21) * law.Fs / law.sigma0))
        lost = jax.vmap(lambda v, z: v * law.force(v, z) - jax.grad(law.stored)(z) * law.rate(v, z))(v, z)
    else:
        lost = forces(law, SLIPS) * SLIPS
    assert (np.asarray(lost) > 0).all()


def test_lugre_beyond_its_passive_range_does_bring_energy_in() -> None:
    """The claim above is sharp: with sigma2 below sigma1 (Fs - Fc)/Fc energy can be gained."""
    law = LuGre(sigma0=750.0, sigma1=12.0, sigma2=1.0, Fc=1.5, Fs=1.75, vs=0.2)
    v, z = jnp.array(50.0), law.Fs / law.sigma0
    assert law.force(v, z) * v - law.sigma0 * z * law.rate(v, z) < 0


@every_law
def test_odd_in_slip(name: str) -> None:
    ours = np.asarray(forces(CASES[name].law, SLIPS))
    if CASES[name].odd:
        np.testing.assert_array_equal(ours, -ours[::-1])
    else:
        assert (np.abs(ours + ours[::-1]) > 1e-3 * np.abs(ours)).all()


@every_law
def test_bounded_by_the_static_limit(name: str) -> None:
    case = CASES[name]
    assert case.bound is not None
    if isinstance(case.law, LuGre):
        # The bound is on the deflection: at |z| = Fs/sigma0 its rate never points outwards, but for rounding of v.
        for side in (-1.0, 1.0):
            outwards = side * jax.vmap(case.law.rate, in_axes=(0, None))(SLIPS, side * case.law.Fs / case.law.sigma0)
            assert (np.asarray(outwards) <= 1e-15 * np.abs(SLIPS)).all()
        return
    fine = jnp.linspace(-1.0, 1.0, 4001)
    dry = forces(case.law, fine) - jnp.where(fine < 0, case.viscous[1], case.viscous[0]) * fine
    assert (np.abs(np.asarray(dry)) <= case.bound * (1 + 1e-12)).all()
    # And nearly reached, or a factor lost in the law would pass. A smooth hump stays some way below its limit.
    assert np.abs(np.asarray(dry)).max() >= 0.7 * case.bound


@every_law
def test_both_directions_use_their_own_limit(name: str) -> None:
    """Far out in slip, where every law is at its Coulomb level, and asymmetric ones at that of the direction."""
    case = CASES[name]
    base = case.law.law if isinstance(case.law, Regularized | DeadZone | Sign) else case.law
    forward, backward = getattr(base, "forward", base), getattr(base, "backward", base)
    fast = jnp.array(50.0)
    for law, v, viscous in ((forward, fast, case.viscous[0]), (backward, -fast, case.viscous[1])):
        level = getattr(law, "Fc", jnp.array(0.0))
        if isinstance(case.law, LuGre):
            ours = case.law.force(v, jnp.sign(v) * level / case.law.sigma0)
        else:
            ours = case.law.force(v)
        # exp(-(50/0.2)^(1/2)) = 1.4e-7 of Fs - Fc = 0.25 is left of the Stribeck hump with the smallest exponent.
        np.testing.assert_allclose(ours, jnp.sign(v) * level + viscous * v, rtol=1e-7)


@every_law
def test_jit_and_vmap_give_what_a_loop_gives(name: str) -> None:
    law = CASES[name].law
    loop = np.array([force(law, v) for v in SLIPS])
    # XLA may contract a product and a sum into one rounding.
    np.testing.assert_allclose(forces(law, SLIPS), loop, rtol=1e-14)
    laws = jax.tree.map(lambda x: jnp.stack([x, 1.1 * x]), law)
    batch = jax.vmap(force)(laws, SLIPS[-2:])
    single = [force(jax.tree.map(lambda x, i=i: x[i], laws), SLIPS[i - 2]) for i in range(2)]
    np.testing.assert_allclose(batch, single, rtol=1e-14)


@every_law
def test_gradients_equal_finite_differences(name: str) -> None:
    """By the velocity and every parameter at once."""
    law = CASES[name].law
    gradient = jax.jit(jax.grad(lambda x: force(*x)))
    value = jax.jit(lambda x: force(*x))
    for v in [*SLIPS[jnp.array([0, 2, 5, 8, 11, 13])]]:
        point = (law, v)
        # Steps of 2e-4 of each number: laws change over lengths not far below their numbers, so truncation is
        # about 1e-14 and rounding 1e-12, relative to the force over the number.
        slopes = gradient_by_differences(value, point, 2e-4)
        scale = abs(float(value(point))) / np.where(flat(point) == 0, 1.0, np.abs(flat(point)))
        np.testing.assert_array_less(np.abs(flat(gradient(point)) - slopes), 1e-8 * scale + 1e-10 * np.abs(slopes))


@every_law
@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_at_rest_everything_is_finite_and_keeps_its_dtype(name: str, dtype: Any) -> None:
    law = jax.tree.map(lambda x: x.astype(dtype), CASES[name].law)
    v = jnp.zeros((), dtype)
    value, gradient = jax.value_and_grad(lambda x: force(*x))((law, v))
    assert value == 0
    for leaf in [value, *jax.tree.leaves(gradient)]:
        assert leaf.dtype == dtype
        assert np.isfinite(leaf), gradient
    if isinstance(law, AbstractDynamicLaw):
        z = law.state0()
        for leaf in (z, law.rate(v, z), law.stored(z), law.advance(v, v, z)):
            assert leaf.dtype == dtype
            assert leaf == 0


@every_law
def test_slope_at_rest(name: str) -> None:
    """The derivative by velocity at v = 0 is the limit from either side, where the law is smooth."""
    case = CASES[name]
    if not case.smooth or isinstance(case.law, AbstractDynamicLaw):
        return
    slope = jax.grad(case.law.force)(jnp.array(0.0))
    if "exponent 1/2" in name:
        # F = level(|v|) tanh(v/w) and its slope differ from their limits by terms of order sqrt(|v|).
        step, tolerance = 1e-12, 1e-5
    else:
        step, tolerance = 1e-6, 1e-8
    sides = [float(case.law.force(jnp.array(s))) / s for s in (-step, step)]
    np.testing.assert_allclose([slope, slope], sides, rtol=tolerance)


def wrong_values() -> dict[str, tuple[Callable[[], Any], str, str, float]]:
    """Every parameter of every module in the table, below its limit, at it where that is excluded, and NaN."""
    found = {}
    for case in CASES.values():
        for _, module in modules_of(case.law):
            kind = type(module)
            arguments = {f.name: getattr(module, f.name) for f in dataclasses.fields(module)}
            for name, allowed in ranges_of(module).items():
                limit = float(arguments[allowed.lower] if isinstance(allowed.lower, str) else allowed.lower or 0.0)
                for value in [limit - 0.25, float("nan"), *([limit] if allowed.strict else [])]:
                    build = lambda k=kind, a=arguments, n=name, x=value: k(**{**a, n: x})  # noqa: E731
                    found[f"{kind.__name__} {name}={value:g}"] = (build, name, allowed.text, value)
    return found


WRONG = wrong_values()


@pytest.mark.quick
@pytest.mark.parametrize("name", WRONG)
def test_values_out_of_range_are_refused(name: str) -> None:
    build, parameter, allowed, value = WRONG[name]
    with pytest.raises(ValueError, match=parameter) as info:
        build()
    assert f"{parameter} must be {allowed}" in str(info.value)
    assert f"{value:g}" in str(info.value)


def test_the_table_covers_every_law() -> None:
    """Each concrete law that the package offers is in the table, and each has parameters in the one above."""
    offered = {n for n, x in vars(friction).items() if isinstance(x, type) and not n.startswith("Abstract")}
    covered = {type(m).__name__ for case in CASES.values() for _, m in modules_of(case.law)}
    assert offered <= covered
    assert {"Viscous Fv=-0.25", "LuGre sigma0=0", "Regularized width=0", "Coulomb Fs=1.25"} <= set(WRONG)


@pytest.mark.parametrize(
    ("build", "text"),
    [
        (lambda: Viscous("0.4"), "Fv must be a real number or an array of real numbers, but '0.4' was given"),
        (lambda: Viscous(True), "Fv must be a real number"),
        (lambda: Viscous(1j), "Fv must be a real number"),
        (lambda: Coulomb([1.0, 2.0]), "Fc must be a real number"),
        (lambda: Coulomb(jnp.ones(2)), r"Fc has shape \(2,\), but one number is needed"),
        (
            lambda: Regularized(cast(Any, Viscous(1.0)), 0.1),
            "Regularized executes a set-valued law .* but 'Viscous' is none",
        ),
        (lambda: Sign(cast(Any, "coulomb")), "Sign executes a set-valued law .* but 'coulomb' is none"),
        (
            lambda: DeadZone(cast(Any, Sign(Coulomb(1.0))), 0.1),
            "DeadZone executes a set-valued law .* but 'Sign' is none",
        ),
        (lambda: asymmetric(cast(Any, BRISTLE), Fc=2.0), "asymmetric takes Viscous or a set-valued"),
        (lambda: asymmetric(Sign(Coulomb(1.0)), Fc=2.0), "asymmetric takes Viscous or a set-valued law"),
        (lambda: asymmetric(Coulomb(1.0), Fv=2.0), r"among Fc; given: Fv"),
        (lambda: asymmetric(Coulomb(1.0)), "given: none"),
        (lambda: asymmetric(Coulomb(1.0), Fc=-2.0), r"Fc must be finite and >= 0 \[N\], but -2.0 was given"),
        (lambda: asymmetric(Stribeck(1.0, 2.0, 0.1), Fc=3.0), r"Fs must be finite and >= Fc \[N\] \(Fc = 3.0\)"),
    ],
)
def test_wrong_structure_is_refused(build: Callable[[], Any], text: str) -> None:
    with pytest.raises(ValueError, match=text):
        build()


def test_integers_become_floating_and_a_dtype_is_kept() -> None:
    assert Viscous(1).Fv.dtype == jnp.float64
    assert Viscous(jnp.float32(1)).Fv.dtype == jnp.float32


def test_lugre_deflection_stays_within_its_bound_along_random_slip() -> None:
    """Steps from far below to far above the bristle's own length, of random sign."""
    rng = np.random.default_rng(7)
    v = jnp.asarray(rng.standard_normal(2000) * 10.0 ** rng.uniform(-4, 1, 2000))
    dt = jnp.asarray(10.0 ** rng.uniform(-6, 0, 2000))

    def step(z: jax.Array, x: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        z = BRISTLE.advance(x[0] * x[1], x[0], z)
        return z, z

    zs = np.asarray(jax.lax.scan(step, BRISTLE.state0(), (v, dt))[1]) * float(BRISTLE.sigma0 / BRISTLE.Fs)
    # exp(-x) + (1 - exp(-x)) is one to rounding.
    assert np.abs(zs).max() <= 1 + 1e-14
    assert zs.max() > 0.9
    assert zs.min() < -0.9


def exact_advance(distance: float, v: float, z: float) -> float:
    """Closed form in exact arithmetic of NumPy's long double."""
    long = np.longdouble
    s0, fc, fs, vs = (long(float(x)) for x in (BRISTLE.sigma0, BRISTLE.Fc, BRISTLE.Fs, BRISTLE.vs))
    g = fc + (fs - fc) * np.exp(-((long(v) / vs) ** 2))
    x = s0 * abs(long(distance)) / g
    steady = g / s0 * np.sign(long(distance))
    return float(long(z) * np.exp(-x) - steady * np.expm1(-x))


@pytest.mark.parametrize("v", [1e-9, 0.1, -3.0])
@pytest.mark.parametrize("distance", [1e-300, 1e-15, 1e-8, 1.9e-7, 2.1e-7, 1e-4, 1.0, 1e6, 1e300])
def test_lugre_advances_by_its_closed_form(distance: float, v: float) -> None:
    """At arguments where the plain form cancels or overflows, too; 2e-7 m is where the library changes over."""
    if v < 0:
        distance = -distance
    advance = jax.jit(lambda *x: BRISTLE.advance(*x))
    for z in (0.0, 1e-3, -2e-3):
        ours = advance(jnp.array(distance), jnp.array(v), jnp.array(z))
        # The series below x = 1e-4 leaves x^3/24 = 4e-14.
        np.testing.assert_allclose(ours, exact_advance(distance, v, z), rtol=1e-13, atol=0)


def test_lugre_advances_with_finite_derivatives_at_rest() -> None:
    zero = jnp.array(0.0)
    gradient = jax.grad(lambda x: x[0].advance(*x[1:]))((BRISTLE, zero, zero, jnp.array(1e-3)))
    assert np.isfinite(flat(gradient)).all()
    np.testing.assert_allclose(gradient[3], 1.0)
    # From rest the bristle follows the surface, less what it yields: one of the two one-sided slopes.
    ahead = 1.0 - 750.0 * 1e-3 / 1.75
    assert np.isclose(gradient[1], ahead) or np.isclose(gradient[1], 2.0 - ahead)
