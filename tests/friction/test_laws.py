"""The contract of friction laws: what each law of the table must keep."""

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any, ClassVar, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmodsim import (
    Coulomb,
    DeadZone,
    LuGre,
    MaxwellSlip,
    Regularized,
    Sign,
    Stribeck,
    Viscous,
    asymmetric,
    friction,
    scaled_by,
)
from jaxmodsim._core.functions import nominal
from jaxmodsim._core.parameters import modules_of, parameter, ranges_of
from jaxmodsim.friction import AbstractDynamicLaw, AbstractForceLaw, AbstractLaw

from ..helpers.differences import flat, gradient_by_differences
from ..helpers.law_cases import CASES, PARAMS, POSITION, VELOCITY, elastic, factor, force, mirrored, settled

every_law = pytest.mark.parametrize("name", CASES)
BRISTLE = LuGre(sigma0=750.0, sigma1=0.0, sigma2=0.1, Fc=1.5, Fs=1.75, vs=0.2)
DYNAMIC = [name for name, case in CASES.items() if case.loaded is not None]
every_dynamic_law = pytest.mark.parametrize("name", DYNAMIC)

# Slip velocities [m/s] from presliding to fast slip, of both signs, none within a step of a finite difference of zero.
SPEEDS = np.array([0.003, 0.02, 0.0417, 0.11, 0.35, 1.3, 7.0])
SLIPS = jnp.asarray(np.concatenate([-SPEEDS[::-1], SPEEDS]))
SHARES = jnp.linspace(-1.0, 1.0, 21)


@partial(jax.jit, static_argnums=0)
def forces(name: str, law: Any, v: Any) -> Any:
    return jax.vmap(lambda v: force(name, law, v))(v)


def loss(name: str, law: Any, v: Any, share: Any) -> Any:
    """Power that is lost: what goes in, less what goes into the elastic elements."""
    law, z = settled(law), cast(Any, CASES[name].loaded)(settled(law), share)
    rate = law.zdot(v, z)
    stored = jax.jvp(law.stored_energy, (z,), (rate,))[1]
    return v * law.force(v, z) - stored


@pytest.mark.quick
@every_law
def test_dissipation_is_never_negative(name: str) -> None:
    """For dynamic laws at all velocities and all loads of the elastic elements."""
    law = CASES[name].law
    if CASES[name].loaded is not None:
        v, share = map(jnp.ravel, jnp.meshgrid(SLIPS, SHARES))
        lost = np.asarray(jax.jit(jax.vmap(lambda v, s: loss(name, law, v, s)))(v, share))
        # A spring that gives nothing away loses nothing, but for rounding.
        assert (lost >= -1e-14 * np.abs(v)).all()
        assert lost.max() > 0
    else:
        assert (np.asarray(forces(name, law, SLIPS) * SLIPS) > 0).all()


@every_law
def test_odd_in_slip(name: str) -> None:
    ours = np.asarray(forces(name, CASES[name].law, SLIPS))
    if CASES[name].odd:
        np.testing.assert_array_equal(ours, -ours[::-1])
    elif CASES[name].loaded is None:
        assert (np.abs(ours + ours[::-1]) > 1e-3 * np.abs(ours)).all()
    if CASES[name].loaded is not None and CASES[name].odd:
        law = settled(CASES[name].law)
        z, v, dt = cast(Any, CASES[name].loaded)(law, 0.7), jnp.array(0.05), jnp.array(0.03)
        for change in (law.zdot, partial(law.step_exact, dt=dt)):
            there, here = change(-v, mirrored(z)), change(v, z)
            jax.tree.map(np.testing.assert_array_equal, there, mirrored(here))


@every_law
def test_bounded_by_the_static_limit(name: str) -> None:
    case = CASES[name]
    if case.loaded is not None:
        return  # test_no_step_leaves_the_bound
    fine = jnp.linspace(-1.0, 1.0, 4001)
    viscous = jnp.where(fine < 0, case.viscous[1], case.viscous[0]) * fine
    dry = np.asarray(forces(name, case.law, fine) - viscous)
    assert (np.abs(dry) <= case.bound * (1 + 1e-12) + 1e-15).all()
    # And nearly reached, or a factor lost in the law would pass. A smooth hump stays some way below its limit, and the
    # slip force of Coulomb friction with stiction below the limit of stick.
    reached = (
        max(abs(settled(case.law).static_limit(jnp.array(s))) for s in (-1.0, 1.0)) if name.startswith("coulomb") else 0
    )
    assert max(np.abs(dry).max(), reached) >= 0.7 * case.bound


