"""Runs of scenes: what compiles when, derivatives, batches, arguments and energies."""

from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import jaxtyping
import numpy as np
import pytest

import jaxmodsim as jms
from jaxmodsim import problems
from jaxmodsim.simulation._solve import default_solver

from ..helpers.differences import central_difference, flat, gradient_by_differences

TRACES: list[int] = []


def lagrangian(t: Any, q: Any, qd: Any, p: Any) -> Any:
    """A spring-held mass; appends to TRACES whenever it is traced."""
    TRACES.append(1)
    return 0.5 * p["m"] * qd[0] ** 2 - 0.5 * p["k"] * (q[0] - p["a"] * jnp.sin(t)) ** 2


def excitation(t: Any, q: Any, qd: Any, p: Any) -> Any:
    del q, qd
    return jnp.reshape(p["F"] * jnp.cos(3.0 * t), (1,))


def belt_scene(**changes: Any) -> jms.Scene:
    """All that holds numbers: parameters, a LuGre law on a belt, a guide under a load, and a spring that is moved."""
    numbers = {"m": 1.2, "k": 40.0, "a": 0.05, "F": 1.5, "belt": 0.3, "load": 2.5, "sigma0": 300.0, "vs": 0.1} | changes
    belt, load, sigma0, vs = (numbers.pop(name) for name in ("belt", "load", "sigma0", "vs"))
    law = jms.LuGre(sigma0=sigma0, sigma1=2.0, sigma2=0.3, Fc=2.0, Fs=2.7, vs=vs)
    return jms.Scene(
        lagrangian,
        params=numbers,
        effects=(
            jms.AppliedForce(excitation),
            jms.Friction(law, belt_velocity=belt),
            jms.Friction(jms.Viscous(0.08), normal_force=load, name="guide"),
        ),
    )


TS = np.linspace(0.1, 1.5, 8)


def run_belt(scene: jms.Scene, **changes: Any) -> jms.Trajectory:
    arguments = {"q0": [0.02], "qd0": [0.1], "t1": 1.5, "ts": TS, "rtol": 1e-8, "z0": {"friction": 1e-4}} | changes
    return jms.simulate(scene, **arguments)


def test_changing_a_number_compiles_nothing() -> None:
    first = run_belt(belt_scene())
    before = first.forces, first.energy
    del before
    TRACES.clear()
    seen = [np.asarray(first.q)]
    for changes in ({"m": 1.3}, {"k": 41.0}, {"F": 1.6}, {"belt": 0.4}, {"load": 3.0}, {"sigma0": 280.0}):
        run = run_belt(belt_scene(**changes))
        seen.append(np.asarray(run.q))
        assert set(run.forces) == {"applied", "friction", "guide"}
    for number in (1.4, jnp.asarray(1.45)):  # put in as they are, both of a type that gives way to others
        run = run_belt(eqx.tree_at(lambda scene: scene.params["m"], belt_scene(), number))
        seen.append(np.asarray(run.q))
    for changes in (
        {"q0": [0.03]},
        {"qd0": np.array([0.2])},
        {"t1": 1.6},
        {"t0": 0.05},
        {"ts": TS + 1e-3, "t1": 2},
        {"rtol": 1e-5},
        {"atol": 1e-5},
        {"z0": {"friction": 2e-4}},
    ):
        run = run_belt(belt_scene(), **changes)
        seen.append(np.asarray(run.q))
    assert run.energy.balance.shape == TS.shape
    assert not TRACES, "a changed number was traced again"
    # Each of the changes has been seen by the run.
    assert len({array.tobytes() for array in seen if not np.array_equal(array, seen[0])}) == len(seen) - 1


FIXED: dict[str, Any] = {"t1": 0.6, "ts": None, "dt": 0.01, "max_steps": 64}


def end_of_fixed(x: Any, adjoint: Any = None) -> Any:
    scene, q0, qd0, z0, t1 = x
    run = run_belt(scene, **{**FIXED, "q0": q0, "qd0": qd0, "z0": {"friction": z0}, "t1": t1, "adjoint": adjoint})
    return run.q[-1, 0] + 0.1 * run.qd[-1, 0]


def fixed_point() -> Any:
    return belt_scene(belt=1.0, vs=0.5), jnp.array([0.02]), jnp.array([0.1]), jnp.array(1e-4), jnp.array(0.605)


