"""How large something is in a run."""

import jax.numpy as jnp
from jaxtyping import Array

from ..simulation import Trajectory, named_series, named_unit, peak_of
from ._metric import Metric


def peak(of: str) -> Metric:
    """Largest magnitude of a coordinate, velocity or force in a run.

    From t0 to the end, whatever the saved times: the scene is run twice more. The first run finds the eight steps in
    which the series may be largest, the second one samples each of them at 16 times, with a parabola between these; and
    in a scene with events the series counts just before and after each of them, which takes the run of `run.events`.

    The error is that of the run's own dense output, plus up to 1e-6 of the peak where a step is a radian of the fastest
    motion. Among more than eight peaks that differ by less than the estimates within a step, about 1e-3 of the
    amplitude, any one may be taken. Derivatives are those at the fixed time of a smooth peak, where the series is
    stationary, and those along the event of a corner; by the ends of the run they are not taken.

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
    return peak_of(run, of)


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

    Runs the scene once more, with the work integrals beside it, unless the run recorded its energy.

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
