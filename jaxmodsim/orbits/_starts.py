"""First orbits of branches that begin on another branch, at a period doubling or a Hopf point."""

import jax.numpy as jnp
import numpy as np

from ..scene import Scene, replace_elements
from ._branch import DOUBLING, HOPF, BifurcationPoint
from ._equilibrium import Equilibrium, nearest_oscillation, prepare_rest, rest_scale
from ._neutral import anchored
from ._newton import Condition, newton
from ._orbit import PeriodicOrbit, describe
from ._orbit_step import OrbitStep, step_at
from ._periodic_orbit import MultipleOfPeriod, prepare
from ._rest import rest_at
from ._return_map import OrbitError, OrbitProblem, PeriodFn, Section, SettledState, ShotOrbit, pack

# First step to the orbits of twice the period, relative to the extent of the orbit.
_BESIDE = 0.02
# Smallest amplitude of the first orbit at a Hopf point, relative to the size of the state. It is doubled until the
# parameter or the period has changed by the second number, relative to span or period, and reduced beyond the third.
_LEAST, _CHANGE, _FAR, _TRIES = 1e-3, 1e-3, 1e-2, 16
# Relative size of the entries of an eigenvector that count as zero.
_STILL = 1e-9


def first_step(
    scene: Scene,
    point: BifurcationPoint,
    parameter: str,
    span: tuple[float, float],
    period: float | PeriodFn | None,
    section: Section | None,
    rtol: float,
    atol: float,
) -> OrbitStep:
    """The first orbit of the branch that begins at a bifurcation.

    **Raises:**

    - `ValueError` if none begins there; `OrbitError` if it is not found.
    """
    orbit = point.orbit
    if (DOUBLING if isinstance(orbit, PeriodicOrbit) else HOPF) != point.kind:
        raise ValueError(f"Another branch starts at a period doubling or a Hopf point, but a {point.kind} was given.")
    if not min(span) <= point.value <= max(span):
        raise ValueError(
            f"The branch starts at {parameter} = {point.value:.6g}, which must be within span, but {span} was given."
        )
    at_point, length = replace_elements(scene, {parameter: point.value}), abs(span[1] - span[0])
    if isinstance(orbit, PeriodicOrbit):
        doubled = None if period is None else MultipleOfPeriod(period, 2.0)
        problem, start, dof = prepare(at_point, orbit, doubled, section, None, rtol, atol, (parameter,))
        return _doubled(problem, start, point, length, dof)
    if period is not None or section is not None:
        raise ValueError(
            "The period and the start of orbits at a Hopf point are computed: pass neither period nor section."
        )
    return _at_hopf_point(at_point, point, parameter, length, (rtol, atol))


def _doubled(
    problem: OrbitProblem, start: SettledState, point: BifurcationPoint[PeriodicOrbit], span: float, dof: int
) -> OrbitStep:
    """The first orbit of twice the period, in the direction of a period doubling."""
    twice = 2.0 * start.period if problem.autonomous else start.period
    n, scale = start.x.size, start.scale.copy()
    scale[-1] = span
    if problem.autonomous:
        scale[n] = twice
    tangent = np.zeros(len(scale))
    tangent[:n] = point.direction / scale[:n]
    tangent /= np.linalg.norm(tangent)
    shot = newton(problem, start.x, twice, np.array([point.value]), dof, scale)[0]
    at_point = OrbitStep(problem, shot, point.orbit, scale, tangent)
    return at_point.moved_to(at_point.corrected(_BESIDE)[0])


def _at_hopf_point(
    scene: Scene, point: BifurcationPoint[Equilibrium], parameter: str, span: float, tolerances: tuple[float, float]
) -> OrbitStep:
    """A small orbit at a Hopf point, which begins on the real part of the eigenvector."""
    rest, dof = point.orbit, len(point.orbit.q)
    centre, (wave, extent), born = np.asarray(pack(rest.state)), _wave(scene, rest), rest.period
    n, (rtol, atol) = len(centre), map(jnp.asarray, tolerances)
    problem = OrbitProblem(scene, jnp.zeros(()), rtol, atol, None, None, (parameter,))
    along = wave / extent
    row = np.append(along / (along @ along), [0.0, 0.0])
    first: OrbitStep | None = None
    x, period, value, amplitude = centre + _LEAST * wave, born, point.value, _LEAST
    for _ in range(_TRIES):
        scale = np.append(amplitude * extent, [period, span])

        def on_wave(shot: ShotOrbit, scale: np.ndarray = scale) -> float:
            return float(row[:n] @ ((shot.x[0] - centre) / scale[:n])) - 1.0

        try:
            here, _ = anchored(problem, SettledState(x[None, :], np.zeros(1), period, scale, ()), dof)
            condition = Condition(on_wave, lambda _: row)
            shot, _ = newton(here, x[None, :], period, np.array([value]), dof, scale, (condition,))
            change = max(abs(shot.value - point.value) / span, abs(shot.period / born - 1.0))
            if change > _FAR:
                raise OrbitError("The orbit is not near the Hopf point.")
        except OrbitError:
            if first is not None:
                return first
            amplitude *= 0.1
            x, period, value = centre + amplitude * wave, born, point.value
            continue
        sense = np.append(shot.x[0] - centre, [0.0, 0.0])
        first = step_at(here, shot, describe(here, shot, dof)[0], np.array([span]), sense)
        if change > _CHANGE:
            return first
        # Parameter and period change with the square of the amplitude.
        amplitude, x = 2.0 * amplitude, centre + 2.0 * (shot.x[0] - centre)
        period, value = 4.0 * shot.period - 3.0 * born, 4.0 * shot.value - 3.0 * point.value
    if first is None:
        raise OrbitError("No orbit is found near the Hopf point: the equations may not be smooth there.")
    return first


def _wave(scene: Scene, rest: Equilibrium) -> tuple[np.ndarray, np.ndarray]:
    """Displacement of the state in the small oscillation at a Hopf point, and the extent of each entry.

    A coordinate moves by its size. The phase is that with the largest displacement of the state.
    """
    x, dof = np.asarray(pack(rest.state)), len(rest.q)
    problem = prepare_rest(scene, rest.q, None, None)[0]
    size = rest_scale(x, dof, 1.0)[:-1]
    point = rest_at(problem, x, 0.0, dof)
    values, vectors = np.linalg.eig(point.linearised)
    wave = point.basis @ vectors[:, np.argmin(np.abs(values - nearest_oscillation(values.astype(complex))))]
    wave = wave / np.max(np.abs(wave[:dof]) / size[:dof])
    extent = np.where(np.abs(wave) > _STILL * np.max(np.abs(wave)), np.abs(wave), size)
    phase = 0.5 * np.angle(np.sum((wave / extent) ** 2))
    return np.real(wave * np.exp(-1j * phase)), extent
