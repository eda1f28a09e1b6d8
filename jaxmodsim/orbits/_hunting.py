"""`hunting`: the limit cycle of a PID-controlled axis with stiction, and the gain at which it vanishes."""

from __future__ import annotations  # `help` shows types as they are written here

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from .._core.arguments import as_float
from .._core.functions import nominal
from .._core.readable import AbstractReadable, Table, short, table_of
from ..friction import AbstractLaw
from ..scene import AppliedForce, Friction, Scene, read_element
from ._branch import FOLD, Branch
from ._continue import check_parameter, continue_orbits
from ._orbit import PeriodicOrbit
from ._return_map import OrbitError

# Settling lasts so many of the periods that a first estimate says.
_PERIODS = 20
# Longest step along the branch, and the most of them.
_STEP, _ORBITS = 0.1, 100


class Hunting(AbstractReadable, eqx.Module):
    """The limit cycle of an axis, and its branch over a gain.

    - `branch`: of limit cycles, a `Branch` over the gain; its first orbit is that of the gains given.
    """

    branch: Branch

    @property
    def orbit(self) -> PeriodicOrbit:
        """The limit cycle with the gains given; its coordinates are the position [m] and the integral of it [m s]."""
        return self.branch.orbits[0]

    @property
    def amplitude(self) -> Float[Array, ""]:
        """Half the distance between the turning points of the axis [m]."""
        return self.orbit.amplitude[0]

    @property
    def period(self) -> Float[Array, ""]:
        """Period [s]."""
        return self.orbit.period

    @property
    def vanishes(self) -> float | None:
        """Value of the gain beyond which there is no limit cycle: the first fold. None if the branch does not fold."""
        return next((point.value for point in self.branch.points if point.kind == FOLD), None)


def hunting(
    law: AbstractLaw, gain: str, last: float, *, m: ArrayLike, kp: ArrayLike, ki: ArrayLike, kd: ArrayLike
) -> Hunting:
    """Find how an axis under PID control and friction hunts about its target, and the gain at which it ceases to.

    The axis is `m x'' = -kp x - ki (integral of x) - kd x' - F`. In stick the integral winds up to `Fs`; then the axis
    breaks away, slips beyond its target, and sticks again. Its limit cycle is followed as `gain` changes to `last`;
    where it meets an unstable one, in a fold, both vanish, and from there on the axis settles.

    **Arguments:**

    - `law`: friction law with the parameters `Fc` and `Fs > Fc`. With `Fs = Fc` an axis does not hunt. What damping
      ends is hunting with a curve that falls over some velocity, as that of `Stribeck`; with `Coulomb` it only shrinks.
    - `gain`: which number changes: `"kp"`, `"ki"`, `"kd"`, or another one of the scene, such as `"m"` or
      `"friction.Fs"`.
    - `last`: its last value; the first one is that of the axis.
    - `m`: mass [kg], > 0.
    - `kp`, `ki`, `kd`: gains [N/m, N/(m s), N s/m], > 0 but for `kd`, >= 0. Without stiction the loop is stable if
      `kp (kd + Fv) > m ki`.

    **Returns:**

    A `Hunting`, with at most 100 orbits; `continue_orbits` goes on from the last one.

    **Raises:**

    - `ValueError` for wrong arguments, and as `continue_orbits`.
    - `OrbitError` if there is no limit cycle: the axis settles, or the loop is unstable.

    ??? cite "Reference"

        ```bibtex
        @article{hensen2003friction,
            author={Hensen, R. H. A. and van de Molengraft, M. J. G. and Steinbuch, M.},
            title={Friction induced hunting limit cycles: A comparison between the {LuGre} and switch friction model},
            journal={Automatica}, volume={39}, number={12}, pages={2131--2137}, year={2003},
        }
        ```
    """
    numbers = {name: as_float(x, name=name, lower=0.0) for name, x in (("m", m), ("kp", kp), ("ki", ki))}
    numbers["kd"] = as_float(kd, name="kd")
    if numbers["kd"] < 0:
        raise ValueError(f"kd must be >= 0, but {kd!r} was given.")
    Fc, Fs = _levels(law)
    axis = Scene(
        _lagrangian,
        params=numbers,
        effects=(AppliedForce(_pid_force), Friction(law, along=_position, name="friction")),
        coordinates=("x [m]", "integral [m s]"),
    )
    check_parameter(axis, gain)
    first, last = read_element(axis, gain), as_float(last, name="last")
    if first == last:
        raise ValueError(f"last must be another value of {gain} than that of the axis, but both are {last:g}.")
    # It sticks (Fs - Fc)/kp from its target, and the integral then turns from one level of friction to the other.
    settle = _PERIODS * 2.0 * (Fs + Fc) * numbers["kp"] / (numbers["ki"] * (Fs - Fc))
    start = 2.0 * Fs / numbers["kp"]
    try:
        branch = continue_orbits(
            *(axis, ([start, 0.0], [0.0, start]), gain, (first, last)),
            settle=settle,
            step=_STEP,
            max_orbits=_ORBITS,
        )
    except OrbitError as error:
        raise OrbitError(
            f"No limit cycle was found in {settle:.4g} s from x = {start:.4g} m: the axis settles, or its loop is"
            f" unstable without stiction, kp (kd + Fv) < m ki. {error}"
        ) from error
    return Hunting(branch)


def _lagrangian(_t: Array, _q: Array, qd: Array, p: dict[str, Array]) -> Array:
    """Axis, and a coordinate of mass one for the integral of its position [J]."""
    return 0.5 * p["m"] * qd[0] ** 2 + 0.5 * qd[1] ** 2


def _pid_force(_t: Array, q: Array, qd: Array, p: dict[str, Array]) -> Array:
    """PID force on the axis [N]; and what holds the velocity of the integral at the position, where it starts."""
    force = -p["kp"] * q[0] - p["ki"] * q[1] - p["kd"] * qd[0]
    return jnp.stack([force, qd[0] + jnp.sqrt(p["kp"] / p["m"]) * (q[0] - qd[1])])


def _position(q: Array) -> Array:
    """Position of the axis [m]."""
    return q[0]


def _levels(law: AbstractLaw) -> tuple[float, float]:
    """Fc and Fs of a law."""
    Fc, Fs = (nominal(getattr(law, name, None)) for name in ("Fc", "Fs"))
    if Fc is None or Fs is None or not float(Fs) > float(Fc):
        raise ValueError(
            f"An axis under PID control hunts where friction in stick exceeds that in slip: law must have Fc and"
            f" Fs > Fc, but {law!r} was given."
        )
    return float(Fc), float(Fs)


@table_of.register
def _(result: Hunting) -> Table:
    """Amplitude, period, where it vanishes."""
    branch, value = result.branch, result.vanishes
    name, ends = branch.parameter, branch.values[[0, -1]]
    end = f"which does not vanish from {name} = {ends[0]:.6g} to {ends[1]:.6g}"
    if value is not None:
        end = f"which vanishes at {name} = {value:.8g}"
    row = (f"{branch.values[0]:.6g}", short(result.amplitude), short(result.period), result.orbit.stability)
    title = f"Hunting, {end}"
    return Table(title, (name, "amplitude [m]", "period [s]", ""), [row], (branch.ending,))
