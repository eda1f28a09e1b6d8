"""Public cases: references against published figures, our runs and derivatives against the references."""

import numpy as np
import pytest

from bench.conformance import gradients, impacts, peers, rotational, translational
from bench.conformance.case import same_order

CASES = {case.name: case for each in (rotational, translational, impacts, gradients) for case in each.CASES}
# Published at a tolerance of 1e-6: 2e-5 of the values, and more where a stop or a temperature adds up.
PUBLISHED = 1e-5
REFUSED = "Rotational.LossyGearDemo3"
QUICK = ("Translational.Brake", "Translational.ElastoGap", "Rotational.EddyCurrentBrake", "diff_sim_grads task1")
# At the stop of this case contact and friction open one after the other, nanoseconds apart.
LATER = {"Translational.Friction, stop2": 5e-9}


@pytest.mark.parametrize("name", [name for name, case in CASES.items() if case.published])
def test_a_reference_explains_the_published_figures(name):
    case = CASES[name]
    reference, published = case.exact(), np.array(case.published, float)
    np.testing.assert_allclose(reference.values, published, rtol=5e-4, atol=6e-5)
    # A mode change of the files is the first sample in the new mode. At rest, gear and bearing hold together.
    shared = [mode for mode in case.modes if mode[1] != "gear backward" or name.endswith("1")]
    late = same_order(shared, reference.events)
    assert late is not None
    assert late < PUBLISHED


@pytest.mark.parametrize("name", QUICK)
def test_values_and_events(name):
    check(name, derivatives=False)


@pytest.mark.parametrize("name", [name for name in CASES if name != REFUSED])
def test_values_events_and_derivatives(name):
    check(name, derivatives=True)


def check(name, *, derivatives):
    """Compare a run with its reference: values to 1e-10, events to 1e-10 s, derivatives to 1e-6."""
    case = CASES[name]
    exact, ours = case.exact(), case.ours(derivatives)
    np.testing.assert_allclose(ours.values, exact.values, rtol=1e-10, atol=1e-10)
    late = same_order(exact.events, ours.events)
    assert late is not None
    assert late < LATER.get(name, 1e-10)
    assert same_order(case.modes, ours.events) is not None
    if derivatives:
        slopes = case.exact_derivatives()
        np.testing.assert_allclose(ours.derivatives, slopes, rtol=1e-6, atol=1e-6 * np.max(np.abs(slopes)))


def test_a_gear_without_a_torque_in_its_mesh_is_refused_with_the_reason():
    with pytest.raises(RuntimeError, match="Friction under the reaction of 'mesh' has lost its unique solution"):
        CASES[REFUSED].ours(derivatives=False)


def test_the_optima_of_two_tasks():
    velocity, _ = gradients.target_velocity()
    np.testing.assert_allclose(velocity, gradients.exact_target_velocity(), rtol=1e-11)
    loss, _ = gradients.optimal_control()
    np.testing.assert_allclose(loss, gradients.least_loss(), rtol=1e-11)


def test_the_least_loss_is_below_that_of_every_program_whose_collision_is_right():
    least = gradients.least_loss()
    np.testing.assert_allclose(least, gradients.TASK3_LOSSES["optimum"], atol=1e-6)
    assert min(gradients.TASK3_LOSSES.values()) > least - 1e-3


@pytest.mark.parametrize("name", [name for name in peers.PEERS if name != "Rotational.Friction"])
def test_scipy_agrees_with_the_references(name):
    """The equations of the legs, written a second time, against the references."""
    method = "LSODA" if "lugre" in name else "DOP853"
    np.testing.assert_allclose(peers.PEERS[name][0](method)(1e-10), CASES[name].exact().values, rtol=1e-7, atol=1e-7)
