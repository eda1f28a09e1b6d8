"""What a good experiment is, and an input design: the motion, its force, and what a record of it would tell."""

from dataclasses import dataclass
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..._core.files import jsonable, written_whole

# Of the relative standard error, above which a number counts as not determined, and of the correlation.
_VAGUE, _ALIKE = 0.5, 0.98
# Share of a limit from which on it counts as reached, and of the travel from which on a deviation is told.
_REACHED, _OFF = 0.98, 0.05


def d_optimal(information: Float[Array, "free free"]) -> Float[Array, ""]:
    """Mean logarithm of the eigenvalues: a small volume of the confidence ellipsoid, whatever the units."""
    return jnp.linalg.slogdet(information)[1] / information.shape[0]


def a_optimal(information: Float[Array, "free free"]) -> Float[Array, ""]:
    """Minus the logarithm of the mean variance of the relative errors."""
    return -jnp.log(jnp.trace(jnp.linalg.inv(information)) / information.shape[0])


def e_optimal(information: Float[Array, "free free"]) -> Float[Array, ""]:
    """Logarithm of the smallest eigenvalue: the combination of numbers that is known worst is known best."""
    return jnp.log(jnp.maximum(jnp.linalg.eigvalsh(information)[0], jnp.finfo(information.dtype).tiny))


@dataclass(frozen=True)
class AxisLimits:
    """What an axis may be asked for; None for no limit.

    **Arguments:**

    - `force`: largest magnitude of the input [N], > 0.
    - `speed`: largest magnitude of the velocity [m/s], > 0.
    - `travel`: largest distance from the start to either side [m], > 0: half of the whole stroke if the axis starts in
      its middle.
    - `rotary`: whether these are a torque [N m], rad/s and rad.

    **Raises:**

    - `ValueError` for a limit that is no positive finite number, or if there is none at all.
    """

    force: float | None = None
    speed: float | None = None
    travel: float | None = None
    rotary: bool = False

    def __post_init__(self) -> None:
        given = self.given
        if not given:
            raise ValueError(
                "AxisLimits needs at least one of force [N], speed [m/s] and travel [m]: without any, the best input is"
                " an infinite one."
            )
        for name, (value, unit) in given.items():
            if isinstance(value, bool) or not np.isfinite(value) or value <= 0:
                raise ValueError(f"The limit of {name} must be finite and > 0 {unit}, but it is {value!r}.")

    @property
    def given(self) -> dict[str, tuple[float, str]]:
        """Value and unit of each limit that there is, by name."""
        units = ("N m", "rad/s", "rad") if self.rotary else ("N", "m/s", "m")
        values = {"force": self.force, "speed": self.speed, "travel": self.travel}
        each = {name: (value, unit) for (name, value), unit in zip(values.items(), units, strict=True)}
        return {name: (value, unit) for name, (value, unit) in each.items() if value is not None}

    def __str__(self) -> str:
        return ", ".join(f"{name} {value:g} {unit}" for name, (value, unit) in self.given.items())


@dataclass(frozen=True, kw_only=True)
class Excitation:
    """A motion that starts and ends at rest, the force that the model needs for it, and what a record of it would tell.

    - `t`: times [s], evenly spaced, shape `[time]`.
    - `q_ref`, `qd_ref`: position [m] and velocity [m/s] that are asked for.
    - `force`: force [N] that leads the model along them, held from each sample to the next.
    - `q`, `qd`: position and velocity of the model under this force alone, with no feedback.
    - `information`: Fisher information of the free numbers, each in units of itself (of 1 if it is zero): the inverse
      is the covariance of the relative errors. Of the record alone, without any prior. Shape `[free, free]`.
    - `errors`: predicted standard errors by name, in the unit of the number; infinite where nothing is learned.
    - `correlation`: of the errors, shape `[free, free]`.
    """

    t: Float[np.ndarray, " time"]
    q_ref: Float[np.ndarray, " time"]
    qd_ref: Float[np.ndarray, " time"]
    force: Float[np.ndarray, " time"]
    q: Float[np.ndarray, " time"]
    qd: Float[np.ndarray, " time"]
    information: Float[np.ndarray, "free free"]
    errors: dict[str, float]
    correlation: Float[np.ndarray, "free free"]