@pytest.fixture(scope="module")
def reverse_gradient() -> Any:
    return jax.jit(jax.grad(end_of_fixed))(fixed_point())


def test_gradients_by_every_number_equal_finite_differences(reverse_gradient: Any) -> None:
    """By reverse mode, with fixed steps, where the run is one smooth function of its numbers.

    Slip keeps its sign: the belt stays faster than the mass, so that |v| in the law is smooth, too. With steps of
    1e-3 of each number, truncation is about 1e-12 times the fifth relative derivative, and rounding 1e-12 of the value.
    """
    slopes = gradient_by_differences(end_of_fixed, fixed_point(), 1e-3)
    ours = flat(reverse_gradient)
    assert ours.size == 4 + 7 + 3 + 4
    assert np.count_nonzero(ours) == ours.size
    np.testing.assert_allclose(ours, slopes, rtol=1e-6, atol=1e-9 * np.abs(slopes).max())


def test_forward_derivatives_equal_reverse(reverse_gradient: Any) -> None:
    """Also by `diffrax.ForwardMode`, which goes through the whole run and not only through its steps."""
    point = fixed_point()
    direction = jax.tree.map(lambda x: x * (1.0 + jnp.cos(x)), point)
    for adjoint in (None, dfx.ForwardMode()):
        forward = jax.jvp(lambda x: end_of_fixed(x, adjoint), (point,), (direction,))[1]  # noqa: B023
        np.testing.assert_allclose(forward, flat(direction) @ flat(reverse_gradient), rtol=1e-10)
    linear = jax.linearize(end_of_fixed, point)[1]
    np.testing.assert_allclose(linear(direction), flat(direction) @ flat(reverse_gradient), rtol=1e-10)


def test_a_batch_equals_a_loop_and_a_sick_lane_harms_no_other() -> None:
    """Lanes: two sound ones, a NaN in the Lagrangian, a parameter out of range, a field of NaN on the way."""
    changes: list[dict[str, Any]] = [{}, {"F": float("nan")}, {"sigma0": 200.0}, {"m": -1.0}, {"k": 60.0}]
    scenes = [belt_scene(**c) for c in changes]
    bad = eqx.tree_at(lambda s: s.effects[1].law.Fc, scenes[0], jnp.array(5.0))  # above Fs
    scenes.append(bad)
    batch = jax.tree.map(lambda *x: jnp.stack(x), *scenes)

    # Tighter than the comparison: rounding differs in a batch, and with it the steps.
    def run(scene: jms.Scene) -> jms.Trajectory:
        return run_belt(scene, throw=False, rtol=1e-11, atol=1e-14)

    runs = jax.vmap(run)(batch)
    assert runs.q.shape == (6, 8, 1)
    np.testing.assert_array_equal(runs.result.ok, [True, False, True, False, True, False])
    messages = [runs.result.messages[code] for code in np.asarray(runs.code)]
    assert "not finite" in messages[1]
    assert "mass matrix is singular or indefinite at coordinate q[0]" in messages[3]
    assert "LuGre: Fs must be finite and >= Fc [N] (at scene.effects[1].law)" in messages[5]
    assert runs.result.message.startswith("3 x The run reached t1.")
    alone = jax.jit(run)  # compiled here, as the batch is
    for lane in (0, 2, 4):
        single = alone(scenes[lane])
        np.testing.assert_allclose(runs.q[lane], single.q, rtol=1e-10, atol=1e-14)
    with pytest.raises(ValueError, match=r"holds a batch of runs.*jax.vmap\(lambda run: run.forces\)"):
        _ = runs.forces
    forces = jax.vmap(lambda run: run.forces)(runs)["friction"]
    np.testing.assert_allclose(forces[2], alone(scenes[2]).forces["friction"], rtol=1e-8)


def test_single_precision_is_kept_under_x64() -> None:
    scene = jax.tree.map(lambda x: x.astype(jnp.float32), belt_scene())
    single, double = run_belt(scene, rtol=1e-5), run_belt(belt_scene())
    arrays = [single.t, single.q, single.qd, single.z, single.forces]
    assert {leaf.dtype for leaf in jax.tree.leaves(arrays)} == {np.dtype(np.float32)}
    # A few roundings of 6e-8 in each of some hundred steps, and the tolerance, of motions of a few centimetres.
    np.testing.assert_allclose(single.q, double.q, atol=2e-5)


