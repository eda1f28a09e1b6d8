"""How many examples the tests `test_fuzz_*.py` draw, and how they draw numbers.

Together they draw about 300 examples; `pytest tests -k fuzz --hypothesis-profile=deep` about 5000. Both draw the
same ones each time.
"""

from collections.abc import Callable
from typing import Any

from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

# Examples of all these tests together, by profile: what conftest.py registers.
PROFILES = {"suite": 300, "deep": 5000}


def register() -> None:
    """Make the profiles known to hypothesis, and choose the short one."""
    for name, total in PROFILES.items():
        settings.register_profile(
            name,
            max_examples=total,
            deadline=None,  # the first example of a scene compiles it
            derandomize=True,
            database=None,
            phases=(Phase.explicit, Phase.generate, Phase.shrink),
            suppress_health_check=list(HealthCheck),
            print_blob=False,
        )
    settings.load_profile("suite")


def fuzz(share: float, *strategies: Any) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """A test that takes `share` of all examples."""
    many = settings(max_examples=max(round(share * settings().max_examples), 1))
    return lambda check: many(given(*strategies)(check))


def is_deep() -> bool:
    """Whether many examples are drawn."""
    return settings().max_examples > PROFILES["suite"]


def decades(low: float, high: float) -> st.SearchStrategy[float]:
    """Ten to a power that is drawn."""
    return st.floats(low, high).map(lambda x: 10.0**x)


def signed(numbers: st.SearchStrategy[float]) -> st.SearchStrategy[float]:
    """Of either sign, and zero."""
    return st.one_of(st.just(0.0), st.tuples(numbers, st.sampled_from([1.0, -1.0])).map(lambda x: x[0] * x[1]))


# What is no number, or hardly one.
ODD = st.sampled_from([float("nan"), float("inf"), -float("inf"), -0.0, 5e-324, -5e-324, 1e308, -1e308, 1e-310])
