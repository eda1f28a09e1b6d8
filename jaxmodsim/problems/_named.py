"""Runs of the reference problems by name, on which solvers can be tried."""

from collections.abc import Callable
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike, Float, PyTree

from ..friction import Coulomb
from ..scene import Scene
from . import (
    belt_oscillator,
    braked_spring,
    bristles,
    cart_pole,
    cartesian_pendulum,
    charged_particle,
    coupled_belts,
    four_bar,
    knife_edge,
    n_link_pendulum,
    ramped_box,
    spherical_pendulum,
    stick_slip_pendulum,
    turntable_puck,
)


@dataclass(frozen=True, eq=False)
class NamedProblem:
    """A run of a named problem.

    - `name`: as in `named_problems`.
    - `scene`: the `Scene`.
    - `q0`, `qd0`: coordinates and velocities at t = 0, shape `[dof]`.
    - `t1`: end time [s].
    - `observable`: the quantity of interest at t1: `q[0]`, `qd[0]`, or the name of an effect for its force.
    - `exact`: its value by a closed form, in the precision of JAX, or None.
    - `max_steps`: sufficient number of steps at a relative tolerance of 1e-10.
    """

    name: str
    scene: Scene
    q0: Float[np.ndarray, " dof"]
    qd0: Float[np.ndarray, " dof"]
    t1: float
    observable: str
    exact: float | None = None
    max_steps: int = 16384

    @property
    def arguments(self) -> dict[str, PyTree]:
        """Keyword arguments of `jaxmodsim.work_precision`."""
        start = {"scene": self.scene, "q0": self.q0, "qd0": self.qd0, "t1": self.t1}
        return {**start, "observable": self.observable, "reference": self.exact, "name": self.name}


def named_problems() -> dict[str, Callable[[], NamedProblem]]:
    """Functions that build each `NamedProblem`, by name.

    - Set-valued friction with a closed form: `coulomb_box`, `braked_spring`, `belt_oscillator`, `stick_slip_pendulum`.
    - Set-valued friction: `stribeck_belt`, `coupled_belts`, `cart_pole`, `turntable_puck` (in the plane).
    - Bristles: `lugre_box`, `pulled_box` (stiff), `slipping_bristle` (closed form).
    - Smooth: `spherical_pendulum` and `charged_particle` (closed forms), `double_pendulum`.
    - Constraints: `cartesian_spherical_pendulum` and `knife_edge` (closed forms), `four_bar`.

    **Returns:**

    A new dictionary; each function takes no arguments.

    **Example:**

    ```python
    case = jms.problems.named_problems()["charged_particle"]()
    run = jms.simulate(case.scene, case.q0, case.qd0, case.t1, max_steps=case.max_steps)
    print(abs(jms.simulation.named_series(run, case.observable)[-1] - case.exact) < 1e-4)
    ```

    ```text
    True
    ```
    """
    return dict(_CASES)


def _case(
    name: str,
    scene: Scene,
    q0: ArrayLike | list[float],
    qd0: ArrayLike | list[float],
    t1: float,
    observable: str,
    exact: float | None = None,
    **more: int,
) -> NamedProblem:
    return NamedProblem(name, scene, np.asarray(q0, float), np.asarray(qd0, float), t1, observable, exact, **more)


def _coulomb_box() -> NamedProblem:
    # At rest until the force reaches Fc = 1.5 N at t = 1.5 s, then v = (t - 1.5)^2/(2 m) under a ramp of 1 N/s.
    exact = (10.0 - 1.5) ** 2 / 4.0
    return _case("coulomb_box", ramped_box.scene(ramped_box.coulomb()), [0.0], [0.0], 10.0, "qd[0]", exact)


def _lugre_box() -> NamedProblem:
    return _case("lugre_box", ramped_box.scene(ramped_box.lugre()), [0.0], [0.0], 10.0, "qd[0]")


def _pulled_box() -> NamedProblem:
    return _case("pulled_box", bristles.pulled_box(), [0.0], [0.0], 20.0, "q[0]", max_steps=200_000)


def _slipping_bristle() -> NamedProblem:
    law, v, t1 = ramped_box.lugre(), 0.1, 0.05
    force = law.sigma0 * bristles.deflection(jnp.asarray(t1), law, v) + law.sigma2 * v
    return _case("slipping_bristle", bristles.slipping_bristle(law, v), [0.0], [0.0], t1, "friction", float(force))


def _braked_spring() -> NamedProblem:
    t1, x0 = 20.0, braked_spring.PARAMS["x0"]
    exact = float(braked_spring.motion(jnp.asarray(t1), **braked_spring.PARAMS)[0])
    return _case("braked_spring", braked_spring.scene(braked_spring.coulomb()), [x0], [0.0], t1, "q[0]", exact)