def test_own_states_start_where_they_are_told() -> None:
    run = run_belt(belt_scene(), ts=np.array([0.0, 1.5, *np.full(6, 1.5)]))
    np.testing.assert_allclose(run.z["friction"][0], 1e-4)
    with pytest.raises(ValueError, match="z0 names 'guide', but the effects with a state of their own are: friction"):
        run_belt(belt_scene(), z0={"guide": 0.0})
    with pytest.raises(ValueError, match="must have the structure of"):
        run_belt(belt_scene(), z0={"friction": (1.0, 2.0)})


def test_energy_balance_on_a_belt() -> None:
    """The bristle's energy and the belt's work included, over stick and slip."""
    energy = run_belt(belt_scene(), t1=6.0, ts=np.linspace(0, 6, 8), rtol=1e-10, atol=1e-12).energy
    assert abs(float(energy.work_in[-1])) > 0.1
    assert float(energy.dissipated[-1]) > 0.1
    assert float(jnp.max(energy.stored)) > 1e-4
    assert (np.diff(np.asarray(energy.dissipated)) > 0).all()
    # Local tolerances of 1e-10 of energies near one, over a thousand steps.
    np.testing.assert_allclose(energy.balance, 0.0, atol=1e-8)


def test_energy_balance_of_a_lagrangian_that_depends_on_time() -> None:
    """A spring whose far end is moved, as a run of its own without effects, checked against its closed form."""
    scene = eqx.tree_at(lambda s: s.effects, belt_scene(k=1.2 * 4.0), ())
    run = run_belt(scene, z0=None, t1=6.0, ts=np.linspace(0, 6, 25), rtol=1e-10, atol=1e-12)
    # x'' + 4 x = 4 a sin t: x = A cos 2t + B sin 2t + (4/3) a sin t.
    b = (0.1 - 4 / 3 * 0.05) / 2
    exact = 0.02 * np.cos(2 * run.t) + b * np.sin(2 * run.t) + 4 / 3 * 0.05 * np.sin(run.t)
    np.testing.assert_allclose(run.q[:, 0], exact, atol=1e-9)
    energy = run.energy
    assert float(jnp.max(jnp.abs(energy.work_in))) > 1e-3
    np.testing.assert_array_equal(energy.dissipated, 0.0)
    np.testing.assert_allclose(energy.balance, 0.0, atol=1e-9)


def test_default_solver() -> None:
    smooth = problems.ramped_box.scene(jms.Viscous(0.1))
    assert isinstance(default_solver(smooth, 1, fixed_step=False), dfx.Tsit5)
    assert isinstance(default_solver(problems.ramped_box.scene(), 1, fixed_step=False), dfx.Tsit5)
    assert isinstance(
        default_solver(problems.ramped_box.scene(jms.Sign(jms.Coulomb(1.0))), 1, fixed_step=False), dfx.Tsit5
    )
    assert isinstance(
        default_solver(problems.ramped_box.scene(problems.ramped_box.lugre()), 1, fixed_step=False), jms.Rodas5P
    )
    assert isinstance(
        default_solver(problems.ramped_box.scene(jms.Regularized(jms.Coulomb(1.0), 0.1)), 1, fixed_step=False),
        jms.Rodas5P,
    )
    exact = problems.ramped_box.scene(jms.Coulomb(1.0))
    assert isinstance(default_solver(exact, 1, fixed_step=False), jms.Rodas5P)
    assert isinstance(default_solver(exact, 2, fixed_step=False), dfx.Tsit5)
    # Nothing rejects a spoilt step where steps are fixed, so there the elimination swaps rows.
    fixed = default_solver(problems.ramped_box.scene(problems.ramped_box.lugre()), 1, fixed_step=True)
    assert isinstance(fixed, jms.Rodas5P)
    assert fixed.pivot


def ramp_to(**arguments: Any) -> jms.Trajectory:
    """Box without friction: v = v0 + ramp t^2/(2 m), x = v0 t + ramp t^3/(6 m), exact for methods of order 3 and up."""
    return jms.simulate(problems.ramped_box.scene(), [0.0], [0.5], 3.0, **arguments)


