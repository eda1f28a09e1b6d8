"""Estimates of what parameters do to a number, from runs at chosen points of the unit cube."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from .._core.system import extra

# Runs, and elementary effects of a parameter, below which a class is too small for indices of its own.
_LEAST_RUNS, _LEAST_EFFECTS = 128, 8


class Estimate(NamedTuple):
    """Indices of one quantity over some runs, each of shape `[parameters]`; NaN where there is no telling.

    - `indices`: by name. By variance `S1`, the part of the variance that goes with a parameter alone, and `ST`, the
      part that goes with it in any way; by elementary effects `mu_star`, the mean size of the change of the quantity
      over the whole range of a parameter, `mu`, the same with its sign, and `sigma`, the standard deviation.
    - `errors`: half widths of their intervals, by the same names.
    - `samples`: runs (by variance) or elementary effects of each parameter that they rest on.
    """

    indices: dict[str, Float[np.ndarray, " parameters"]]
    errors: dict[str, Float[np.ndarray, " parameters"]]
    samples: Float[np.ndarray, " parameters"]


@dataclass(frozen=True)
class SobolDesign:
    """Saltelli's design: blocks of D + 2 points, which are two independent ones and D of the first with one coordinate
    of the second; the independent ones come first and last.

    - `points`: shape `[runs, parameters]`.
    """

    points: Float[np.ndarray, "runs parameters"]
    confidence: float
    seed: int

    @property
    def block(self) -> int:
        """Runs that can only be used together."""
        return self.points.shape[1] + 2

    def overall(self, y: Float[np.ndarray, " runs"], use: Bool[np.ndarray, " runs"]) -> Estimate:
        """First and total indices from all whole blocks."""
        d = self.points.shape[1]
        whole = np.repeat(use.reshape(-1, self.block).all(axis=1), self.block)
        samples = np.full(d, float(whole.sum()))
        y = y[whole]
        if y.size < 2 * self.block or constant(y):
            return _nothing(("S1", "ST"), d, samples)
        # SALib takes the seed 0 for none.
        analysis = extra("SALib.analyze.sobol").analyze(
            _problem(d), y, calc_second_order=False, conf_level=self.confidence, seed=self.seed + 1
        )
        indices, errors = ({x: analysis[f"{x}{of}"] for x in ("S1", "ST")} for of in ("", "_conf"))
        return Estimate(indices, errors, samples)

    def within(self, y: Float[np.ndarray, " runs"], use: Bool[np.ndarray, " runs"]) -> Estimate:
        """First indices from the independent points, the first and last of each block, that are used.

        By random balance designs on given data (Plischke 2010, Reliab. Eng. Syst. Saf. 95:354; bias taken out as by
        Tissot and Prieur 2012, ibid. 107:205). The intervals, from resamples of half the size, are two to four times as
        wide as the scatter of the estimate.
        """
        d = self.points.shape[1]
        place = np.arange(y.size) % self.block
        use = use & ((place == 0) | (place == self.block - 1))
        samples = np.full(d, float(use.sum()))
        if use.sum() < _LEAST_RUNS or constant(y[use]):
            return _nothing(("S1",), d, samples)
        analysis = extra("SALib.analyze.rbd_fast").analyze(
            _problem(d), self.points[use], y[use], conf_level=self.confidence, seed=self.seed
        )
        return Estimate({"S1": np.asarray(analysis["S1"])}, {"S1": np.asarray(analysis["S1_conf"])}, samples)


@dataclass(frozen=True)
class MorrisDesign:
    """Trajectories of D + 1 points, each of which differs from the one before in one parameter.

    - `points`: shape `[runs, parameters]`.
    """

    points: Float[np.ndarray, "runs parameters"]
    confidence: float
    seed: int

    @property
    def block(self) -> int:
        """Runs that can only be used together."""
        return self.points.shape[1] + 1

    def overall(self, y: Float[np.ndarray, " runs"], use: Bool[np.ndarray, " runs"]) -> Estimate:
        """Mean, mean size and scatter of the elementary effects between points that are both used.

        Of a mean size the interval is that of a mean of independent trajectories.
        """
        d = self.points.shape[1]
        effects, both = self._effects(np.where(use, y, 0.0), use)
        samples = both.sum(axis=0).astype(float)
        result = {name: np.full(d, np.nan) for name in ("mu_star", "mu", "sigma")}
        error = np.full(d, np.nan)
        for j in range(d):
            some = effects[both[:, j], j]
            if some.size < _LEAST_EFFECTS:
                continue
            values = np.abs(some).mean(), some.mean(), some.std(ddof=1)
            for name, value in zip(result, values, strict=True):
                result[name][j] = value
            error[j] = _normal(self.confidence) * np.abs(some).std(ddof=1) / np.sqrt(some.size)
        return Estimate(result, {"mu_star": error}, samples)

    within = overall

    def crossings(
        self, label: Float[np.ndarray, " runs"], use: Bool[np.ndarray, " runs"]
    ) -> Float[np.ndarray, " parameters"]:
        """Share of the steps of each parameter that lead into another class."""
        change, both = self._effects(np.where(use, label, 0.0), use)
        return ((change != 0) & both).sum(axis=0) / np.maximum(both.sum(axis=0), 1)

    def _effects(self, y: np.ndarray, use: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Change of y over change of the parameter for each step, and whether both ends count: `[trajectories, D]`."""
        d = self.points.shape[1]
        steps = np.diff(self.points.reshape(-1, d + 1, d), axis=1)
        which = np.argmax(np.abs(steps), axis=2)
        size = np.take_along_axis(steps, which[..., None], axis=2)[..., 0]
        order = np.argsort(which, axis=1)
        use = use.reshape(-1, d + 1)
        effects, both = np.diff(y.reshape(-1, d + 1), axis=1) / size, use[:, 1:] & use[:, :-1]
        return np.take_along_axis(effects, order, axis=1), np.take_along_axis(both, order, axis=1)


def sobol_design(parameters: int, count: int, confidence: float, seed: int) -> SobolDesign:
    """Saltelli's design from scrambled Sobol' points."""
    points = extra("SALib.sample.sobol").sample(_problem(parameters), count, calc_second_order=False, seed=seed)
    return SobolDesign(points, confidence, seed)


def morris_design(parameters: int, count: int, confidence: float, seed: int) -> MorrisDesign:
    """Morris's design on four levels."""
    return MorrisDesign(extra("SALib.sample.morris").sample(_problem(parameters), count, seed=seed), confidence, seed)


def _problem(parameters: int) -> dict[str, object]:
    """What SALib calls a problem: the unit cube."""
    names = [f"x{i}" for i in range(parameters)]
    return {"num_vars": parameters, "names": names, "bounds": [[0.0, 1.0]] * parameters}


def constant(y: np.ndarray) -> bool:
    """Whether numbers are the same but for rounding."""
    return bool(np.ptp(y) <= 1e-12 * np.abs(y).max(initial=0.0))


def _nothing(names: tuple[str, ...], parameters: int, samples: np.ndarray) -> Estimate:
    empty = {name: np.full(parameters, np.nan) for name in names}
    return Estimate(empty, empty, samples)


def _normal(confidence: float) -> float:
    """Half width of an interval in standard errors."""
    from scipy.special import ndtri

    return float(ndtri(0.5 + 0.5 * confidence))
