"""ImplicitFriction: bounded at any step and stiffness, of order 1, and differentiable."""

from importlib.metadata import version
from typing import Any

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxmodsim as jms
from jaxmodsim._core.monotone import rising_root, solve_monotone
from jaxmodsim.problems import ramped_box
from jaxmodsim.scene import State, scene_step

from ..helpers.differences import central_difference, flat, gradient_by_differences

SOLVER = jms.ImplicitFriction()
M = 2.0


def mass(t: Any, q: Any, qd: Any, p: Any) -> Any:
    del t, q
    return 0.5 * p["m"] * qd[0] ** 2


def pull(t: Any, q: Any, qd: Any, p: Any) -> Any:
    del t, q, qd
    return p["force"][None]


def spring(t: Any, q: Any, qd: Any, p: Any) -> Any:
    return 0.5 * p["m"] * qd[0] ** 2 - 0.5 * p["k"] * (p["v"] * t - q[0]) ** 2


def pulled_box() -> jms.Scene:
    """The set of 1995 pulled through a spring."""
    law = jms.LuGre(sigma0=1e5, sigma1=1e5**0.5, sigma2=0.4, Fc=1.0, Fs=1.5, vs=1e-3)
    return jms.Scene(spring, params={"m": 1.0, "k": 2.0, "v": 0.1}, effects=(jms.Friction(law),))


def errors(scene: jms.Scene, q0: Any, qd0: Any, t1: float, steps: Any) -> np.ndarray:
    """Largest error of coordinates and velocities at the end, against Rodas5P at a tight tolerance."""
    tight = jms.simulate(scene, q0, qd0, t1, rtol=1e-10, atol=1e-12, max_steps=100_000, solver=jms.Rodas5P())
    found = []
    for dt in steps:
        run = jms.simulate(scene, q0, qd0, t1, dt=dt, solver=SOLVER, max_steps=200_000)
        found.append(max(np.abs(run.q - tight.q).max(), np.abs(run.qd - tight.qd).max()))
    return np.array(found)


@pytest.mark.quick
def test_order_on_the_test_bench() -> None:
    for sigma1 in (0.0, 40.0):
        table = errors(ramped_box.scene(ramped_box.lugre(sigma1=sigma1)), [0.0], [0.0], 4.0, [4e-3, 2e-3, 1e-3])
        np.testing.assert_allclose(np.log2(table[:-1] / table[1:]), 1.0, atol=0.1)
        assert table[-1] < 1e-3


def test_order_pulled_through_a_spring() -> None:
    """After the first slip, which passes the whole Stribeck curve; the bristle's time constant is 1e-2 to 1e-5 s."""
    table = errors(pulled_box(), [0.0], [0.0], 12.0, [4e-4, 2e-4, 1e-4])
    np.testing.assert_allclose(np.log2(table[:-1] / table[1:]), 1.0, atol=0.15)
    assert table[-1] < 5e-5


def two_masses(t: Any, q: Any, qd: Any, p: Any) -> Any:
    kinetic = 0.5 * p["m"] * (qd[0] ** 2 + qd[1] ** 2) + 0.3 * qd[0] * qd[1]
    return kinetic - 25.0 * (q[1] - q[0]) ** 2 - 25.0 * (q[0] - 0.2 * t) ** 2


def coupled() -> jms.Scene:
    """Two masses, each with friction of its own, and a damper between them: more elements than coordinates."""
    first = jms.LuGre(sigma0=1e4, sigma1=50.0, sigma2=0.4, Fc=1.0, Fs=1.2, vs=0.05)
    effects = (
        jms.Friction(first, along=lambda q: q[0], name="first"),
        jms.Friction(jms.Dahl(sigma0=5e3, Fc=0.7), along=lambda q: q[1], name="second", belt_velocity=0.1),
        jms.Friction(jms.Viscous(Fv=0.3), along=lambda q: q[1] - q[0], name="between"),
    )
    return jms.Scene(two_masses, params={"m": 1.0}, effects=effects)


def test_coupled_elements() -> None:
    table = errors(coupled(), [0.0, 0.0], [0.0, 0.5], 2.0, [1e-3, 2e-4])
    assert table[1] < 2e-4
    np.testing.assert_allclose(np.log(table[0] / table[1]) / np.log(5.0), 1.0, atol=0.3)