@every_dynamic_law
def test_no_step_leaves_the_bound(name: str) -> None:
    """Random slip, steps from far below to far above the elements' own length."""
    case = CASES[name]
    law = settled(case.law)
    rng = np.random.default_rng(7)
    v = jnp.asarray(rng.standard_normal(2000) * 10.0 ** rng.uniform(-4, 1, 2000))
    dt = jnp.asarray(10.0 ** rng.uniform(-6, 0, 2000))

    def step(z: Any, x: tuple[jax.Array, jax.Array]) -> tuple[Any, jax.Array]:
        z = law.step_exact(x[0], z, x[1])
        return z, elastic(law, z, x[0])

    held = np.asarray(jax.jit(lambda: jax.lax.scan(step, law.initial_state(v[0]), (v, dt))[1])()) / case.bound
    assert np.abs(held).max() <= 1 + 1e-13
    assert held.max() > 0.75
    assert held.min() < -0.6


@every_dynamic_law
def test_a_step_is_what_many_small_ones_are(name: str) -> None:
    """The step at constant velocity against the rate, integrated by the midpoint rule; and it needs no small steps."""
    case = CASES[name]
    law = settled(case.law)
    span, count = jnp.array(0.02), 4000

    def both(v: Any) -> tuple[Any, Any, Any]:
        z0 = cast(Any, case.loaded)(law, -0.3)

        def midpoint(z: Any, _: None) -> tuple[Any, None]:
            h = span / count
            middle = jax.tree.map(lambda z, r: z + 0.5 * h * r, z, law.zdot(v, z))
            return jax.tree.map(lambda z, r: z + h * r, z, law.zdot(v, middle)), None

        four = z0
        for _ in range(4):
            four = law.step_exact(v, four, 0.25 * span)
        return jax.lax.scan(midpoint, z0, None, length=count)[0], law.step_exact(v, z0, span), four

    fine, once, four = jax.jit(jax.vmap(both))(SLIPS)
    scale = float(jnp.max(jnp.abs(jax.tree.leaves(fine)[0])))
    # Where the solution at constant velocity is known, the midpoint rule's error is left; the transition of the
    # elasto-plastic law is stepped through, and Armstrong's memory follows the deflection.
    rough = {"elasto": 3e-3, "armstr": 6e-2}.get(name[:6], 3e-6)
    np.testing.assert_allclose(jax.tree.leaves(once)[0], jax.tree.leaves(fine)[0], atol=rough * scale)
    np.testing.assert_allclose(jax.tree.leaves(four)[0], jax.tree.leaves(fine)[0], atol=rough * scale)


@every_law
def test_both_directions_use_their_own_level(name: str) -> None:
    """Far out in slip, where every law is at its Coulomb level, and asymmetric ones at that of the direction."""
    case = CASES[name]
    for v, level, viscous in zip(jnp.array([500.0, -500.0]), case.level, case.viscous, strict=True):
        law = settled(case.law)
        if isinstance(law, AbstractDynamicLaw):
            z = law.step_exact(v, law.initial_state(v), jnp.array(1e4))
            dry = law.force(v, z) - viscous * v
        else:
            dry = force(name, case.law, v) - viscous * v
        # A Lorentzian fall leaves (0.2/500)^2 of Fs - Fc = 0.25.
        np.testing.assert_allclose(dry, jnp.sign(v) * level, rtol=1e-5, atol=1e-12)


@every_law
def test_jit_and_vmap_give_what_a_loop_gives(name: str) -> None:
    law = CASES[name].law
    loop = np.array([force(name, law, v) for v in SLIPS[::3]])
    # XLA may contract a product and a sum into one rounding.
    np.testing.assert_allclose(forces(name, law, SLIPS)[::3], loop, rtol=1e-14)
    laws = jax.tree.map(lambda x: jnp.stack([x, 1.1 * x]), law)
    batch = jax.vmap(lambda law, v: force(name, law, v))(laws, SLIPS[-2:])
    single = [force(name, jax.tree.map(lambda x, i=i: x[i], laws), SLIPS[i - 2]) for i in range(2)]
    np.testing.assert_allclose(batch, single, rtol=1e-14)


