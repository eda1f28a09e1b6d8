"""Arguments without a physical meaning are refused by name, and those with one are not."""

import math
import re
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxmodsim as jms
from jaxmodsim.friction import lorentzian

COULOMB = jms.Coulomb(0.5)


def across(q: Any) -> Any:
    return q[0]


def place(q: Any) -> Any:
    return jnp.stack([q[0], 0.0 * q[0], 0.0 * q[0]])


def energy(t: Any, q: Any, qd: Any, p: Any) -> Any:
    del t, q, p
    return 0.5 * qd[0] ** 2


REFUSED: dict[str, tuple[Callable[[], object], str]] = {
    "load": (
        lambda: jms.Friction(COULOMB, normal_force=-5.0),
        "Friction: normal_force must be finite and >= 0 [N], but -5.0",
    ),
    "load of nan": (lambda: jms.Friction(COULOMB, normal_force=math.nan), "normal_force must be finite"),
    "belt": (lambda: jms.Friction(COULOMB, belt_velocity=math.inf), "belt_velocity must be a finite number"),
    "ends exchanged": (
        lambda: jms.end_stops(across, lower=1.0, upper=0.0),
        "end_stops needs lower < upper [m or rad], but lower=1 and upper=0 were given: swap them",
    ),
    "ends equal": (lambda: jms.end_stops(across, lower=1, upper=1.0), "end_stops needs lower < upper"),
    "end of infinity": (lambda: jms.end_stops(across, upper=math.inf), "end_stops upper must be a finite number"),
    "two ends": (lambda: jms.end_stops(across, lower=np.zeros(2)), "end_stops lower has shape (2,)"),
    "stop without a name": (lambda: jms.end_stops(across, lower=0.0, name=""), "end_stops name must be a text"),
    "play": (lambda: jms.backlash(across, -1e-3), "backlash width must be finite and > 0 [m or rad], but -0.001"),
    "no play": (lambda: jms.backlash(across, 0.0), "backlash width must be finite and > 0"),
    "mass": (lambda: jms.point_mass(-1.0, place), "point_mass m must be finite and > 0 [kg], but -1.0"),
    "no mass": (lambda: jms.rigid_body(0, 1.0, place, across), "rigid_body m must be finite and > 0 [kg]"),
    "masses": (lambda: jms.point_mass(np.ones(2), place), "point_mass m has shape (2,)"),
    "gravity": (lambda: jms.point_mass(1.0, place, math.nan), "point_mass gravity must be a finite number"),
    "inertia": (
        lambda: jms.rigid_body(1.0, -0.1, place, across),
        "rigid_body inertia must have moments >= 0 [kg m^2], but they are -0.1",
    ),
    "principal inertia": (lambda: jms.rigid_body(1.0, np.array([1.0, -2.0, 1.0]), place, across), "[1.0, -2.0, 1.0]"),
    "tensor": (lambda: jms.rigid_body(1.0, np.diag([1.0, 1.0, -2.0]), place, across), "moments >= 0"),
    "skew tensor": (
        lambda: jms.rigid_body(1.0, np.eye(3) + np.eye(3, k=1), place, across),
        "rigid_body inertia must be symmetric",
    ),
    "torque": (lambda: jms.Geared(COULOMB, 0.1, math.nan), "Geared torque must be a finite number"),
    "number of nothing": (lambda: jms.Scene(energy, params={"m": None}), "params['m'] is None, but a real number"),
    "numbers of nothing": (lambda: jms.Scene(energy, params={"a": [1.0, None]}), "params['a'][1] is None"),
    "unit": (
        lambda: jms.Scene(energy, coordinates=("x [furlong]",)),
        "The coordinate 'x [furlong]' has the unit 'furlong', where 'furlong' is not known. Units are products,",
    ),
    "unit in full": (
        lambda: jms.Scene(energy, coordinates=("x [meters/s]",)),
        "'meters' is not known. Did you mean 'm'?",
    ),
    "unit in capitals": (lambda: jms.Scene(energy, coordinates=("x [KG m]",)), "'KG' is not known. Did you mean 'kg'?"),
    "fall": (lambda: jms.Stribeck(1.0, 2.0, 0.1, fall=jnp.sinh), "fall(0) must be 1, so that slip begins at Fs"),
}


@pytest.mark.quick
@pytest.mark.parametrize("case", REFUSED)
def test_refused(case: str) -> None:
    make, words = REFUSED[case]
    with pytest.raises(ValueError, match=re.escape(words)):
        make()


