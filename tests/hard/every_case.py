"""Every hard case under every transform. The suite leaves these out, as they take most of an hour; run this file.

```sh
python -m pytest tests/hard/every_case.py --jaxtyping-packages= -n 2 -k "_alone"                  each case in one way
python -m pytest tests/hard/every_case.py --jaxtyping-packages= -k "many_events and _reverse"     one family, one way
```

The name of a test is family-case-_transform. Cases call the package as users do, without type checks at run time;
`.ci/run` also compiles as users do: CONTRIBUTING.md has the environment variables.
"""

import pytest

from ..conftest import drop_programs
from .case import HardCase, MeasuredNumber, RefusedCalls
from .catalogue import LONG, hard_cases
from .check import TRANSFORMS, check


def _tests() -> list[object]:
    """Each case with each transform; those first that take longest."""
    ordered = sorted(hard_cases().values(), key=lambda case: case.name not in LONG)
    return [
        pytest.param(case, transform, id=f"{case.family.replace(' ', '_')}-{case.name}-_{transform}")
        for case in ordered
        for transform in (TRANSFORMS[:1] if isinstance(case.task, RefusedCalls | MeasuredNumber) else TRANSFORMS)
    ]


@pytest.fixture(autouse=True)
def programs_of_other_cases() -> None:
    """One process runs many cases, each of which compiles tens of programs."""
    drop_programs()


@pytest.mark.parametrize(("case", "transform"), _tests())
def test_the_answer_is_right_or_the_error_says_why(case: HardCase, transform: str) -> None:
    report = check(case, [transform])
    if not report.findings:
        pytest.skip(case.skips.get(transform, "There is nothing to compare."))
    failed = [f"{finding.dtype}: {finding.sentence}" for finding in report.findings if not finding.ok]
    assert not failed, f"{case.why}\n" + "\n".join(failed)