def _belt_oscillator() -> NamedProblem:
    t1 = 5.0
    exact = float(belt_oscillator.motion(jnp.asarray(t1), **belt_oscillator.PARAMS)[0])
    return _case("belt_oscillator", belt_oscillator.scene(), [0.0], [belt_oscillator.PARAMS["belt"]], t1, "q[0]", exact)


def _stribeck_belt() -> NamedProblem:
    scene = belt_oscillator.scene(belt_oscillator.stribeck())
    return _case("stribeck_belt", scene, [0.0], [belt_oscillator.PARAMS["belt"]], 5.0, "q[0]")


def _coupled_belts() -> NamedProblem:
    belt = coupled_belts.PARAMS["belt"]
    return _case("coupled_belts", coupled_belts.scene(), [0.0, 0.0], [belt, belt], 4.0, "q[0]")


def _stick_slip_pendulum() -> NamedProblem:
    """The exact angle is that of the first turning point at which the weight cannot overcome friction."""
    p, start = stick_slip_pendulum.PARAMS, 1.2
    angle, numbers = start, {name: p[name] for name in ("m", "l", "g", "Fc")}
    while p["m"] * p["g"] * p["l"] * abs(np.sin(angle)) > p["Fs"]:
        angle = float(stick_slip_pendulum.turn(angle, **numbers))
    return _case("stick_slip_pendulum", stick_slip_pendulum.scene(), [start], [0.0], 10.0, "q[0]", angle)


def _cart_pole() -> NamedProblem:
    return _case("cart_pole", cart_pole.scene(Coulomb(Fc=0.3, Fs=0.4)), [0.0, 2.0], [0.0, 0.0], 3.0, "q[1]")


def _turntable_puck() -> NamedProblem:
    mu, r0 = turntable_puck.PARAMS["mu"], turntable_puck.PARAMS["r0"]
    scene = turntable_puck.scene(Coulomb(mu, 1.3 * mu))
    return _case("turntable_puck", scene, [r0, 0.0], [0.0, 0.0], 4.0, "q[1]")


def _spherical_pendulum() -> NamedProblem:
    phi, turn, t1 = 1.8, 2.0, 5.0
    exact = float(spherical_pendulum.motion(t1, phi, turn))
    return _case("spherical_pendulum", spherical_pendulum.scene(), [phi, 0.0], [0.0, turn], t1, "q[0]", exact)


def _cartesian_spherical_pendulum() -> NamedProblem:
    """The spherical pendulum in Cartesian coordinates, with a constraint."""
    phi, turn, t1 = 1.8, 2.0, 5.0
    q0, qd0 = [np.sin(phi), 0.0, np.cos(phi)], [0.0, turn * np.sin(phi), 0.0]
    exact = float(np.cos(spherical_pendulum.motion(t1, phi, turn)))
    scene = cartesian_pendulum.cartesian_spherical_pendulum()
    return _case("cartesian_spherical_pendulum", scene, q0, qd0, t1, "q[2]", exact)


def _double_pendulum() -> NamedProblem:
    return _case("double_pendulum", n_link_pendulum.double_pendulum(), [2.0, 1.5], [0.0, 0.0], 3.0, "q[1]")


def _charged_particle() -> NamedProblem:
    q0, qd0, t1 = [0.3, -0.8, 0.5], [1.2, 0.4, -0.7], 10.0
    motion = charged_particle.motion(jnp.asarray(t1), jnp.asarray(q0), jnp.asarray(qd0), **charged_particle.PARAMS)
    scene = charged_particle.scene(E=charged_particle.PARAMS["E"])
    return _case("charged_particle", scene, q0, qd0, t1, "q[0]", float(motion[0][0]))


def _knife_edge() -> NamedProblem:
    turn, speed, t1 = 1.7, 0.9, 6.0
    exact = float(knife_edge.motion(jnp.asarray(t1), turn=turn, speed=speed)[0][1])
    return _case("knife_edge", knife_edge.scene(), [0.0, 0.0, 0.0], [speed, 0.0, turn], t1, "q[1]", exact)


def _four_bar() -> NamedProblem:
    q0, qd0 = four_bar.state(0.7, 8.0)
    return _case("four_bar", four_bar.scene(), q0, qd0, 2.0, "q[2]")


_CASES: dict[str, Callable[[], NamedProblem]] = {
    case.__name__.removeprefix("_"): case for case in (
        _lugre_box, _pulled_box, _slipping_bristle, _coulomb_box, _braked_spring, _belt_oscillator, _stribeck_belt,
        _coupled_belts, _stick_slip_pendulum, _cart_pole, _turntable_puck, _spherical_pendulum,
        _cartesian_spherical_pendulum, _double_pendulum, _charged_particle, _knife_edge, _four_bar,
    )
}  # fmt: skip
