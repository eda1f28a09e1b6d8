"""Numbers in printed tables."""

import math

import pytest

from jaxmodsim._core.readable import interval_text


@pytest.mark.quick
@pytest.mark.parametrize(
    ("low", "high", "text"),
    [
        (11.99998, 12.00013, "11.999980 to 12.000130"),
        (1.5, 1.5001, "1.500000 to 1.500100"),
        (0.1, 2.3, "0.1 to 2.3"),
        (0.0, 1e-7, "0 to 1.00e-07"),
        (-0.004, 0.9, "0 to 0.90"),
        (9.96, 30.0, "10 to 30"),
        (2.0, 2.0, "2 to 2"),
        (-math.inf, 2.0, "-inf to 2"),
    ],
)
def test_both_ends_of_an_interval_show_its_width(low: float, high: float, text: str) -> None:
    assert interval_text(low, high) == text
