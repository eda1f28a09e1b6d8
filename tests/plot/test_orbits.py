"""Figures of periodic orbits: what is drawn, of orbits that other tests compute."""

from dataclasses import replace

import numpy as np
import pytest

import jaxmodsim as jms
from jaxmodsim.orbits import Branch, PeriodicOrbit
from jaxmodsim.plot import branch_figure, orbit_figure
from jaxmodsim.problems import belt_oscillator


@pytest.fixture(scope="module")
def branch() -> Branch:
    scene = belt_oscillator.scene()
    return jms.continue_orbits(scene, ([0.0], [0.0]), "friction.belt_velocity", (0.1, 0.15), settle=20.0, step=0.5)


def test_an_orbit_is_drawn_by_its_modes(branch: Branch) -> None:
    figure = orbit_figure(branch.orbits[0])
    (axis,) = figure.axes
    assert axis.get_xlabel() == "x [m]"
    legend = axis.get_legend()
    assert legend is not None
    assert {text.get_text() for text in legend.get_texts()} == {"stick", "backward"}


def test_a_branch_is_drawn_with_its_stability_and_period(branch: Branch) -> None:
    exact = [belt_oscillator.cycle(**{**belt_oscillator.PARAMS, "belt": x}).period for x in branch.values]
    np.testing.assert_allclose(branch.period, exact, rtol=1e-8)
    figure = branch_figure(branch)
    assert [axis.get_ylabel() for axis in figure.axes] == ["amplitude of x [m]", "x_dot [m/s]", "period [s]"]

    def unstable(orbit: PeriodicOrbit) -> PeriodicOrbit:
        return replace(orbit, multipliers=np.array([1.0, 2.0 + 0j]))

    rests = jms.continue_equilibria(
        belt_oscillator.scene(belt_oscillator.stribeck(), c=2.0), [0.0], branch.parameter, (0.8, 0.1), step=0.5
    )
    beside, _, below = branch_figure(branch, beside=(rests,)).axes
    assert below.get_xlabel() == "friction.belt_velocity [m/s]"
    legend = beside.get_legend()
    assert legend is not None
    assert {text.get_text() for text in legend.get_texts()} == {"stable", "unstable", "Hopf"}

    half = len(branch.orbits) // 2
    orbits = branch.orbits[:half] + tuple(map(unstable, branch.orbits[half:]))
    mixed = branch_figure(Branch(branch.parameter, branch.values, orbits, (), branch.ending))
    assert {line.get_linestyle() for line in mixed.axes[0].get_lines()} == {"-", "--"}
