"""A profile likelihood."""

import numpy as np

from ..identify import Profile
from ._figure import Figure
from ._style import BLUE, COLOURS, GREEN, GREY, RED, legend_beside, panel_letters, with_unit


def profile_figure(profile: Profile) -> Figure:
    """The profile likelihood of a parameter, and the other parameters along it.

    **Arguments:**

    - `profile`: from `jaxmodsim.identify.profile`.
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
