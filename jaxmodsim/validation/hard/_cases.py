"""All hard cases."""

from . import _geometry, _gradients, _many_events, _numbers, _reversal, _scale, _shaken, _stiffness
from ._case import HardCase

_MODULES = (_stiffness, _reversal, _shaken, _many_events, _geometry, _scale, _numbers, _gradients)

FAMILIES = tuple(module.FAMILY for module in _MODULES)


def hard_cases() -> dict[str, HardCase]:
    """All hard cases by name, family after family.

    ```python
    case = hard.hard_cases()["bristle_stiff"]
    verdict = hard.check(case)
    verdict.ok, [finding.sentence for finding in verdict.findings]
    ```

    Families: stiffness, rest and reversal, loads in stick, many events, geometry, scale and time, numbers,
    gradients.
    """
    return {case.name: case for module in _MODULES for case in module.cases()}
