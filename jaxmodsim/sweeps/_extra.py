"""Packages that only sweeps need."""

import importlib
from types import ModuleType


def extra(name: str) -> ModuleType:
    """Import a package of the extra `sweep`.

    **Raises:**

    - `ImportError` that says how to install it.
    """
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        raise ImportError(f'sweep needs {error.name}: pip install "jaxmodsim[sweep]".') from error