@pytest.mark.quick
def test_frictionless_run_and_its_shapes() -> None:
    ts = jnp.linspace(0.0, 3.0, 7)
    run, end = ramp_to(ts=ts), ramp_to()
    np.testing.assert_allclose(run.t, ts)
    np.testing.assert_allclose(run.q[:, 0], 0.5 * ts + ts**3 / 12.0, atol=1e-12)
    np.testing.assert_allclose(run.qd[:, 0], 0.5 + ts**2 / 4.0, atol=1e-12)
    np.testing.assert_allclose(run.forces["pull"][:, 0], ts)
    assert run.z == {}
    assert (end.t.shape, end.q.shape, end.qd.shape) == ((1,), (1, 1), (1, 1))
    np.testing.assert_allclose(end.q, run.q[-1:], rtol=1e-12)
    assert bool(run.result.ok)
    assert str(run.result) == "The run reached t1."
    assert run.events.t.shape == (0,)


@pytest.mark.parametrize("solver", [dfx.Kvaerno5(), dfx.Tsit5(), jms.Rodas5P()], ids=lambda s: type(s).__name__)
def test_solvers_of_the_users_choice(solver: Any) -> None:
    run = ramp_to(solver=solver)
    # The motion is a cubic, so the error is that of Kvaerno5's Newton iteration at most.
    np.testing.assert_allclose(run.q[0, 0], 0.5 * 3 + 27 / 12, rtol=1e-7)


def test_a_fixed_step_is_kept() -> None:
    run = ramp_to(dt=0.03, solver=dfx.Euler(), ts=jnp.linspace(0.0, 3.0, 5))
    assert int(run.stats["num_steps"]) == 100
    # Euler's own sums: v = v0 + ramp h^2/m n(n-1)/2.
    n = np.round(np.asarray(run.t) / 0.03)
    np.testing.assert_allclose(run.qd[:, 0], 0.5 + 0.03**2 / 2 * n * (n - 1) / 2, rtol=1e-12)


def test_a_run_of_no_length() -> None:
    run = jms.simulate(problems.ramped_box.scene(), [0.0], [0.5], 0.0)
    np.testing.assert_array_equal(run.q, [[0.0]])
    np.testing.assert_array_equal(run.qd, [[0.5]])


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"t1": -1.0}, "t1 must not be before t0, but t0 = 0.0 and t1 = -1.0"),
        ({"t1": 1.0, "t0": 2.0}, "t1 must not be before t0"),
        ({"t1": float("nan")}, "t1 must be finite"),
        ({"q0": [float("inf")]}, "q0 must be finite"),
        ({"q0": 0.0}, r"q0 and qd0 must both have the shape \[dof\], but q0 has the shape \(\)"),
        ({"q0": [0.0, 0.0]}, r"q0 has the shape \(2,\) and qd0 \(1,\)"),
        ({"q0": [], "qd0": []}, r"must both have the shape \[dof\]"),
        ({"q0": ["a"]}, "q0 must hold real numbers"),
        ({"qd0": [1j]}, "qd0 must hold real numbers"),
        ({"q0": [[0.0], [0.0, 1.0]]}, "q0 must hold real numbers"),
        ({"ts": [1.0, 0.5]}, "ts must increase"),
        ({"ts": [0.5, 3.5]}, r"ts must lie within \[t0, t1\] = \[0.0, 3.0\], but runs from 0.5 to 3.5"),
        ({"ts": 1.0}, r"ts must be a vector of times, shape \[time\]"),
        ({"ts": []}, "ts must be a vector of times"),
        ({"rtol": -1e-3}, "rtol must not be negative"),
        ({"rtol": 0.0, "atol": 0.0}, "rtol and atol must not both be zero"),
        ({"rtol": [1e-3]}, r"rtol must be one number, but has the shape \(1,\)"),
        ({"dt": 0.0}, "dt must be positive"),
        ({"dt": -0.1}, "dt must be positive"),
        ({"max_steps": 0}, "max_steps must be a positive integer, but 0"),
        ({"max_steps": 10.0}, "max_steps must be a positive integer"),
        ({"solver": "tsit5"}, "solver must be a diffrax.AbstractSolver object, but 'tsit5'"),
        ({"solver": dfx.Tsit5}, "solver must be a diffrax.AbstractSolver object"),
        ({"adjoint": "reverse"}, "adjoint must be a diffrax.AbstractAdjoint object"),
        ({"z0": {"pull": 0.0}}, "z0 names 'pull', but the effects with a state of their own are: none"),
        ({"scene": "box"}, "simulate needs a Scene, but a str was given"),
    ],
)
def test_wrong_arguments_are_refused(changes: dict[str, Any], text: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)  # as users have it, who get our own words
    arguments = {"scene": problems.ramped_box.scene(), "q0": [0.0], "qd0": [0.5], "t1": 3.0} | changes
    with pytest.raises(ValueError, match=text):
        jms.simulate(**arguments)


