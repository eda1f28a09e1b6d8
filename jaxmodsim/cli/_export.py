"""`jaxmodsim export`: a scene as an FMU, as a SPEC says."""

from pathlib import Path

from ..export import fmu
from ._output import show_paths
from ._spec import read_export_spec


def run_export(spec: Path, model: Path) -> None:
    """Write the FMU of the SPEC, and print its path.

    **Raises:**

    - `ValueError` as `read_export_spec` and `fmu`; `RuntimeError` if a compiler fails.
    """
    problem = read_export_spec(spec)
    model.parent.mkdir(parents=True, exist_ok=True)
    show_paths([fmu(problem.scene, *problem.start, model, **problem.options)])
