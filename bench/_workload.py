"""The yardstick between two environments: the same NumPy work, timed in each."""

import time

import numpy as np


def numpy_workload_s(repetitions: int = 25) -> float:
    """Shortest time [s] of 3000 steps of Euler's method on 200 oscillators, one thread."""
    taken = []
    for _ in range(repetitions):
        start = time.perf_counter()
        x, v = np.linspace(0.5, 1.5, 200), np.zeros(200)
        for _ in range(3000):
            x, v = x + 1e-3 * v, v - 1e-3 * x
        taken.append(time.perf_counter() - start)
    return min(taken)
