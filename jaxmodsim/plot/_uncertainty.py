"""Figures of sensitivities, profile likelihoods and posteriors."""

import numpy as np
from matplotlib.axes import Axes
from scipy import special

from ..analysis import Sensitivity
from ..identify import Posterior, Profile
from ..sweeps import GlobalSensitivity
from ._style import BLUE, COLOURS, GREEN, GREY, RED, Figure, legend_beside, panel_letters, with_unit

# Axis labels of the indices of `GlobalSensitivity`.
_AXES = {
    "S1": "share of the variance [1]; pale: with all interactions",
    "mu_star": "mean magnitude of the change over the whole range of the parameter",
}


def sensitivity_figure(sensitivity: Sensitivity, *, most: int = 8) -> Figure:
    """Plot the observable, its normalised sensitivities along the run, and their ranking as bars.

    **Arguments:**

    - `sensitivity`: from `jaxmodsim.sensitivity`. An observable that is no function of time has bars alone.
    - `most`: largest number of parameters, taken from the top of the ranking.

    **Returns:**

    A matplotlib figure, which a notebook shows; `figure.savefig(path)` writes it.
    """
    ranking = sensitivity.ranking[:most]
    colours = {name: COLOURS[i % len(COLOURS)] for i, (name, _) in enumerate(ranking)}
    styles = {name: ("-", "--", ":", "-.")[i // len(COLOURS) % 4] for i, name in enumerate(colours)}
    height = 0.9 + 0.32 * len(ranking)
    if sensitivity.over_time:
        figure = Figure(figsize=(10, 5.2 + height), layout="constrained")
        above, middle, below = figure.subplots(3, 1, height_ratios=(1.6, 3.2, height))
        above.plot(sensitivity.t, sensitivity.observable, color=GREY, lw=1.6)
        above.set(ylabel=with_unit(sensitivity.label, sensitivity.unit), title=f"Sensitivity of {sensitivity.label}")
        above.tick_params(labelbottom=False)
        above.sharex(middle)
        for name, _ in ranking:
            middle.plot(
                sensitivity.t, sensitivity.normalised[name], color=colours[name], ls=styles[name], lw=1.3, label=name
            )
        middle.axhline(0.0, color=GREY, lw=0.6)
        middle.set(xlabel="time [s]", ylabel=f"p d({sensitivity.label})/dp\nover its rms [1]")
        legend_beside(middle)
        panel_letters((above, middle, below))
    else:
        figure = Figure(figsize=(8, 0.4 + height), layout="constrained")
        below: Axes = figure.subplots()
        below.set(title=f"Sensitivity of {sensitivity.label}")
    for i, (name, size) in enumerate(ranking):
        below.barh(i, size, color=colours[name])
        below.text(size, i, f" {size:.3g}", va="center", fontsize=8)
    below.set_yticks(
        range(len(ranking)),
        [f"{n} = {sensitivity.values[n]:.4g} {sensitivity.units.get(n, '')}".rstrip() for n, _ in ranking],
    )
    below.margins(x=0.12)
    below.set(xlabel="rms of relative change of the observable per relative change of the parameter [1]")
    below.invert_yaxis()
    return figure


def indices_figure(sensitivity: GlobalSensitivity, *, caption: str = "") -> Figure:
    """Indices as bars with their confidence intervals, a panel for each observable.

    **Arguments:**

    - `sensitivity`: from `jaxmodsim.sweeps.global_sensitivity`.
    - `caption`: a line below.

    **Returns:**

    A matplotlib figure, which a notebook shows; `figure.savefig(path)` writes it.
    """
    index, names = "S1" if sensitivity.method == "sobol" else "mu_star", sensitivity.names
    panels, at = sensitivity.indices, np.arange(len(names))
    figure = Figure(figsize=(9, 1.2 + len(panels) * (0.6 + 0.24 * len(names))), layout="constrained")
    for axis, (name, indices) in zip(figure.subplots(len(panels), 1, squeeze=False).flat, panels.items(), strict=True):
        values, errors = indices.values, indices.errors
        if "ST" in values:
            axis.barh(at, values["ST"], 0.72, color=BLUE, alpha=0.3)
            axis.errorbar(values["ST"], at, xerr=errors["ST"], fmt="none", ecolor=GREY, lw=0.8)
        axis.barh(at, values[index], 0.72, color=BLUE)
        axis.errorbar(values[index], at, xerr=errors[index], fmt="none", ecolor="black", capsize=2, lw=1.0)
        for y in at[np.isnan(values[index])]:
            axis.text(0.0, y, " too few runs", va="center", fontsize=7, color=BLUE)
        axis.set_yticks(at, names, fontsize=9)
        axis.set_ylim(len(names) - 0.5, -0.5)
        axis.axvline(0.0, color=GREY, lw=0.6)
        axis.grid(axis="x", alpha=0.3)
        axis.set_title(name, loc="left", fontsize=10)
        label = _AXES[index] if index == "S1" else with_unit(_AXES[index], sensitivity.units.get(name, ""))
        axis.set_xlabel(label, fontsize=8)
    method = "Sobol' indices" if sensitivity.method == "sobol" else "Elementary effects"
    below = f"\n{caption}" if caption else ""
    interval = f"{100 * sensitivity.confidence:.0f} % intervals"
    figure.suptitle(f"{method} from {sensitivity.runs['result'].size} runs, {interval}{below}", fontsize=11)
    return figure


def profile_figure(profile: Profile) -> Figure:
    """Plot the profile likelihood of a parameter, and the other parameters along it.

    **Arguments:**

    - `profile`: from `jaxmodsim.identify.profile`.

    **Returns:**

    A matplotlib figure, which a notebook shows; `figure.savefig(path)` writes it.
    """
    others = {name: x for name, x in profile.others.items() if x.size}
    figure = Figure(figsize=(8, 4.0 + (2.6 if others else 0.0)), layout="constrained")
    axes = figure.subplots(2 if others else 1, 1, sharex=True, squeeze=False)[:, 0]
    above = axes[0]
    above.plot(profile.values, profile.ratio, color=BLUE, marker=".", label="profile")
    if np.isfinite(profile.error) and profile.error > 0:
        low, over = profile.floor or 0.0, profile.estimate - (profile.floor or 0.0)
        if profile.floor is None:
            x = np.linspace(profile.values[0], profile.values[-1], 200)
            shift = x - profile.estimate
        else:
            x = low + np.geomspace(profile.values[0] - low, profile.values[-1] - low, 200)
            shift = over * np.log((x - low) / over)
        above.plot(x, (shift / profile.error) ** 2, color=GREY, ls="--", lw=1.0, label="linear model (standard error)")
    above.axhline(profile.threshold, color=RED, lw=1.0, label=f"{100 * profile.level:g} % level")
    low, high = (min(max(x, profile.values[0]), profile.values[-1]) for x in profile.interval)
    above.axvspan(low, high, color=GREEN, alpha=0.15, lw=0, label="interval")
    top = max(1.6 * profile.threshold, 1.05 * float(np.min(profile.ratio[[0, -1]])))
    above.set(ylim=(min(-0.03 * top, float(np.min(profile.ratio))), top), ylabel="likelihood ratio")
    above.set_title("\n".join([f"Profile of {profile.name}", *profile.notes]), fontsize=10)
    legend_beside(above)
    here = int(np.argmin(np.abs(profile.values - profile.estimate)))
    for (name, x), colour in zip(others.items(), COLOURS * len(others), strict=False):
        scale = abs(x[here]) or 1.0
        axes[-1].plot(profile.values, 100 * (x - x[here]) / scale, color=colour, marker=".", ms=4, lw=1.0, label=name)
    if others:
        axes[-1].set_ylabel("others, change [%]")
        if max(float(np.max(np.abs(x / (x[here] or 1.0) - 1))) for x in others.values()) > 10:
            axes[-1].set_yscale("symlog", linthresh=10.0)
        legend_beside(axes[-1])
        panel_letters(axes)
    ratio = profile.values[-1] / profile.values[0] if profile.values[0] > 0 else 0.0
    if ratio > 20:
        above.set_xscale("log")
    axes[-1].set_xlabel(with_unit(profile.name, profile.unit))
    return figure


def posterior_figure(posterior: Posterior) -> Figure:
    """Draw a corner plot: samples of each unknown and each pair, over the normal distribution of the fit.

    **Arguments:**

    - `posterior`: from `jaxmodsim.identify.sample_posterior`. Only its first ten unknowns are drawn.

    **Returns:**

    A matplotlib figure, which a notebook shows; `figure.savefig(path)` writes it.
    """
    names, estimate = list(posterior.draws)[:10], posterior.estimate
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
                _histogram(axis, posterior, a)
            else:
                axis.plot(posterior.draws[b].ravel(), posterior.draws[a].ravel(), ",", color=BLUE, alpha=0.6)
                if a in fitted and b in fitted:
                    k = [fitted.index(b), fitted.index(a)]
                    _ellipse(axis, values[k], estimate.covariance[np.ix_(k, k)])
            _label_edges(axis, posterior, names, i, j)
    axes[0, 0].plot([], [], color=BLUE, label="posterior")
    axes[0, 0].plot([], [], color=RED, label="fit, standard errors")
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="upper right")
    return figure


def _histogram(axis: Axes, posterior: Posterior, name: str) -> None:
    draws, estimate = posterior.draws[name].ravel(), posterior.estimate
    axis.hist(draws, bins=30, density=True, color=BLUE, alpha=0.5)
    axis.set_yticks([])
    error = estimate.errors.get(name, np.inf)
    if np.isfinite(error) and error > 0:
        x = np.linspace(draws.min(), draws.max(), 200)
        axis.plot(x, np.exp(-0.5 * ((x - estimate.values[name]) / error) ** 2) / error / np.sqrt(2 * np.pi), color=RED)


def _ellipse(axis: Axes, centre: np.ndarray, covariance: np.ndarray) -> None:
    """Draw the ellipse that contains 95 % of a bivariate normal distribution."""
    if not np.isfinite(covariance).all():
        return
    values, vectors = np.linalg.eigh(covariance)
    angle = np.linspace(0.0, 2 * np.pi, 100)
    radius = np.sqrt(special.chdtri(2, 0.05) * np.maximum(values, 0.0))
    axis.plot(*(centre[:, None] + vectors @ (radius[:, None] * np.array([np.cos(angle), np.sin(angle)]))), color=RED)


def _label_edges(axis: Axes, posterior: Posterior, names: list[str], i: int, j: int) -> None:
    """Write names at the left and lower edges of the figure, with two ticks each."""
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
