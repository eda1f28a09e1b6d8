"""What JSON knows."""

import math
from typing import Any


def jsonable(value: Any) -> Any:
    """Dictionaries, lists, text and numbers as JSON knows them: arrays become lists, what is not finite null."""
    if isinstance(value, dict):
        return {key: jsonable(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [jsonable(item) for item in value]
    if hasattr(value, "tolist"):
        return jsonable(value.tolist())
    return None if isinstance(value, float) and not math.isfinite(value) else value
