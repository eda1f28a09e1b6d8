"""Compensation of friction: on a planned motion, or by an observer of the bristle on the measured one."""

import math
from collections.abc import Mapping
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, PyTree

from .._core.arrays import PerDof, Scalar
from .._core.safe import decay_mean
from ..friction import LuGre, Passivity
from ..scene import Friction, Scene, State, compensating_force


def compensate_friction(
    scene: Scene,
    t0: Scalar,
    t1: Scalar,
    y: State,
    *,
    error: PerDof | None = None,
    gain: ArrayLike = 0.0,
    share: ArrayLike = 1.0,
) -> tuple[PerDof, dict[str, PyTree]]:
    """Force that compensates friction in a cycle of a controller, and the states of the laws at its end.

    With the planned coordinates and velocities in `y` it is a feedforward: the law follows the planned slip, so that at
    a start the force grows over the break-away distance of the bristle to the break-away force, and it never chatters.
    With the measured ones and a tracking `error` it is the observer of Canudas de Wit and others,
    `z' = v - sigma0 |v| z/g(v) - k e`: in stick the force grows with the error until the joint breaks away. Its
    deflection is limited to `Fs/sigma0`, which holds for the true one, so that the limit never increases the error of
    the observer, and the force never exceeds break-away. `check_observer` checks the gains.

    A `share` above 1, or a law with more friction than there is, over-compensates: see `check_observer`.

    **Arguments:**

    - `scene`: the fitted `Scene`; set-valued laws need the wrapper `Regularized`.
    - `t0`, `t1`: begin and end of the cycle [s].
    - `y`: coordinates and velocities, planned or measured, and the states of the laws after the cycle before.
    - `error`: measured minus planned coordinates, shape `[dof]`; None for the feedforward.
    - `gain`: the observer's gain k [1/s], >= 0.
    - `share`: factor of the force.

    **Returns:**

    Generalised force [N or N m], shape `[dof]`, to add to that of the controller; and the states by name.

    **Raises:**

    - `ValueError` for an `error` in a scene with other friction than `LuGre` along scalar displacements.

    **Example:**

    ```python
    scene = jms.problems.ramped_box.scene(jms.problems.ramped_box.lugre())
    z = scene.initial_state(jnp.zeros(1))
    for _ in range(20):  # plan: 0.1 m/s
        y = jms.scene.State(jnp.zeros(1), jnp.array([0.1]), z)
        force, z = jms.control.compensate_friction(scene, jnp.array(0.0), jnp.array(0.01), y)
    print(f"{force[0]:.3f} N")
    ```

    ```text
    1.704 N
    ```

    ??? cite "Reference"

        ```bibtex
        @article{canudas1995new,
            author={Canudas de Wit, C. and Olsson, H. and Astrom, K. J. and Lischinsky, P.},
            title={A new model for control of systems with friction},
            journal={IEEE Transactions on Automatic Control},
            volume={40}, number={3}, pages={419--425}, year={1995},
        }
        ```
    """
    scene = scene.bind_state(t0, y.q, y.qd)
    if error is None:
        force, after = compensating_force(scene, t0, t1, y)
        return jnp.asarray(share) * force, after
    for name, effect in scene.friction.items():
        if not isinstance(effect.law, LuGre) or jnp.ndim(effect.slip(t0, y.q, y.qd, scene.params)):
            raise ValueError(
                f"compensate_friction: an observer needs LuGre along a scalar displacement, but friction {name!r} is"
                f" {type(effect.law).__name__}. Leave `error` out, and write the planned motion to y."
            )

    def observe(effect: Friction, v: Array, z: PyTree, h: Scalar, load: Scalar | None) -> tuple[Array, PyTree]:
        """The equation is linear in z: the correction acts like a slip at the rate -k e."""
        law: Any = effect.law
        slip_error = jnp.sum(effect.direction(y.q, scene.params) * error)
        most, rate = law.Fs / law.sigma0, law.sigma0 * jnp.abs(v) / law.stribeck_curve(v)
        push = -jnp.asarray(gain) * slip_error * decay_mean(rate * h) * h
        moved = jnp.clip(law.step_exact(v, z, h) + push, -most, most)
        force = law.force_given_zdot(v, moved, (moved - z) / h)
        return (force if load is None else load * force), moved

    force, after = compensating_force(scene, t0, t1, y, observe)
    return jnp.asarray(share) * force, after


def check_observer(law: LuGre, m: float, kp: float, kd: float, ki: float = 0.0, *, level: float = 1.0) -> Passivity:
    """Whether a LuGre observer and a PID controller are stable together, by passivity.

    The observer's error is a passive feedback around `G(s) = (sigma1 s + sigma0) s/(m s^3 + kd s^2 + kp s + ki)`, from
    the error of the estimated deflection to the tracking error (Canudas de Wit and others, 1995, theorem 1, where G
    must be strictly positive real). G is positive real if and only if `sigma1 kd >= m sigma0`, `sigma0 kp >= sigma1 ki`
    and `kd kp > m ki`. The observer then converges for any gain k > 0; with an integral only while the joint moves,
    since G(0) = 0.

    A compensator that assumes more friction than there is adds energy: `level` above 1 leaves the force
    `(1 - level) F(v)`, a negative damping at low speed, which no gain outweighs at rest. The condition names it.

    **Arguments:**

    - `law`: the law of the observer.
    - `m`: mass [kg] or inertia [kg m^2], > 0.
    - `kp`, `kd`, `ki`: gains of the controller [N/m, N s/m, N/(m s)], >= 0.
    - `level`: assumed friction over actual friction, times the share that is compensated.

    **Returns:**

    A `Passivity`: `margin` is the `kd` [N s/m] that could be removed, -inf if no `kd` helps; `speed` is infinite.

    **Raises:**

    - `ValueError` for gains or a mass out of range.

    **Example:**

    ```python
    law = jms.LuGre(sigma0=2000.0, sigma1=60.0, sigma2=1.0, Fc=0.7, Fs=2.8, vs=0.1)
    print(jms.control.check_observer(law, m=0.4, kp=300.0, kd=15.0, ki=200.0).ok)
    ```

    ```text
    True
    ```
    """
    given: Mapping[str, float] = {"kp": kp, "kd": kd, "ki": ki, "level": level}
    for name, value in given.items():
        if not 0 <= value < math.inf:
            raise ValueError(f"check_observer: {name} must be finite and >= 0, but {value} was given.")
    if not 0 < m < math.inf:
        raise ValueError(f"check_observer: m must be finite and > 0, but {m} was given.")
    s0, s1 = float(law.sigma0), float(law.sigma1)
    least = m * s0 / s1 if s1 > 0 else math.inf
    integral = s0 * kp >= s1 * ki and (ki == 0 or kd * kp > m * ki)
    over = level > 1.0
    condition = (
        f"The observer and the controller are passive if sigma1 kd >= m sigma0 (kd {kd:g} against {least:g} N s/m),"
        f" sigma0 kp >= sigma1 ki ({s0 * kp:g} against {s1 * ki:g}) and kd kp > m ki ({kd * kp:g} against {m * ki:g})."
    )
    if over:
        condition += f" Over-compensation: {level:g} of the friction is compensated, and the rest drives the motion."
    ok = bool(kd >= least and integral and not over and kp > 0)
    # Damping does not outweigh too much compensation, an integral that is too strong, or no proportional gain.
    lost = over or kp == 0 or s0 * kp < s1 * ki
    return Passivity(ok, -math.inf if lost else float(kd - least), math.inf if ok else 0.0, condition)