def circling(t: Any, q: Any, qd: Any, p: Any) -> Any:
    return 0.5 * p["m"] * jnp.sum(qd**2) - 10.0 * ((q[0] - jnp.cos(t)) ** 2 + (q[1] - jnp.sin(t)) ** 2)


def test_planar_slip() -> None:
    law = jms.LuGre(sigma0=1e4, sigma1=50.0, sigma2=0.4, Fc=1.0, Fs=1.2, vs=0.05)
    friction = jms.Friction(law, along=lambda q: q, ellipse=0.7, normal_force=lambda t, q, qd, p: 1.0 + 0.1 * q[0])
    scene = jms.Scene(circling, params={"m": 1.0}, effects=(friction,))
    table = errors(scene, [1.0, 0.0], [0.0, 0.0], 2.0, [1e-3, 2e-4])
    assert table[1] < 3e-4
    np.testing.assert_allclose(np.log(table[0] / table[1]) / np.log(5.0), 1.0, atol=0.3)


def angle_pendulum(t: Any, q: Any, qd: Any, p: Any) -> Any:
    del t
    return 0.5 * p["m"] * qd[0] ** 2 + p["m"] * 9.81 * jnp.cos(q[0])


def cartesian_pendulum(t: Any, q: Any, qd: Any, p: Any) -> Any:
    del t
    return 0.5 * p["m"] * jnp.sum(qd**2) - p["m"] * 9.81 * q[1]


def test_within_a_constraint() -> None:
    """A pendulum in Cartesian coordinates with friction in its joint, against one in its angle."""
    law = jms.LuGre(sigma0=1e4, sigma1=50.0, sigma2=0.4, Fc=1.0, Fs=1.2, vs=0.05)
    angle = jms.Scene(angle_pendulum, params={"m": 1.0}, effects=(jms.Friction(law),))
    tight = jms.simulate(angle, [0.5 * np.pi], [0.0], 1.0, rtol=1e-9, atol=1e-11).q[0, 0]
    rod = jms.Constraint(lambda t, q, p: q[0] ** 2 + q[1] ** 2 - 1.0, name="rod")
    friction = jms.Friction(law, along=lambda q: jnp.arctan2(q[0], -q[1]))
    scene = jms.Scene(cartesian_pendulum, params={"m": 1.0}, effects=(friction,), constraints=(rod,))
    found = []
    for dt in (2e-3, 5e-4):
        q = jms.simulate(scene, [1.0, 0.0], [0.0, 0.0], 1.0, dt=dt, solver=SOLVER).q[0]
        found.append(float(jnp.abs(jnp.arctan2(q[0], -q[1]) - tight)))
    assert found[1] < 3e-3
    np.testing.assert_allclose(np.log(found[0] / found[1]) / np.log(4.0), 1.0, atol=0.1)


def law(name: str, sigma0: Any, critical: Any) -> Any:
    """A law of that stiffness, undamped or with critical damping."""
    sigma1 = jnp.where(critical, 2.0 * jnp.sqrt(M * sigma0), 0.0).astype(sigma0.dtype)
    bristle: dict[str, Any] = {"sigma0": sigma0, "sigma1": sigma1, "sigma2": 0.1, "Fc": 1.5, "Fs": 1.75, "vs": 0.2}
    share = jnp.array([1.0, 0.5, 0.2], sigma0.dtype)
    slips: dict[str, Any] = {"Fc": [0.7, 0.5, 0.3], "Fs": [0.8, 0.6, 0.35], "vs": 0.2}
    made = {
        "Dahl": lambda: jms.Dahl(sigma0=sigma0, Fc=1.75),
        "LuGre": lambda: jms.LuGre(**bristle),
        "LuGre, vd": lambda: jms.LuGre(**bristle, vd=0.1),
        "LuGre, sharp": lambda: jms.LuGre(**{**bristle, "vs": 1e-3}),
        "ElastoPlastic": lambda: jms.ElastoPlastic(**bristle, Fba=1.0),
        "MaxwellSlip, 1": lambda: jms.MaxwellSlip(k=sigma0[None], Fc=[1.75]),
        "MaxwellSlip, 3": lambda: jms.MaxwellSlip(k=sigma0 * share, **slips),
        "Armstrong": lambda: jms.Armstrong(sigma0=sigma0, Fc=1.5, Fs=1.75, vs=0.2, Fv=0.1, tau=0.02, gamma=0.5),
    }[name]()
    return jax.tree.map(lambda x: x.astype(sigma0.dtype), made)