def response(name: str, law: Any, v: Any) -> Any:
    """Force, and of a dynamic law what follows from its rate and from a step, too."""
    total = force(name, law, v)
    settled_law = settled(law)
    if isinstance(settled_law, AbstractDynamicLaw):
        z = cast(Any, CASES[name].loaded)(settled_law, 0.55)
        rates = jax.tree.leaves(settled_law.zdot(v, z))
        total = total + sum(0.1 * jnp.sum(rate) for rate in rates)
        total = total + 0.7 * elastic(settled_law, settled_law.step_exact(v, z, jnp.array(0.011)), v)
    return total


@every_law
def test_gradients_equal_finite_differences(name: str) -> None:
    """By the velocity and every parameter at once."""
    law = CASES[name].law
    gradient = jax.jit(jax.grad(lambda x: response(name, *x)))
    value = jax.jit(lambda x: response(name, *x))
    for v in [*SLIPS[jnp.array([0, 2, 5, 8, 11, 13])]]:
        point = (law, v)
        # Steps of 2e-4 of each number: laws change over lengths not far below their numbers, so truncation is
        # about 1e-14 and rounding 1e-12, relative to the force over the number.
        slopes = gradient_by_differences(value, point, 2e-4)
        scale = max(abs(float(value(point))), 1.0) / np.where(flat(point) == 0, 1.0, np.abs(flat(point)))
        np.testing.assert_array_less(np.abs(flat(gradient(point)) - slopes), 1e-8 * scale + 1e-10 * np.abs(slopes))


@every_law
@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_at_rest_everything_is_finite_and_keeps_its_dtype(name: str, dtype: Any) -> None:
    law = jax.tree.map(lambda x: x.astype(dtype), CASES[name].law)
    v = jnp.zeros((), dtype)
    state = [jax.tree.map(lambda x: x.astype(dtype), x) for x in (POSITION, VELOCITY, PARAMS)]

    def at_rest(x: Any) -> Any:
        law, v = x
        law = law.bind_state(v, *state)
        if not isinstance(law, AbstractDynamicLaw):
            return force(name, law, v)
        z = law.initial_state(v)
        z = jax.tree.map(jnp.add, z, law.zdot(v, z))
        return law.force(v, law.step_exact(v, z, jnp.asarray(0.01, dtype))) + law.stored_energy(z)

    value, gradient = jax.value_and_grad(at_rest)((law, v))
    assert value == 0
    for leaf in [value, *jax.tree.leaves(gradient)]:
        assert leaf.dtype == dtype
        assert np.isfinite(leaf).all(), gradient


@every_law
def test_slope_at_rest(name: str) -> None:
    """The derivative by velocity at v = 0 is the limit from either side, where the law is smooth."""
    case = CASES[name]
    if not case.smooth or case.loaded is not None:
        return
    slope = jax.grad(lambda v: force(name, case.law, v))(jnp.array(0.0))
    if "exponent 1/2" in name:
        # F = g(|v|) tanh(v/w) and its slope differ from their limits by terms of order sqrt(|v|).
        step, tolerance = 1e-12, 1e-5
    else:
        step, tolerance = 1e-6, 1e-8
    sides = [float(force(name, case.law, jnp.array(s))) / s for s in (-step, step)]
    np.testing.assert_allclose([slope, slope], sides, rtol=tolerance)


def wrong_values() -> dict[str, tuple[Callable[[], Any], str, str, float]]:
    """Every parameter of every module in the table, out of its range, at a limit that is excluded, and NaN."""
    found = {}
    for case in CASES.values():
        for _, module in modules_of(case.law):
            kind = type(module)
            given = {f.name: nominal(getattr(module, f.name)) for f in dataclasses.fields(module) if f.init}
            for name, allowed in ranges_of(module).items():
                limit = np.min(np.asarray(given[allowed.lower] if isinstance(allowed.lower, str) else allowed.lower))
                above = [] if allowed.upper is None else [allowed.upper + 0.25]
                for value in [float(limit) - 0.25, float("nan"), *([float(limit)] if allowed.strict else []), *above]:
                    wrong = given | {name: jnp.full(jnp.shape(given[name]), value)}
                    build = lambda k=kind, a=wrong: k(**a)  # noqa: E731
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


class Number(eqx.Module):
    value: Any

    def __call__(self, t: Any, q: Any, qd: Any, params: Any) -> Any:
        del t, q, qd, params
        return self.value


class Most(AbstractForceLaw):
    """A law of one's own with an upper limit alone."""

    share: Any = parameter("share", "1", upper=1.0)
    stiff: ClassVar[bool] = False

    def force(self, v: Any) -> Any:
        return self.share * v


