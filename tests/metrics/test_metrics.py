"""Features of runs against closed forms, compiled and in batches, with their derivatives."""

import dataclasses
import pickle
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxmodsim as jms
from jaxmodsim import metrics, problems
from jaxmodsim.metrics import Metric
from jaxmodsim.simulation import Events, _trajectory

BELT = problems.belt_oscillator.PARAMS
TIGHT: dict[str, Any] = {"rtol": 1e-10, "atol": 1e-12, "max_events": 32}
OF_EVENTS = (
    metrics.break_away(),
    metrics.period(),
    metrics.mode_changes(),
    metrics.stick_share(),
    metrics.motion_kind(),
    metrics.peak("friction"),
)
BREAK_AWAY, PERIOD, CHANGES, SHARE, KIND, PEAK = range(6)
BELTS = jnp.array([0.08, 0.1, 0.16])
# For differences by Fs. The runs are right to about 1e-9: with this step the differences are to 1e-6.
STEP = 1e-3


def on_belt(belt: Any, fs: Any = BELT["Fs"], **more: Any) -> Any:
    """A run in stick from the start on."""
    scene = problems.belt_oscillator.scene(jms.Coulomb(BELT["Fc"], fs), belt=belt)
    return jms.simulate(scene, [0.0], jnp.stack([jnp.asarray(belt)]), 6.0, throw=False, **TIGHT, **more)


def modes_after_events(run: Any) -> list[int]:
    return [int(x) for x in run.events.after[np.isfinite(run.events.t)]]


def values(belt: Any, fs: Any) -> list[Any]:
    run = on_belt(belt, fs)
    return [metric(run) for metric in OF_EVENTS]


@pytest.fixture(scope="module")
def lanes() -> list[np.ndarray]:
    """Of three belts, and of one belt with Fs less and more by a step."""
    belts, fs = jnp.append(BELTS, jnp.full(2, 0.1)), 8.0 + STEP * jnp.array([0.0, 0.0, 0.0, -1.0, 1.0])
    return [np.asarray(x) for x in jax.jit(jax.vmap(values))(belts, fs)]


@pytest.fixture(scope="module")
def batch(lanes: list[np.ndarray]) -> list[np.ndarray]:
    return [x[:3] for x in lanes]


def cycle(belt: Any, fs: Any = BELT["Fs"]) -> Any:
    return problems.belt_oscillator.cycle(**{**BELT, "belt": belt, "Fs": fs})


def test_belt_oscillator_keeps_its_closed_form(batch: list[np.ndarray]) -> None:
    exact = cycle(BELTS)
    begins = exact.begins / BELTS
    np.testing.assert_allclose(batch[BREAK_AWAY], begins, rtol=1e-9)
    np.testing.assert_allclose(batch[PERIOD], exact.period, rtol=1e-8)
    np.testing.assert_allclose(batch[PEAK], BELT["Fs"], rtol=1e-9)
    cycles, rest = np.divmod(6.0 - begins, exact.period)
    np.testing.assert_array_equal(batch[CHANGES], 2 * cycles + 1 + (rest > exact.slip))
    stuck = begins + cycles * exact.stick + np.maximum(rest - exact.slip, 0.0)
    np.testing.assert_allclose(batch[SHARE], stuck / 6.0, rtol=1e-8)
    assert [OF_EVENTS[KIND].describe(kind) for kind in batch[KIND]] == ["stick-slip cycle"] * 3


@pytest.fixture(scope="module")
def alone() -> Any:
    """A run of the middle belt, not compiled by its user."""
    return on_belt(BELTS[1])


def test_eager_as_compiled_and_mapped(alone: Any, batch: list[np.ndarray]) -> None:
    for metric, mapped in zip(OF_EVENTS, batch, strict=True):
        np.testing.assert_allclose(metric(alone), mapped[1], rtol=1e-9, err_msg=metric.label)
    changes = modes_after_events(alone)
    assert changes == ([-1, 0] * len(changes))[: int(batch[CHANGES][1])]


