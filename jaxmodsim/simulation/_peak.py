"""The largest magnitude of a series in a run, also between saved times."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from .._core.arrays import is_known
from ._observe import find_series, read_series
from ._solve import Nodes, solve
from ._trajectory import Trajectory, trajectory

# Number of steps with the largest estimates that are searched for the peak, and of samples in each of them.
_INTERVALS, _SAMPLES = 8, 16
# The samples of a step are at Chebyshev's points, -cos(angle) on [-1, 1]: their interpolant is as accurate as the dense
# output, also at the ends. Its largest value is sought at the angles of a finer grid.
_ANGLES = (np.arange(_SAMPLES) + 0.5) * np.pi / _SAMPLES
_GRID = np.linspace(0.0, np.pi, 8 * _SAMPLES + 1)
# Relative difference up to which a peak at the end of a step counts as that of an event or of a saved time, whose times
# have derivatives. A turning point within a step has its derivative at its own time: a saved time close by does not.
_CORNER = 1e-6
# Sum of the last four coefficients, in parts of the range of the samples, above which the series jumps in the step. The
# coefficients of a jump fall as 1/k; those of a smooth series are far smaller.
_JUMP = 0.05


def peak_of(run: Trajectory, name: str) -> Float[Array, ""]:
    """Largest magnitude of a series from t0 to the end of a run, see `metrics.peak`.

    **Returns:**

    The magnitude, shape `[]`, with derivatives.

    **Raises:**

    - `ValueError` for an unknown name.
    """
    series = find_series(run, name)
    x = read_series(run, series)
    # Of equal peaks the first counts, with its derivative: `jnp.max` has a mixture of theirs.
    saved = jax.lax.top_k(jnp.where(jnp.isfinite(run.t), jnp.abs(x), 0.0), 1)[0][0]
    corner = jax.lax.top_k(jnp.append(jnp.abs(run.event_sides(series)), 0.0), 1)[0][0]
    at_node = jnp.where(corner >= (1.0 - _CORNER) * saved, corner, saved)
    between, turns = _between(run, name)
    return jnp.where(at_node >= jnp.where(turns, 1.0 + _CORNER, 1.0 - _CORNER) * between, at_node, between)


def _between(run: Trajectory, name: str) -> tuple[Float[Array, ""], Bool[Array, ""]]:
    """The largest magnitude within steps, and whether it is a turning point.

    A first repeat of the run selects steps, a second one samples them.
    """
    series = find_series(run, name)
    plain = run.request._replace(ts=None).choosing(log=0, audited=False)
    nodes = solve(jax.lax.stop_gradient(plain.choosing(max_steps=_most_steps(run), series=series))).nodes
    assert nodes is not None
    chosen = _largest(nodes)
    start, length = nodes.t[chosen], nodes.t[chosen + 1] - nodes.t[chosen]
    within = jnp.isfinite(length)
    start, length = jnp.where(within, start, run.t_end), jnp.where(within, length, 0.0)
    # Open intervals, as an event may have changed the series at their ends.
    share = jnp.asarray(0.5 - 0.5 * np.cos(_ANGLES), start.dtype)
    ts = start[:, None] + share[None, :] * length[:, None]
    ts = jnp.clip(jax.lax.stop_gradient(ts), plain.t0, run.t_end)
    near = plain._replace(ts=jnp.ravel(ts))
    samples = jnp.reshape(read_series(trajectory(near, solve(near)), series), ts.shape)
    samples = jnp.where(within[:, None] & jnp.isfinite(samples), samples, 0.0)
    peaks, turns = jax.vmap(_vertex)(samples)
    highest, at = jax.lax.top_k(peaks, 1)
    return highest[0], turns[at[0]]


def _most_steps(run: Trajectory) -> int:
    """A bound on the number of steps, a power of two if that is known: each bound compiles a program."""
    count, most = run.stats["num_steps"], run.request.choices.max_steps
    return min(most, 1 << max(int(count), 64).bit_length()) if is_known(count) else most


def _largest(nodes: Nodes) -> Int[Array, " intervals"]:
    """The steps with the largest estimates of the magnitude, in the order of time."""
    t, x = nodes.t, jnp.where(jnp.isfinite(nodes.t), nodes.x, 0.0)
    step = jnp.where(jnp.isfinite(t[1:]), jnp.diff(jnp.where(jnp.isfinite(t), t, 0.0)), 0.0)
    v = _slopes(step, x) if nodes.rate is None else jnp.where(jnp.isfinite(t), nodes.rate, 0.0)
    turn = jnp.abs(_turns(step, x, v))
    estimate = jnp.maximum(jnp.maximum(jnp.abs(x[:-1]), jnp.abs(x[1:])), turn)
    _, chosen = jax.lax.top_k(jnp.where(step > 0, estimate, -1.0), min(_INTERVALS, step.shape[0]))
    return jnp.sort(chosen)


def _slopes(step: Float[Array, " steps"], x: Float[Array, " nodes"]) -> Float[Array, " nodes"]:
    """Slopes at the nodes of the parabolas through each node and its neighbours."""
    slope = jnp.diff(x) / jnp.where(step > 0, step, 1.0)
    both = step[:-1] + step[1:]
    inner = (step[1:] * slope[:-1] + step[:-1] * slope[1:]) / jnp.where(both > 0, both, 1.0)
    return jnp.concatenate([slope[:1], inner, slope[-1:]])


def _turns(step: Float[Array, " steps"], x: Float[Array, " nodes"], v: Float[Array, " nodes"]) -> Array:
    """Value of the turning point of x within a step, by the cubic through its ends with slopes `v`; zero without."""
    turns = v[:-1] * v[1:] < 0
    x0, x1, v0, v1 = x[:-1], x[1:], v[:-1], v[1:]
    s = v0 / jnp.where(turns, v0 - v1, 1.0)
    cubic = (1 - s) ** 2 * ((1 + 2 * s) * x0 + s * step * v0) + s**2 * ((3 - 2 * s) * x1 - (1 - s) * step * v1)
    return jnp.where(turns, cubic, 0.0)


def _vertex(x: Float[Array, " samples"]) -> tuple[Float[Array, ""], Bool[Array, ""]]:
    """Largest magnitude within a step, and whether it is a turning point rather than an end of the step.

    It is that of the interpolant of the samples. Its time is a constant: the series is stationary there, or the step
    ends. Beside a jump it is the largest sample: a step contains one if it begins before an event and ends behind it.
    """
    wave = np.cos(np.outer(np.arange(_SAMPLES), _ANGLES)) * 2.0 / _SAMPLES
    wave[0] /= 2.0
    c = jnp.sum(jnp.asarray(wave, x.dtype) * x[None, :], axis=1)
    fixed, still = jax.lax.stop_gradient(x), jax.lax.stop_gradient(c)
    jumps = jnp.sum(jnp.abs(still[-4:])) > _JUMP * (jnp.max(fixed) - jnp.min(fixed))
    k, last = np.arange(_SAMPLES), len(_GRID) - 1
    grid = jnp.asarray(np.cos(np.outer(_GRID, k)), x.dtype)
    at = jnp.argmax(jnp.abs(jnp.sum(grid * still[None, :], axis=1)))
    spacing = np.pi / last
    angle = begun = jnp.asarray(at * spacing, x.dtype)
    for _ in range(2):  # Newton steps to the stationary point; in the angle both ends of the step are such points
        slope, bend = jnp.sum(k * jnp.sin(k * angle) * still), jnp.sum(k**2 * jnp.cos(k * angle) * still)
        newton = angle - jnp.where(bend == 0, 0.0, slope / jnp.where(bend == 0, 1.0, bend))
        angle = jnp.clip(newton, begun - spacing, begun + spacing)
    top = jnp.abs(jnp.sum(jnp.cos(k * angle) * c))
    return jnp.where(jumps, jnp.abs(x[jnp.argmax(jnp.abs(fixed))]), top), ~jumps & (at > 0) & (at < last)
