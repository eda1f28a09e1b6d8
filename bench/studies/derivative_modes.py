"""Reverse mode against forward mode: derivatives of the same steps, which differ by rounding alone.

The functions are the named problems, by all numbers of their scenes at three tolerances, and the hard cases of
`FAMILIES` with a derivative, by their number. Each runs with and without `tune_cpu`, in its own process. Differences
are relative to the derivative, or to the scale of the answer over the number if that is larger.
"""

import multiprocessing
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

import jaxmodsim as jms
from bench.record import Result
from jaxmodsim.problems import NamedProblem, named_problems
from jaxmodsim.scene import elements, read_element, replace_elements
from jaxmodsim.simulation import named_series
from tests.hard.case import HardCase
from tests.hard.catalogue import hard_cases

PROBLEMS, HARD = "named problems", "hard cases"
FAMILIES = ("stiffness", "rest and reversal", "many events", "gradients")
RTOLS = (1e-6, 1e-9, 1e-12)
TUNED = {"": False, "tuned": True}
# Cases with a larger difference are listed.
SHOWN = 1e-11

Found: TypeAlias = "tuple[str, str, float, str]"


def main(smoke: bool, out: Path) -> Result:
    """Record the largest differences; a smoke run has one case of each kind."""
    del out
    result = Result("derivative_modes", ("diffrax",), {"shown": SHOWN})
    context = multiprocessing.get_context("spawn")
    ways = {"": False} if smoke else TUNED
    pools = {at: ProcessPoolExecutor(1, context, initializer=_begin, initargs=(tuned,)) for at, tuned in ways.items()}
    futures = {at: pool.submit(_all, smoke) for at, pool in pools.items()}
    for at, future in futures.items():
        found = future.result()
        for group in (PROBLEMS, HARD):
            differences = [difference for kind, _, difference, _ in found if kind == group]
            about = {"case": group, "at": at}
            result.add("derivatives", len(differences), **about)
            result.add("median", float(np.median(differences)), **about)
            result.add("largest", max(differences), **about)
            result.add(f"above {SHOWN:g}", sum(x > SHOWN for x in differences), **about)
        for _, name, difference, why in found:
            if difference > SHOWN:
                result.add("difference", difference, case=name, at=at)
                result.add("why it is hard", why, case=name, at=at)
    return result


def _begin(tuned: bool) -> None:
    jax.config.update("jax_enable_x64", True)
    if tuned:
        jms.tune_cpu()


def _all(smoke: bool) -> list[Found]:
    """Group, name, difference and reason for every derivative."""
    found = []
    for name in ("braked_spring",) if smoke else named_problems():
        found += _problem(named_problems()[name]())
        jax.clear_caches()
    for name, case in hard_cases().items():
        if _has_derivative(case) and (not smoke or name == "zero_start"):
            found.append(_hard(case))
            jax.clear_caches()
    return found


def _has_derivative(case: HardCase) -> bool:
    wanted = case.family in FAMILIES and hasattr(case.task, "answer")
    return wanted and not (case.ends or case.undefined or {"forward", "reverse"} & {*case.skips})


def _problem(problem: NamedProblem) -> Iterator[Found]:
    numbers = {name: read_element(problem.scene, name) for name in elements(problem.scene)}

    def fn(values: Array, rtol: Array) -> Array:
        scene = replace_elements(problem.scene, dict(zip(numbers, values, strict=True)))
        options = {"rtol": rtol, "atol": 1e-2 * rtol, "max_steps": problem.max_steps, "throw": False}
        return named_series(jms.simulate(scene, problem.q0, problem.qd0, problem.t1, **options), problem.observable)[-1]

    x = jnp.array([*numbers.values()])
    modes = _modes(fn)
    for rtol in RTOLS:
        yield PROBLEMS, f"{problem.name}, rtol {rtol:g}", _difference(*modes(x, jnp.asarray(rtol)), x), ""


def _hard(case: HardCase) -> Found:
    task: Any = case.task
    x = jnp.asarray(task.x, float)
    modes = _modes(lambda x: task.answer(x).value)
    forward, (value, reverse) = modes(x)
    size = value if case.scale is None else jnp.asarray(case.scale)
    return HARD, case.name, _difference(forward, (size, reverse), x), case.why


def _modes(fn: Callable[..., Array]) -> Callable[..., tuple[Array, tuple[Array, Array]]]:
    """Forward derivatives of a function, and its value and reverse derivatives."""
    forward, reverse = jax.jit(jax.jacfwd(fn)), jax.jit(jax.value_and_grad(fn))
    return lambda *x: (forward(*x), reverse(*x))


def _difference(forward: Array, reverse: tuple[Array, Array], x: Array) -> float:
    """The largest relative difference of derivatives."""
    scale, other = reverse
    one, other, size = (np.atleast_1d(each) for each in (forward, other, x))
    measure = np.maximum(np.abs(one), abs(float(scale)) / np.where(size == 0, 1.0, np.abs(size)))
    return float(np.max(np.abs(one - other) / np.where(measure == 0, 1.0, measure)))
