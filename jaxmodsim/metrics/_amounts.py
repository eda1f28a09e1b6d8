"""How large something is in a run."""

import jax.numpy as jnp
from jaxtyping import Array

from ..simulation import Trajectory, named_series, named_unit
from ._metric import Metric


def peak(of: str) -> Metric:
    """Largest magnitude of a coordinate, velocity or force in a run.

    At the saved times `ts`; of a coordinate also where it turns between two of them, by a cubic, and of friction that
    runs by events also just before and after each of these, where it has its peaks.

    ```python
    metrics.peak("friction")(run), metrics.peak("qd[0]")(run)
    ```

    **Arguments:**

    - `of`: `q[0]`, `qd[0]`, or the name of an effect for its force, with `[i]` for a component.

    **Raises:**

    - `ValueError` when called, if the run has nothing of that name.
    """
    return Metric(f"peak |{of}|", named_unit(of), _peak, (of,))


def _peak(run: Trajectory, of: str) -> Array:
    x = named_series(run, of)
    peak = jnp.max(jnp.where(jnp.isfinite(run.t), jnp.abs(x), 0.0))
    if of in run.scene.event_driven:
        sides = jnp.abs(run.event_forces[of])
        return jnp.max(jnp.where(jnp.isnan(sides), 0.0, sides), initial=peak)
    if of.startswith("q[") and run.t.shape[0] > 1:
        return jnp.maximum(peak, jnp.max(jnp.abs(_turns(run.t, x, named_series(run, f"qd{of[1:]}")))))
    return peak


def _turns(t: Array, x: Array, v: Array) -> Array:
    """Where x turns between two samples by the cubic through both with their slopes `v`; else zero, `[time - 1]`."""
    turns = (v[:-1] * v[1:] < 0) & jnp.isfinite(t[1:])
    step = jnp.where(turns, t[1:] - t[:-1], 0.0)
    x0, x1, v0, v1 = (jnp.where(turns, each, 0.0) for each in (x[:-1], x[1:], v[:-1], v[1:]))
    s = v0 / jnp.where(turns, v0 - v1, 1.0)
    cubic = (1 - s) ** 2 * ((1 + 2 * s) * x0 + s * step * v0) + s**2 * ((3 - 2 * s) * x1 - (1 - s) * step * v1)
    return jnp.where(turns, cubic, 0.0)


def final(of: str) -> Metric:
    """Value of a coordinate, velocity or force at the last saved time of a run.

    ```python
    metrics.final("q[0]")(run)
    ```

    **Arguments:**

    - `of`: `q[0]`, `qd[0]`, or the name of an effect for its force, with `[i]` for a component.

    **Raises:**

    - `ValueError` when called, if the run has nothing of that name.
    """
    return Metric(f"final {of}", named_unit(of), _final, (of,))


def _final(run: Trajectory, of: str) -> Array:
    return named_series(run, of)[-1]


def dissipated(effect: str | None = None) -> Metric:
    """Energy [J] lost in friction from t0 to the last saved time; see `Trajectory.energy`.

    Runs the scene once more, with the work integrals beside it.

    ```python
    metrics.dissipated("friction")(run), metrics.dissipated()(run)
    ```

    **Arguments:**

    - `effect`: name of an effect that loses energy; None for all of them together.

    **Raises:**

    - `ValueError` when called, if the run has no such effect.
    """
    return Metric("dissipated" if effect is None else f"dissipated in {effect}", "J", _dissipated, (effect,))


def _dissipated(run: Trajectory, effect: str | None) -> Array:
    lost = run.ledger.dissipated
    if effect is None:
        return sum((each[-1] for each in lost.values()), jnp.zeros_like(run.t[-1]))
    if effect not in lost:
        raise ValueError(f"No energy is lost in {effect!r}; effects that lose some are: {', '.join(lost) or 'none'}.")
    return lost[effect][-1]
