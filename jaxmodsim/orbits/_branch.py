"""A branch of periodic orbits, and the special ones along it."""

from typing import Generic, TypeVar

import equinox as eqx
import numpy as np

from .._core.readable import AbstractReadable, Table, table_of
from ._equilibrium import Equilibrium
from ._orbit import PeriodicOrbit

FOLD, DOUBLING, TORUS, CROSSING, HOPF = "fold", "period doubling", "Neimark-Sacker", "branch point", "Hopf"
ONSET, LOSS, GRAZING, ORDER = "onset of stick", "loss of stick", "grazing", "order of modes"

# What a branch consists of. An equilibrium is an orbit that stays where it is.
OrbitT = TypeVar("OrbitT", PeriodicOrbit, Equilibrium)


class SpecialOrbit(eqx.Module, Generic[OrbitT]):
    """An orbit at which a branch turns, or orbits change their stability or their sequence of modes.

    - `kind`: `"fold"`, `"period doubling"`, `"Neimark-Sacker"`, `"branch point"` (a multiplier of 1 without a fold);
      where the sequence of modes changes `"onset of stick"`, `"loss of stick"`, `"grazing"` (an impact or a reversal
      more or less) or `"order of modes"` (the same changes in another order). Of equilibria `"fold"`,
      `"branch point"`, or `"Hopf"`, where a branch of periodic orbits begins.
    - `value`: of the parameter.
    - `index`: it lies between the orbits `index` and `index + 1` of the branch.
    - `orbit`: the orbit.
    - `direction`: of a period doubling the direction of the state to the orbits of twice the period, shape `[n]`; of
      equilibria none, shape `[0]`.
    """

    kind: str = eqx.field(static=True)
    value: float
    index: int = eqx.field(static=True)
    orbit: OrbitT
    direction: np.ndarray


class Branch(AbstractReadable, eqx.Module, Generic[OrbitT]):
    """A branch of periodic orbits, or of equilibria, over a number of the scene.

    - `parameter`: name of the number.
    - `values`: of it, shape `[orbits]`.
    - `orbits`: a `PeriodicOrbit` or an `Equilibrium` each, in order along the branch.
    - `points`: where it folds, loses stability or changes the sequence of modes, `SpecialOrbit`s in that order.
    - `ending`: why it ends, in words.
    """

    parameter: str = eqx.field(static=True)
    values: np.ndarray
    orbits: tuple[OrbitT, ...]
    points: tuple[SpecialOrbit[OrbitT], ...]
    ending: str = eqx.field(static=True)

    @property
    def amplitude(self) -> np.ndarray:
        """Half the distance between the turning points of each coordinate, shape `[orbits, dof]`."""
        return np.array([each.amplitude for each in self.orbits])

    @property
    def period(self) -> np.ndarray:
        """Periods [s], shape `[orbits]`; of equilibria that of small oscillations, infinite where there are none."""
        return np.array([float(each.period) for each in self.orbits])

    @property
    def multipliers(self) -> np.ndarray:
        """Floquet multipliers of periodic orbits, complex, shape `[orbits, n]`."""
        return np.array([each.multipliers for each in self.orbits if isinstance(each, PeriodicOrbit)])

    @property
    def eigenvalues(self) -> np.ndarray:
        """Eigenvalues of equilibria [1/s], complex, shape `[orbits, k]`."""
        return np.array([each.eigenvalues for each in self.orbits if isinstance(each, Equilibrium)])

    @property
    def stable(self) -> np.ndarray:
        """Whether each orbit is stable, shape `[orbits]`."""
        return np.array([each.stable for each in self.orbits])


@table_of.register
def _(branch: Branch) -> Table:
    """Special orbits, and how the branch ended."""
    at_rest = isinstance(branch.orbits[0], Equilibrium)
    rows = [
        (
            each.kind,
            f"{each.value:.8g}",
            ", ".join(f"{float(x):.6g}" for x in (each.orbit.q if at_rest else each.orbit.amplitude)),
            f"{float(each.orbit.period):.6g}",
        )
        for each in branch.points
    ]
    span = f"{branch.values.min():.6g} to {branch.values.max():.6g}"
    what = "equilibria" if at_rest else "orbits"
    title = (
        f"Branch of {len(branch.orbits)} {what}, {branch.parameter} {span}, {int(branch.stable.sum())} of them stable"
    )
    head = ("", branch.parameter, "at" if at_rest else "amplitude", "period [s]")
    return Table(title, head, rows, (branch.ending,))
