"""Input design: derivatives are right, limits hold, and a record of the designed input is worth what was promised."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxmodsim as jms
from jaxmodsim.identify import (
    AxisLimits,
    InputDesign,
    a_optimal,
    axis_models,
    axis_scene,
    d_optimal,
    design_input,
    e_optimal,
)
from jaxmodsim.identify.design import _design_input
from jaxmodsim.identify.design._design_input import _axis, _judge, _known, _share, _Task
from jaxmodsim.identify.design._input_design import driven_motion, feed_forward, motion_basis, sensitivities
from jaxmodsim.identify.model._axis import AxisEstimate
from jaxmodsim.plot import design_figure
from jaxmodsim.scene import replace_numbers

from ..helpers.optimized import optimized

MODEL = axis_models()["lugre"]
LIMITS = AxisLimits(force=40.0, speed=0.1, travel=0.02)
DT, DURATION, HARMONICS, NOISE = 2e-3, 2.0, 5, 1e-6
OPTIONS = {"duration": DURATION, "noise": NOISE, "dt": DT, "harmonics": HARMONICS}
# A box of 10 kg whose bristle gives way after a tenth of a millimetre.
TRUTH = {"friction.sigma0": 8e4, "friction.sigma1": 400.0, "friction.Fs": 10.0, "friction.vs": 0.01}


def box():
    return axis_scene(MODEL, AxisEstimate(m=10.0, Fv=40.0, Fc=8.0, offset=-1.0, top=0.1), TRUTH)


def shorten(patch, tried, improved):
    """A search on fewer samples from fewer starts, because each of its steps is a run with its derivatives."""
    patch.setattr(_design_input, "_COARSE", 500)
    patch.setattr(_design_input, "_TRIED", tried)
    patch.setattr(_design_input, "_IMPROVED", improved)


@pytest.fixture(scope="module")
@optimized()  # its many runs take longer than compilation
def design() -> InputDesign:
    with pytest.MonkeyPatch.context() as patch:
        shorten(patch, 8, 1)
        return design_input(box(), MODEL.free, LIMITS, max_steps=15, seed=1, **OPTIONS)


@pytest.fixture(scope="module")
def rough() -> InputDesign:
    """After one step."""
    with pytest.MonkeyPatch.context() as patch:
        shorten(patch, 2, 1)
        return design_input(box(), MODEL.free, LIMITS, max_steps=1, **OPTIONS)


def as_arrays(each):
    return jnp.asarray(each.t), jnp.asarray(each.force)


def measured(each, seed):
    rng = np.random.default_rng(seed)
    return jms.Record(each.t, each.q + NOISE * rng.standard_normal(each.t.size), {"u": each.force})


@pytest.fixture(scope="module")
def fits(design):
    """As on a machine: first a fit to the plain sine from a wrong start, the last here; then eight from its numbers."""
    wrong = {"m": 10.5, "friction.Fc": 7.6, "friction.sigma0": 7e4, "friction.sigma1": 420.0}

    def fit(each, seed, start):
        scene = replace_numbers(box(), {name: jnp.asarray(x, float) for name, x in start.items()})
        return jms.fit(scene, measured(each, seed), MODEL.free, q0=[0.0], qd0=[0.0], limits={"m": (0.0, None)})

    plain = fit(design.baseline, 8, wrong)
    return [*(fit(design.best, seed, plain.values) for seed in range(8)), plain]


@pytest.mark.parametrize("derivative", [0, 1])
def test_motions_start_and_end_at_rest_in_the_same_place(derivative):
    t = np.linspace(1.0, 3.0, 4001)
    columns = motion_basis(t, 3)
    assert np.all(np.abs(columns[derivative][[0, -1]]) < 1e-12)
    # Velocities are the derivatives of displacements: by central differences over 0.5 ms, where the third derivative
    # of the fading, 60/(0.2 s)^3, makes an error of 3e-4.
    slope = (columns[0][2:] - columns[0][:-2]) / (t[2:] - t[:-2])[:, None]
    np.testing.assert_allclose(columns[1][1:-1], slope, atol=5e-4)


def test_the_force_leads_the_axis_along_the_motion_with_order_two():
    # Gravity on a slope and a spring are in the force as well.
    def lagrangian(t, q, qd, p):
        del t
        return 0.5 * p["m"] * qd[0] ** 2 - 20.0 * q[0] ** 2 + 3.0 * q[0]

    drive = jms.AppliedForce(lambda t, q, qd, p: jnp.reshape(2.0 * p["u"], (1,)))
    law = jms.Regularized(jms.Stribeck(Fc=2.0, Fs=2.5, vs=0.1, Fv=1.0), 0.05)
    scene = jms.Scene(lagrangian, params={"m": 2.0, "u": 0.0}, effects=(drive, jms.Friction(law)))
    axis, _, _ = _axis(scene, ("m",), [0.3], lambda q, qd: q[0], "u", 1e-6)
    off = []
    for count in (201, 401):
        t = np.linspace(0.0, 2.0, count)
        shapes, rates = motion_basis(t, 2)
        q, qd = 0.3 + 0.1 * shapes.sum(axis=1), 0.1 * rates.sum(axis=1)
        force = feed_forward(axis, jnp.asarray(t), jnp.asarray(q), jnp.asarray(qd))
        # Inertia, spring, slope and friction in the middle of each sample; the drive doubles the force.
        place, speed = 0.5 * (q[1:] + q[:-1]), 0.5 * (qd[1:] + qd[:-1])
        friction = np.asarray(jax.vmap(law.force)(jnp.asarray(speed)))
        needed = 0.5 * (2.0 * np.diff(qd) / np.diff(t) + 40.0 * place - 3.0 + friction)
        np.testing.assert_allclose(force[:-1], needed, rtol=1e-9, atol=1e-9)
        off.append(np.max(np.abs(np.asarray(driven_motion(axis, jnp.asarray(t), force)[0]) - q)))
    assert off[1] < 1e-3
    assert np.log2(off[0] / off[1]) == pytest.approx(2.0, abs=0.3)


def test_sensitivities_are_those_of_the_simulated_record(design):
    axis, _, scale = _axis(box(), MODEL.free, None, lambda q, qd: q[0], "u", NOISE)
    t, force = as_arrays(design.best)
    record, columns = (np.asarray(x) for x in sensitivities(axis, t, force))
    np.testing.assert_allclose(record * NOISE, design.best.q, atol=1e-12)
    assert scale[0] == 10.0
    # Central differences with relative steps of 1e-7: they move the record by less than the bristle's tenth of a
    # millimetre, and by far more than rounding.
    moved = jax.jit(lambda x: driven_motion(_moved(axis, x), t, force)[0])
    for i in range(len(scale)):
        step = 1e-7 * jnp.eye(len(scale))[i]
        slope = np.asarray(moved(step) - moved(-step)) / (2e-7 * NOISE)
        np.testing.assert_allclose(columns[:, i], slope, atol=1e-3 * np.max(np.abs(slope)))
    np.testing.assert_allclose(design.best.information, columns.T @ columns, rtol=1e-9)


def _moved(axis, x):
    return type(axis)(axis.at(x), axis.start, axis.slopes, axis.q0, axis.noise, axis.input_name, axis.observe)


def every_goal(information):
    return d_optimal(information) + 2.0 * a_optimal(information) + 3.0 * e_optimal(information)


def test_gradients_of_goals_and_limits_equal_finite_differences():
    # A smooth law: the kink of LuGre at rest would be seen by the differences and not by the derivative.
    exact = axis_scene(axis_models()["coulomb"], AxisEstimate(10.0, 40.0, 8.0, -1.0, 0.1))
    scene = jms.formulations(exact, width=0.02)["Regularized"]
    axis, parameters, _ = _axis(scene, ("m", "dry.Fc", "viscous.Fv"), None, lambda q, qd: q[0], "u", NOISE)
    t = np.linspace(0.0, 1.0, 101)
    shapes, rates = motion_basis(t, 2)
    inverse = np.array([1 / 40.0, 1 / 0.1, 1 / 0.02])
    grid, weight = (jnp.asarray(each) for each in (t, shapes, rates, inverse)), jnp.asarray(5.0)
    task = _Task(axis, *grid, weight, jnp.zeros((3, 3)), jnp.asarray(0.1), every_goal)  # pyright: ignore[reportCallIssue]
    x = 3e-3 * np.random.default_rng(0).standard_normal(4)
    _, slope, peaks, rows = (np.asarray(each) for each in _judge(task, jnp.asarray(x)))
    # The smooth maximum lies above the largest share, by no more than the logarithm of all samples.
    share = float(_share(task, jnp.asarray(x)))
    assert share <= peaks[:3].max() <= share + np.log(2 * t.size) / 100.0
    for i in range(4):
        step = 1e-7 * np.eye(4)[i]  # of weights of 3 mm: truncation 1e-9, rounding 1e-8 of the derivative
        above, below = (_judge(task, jnp.asarray(x + sign * step)) for sign in (1.0, -1.0))
        assert slope[i] == pytest.approx(float(above[0] - below[0]) / 2e-7, rel=1e-4, abs=1e-4 * np.abs(slope).max())
        np.testing.assert_allclose(rows[:, i], np.asarray(above[2] - below[2]) / 2e-7, atol=1e-4 * np.abs(rows).max())
    assert parameters.names == ("m", "dry.Fc", "viscous.Fv")


def test_goals_of_a_diagonal_matrix():
    information = jnp.diag(jnp.array([1.0, 4.0, 16.0]))
    assert float(d_optimal(information)) == pytest.approx(np.log(4.0))
    assert float(a_optimal(information)) == pytest.approx(-np.log((1 + 1 / 4 + 1 / 16) / 3))
    assert float(e_optimal(information)) == pytest.approx(0.0, abs=1e-12)


def test_limits_hold_also_in_an_independent_run(design):
    assert np.max(np.abs(design.best.force)) <= 40.0
    assert max(design.used.values()) <= 1.0
    assert max(design.used.values()) > 0.98  # a larger motion would tell more
    held = jnp.asarray(design.best.force)
    # Steps of a twentieth of a sample, because one that ends on the next sample's force feels a little of it.

    def drive(t, q, qd, p):
        del q, qd
        index = jnp.clip(jnp.floor(t / DT + 1e-6).astype(int), 0, held.shape[0] - 1)
        return jnp.reshape(held[index] - p["offset"], (1,))

    scene = box()
    again = jms.Scene(scene.lagrangian, params=scene.params, effects=(jms.AppliedForce(drive), *scene.effects[1:]))
    ts = jnp.linspace(0.0, DURATION, 501)
    run = jms.simulate(again, [0.0], [0.0], DURATION, ts=ts, dt=DT / 20, max_steps=30000)
    q, qd = np.asarray(run.q[:, 0]), np.asarray(run.qd[:, 0])
    assert np.max(np.abs(q)) <= 0.02
    assert np.max(np.abs(qd)) <= 0.1
    # The force alone keeps the axis on its motion.
    np.testing.assert_allclose(q, np.interp(ts, design.best.t, design.best.q_ref), atol=1e-3)


def test_fits_are_as_good_as_predicted_and_better_than_those_of_a_plain_sine(design, fits):
    *designed, plain = fits
    assert all(result.search.converged for result in fits)
    ratios, better = [], 0
    for name in design.values:
        stated = np.mean([result.errors[name] for result in designed])
        ratios.append(stated / design.best.errors[name])
        better += stated < 0.7 * plain.errors[name]
    # A fit reckons its errors from 32 blocks of its residual, of which a few tell nearly all.
    assert np.mean(ratios) == pytest.approx(1.0, rel=0.3)
    assert better >= 4
    gain = np.linalg.slogdet(design.best.information)[1] - np.linalg.slogdet(design.baseline.information)[1]
    assert gain > 2 * len(design.values) * np.log(1.5)  # errors lower by a third in the geometric mean


def test_deviations_of_fits_scatter_as_promised(design, fits):
    # In units of their own promised errors. They cannot be whitened by the information matrix: one error along the
    # direction known worst bends the one known best, ten thousand times sharper, away from its straight line.
    off = np.array(
        [[(fit.values[n] - value) / design.best.errors[n] for n, value in design.values.items()] for fit in fits]
    )
    # 64 deviates, of which about half are independent: a mean square of 1 +- 0.25, three of those are allowed.
    assert np.mean(off[:8] ** 2) == pytest.approx(1.0, abs=0.75)
    assert np.max(np.abs(off[:8])) < 4.5
    assert all(fit.rmse == pytest.approx(NOISE, rel=0.1) for fit in fits)


@pytest.fixture
def hasty(monkeypatch):
    """Few starts, where the quality of the design does not matter."""
    shorten(monkeypatch, 2, 2)


@pytest.mark.usefixtures("hasty")
def test_the_seed_decides_and_a_prior_adds_what_is_known(design, fits):
    first = design_input(box(), MODEL.free, LIMITS, max_steps=1, seed=3, **OPTIONS)
    seen = []
    same = design_input(
        box(), MODEL.free, LIMITS, max_steps=1, seed=3, progress=lambda n, goal: seen.append((n, goal)), **OPTIONS
    )
    assert np.array_equal(first.best.force, same.best.force)
    assert [n for n, _ in seen] == [1, 2]
    assert np.isfinite([goal for _, goal in seen]).all()
    assert any("more steps or another seed" in warning for warning in first.warnings)
    again = design_input(box(), MODEL.free, LIMITS, max_steps=1, seed=3, prior=fits[0], **OPTIONS)
    for name in design.values:
        assert again.best.errors[name] < fits[0].errors[name]
    alone = np.sqrt(np.diag(np.linalg.inv(again.best.information))) * np.abs(list(again.values.values()))
    assert np.all(np.array(list(again.best.errors.values())) < alone)


def test_a_prior_is_the_inverse_of_its_covariance(fits):
    names = ("friction.Fc", "m")
    information = _known(fits[0], names, np.array([8.0, 10.0]))
    errors = np.array([fits[0].errors[name] for name in names]) / np.array([8.0, 10.0])
    places = [list(fits[0].values).index(name) for name in names]
    r = fits[0].estimate.correlation[places[0], places[1]]
    expected = np.linalg.inv(np.outer(errors, errors) * np.array([[1.0, r], [r, 1.0]]))
    np.testing.assert_allclose(information, expected, rtol=1e-6)
    with pytest.raises(ValueError, match="prior knows none of spring; it fitted m, offset"):
        _known(fits[0], ("spring",), np.ones(1))


@pytest.mark.usefixtures("hasty")
def test_ctrl_c_keeps_the_best_so_far(design):
    def impatient(step, goal):
        del goal
        if step == 2:
            raise KeyboardInterrupt

    early = design_input(box(), MODEL.free, LIMITS, max_steps=15, progress=impatient, **OPTIONS)
    assert early.ending == "was interrupted"
    assert max(early.used.values()) <= 1.0
    assert np.linalg.slogdet(early.best.information)[1] < np.linalg.slogdet(design.best.information)[1]


@pytest.mark.usefixtures("hasty")
def test_what_cannot_be_learned_is_said_and_keeps_the_goal_finite(design):
    # Far below break-away nothing slides, and what is left is a spring; the shapes are those of the other designs.
    tiny = AxisLimits(force=40.0, speed=0.1, travel=1e-6)
    still = design_input(box(), MODEL.free, tiny, max_steps=1, **OPTIONS)
    assert np.isfinite(still.best.errors["friction.sigma0"])
    text = " ".join(still.warnings)
    assert "Within force 40 N, speed 0.1 m/s, travel 1e-06 m, friction.vs is not determined" in text
    assert "What limits it: travel." in text
    assert still.best.errors["friction.Fs"] > 1e3 * design.best.errors["friction.Fs"]


def test_csv_holds_the_motion_and_the_force_and_is_whole_or_not_there(rough, tmp_path):
    path = tmp_path / "input.csv"
    rough.to_csv(path)
    assert path.read_text().startswith("t,q_ref,qd_ref,force\n")
    t, q_ref, qd_ref, force = np.loadtxt(path, delimiter=",", skiprows=1).T
    for column, expected in (
        (t, rough.best.t),
        (q_ref, rough.best.q_ref),
        (qd_ref, rough.best.qd_ref),
        (force, rough.best.force),
    ):
        np.testing.assert_allclose(column, expected, rtol=1e-8, atol=1e-12)
    assert np.max(np.abs(force)) <= 40.0
    (tmp_path / "folder.csv").mkdir()
    with pytest.raises(OSError, match=r"folder\.csv"):
        rough.to_csv(tmp_path / "folder.csv")
    assert sorted(each.name for each in tmp_path.iterdir()) == ["folder.csv", "input.csv"]


def test_the_result_prints_goes_to_json_and_is_drawn(rough):
    text = str(rough)
    assert "friction.sigma0" in text
    assert "plain sine" in text
    report = json.loads(json.dumps(rough.to_dict(), allow_nan=False))
    assert report["parameters"]["friction.vs"]["unit"] == "m/s"
    assert report["parameters"]["m"]["standard_error"] == rough.best.errors["m"]
    figure = design_figure(rough, caption="LuGre")
    axes = [axis for part in figure.subfigs for axis in part.axes]
    assert [axis.get_ylabel() for axis in axes[:3]] == ["position [mm]", "velocity [m/s]", "force [N]"]
    assert [sum(line.get_linestyle() == "--" for line in axis.get_lines()) for axis in axes[:3]] == [2, 2, 2]
    assert len(axes[3].patches) == 2 * len(rough.values)
    assert "%" in axes[3].get_xlabel()


@pytest.mark.parametrize(
    ("limits", "text"),
    [
        ({}, "at least one of force"),
        ({"force": -1.0}, r"limit of force \[N\] must be one finite number > 0, but -1.0"),
        ({"force": 1.0, "speed": 0.0}, "limit of speed"),
        ({"travel": float("inf")}, "limit of travel"),
    ],
)
@pytest.mark.quick
def test_wrong_limits_are_refused(limits, text):
    with pytest.raises(ValueError, match=text):
        AxisLimits(**limits)


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"free": ("mass",)}, "'mass', but the numbers are: m, offset"),
        ({"free": ("u",)}, "u is the input"),
        ({"input_name": "force"}, r"'force' must be a single number in the scene's params \(m, offset, u\)"),
        ({"input_name": "m", "free": ("offset",)}, "does not move the first coordinate"),
        ({"duration": -1.0}, r"duration \[s\] must be one finite number > 0"),
        ({"noise": 0.0}, "noise must be one finite number > 0"),
        ({"harmonics": 0}, "harmonics must be a positive integer"),
        ({"harmonics": 100}, "6 samples in a period of the fastest, but 20 are needed"),
        ({"q0": [0.0, 0.0]}, r"q0 has the shape \(2,\)"),
        ({"observe": lambda q, qd: q}, r"observe\(q, qd\) returned the shape \(1,\)"),
        ({"limits": AxisLimits(force=0.5)}, "the axis at rest takes 2[0-9][0-9] % of one"),
    ],
)
def test_wrong_options_are_refused(changes, text):
    given = {"scene": box(), "free": MODEL.free, "limits": LIMITS, **OPTIONS, **changes}
    if "harmonics" in changes and changes["harmonics"] == 100:
        given["dt"] = 1e-3
    with pytest.raises(ValueError, match=text):
        design_input(**given)


def test_scenes_that_need_events_and_criteria_that_are_words_are_refused():
    drive = box().effects[0]
    exact = jms.Scene(box().lagrangian, params=box().params, effects=(drive, jms.Friction(jms.Coulomb(8.0))))
    with pytest.raises(ValueError, match=r"friction would need events.*Regularized\(law, width\)"):
        design_input(exact, ("m",), LIMITS, **OPTIONS)
    for law in (jms.Sign(jms.Coulomb(8.0)), jms.DeadZone(jms.Coulomb(8.0), 1e-3)):
        jumps = jms.Scene(box().lagrangian, params=box().params, effects=(drive, jms.Friction(law)))
        with pytest.raises(ValueError, match=f"No derivatives through friction 'friction' .{type(law).__name__}"):
            design_input(jumps, ("m",), LIMITS, **OPTIONS)
    # Run-time type checks of the tests may come before our own; both name the argument.
    with pytest.raises((ValueError, TypeError), match="criterion"):
        design_input(box(), ("m",), LIMITS, criterion="D", **OPTIONS)  # pyright: ignore[reportArgumentType]


def test_gradients_are_finite_where_an_axis_rests():
    axis, _, scale = _axis(box(), MODEL.free, None, lambda q, qd: q[0], "u", NOISE)
    t = jnp.linspace(0.0, 0.1, 51)
    _, columns = jax.jit(lambda force: sensitivities(axis, t, force))(jnp.full(51, -1.0))
    assert columns.shape == (51, len(scale))
    assert np.isfinite(columns).all()
