"""Runs by events against an independent reference: families of stick-slip systems at random.

`pytest tests/simulation/test_stick_slip_families.py --hypothesis-profile=deep` draws 400 members of each family, the
suite 24.
"""

from dataclasses import dataclass
from functools import cache
from typing import Any

import equinox as eqx
import jax
import numpy as np
import pytest

import jaxmodsim as jms
from jaxmodsim.simulation import outcome_messages

from ..helpers.fuzz import is_deep
from ..helpers.stick_slip_families import FAMILIES, Family, Member, draw_family
from ..problems import linear_stick_slip

COUNT, DEEP = 24, 400
# What takes minutes to compile is left to the deep profile.
NAMES = [name for name in FAMILIES if is_deep() or name != "chain"]
# Two elements may change together, each to be counted: in the log, which is another run and so compiled besides. Of
# other families the instants are counted.
LOGGED = ("two_elements", "two_boxes", "together")
# What is asked for by default, and how many times that ends may be off.
RTOL, ATOL, TIMES = 1e-6, 1e-9, 10.0


@dataclass(frozen=True)
class Compared:
    """Runs of a family beside their reference.

    - `codes`: how they ended, 0 where they reached t1.
    - `errors`: of coordinates and velocities at the end, over what is admissible; the largest of each member.
    - `events`, `expected`: numbers of mode changes, and those of the reference; see `LOGGED`.
    """

    family: Family
    codes: np.ndarray
    errors: np.ndarray
    events: np.ndarray
    expected: np.ndarray

    def describe(self, wrong: np.ndarray) -> str:
        """The members that are wrong, the first ones in full."""
        which = np.flatnonzero(wrong)
        lines = [f"{len(which)} of {len(wrong)} members of {self.family.name} ({self.family.left_out} left out):"]
        for i in which[:8]:
            lines.append(
                f"member {i}: code {self.codes[i]}, error {self.errors[i]:.3g} of what is admissible,"
                f" {self.events[i]:g} events, right are {self.expected[i]}"
            )
        return "\n".join(lines)


@eqx.filter_jit
def runs(scenes: Any, q0: Any, qd0: Any, t1: Any, logged: bool) -> tuple[Any, ...]:
    """Codes, ends, and numbers of mode changes."""

    def one(scene: Any, q0: Any, qd0: Any, t1: Any) -> tuple[Any, ...]:
        run = jms.simulate(scene, q0, qd0, t1, max_events=512, throw=False)
        events = (run.events.effect >= 0).sum() if logged else run.stats["num_events"]
        return run.code, run.q[-1], run.qd[-1], events

    return jax.vmap(one)(scenes, q0, qd0, t1)


def scale_of(member: Member) -> np.ndarray:
    """Largest magnitudes of coordinates and velocities."""
    return np.concatenate([member.motion.q_scale, member.motion.qd_scale])


@cache
def compared(name: str) -> Compared:
    """All members in one compiled call."""
    family = draw_family(name, DEEP if is_deep() else COUNT)
    logged = name in LOGGED
    codes, q, qd, events = map(np.asarray, runs(*family.batch, logged))
    ends = np.concatenate([q, qd], axis=1)
    right = np.stack([np.concatenate([each.motion.q, each.motion.qd]) for each in family.members])
    admissible = TIMES * (RTOL * np.stack([scale_of(each) for each in family.members]) + ATOL)
    motions = [each.motion for each in family.members]
    expected = np.array([each.num_events if logged else len(each.times) for each in motions])
    return Compared(family, codes, np.max(np.abs(ends - right) / admissible, axis=1), events, expected)


@pytest.mark.parametrize("name", NAMES)
def test_runs_reach_the_end(name: str) -> None:
    found = compared(name)
    messages = outcome_messages(
        linear_stick_slip.scene(found.family.members[0].system), found.family.members[0].system.size
    )
    failed = found.codes != 0
    assert not failed.any(), found.describe(failed) + "\n" + messages[found.codes[failed][0]]


@pytest.mark.parametrize("name", NAMES)
def test_ends_are_right(name: str) -> None:
    found = compared(name)
    wrong = ~(found.errors <= 1.0)
    assert not wrong.any(), found.describe(wrong)


@pytest.mark.parametrize("name", [name for name in NAMES if name != "chain"])
def test_events_are_all_there(name: str) -> None:
    """But for the chain, where they are not unique."""
    found = compared(name)
    wrong = found.events != found.expected
    assert not wrong.any(), found.describe(wrong)


@pytest.mark.parametrize("name", NAMES)
def test_few_members_are_left_out(name: str) -> None:
    """What is ill-conditioned is the exception."""
    family = compared(name).family
    assert family.left_out <= 2 + 0.1 * len(family.members)


def test_accuracy_is_met_or_its_lack_is_said() -> None:
    asked = 1e-6
    for member in draw_family("shaken_box", 24 if is_deep() else 4, seed=1).members:
        scene = linear_stick_slip.scene(member.system)
        try:
            run = jms.simulate_to_accuracy(scene, member.q0, member.qd0, member.t1, accuracy=asked)
        except jms.SimulationError:
            continue
        ends = np.concatenate([run.q[-1], run.qd[-1]])
        right = np.concatenate([member.motion.q, member.motion.qd])
        assert np.all(np.abs(ends - right) <= 3.0 * asked * np.maximum(scale_of(member), 1e-6))