@pytest.mark.quick
def test_admissible() -> None:
    jms.Friction(COULOMB, normal_force=0.0, belt_velocity=-1.0)
    jms.end_stops(across, lower=-1.0, upper=0.0)
    jms.end_stops(across, lower=lambda p: p["a"], upper=0.0)
    jms.backlash(across, lambda p: p["play"])
    jms.point_mass(1.0, place, -9.81)
    jms.rigid_body(1.0, np.array([0.0, 1.0, 1.0]), place, across)
    jms.rigid_body(1.0, np.diag([0.0, 1.0, 1.0]), place, across)
    jms.Stribeck(1.0, 2.0, 0.1, fall=lorentzian)
    for unit in ("mm", "N m/rad", "m^2", "m2", "µm", "°", "m·s", "1/m", "-"):
        jms.Scene(energy, coordinates=(f"x [{unit}]",))
    jms.Scene(energy, params={"law": jms.LuGre(1e5, 1.0, 1.0, 1.0, 1.0, 0.1), "list": [1.0, 2.0]})
    jax.jit(lambda x: jms.end_stops(across, lower=x, upper=-x)[0].gap.limit.amount)(1.0)  # pyright: ignore


def slides(load: Any, throw: bool = True, **params: float) -> jms.Trajectory:
    scene = jms.Scene(energy, params=params, effects=(jms.Friction(COULOMB, normal_force=load),))
    return jms.simulate(scene, [0.0], [1.0], 1.0, throw=throw)


def test_a_load_that_is_a_parameter() -> None:
    def weight(t: Any, q: Any, qd: Any, p: Any) -> Any:
        del t, q, qd
        return 9.81 * p["m"]

    with pytest.raises(jms.SimulationError, match=r"'friction': normal_force depends on params alone.*>= 0"):
        slides(weight, m=-1.0)
    assert abs(float(slides(weight, m=0.1).qd[-1, 0]) - (1.0 - 0.5 * 0.981)) < 1e-6
    # Of a batch only those out of range end.
    codes = jax.vmap(lambda m: slides(weight, throw=False, m=m).result.code)(jnp.array([-1.0, 0.0, 1.0]))
    assert [bool(code) for code in codes] == [True, False, False]


def test_a_traced_load() -> None:
    codes = jax.vmap(lambda n: slides(n, throw=False).result.code)(jnp.array([-1.0, 0.0, 1.0]))
    assert [bool(code) for code in codes] == [True, False, False]


def test_lift_off_gives_no_friction() -> None:
    """The load 0.5 sin(2 pi t) is positive in the first half of the run: its impulse there is 0.5/pi."""
    run = slides(lambda t, q, qd, p: 0.5 * jnp.sin(2.0 * jnp.pi * t))
    assert abs(float(run.qd[-1, 0]) - (1.0 - 0.5 * 0.5 / np.pi)) < 1e-6


def test_a_signal_as_load_may_be_negative() -> None:
    signal = jms.Signal([0.0, 0.5], [-1.0, 1.0])
    scene = jms.Scene(
        energy, params={"N": signal}, effects=(jms.Friction(COULOMB, normal_force=lambda t, q, qd, p: p["N"]),)
    )
    run = jms.simulate(scene, [0.0], [1.0], 1.0)
    assert abs(float(run.qd[-1, 0]) - 0.75) < 1e-6


def by_name(q: Any, p: Any) -> Any:
    return p["r"] * q[0]


@pytest.mark.parametrize("law", [COULOMB, jms.Viscous(1.0)], ids=["events", "smooth"])
@pytest.mark.parametrize("params", [[1.0], 1.0, np.ones(2)], ids=["list", "number", "array"])
def test_params_that_are_no_mapping(law: Any, params: Any) -> None:
    scene = jms.Scene(
        jms.point_mass(1.0, lambda q: jnp.stack([q[0], q[1], 0.0 * q[0]])), params, (jms.Friction(law, by_name),)
    )
    with pytest.raises(ValueError, match=r"along of Friction 'friction' reads params by name.*`return p\[\"r\"\]"):
        jms.simulate(scene, [0.0, 0.0], [1.0, 0.0], 1.0)


@pytest.mark.parametrize("mass", [[1.0], {"a": 1.0}], ids=["list", "mapping"])
def test_a_number_that_is_a_list(mass: Any) -> None:
    scene = jms.Scene(lambda t, q, qd, p: 0.5 * p["m"] * qd[0] ** 2, params={"m": mass})
    with pytest.raises(
        ValueError, match=r"The Lagrangian cannot compute with a list or a mapping, at .*: read its entries"
    ):
        jms.simulate(scene, [0.0], [1.0], 1.0)
