"""How large something is in a run."""

import jax.numpy as jnp
from jaxtyping import Array

from ..simulation import Trajectory
from ._feature import Feature
from ._names import series, unit_of


def peak(of: str) -> Feature:
    """Largest magnitude of a coordinate, velocity or force at the saved times `ts` of a run.

    ```python
    features.peak("friction")(run), features.peak("qd[0]")(run)
    ```

    **Arguments:**

    - `of`: `q[0]`, `qd[0]`, or the name of an effect for its force, with `[i]` for a component.

    **Raises:**

    - `ValueError` when called, if the run has nothing of that name.
    """
    return Feature(f"peak |{of}|", unit_of(of), _peak, (of,))


def _peak(run: Trajectory, of: str) -> Array:
    return jnp.max(jnp.where(jnp.isfinite(run.t), jnp.abs(series(run, of)), 0.0))


def final(of: str) -> Feature:
    """Value of a coordinate, velocity or force at the last saved time of a run.

    ```python
    features.final("q[0]")(run)
    ```

    **Arguments:**

    - `of`: `q[0]`, `qd[0]`, or the name of an effect for its force, with `[i]` for a component.

    **Raises:**

    - `ValueError` when called, if the run has nothing of that name.
    """
    return Feature(f"final {of}", unit_of(of), _final, (of,))


def _final(run: Trajectory, of: str) -> Array:
    return series(run, of)[-1]


def dissipated(effect: str | None = None) -> Feature:
    """Energy [J] lost in friction from t0 to the last saved time; see `Trajectory.energy`.

    Runs the scene once more, with the work integrals beside it.

    ```python
    features.dissipated("friction")(run), features.dissipated()(run)
    ```

    **Arguments:**

    - `effect`: name of an effect that loses energy; None for all of them together.

    **Raises:**

    - `ValueError` when called, if the run has no such effect.
    """
    return Feature("dissipated" if effect is None else f"dissipated in {effect}", "J", _dissipated, (effect,))


def _dissipated(run: Trajectory, effect: str | None) -> Array:
    lost = run.ledger.dissipated
    if effect is None:
        return sum((each[-1] for each in lost.values()), jnp.zeros_like(run.t[-1]))
    if effect not in lost:
        raise ValueError(f"No energy is lost in {effect!r}; effects that lose some are: {', '.join(lost) or 'none'}.")
    return lost[effect][-1]