@dataclass(frozen=True, kw_only=True)
class InputDesign:
    """An input that tells most about the numbers that are to be found, within limits.

    - `best`: the designed input.
    - `baseline`: the best single sine within the same limits and of the same duration.
    - `values`, `units`: the free numbers that it was designed for, and the unit of each that declares one.
    - `limits`: the `Limits`.
    - `noise`: standard deviation of a sample that was reckoned with.
    - `ending`: how the search ended.
    - `single_precision`: whether it was computed in float32.
    """

    best: Excitation
    baseline: Excitation
    values: dict[str, float]
    units: dict[str, str]
    limits: AxisLimits
    noise: float
    ending: str
    single_precision: bool

    @property
    def used(self) -> dict[str, float]:
        """Share of each limit that the input uses, at most 1, by its name."""
        best = self.best
        peaks = {
            "force": np.max(np.abs(best.force)),
            "speed": max(np.max(np.abs(best.qd_ref)), np.max(np.abs(best.qd))),
            "travel": max(np.max(np.abs(q - best.q_ref[0])) for q in (best.q_ref, best.q)),
        }
        return {name: float(peaks[name]) / value for name, (value, _) in self.limits.given.items()}

    @property
    def remarks(self) -> tuple[str, ...]:
        """What the design rests on and what it cannot do, in words."""
        remarks = []
        where = f"Within {self.limits}"
        for name, value in self.values.items():
            share = self.best.errors[name] / abs(value) if value else 0.0
            if not np.isfinite(self.best.errors[name]):
                remarks.append(f"{where}, {name} has no effect on the record.")
            elif share > _VAGUE:
                remarks.append(
                    f"{where}, {name} is not determined: its standard error would be {100 * share:.0f} % of its value."
                )
        names = list(self.values)
        for i, first in enumerate(names):
            for j in range(i):
                if abs(self.best.correlation[i, j]) > _ALIKE:
                    remarks.append(
                        f"{where}, {names[j]} and {first} can hardly be told apart (correlation"
                        f" {self.best.correlation[i, j]:+.3f})."
                    )
        full = [name for name, share in self.used.items() if share > _REACHED]
        if full:
            remarks.append(f"What limits it: {' and '.join(full)}.")
        off = float(np.max(np.abs(self.best.q - self.best.q_ref)))
        reach = float(np.max(np.abs(self.best.q_ref - self.best.q_ref[0])))
        if off > _OFF * reach:
            remarks.append(
                f"The force alone leaves the motion by up to {off:.2g} m even in the model: lead the axis by position"
                " and velocity, or choose a shorter dt."
            )
        if self.ending != "converged":
            remarks.append(f"The search {self.ending}: more steps or another seed may find a better input.")
        if self.single_precision:
            remarks.append("Computed in single precision: enable jax_enable_x64 for numbers that you mean to use.")
        return tuple(remarks)

    def rows(self) -> list[tuple[str, float, float, float, str]]:
        """Rows of a table: name, value, predicted standard error, that of the plain sine, unit."""
        return [
            (name, value, self.best.errors[name], self.baseline.errors[name], self.units[name])
            for name, value in self.values.items()
        ]

    def to_dict(self) -> dict[str, object]:
        """All but the samples, as JSON knows it: errors that are infinite are None."""
        return jsonable(
            {
                "duration": float(self.best.t[-1] - self.best.t[0]),
                "samples": len(self.best.t),
                "noise": self.noise,
                "limits": {name: value for name, (value, _) in self.limits.given.items()},
                "used": self.used,
                "parameters": {
                    name: {"value": value, "standard_error": error, "standard_error_of_a_sine": plain, "unit": unit}
                    for name, value, error, plain, unit in self.rows()
                },
                "information": {"names": list(self.values), "matrix": self.best.information.tolist()},
                "ending": self.ending,
                "remarks": list(self.remarks),
            }
        )

    def to_csv(self, path: str | Path) -> None:
        """Write `t` [s], `q_ref` [m], `qd_ref` [m/s], `force` [N] with a header line: the whole file or none.

        A drive that tracks a motion takes `q_ref` and `qd_ref`, with `force` as its feed-forward if it has one; for one
        that takes a force, `force` is held from each sample to the next. Record the force that was applied in fact.

        **Raises:**

        - `OSError` if the file cannot be written.
        """
        columns = np.column_stack([self.best.t, self.best.q_ref, self.best.qd_ref, self.best.force])
        with written_whole(path) as file:
            np.savetxt(file, columns, fmt="%.9g", delimiter=",", header="t,q_ref,qd_ref,force", comments="")

    def __str__(self) -> str:
        """A table of predicted errors against those of a plain sine, and remarks."""
        width = max(len(name) for name in self.values)
        lines = [f"{'':{width}}  {'value':>13}  {'std. error':>11}  {'in %':>8}  {'plain sine':>11}  unit"]
        for name, value, error, plain, unit in self.rows():
            share = f"{100 * error / abs(value):8.2g}" if value else f"{'-':>8}"
            lines.append(f"{name:{width}}  {value:13.6g}  {error:11.2g}  {share}  {plain:11.2g}  {unit}")
        used = ", ".join(f"{name} {100 * share:.0f} %" for name, share in self.used.items())
        span = f"{len(self.best.t)} samples, {self.best.t[-1] - self.best.t[0]:g} s, noise {self.noise:g}; used: {used}"
        return "\n".join([*lines, span, *self.remarks])
