"""What every export needs of a law."""

from .._core.state_dependent import is_state_dependent
from ..friction import AbstractLaw


def need_numbers(law: AbstractLaw, wanted: str) -> None:
    """Refuse what is no law, and a law whose numbers depend on the state of the mechanism.

    **Raises:**

    - `ValueError` that says what to give instead.
    """
    if not isinstance(law, AbstractLaw):
        raise ValueError(f"{wanted} needs a law, but {law!r} was given.")
    if is_state_dependent(law):
        raise ValueError(
            f"{wanted} writes numbers, but parameters of this {type(law).__name__} depend on the state of the mechanism"
            " (scaled_by), which the target cannot say: export law.bind_state(t, q, qd, params), the law at one state."
        )
