"""Sampled inputs: steps end on the samples, stick breaks at them, and derivatives go through."""
# ruff: noqa: ARG001 (Lagrangians have the arguments that the scene passes, used or not)

from typing import Any

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest

import jaxmodsim as jms
from jaxmodsim.scene import replace_numbers, scene_numbers

from ..helpers.differences import central_difference

M, FC = 2.0, 1.5
EXACT: Any = {"rtol": 1e-10, "atol": 1e-12}
T = np.linspace(0.0, 2.0, 21)
U = np.random.default_rng(0).normal(size=21) * 2 * FC


def lagrangian(t: Any, q: Any, qd: Any, p: Any) -> Any:
    return 0.5 * p["m"] * qd[0] ** 2


def carried(t: Any, q: Any, qd: Any, p: Any) -> Any:
    """A free mass seen from a carriage of velocity u."""
    return 0.5 * p["m"] * (qd[0] + p["u"]) ** 2


def pulled(t: Any, q: Any, qd: Any, p: Any) -> Any:
    """A mass on a spring whose other end is at u."""
    return 0.5 * p["m"] * qd[0] ** 2 - 0.5 * p["k"] * (q[0] - p["u"]) ** 2


push = jms.AppliedForce(lambda t, q, qd, p: p["u"][None])
ramp = jms.AppliedForce(lambda t, q, qd, p: (p["k"] * t)[None])
coulomb = jms.Friction(jms.Coulomb(FC))


def box(u: Any) -> jms.Scene:
    return jms.Scene(lagrangian, params={"m": M, "u": u}, effects=(push, coulomb))


def test_stick_breaks_at_the_sample() -> None:
    """A force from half the limit to twice the limit: at rest up to t = 1 exactly, then constantly accelerated."""
    ts = jnp.linspace(0.0, 2.0, 21)
    run = jms.simulate(box(jms.Signal([0.0, 1.0], [0.5 * FC, 2 * FC])), [0.0], [0.0], 2.0, ts=ts)
    since = jnp.maximum(ts - 1.0, 0.0)
    np.testing.assert_allclose(run.q[:, 0], 0.5 * FC / M * since**2, atol=1e-13)
    np.testing.assert_array_equal(run.mode["friction"], ts >= 1.0)
    np.testing.assert_allclose(run.forces["friction"], np.where(ts < 1.0, 0.5 * FC, FC), atol=1e-13)
    assert float(run.events.t[0]) == 1.0
    assert not np.isfinite(run.events.t[1:]).any()
    energy = run.energy
    np.testing.assert_allclose(energy.work_in, 2 * FC * run.q[:, 0], atol=1e-12)
    np.testing.assert_allclose(energy.balance, 0.0, atol=1e-12)


def coupled(t: Any, q: Any, qd: Any, p: Any) -> Any:
    """A pushed mass, a spring, a mass that sticks, and a load."""
    kinetic = 0.5 * (2.0 * qd[0] ** 2 + 3.0 * qd[1] ** 2 + 1.3 * qd[2] ** 2)
    return kinetic - 0.5 * 400.0 * (q[0] - q[1]) ** 2 - 1.3 * 9.81 * q[2]


@pytest.mark.parametrize(
    ("along", "constraints"),
    [
        (lambda q: q[1] - 0.3 * q[0], ()),
        (lambda q: jnp.array([q[1] - 0.3 * q[0], q[0] + 0.1 * q[1]]), ()),
        (lambda q: q[1] - 0.3 * q[0], (jms.Contact(lambda t, q, p: q[2] - 0.4 * q[1] + 0.2 * q[0], name="floor"),)),
    ],
    ids=["row", "plane", "contact"],
)
def test_samples_in_stick_are_no_events(along: Any, constraints: Any) -> None:
    """Rounding of the velocity that stick removes counted as an event: a fast input ran into `max_events`."""
    t = np.linspace(0.0, 2.0, 201)
    u = jms.Signal(t, 3.0 * np.random.default_rng(0).normal(size=201))
    push = jms.AppliedForce(lambda t, q, qd, p: jnp.array([p["u"], 0.0, 0.1 * p["u"]]))
    friction = jms.Friction(jms.Coulomb(500.0), along=along)
    scene = jms.Scene(coupled, params={"u": u}, effects=(push, friction), constraints=constraints)
    run = jms.simulate(scene, [0.0] * 3, [0.0] * 3, 2.0)
    assert run.stats["num_events"] == 0


