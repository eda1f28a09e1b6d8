"""A worm drive against the closed forms of its efficiency, its locking and its motion."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxmodsim as jms
from jaxmodsim.problems import worm_drive

# Friction angles below and above the lead angle of 0.12 rad.
SLIPPERY, ROUGH = 0.05, 0.15


def end(numbers: dict[str, Any], speed: float, t1: float = 0.05) -> Any:
    q, qd = worm_drive.state(speed)
    return jms.simulate(worm_drive.scene(**numbers), q, qd, t1, rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize("load", [8.0, -8.0])
def test_the_locked_drive_holds_to_rounding(load: float) -> None:
    least, most = worm_drive.holding_torques(load=load, mu=ROUGH)
    assert float(least) < 0.0 < float(most)
    for motor in (0.0, float(least) * (1.0 - 1e-9), float(most) * (1.0 - 1e-9)):
        run = end({"load": load, "mu": ROUGH, "motor": motor}, 0.0, 1.0)
        # To rounding of the two reactions, which balance torques of 8 N m on 1e-4 kg m^2.
        np.testing.assert_allclose(run.q, 0.0, atol=2e-12)
        np.testing.assert_allclose(run.qd, 0.0, atol=2e-12)
        assert run.mode["friction"][-1] == 0
    for motor, side in ((float(most) * (1.0 + 1e-9), 1), (float(least) * (1.0 + 1e-9), -1)):
        assert end({"load": load, "mu": ROUGH, "motor": motor}, 0.0).mode["friction"][-1] == side


def test_the_drive_is_self_locking_from_the_lead_angle_on() -> None:
    lead = worm_drive.PARAMS["lead"]
    for over in (1e-9, -1e-9):
        run = end({"mu": float(np.tan(lead * (1.0 + over)))}, 0.0)
        assert bool(run.mode["friction"][-1] == 0) == (over > 0)
    assert float(worm_drive.efficiency(lead, np.tan(lead * 1.01))[1]) == 0.0


@pytest.mark.parametrize(
    ("numbers", "speed"),
    [
        ({"motor": 0.9, "mu": ROUGH}, 0.0),  # lifts
        ({"mu": SLIPPERY}, 0.0),  # driven back from rest
        ({"motor": -0.5, "mu": ROUGH}, 0.0),  # pushed down
        ({"motor": 0.0, "mu": SLIPPERY}, -3.0),
        ({"motor": -0.9, "load": -8.0, "mu": ROUGH}, 0.0),  # lifts the other way, on the other side of the teeth
    ],
)
def test_the_driven_state_accelerates_as_the_closed_form(numbers: dict[str, float], speed: float) -> None:
    run, t1 = end(numbers, speed), 0.05
    direction = np.sign(float(run.qd[-1, 0]))
    rate = worm_drive.acceleration(direction, **numbers)
    np.testing.assert_allclose(run.qd[-1, 0], speed + rate * t1, rtol=1e-11)
    np.testing.assert_allclose(run.q[-1, 0], speed * t1 + 0.5 * rate * t1**2, rtol=1e-11)
    ratio = worm_drive.PARAMS["r1"] / worm_drive.PARAMS["r2"] * np.tan(worm_drive.PARAMS["lead"])
    np.testing.assert_allclose(run.qd[-1, 1], ratio * run.qd[-1, 0], rtol=1e-11)


def test_efficiency_in_steady_motion_to_rounding() -> None:
    load, p = 8.0, worm_drive.PARAMS
    ratio = p["r1"] / p["r2"] * np.tan(p["lead"])
    for mu, direction in ((SLIPPERY, 1.0), (SLIPPERY, -1.0), (ROUGH, 1.0)):
        motor = worm_drive.holding_torques(mu=mu)[1 if direction > 0 else 0]
        assert float(worm_drive.acceleration(direction, mu=mu, motor=motor)) == pytest.approx(0.0, abs=1e-10)
        efficiency = worm_drive.efficiency(p["lead"], mu)[0 if direction > 0 else 1]
        share = load * ratio / motor if direction > 0 else motor / (load * ratio)
        assert float(share) == pytest.approx(float(efficiency), abs=1e-12)
        # The same drive, of one coordinate, with coefficients per transmitted torque.
        drive, back = worm_drive.efficiency(p["lead"], mu)
        gear = jms.Geared(jms.Coulomb(0.0), 1.0 / float(drive) - 1.0, load * ratio, 1.0 - float(back))
        force = direction * gear.sliding_force(jnp.array(direction))
        assert float(force) == pytest.approx(float(motor) - load * ratio, abs=1e-12)


def test_jamming_raises_an_error_that_names_it() -> None:
    # A heavy wheel on a light worm: J1/r1^2 < (J2/r2^2) tan(lead) tan(phi - lead).
    with pytest.raises(jms.SimulationError, match="jamming"):
        end({"mu": 0.6, "J1": 1e-6, "J2": 1.0}, -3.0)


def test_gradients_equal_those_of_the_closed_form() -> None:
    names = ("J1", "J2", "lead", "mu", "motor", "load")
    numbers = {name: jnp.array(worm_drive.PARAMS[name]) for name in names} | {"motor": jnp.array(0.9)}

    def simulated(numbers: dict[str, Any]) -> Any:
        q, qd = worm_drive.state(0.0, lead=numbers["lead"])
        return jms.simulate(worm_drive.scene(**numbers), q, qd, 0.05, rtol=1e-10, atol=1e-12).qd[-1, 0]

    slopes = jax.jit(jax.grad(simulated))(numbers)
    exact = jax.jit(jax.grad(lambda numbers: 0.05 * worm_drive.acceleration(1.0, **numbers)))(numbers)
    for name in names:
        assert float(slopes[name]) == pytest.approx(float(exact[name]), rel=1e-8), name