LAWS = ["Dahl", "LuGre", "LuGre, vd", "ElastoPlastic", "MaxwellSlip, 1", "MaxwellSlip, 3", "Armstrong"]
CASES = [(x, np.float32) for x in LAWS] + [("LuGre", np.float64), ("LuGre, sharp", np.float64)]


@pytest.mark.parametrize(("name", "dtype"), CASES)
def test_bounded_at_any_step_and_stiffness(name: str, dtype: Any) -> None:
    """sigma0 from 1e1 to 1e9, steps from 1e-6 to 1e-1; pulled in stick, pulled out of it, stopped from slip.

    In stick the velocity goes to zero as far as rounding lets it, or where the step resolves the undamped bristle does
    not grow.
    """
    steps = 40
    sigma0s, sizes = np.logspace(1, 9, 5), np.logspace(-6, -1, 6)
    cases = np.array([[1.2, 0.0], [3.0, 0.0], [-1.0, 0.5]])
    grid = np.meshgrid(sigma0s, sizes, [False, True], range(3), indexing="ij")
    sigma0, dt, critical = (jnp.asarray(x.ravel()) for x in grid[:3])
    force, v0 = jnp.asarray(cases[grid[3].ravel()].T)
    sigma0, dt, force, v0 = (x.astype(dtype) for x in (sigma0, dt, force, v0))

    def run(sigma0: Any, dt: Any, critical: Any, force: Any, v0: Any) -> Any:
        friction = jms.Friction(law(name, sigma0, critical), belt_velocity=jnp.zeros((), dtype))
        params = {"m": jnp.asarray(M, dtype), "force": force}
        scene = jms.Scene(mass, params=params, effects=(jms.AppliedForce(pull), friction))
        # Not quite the end, which rounding may put beyond the last step.
        ts = jnp.arange(1, steps + 1).astype(dtype) * dt * (1.0 - 4.0 * jnp.finfo(dtype).eps)
        return jms.simulate(
            scene,
            jnp.zeros(1, dtype),
            v0[None],
            steps * dt,
            ts=ts,
            dt=dt,
            solver=SOLVER,
            max_steps=steps + 2,
            throw=False,
        )

    runs = jax.jit(jax.vmap(run))(sigma0, dt, critical, force, v0)
    assert (runs.code == 0).all()
    v = np.asarray(runs.qd[..., 0])
    z = runs.z["friction"]
    z = np.asarray(z.z if name == "Armstrong" else z)
    assert v.dtype == z.dtype == dtype
    assert np.isfinite(v).all()
    stiffness, limit = np.array([[1.0]]), 1.75
    if name == "MaxwellSlip, 3":
        stiffness, limit = np.array([[1.0, 0.5, 0.2]]), np.array([0.8, 0.6, 0.35])
    share = np.abs(z.reshape(*v.shape, -1)) * np.asarray(sigma0, float)[:, None, None] * stiffness / limit
    eps = np.finfo(dtype).eps
    assert share.max() <= 1.0 + 8 * eps
    reach = np.abs(v0) + steps * dt * (np.abs(force) + 1.75) / M
    assert (np.abs(v).max(axis=1) <= 1.001 * reach).all()
    stuck = grid[3].ravel() == 0
    fast = np.asarray(dt, float) * np.sqrt(np.asarray(sigma0, float) / M)
    first, last = np.abs(v[:, :20]).max(axis=1), np.abs(v[:, -20:]).max(axis=1)
    rounding = 32.0 * eps * np.asarray(dt * jnp.abs(force)) / M
    still = stuck & (fast > 1.0)
    assert (last[still] <= 1e-4 * first[still] + rounding[still]).all()
    free = stuck & (fast > 0.1)
    assert (last[free] <= first[free] + rounding[free]).all()