def test_an_upper_limit_alone_holds() -> None:
    assert float(Most(-3.0).force(jnp.array(2.0))) == -6.0
    with pytest.raises(ValueError, match=r"share must be finite and <= 1 \[1\], but 5.0 was given"):
        Most(5.0)


def test_the_table_covers_every_law_and_every_modifier() -> None:
    """Each concrete law that the package offers is in the table, by itself and under either modifier."""
    public = {n for n, x in vars(friction).items() if isinstance(x, type) and issubclass(x, AbstractLaw)}
    offered = {name for name in public if not name.startswith("Abstract")}
    assert offered == set(friction.laws())

    def laws(cases: list[Any]) -> set[str]:
        return {type(m).__name__ for case in cases for _, m in modules_of(case.law) if isinstance(m, AbstractLaw)}

    assert offered <= laws([case for name, case in CASES.items() if "scaled" not in name and "asym" not in name])
    assert offered <= laws([case for name, case in CASES.items() if name.endswith("scaled")])
    sided = [case for name, case in CASES.items() if name.endswith("asymmetric")]
    assert offered <= laws(sided)
    for case in sided:
        assert any(hasattr(module, "backward") for _, module in modules_of(case.law))
    assert {"Viscous Fv=-0.25", "LuGre sigma0=0", "Regularized width=0", "Coulomb Fs=1.25"} <= set(WRONG)
    assert {"MaxwellSlip k=-0.25", "MaxwellSlip corner=1.25", "ElastoPlastic Fc=1", "LuGre vd=0"} <= set(WRONG)


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
            "Regularized needs a set-valued law .* but 'Viscous' was given",
        ),
        (lambda: Sign(cast(Any, "coulomb")), "Sign needs a set-valued law .* but 'coulomb' was given"),
        (
            lambda: DeadZone(cast(Any, Sign(Coulomb(1.0))), 0.1),
            "DeadZone needs a set-valued law .* but 'Sign' was given",
        ),
        (lambda: asymmetric(BRISTLE, sigma0=2.0), "sigma0 stores energy, so it must be the same"),
        (lambda: asymmetric(asymmetric(Coulomb(1.0), Fc=2.0), Fc=2.0), "an asymmetric law was given"),
        (lambda: asymmetric(cast(Any, "coulomb"), Fc=2.0), "asymmetric needs a law .* but 'coulomb'"),
        (lambda: scaled_by(cast(Any, "coulomb"), factor), "scaled_by needs a law, but 'coulomb'"),
        (lambda: scaled_by(Coulomb(1.0), cast(Any, 2.0)), "scaled_by fn must be a function, but 2.0"),
        (lambda: scaled_by(Coulomb(1.0), factor, ["Fv"]), r"parameters of Coulomb, among Fc .*given: \['Fv'\]"),
        (lambda: scaled_by(Coulomb(1.0), factor, "Fc"), "scaled_by parameters must be a list"),
        (lambda: asymmetric(Coulomb(1.0, 2.0), Fs=None), r"Fs must have the shape \(\) .* got None"),
        (lambda: asymmetric(MaxwellSlip([1.0, 2.0], [1.0, 2.0]), Fc=1.0), r"Fc must have the shape \(2,\)"),
        (lambda: scaled_by(Coulomb(1.0), Number(jnp.ones(()))), "fn holds numbers of its own"),
        (lambda: MaxwellSlip([1.0, 2.0], [1.0]), r"Fc must have one number for each of the 2 elements of k"),
        (lambda: MaxwellSlip([1.0, 2.0], [1.0, 1.0], Fs=[1.0, 2.0]), "give both or none"),
        (lambda: MaxwellSlip(jnp.ones((2, 2)), 1.0), r"k has shape \(2, 2\), but a vector of numbers"),
        (lambda: MaxwellSlip([], []), r"k has shape \(0,\), but a vector of numbers"),
        (lambda: asymmetric(Coulomb(1.0), Fv=2.0), r"among Fc .*given: Fv"),
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


def exact_advance(distance: float, v: float, z: float) -> float:
    """Closed form in exact arithmetic of NumPy's long double."""
    long = np.longdouble
    s0, fc, fs, vs = (long(float(x)) for x in (BRISTLE.sigma0, BRISTLE.Fc, BRISTLE.Fs, BRISTLE.vs))
    g = fc + (fs - fc) * np.exp(-((long(v) / vs) ** 2))
    x = s0 * abs(long(distance)) / g
    steady = g / s0 * np.sign(long(distance))
    return float(long(z) * np.exp(-x) - steady * np.expm1(-x))


