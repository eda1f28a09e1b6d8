"""Samples of boxes of parameters."""

from typing import Any

import numpy as np
import pytest
import scipy.stats

from jaxmodsim.sweeps import latin_hypercube, sobol

RANGES = {"m": (1.0, 3.0), "friction.Fc": (1e-2, 1e2, "log"), "k": scipy.stats.norm(5.0, 0.5)}


def unit(columns: dict[str, np.ndarray]) -> np.ndarray:
    """Back into the unit cube, shape `[count, 3]`."""
    m, fc, k = columns.values()
    return np.stack([(m - 1.0) / 2.0, (np.log10(fc) + 2.0) / 4.0, scipy.stats.norm(5.0, 0.5).cdf(k)], axis=1)


@pytest.mark.parametrize(("draw", "count"), [(latin_hypercube, 50), (sobol, 64)])
def test_one_in_each_stratum_of_every_parameter(draw: Any, count: int) -> None:
    columns = draw(RANGES, count)
    assert list(columns) == list(RANGES)
    strata = np.floor(unit(columns) * count)
    np.testing.assert_array_equal(np.sort(strata, axis=0), np.tile(np.arange(count)[:, None], (1, 3)))


def test_sobol_points_are_balanced_in_pairs() -> None:
    """Of 64 points in each pair of these parameters, 4 in each sixteenth of the square."""
    points = unit(sobol(RANGES, 64))
    for i, j in ((0, 1), (0, 2), (1, 2)):
        counts = np.histogram2d(points[:, i], points[:, j], bins=4, range=[[0, 1], [0, 1]])[0]
        np.testing.assert_array_equal(counts, 4)


@pytest.mark.parametrize("draw", [latin_hypercube, sobol])
def test_seeds(draw: Any) -> None:
    one, same, other = (unit(draw(RANGES, 16, seed=seed)) for seed in (3, 3, 4))
    np.testing.assert_array_equal(one, same)
    assert np.all(one != other)


@pytest.mark.parametrize(
    ("ranges", "count", "text"),
    [
        ({}, 4, "at least one parameter"),
        ({"m": (1.0,)}, 4, r"range of 'm' must be \(low, high\)"),
        ({"m": (1.0, 2.0, "lin")}, 4, "'log'"),
        ({"m": 2.0}, 4, "frozen distribution"),
        ({"m": (2.0, 2.0)}, 4, "low < high"),
        ({"m": (0.0, np.inf)}, 4, "finite"),
        ({"m": ("a", "b")}, 4, "finite"),
        ({"m": (0.0, 1.0, "log")}, 4, "begin above zero"),
        ({"m": scipy.stats.norm(1.0, np.inf)}, 4, "distribution of 'm' has samples that are not finite"),
        ({"m": (1.0, 2.0)}, 0, "positive integer"),
    ],
)
@pytest.mark.parametrize("draw", [latin_hypercube, sobol])
def test_garbage_is_refused(draw: Any, ranges: Any, count: int, text: str) -> None:
    with pytest.raises(ValueError, match=text):
        draw(ranges, count)


def test_sobol_wants_a_power_of_two() -> None:
    with pytest.raises(ValueError, match="use 64 or 128"):
        sobol({"m": (1.0, 2.0)}, 100)
