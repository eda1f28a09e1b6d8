"""What a record cannot tell, in words: a few sentences, the most important first."""

from typing import TYPE_CHECKING

import numpy as np

from ._directions import weak_directions
from ._solve import ENDINGS

if TYPE_CHECKING:
    from ._result import FitResult

# Relative errors and correlations from which on a parameter is called uncertain, in looking for a cause.
_UNCERTAIN, _ALIKE = 0.1, 0.98
# Standard error against the value from which on a parameter is called not determined, and how many pairs are named.
_UNKNOWN, _PAIRS = 0.5, 4
# Share of the scatter of a channel from which on an RMSE says that nothing is followed.
_FOLLOWS = 0.95


def remarks_of(result: "FitResult") -> tuple[str, ...]:
    """Sentences on what spoils the figures, on what is not determined, and why.

    What a cause in the motion, or a weak combination, has explained is not said again of each parameter and pair.
    """
    explained = {name for cause in result.causes for name in cause.about}
    remarks = [*_of_the_search(result)]
    remarks += [
        f"{name} has no effect on this record." for name in result.values if not np.isfinite(result.errors[name])
    ]
    remarks += [cause.sentence for cause in result.causes]
    for name, value in result.values.items():
        if np.isfinite(result.errors[name]) and value in result.bounds[name]:
            remarks.append(f"{name} ended on its limit {value:g}.")
    directions = weak_directions(result, explained)
    remarks += [direction.sentence for direction in directions]
    told = explained | {name for direction in directions for name in direction.names}
    for name, value in result.values.items():
        share = result.errors[name] / abs(value) if value else np.inf
        if _UNKNOWN < share < np.inf and value not in result.bounds[name] and name not in told:
            remarks.append(
                f"{name} is not determined by this record: its standard error is {100 * share:.0f} % of its value."
            )
    pairs = [(a, b, c) for a, b, c in _alike(result) if not {a, b} <= told]
    for a, b, c in pairs[:_PAIRS]:
        remarks.append(f"{a} and {b} are hardly told apart (correlation {c:+.3f}).")
    if len(pairs) > _PAIRS:
        remarks.append(f"{len(pairs) - _PAIRS} more pairs have correlations as large: see `correlation`.")
    if result.single_precision:
        remarks.append("Computed in single precision: enable jax_enable_x64 for numbers that you mean to use.")
    return tuple(remarks)


def uncertain_of(result: "FitResult") -> dict[str, tuple[str, ...]]:
    """Parameters that are not well known, each with those that it is hardly told apart from."""
    pairs, found = _alike(result), {}
    for name, value in result.values.items():
        others = tuple(b if a == name else a for a, b, _ in pairs if name in (a, b))
        if others or not result.errors[name] < _UNCERTAIN * abs(value) or value in result.bounds[name]:
            found[name] = others
    return found


def _of_the_search(result: "FitResult") -> list[str]:
    remarks = []
    if result.ending not in ENDINGS.values():
        remarks.append(f"The search {result.ending}: do not trust the standard errors.")
    if result.step_error is not None and len(result.rmse_by) == 1 and result.step_error > 0.1 * result.rmse:
        remarks.append(
            f"The integration step shows: with four times as many the output moves by {result.step_error:.2g} (root"
            f" mean square) against an RMSE of {result.rmse:.2g}. Raise substeps."
        )
    for channel, rmse in result.rmse_by.items():
        columns = [record.channels[channel] for record in result.records if channel in record.channels]
        scatter = np.sqrt(np.mean(np.concatenate([x - np.mean(x) for x in columns]) ** 2)) if columns else 0.0
        if columns and rmse > _FOLLOWS * scatter > 0:
            remarks.append(
                f"{channel}: the model follows nothing of the record; its RMSE of {rmse:.2g} is no less than that of a"
                f" constant, {scatter:.2g}. Is the input the right column, has it the right sign and unit?"
            )
    return remarks


def _alike(result: "FitResult") -> list[tuple[str, str, float]]:
    """Pairs of parameters with a large correlation, the largest first."""
    names, correlation = list(result.values), result.correlation
    pairs = [
        (names[j], names[i], float(correlation[i, j]))
        for i in range(len(names))
        for j in range(i)
        if abs(correlation[i, j]) > _ALIKE
    ]
    return sorted(pairs, key=lambda pair: -abs(pair[2]))
