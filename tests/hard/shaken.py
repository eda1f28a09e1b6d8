"""Loads in stick: where nothing moves that steps could be chosen by, and the load alone decides when slip begins."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import PyTree

from ..problems import linear_stick_slip
from .case import HardCase, motion, position

FAMILY = "loads in stick"


def _case(
    name: str,
    why: str,
    naive: str,
    system: linear_stick_slip.LinearStickSlip,
    t1: float,
    qd0: float = 0.0,
    **options: PyTree,
) -> HardCase:
    """The first coordinate at `t1` from q = 0, by Coulomb's force of the first element."""
    q0, qd = np.zeros(system.size), np.full(system.size, qd0)

    def exact(Fc: float) -> float:
        changed = replace(system, Fc=np.array([Fc, *system.Fc[1:]]))
        return float(linear_stick_slip.motion(changed, q0, qd, t1).q[0])

    scene = linear_stick_slip.scene(system)
    task = motion(scene, q0, qd, t1, by="element_0.Fc", read=position, max_steps=65536)
    return HardCase(name, why, naive, task, exact, **options)


def _with_samples(
    system: linear_stick_slip.LinearStickSlip, times: Sequence[float], values: Sequence[float]
) -> linear_stick_slip.LinearStickSlip:
    """Under a signal besides, which is held from sample to sample."""
    load = system.load.copy()
    load[0, -2] = 1.0
    return replace(system, load=load, sample_times=np.array(times), sample_values=np.array(values))


def _boxes() -> list[HardCase]:
    a, g, w = 0.8441173414514593, 0.09826644620612397, 2.9358368442770417
    growing = linear_stick_slip.system([[0.0, 0.0, 0.0, a, 0.0, a * g]], [(1.0, 1.5)], [w])
    t = float(linear_stick_slip.motion(growing, np.zeros(1), np.zeros(1), 10.0).times[0])
    steps = (
        "The steps have grown over the load while nothing moved: break-aways are missed or come late, without a word."
    )
    return [
        _case(
            "growing_load",
            "A box rests under a load that swings 3.7 times before it exceeds the limit, and breaks away twice.",
            steps,
            growing,
            10.0,
        ),
        _case(
            "sample_after_break_away",
            "The load falls by 0.3 N, to less than stiction but more than Coulomb's force, 1e-9 s after a break-away.",
            "The box, at 3e-10 m/s, is taken to be at rest and held.",
            _with_samples(growing, [0.0, t + 1e-9, t + 0.3], [0.0, 0.3, 0.0]),
            9.5,
            # 1e-9 s are below the rounding of the time.
            single=None,
        ),
        _case(
            "touching_load",
            "The peaks of the load stay below the limit by 1e-5 of it, 38 times.",
            "A tolerance in the search for the event lets the box go.",
            linear_stick_slip.system([[0.0, 0.0, 0.0, 1.5 * (1.0 - 1e-5)]], [(1.0, 1.5)], [6.0]),
            20.0,
            scale=1.0,
        ),
        _case(
            "exceeding_load",
            "The peaks of the load exceed the limit by 1e-5 of it, for 1.5 ms.",
            steps,
            linear_stick_slip.system([[0.0, 0.0, 0.0, 1.5 * (1.0 + 1e-5)]], [(1.0, 1.5)], [6.0]),
            19.4,
            # The time of an exceedance is known to the square root of rounding.
            single=None,
        ),
        _case(
            "slow_load_with_ripple",
            "A load that rises for 1e4 s, with ripple of 0.01 N every 31 s that decides when slip begins.",
            "Steps grow over the ripple: slip begins late by up to half of its period.",
            linear_stick_slip.system([[0.0, 1.5e-4, 0.0, 0.01]], [(1.0, 1.5)], [0.2]),
            1.005e4,
            # Times of 1e4 s are known to 1e-3 s.
            single=None,
        ),
    ]


def _several() -> list[HardCase]:
    pair = 4.0 * np.array([[1.0, -1.0], [-1.0, 1.0]])
    row = np.array([[2.0, -1.0, 0.0], [-1.0, 2.0, -1.0], [0.0, -1.0, 1.0]])
    neighbours = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [-1.0, 1.0, 0.0], [0.0, -1.0, 1.0]]
    limits = [(0.4, 0.4), (0.3, 0.3), (0.5, 0.5), (0.35, 0.35), (0.25, 0.25)]
    together = "One of them breaks away first, and the other is left behind or counted at another instant."
    return [
        _case(
            "two_elements_together",
            "A box with two elements, which share the load in stick and break away at one instant.",
            together,
            linear_stick_slip.system(
                [[0.1, 0.0, 0.0, 2.4]], [(1.0, 1.4), (0.5, 0.6)], [3.0], directions=[[1.0], [1.0]]
            ),
            9.0,
        ),
        _case(
            "mirrored_boxes",
            "Two equal boxes under opposite loads, joined by a spring: what one does, the other does at once.",
            together,
            linear_stick_slip.system(
                [[0.0, 0.0, 0.0, 2.0], [0.0, 0.0, 0.0, -2.0]], [(1.0, 1.3)] * 2, [2.0], stiffness=pair
            ),
            8.0,
        ),
        _case(
            "belt_that_swings",
            "A box on a spring and on a belt whose velocity swings through zero: it sticks and lags in turns.",
            "In stick the belt carries the box, and steps that fit the spring pass over the load of its acceleration.",
            linear_stick_slip.system([[]], [(1.0, 1.5)], [1.7], mass=1.0, stiffness=4.0, belt=[0.2, 0.0, 0.0, 0.3]),
            12.0,
            qd0=0.2,
            # So do half of the runs from velocities within a tenth of this one; the others are right to 1e-6.
            single_ends="step size fell below what the time can resolve",
        ),
        _case(
            "chain_with_neighbours",
            "Three masses with friction on the ground and between neighbours: five elements on three coordinates.",
            "Which elements hold is not unique where all rest; a wrong choice lets slip begin where there is none.",
            linear_stick_slip.system(
                [[0.0, 0.0, 0.0, 2.5], [], [0.4]], limits, [1.9], mass=1.0, stiffness=3.0 * row, directions=neighbours
            ),
            5.0,
            tolerance=1e-5,
            # Elements that hold nothing, at their limits, are told from those that slip by 1e-14 m/s.
            single_ends="step size fell below what the time can resolve",
        ),
    ]


def cases() -> list[HardCase]:
    """The cases of this family."""
    return [*_boxes(), *_several()]
