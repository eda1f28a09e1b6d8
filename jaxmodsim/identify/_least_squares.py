"""Nonlinear least squares by Levenberg-Marquardt, one visible iteration after the other."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float

from ._parameters import FreeParameters

# Called after each iteration with its number, the root mean square of the residual, and the parameters by name.
Progress: TypeAlias = Callable[[int, float, dict[str, float]], None]
Residual: TypeAlias = Callable[[dict[str, Array], Any], Float[Array, " samples"]]

# Blocks of the covariance of the score: enough for six or seven parameters, and each far longer than what the
# residual of a mechanism is correlated over.
_BLOCKS = 32


@dataclass(frozen=True)
class Estimate:
    """What least squares found; arrays in the order of `names`, `following` by name (see `FreeParameters`)."""

    names: tuple[str, ...]
    start: Float[np.ndarray, " free"]
    values: Float[np.ndarray, " free"]
    following: dict[str, float]
    covariance: Float[np.ndarray, "free free"]
    residual: Float[np.ndarray, " samples"]
    jacobian: Float[np.ndarray, "samples free"]
    iterations: int
    ending: str

    @property
    def found(self) -> dict[str, Array]:
        """All values that differ from the start, by name."""
        return {
            name: jnp.asarray(x) for name, x in (*zip(self.names, self.values, strict=True), *self.following.items())
        }


def least_squares(
    residual: Residual,
    free: FreeParameters,
    data: Any,
    *,
    rtol: float,
    max_steps: int,
    progress: Progress | None,
) -> Estimate:
    """Minimise the sum of squares of `residual(values, data)` over the free parameters.

    Levenberg-Marquardt (optimistix) on forward-mode Jacobians. Ctrl-C ends it with the best so far.

    **Raises:**

    - `ValueError` if there are no more samples than free parameters.
    - `RuntimeError` if the residual is not finite at the start.
    """
    function = _with_dense_jacobian(lambda x, data: residual(free.values(x), data))
    solver = optx.LevenbergMarquardt(rtol=rtol, atol=rtol)
    options, tags = {"jac": "fwd"}, frozenset()
    x = jnp.zeros(len(free.names))
    f_struct, aux_struct = eqx.filter_eval_shape(function, x, data)
    if f_struct.shape[0] <= x.shape[0]:
        raise ValueError(f"{f_struct.shape[0]} samples are too few for {x.shape[0]} free parameters.")
    state = solver.init(function, x, data, options, f_struct, aux_struct, tags)

    @eqx.filter_jit
    def iterate(x: Array, state: Any, data: Any) -> tuple[Array, Any, Array, Array]:
        x, state, _ = solver.step(function, x, data, options, state, tags)
        done, _ = solver.terminate(function, x, data, options, state, tags)
        return x, state, done, jnp.sqrt(2 * state.f_info.as_min() / f_struct.shape[0])

    steps, ending = 0, f"stopped at the limit of {max_steps} iterations"
    try:
        for steps in range(1, max_steps + 1):
            x, state, done, rms = iterate(x, state, data)
            if steps == 1 and not np.isfinite(np.asarray(state.f_info.residual)).all():
                raise RuntimeError(
                    "The model gives values that are not finite at the start of the fit: check the start values, or"
                    " take more substeps."
                )
            if progress is not None and np.isfinite(float(rms)):
                progress(steps, float(rms), {name: float(v) for name, v in free.values(x).items()})
            if bool(done):
                ending = "converged"
                break
    except KeyboardInterrupt:
        if steps < 2:
            raise  # nothing was computed yet
        ending = "interrupted; these are the best values so far"
    r = np.asarray(state.f_info.residual)
    # By the parameters themselves instead of x.
    jacobian = np.linalg.solve(np.asarray(free.slopes(x)).T, np.asarray(state.f_info.jac.as_matrix()).T).T
    return Estimate(
        free.names,
        np.array([free.start[name] for name in free.names]),
        np.asarray(free.vector(x)),
        {name: float(value) for name, value in free.values(x).items() if name in free.following},
        _covariance(jacobian, r),
        r,
        jacobian,
        steps,
        ending,
    )


def _with_dense_jacobian(residual: Callable[[Array, Any], Array]) -> Callable[[Array, Any], tuple[Array, None]]:
    """The residual, with a derivative that is computed as a whole matrix.

    optimistix linearises the residual and keeps the linear map, which for a run of many steps would mean to keep
    every step's; all columns side by side in one forward sweep keep nothing and are several times faster.
    """

    @jax.custom_jvp
    def function(x: Array, data: Any) -> Array:
        return residual(x, data)

    @function.defjvp
    def _(primals: tuple[Any, Any], tangents: tuple[Any, Any]) -> tuple[Array, Array]:
        x, data = primals
        r, columns = jax.vmap(lambda unit: jax.jvp(lambda x: residual(x, data), (x,), (unit,)), out_axes=(None, 1))(
            jnp.eye(x.shape[0], dtype=x.dtype)
        )
        return r, columns @ tangents[0]

    return lambda x, data: (function(x, data), None)


def _covariance(jacobian: np.ndarray, residual: np.ndarray) -> np.ndarray:
    """Covariance of the estimate, with the correlation of the residual in time taken into account.

    `(J'J)^-1 S (J'J)^-1` with S the sum over blocks of samples of the squared scores `J_b' r_b`: residuals may be
    correlated in any way within a block. The scatter of the blocks gives away as many degrees of freedom as there
    are parameters.
    """
    n, p = jacobian.shape
    blocks = max(min(_BLOCKS, n // 2), p + 1)
    edges = np.linspace(0, n, blocks + 1).astype(int)[:-1]
    scores = np.add.reduceat(jacobian * residual[:, None], edges, axis=0)
    # Columns differ by orders of magnitude, so the scaled matrix is inverted. Its eigenvalues are kept off zero: a
    # direction that the record says nothing about gets a huge error, not none.
    scale = np.sqrt(np.sum(jacobian**2, axis=0))
    silent = scale == 0
    scale = np.where(silent, 1.0, scale)
    eigenvalues, vectors = np.linalg.eigh((jacobian / scale).T @ (jacobian / scale))
    bread = vectors / np.maximum(eigenvalues, 1e-15 * max(eigenvalues[-1], 1.0)) @ vectors.T
    scores = scores / scale
    meat = scores.T @ scores * (blocks / max(blocks - p, 1))
    covariance = bread @ meat @ bread / np.outer(scale, scale)
    covariance[silent, silent] = np.inf
    return covariance
