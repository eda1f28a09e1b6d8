"""`jaxmodsim orbit` and `jaxmodsim branch`: periodic orbits by a SPEC."""

from pathlib import Path

import numpy as np
import pandas as pd

from ..orbits import OrbitError, continue_equilibria, continue_orbits, periodic_orbit
from ..plot import branch_figure, orbit_figure
from ._output import say, show_paths, show_table, write
from ._spec_orbit import read_orbit_spec


def run_orbit(spec: Path, out: Path) -> None:
    """Find the orbit that the SPEC names, print it, and write its figure and its numbers.

    **Raises:**

    - `ValueError` as `read_orbit_spec` and `periodic_orbit`; `OrbitError` where there is no orbit.
    """
    asked = read_orbit_spec(spec)
    orbit = periodic_orbit(asked.scene, asked.guess, **asked.options)
    say(str(orbit))
    numbers = {
        "period": float(orbit.period),
        "q": np.asarray(orbit.q).tolist(),
        "qd": np.asarray(orbit.qd).tolist(),
        "lowest": np.asarray(orbit.lowest).tolist(),
        "highest": np.asarray(orbit.highest).tolist(),
        "advance": np.asarray(orbit.advance).tolist(),
        "multipliers": [[x.real, x.imag] for x in orbit.multipliers.tolist()],
        "stability": orbit.stability,
        "stick": orbit.stick,
        "energy": orbit.energy,
        "residual": orbit.residual,
    }
    show_paths(write(out, {"orbit.png": orbit_figure(orbit), "orbit.json": numbers}))


def run_branch(spec: Path, out: Path) -> None:
    """Follow the branch that the SPEC names, print its special orbits, and write its figure and a table.

    **Raises:**

    - `ValueError` as `read_orbit_spec` and `continue_orbits`; `OrbitError` where there is no first orbit, or no Hopf
      point.
    """
    asked = read_orbit_spec(spec)
    if asked.branch is None:
        raise ValueError(f'{spec.name}: the table [branch] is missing, as in parameter = "W", from = 0.2, to = 1.2.')
    store, guess, beside = out / "branch.zarr", asked.guess, ()
    if asked.from_rest:
        parameter, span = asked.branch["parameter"], asked.branch["span"]
        beside = (continue_equilibria(asked.scene, asked.guess[0], parameter, span),)
        say(str(beside[0]))
        guess = next((point for point in beside[0].points if point.kind == "Hopf"), None)
        if guess is None:
            raise OrbitError("The equilibria have no Hopf point where orbits could begin: change from or to.")
    try:
        branch = continue_orbits(asked.scene, guess, out=store, progress=True, **asked.branch, **asked.options)
    except ImportError as error:  # of the extra
        raise ValueError(str(error)) from error
    rows = [(x.kind, x.value, *np.asarray(x.orbit.amplitude).tolist()) for x in branch.points]
    amplitudes = [f"amplitude[{i}]" for i in range(branch.amplitude.shape[1])]
    if rows:
        show_table(pd.DataFrame(rows, columns=["special orbit", branch.parameter, *amplitudes]), "Along the branch")
    say(f"{len(branch.orbits)} orbits, {int(branch.stable.sum())} of them stable. {branch.ending}")
    table = pd.DataFrame({branch.parameter: branch.values, "period [s]": branch.period, "stable": branch.stable})
    table[amplitudes] = branch.amplitude
    paths = write(out, {"branch.png": branch_figure(branch, beside=beside), "branch.csv": table})
    show_paths([*paths, store])