def held(values: Any, adjoint: Any = None) -> Any:
    run = jms.simulate(box(jms.Signal(T, values)), [0.0], [0.3], 2.0, adjoint=adjoint, **EXACT)
    return jnp.stack([run.q[0, 0], run.qd[0, 0]])


def test_a_held_signal_is_constant_inputs_one_after_the_other() -> None:
    """Through sticking, reversals and loads that break stick at samples, and at a sample that is the end of the run."""
    q, qd, changes = [0.0], [0.3], 0.0
    for i in range(len(T) - 1):
        step = jms.simulate(
            box(U[i]),
            q,
            qd,
            T[i + 1],
            t0=T[i],
            **EXACT,
        )
        q, qd, changes = step.q[0], step.qd[0], changes + step.stats["num_events"]
    np.testing.assert_allclose(held(jnp.asarray(U)), np.array([q[0], qd[0]]), rtol=1e-7)
    assert changes >= 3


def test_derivatives_by_values() -> None:
    weights = np.array([1.0, 0.7])
    reverse = jax.jit(jax.grad(lambda u: jnp.sum(weights * held(u))))(jnp.asarray(U))
    forward = jax.jit(jax.jacfwd(lambda u: held(u, dfx.ForwardMode())))(jnp.asarray(U))
    np.testing.assert_allclose(reverse, weights @ forward, atol=1e-12)
    assert forward[1, -2] == pytest.approx((T[-1] - T[-2]) / M)
    for i in (0, 5, 12, 19):
        differences = central_difference(lambda x, i=i: held(jnp.asarray(U).at[i].set(x)), U[i], 1e-4)
        np.testing.assert_allclose(forward[:, i], differences, atol=1e-9)