def test_rodas5p_at_the_same_steps_does_not_hold() -> None:
    """What there was for fixed steps: it runs away where the step is far too long for the bristle."""
    scene = ramped_box.scene(ramped_box.lugre(sigma0=1e7, sigma1=2.0 * (2.0 * 1e7) ** 0.5))
    run = jms.simulate(scene, [0.0], [0.0], 4.0, dt=0.1, solver=jms.Rodas5P(), throw=False)
    assert not np.abs(run.qd[-1, 0]) < 1e6
    held = jms.simulate(scene, [0.0], [0.0], 4.0, dt=0.1, solver=SOLVER)
    np.testing.assert_allclose(held.qd[-1, 0], 1.395, atol=0.1)


def gradient_scene() -> jms.Scene:
    law = jms.LuGre(sigma0=1e5, sigma1=300.0, sigma2=0.4, Fc=1.0, Fs=1.5, vs=0.05)
    effects = (jms.AppliedForce(pull), jms.Friction(law), jms.Friction(jms.Regularized(jms.Coulomb(0.2), width=1e-6)))
    return jms.Scene(mass, params={"m": 1.3, "force": jnp.array(2.5)}, effects=effects)


def end(scene: jms.Scene, adjoint: Any = None, t1: Any = 0.2, ts: Any = None) -> Any:
    run = jms.simulate(scene, [0.0], [-0.05], t1, ts=ts, dt=2e-3, solver=SOLVER, adjoint=adjoint, max_steps=256)
    return jnp.sum(run.q[:, 0]) + 0.1 * jnp.sum(run.qd[:, 0])


def test_derivatives() -> None:
    """Of the discrete run, one smooth function between reversals: forward, reverse and finite differences.

    Two elements act on the one coordinate; steps are a thousand times longer than what the bristle needs.
    """
    scene = gradient_scene()
    reverse = flat(jax.jit(jax.grad(end))(scene))
    leaves, tree = jax.tree.flatten(scene)
    ahead = dfx.ForwardMode()
    forward = jax.jit(jax.jacfwd(lambda leaves: end(jax.tree.unflatten(tree, leaves), ahead)))(leaves)
    np.testing.assert_allclose(flat(forward), reverse, rtol=1e-9, atol=1e-13)
    # Truncation of order step^4; rounding of the end, 1e-16, divided by the step: 1e-12.
    differences = gradient_by_differences(end, scene, 1e-4)
    np.testing.assert_allclose(reverse, differences, rtol=1e-6, atol=1e-10)
    assert np.abs(reverse).max() > 1e-2


@pytest.mark.parametrize("saved", [False, True])
def test_lanes_that_finish_early_have_gradients(saved: bool) -> None:
    """Under vmap a finished lane goes on with steps of length zero."""

    def value(scene: Any, t1: Any) -> Any:
        return end(scene, None, t1, jnp.linspace(0.0, 1.0, 3) * t1 if saved else None)

    scene = ramped_box.scene(ramped_box.lugre(sigma0=1e5, sigma1=300.0), ramp=30.0)
    gradients = jax.jit(jax.vmap(jax.grad(value), (None, 0)))
    together, alone = gradients(scene, jnp.array([0.01, 0.1, 0.2])), gradients(scene, jnp.array([0.1, 0.1, 0.1]))
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(together))
    middle = [flat(jax.tree.map(lambda x: x[1], each)) for each in (together, alone)]
    np.testing.assert_allclose(*middle, rtol=1e-9, atol=1e-13)
    assert np.abs(middle[0]).max() > 1e-3


def test_forces_and_energy_follow_from_the_state() -> None:
    scene = ramped_box.scene(ramped_box.lugre(sigma0=1e7))
    ts = jnp.linspace(0.0, 4.0, 9)
    run = jms.simulate(scene, [0.0], [0.0], 4.0, ts=ts, dt=1e-3, solver=SOLVER)
    # In stick friction is the load of the step that ended, saved times being ends of steps.
    np.testing.assert_allclose(run.forces["friction"][:4], ts[:4], atol=2e-3)
    assert np.abs(run.energy.balance).max() < 2e-2 * run.energy.work_in[-1]
    assert (np.diff(run.energy.dissipated) >= -1e-9).all()


