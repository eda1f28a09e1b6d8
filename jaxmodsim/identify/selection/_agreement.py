"""Whether records agree: each fitted by itself, parameter by parameter."""

import dataclasses
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ..estimate._search import SearchOptions, solve
from ..uncertainty._estimate import covariance_of
from ..uncertainty._result import FitResult


@dataclass(frozen=True, kw_only=True)
class RecordAgreement:
    """Whether the parameters of a model are the same in several records.

    - `records`, `names`: of the records and of the parameters.
    - `values`, `errors`: of each parameter in a fit to each record alone, and its standard error (residuals correlated
      in time allowed for), shape `[records, parameters]`.
    - `p`: probability that values which are the same come out at least as different, shape `[parameters]`; NaN of a
      parameter that some record does not determine or that ends at a limit.
    - `level`: probability with which any parameter at all is said to differ where none does.
    """

    records: tuple[str, ...]
    names: tuple[str, ...]
    values: Float[np.ndarray, "records parameters"]
    errors: Float[np.ndarray, "records parameters"]
    p: Float[np.ndarray, " parameters"]
    level: float

    @property
    def differing(self) -> tuple[str, ...]:
        """Names of the parameters that differ, at `level` for all together (Holm 1979, Scand. J. Statist. 6:65)."""
        known = [i for i in np.argsort(self.p) if np.isfinite(self.p[i])]
        found = []
        for rank, i in enumerate(known):
            if self.p[i] > self.level / (len(known) - rank):
                break
            found.append(self.names[i])
        return tuple(found)

    @property
    def sentences(self) -> tuple[str, ...]:
        """One for each parameter that differs."""
        lines = []
        for name in self.differing:
            x = self.values[:, self.names.index(name)]
            share = 100 * np.ptp(x) / np.max(np.abs(x))
            p = self.p[self.names.index(name)]
            each = ", ".join(f"{value:.4g} in {record}" for value, record in zip(x, self.records, strict=True))
            lines.append(f"The records differ in {name} by {share:.2g} %: {each} (p = {p:.1g}).")
        return tuple(lines)

    def __str__(self) -> str:
        """What differs, and what does not as far as the records show."""
        lines = [*self.sentences]
        others = [
            name for name, p in zip(self.names, self.p, strict=True) if name not in self.differing and np.isfinite(p)
        ]
        if others:
            lines.append(f"They do not show a difference in {', '.join(others)}.")
        return "\n".join(lines)


def agreement(result: FitResult, *, level: float = 0.05, max_steps: int = 100) -> RecordAgreement:
    """Fit each record by itself, from the fit to all, and test whether the parameters are the same.

    For each parameter the sum of squared distances from its weighted mean, in standard errors, is held against its
    distribution (chi-squared, one degree of freedom less than there are records).

    **Arguments:**

    - `result`: a fit to several records, each run as a whole, that was not loaded from a file.
    - `level`: probability of a false alarm, 0 < level < 1.
    - `max_steps`: limit of the iterations of each fit.

    **Returns:**

    An `RecordAgreement`.

    **Raises:**

    - `ValueError` for one record, records in windows, a loaded result, or a level out of range.
    - `RuntimeError` where the fit to a record ends with values that are not finite.
    """
    from scipy.stats import chi2  # most of a second to import, and only needed here

    records = tuple(record.name for record in result.provenance.records)
    if result.search is None:
        raise ValueError("Agreement needs what the fit observed, which a loaded result does not have: fit again.")
    problem = result.search.problem
    if len(records) < 2 or problem.count != len(records):
        raise ValueError(
            f"Agreement needs a fit to several whole records, but {len(records)} were fitted in {problem.count} parts."
        )
    if not 0 < level < 1:
        raise ValueError(f"level must lie between 0 and 1, but it is {level!r}.")
    shared, own = problem.split(result.search.state.x)
    fits = []
    for i, record in enumerate(records):
        base, runs = jax.tree.map(lambda leaf, i=i: leaf[i : i + 1], (problem.base, problem.runs))
        alone = dataclasses.replace(problem, base=base, runs=runs)
        search = solve(alone, jnp.concatenate([shared, own[i]]), SearchOptions(max_steps=max_steps))
        if not bool(jnp.isfinite(search.state.cost)):
            raise RuntimeError(f"The fit to {record} alone ended with values that are not finite.")
        covariance = covariance_of(alone, search.state, len(problem.free.names)).covariance
        value = np.asarray(problem.free.vector(search.state.x[: len(problem.free.names)]))
        limits = problem.free.limits(search.state.x[: len(problem.free.names)])
        at_limit = [x in limits[name] for name, x in zip(problem.free.names, value.tolist(), strict=True)]
        fits.append((value, np.where(at_limit, np.nan, np.sqrt(np.diag(np.asarray(covariance))))))
    values, errors = (np.stack(each) for each in zip(*fits, strict=True))
    with np.errstate(divide="ignore", invalid="ignore"):
        weight = 1.0 / errors**2
        mean = np.sum(weight * values, axis=0) / np.sum(weight, axis=0)
        p = chi2.sf(np.sum(weight * (values - mean) ** 2, axis=0), len(records) - 1)
    known = np.all(np.isfinite(errors) & (errors > 0), axis=0)
    return RecordAgreement(
        records=records,
        names=problem.free.names,
        values=values,
        errors=errors,
        p=np.where(known, p, np.nan),
        level=level,
    )
