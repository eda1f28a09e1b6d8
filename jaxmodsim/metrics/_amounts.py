"""Metrics that are amounts: peaks, final values, dissipated energy."""

from jaxtyping import Array

from ..simulation import Trajectory, named_series, named_unit, peak_of
from ._metric import Metric


def peak(of: str) -> Metric:
    """Largest magnitude of a coordinate, velocity or force in a run.

    The peak is taken from t0 to the end, between saved times too, which needs two more runs of the scene. The first run
    finds the eight steps with the largest candidates. The second interpolates each of these through 16 samples.
    In a scene with events the values just before and after each event count too, from the run of `run.events`.

    The error is that of the dense output where the series is smooth within a step. If more than eight peaks differ by
    less than about 1e-3 of the amplitude, the result may be any of them. Derivatives are taken at the fixed time of a
    smooth peak, where the series is stationary, along the event of a corner, or at the end of the run if the peak is
    there and the end is a saved time.

    **Arguments:**

    - `of`: `q[0]`, `qd[0]`, or the name of an effect for its force, with `[i]` for a component.

    **Returns:**

    A `Metric`, in the unit of the series: N or N m, m or rad, m/s or rad/s.

    **Raises:**

    - `ValueError` when called, for an unknown name.

    **Example:**

    ```python
    scene = jms.problems.belt_oscillator.scene()
    run = jms.simulate(scene, [0.0], [0.0], 3.0, ts=jnp.linspace(0.0, 3.0, 301))
    print(f"{jms.metrics.peak('qd[0]')(run):.4f} m/s")
    ```

    ```text
    0.3162 m/s
    ```
    """
    return Metric(f"peak |{of}|", named_unit(of), peak_of, (of,))


def final(of: str) -> Metric:
    """Value of a coordinate, velocity or force at the last saved time of a run.

    **Arguments:**

    - `of`: `q[0]`, `qd[0]`, or the name of an effect for its force, with `[i]` for a component.

    **Returns:**

    A `Metric`, in the unit of the series: N or N m, m or rad, m/s or rad/s.

    **Raises:**

    - `ValueError` when called, for an unknown name.

    **Example:**

    ```python
    scene = jms.problems.belt_oscillator.scene()
    run = jms.simulate(scene, [0.0], [0.0], 3.0, ts=jnp.linspace(0.0, 3.0, 301))
    print(f"{jms.metrics.final('q[0]')(run):.4f} m")
    ```

    ```text
    0.0366 m
    ```
    """
    return Metric(f"final {of}", named_unit(of), _final, (of,))


def _final(run: Trajectory, of: str) -> Array:
    return named_series(run, of)[-1]


def dissipated(effect: str | None = None) -> Metric:
    """Energy [J] dissipated from t0 to the last saved time; see `Trajectory.energy`.

    Needs one more run of the scene, with its work integrals, unless the run recorded its energy.

    **Arguments:**

    - `effect`: name of a dissipative effect; None for the sum of all, and of the losses in impacts.

    **Returns:**

    A `Metric` in J.

    **Raises:**

    - `ValueError` when called, for an unknown or conservative effect.

    **Example:**

    ```python
    scene = jms.problems.belt_oscillator.scene()
    run = jms.simulate(scene, [0.0], [0.0], 3.0, ts=jnp.linspace(0.0, 3.0, 301))
    print(f"{jms.metrics.dissipated('friction')(run):.4f} J, all effects {jms.metrics.dissipated()(run):.4f} J")
    ```

    ```text
    1.3169 J, all effects 1.3169 J
    ```
    """
    return Metric("dissipated" if effect is None else f"dissipated in {effect}", "J", _dissipated, (effect,))


def _dissipated(run: Trajectory, effect: str | None) -> Array:
    if effect is None:
        return run.energy.dissipated[-1]
    lost = run.ledger.dissipated
    if effect not in lost:
        raise ValueError(f"{effect!r} dissipates no energy; dissipative effects are: {', '.join(lost) or 'none'}.")
    return lost[effect][-1]