@pytest.mark.parametrize("v", [1e-9, 0.1, -3.0])
@pytest.mark.parametrize("distance", [1e-300, 1e-15, 1e-8, 1.9e-7, 2.1e-7, 1e-4, 1.0, 1e6, 1e290])
def test_lugre_advances_by_its_closed_form(distance: float, v: float) -> None:
    """At arguments where the plain form cancels or overflows, too; 2e-7 m is where the library changes over."""
    if v < 0:
        distance = -distance
    advance = jax.jit(lambda *x: BRISTLE.step_exact(*x))
    for z in (0.0, 1e-3, -2e-3):
        ours = advance(jnp.array(v), jnp.array(z), jnp.array(distance / v))
        # The series below x = 1e-4 leaves x^3/24 = 4e-14.
        np.testing.assert_allclose(ours, exact_advance(distance, v, z), rtol=1e-13, atol=0)


def test_a_law_that_varies_has_no_values_by_itself() -> None:
    law = scaled_by(LuGre(750.0, 0.0, 0.1, 1.5, 1.75, 0.2), factor)
    with pytest.raises(TypeError, match="depends on the state of the mechanism"):
        law.force(jnp.array(0.1), jnp.array(0.0))


def test_scaling_multiplies_the_parameters_that_are_named() -> None:
    law = scaled_by(scaled_by(Stribeck(1.0, 2.0, 0.1, Fv=0.5), factor, ["Fv", "vs"]), lambda *_: 3.0, ["Fv"])
    here = settled(law)
    ours = [float(x) for x in (here.Fc, here.Fs, here.vs, here.Fv)]
    np.testing.assert_allclose(ours, [1.0, 2.0, 0.1 * 1.4, 1.5 * 1.4])
    # Nothing that is divided by a parameter becomes NaN where the factor vanishes.
    gone = settled(scaled_by(BRISTLE, lambda *_: -1.0))
    assert float(gone.Fc) < 1e-29
    np.testing.assert_allclose(gone.force(jnp.array(0.1), jnp.array(1e-3)), 0.0, atol=1e-25)
    np.testing.assert_allclose(
        gone.zdot(jnp.array(0.1), jnp.array(1e-3)), BRISTLE.zdot(jnp.array(0.1), jnp.array(1e-3))
    )


def test_factors_that_wrap_the_same_function_are_told_apart() -> None:
    class Gain(eqx.Module):
        fn: Any
        gain: float = eqx.field(static=True)

        def __call__(self, *state: Any) -> Any:
            return self.gain * self.fn(*state)

    law = scaled_by(scaled_by(Coulomb(1.0), Gain(factor, 2.0)), Gain(factor, 3.0))
    np.testing.assert_allclose(settled(law).Fc, 6.0 * 1.4**2)


@every_dynamic_law
def test_a_step_from_rest_moves_with_the_surface(name: str) -> None:
    """The derivative by velocity at v = 0 of an unloaded element is the time, times its stiffness."""
    law = settled(CASES[name].law)
    zero = jnp.array(0.0)

    def held(v: Any) -> Any:
        return elastic(law, law.step_exact(v, law.initial_state(v), jnp.array(1e-3)), v)

    np.testing.assert_allclose(jax.grad(held)(zero), held(jnp.array(1e-9)) / 1e-9, rtol=1e-5)


def test_what_is_limited_by_a_number_that_differs_differs_too() -> None:
    law = asymmetric(LuGre(100.0, 0.0, 0.0, 1.0, 1.5, 0.1), Fc=1.2)
    assert set(law.backward) == {"Fc", "Fs"}  # pyright: ignore[reportAttributeAccessIssue]
    stiff = asymmetric(Regularized(Coulomb(1.0), 0.1), Fc=2.0)
    assert stiff.stiff
    assert asymmetric(BRISTLE, Fc=1.2).stiff


def test_modifiers_commute() -> None:
    one, other = scaled_by(asymmetric(BRISTLE, Fc=1.2), factor), asymmetric(scaled_by(BRISTLE, factor), Fc=1.2)
    for v in (-0.3, 0.3):
        force = [settled(law).force(jnp.array(v), jnp.array(1e-3)) for law in (one, other)]
        assert force[0] == force[1]