def test_derivatives_of_break_away_and_period(lanes: list[np.ndarray]) -> None:
    """Against the closed form, and against differences."""
    chosen = (BREAK_AWAY, PERIOD, PEAK, SHARE)

    def some(fs: Any) -> Any:
        run = on_belt(0.1, fs, adjoint=dfx.ForwardMode())
        return jnp.stack([OF_EVENTS[i](run) for i in chosen])

    slopes = jax.jit(jax.jacfwd(some))(8.0)
    exact = jax.jacfwd(lambda fs: jnp.stack([cycle(0.1, fs).begins / 0.1, cycle(0.1, fs).period, fs]))(8.0)
    np.testing.assert_allclose(slopes[:3], exact, rtol=1e-7)
    differences = [(lanes[i][4] - lanes[i][3]) / (2 * STEP) for i in chosen]
    np.testing.assert_allclose(slopes, differences, rtol=1e-5)


def test_events_of_a_run_are_found_once(alone: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    run, calls = dataclasses.replace(alone, log=None), []  # as of a run with more events than it logged
    solve = _trajectory.solve
    monkeypatch.setattr(_trajectory, "solve", lambda *args: (calls.append(1), solve(*args))[1])
    first = [metric(run) for metric in OF_EVENTS]
    assert len(calls) == 1
    assert pickle.loads(pickle.dumps(run)).events.t.shape == run.events.t.shape
    calls.clear()
    traced = jax.jit(lambda: [metric(run) for metric in OF_EVENTS])()
    assert not calls
    # A run whose numbers are known is repeated with known numbers, also where it is read while tracing.
    run = dataclasses.replace(alone, log=None)
    jax.jit(lambda: run.events.t)()
    assert len(calls) == 1
    again = [metric(run) for metric in OF_EVENTS]
    np.testing.assert_allclose(np.array(traced), np.array(first))
    np.testing.assert_array_equal(np.array(again), np.array(first))


def test_metrics_of_equal_arguments_compile_once(alone: Any) -> None:
    count = []

    def applied(metric: Metric, run: Any) -> Any:
        count.append(metric)
        return metric(run)

    compiled = jax.jit(applied, static_argnums=0)
    compiled(metrics.peak("q[0]"), alone)
    compiled(metrics.peak("q[0]"), alone)
    assert len(count) == 1
    assert metrics.period("q[0]") != metrics.period("qd[0]")


def box(law: Any) -> Any:
    """Pulled by 0.5 t, a mass of 2 kg."""
    ts = jnp.linspace(0.0, 5.0, 2001)
    return jms.simulate(problems.ramped_box.scene(law, ramp=0.5), [0.0], [0.0], 5.0, ts=ts, rtol=1e-9, atol=1e-12)


def made(run: Any, scene: Any = None, **fields: Any) -> Any:
    """A run with some of it replaced by what is given."""
    request = run.request if scene is None else run.request._replace(scene=scene)
    return dataclasses.replace(run, request=request, **fields)


def bristle() -> Any:
    """So stiff that it breaks away at Fs, but for what it creeps before."""
    return box(jms.LuGre(sigma0=1e5, sigma1=100.0, sigma2=0.0, Fc=1.5, Fs=1.5, vs=0.1))


def free(coefficient: float = 0.0) -> Any:
    """The run of a box that nothing holds, of which viscous friction is measured but does not act."""
    run = bristle()
    q, qd = 0.5 * run.t[:, None] ** 3 / 12.0, 0.5 * run.t[:, None] ** 2 / 4.0
    return made(run, problems.ramped_box.scene(jms.Viscous(coefficient), ramp=0.5), q=q, qd=qd, z={})


def test_break_away_of_a_pulled_box() -> None:
    """At t = Fs/ramp; a slip d later by (6 m d/ramp)^(1/3), as the force is over what is needed by ramp t."""
    run = box(jms.Coulomb(1.5))
    np.testing.assert_allclose(metrics.break_away()(run), 3.0, rtol=1e-9)
    later = (6.0 * 2.0 * 1e-2 / 0.5) ** (1 / 3)
    np.testing.assert_allclose(metrics.break_away(distance=1e-2)(run), 3.0 + later, rtol=2e-6)
    # Without friction it slips from the start on.
    np.testing.assert_allclose(metrics.break_away(distance=1e-2)(free()), later, rtol=1e-5)
    assert np.isnan(metrics.break_away(distance=1e3)(free()))
    assert np.isnan(metrics.break_away()(box(jms.Coulomb(3.0))))
    np.testing.assert_allclose(metrics.break_away(distance=1e-2)(bristle()), 3.0 + later, rtol=3e-3)


def test_break_away_counts_slip_and_not_motion() -> None:
    """A mass at rest beside a belt of -0.1 m/s slips by 0.1 t, from t0 and not from the first saved time on."""
    run = free()
    scene = run.scene
    effect = eqx.tree_at(lambda friction: friction.belt_velocity, scene.effects[1], jnp.asarray(-0.1))
    scene = jms.Scene(scene.lagrangian, params=scene.params, effects=(scene.effects[0], effect))
    rest = jnp.zeros((4, 1))
    run = made(run, scene, t=jnp.linspace(0.5, 2.0, 4), q=rest, qd=rest, end=jnp.asarray(2.0))
    np.testing.assert_allclose(metrics.break_away(distance=0.12)(run), 1.2, rtol=1e-12)
    np.testing.assert_allclose(metrics.stick_share(rest=0.09)(run), 0.0)
    np.testing.assert_allclose(metrics.stick_share(rest=0.11)(run), 1.0)


def test_a_spring_that_stops() -> None:
    """The braked spring from 0.3 m: so many half cycles, and at rest."""
    numbers = {"m": 1.3, "k": 2.7, "Fc": 0.11, "Fs": 0.15}
    rest = problems.braked_spring.rest(x0=0.3, **numbers)
    scene = problems.braked_spring.scene(problems.braked_spring.coulomb())
    half = float(rest.t / rest.half_cycles)

    def kind(t1: float, x0: float = 0.3) -> tuple[str, list[int]]:
        run = jms.simulate(scene, [x0], [0.0], t1, **TIGHT)
        return metrics.motion_kind().describe(metrics.motion_kind()(run)), modes_after_events(run)

    assert int(rest.half_cycles) == 3
    assert kind(float(rest.t) + 1.0) == ("sticks for good", [1, -1, 0])
    assert kind(2.5 * half) == ("slips back and forth", [1, -1])
    assert kind(0.5 * half) == ("slips for good", [])
    assert kind(3.0, x0=0.01) == ("never slips", [])
    run = jms.simulate(scene, [0.3], [0.0], 2.0 * float(rest.t), **TIGHT)
    np.testing.assert_allclose(metrics.stick_share()(run), 0.5, rtol=1e-9)
    np.testing.assert_allclose(metrics.stick_share(since=0.5 * float(rest.t))(run), 2 / 3, rtol=1e-9)
    assert np.isnan(metrics.period()(run))


def test_several_elements(alone: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Changes of each as they are given: `first` leaves stick for good, `second` at the same time, and comes back."""
    t, effect, before, after = map(jnp.array, ([1.0, 1.0, 2.0, jnp.inf], [0, 1, 1, -1], [0, 0, 1, -1], [-1, 1, 0, -1]))
    monkeypatch.setattr(jms.Trajectory, "events", property(lambda run: Events(t, effect, before, after)))
    run = made(alone, problems.coupled_belts.scene(), modes=jnp.array([[-1.0, 0.0]]), end=jnp.asarray(4.0))
    names = ("first", "second")
    kind = metrics.motion_kind(*names)
    assert kind.describe(kind(run)) == "first slips for good, second sticks for good"
    assert [int(metrics.mode_changes(name)(run)) for name in names] == [1, 2]
    assert [float(metrics.stick_share(name)(run)) for name in names] == [0.25, 0.75]


def test_single_precision(alone: Any) -> None:
    single = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32) if x.dtype == jnp.float64 else x, alone)
    tolerances = {"rtol": jnp.asarray(1e-5, jnp.float32), "atol": jnp.asarray(1e-6, jnp.float32)}
    request = single.request._replace(**tolerances)
    single = dataclasses.replace(single, request=request)
    assert metrics.period()(single).dtype == metrics.break_away()(single).dtype == jnp.float32
    np.testing.assert_allclose(metrics.period()(single), metrics.period()(alone), rtol=1e-4)


def test_peaks_between_saved_times() -> None:
    """A swing sin(w t) that is saved at its zeros: the samples say nothing of its amplitude."""

    def lagrangian(t: Any, q: Any, qd: Any, p: Any) -> Any:
        del t
        return 0.5 * qd[0] ** 2 - 0.5 * (p["w"] * q[0]) ** 2

    zeros = np.pi / 1.7 * np.arange(5)

    def peak(of: str, w: Any, v: Any, t1: Any = 8.0, ts: Any = zeros) -> Any:
        run = jms.simulate(jms.Scene(lagrangian, params={"w": w}), [0.0], v[None], t1, ts=ts, rtol=1e-9, atol=1e-11)
        return metrics.peak(of)(run)

    w, v = jnp.asarray(1.7), jnp.asarray(3.4)
    np.testing.assert_allclose(peak("q[0]", w, v), 2.0, rtol=2e-6)
    np.testing.assert_allclose(peak("qd[0]", w, v), 3.4, rtol=2e-6)
    slopes = jax.jit(jax.grad(lambda *x: peak("q[0]", *x), argnums=(0, 1)))(w, v)
    np.testing.assert_allclose(slopes, [-2.0 / 1.7, 1.0 / 1.7], rtol=1e-5)
    # A run that ends before the first peak: the largest value moves with t1.
    at_end = jax.jit(jax.value_and_grad(lambda t1: peak("q[0]", w, v, t1, jnp.stack([0.0 * t1, t1]))))(0.6)
    np.testing.assert_allclose(at_end, [2.0 * np.sin(1.02), 3.4 * np.cos(1.02)], rtol=2e-6)


@pytest.mark.parametrize("beside", [-5e-4, 5e-4])
def test_a_saved_time_beside_a_peak_does_not_give_its_derivative(beside: float) -> None:
    """The peak of A w sin(w t) moves as A does; at half a thousandth of a radian beside it, the slope is 8e-4 off."""
    a, w = 0.7, 1.7
    saved = (0.5 * np.pi + beside) / w

    def peak(w: Any) -> Any:
        scene = jms.Scene(lambda t, q, qd, p: 0.5 * qd[0] ** 2 - 0.5 * (p["w"] * q[0]) ** 2, {"w": w})
        run = jms.simulate(scene, [a], [0.0], 3.0, ts=[0.0, saved, 3.0], rtol=1e-9, atol=1e-11)
        return metrics.peak("qd[0]")(run)

    value, slope = jax.jit(jax.value_and_grad(peak))(jnp.asarray(w))
    np.testing.assert_allclose(value, a * w, rtol=1e-6)
    np.testing.assert_allclose(slope, a, rtol=5e-5)


def test_the_peak_of_a_force_that_jumps_is_within_its_limits() -> None:
    """Steps that contain an event have samples on both sides of the jump: no parabola passes through them."""
    rng = np.random.default_rng(11)
    belts = np.stack([rng.uniform(0.5, 2.0, 64), rng.uniform(5.0, 50.0, 64), rng.uniform(0.05, 0.5, 64)], 1)

    def lagrangian(t: Any, q: Any, qd: Any, p: Any) -> Any:
        del t
        return 0.5 * p["m"] * qd[0] ** 2 - 0.5 * p["k"] * q[0] ** 2

    @jax.jit
    @jax.vmap
    def peak(numbers: Any) -> Any:
        m, k, belt = numbers
        friction = jms.Friction(jms.asymmetric(jms.Coulomb(1.5), Fc=2.0), belt_velocity=belt)
        run = jms.simulate(jms.Scene(lagrangian, {"m": m, "k": k}, (friction,)), [-0.3], [0.0], 3.0)
        return metrics.peak("friction")(run)

    np.testing.assert_allclose(peak(belts), 2.0, rtol=1e-5)


def test_the_peak_at_the_end_of_a_step_is_that_of_its_event() -> None:
    """A mass on a spring strikes a wall at its largest speed, or starts with it; w = sqrt(k/m)."""
    rng = np.random.default_rng(5)
    a = rng.uniform(0.2, 1.0, 24)
    numbers = np.stack([rng.uniform(0.5, 2.0, 24), rng.uniform(5.0, 50.0, 24), a, rng.uniform(0.1, 0.9, 24) * a], 1)

    def lagrangian(t: Any, q: Any, qd: Any, p: Any) -> Any:
        del t
        return 0.5 * p["m"] * qd[0] ** 2 - 0.5 * p["k"] * q[0] ** 2

    def peak(x: Any, struck: bool) -> Any:
        m, k, a, d = x
        wall = jms.Contact(lambda t, q, p: -p["d"] - q[0], restitution=0.5)
        scene = jms.Scene(lagrangian, {"m": m, "k": k, "d": d}, constraints=(wall,))
        fast = jnp.sqrt(k / m * (a**2 - d**2))
        start = (-a[None], [0.0]) if struck else (-d[None], -fast[None])
        return metrics.peak("qd[0]")(jms.simulate(scene, *start, 1.0 if struck else 0.1 * jnp.sqrt(m / k)))

    for struck in (True, False):
        value, slope = jax.jit(jax.vmap(jax.value_and_grad(lambda x, struck=struck: peak(x, struck))))(numbers)
        exact = jax.vmap(jax.value_and_grad(lambda x: jnp.sqrt(x[1] / x[0] * (x[2] ** 2 - x[3] ** 2))))(numbers)
        np.testing.assert_allclose(value, exact[0], rtol=1e-6)
        np.testing.assert_allclose(slope, exact[1], rtol=2e-5)


def test_of_equal_peaks_one_has_the_derivative():
    @jax.jit
    @jax.grad
    def slope(u: Any) -> Any:
        pull = jms.Signal([0.0, 0.5, 1.0], u, linear=False)
        drive = jms.AppliedForce(lambda t, q, qd, p: p["pull"][None], name="drive")
        scene = jms.Scene(lambda t, q, qd, p: qd[0] ** 2, {"pull": pull}, (drive,))
        return metrics.peak("drive[0]")(jms.simulate(scene, [0.0], [0.0], 2.0, ts=[0.0, 1.3, 2.0]))

    assert slope(jnp.array([3.0, -1.0, -3.0])).tolist() in ([1.0, 0.0, 0.0], [0.0, 0.0, -1.0])


def test_periods_by_crossings() -> None:
    """A swing cos(w t) about any mean has the period 2 pi/w; what dies away or has ended has none."""
    t, run = jnp.linspace(0.0, 40.0, 4001), free()

    def swing(w: Any, x: Any = None) -> Any:
        x = 3.0 + jnp.cos(w * t) if x is None else x
        return made(run, t=t, q=x[:, None], qd=-w * jnp.sin(w * t)[:, None], end=jnp.asarray(40.0))

    for name in ("q[0]", "qd[0]"):
        np.testing.assert_allclose(metrics.period(name)(swing(1.7)), 2 * np.pi / 1.7, rtol=1e-5)
    slope = jax.jit(jax.grad(lambda w: metrics.period("q[0]")(swing(w))))(1.7)
    np.testing.assert_allclose(slope, -2 * np.pi / 1.7**2, rtol=1e-3)
    np.testing.assert_allclose(metrics.final("qd[0]")(swing(1.7)), -1.7 * np.sin(1.7 * 40.0), rtol=1e-9)
    late = jnp.where(t > 19.0, 1e-4, 1.0) * jnp.cos(1.7 * t)
    assert np.isnan(metrics.period("q[0]")(swing(1.7, late)))
    np.testing.assert_allclose(metrics.period("q[0]", swing=1e-5)(swing(1.7, late)), 2 * np.pi / 1.7, rtol=1e-5)
    ended = jnp.where(t > 30.0, 0.0, jnp.cos(1.7 * t))
    assert np.isnan(metrics.period("q[0]")(swing(1.7, ended)))
    assert np.isnan(metrics.period("q[0]")(swing(1.7, t)))


def test_dahl_dissipates_its_closed_form_in_each_cycle() -> None:
    """`4 Fc [A - Fc/sigma0 tanh(sigma0 A/Fc)]`, with a mass so heavy that friction does not disturb its swing."""
    sigma0, fc, amplitude = 750.0, 1.5, 2e-2
    scene = problems.braked_spring.scene(jms.Dahl(sigma0, fc), m=1e9, k=1e9)
    lost = []
    for cycles in (2, 3):
        run = jms.simulate(scene, [amplitude], [0.0], 2 * np.pi * cycles, rtol=1e-9, atol=1e-12)
        lost.append(metrics.dissipated("friction")(run))
        np.testing.assert_allclose(metrics.dissipated()(run), lost[-1], rtol=1e-12)
    expected = 4 * fc * (amplitude - fc / sigma0 * np.tanh(sigma0 * amplitude / fc))
    np.testing.assert_allclose(lost[1] - lost[0], expected, rtol=1e-6)
    with pytest.raises(ValueError, match="dissipative effects are: friction"):
        metrics.dissipated("brake")(run)


def test_stick_share_of_laws_without_modes() -> None:
    """Up to which share of its limit a bristle creeps slower than 1e-4 m/s, and when a box that sticks gets faster."""
    share = metrics.stick_share(rest=1e-4)
    # A bristle under a ramp creeps at v = (ramp/sigma0)/(1 - F/Fc).
    np.testing.assert_allclose(share(bristle()), 3.0 * (1 - 0.5 / 1e5 / 1e-4) / 5.0, atol=3e-3)
    # A box that slips after 3 s has v = ramp (t - 3)^2/(2 m).
    np.testing.assert_allclose(share(box(jms.Coulomb(1.5))), (3.0 + np.sqrt(4 * 1e-4 / 0.5)) / 5.0, atol=1e-3)
    still = metrics.classes(lambda run: jnp.where(jnp.abs(run.qd[-1, 0]) < 1e-3, 0, 1), ("rests", "moves"))
    assert still.describe(still(bristle())) == "moves"


def test_peak_of_a_force() -> None:
    run = free(0.3)
    np.testing.assert_allclose(metrics.peak("friction")(run), 0.3 * run.qd[-1, 0], rtol=1e-12)
    np.testing.assert_allclose(metrics.peak("pull[0]")(run), 2.5, rtol=1e-12)
    np.testing.assert_allclose(metrics.final("pull[0]")(run), 2.5, rtol=1e-12)
    assert metrics.peak("pull[0]").describe(2.5) == "2.5 N or N m"


@pytest.mark.parametrize(
    ("make", "text"),
    [
        (lambda: metrics.break_away(distance=-1.0), "positive number of metres"),
        (lambda: metrics.stick_share(rest=0.0), "positive speed"),
        (lambda: metrics.period(swing=1.0), "swing"),
        (lambda: metrics.motion_kind("a", "a"), "once"),
        (lambda: metrics.motion_kind(*(str(i) for i in range(11))), "up to 10"),
        (lambda: metrics.classes(lambda run: 0, ()), "name for each class"),
    ],
)
def test_invalid_arguments_are_refused(make: Any, text: str) -> None:
    with pytest.raises(ValueError, match=text):
        make()


@pytest.mark.parametrize(
    ("metric", "text"),
    [
        (metrics.break_away(), r"break_away\(distance=1e-3\)"),
        (metrics.break_away("brake"), "'brake'; there are: friction"),
        (metrics.mode_changes(), "not event-driven"),
        (metrics.stick_share(), "rest=1e-4"),
        (metrics.motion_kind(), "classes"),
        (metrics.peak("q[1]"), r"'q\[1\]'; there are: q\[0\] \(x\), qd\[0\] \(x_dot\), pull\[0\], friction"),
        (metrics.final("pull"), "No observable"),
        (metrics.period("brake"), "No observable"),
    ],
)
def test_invalid_runs_are_refused(metric: Metric, text: str) -> None:
    with pytest.raises(ValueError, match=text):
        metric(bristle())
