"""Filters and smoothers in square-root form against dense Gaussian conditioning and the plain Kalman filter."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmodsim.control import Gaussian, linearized, unscented
from jaxmodsim.control._square_root import correct, predict, smoothed, triangular_factor

from ..helpers.differences import central_difference

N, M, TIMES = 3, 2, 6
RNG = np.random.default_rng(3)
F = np.eye(N) + 0.3 * RNG.normal(size=(N, N))
H = RNG.normal(size=(M, N))
Q, R = np.array([0.2, 0.5, 0.0]), np.array([0.3, 0.1])
MEAN, FACTOR = RNG.normal(size=N), np.tril(RNG.normal(size=(N, N))) + 2.0 * np.eye(N)
MEASURED = RNG.normal(size=(TIMES, M))
MEASURED[2, 0] = MEASURED[4] = np.nan  # absent channels


def filtered(transform: Any, noise: Any = R) -> tuple[list[Any], list[Any], Any]:
    """States after each measurement, the steps between them, and the likelihood of the record."""
    x, states, steps, total = Gaussian(jnp.asarray(MEAN), jnp.asarray(FACTOR)), [], [], 0.0
    for k in range(TIMES):
        if k:
            steps.append(predict(lambda x: jnp.asarray(F) @ x, x, jnp.asarray(Q), transform))
            x = steps[-1].ahead
        done = correct(lambda x: jnp.asarray(H) @ x, x, jnp.asarray(MEASURED[k]), jnp.asarray(noise), transform)
        x, total = done.state, total + done.log_likelihood
        states.append(x)
    return states, steps, total


def dense(until: int) -> tuple[np.ndarray, np.ndarray, float]:
    """Mean and covariance of all states given the measurements up to one time, by conditioning the joint Gaussian."""
    size = N * TIMES
    transition = np.eye(size)  # states from the first one and all noises
    for k in range(1, TIMES):
        transition[N * k : N * (k + 1)] += F @ transition[N * (k - 1) : N * k]
        transition[N * k : N * (k + 1), N * k : N * (k + 1)] = np.eye(N)
    blocks = np.zeros((size, size))
    blocks[:N, :N] = FACTOR @ FACTOR.T
    for k in range(1, TIMES):
        blocks[N * k : N * (k + 1), N * k : N * (k + 1)] = np.diag(Q**2)
    first = np.zeros(size)
    first[:N] = MEAN
    mean, cov = transition @ first, transition @ blocks @ transition.T
    output = np.kron(np.eye(TIMES), H)
    seen = (np.isfinite(MEASURED) & (np.arange(TIMES)[:, None] <= until)).ravel()
    output, measured = output[seen], MEASURED.ravel()[seen]
    total = output @ cov @ output.T + np.diag(np.tile(R**2, TIMES)[seen])
    error = measured - output @ mean
    gain = np.linalg.solve(total, output @ cov).T
    logs = -0.5 * (error @ np.linalg.solve(total, error) + np.linalg.slogdet(2 * np.pi * total)[1])
    return mean + gain @ error, cov - gain @ output @ cov, logs


@pytest.mark.parametrize("transform", [linearized, unscented])
def test_filter_and_smoother_are_exact_conditioning(transform):
    states, steps, total = filtered(transform)
    for k in range(TIMES):
        mean, cov, _ = dense(k)
        part = slice(N * k, N * (k + 1))
        np.testing.assert_allclose(states[k].mean, mean[part], rtol=1e-9, atol=1e-11)
        np.testing.assert_allclose(states[k].factor @ states[k].factor.T, cov[part, part], rtol=1e-8, atol=1e-11)
    mean, cov, logs = dense(TIMES)
    np.testing.assert_allclose(total, logs, rtol=1e-11)
    after = states[-1]
    for k in reversed(range(TIMES - 1)):
        after = smoothed(states[k], steps[k], after)
        part = slice(N * k, N * (k + 1))
        np.testing.assert_allclose(after.mean, mean[part], rtol=1e-9, atol=1e-11)
        np.testing.assert_allclose(after.factor @ after.factor.T, cov[part, part], rtol=1e-8, atol=1e-11)


def test_gradient_of_the_likelihood():
    gradient = jax.grad(lambda noise: filtered(linearized, noise)[2])(jnp.asarray(R))
    for i in range(M):
        unit = np.eye(M)[i]
        # Truncation of order step^4, rounding 1e-14/step.
        slope = central_difference(lambda s, unit=unit: filtered(linearized, R + s * unit)[2], 0.0, 1e-3 * R[i])
        np.testing.assert_allclose(gradient[i], slope, rtol=1e-8)


def test_a_fixed_state_keeps_its_variance_and_counts():
    """Schmidt's filter: the gain of the other states is optimal, and their covariance that of the suboptimal gain."""
    x = Gaussian(jnp.asarray(MEAN), jnp.asarray(FACTOR))
    free = jnp.array([1.0, 1.0, 0.0])
    done = correct(lambda x: jnp.asarray(H) @ x, x, jnp.asarray(MEASURED[0]), jnp.asarray(R), linearized, free)
    cov = FACTOR @ FACTOR.T
    gain = np.linalg.solve(H @ cov @ H.T + np.diag(R**2), H @ cov).T * np.asarray(free)[:, None]
    rest = np.eye(N) - gain @ H
    expected = rest @ cov @ rest.T + gain @ np.diag(R**2) @ gain.T
    np.testing.assert_allclose(done.state.factor @ done.state.factor.T, expected, rtol=1e-10)
    np.testing.assert_allclose(done.state.mean[2], MEAN[2], rtol=1e-15)
    np.testing.assert_allclose(expected[2, 2], cov[2, 2], rtol=1e-12)


def test_factors_of_dependent_rows_have_derivatives():
    """A row that depends on the ones before has a zero on the diagonal; a row of zeros too."""
    matrix = jnp.array([[3.0, 4.0, 0.0], [0.0, 0.0, 0.0], [1.0, 2.0, 2.0]])
    factor = triangular_factor(matrix)
    np.testing.assert_allclose(factor @ factor.T, matrix @ matrix.T, atol=1e-14)
    assert factor[1, 1] == 0.0
    assert np.isfinite(jax.jacrev(triangular_factor)(matrix)).all()
    single = triangular_factor(matrix.astype(jnp.float32))
    assert single.dtype == jnp.float32
    np.testing.assert_allclose(single, factor, atol=1e-6)


def test_a_square_root_holds_in_single_precision():
    """A measurement a million times more accurate than what was known, for which `P - K H P` is lost in float32."""
    x = Gaussian(jnp.zeros(2, jnp.float32), jnp.eye(2, dtype=jnp.float32))
    row, noise = jnp.ones((1, 2), jnp.float32), jnp.full(1, 1e-6, jnp.float32)
    done = correct(lambda x: row @ x, x, jnp.ones(1, jnp.float32), noise, linearized)
    deviation = float(jnp.linalg.norm(row @ done.state.factor))
    np.testing.assert_allclose(deviation, 1e-6, rtol=0.3)
