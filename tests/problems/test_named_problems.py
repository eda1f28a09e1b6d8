"""The registry of named problems: each runs, and ends where its closed form says."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxmodsim import problems, simulate
from jaxmodsim.problems import named_problems
from jaxmodsim.simulation import named_series

NAMES = sorted(named_problems())
# The names with a closed form, so that none loses it unnoticed.
EXACT = {
    "belt_oscillator", "braked_spring", "cartesian_spherical_pendulum", "charged_particle", "coulomb_box", "knife_edge",
    "slipping_bristle", "spherical_pendulum", "stick_slip_pendulum",
}  # fmt: skip


@pytest.mark.parametrize("name", NAMES)
def test_runs_end_at_the_closed_form(name: str) -> None:
    case = named_problems()[name]()
    assert case.name == name
    run = simulate(case.scene, case.q0, case.qd0, case.t1, rtol=1e-10, atol=1e-12, max_steps=case.max_steps)
    value = float(named_series(run, case.observable)[-1])
    assert np.isfinite(value)
    assert (case.exact is not None) == (name in EXACT)
    if case.exact is not None:
        np.testing.assert_allclose(value, case.exact, atol=1e-8)


def test_cases_are_new_and_the_registry_is_a_copy() -> None:
    named_problems().clear()
    assert len(named_problems()) >= 12


def test_motion_of_the_belt_oscillator() -> None:
    """Continuous at the events of its cycle, and at their times in the places that the cycle says."""
    numbers = problems.belt_oscillator.PARAMS
    cycle, first = problems.belt_oscillator.cycle(**numbers), numbers["Fs"] / numbers["k"] / numbers["belt"]
    begins = first + float(cycle.period) * np.arange(3)
    ends = begins + float(cycle.slip)
    for times, place in ((begins, cycle.begins), (ends, cycle.ends)):
        for side in (-1e-9, 1e-9):
            q, qd = problems.belt_oscillator.motion(jnp.asarray(times + side), **numbers)
            np.testing.assert_allclose(q, place, atol=1e-9)
            np.testing.assert_allclose(qd, numbers["belt"], atol=1e-7)
    q, qd = problems.belt_oscillator.motion(jnp.linspace(first, ends[2], 4001), **numbers)
    np.testing.assert_allclose([q.min(), q.max()], [cycle.lowest, cycle.highest], atol=1e-6)


@pytest.mark.parametrize("turn", [2.0, 9.0])
def test_motion_of_the_spherical_pendulum(turn: float) -> None:
    """From its upper turning point and from its lower one: energy and angular momentum are kept."""
    t, phi, h = np.linspace(0.0, 4.0, 41), 1.8, 1e-5
    at, before, after = (problems.spherical_pendulum.motion(x, phi, turn) for x in (t, t - h, t + h))
    rate = (after - before) / (2.0 * h)
    momentum = np.sin(phi) ** 2 * turn
    energy = 0.5 * rate**2 + 0.5 * (momentum / np.sin(at)) ** 2 + 9.81 * np.cos(at)
    np.testing.assert_allclose(at[0], phi, atol=1e-12)
    np.testing.assert_allclose(energy, energy[0], atol=1e-7)
    assert (at.max() > phi + 0.1) == (turn < 3.0)
    assert (at.min() < phi - 0.1) == (turn > 3.0)
