"""All hard cases, and checks of many of them in several processes."""

import math
import multiprocessing
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import replace
from functools import cache

import jax

from ..._core.arguments import did_you_mean
from . import (
    _at_rest,
    _contacts,
    _geometry,
    _gradients,
    _many_events,
    _numbers,
    _orbits,
    _plane,
    _reversal,
    _scale,
    _settling,
    _shaken,
    _stiffness,
)
from ._case import HardCase
from ._check import DTYPES, TRANSFORMS, CaseReport, CheckFinding, check, check_choice

_MODULES = (
    *(_stiffness, _reversal, _shaken, _many_events, _contacts, _settling, _orbits),
    *(_plane, _geometry, _scale, _numbers, _gradients, _at_rest),
)

# Families of hard cases, in the order in which they run.
FAMILIES = tuple(module.FAMILY for module in _MODULES)


def hard_cases() -> dict[str, HardCase]:
    """All hard cases by name, family after family.

    ```python
    case = hard.hard_cases()["bristle_stiff"]
    verdict = hard.check(case)
    verdict.ok, [finding.sentence for finding in verdict.findings]
    ```

    Families: stiffness, rest and reversal, loads in stick, many events, contacts, periodic orbits, geometry, scale and
    time, numbers, gradients, derivatives at rest.
    """
    return {case.name: replace(case, family=module.FAMILY) for module in _MODULES for case in module.cases()}


# Of these the runs themselves take minutes: begun first, they do not hold up the end.
_LONG = ("periods_1000000", "cycles_100000", "dead_points", "redundant_constraints")

# Cases that a process checks. Each compiles tens of programs, a program takes several maps of memory, and Linux gives a
# process no more than 65 530 of those.
_PORTION = 12


def choose(names: Sequence[str]) -> dict[str, HardCase]:
    """The hard cases of these names or families; all without.

    **Raises:**

    - `ValueError` for a name that is neither.
    """
    known = hard_cases()
    chosen: dict[str, HardCase] = {}
    for name in names:
        if name not in known and name not in FAMILIES:
            raise ValueError(
                f"there is no hard case or family {name!r}; the families are: {', '.join(FAMILIES)}."
                f"{did_you_mean(name, (*known, *FAMILIES))}"
            )
        chosen |= {each.name: each for each in known.values() if name in (each.name, each.family)}
    return chosen or known


def check_many(
    names: Sequence[str] = (), *, transforms: Sequence[str] = TRANSFORMS, dtypes: Sequence[str] = DTYPES, jobs: int = 1
) -> Iterator[CaseReport]:
    """`check` many hard cases; each verdict comes as it is found, also where its process was killed.

    **Arguments:**

    - `names`: of cases or families; all without.
    - `transforms`, `dtypes`: as for `check`.
    - `jobs`: processes at a time, > 0, besides this one.

    **Raises:**

    - `ValueError` as `choose` and `check`.
    """
    cases = choose(names)
    check_choice(transforms, dtypes)
    order = sorted(cases, key=lambda name: name not in _LONG)
    context = multiprocessing.get_context("spawn")
    for first in range(0, len(order), jobs * _PORTION):
        pool = ProcessPoolExecutor(jobs, context, initializer=_begin)
        portion = order[first : first + jobs * _PORTION]
        try:
            futures = {pool.submit(_found, name, tuple(transforms), tuple(dtypes)): name for name in portion}
            for future in as_completed(futures):
                yield CaseReport(cases[futures[future]], _result(future))
        finally:
            pool.shutdown(wait=True, cancel_futures=True)


def _result(future: Future[tuple[CheckFinding, ...]]) -> tuple[CheckFinding, ...]:
    try:
        return future.result()
    except BrokenProcessPool as error:
        # That of this case, or of another one that was begun with it.
        return (CheckFinding("alone", "float64", math.nan, False, f"A process was killed: {error}"),)


def _begin() -> None:
    """A process of our own is in double precision."""
    jax.config.update("jax_enable_x64", True)


# Cases of one structure share what is compiled, and a process makes them once.
_cases = cache(hard_cases)


def _found(name: str, transforms: tuple[str, ...], dtypes: tuple[str, ...]) -> tuple[CheckFinding, ...]:
    try:
        return check(_cases()[name], transforms, dtypes).findings
    except Exception as error:
        # Whatever it is, the other cases go on.
        return (CheckFinding("alone", "float64", math.nan, False, f"{type(error).__name__}: {error}"),)
