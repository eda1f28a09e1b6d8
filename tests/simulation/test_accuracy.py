"""`simulate_to_accuracy`: the accuracy is met on every named problem, or its lack is said."""

import math
import pickle
from typing import Any

import diffrax as dfx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
import pytest

import jaxmodsim as jms
from jaxmodsim.problems import n_link_pendulum, named_problems
from jaxmodsim.simulation import named_series

# Each problem compiles two methods. Of alike ones the cheaper to compile is here.
NAMES = (
    "lugre_box",
    "slipping_bristle",
    "braked_spring",
    "belt_oscillator",
    "spherical_pendulum",
    "double_pendulum",
    "charged_particle",
    "knife_edge",
)
CHAOTIC, CHAOS = ([3.0, 3.1], [0.0, 0.0]), 30.0


def motion(run: jms.Trajectory) -> np.ndarray:
    return np.concatenate([run.q, run.qd], axis=1)


def relative(one: np.ndarray, other: np.ndarray) -> float:
    return float(np.max(np.abs(one - other) / np.maximum(np.max(np.abs(other), axis=0), 1e-6)))


@pytest.mark.parametrize("name", NAMES)
def test_accuracy_is_met(name: str) -> None:
    case = named_problems()[name]()
    own = case.observable == "friction"
    settings: dict[str, Any] = {"ts": np.linspace(0.0, case.t1, 11), "max_steps": case.max_steps}

    def observed(run: jms.Trajectory) -> np.ndarray:
        return np.asarray(named_series(run, "friction")) if own else motion(run)

    # Far beyond what is asked for, by the method that is less used.
    stiff = any(effect.stiff for effect in case.scene.effects)
    solver = dfx.Kvaerno5() if stiff else dfx.Dopri8()
    reference = jms.simulate(case.scene, case.q0, case.qd0, case.t1, solver=solver, rtol=1e-11, atol=1e-14, **settings)
    for asked in (1e-3, 1e-5, 1e-8):
        run = jms.simulate_to_accuracy(
            case.scene,
            case.q0,
            case.qd0,
            case.t1,
            accuracy=asked,
            observable="friction" if own else None,
            **settings,
        )
        found = run.accuracy
        assert found is not None
        assert found.reached
        error = relative(observed(run), observed(reference))
        if case.exact is not None:
            series = np.asarray(named_series(run, case.observable))
            error = max(error, abs(float(series[-1]) - case.exact) / np.max(np.abs(series)))
        assert error <= asked
        assert error <= 3 * found.estimate <= 3 * asked
        # No looser run of the same method would have done with less work.
        name_of = type(found.solver).__name__
        looser = [each for each in found.attempts if each.rtol > found.rtol and each.solver == name_of]
        assert all(each.estimate > asked or each.num_steps >= found.num_steps for each in looser)


@pytest.fixture(scope="module")
def pendulum() -> jms.Trajectory:
    return jms.simulate_to_accuracy(
        n_link_pendulum.double_pendulum(), [2.0, 1.5], [0.0, 0.0], 3.0, ts=np.linspace(0.0, 3.0, 11), accuracy=1e-6
    )


def test_report(pendulum: jms.Trajectory) -> None:
    found = pendulum.accuracy
    assert found is not None
    assert found.asked == 1e-6
    assert found.num_steps == int(pendulum.stats["num_steps"])
    assert {each.solver for each in found.attempts} == {"Tsit5", "Dopri8"}
    chosen = [each for each in found.attempts if (each.solver, each.rtol) == (type(found.solver).__name__, found.rtol)]
    assert [(each.num_steps, each.estimate, each.atol) for each in chosen] == [
        (found.num_steps, found.estimate, found.atol)
    ]
    work = {each: each.num_steps * (each.evaluations or 0) for each in found.attempts if each.estimate <= 1e-6}
    assert min(work.values()) == work[chosen[0]]
    assert 1.0 < found.cost_scaling.better < 2.0
    assert 0.5 < found.cost_scaling.worse < 1.0
    text = str(found)
    assert f"{found.num_steps} steps" in text
    assert len(text.splitlines()) == 3 + len(found.attempts)
    copied = pickle.loads(pickle.dumps(pendulum)).accuracy
    assert str(copied) == text


def test_prediction_of_steps(pendulum: jms.Trajectory) -> None:
    assert pendulum.accuracy is not None
    for asked, ratio in ((1e-7, pendulum.accuracy.cost_scaling.better), (1e-5, pendulum.accuracy.cost_scaling.worse)):
        run = again(pendulum, accuracy=asked, solver=pendulum.accuracy.solver)
        assert run.stats["num_steps"] / pendulum.stats["num_steps"] == pytest.approx(ratio, rel=0.3)


def again(run: jms.Trajectory, **options: Any) -> jms.Trajectory:
    p = run.request
    simulate = jms.simulate_to_accuracy if "accuracy" in options else jms.simulate
    return simulate(p.scene, p.q0, p.qd0, p.t1, ts=p.ts, **options)


