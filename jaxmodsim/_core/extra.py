"""Packages that only some parts need."""

import importlib
from types import ModuleType


def extra(name: str, user: str = "sweep", of: str = "sweep") -> ModuleType:
    """Import a package of the extra `of`, for the function `user`.

    **Raises:**

    - `ImportError` that says how to install it.
    """
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        raise ImportError(f'{user} needs {error.name}: pip install "jaxmodsim[{of}]".') from error
