"""Public cases: references against published figures, our runs and derivatives against the references."""

import numpy as np
import pytest

from bench.conformance import gradients, impacts, peers, references_translational
from bench.conformance.case import same_order
from bench.studies.conformance import CASES

# Published at a tolerance of 1e-6: 2e-5 of the values, and more where a stop or a temperature adds up.
PUBLISHED = 1e-5
QUICK = ("Translational.Brake", "Translational.ElastoGap", "Rotational.EddyCurrentBrake", "diff_sim_grads task1")
# Published by time-stepping of first order, in steps of the impulse, or with another rule at a stop, see their tests.
COARSE = {
    "Siconos ImpactingStick": 2e-3, "Siconos RockingBlock": 1e-3, "Siconos RelayOscillatorWithSliding": 2e-3,
    "Translational.HeatLosses": 6e-3,
}  # fmt: skip
# At the stop of this case contact and friction open one after the other, nanoseconds apart.
LATER = {"Translational.Friction, stop2": 5e-9}


@pytest.mark.parametrize("name", [name for name, case in CASES.items() if case.published or case.modes])
def test_a_reference_explains_the_published_figures(name):
    case = CASES[name]
    reference = case.exact()
    published = np.array([np.nan if x is None else x for x in case.published or [None] * len(case.outputs)])
    values = np.where(np.isnan(published), np.nan, reference.values)
    np.testing.assert_allclose(values, published, rtol=COARSE.get(name, 5e-4), atol=COARSE.get(name, 6e-5))
    # A mode change of the files is the first sample in the new mode. At rest, gear and bearing hold together.
    shared = [mode for mode in case.modes if mode[1] != "gear backward" or name.endswith("1")]
    late = same_order(shared, reference.events)
    assert late is not None
    assert late < (1e-4 if name == "Siconos RockingBlock" else PUBLISHED)


@pytest.mark.parametrize("name", QUICK)
def test_values_and_events(name):
    check(name, derivatives=False)


@pytest.mark.parametrize("name", [*CASES])
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


def test_the_stop_of_heat_losses_explains_its_published_figures():
    """`reinit` of one velocity changes another one, where the difference of both is a state."""
    case = CASES["Translational.HeatLosses"]
    found = references_translational.heat_losses(**case.numbers, shared=True)
    np.testing.assert_allclose(found.values, np.array(case.published, float), atol=2e-6)
    # Samples of mode changes in the file. In its mode "free" the brake has no events.
    published = (
        (0.029181443220520149, "support forward"), (0.24192323015836162, "brake forward"),
        (0.2472587005616009, "mass forward"), (0.42854941954174963, "mass stick"), (0.50800900423551665, "brake stick"),
        (0.51439387914313006, "support backward"), (0.73436396331476106, "brake backward"),
        (0.75982317121778309, "mass backward"), (0.91104221190560397, "support forward"),
        (1.0668354641348265, "brake stick"), (1.0681110514780516, "mass stick"), (1.2433548506181671, "brake forward"),
        (1.2435483691402927, "mass forward"), (1.4992304684685385, "mass stick"), (1.5038361636706319, "brake stick"),
        (1.5619319654431607, "support backward"), (1.7398447595211923, "brake backward"),
        (1.7645511343877638, "mass backward"), (1.913330313864134, "support forward"),
    )  # fmt: skip
    late = same_order(published, found.events)
    assert late is not None
    assert late < 5e-6


def test_a_stick_by_time_stepping_gives_the_published_figures_of_siconos():
    """Moreau-Jean's method with theta = 1/2 and steps of 0.1 ms, of which the reference is the limit."""
    h, mu = 1e-4, 0.01
    mass = np.array([1.0, 1.0, 1.0 / 12.0])
    q, v = np.array([0.5 * np.sin(np.pi / 4), 0.5 * np.cos(np.pi / 4) + 0.01, np.pi / 4]), np.array([-0.5, 0.1, 0.1])
    for _ in range(2000):
        normal, along = np.array([0.0, 1.0, 0.5 * np.sin(q[2])]), np.array([1.0, 0.0, 0.5 * np.cos(q[2])])
        after = v + h * np.array([0.0, -10.0, 0.0])
        if q[1] - 0.5 * np.cos(q[2]) + 0.5 * h * (normal @ v) <= 0 and normal @ (after + v) < 0:
            for sign in (1.0, -1.0):
                push = (normal - sign * mu * along) / mass
                slid = after - normal @ (after + v) / (normal @ push) * push
                if sign * (along @ slid) > 0:
                    break
            after = slid
        q, v = q + 0.5 * h * (v + after), after
    np.testing.assert_allclose([*q, *v], CASES["Siconos ImpactingStick"].published, rtol=1e-9)


def test_a_block_with_impulses_in_steps_gives_the_published_figures_of_siconos():
    """Impulses rise in steps of 5e-5 N s until they reach those of the law."""
    case = CASES["Siconos RockingBlock"]
    found = impacts.exact_rocking_block(**case.numbers, step=5e-5)
    np.testing.assert_allclose(found.values, np.array(case.published, float), rtol=1e-7)
    late = same_order(case.modes, found.events)
    assert late is not None
    assert late < 1e-9


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
