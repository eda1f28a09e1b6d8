"""Prediction of the number of steps of each run of a sweep, from a trial of a few runs."""

from dataclasses import dataclass, replace
from itertools import combinations_with_replacement
from math import comb

import numpy as np

from ._compute import Work, compute, runs_per_call
from ._grid import Grid
from ._run import CAP, out_of_steps

# The trial has at most 1/16 of the runs.
_SHARE = 16
# Factor by which the cap of the trial grows.
_GROWTH = 8
# Smaller sweeps have no trial.
_SMALL = 1024
# Largest share of runs that may reach the cap.
_LATE = 0.05
# Runs of the trial per coefficient of the prediction.
_PER_COEFFICIENT = 4
# Ridge of the normal equations, which may be singular, relative to their trace.
_RIDGE = 1e-10
# Ratio of the largest to the smallest positive value above which the prediction uses the logarithm.
_WIDE = 5.0


@dataclass(frozen=True)
class Prediction:
    """Logarithm of the number of steps as a polynomial in the numbers of a run.

    - `names`: the numbers; `logs`: whether to use the logarithm; `centre`, `scale`: for normalisation.
    - `coefficients`: of all products of up to `degree` numbers.
    """

    names: tuple[str, ...]
    logs: tuple[bool, ...]
    centre: np.ndarray
    scale: np.ndarray
    degree: int
    coefficients: np.ndarray

    def order(self, numbers: dict[str, np.ndarray]) -> np.ndarray:
        """Indices of the runs, those with the fewest steps first."""
        x = (_columns(numbers, self.names, self.logs) - self.centre) / self.scale
        steps = np.einsum("nk,k->n", _products(x, self.degree), self.coefficients)
        return np.argsort(steps, kind="stable")


def predict_steps(work: Work, grid: Grid, runs: int) -> tuple[Work, Prediction | None]:
    """Choose the cap of steps and the order of the runs; neither if the limit of steps is unknown.

    The trial fills one call of compiled code for blocks of `runs`. Its runs are drawn at random with a fixed seed. The
    results of the sweep do not depend on it.
    """
    limit = work.run.max_steps
    if limit is None:
        return replace(work, cap=None), None
    cap = min(CAP, limit)
    if grid.size < _SMALL:
        return replace(work, cap=cap), None
    count = min(runs_per_call(runs, work.group), grid.size // _SHARE)
    drawn = np.unique(np.random.default_rng(0).integers(grid.size, size=count))
    numbers = grid.numbers_at(drawn)
    while True:
        # Without a second computation of the runs that reach the cap.
        trial = compute(replace(work, run=work.run.within(cap), cap=None), numbers, np.arange(drawn.size))
        if cap == limit or out_of_steps(trial.code).mean() <= _LATE:
            break
        cap = min(cap * _GROWTH, limit)
    return replace(work, cap=cap), _prediction(numbers, trial.num_steps)


def _prediction(numbers: dict[str, np.ndarray], steps: np.ndarray) -> Prediction:
    names = tuple(numbers)
    logs = tuple(bool(x.min() > 0 and x.max() > _WIDE * x.min()) for x in numbers.values())
    x = _columns(numbers, names, logs)
    centre, scale = x.mean(axis=0), np.where(np.ptp(x, axis=0) > 0, np.ptp(x, axis=0), 1.0)
    x = (x - centre) / scale
    degree = max(d for d in (0, 1, 2, 3) if comb(x.shape[1] + d, d) * _PER_COEFFICIENT <= steps.size)
    products = _products(x, degree)
    # einsum, as the threads of a BLAS spin after their work and take the cores from the runs.
    square = np.einsum("ni,nj->ij", products, products)
    square += _RIDGE * np.trace(square) * np.eye(square.shape[0])
    coefficients = np.linalg.solve(square, np.einsum("ni,n->i", products, np.log(np.maximum(steps, 1))))
    return Prediction(names, logs, centre, scale, degree, coefficients)


def _columns(numbers: dict[str, np.ndarray], names: tuple[str, ...], logs: tuple[bool, ...]) -> np.ndarray:
    columns = [numbers[name].reshape(numbers[name].shape[0], -1).astype(float) for name in names]
    return np.concatenate([np.log(x) if log else x for x, log in zip(columns, logs, strict=True)], axis=1)


def _products(x: np.ndarray, degree: int) -> np.ndarray:
    """All products of up to `degree` columns."""
    chosen = [each for k in range(degree + 1) for each in combinations_with_replacement(range(x.shape[1]), k)]
    return np.stack([np.prod(x[:, each], axis=1) for each in chosen], axis=1)
