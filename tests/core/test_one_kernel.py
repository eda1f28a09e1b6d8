"""Programs compiled as one kernel: what is marked, and that it computes the same."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxmodsim as jms
from jaxmodsim._core.one_kernel import in_one_kernel
from jaxmodsim.problems import bouncing_ball

_MARK = "xla_cpu_small_call"
X = np.random.default_rng(0).normal(size=(7, 5))


def _compiled(function, *args):
    """What `function` gives in one kernel, and whether it was marked."""
    lowered = jax.jit(lambda *args: in_one_kernel(jax.jit(function), *args)).lower(*args)
    return lowered.compile()(*args), _MARK in lowered.as_text()


@pytest.mark.parametrize(
    ("function", "args"),
    [
        pytest.param(lambda x: jax.lax.fori_loop(0, 9, lambda i, x: jnp.sin(x + i), x), (X,), id="loop"),
        pytest.param(lambda x: jax.lax.cond(x[0, 0] > 0, jnp.sin, jnp.cos, x), (X,), id="branch"),
        pytest.param(lambda x, i: x[i], (X, np.array([3, 1, 6])), id="gather"),
        pytest.param(lambda x, i: x.at[i].set(1.0), (X, np.int64(2)), id="one place"),
        pytest.param(lambda x, i: x.at[i].set(1.0, mode="drop"), (X, np.int64(20)), id="no place"),
        pytest.param(lambda x: (x.T @ x)[:2, :3] @ x[:3, :3], (X[:3, :3],), id="small matrices"),
        pytest.param(lambda x, y: (x, y), (X, np.array(True)), id="handed on"),
        pytest.param(lambda x, y: x + 0 * y, (X, np.uint8(3)), id="argument of no use"),
        pytest.param(lambda x, y: jnp.where(False, x, 1.0), (X, np.array(np.nan, np.float32)), id="none of use"),
        pytest.param(lambda x, v: jnp.interp(v, x, x * x), (np.sort(X[:, 0]), np.float64(0.3)), id="interpolation"),
        pytest.param(lambda x: jax.scipy.special.erfinv(jnp.tanh(x)) + jnp.sinh(x), (X,), id="special functions"),
    ],
)
def test_one_kernel_gives_the_same(function, args):
    found, marked = _compiled(function, *args)
    assert marked
    for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(jax.jit(function)(*args)), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-15)


def _written_into(x):
    """A loop that hands on 40 arrays."""
    start = [jnp.broadcast_to(x[0], x.shape)] * 40
    ends = jax.lax.fori_loop(0, 9, lambda i, arrays: [each.at[i].set(1.0) for each in arrays], start)
    return jnp.stack([each[0] for each in ends])


@pytest.mark.parametrize(
    ("function", "args"),
    [
        pytest.param(lambda x: jnp.sort(x), (X,), id="sort"),
        pytest.param(lambda x: jnp.linalg.cholesky(x.T @ x), (X,), id="LAPACK"),
        pytest.param(lambda x: jax.pure_callback(np.sin, jax.ShapeDtypeStruct(x.shape, x.dtype), x), (X,), id="call"),
        pytest.param(lambda x, i: x.at[i].add(1.0), (X, np.array([1, 1, 2])), id="several places"),
        pytest.param(lambda x: x @ x, (np.ones((8, 8)),), id="matrices of a library"),
        pytest.param(lambda x: jnp.sum(x), (np.ones(2000),), id="sum of a library"),
        pytest.param(lambda x: jnp.sin(x), (np.ones(200_000),), id="work for several cores"),
        pytest.param(_written_into, (np.ones(200_000),), id="buffers that come fresh from the system"),
        pytest.param(lambda x: jnp.real(jnp.exp(1j * x)), (X,), id="complex"),
        pytest.param(lambda x: jnp.sin(x), (np.ones((0, 2)),), id="empty"),
    ],
)
def test_what_no_kernel_holds_stays_as_it_is(function, args):
    found, marked = _compiled(function, *args)
    assert not marked
    np.testing.assert_allclose(found, function(*map(jnp.asarray, args)), rtol=1e-14)


def test_derivatives_are_kernels_of_their_own():
    decay = jax.jit(lambda x, rate: jax.lax.fori_loop(0, 5, lambda _, x: x * jnp.exp(-rate), x))

    def total(x, rate):
        return jnp.sum(in_one_kernel(decay, x, rate))

    x, rate = jnp.asarray(X), jnp.asarray(0.1)
    closed = -5.0 * float(np.sum(X)) * np.exp(-0.5)
    for derivative in (jax.grad(total, argnums=1), jax.jacfwd(total, argnums=1)):
        lowered = jax.jit(derivative).lower(x, rate)
        np.testing.assert_allclose(lowered.compile()(x, rate), closed, rtol=1e-14)
        assert _MARK in lowered.as_text()
    # Nothing but the derivative is asked for: the run that it needs is a kernel, too.
    assert jax.jit(jax.grad(total, argnums=1)).lower(x, rate).as_text().count(_MARK) == 2
    np.testing.assert_allclose(jax.hessian(total, argnums=1)(x, rate), -5.0 * closed, rtol=1e-13)


def test_few_runs_side_by_side_are_one_kernel_and_many_are_not():
    decay = jax.jit(lambda x: jax.lax.fori_loop(0, 5, lambda _, x: 0.5 * x, x))
    for runs, marked in ((8, True), (65, False)):
        call = jax.jit(jax.vmap(lambda x: in_one_kernel(decay, x)))
        x = jnp.arange(float(runs))
        assert (_MARK in call.lower(x).as_text()) == marked
        np.testing.assert_array_equal(call(x), x / 32)


def test_another_call_of_the_same_function_keeps_its_own():
    decay = jax.jit(lambda x: jax.lax.fori_loop(0, 5, lambda _, x: 0.5 * x, x))
    both = jax.jit(lambda x: (in_one_kernel(decay, x), decay(2.0 * x)))
    text = both.lower(X).as_text()
    assert text.count(_MARK) == 1
    marked, plain = re.findall(r"call @(\S+?)\(", text)[:2]
    assert marked != plain
    for one, factor in zip(both(X), (1.0, 2.0), strict=True):
        np.testing.assert_array_equal(one, factor * X / 32)


def test_a_run_and_its_gradient_are_kernels(pendulum):
    def end(q0):
        return jms.simulate(pendulum, jnp.stack([q0]), [0.0], 1.0, throw=False).q[-1, 0]

    for function, kernels in ((end, 1), (jax.grad(end), 2), (jax.jacfwd(end), 1)):
        assert jax.jit(function).lower(0.3).as_text().count(_MARK) == kernels


def test_what_is_known_of_a_run_stays_an_argument():
    """XLA would write it into the kernel, and end the process over the argument that is left without use."""

    def height(e):
        return jms.simulate(bouncing_ball.scene(e=e), [1.0], [0.0], 0.6, throw=False).q[-1, 0]

    closed = jax.grad(lambda e: bouncing_ball.motion(jnp.asarray(0.6), h=1.0, e=e)[0])(0.5)
    gradient = jax.jit(jax.grad(height))
    np.testing.assert_allclose(gradient(0.5), closed, rtol=1e-6)
    # Contacts without friction have arrays of no entries, which are no reason against a kernel.
    assert gradient.lower(0.5).as_text().count(_MARK) == 2


def test_runs_that_are_made_again_are_kernels(pendulum):
    damped = jms.Scene(pendulum.lagrangian, params=pendulum.params, effects=(jms.Friction(jms.Viscous(0.1)),))
    for scene, read in (
        (bouncing_ball.scene(e=0.5), lambda run: run.events.t),
        (damped, lambda run: run.energy.dissipated),
    ):
        lowered = jax.jit(lambda q0, scene=scene, read=read: read(jms.simulate(scene, q0, [0.0], 0.6, throw=False)))
        # The motion is not asked for, so that the run without events or work beside it is dropped.
        assert lowered.lower(jnp.ones(1)).as_text().count(_MARK) == 1


@pytest.mark.parametrize(
    ("function", "args"),
    [
        pytest.param(lambda x, none: x + jnp.sum(none), (X, np.ones((0, 2))), id="argument"),
        pytest.param(lambda x, none: (2 * x, none), (X, np.ones((0, 2), int)), id="result"),
        pytest.param(lambda x, none: 2 * x, (X, np.ones(0, np.int32)), id="of no use"),
    ],
)
def test_arrays_of_no_entries_are_no_reason_against_a_kernel(function, args):
    found, marked = _compiled(function, *args)
    assert marked
    jax.tree.map(np.testing.assert_array_equal, found, function(*map(jnp.asarray, args)))


@pytest.fixture
def pendulum():
    return jms.Scene(lambda t, q, qd, params: 0.5 * params["m"] * qd[0] ** 2 + jnp.cos(q[0]), params={"m": 1.0})
