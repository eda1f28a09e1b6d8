"""Every objective of a fit: its derivatives, and that it gives the truth back."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxmodsim as jms
from jaxmodsim.identify import (
    Cauchy,
    Controller,
    Huber,
    MultipleShooting,
    SquaredLoss,
    Staged,
    start_state,
)
from jaxmodsim.identify.estimate._prepare import FitOptions, prepare
from jaxmodsim.identify.model._engines import delayed, run_samples
from jaxmodsim.identify.model._observe import observer
from jaxmodsim.problems import belt_oscillator
from jaxmodsim.scene import State, replace_numbers

from ..helpers.sprung import lagrangian, sprung_mass

DT = 4e-3
TRUTH = {"m": 2.0, "friction.Fc": 1.5, "friction.sigma0": 600.0}


def _drive(t, q, qd, p):
    del t, q, qd
    return jnp.reshape(p["gain"] * p["u"], (1,))


DRIVE = jms.AppliedForce(_drive, name="drive")


def sprung(m=2.0, Fc=1.5, sigma0=600.0):
    # Fs is not free in these fits and keeps its distance from Fc.
    law = jms.LuGre(sigma0=sigma0, sigma1=5.0, sigma2=0.6, Fc=Fc, Fs=Fc + 0.5, vs=0.1)
    return sprung_mass(DRIVE, jms.Friction(law), m=m, gain=1.0)


def options(**changes):
    return FitOptions(**{"observe": "q[0]", "accuracy": 1e-9, **changes})


OBSERVED = (("x", "q[0]"), ("v", "qd[0]"), ("F", "friction"))
NOISE = {"x": 1e-4, "v": 1e-3, "F": 1e-2}


def record(samples=300, seed=0, late=0.0, linear=(), noise=1.0, start=(0.0, 0.0), name="record", controller=None):
    """A noisy record of the truth; the drive acts `late` seconds later than recorded."""
    t = np.arange(samples) * DT
    u = 4.0 * np.sin(2 * np.pi * 0.9 * t + seed) + 2.0 * np.sin(2 * np.pi * 2.3 * t)
    scene = sprung()
    inputs = delayed(jnp.asarray(t), {"u": jnp.asarray(u)}, frozenset(linear), {"delay.u": jnp.asarray(late)})
    y0 = State(jnp.asarray([start[0]]), jnp.asarray([start[1]]), scene.initial_state(jnp.zeros(1)))
    run = jax.jit(
        lambda inputs: run_samples(
            scene, jnp.asarray(t), inputs, y0, observer(OBSERVED), linear=frozenset(linear), controller=controller
        )[0]
    )
    rng = np.random.default_rng(seed)
    seen = {k: np.asarray(x) + noise * NOISE[k] * rng.standard_normal(samples) for k, x in run(inputs).items()}
    return jms.Record(t, seen, {"u": u}, name=name, linear=linear, noise=NOISE)


def only_x(full):
    return jms.Record(full.t, full.channels["x"], full.inputs, full.name, linear=full.linear, noise=NOISE["x"])


@pytest.fixture(scope="module")
def full():
    return record()


@pytest.fixture(scope="module")
def belt():
    scene = belt_oscillator.scene(jms.Stribeck(**belt_oscillator.STRIBECK))
    t = np.linspace(0.0, 3.2, 321)
    run = jms.simulate(scene, [0.0], [0.0], 3.2, ts=t, rtol=1e-9, atol=1e-11)
    events = run.events
    slips = np.asarray(events.t)[np.asarray((events.before == 0) & jnp.isfinite(events.t))]
    rng = np.random.default_rng(1)
    x = np.asarray(run.q[:, 0]) + 1e-4 * rng.standard_normal(t.size)
    noise = {"measured": 1e-4, "friction slips": 1e-3}
    return jms.Record(t, x, noise=noise, slips={"friction": slips + 1e-3 * rng.standard_normal(slips.size)})


def _hold(t, q, qd, memory, p):
    del t
    error = p["u"] * 0.01 - q[0]
    memory = memory + DT * error
    return {"u": p["P"] * error - 4.0 * qd[0] + 100.0 * memory}, memory


def held():
    scene = sprung()
    return jms.Scene(scene.lagrangian, params={**scene.params, "P": 300.0}, effects=scene.effects)


OBJECTIVES = {
    "position": (sprung, "x", ("m", "friction.Fc", "friction.sigma0"), {}),
    "position, velocity and force": (sprung, "all", ("m", "friction.Fc"), {"observe": dict(OBSERVED)}),
    "initial state": (sprung, "x", ("gain", "q0", "qd0[0]", "z0.friction"), {}),
    "delay of a held input": (sprung, "x", ("delay.u", "m"), {"delay": {"u": 0.0031}}),
    "outliers": (sprung, "x", ("m", "friction.Fc"), {"loss": Huber(1.0)}),
    "windows": (sprung, "x", ("m", "friction.Fc"), {"shooting": MultipleShooting(0.4, (1e-4, 1e-2))}),
    "known before": (sprung, "x", ("m", "friction.Fc"), {"prior": {"m": (1.9, 0.01)}}),
    "in a loop": (held, "x", ("P", "m"), {"controller": Controller(_hold, 0.0)}),
}


def gradient_and_differences(problem, x, steps):
    """Gradient of the cost, and central differences of it."""
    evaluate = eqx.filter_jit(lambda problem, x: problem.evaluate(x))
    residual, jacobian = evaluate(problem, x)
    weighted, slopes = problem.loss.weighted(residual, jacobian)
    exact, differences = np.asarray(slopes.T @ weighted), []
    for i, step in enumerate(steps):
        up, down = (float(problem.loss.cost(evaluate(problem, x.at[i].add(s))[0])) for s in (step, -step))
        differences.append((up - down) / (2 * step))
    return exact, np.array(differences)


@pytest.mark.parametrize("name", OBJECTIVES)
def test_gradient_of_every_objective_equals_finite_differences(name, full):
    scene, which, free, asked = OBJECTIVES[name]
    problem = prepare(scene(), full if which == "all" else only_x(full), free, options(**asked)).problem
    # Off the start, so that no coordinate lies on its limit and nothing vanishes by symmetry.
    x = problem.x0 + 0.01 * jnp.sin(jnp.arange(1.0, problem.x0.size + 1)) * (
        jnp.where(jnp.arange(problem.x0.size) < len(problem.free.names), 1.0, 1e-2)
    )
    if "delay.u" in free:
        x = x.at[0].set(0.0031)
    # Central differences: 1e-6 balances its square against rounding of 1e-16/1e-6 of a cost of some thousands.
    exact, differences = gradient_and_differences(problem, x, [1e-6] * x.size)
    np.testing.assert_allclose(exact, differences, rtol=2e-5, atol=1e-6 * np.max(np.abs(exact)))


def test_gradient_of_a_fit_through_events_equals_finite_differences(belt):
    scene = belt_oscillator.scene(jms.Stribeck(**belt_oscillator.STRIBECK))
    free = ("friction.Fc", "friction.Fs", "k")
    problem = prepare(scene, belt, free, options(q0=[0.0], qd0=[0.0])).problem
    x = problem.x0 + jnp.asarray([0.01, -0.02, 0.015])
    # Larger steps than above: event times are found to the accuracy of the run, not to rounding.
    exact, differences = gradient_and_differences(problem, x, [1e-4] * 3)
    np.testing.assert_allclose(exact, differences, rtol=1e-4)


def test_fit_through_events_finds_back_from_half_wrong(belt):
    start = belt_oscillator.scene(jms.Stribeck(Fc=2.5, Fs=12.0, vs=0.1, Fv=0.3), k=150.0)
    result = jms.fit(start, belt, ("friction.Fc", "friction.Fs", "friction.vs", "k"), q0=[0.0], initializer=Staged())
    assert result.diagnostics.ending == "converged"
    for name, true in {"friction.Fc": 5.0, "friction.Fs": 8.0, "friction.vs": 0.2, "k": 100.0}.items():
        assert abs(result.values[name] - true) < 4.5 * result.errors[name] < 0.1 * true
    assert result.diagnostics.rmse["measured"] == pytest.approx(1e-4, rel=0.15)


def test_channels_and_records_together(full):
    start = sprung(1.6, 1.2, 900.0)
    other = record(samples=220, seed=3, start=(0.02, -0.1), name="other")
    free = (*TRUTH, "q0[0]", "qd0[0]")
    result = jms.fit(start, [full, other], free, observe=dict(OBSERVED), limits={"m": (0.0, None)})
    assert result.diagnostics.ending == "converged"
    truth = TRUTH | {"record/qd0[0]": 0.0, "other/q0[0]": 0.02, "other/qd0[0]": -0.1}
    for name, true in truth.items():
        assert abs(result.values[name] - true) < 4.5 * result.errors[name]
    assert set(result.diagnostics.rmse) == {"x", "v", "F"}
    for name, level in NOISE.items():
        assert result.diagnostics.rmse[name] == pytest.approx(level, rel=0.15)
    assert [len(each["x"]) for each in result.provenance.outputs] == [300, 220]


def test_noise_levels_are_estimated_where_none_are_given(full):
    bare = jms.Record(full.t, full.channels, full.inputs)
    result = jms.fit(sprung(1.9, 1.4), bare, tuple(TRUTH), q0=[0.0], observe=dict(OBSERVED), limits={"m": (0.0, None)})
    for name, level in NOISE.items():
        assert result.diagnostics.noise[name] == pytest.approx(level, rel=0.15)


@pytest.mark.parametrize("linear", [(), ("u",)])
def test_a_delay_of_a_fraction_of_a_sample_is_found(linear):
    late = record(late=0.0062, linear=linear)
    result = jms.fit(sprung(), only_x(late), ("delay.u", "m"), q0=[0.0])
    assert abs(result.values["delay.u"] - 0.0062) < 4.5 * result.errors["delay.u"] < 1e-3
    assert result.estimate.units["delay.u"] == "s"


@pytest.mark.parametrize("linear", [(), ("u",)])
def test_more_steps_resolve_a_delay_of_a_fraction_of_a_sample(linear):
    # The same input on a grid of which the delay is a whole number of intervals.
    n, h, share = 120, 0.05, 0.4
    t, fine = h * np.arange(n), h / 10 * np.arange(10 * n - 9)
    u, scene, rest = 3.0 * np.sin(4.0 * t), sprung_mass(DRIVE, jms.Friction(jms.Viscous(0.6)), gain=1.0), jnp.zeros(1)
    before = fine - share * h
    held = u[np.maximum(np.floor(before / h + 1e-9), 0).astype(int)]
    late = {"u": jnp.asarray(np.interp(before, t, u) if linear else held)}
    look = lambda t, y, scene, mode: y.q[0]  # noqa: E731
    y0 = State(rest, rest, scene.initial_state(rest))
    exact, _ = run_samples(scene, jnp.asarray(fine), late, y0, look, linear=frozenset(linear))
    data, errors = jms.Record(t, np.asarray(exact)[::10], {"u": u}, linear=linear), []
    for substeps in (1, 5, 10):
        chosen = options(observe="q[0]", q0=[0.0], qd0=[0.0], delay={"u": share * h}, substeps=substeps)
        problem = prepare(scene, data, ("m",), chosen).problem
        errors.append(float(jnp.max(jnp.abs(problem.seen(problem.x0).channels["measured"][0] - exact[::10]))))
    assert errors[0] > 1e-3
    assert max(errors[1:]) < 1e-2 * errors[0]


def test_outliers_do_not_pull_a_robust_fit(full):
    spoilt = full.channels["x"].copy()
    spoilt[::20] += 0.02
    bad = jms.Record(full.t, spoilt, full.inputs, noise=NOISE["x"])
    squares, cauchy = (
        jms.fit(sprung(1.8), bad, tuple(TRUTH), q0=[0.0], loss=loss) for loss in (SquaredLoss(), Cauchy())
    )
    off = [max(abs(r.values[name] / true - 1) for name, true in TRUTH.items()) for r in (squares, cauchy)]
    assert off[1] < 0.1 * off[0]


@pytest.mark.parametrize("loss", [Huber(), Huber(0.5), Cauchy(), Cauchy(1.0)])
def test_standard_errors_of_a_robust_fit_are_those_of_its_estimator(loss):
    # With the influence psi of the loss, the variance is that of least squares times E[psi^2]/E[psi']^2 (Huber 1964).
    k, r = float(loss.limit), np.linspace(-10.0, 10.0, 20001)
    huber = isinstance(loss, Huber)
    psi = np.clip(r, -k, k) if huber else r / (1 + (r / k) ** 2)
    slope = (np.abs(r) < k) if huber else (1 - (r / k) ** 2) / (1 + (r / k) ** 2) ** 2
    normal = np.exp(-(r**2) / 2) / np.sqrt(2 * np.pi) * 1e-3
    factor = np.sqrt(np.sum(psi**2 * normal)) / np.sum(slope * normal)
    t = np.linspace(0.0, 4.0, 2001)
    x, ratios = np.sin(3.0 * t), []
    v = np.diff(x) / np.diff(t)
    for seed in range(10):
        force = 2.0 * np.concatenate([[0.0], v]) + 0.1 * np.random.default_rng(seed).standard_normal(t.size)
        result = jms.fit_law(jms.Viscous(1.0), jms.Record(t, force, {"x": x}), loss=loss)
        ratios.append(result.errors["Fv"] / (factor * 0.1 / np.linalg.norm(v)))
    # A standard error scatters by less than a fifth, so their mean by 6 %.
    assert np.mean(ratios) == pytest.approx(1.0, abs=0.12)


def test_windows_find_what_one_run_finds(full):
    one = jms.fit(sprung(1.8), only_x(full), tuple(TRUTH), q0=[0.0])
    several = jms.fit(sprung(1.8), only_x(full), tuple(TRUTH), q0=[0.0], shooting=MultipleShooting(0.3, (1e-5, 1e-3)))
    for name in TRUTH:
        assert abs(several.values[name] - one.values[name]) < 3 * several.errors[name]
    assert several.rmse == pytest.approx(one.rmse, rel=0.1)
    apart = jms.fit(sprung(1.8), only_x(full), ("m", "friction.Fc"), shooting=MultipleShooting(0.3))
    # Each window begins with a bristle that is not deflected, which the truth's is.
    for name in apart.values:
        assert apart.values[name] == pytest.approx(TRUTH[name], rel=0.03)


def test_what_was_known_before_weighs_by_its_deviation(full):
    # A prior far narrower than what the record says decides alone, one far wider changes nothing.
    one = jms.fit(sprung(), only_x(full), ("m",))
    narrow = jms.fit(sprung(), only_x(full), ("m",), prior={"m": (2.1, 1e-8)})
    wide = jms.fit(sprung(), only_x(full), ("m",), prior={"m": (2.1, 1e3)})
    assert narrow.values["m"] == pytest.approx(2.1, rel=1e-5)
    assert wide.values["m"] == pytest.approx(one.values["m"], rel=1e-6)


def test_a_gain_of_a_controller_is_found():
    run = record(controller=Controller(lambda *x: ({}, ()), ()))
    scene = held()
    y0 = State(jnp.zeros(1), jnp.zeros(1), scene.initial_state(jnp.zeros(1)))
    loop = Controller(_hold, 0.0)
    x, _ = run_samples(
        scene, jnp.asarray(run.t), {"u": jnp.asarray(run.inputs["u"])}, y0, observer(OBSERVED), controller=loop
    )
    noisy = np.asarray(x["x"]) + 1e-5 * np.random.default_rng(0).standard_normal(len(run.t))
    closed = jms.Record(run.t, noisy, run.inputs)
    start = replace_numbers(held(), {"P": jnp.asarray(200.0), "m": jnp.asarray(1.5)})
    result = jms.fit(start, closed, ("P", "m"), controller=loop, q0=[0.0], limits={"m": (0.0, None)})
    assert abs(result.values["P"] - 300.0) < 4.5 * result.errors["P"] < 30.0
    assert abs(result.values["m"] - 2.0) < 4.5 * result.errors["m"]


def test_a_law_that_must_be_passive_is():
    law = jms.LuGre(sigma0=600.0, sigma1=5.0, sigma2=0.6, Fc=1.5, Fs=2.0, vs=0.1)
    scene = jms.Scene(
        lagrangian, params={"m": 2.0, "k": 20.0, "gain": 1.0, "u": 0.0}, effects=(DRIVE, jms.Friction(law))
    )
    assert not jms.check_passivity(law).ok
    result = jms.fit(scene, only_x(record()), ("friction.sigma2", "friction.Fs"), passive=("friction",))
    fitted = result.model.effects[1].law  # pyright: ignore[reportOptionalMemberAccess, reportAttributeAccessIssue]
    assert float(fitted.sigma2) >= float(fitted.sigma1 * (fitted.Fs - fitted.Fc) / fitted.Fc) - 1e-12


@pytest.mark.parametrize(
    ("asked", "text"),
    [
        ({"free": ("friction.FC",)}, "free names 'friction.FC'"),
        ({"observe": "q[3]"}, r"observes 'q\[3\]', but there are: q\[0\], qd\[0\], drive, friction"),
        ({"observe": "frictoin"}, "Did you mean 'friction'"),
        ({"delay": {"v": 0.1}}, "delay of 'v'"),
        ({"limits": {"mass": (0.0, None)}}, "limits: mass is no number"),
        ({"prior": {"k": (1.0, 1.0)}}, "prior names 'k'"),
        ({"passive": ("drive",)}, "passive names 'drive'"),
        ({"shooting": MultipleShooting(1e-9)}, "A window must be at least two samples"),
    ],
)
def test_wrong_requests_are_refused(full, asked, text):
    free = asked.pop("free", ("m",))
    with pytest.raises(ValueError, match=text):
        jms.fit(sprung(), only_x(full), free, **asked)


@pytest.mark.quick
def test_records_refuse_what_cannot_be():
    t, x = [0.0, 1.0, 2.0], [0.0, 1.0, 2.0]
    with pytest.raises(ValueError, match="noise names 'v', but the channels are: measured"):
        jms.Record(t, x, noise={"v": 1.0})
    with pytest.raises(ValueError, match="noise of 'measured' must be one finite number > 0"):
        jms.Record(t, x, noise=0.0)
    with pytest.raises(ValueError, match="linear names"):
        jms.Record(t, x, linear=("u",))
    with pytest.raises(ValueError, match="slips of 'friction' must be increasing times within"):
        jms.Record(t, x, slips={"friction": [3.0]})
    with pytest.raises(ValueError, match=r"use Record\.channels"):
        _ = jms.Record(t, {"a": x, "b": x}).measured
    with pytest.raises(ValueError, match=r"windows of 1.0 s cannot be cut from 3 samples"):
        jms.Record(t, x).windows(1.0)
    parts = jms.Record(np.arange(9.0), np.arange(9.0)).windows(4.0)
    assert [part.t.tolist() for part in parts] == [[0.0, 1.0, 2.0, 3.0], [4.0, 5.0, 6.0, 7.0, 8.0]]


@pytest.mark.quick
def test_start_state_is_a_parabola_through_the_first_samples():
    t = np.linspace(0.0, 1.0, 101)
    q, v = start_state(jms.Record(t, 0.3 - 0.7 * t + 4.0 * t**2))
    assert (q, v) == pytest.approx((0.3, -0.7), abs=1e-9)
