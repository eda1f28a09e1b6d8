"""What a misspelt name may have meant."""

import difflib
from collections.abc import Iterable


def nearest(name: str, known: Iterable[str]) -> str | None:
    """The known name that is most like this one; None where none is."""
    found = difflib.get_close_matches(name, list(known), n=1)
    return found[0] if found else None


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """A question whether the nearest of the known names was meant, to end a sentence with; "" where none is near."""
    near = nearest(name, known)
    return f" Did you mean {near!r}?" if near else ""
