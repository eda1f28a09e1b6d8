"""`jaxmodsim orbit` and `jaxmodsim branch`: periodic orbits, as a SPEC says."""

from pathlib import Path

import pandas as pd

from ..orbits import OrbitError, continue_equilibria, continue_orbits, periodic_orbit
from ..plot import branch_figure, orbit_figure
from ._output import say, show_paths, write
from ._spec import read_orbit_spec


def run_orbit(spec: Path, out: Path) -> None:
    """Find the orbit of the SPEC, print it, and write its figure and its numbers."""
    problem = read_orbit_spec(spec)
    orbit = periodic_orbit(problem.scene, problem.guess, **problem.options)
    say(str(orbit))
    names = ("period", "q", "qd", "lowest", "highest", "advance", "stability", "stick", "energy", "residual")
    numbers = {name: getattr(orbit, name) for name in names}
    numbers["multipliers"] = [[x.real, x.imag] for x in orbit.multipliers.tolist()]
    show_paths(write(out, {"orbit.png": orbit_figure(orbit), "orbit.json": numbers}))


def run_branch(spec: Path, out: Path) -> None:
    """Continue the branch of the SPEC, print its bifurcations, and write its figure and a table."""
    problem = read_orbit_spec(spec)
    if problem.branch is None:
        raise ValueError(f'{spec.name}: the table [branch] is missing, as in parameter = "W", from = 0.2, to = 1.2.')
    store, guess, beside = out / "branch.zarr", problem.guess, ()
    if problem.from_rest:
        equilibria = continue_equilibria(
            problem.scene, problem.guess[0], problem.branch["parameter"], problem.branch["span"]
        )
        say(str(equilibria))
        guess, beside = next((point for point in equilibria.points if point.kind == "Hopf"), None), (equilibria,)
        if guess is None:
            raise OrbitError("The equilibria have no Hopf point where orbits could begin: change from or to.")
    try:
        branch = continue_orbits(problem.scene, guess, out=store, progress=True, **problem.branch, **problem.options)
    except ImportError as error:  # of the extra
        raise ValueError(str(error)) from error
    say(str(branch))
    table = pd.DataFrame({branch.parameter: branch.values, "period [s]": branch.period, "stable": branch.stable})
    table[[f"amplitude[{i}]" for i in range(branch.amplitude.shape[1])]] = branch.amplitude
    show_paths([*write(out, {"branch.png": branch_figure(branch, beside=beside), "branch.csv": table}), store])