def test_scaled_by_and_no_friction() -> None:
    """A law at half its force is the law with half its parameters; without friction it is semi-implicit Euler."""
    half = jms.scaled_by(ramped_box.lugre(), lambda t, q, qd, p: 0.5)
    same = jms.LuGre(sigma0=375.0, sigma1=0.0, sigma2=0.05, Fc=0.75, Fs=0.875, vs=0.2)
    ends = [jms.simulate(ramped_box.scene(x), [0.0], [0.0], 2.0, dt=1e-2, solver=SOLVER).qd for x in (half, same)]
    np.testing.assert_allclose(*ends, rtol=1e-12)
    free = jms.simulate(ramped_box.scene(), [0.0], [0.0], 1.0, dt=0.1, solver=SOLVER)
    np.testing.assert_allclose(free.qd[0], 0.5 * 0.1 * 0.1 * 45.0, rtol=1e-12)


@pytest.mark.quick
def test_what_it_cannot_step_is_refused() -> None:
    def run(law: Any, **options: Any) -> Any:
        return jms.simulate(ramped_box.scene(law), [0.0], [0.0], 1.0, solver=SOLVER, **{"dt": 0.1, **options})

    with pytest.raises(ValueError, match=r"no estimate of its error: pass the step, as in dt=1e-3"):
        run(ramped_box.lugre(), dt=None)
    for law in (jms.Coulomb(1.0), jms.Sign(jms.Coulomb(1.0))):
        with pytest.raises(ValueError, match=r"'friction' has a force that jumps at rest .*Regularized"):
            run(law)
    with pytest.raises(ValueError, match=r"'friction' is a DeadZone.*Regularized"):
        run(jms.DeadZone(jms.Coulomb(1.0), width=0.1))
    floor = jms.Constraint(lambda t, q, p: q[1:], name="floor")
    leaning = jms.Friction(ramped_box.lugre(), along=lambda q: q[0], normal_force="floor")
    plane = lambda t, q, qd, p: 0.5 * p["m"] * jnp.sum(qd**2)  # noqa: E731
    scene = jms.Scene(plane, params={"m": 1.0}, effects=(leaning,), constraints=(floor,))
    with pytest.raises(ValueError, match=r"reaction of the constraint 'floor' for its load"):
        jms.simulate(scene, [0.0, 0.0], [0.0, 0.0], 1.0, dt=0.1, solver=SOLVER)
    with pytest.raises(ValueError, match=r"use it in jaxmodsim\.simulate"):
        dfx.diffeqsolve(dfx.ODETerm(lambda t, y, args: -y), SOLVER, 0.0, 1.0, 0.1, jnp.array(1.0))


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_roots_of_steep_functions(dtype: Any) -> None:
    """A level of 1 that is reached over any width, and a load above or below it."""
    widths, loads = np.meshgrid(np.logspace(-30, 1, 32), [1e-6, 0.5, 0.999, 1.0, 1.001, 30.0])

    def solve(width: Any, load: Any) -> Any:
        fn = lambda x: (x + 1e-3 * (-jnp.expm1(-x / width) - load), jnp.zeros_like(x))  # noqa: E731
        infinity, least = jnp.full_like(width, jnp.inf), jnp.full_like(width, jnp.finfo(dtype).tiny)
        root = rising_root(fn, 1e-3 * load, infinity, least)
        return root, fn(root.x)[0]

    roots, misfit = jax.jit(jax.vmap(solve))(widths.ravel().astype(dtype), loads.ravel().astype(dtype))
    assert roots.solved.all()
    assert (np.abs(misfit) <= 8e-3 * np.finfo(dtype).eps * loads.ravel().clip(1.0)).all()
    # 76; from jaxlib 0.11 on 111, as XLA rounds each operation and the function at a load of 1 ends in rounding.
    assert int(np.max(roots.evaluations)) < (100 if version("jaxlib").startswith("0.10.") else 120)