def page_lagrangian(t: Any, q: Any, qd: Any, p: Any) -> Any:
    del t, q
    return 0.5 * p["m"] * qd[0] ** 2


def test_the_page_of_code_that_must_always_work() -> None:
    scene = jms.Scene(
        page_lagrangian,
        params={"m": 2.0},
        effects=(
            jms.AppliedForce(lambda t, q, qd, p: jnp.array([1.0 * t])),
            jms.Friction(jms.LuGre(sigma0=750.0, sigma1=0.0, sigma2=0.1, Fc=1.5, Fs=1.75, vs=0.2)),
        ),
    )
    run = jms.simulate(scene, q0=[0.0], qd0=[0.0], t1=10.0, ts=jnp.linspace(0.0, 10.0, 1001))
    assert (run.t.shape, run.q.shape, run.qd.shape) == ((1001,), (1001, 1), (1001, 1))
    assert set(run.forces) == {"applied", "friction"}
    assert run.forces["friction"].shape == (1001,)
    assert run.events.effect.shape == (0,)
    for part in (run.energy.kinetic, run.energy.potential, run.energy.work_in, run.energy.dissipated):
        assert part.shape == (1001,)
    # At the default tolerance of 1e-6, over energies up to 250 J.
    np.testing.assert_allclose(run.energy.balance, 0.0, atol=1e-2)

    gradient = jax.grad(lambda s: jms.simulate(s, q0=[0.0], qd0=[0.0], t1=10.0).q[-1, 0])(scene)
    assert jax.tree.structure(gradient) == jax.tree.structure(scene)

    def end(m: float, Fc: float) -> Any:
        changed = eqx.tree_at(lambda s: (s.params["m"], s.effects[1].law.Fc), scene, (jnp.array(m), jnp.array(Fc)))
        return jms.simulate(changed, q0=[0.0], qd0=[0.0], t1=10.0, rtol=1e-10, atol=1e-12).q[-1, 0]

    # The gradient is that of the motion, to the run's own tolerance and some; the differences are far more exact.
    np.testing.assert_allclose(gradient.params["m"], central_difference(lambda m: end(m, 1.5), 2.0, 0.02), rtol=1e-4)
    by_fc = central_difference(lambda Fc: end(2.0, Fc), 1.5, 0.01)
    np.testing.assert_allclose(gradient.effects[1].law.Fc, by_fc, rtol=1e-4)


@pytest.mark.parametrize(("ts", "probe"), [(None, False), (jnp.linspace(0.0, 3.0, 7), False), (None, True)])
def test_gradients_under_vmap_are_right_in_lanes_that_finish_early(ts: Any, probe: bool) -> None:
    """Finished lanes take steps of length zero until the last one is through; these must not reach the derivative."""
    scene = problems.ramped_box.scene(problems.ramped_box.lugre())

    def position(m: Any) -> Any:
        changed = eqx.tree_at(lambda s: s.params["m"], scene, m)
        run = jms.simulate(changed, [0.0], [0.0], 3.0, ts=ts, adjoint=jms.StoredSteps(probe=probe))
        return run.q[-1, 0]

    masses = jnp.array([1.0, 3.0, 2.0])
    gradients = jax.jit(jax.vmap(jax.grad(position)))
    together = gradients(masses)
    # By the program for one lane; with times, whose derivatives are the same there, by lanes that are all alike.
    alone = jax.jit(jax.grad(position)) if ts is None else lambda m: gradients(jnp.full(3, m))[0]
    # Without a probe lanes take the same steps as alone, so only rounding differs. With one, stability limits the steps
    # of a bristle at rest, and rounding decides which of them are accepted: derivatives agree to the tolerance.
    np.testing.assert_allclose(together, [alone(m) for m in masses], rtol=1e-6 if probe else 1e-8)


def test_times_that_are_arrays_of_jax_are_known_inside_jit() -> None:
    end = jnp.asarray(1.5)
    found = jax.jit(lambda v: run_belt(belt_scene(), qd0=v, t0=jnp.asarray(0.0), t1=end).q)(jnp.asarray([0.1]))
    np.testing.assert_allclose(found, run_belt(belt_scene()).q, rtol=1e-7)
