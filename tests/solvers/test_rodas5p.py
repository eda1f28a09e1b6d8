"""Rodas5P as a plug-in of plain diffrax, without anything else of this package."""

import re
from typing import Any

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from jaxmodsim import Rodas5P
from jaxmodsim._core import lu as _lu

from ..helpers.differences import central_difference

T1 = 2.0
FINE = jnp.linspace(0.0, T1, 157)  # shares no inner point with the steps below


def field(t: Any, y: Any, args: Any) -> Any:
    """Nonlinear and nonautonomous, in leaves of two shapes; `exact` solves it."""
    del args
    a, b = y["a"], y["b"]
    bend = -2.0 * t * b[0, 0]
    return {"a": bend * a, "b": jnp.stack([jnp.stack([bend * b[0, 0], b[0, 1] * jnp.cos(t) * a / b[0, 0]])])}


def exact(t: Any) -> dict[str, Any]:
    """`b_0 = a = 1/(1+t^2)` and `b_1 = exp(sin t)`."""
    bell = 1.0 / (1.0 + t**2)
    return {"a": bell, "b": jnp.stack([bell, jnp.exp(jnp.sin(t))], axis=-1)[..., None, :]}


@pytest.fixture(scope="module")
def fixed_step() -> Any:
    """Errors at fixed steps: at the end, by `SaveAt(ts)`, and by dense output. The step is an argument."""

    @jax.jit
    def run(dt: Any) -> tuple[Any, Any, Any]:
        saveat = dfx.SaveAt(t1=True, ts=FINE, dense=True)
        steps = dfx.diffeqsolve(
            dfx.ODETerm(field),
            Rodas5P(),
            0.0,
            T1,
            dt,
            exact(jnp.array(0.0)),
            saveat=saveat,
            stepsize_controller=dfx.ConstantStepSize(),
            max_steps=80,
        )
        ys: Any = steps.ys
        dense = jax.vmap(steps.evaluate)(FINE)

        def error(x: Any, y: Any) -> Any:
            return jnp.max(
                jnp.stack([jnp.max(jnp.abs(p - q)) for p, q in zip(*map(jax.tree.leaves, (x, y)), strict=True)])
            )

        end = error(jax.tree.map(lambda x: x[-1], ys), exact(jnp.array(T1)))
        return end, error(jax.tree.map(lambda x: x[:-1], ys), exact(FINE)), error(dense, exact(FINE))

    return run


@pytest.mark.quick
def test_observed_order(fixed_step: Any) -> None:
    """5 at the steps' ends, and at least 4 in between, where the dense output has that order."""
    counts = np.array([10, 20, 40, 80])
    errors = np.array([[float(e) for e in fixed_step(T1 / n)] for n in counts])
    orders = np.log2(errors[:-1] / errors[1:])
    # The last halving is close to its limit: one part in ten is left of the next order.
    np.testing.assert_allclose(orders[-1, 0], 5.0, atol=0.3)
    assert (orders[-1, 1:] > 3.8).all()
    # A method whose order is right but whose coefficients are in part not has a larger constant.
    assert errors[-1, 0] < 1e-8
    assert errors[-1, 1:].max() < 1e-7
    # SaveAt(ts) and dense output are the same polynomial.
    np.testing.assert_allclose(errors[:, 1], errors[:, 2], rtol=1e-6)


def test_dense_increment_is_the_difference_of_its_ends() -> None:
    y0 = {"x": jnp.array([1.0, 2.0])}
    k = tuple({"x": jnp.array([0.1 * i, -0.2])} for i in range(3))
    local = Rodas5P.interpolation_cls(t0=jnp.array(1.0), t1=jnp.array(3.0), y0=y0, y1={"x": jnp.array([2.0, 1.0])}, k=k)
    np.testing.assert_array_equal(local.evaluate(jnp.array(1.0))["x"], [1.0, 2.0])
    np.testing.assert_array_equal(local.evaluate(jnp.array(3.0))["x"], [2.0, 1.0])
    step = local.evaluate(jnp.array(1.5), jnp.array(2.5))["x"]
    whole = local.evaluate(jnp.array(2.5))["x"] - local.evaluate(jnp.array(1.5))["x"]
    np.testing.assert_array_equal(step, whole)


def robertson(t: Any, y: Any, args: Any) -> Any:
    del t, args
    a, b, c = y
    return (-0.04 * a + 1e4 * b * c, 0.04 * a - 1e4 * b * c - 3e7 * b**2, 3e7 * b**2)


def test_robertson_against_radau() -> None:
    """Rates from 1e-2 to 1e4 1/s over eleven decades of time, against SciPy's Radau at tight tolerances."""
    times = np.array([0.4, 40.0, 4e3, 4e6])
    reference = solve_ivp(
        lambda t, y: robertson(t, y, None), (0.0, 4e6), [1.0, 0.0, 0.0], "Radau", times, rtol=1e-11, atol=1e-16
    ).y.T

    @jax.jit
    def run(rtol: Any) -> tuple[Any, Any]:
        solution = dfx.diffeqsolve(
            dfx.ODETerm(robertson),
            Rodas5P(),
            0.0,
            4e6,
            1e-6,
            (jnp.array(1.0), jnp.array(0.0), jnp.array(0.0)),
            saveat=dfx.SaveAt(ts=jnp.asarray(times)),
            stepsize_controller=dfx.PIDController(rtol, rtol * 1e-5),
        )
        ys: Any = solution.ys
        return jnp.stack(ys, axis=-1), solution.stats["num_steps"]

    loose, few = run(1e-5)
    tight, many = run(1e-8)
    # Local tolerances add up over the steps taken: allow ten times the tolerance.
    np.testing.assert_allclose(loose, reference, rtol=1e-4)
    np.testing.assert_allclose(tight, reference, rtol=1e-7)
    np.testing.assert_allclose(np.sum(tight, axis=1), 1.0, rtol=1e-12)  # linear invariants are kept
    assert few < many < 1000  # an explicit method needs about 1e10