@pytest.mark.parametrize("blocks", [(1, 1, 1), (2, 2)])
def test_coupled_steep_equations(blocks: tuple[int, ...]) -> None:
    """Random masses, loads and widths over ten decades, with fewer coordinates than unknowns."""
    n, lanes, rng = sum(blocks), 500, np.random.default_rng(3)
    rows = rng.normal(size=(lanes, n, max(n - 1, 1)))
    coupling = np.einsum("nik,njk->nij", rows, rows)
    free = np.einsum("nik,nk->ni", rows, rng.normal(size=rows.shape[::2]) * 10.0 ** rng.uniform(-3, 1, (lanes, 1)))
    widths = 10.0 ** rng.uniform(-9, 1, (lanes, len(blocks)))

    def solve(free: Any, coupling: Any, widths: Any) -> Any:
        def fn(x: Any) -> Any:
            parts = jnp.split(x, np.cumsum(blocks)[:-1])
            return jnp.concatenate([p / jnp.sqrt(w**2 + jnp.sum(p**2)) for p, w in zip(parts, widths, strict=True)])

        found = solve_monotone(fn, free, coupling, blocks)
        misfit = found.x - free + jnp.sum(coupling * fn(found.x)[None, :], axis=1)
        return found.solved, jnp.max(jnp.abs(misfit)) / jnp.max(jnp.abs(free))

    solved, misfit = jax.jit(jax.vmap(solve))(free, coupling, widths)
    assert solved.all()
    assert np.max(misfit) < 1e-8


def test_a_step_with_falling_friction_is_solved() -> None:
    """The root lies beyond the first value of the search where friction falls with speed."""
    law, h = jms.LuGre(sigma0=1e4, sigma1=0.0, sigma2=1.0, Fc=2.0, Fs=3.0, vs=0.02), 7e-3
    rng = np.random.default_rng(0)
    free = rng.normal(size=300) * 10.0 ** rng.uniform(-3.0, -0.5, 300)
    z0 = rng.uniform(-2.5e-4, 2.5e-4, 300)

    def impulse(v: Any, z: Any) -> Any:
        after = law.step_exact(v, z, jnp.asarray(h))
        return law.force_given_zdot(v, after, (after - z) / h)

    solve = jax.vmap(lambda free, z: solve_monotone(lambda x: impulse(x, z), free[None], jnp.array([[h]]), (1,)))
    found = solve(jnp.asarray(free), jnp.asarray(z0))
    x = found.x[:, 0]
    assert found.solved.all()
    np.testing.assert_allclose(x + h * jax.vmap(impulse)(x, z0), free, rtol=0, atol=1e-15)


def test_derivatives_of_a_step_in_steady_slip() -> None:
    """The bristle does not change there, but its rate after a change of it is that of a whole step."""
    law = jms.LuGre(sigma0=1e4, sigma1=100.0, sigma2=1.0, Fc=2.0, Fs=3.0, vs=0.02)
    scene = jms.Scene(mass, {"m": 1.0, "force": 3.0}, (jms.AppliedForce(pull, name="pull"), jms.Friction(law)))

    @jax.jit
    def after(z: Any) -> Any:
        y = State(jnp.zeros(1), jnp.array([0.27318847]), {"friction": z})
        return scene_step(scene, jnp.array(0.0), jnp.array(4e-3), y)[0].qd[0]

    slope = central_difference(after, 2e-4, 1e-8)
    np.testing.assert_allclose([jax.jacfwd(after)(2e-4), jax.grad(after)(2e-4)], slope, rtol=1e-6)


def test_second_derivatives_of_a_step() -> None:
    """Against differences of first derivatives, in slip, in both modes."""
    scene = ramped_box.scene(ramped_box.lugre(sigma1=20.0))

    def after(x: Any) -> Any:
        y = State(jnp.zeros(1), x[:1], {"friction": 1e-3 * x[1]})
        return scene_step(scene, jnp.array(0.0), jnp.array(1e-2), y)[0].qd[0]

    x = jnp.array([0.1, 1.0])
    forward = jax.jacfwd(jax.jacfwd(after))(x)
    np.testing.assert_allclose(jax.hessian(after)(x), forward, rtol=1e-10)
    for i in range(2):
        slope = central_difference(lambda s, i=i: jax.jacfwd(after)(x.at[i].add(s)), 0.0, 1e-3)
        np.testing.assert_allclose(forward[i], slope, rtol=1e-6, atol=1e-9)
