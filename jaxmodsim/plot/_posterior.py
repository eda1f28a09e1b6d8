"""Samples of a posterior, pair by pair."""

import numpy as np
from matplotlib.axes import Axes
from scipy import special

from ..identify import Posterior
from ._figure import Figure
from ._style import BLUE, RED, with_unit

# Unknowns beside which a figure becomes illegible.
_MOST = 10


def posterior_figure(posterior: Posterior) -> Figure:
    """A corner plot: how often each unknown and each pair was drawn, over what the covariance of the fit says.

    **Arguments:**

    - `posterior`: from `jaxmodsim.identify.sample_posterior`; its first ten unknowns are drawn.
    """
    names, estimate = list(posterior.draws)[:_MOST], posterior.estimate
    fitted, values = list(estimate.values), np.array([*estimate.values.values()])
    n = len(names)
    figure = Figure(figsize=(1.5 + 1.35 * n, 1.2 + 1.35 * n), layout="constrained")
    axes = figure.subplots(n, n, squeeze=False)
    for i, a in enumerate(names):
        for j, b in enumerate(names):
            axis = axes[i, j]
            if j > i:
                axis.set_axis_off()
                continue
            if i == j:
                _one(axis, posterior, a)
            else:
                axis.plot(posterior.draws[b].ravel(), posterior.draws[a].ravel(), ",", color=BLUE, alpha=0.6)
                if a in fitted and b in fitted:
                    k = [fitted.index(b), fitted.index(a)]
                    _ellipse(axis, values[k], estimate.covariance[np.ix_(k, k)])
            _label(axis, posterior, names, i, j)
    axes[0, 0].plot([], [], color=BLUE, label="posterior")
    axes[0, 0].plot([], [], color=RED, label="fit, standard errors")
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="upper right")
    return figure


def _one(axis: Axes, posterior: Posterior, name: str) -> None:
    draws, estimate = posterior.draws[name].ravel(), posterior.estimate
    axis.hist(draws, bins=30, density=True, color=BLUE, alpha=0.5)
    axis.set_yticks([])
    error = estimate.errors.get(name, np.inf)
    if np.isfinite(error) and error > 0:
        x = np.linspace(draws.min(), draws.max(), 200)
        axis.plot(x, np.exp(-0.5 * ((x - estimate.values[name]) / error) ** 2) / error / np.sqrt(2 * np.pi), color=RED)


def _ellipse(axis: Axes, centre: np.ndarray, covariance: np.ndarray) -> None:
    """What holds 95 % of a normal distribution in the plane."""
    if not np.isfinite(covariance).all():
        return
    values, vectors = np.linalg.eigh(covariance)
    angle = np.linspace(0.0, 2 * np.pi, 100)
    radius = np.sqrt(special.chdtri(2, 0.05) * np.maximum(values, 0.0))
    axis.plot(*(centre[:, None] + vectors @ (radius[:, None] * np.array([np.cos(angle), np.sin(angle)]))), color=RED)


def _label(axis: Axes, posterior: Posterior, names: list[str], i: int, j: int) -> None:
    """Names at the left and lower edges only; two ticks each."""
    units = posterior.estimate.units
    axis.tick_params(labelsize=6)
    axis.locator_params(nbins=2)
    axis.ticklabel_format(useOffset=False)
    if i == len(names) - 1:
        axis.set_xlabel(with_unit(names[j], units.get(names[j], "")), fontsize=7)
        axis.tick_params(axis="x", labelrotation=30)
    else:
        axis.set_xticklabels([])
    if j == 0 and i > 0:
        axis.set_ylabel(with_unit(names[i], units.get(names[i], "")), fontsize=7)
    elif i != j:
        axis.set_yticklabels([])