def test_options_make_the_same_run(pendulum: jms.Trajectory) -> None:
    assert pendulum.accuracy is not None
    run = again(pendulum, **pendulum.accuracy.options)
    assert run.accuracy is None
    np.testing.assert_array_equal(run.q, pendulum.q)


def test_given_solver_is_kept(pendulum: jms.Trajectory) -> None:
    run = again(pendulum, accuracy=1e-6, solver=dfx.Tsit5())
    assert run.accuracy is not None
    assert isinstance(run.accuracy.solver, dfx.Tsit5)
    assert relative(motion(run), motion(pendulum)) <= 2e-6


def test_observable_function(pendulum: jms.Trajectory) -> None:
    """Of one number the scale is its own magnitude."""
    run = again(pendulum, accuracy=1e-4, observable=lambda run: run.q[-1, 0])
    tight = again(pendulum, solver=dfx.Dopri8(), rtol=1e-12, atol=1e-14)
    assert abs(run.q[-1, 0] / tight.q[-1, 0] - 1.0) <= 1e-4
    for bad in (lambda run: run.events.t, lambda run: run.q[:, :, None], lambda run: run.q > 0):
        with pytest.raises(ValueError, match="observable must return real numbers"):
            again(pendulum, accuracy=1e-4, observable=bad)
    with pytest.raises(ValueError, match="not finite"):
        again(pendulum, accuracy=1e-4, observable=lambda run: run.q / 0)
    with pytest.raises(ValueError, match="No observable has the name 'x'"):
        again(pendulum, accuracy=1e-4, observable="x")


@pytest.mark.parametrize("observable", [None, lambda run: run.q[-1, 0]])
def test_chaos_is_said(pendulum: jms.Trajectory, observable: Any) -> None:
    scene, ts = pendulum.scene, np.linspace(0.0, CHAOS, 11)
    with pytest.raises(jms.SimulationError, match=r"accuracy=0\.001 was not reached.*chaotic"):
        jms.simulate_to_accuracy(scene, *CHAOTIC, CHAOS, ts=ts, accuracy=1e-3, observable=observable)
    run = jms.simulate_to_accuracy(scene, *CHAOTIC, CHAOS, ts=ts, accuracy=1e-3, observable=observable, throw=False)
    assert run.accuracy is not None
    assert not run.accuracy.reached
    assert run.accuracy.estimate > 1e-3
    assert run.accuracy.remark in str(run.accuracy)


def test_rounding_is_said(pendulum: jms.Trajectory) -> None:
    with pytest.raises(jms.SimulationError, match=r"accuracy=1e-12 was not reached.*rounding"):
        jms.simulate_to_accuracy(pendulum.scene, *CHAOTIC, 10.0, ts=np.linspace(0.0, 10.0, 11), accuracy=1e-12)


def test_float32_floor_is_named(pendulum: jms.Trajectory) -> None:
    p = jtu.tree_map(lambda x: jnp.asarray(x, "float32"), pendulum.request)
    run = jms.simulate_to_accuracy(p.scene, p.q0, p.qd0, p.t1, ts=p.ts, accuracy=1e-3)
    assert run.q.dtype == jnp.float32
    assert relative(motion(run), motion(pendulum)) <= 1e-3
    with pytest.raises(jms.SimulationError, match=r"differ by .* float32, whose rounding is 1e-07: .*float64"):
        jms.simulate_to_accuracy(p.scene, p.q0, p.qd0, p.t1, ts=p.ts, accuracy=1e-8)


def test_too_few_steps_are_said(pendulum: jms.Trajectory) -> None:
    with pytest.raises(jms.SimulationError, match=r"needs runs at rtol 1e-08 for comparison\. The step limit"):
        again(pendulum, accuracy=1e-6, max_steps=16)
    run = again(pendulum, accuracy=1e-6, max_steps=16, throw=False)
    assert run.accuracy is None
    assert not run.result.ok
    assert math.isfinite(run.t_end)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"accuracy": 1e-15}, r"within \[1e-12, 0\.1\], but 1e-15"),
        ({"accuracy": 0.5}, r"within \[1e-12, 0\.1\], but 0\.5"),
        ({"accuracy": 1e-6, "solver": jms.Gauss()}, "Gauss takes fixed steps"),
    ],
)
def test_misuse(pendulum: jms.Trajectory, options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        again(pendulum, **options)


def test_traced_numbers_are_refused(pendulum: jms.Trajectory) -> None:
    def last(q0: Any) -> Any:
        return jms.simulate_to_accuracy(pendulum.scene, q0, [0.0, 0.0], 3.0, accuracy=1e-6).q[-1, 0]

    for trace in (jax.jit(last), jax.vmap(lambda s: last(s * jnp.ones(2))), jax.grad(last)):
        with pytest.raises(ValueError, match=r"\*\*run\.accuracy\.options"):
            trace(jnp.asarray([2.0, 1.5]))
    with pytest.raises(ValueError, match=r"sweep takes no argument 'accuracy'"):
        jms.sweep(pendulum.scene, over={"q0": np.ones((2, 2))}, qd0=[0.0, 0.0], t1=1.0, accuracy=1e-6)