def ring(n: int) -> Any:
    """`n` states that drive each other in a ring; states beyond the first 12 are still."""

    def rates(t: Any, y: Any, args: Any) -> Any:
        del args
        head = y[:12]
        rate = jnp.sin(jnp.roll(head, 1)) * jnp.cos(t + jnp.roll(head, -3)) - 5.0 * head**3
        return jnp.concatenate([rate, jnp.zeros(n - 12)])

    return rates


def compiled_ring(n: int) -> Any:
    """One step, and what the dense output and the error estimate take besides."""

    def step(t: Any, y: Any) -> Any:
        return Rodas5P().step(dfx.ODETerm(ring(n)), t, t + 0.05, y, None, None, False)[:3]

    return jax.jit(step).lower(jnp.array(0.0), jnp.zeros(n)).compile()


def library_calls(compiled: Any) -> list[str]:
    return re.findall(r'custom_call_target="([^"]*)"', compiled.as_text())


def test_scalars_and_arrays_agree() -> None:
    """Twelve states are solved in scalars, thirteen in arrays, to the same numbers; neither calls into LAPACK."""
    assert _lu.MAX_UNROLLED_LU == 12
    y0 = jnp.linspace(-1.0, 1.5, 12)
    small, large = compiled_ring(12), compiled_ring(13)
    assert library_calls(small) == library_calls(large) == []
    t, y, z = jnp.array(0.0), y0, jnp.append(y0, 0.25)
    for _ in range(5):
        (y, error, inside), (z, large_error, large_inside) = small(t, y), large(t, z)
        t = t + 0.05
        # I/(gamma dt), 94, dominates the matrix, so with row swaps or without only rounding is different.
        np.testing.assert_allclose(y, z[:12], atol=1e-13)
        np.testing.assert_allclose(error, large_error[:12], atol=1e-13)
        for k, large_k in zip(inside["k"], large_inside["k"], strict=True):
            np.testing.assert_allclose(k, large_k[:12], atol=1e-12)
        assert z[12] == 0.25


def decay(t: Any, y: Any, args: Any) -> Any:
    return -args * (y - jnp.cos(t).astype(y.dtype))


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_dtype_is_kept(dtype: Any) -> None:
    """Single precision stays single under x64, and is good to its tolerance."""
    solution = dfx.diffeqsolve(
        dfx.ODETerm(decay),
        Rodas5P(),
        jnp.array(0.0, dtype),
        jnp.array(1.0, dtype),
        None,
        jnp.array([0.5], dtype),
        args=jnp.array(100.0, dtype),
        stepsize_controller=dfx.PIDController(1e-4, 1e-6),
    )
    ys: Any = solution.ys
    assert ys.dtype == dtype
    # y = (a^2 cos t + a sin t)/(a^2 + 1) once the transient exp(-100 t) is over.
    expected = (1e4 * np.cos(1.0) + 100.0 * np.sin(1.0)) / (1e4 + 1.0)
    np.testing.assert_allclose(ys[0, 0], expected, rtol=1e-3)


@pytest.mark.parametrize("y0", [jnp.array([1.0 + 1.0j]), jnp.array([1])])
def test_states_that_are_not_real_are_refused(y0: jax.Array) -> None:
    with pytest.raises(ValueError, match=r"real floating numbers, but one of its arrays has the type (complex|int)"):
        Rodas5P().init(dfx.ODETerm(decay), 0.0, 1.0, y0, None)


def test_derivatives_forward_and_reverse() -> None:
    """Of a stiff van der Pol oscillator's end by its parameter and its start."""

    def end(x: Any, adjoint: Any) -> Any:
        solution = dfx.diffeqsolve(
            dfx.ODETerm(lambda t, y, mu: (y[1], mu * (1 - y[0] ** 2) * y[1] - y[0] + 0.1 * jnp.sin(t))),
            Rodas5P(),
            0.0,
            2.0,
            0.02,
            (x[1], x[2]),
            args=x[0],
            stepsize_controller=dfx.ConstantStepSize(),
            max_steps=128,
            adjoint=adjoint,
        )
        ys: Any = solution.ys
        return ys[0][0]

    point = jnp.array([20.0, 2.0, -0.5])
    value = jax.jit(lambda x: end(x, dfx.DirectAdjoint()))
    reverse = np.asarray(jax.jit(jax.grad(lambda x: end(x, dfx.RecursiveCheckpointAdjoint())))(point))
    forward = np.asarray(jax.jit(jax.jacfwd(lambda x: end(x, dfx.ForwardMode())))(point))
    np.testing.assert_allclose(forward, reverse, rtol=1e-10)
    # With a fixed step the run is one smooth function. Step 1e-3 of each number: truncation 1e-12, rounding 1e-12.
    for i in range(3):
        x0 = float(point[i])
        slope = central_difference(lambda x, i=i: value(point.at[i].set(x)), x0, 1e-3 * abs(x0))
        np.testing.assert_allclose(reverse[i], slope, rtol=1e-7)
