"""The yardstick between two environments: the same NumPy work, timed in each."""

import statistics
import time

import numpy as np


def numpy_workload_s(repetitions: int = 7) -> float:
    """Median time [s] of 2000 steps of Euler's method on two numbers and 20 products of 200 x 200 matrices."""
    field, square = np.array([[0.0, 1.0], [-1.0, 0.0]]), np.linspace(0.0, 1.0, 40_000).reshape(200, 200)
    taken = []
    for _ in range(repetitions):
        start = time.perf_counter()
        y, total = np.array([1.0, 0.0]), 0.0
        for _ in range(2000):
            y = y + 1e-3 * (field @ y)
        for _ in range(20):
            total += float((square @ square)[0, 0])
        taken.append(time.perf_counter() - start)
    return statistics.median(taken)
