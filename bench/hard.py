"""All hard cases in several processes, and the largest stable steps, as rows of a result."""

import math
import multiprocessing
from collections.abc import Iterable, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from functools import cache

import jax

from bench.record import Result
from tests.hard.catalogue import LONG, hard_cases
from tests.hard.check import DTYPES, CaseReport, CheckFinding, check
from tests.hard.steps import EXPLICIT, formulations, largest_step, theory

# Number of cases for each process. A case compiles tens of programs, each with several memory maps, and Linux allows a
# process 65 530 maps.
_PORTION = 12


def add_errors(result: Result, reports: Iterable[CaseReport]) -> None:
    """Add errors relative to the admissible error, and whether each case passes."""
    for report in reports:
        about = {"case": f"{report.case.family}: `{report.case.name}`"}
        for dtype in DTYPES:
            error = report.worst(dtype)
            result.add("error", None if math.isnan(error) else error, at=dtype, **about)
        result.add("passes", "yes" if report.ok else "**no**", **about)


def add_steps(result: Result, names: Sequence[str], solvers: Sequence[str] = tuple(EXPLICIT)) -> None:
    """Add largest stable fixed steps [s] of explicit methods, by theory and by simulation."""
    for name in names:
        law = formulations()[name]
        for solver in solvers:
            result.add("step by theory", theory(law, EXPLICIT[solver]), "s", case=name, peer=solver)
            result.add("step found", largest_step(law, EXPLICIT[solver]), "s", case=name, peer=solver)


def check_many(names: Sequence[str]) -> list[CaseReport]:
    """Reports on cases in this order, printed as they arrive. A killed process gives reports too."""
    cases, jobs = hard_cases(), multiprocessing.cpu_count()
    reports: dict[str, CaseReport] = {}
    order = sorted(names, key=lambda name: name not in LONG)
    context = multiprocessing.get_context("spawn")
    for first in range(0, len(order), jobs * _PORTION):
        portion = order[first : first + jobs * _PORTION]
        with ProcessPoolExecutor(jobs, context, initializer=_begin) as pool:
            futures = {pool.submit(_found, name): name for name in portion}
            for future in as_completed(futures):
                report = reports[futures[future]] = CaseReport(cases[futures[future]], _result(future))
                failed = [f"{each.dtype}: {each.sentence}" for each in report.findings if not each.ok]
                print(f"{report.case.name}: {'; '.join(failed) or 'pass'}", flush=True)
    return [reports[name] for name in names]


def _result(future: Future[tuple[CheckFinding, ...]]) -> tuple[CheckFinding, ...]:
    try:
        return future.result()
    except BrokenProcessPool as error:
        # The process of this case, or of another one in the same batch.
        return (CheckFinding("alone", "float64", math.nan, False, f"A process was killed: {error}"),)


def _begin() -> None:
    jax.config.update("jax_enable_x64", True)


# Cases with the same structure share compiled programs. A process creates all cases once.
_cases = cache(hard_cases)


def _found(name: str) -> tuple[CheckFinding, ...]:
    try:
        return check(_cases()[name], ["alone"]).findings
    except Exception as error:
        # The other cases continue after any error.
        return (CheckFinding("alone", "float64", math.nan, False, f"{type(error).__name__}: {error}"),)