def test_runs_under_vmap() -> None:
    batch = jnp.stack([jnp.asarray(U), -U, 0.5 * U])
    np.testing.assert_allclose(jax.vmap(held)(batch), jnp.stack([held(u) for u in batch]), rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("dt", [None, 0.03, 0.25])
def test_steps_end_on_samples(dt: float | None) -> None:
    """Between samples the motion is a parabola, which the method has exactly if no step runs over a sample."""
    scene = jms.Scene(lagrangian, params={"m": M, "u": jms.Signal(T, U)}, effects=(push,))
    run = jms.simulate(scene, [0.0], [0.0], 2.0, ts=T, dt=dt)
    velocity = np.concatenate([[0.0], np.cumsum(np.diff(T) * U[:-1] / M)])
    np.testing.assert_allclose(run.qd[:, 0], velocity, atol=1e-12)
    place = np.concatenate([[0.0], np.cumsum(np.diff(T) * 0.5 * (velocity[1:] + velocity[:-1]))])
    np.testing.assert_allclose(run.q[:, 0], place, atol=1e-12)
    if dt is not None:  # those of the grid of dt, less those that samples are on, and those to the samples
        grid = np.ceil(2.0 / dt)
        shared = np.sum(np.abs(2.0 / grid * np.arange(1, grid + 1)[:, None] - T[None, 1:]) < 1e-9)
        assert run.stats["num_steps"] == 20 + grid - shared


def test_a_lagrangian_has_the_rate_of_a_linear_signal() -> None:
    """The momentum m (qd + u) is kept; outside of the samples the signal stays at its ends."""
    u = jms.Signal([0.5, 1.0, 1.5], [1.0, 3.0, -1.0], linear=True)
    ts = np.linspace(0.0, 2.0, 9)
    scene = jms.Scene(carried, params={"m": M, "u": u})
    run = jms.simulate(scene, [0.0], [0.0], 2.0, ts=ts)
    np.testing.assert_allclose(run.qd[:, 0], 1.0 - np.interp(ts, u.t, u.values), atol=1e-12)
    np.testing.assert_allclose(run.momentum[:, 0], M, rtol=1e-12)


def test_work_of_a_moving_spring_is_accounted() -> None:
    u = jms.Signal([0.0, 0.4, 1.0], [0.0, 1.0, -1.0], linear=True)
    scene = jms.Scene(pulled, params={"m": M, "k": 30.0, "u": u}, effects=(jms.Friction(jms.Viscous(0.5)),))
    energy = jms.simulate(scene, [0.0], [0.0], 1.5, ts=T[:16], **EXACT).energy
    np.testing.assert_allclose(energy.balance, 0.0, atol=1e-8)
    assert abs(float(energy.work_in[-1])) > 1.0


def test_numbers_of_a_signal() -> None:
    scene = jms.Scene(lagrangian, params={"m": 1, "in": {"u": jms.Signal([0, 1], [2, 3])}}, effects=(coulomb,))
    numbers = scene_numbers(scene)
    assert set(numbers) == {"m", "in.u.values", "friction.Fc", "friction.belt_velocity"}
    other = replace_numbers(scene, {"in.u.values": jnp.array([5.0, 6.0])}).bind_time(jnp.array(1.0))
    assert float(other.params["in"]["u"]) == 6.0
    plain = box(1.0)
    assert plain.bind_time(jnp.array(0.0)) is plain


@pytest.mark.parametrize(
    ("t", "values", "text"),
    [
        ([0.0, 1.0], [1.0], "one value for each time"),
        ([0.0, 0.0], [1.0, 2.0], r"increase .*t\[1\] = 0.0 after t\[0\] = 0.0"),
        ([0.0, jnp.inf], [1.0, 2.0], "finite"),
        ([[0.0]], [1.0], "real number"),
    ],
)
def test_what_is_no_signal_is_refused(t: Any, values: Any, text: str) -> None:
    with pytest.raises(ValueError, match=text):
        jms.Signal(t, values)


def switches(x: Any, adjoint: Any) -> Any:
    """Times at which a box slides to rest from x[0] m/s, and at which a force x[1] t breaks it loose."""
    scene = jms.Scene(lagrangian, params={"m": M, "k": x[1]}, effects=(ramp, jms.Friction(jms.Coulomb(FC, 2.0))))
    return jms.simulate(scene, [0.0], x[:1], 10.0, adjoint=adjoint, max_events=4).events.t[:2]


def test_times_of_events_are_differentiable() -> None:
    """The box comes to rest where `m v0 + k t^2/2 = Fc t`, and breaks loose where `k t = Fs`."""
    v, k = 0.1, 0.5
    root = np.sqrt(FC**2 - 2 * k * M * v)
    rest = (FC - root) / k
    expected = [[M / root, 0.5 * rest**2 / root], [0.0, -2.0 / k**2]]
    x = jnp.array([v, k])

    def twice(x: Any) -> Any:
        t = switches(x, dfx.ForwardMode())
        return t, t

    forward, t = jax.jit(jax.jacfwd(twice, has_aux=True))(x)
    np.testing.assert_allclose(t, [rest, 2.0 / k], rtol=1e-9)
    np.testing.assert_allclose(forward, expected, atol=1e-7)


COLUMNS: Any = pd.DataFrame({"t": [0.0, 0.5, 2.0], "u": [1, 2, 3], "text": ["a", "b", "c"]})


@pytest.mark.parametrize("kind", ["int64", "float32", "Float64", "Int64", "float64[pyarrow]"])
def test_columns_of_tables_are_taken_as_a_record_takes_them(kind):
    u = COLUMNS["u"].astype(kind)
    for values in (u, u.array, u.to_list(), range(1, 4), u.to_xarray()):
        assert jms.Signal(COLUMNS["t"], values).values.tolist() == [1.0, 2.0, 3.0]
        assert jms.Record(COLUMNS["t"], values).measured.tolist() == [1.0, 2.0, 3.0]
    assert jms.Signal(COLUMNS.set_index("t").index, u).t.tolist() == [0.0, 0.5, 2.0]
    hollow = u.astype("Float64").where(u != 2)
    with pytest.raises(ValueError, match=r"values must be finite, but the one at t = 0.5 is nan"):
        jms.Signal(COLUMNS["t"], hollow)


def test_columns_of_text_are_refused_in_a_line():
    for make in (jms.Signal, jms.Record):
        with pytest.raises(
            ValueError, match=r"must hold real numbers, but a Series of (str|object) was given"
        ) as error:
            make(COLUMNS["t"], COLUMNS["text"])
        assert "\n" not in str(error.value)
