"""The result of a fit: parameters, warnings on what the records do not determine, and its files."""

import io
import json
import math
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass, fields
from importlib import metadata
from os import PathLike
from pathlib import Path
from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Float

from ..._core.readable import AbstractReadable, Table, interval_text, table_of
from ..._core.system import jsonable, written_whole
from ..data._record import Record
from ..data._signals import resolution, sample_noise
from ..estimate._search import SearchResult, ended_by_itself
from ..model._parameters import with_numbers
from ._estimate import FitDiagnostics, FitProvenance, IdentifiabilityIssue, ParameterEstimate, correlated
from ._identifiability import sloppy_directions

# Relative standard error, and correlation, from which a parameter is uncertain, in the search for a cause.
_UNCERTAIN, _ALIKE = 0.1, 0.98
# Relative standard error from which a parameter is undetermined; number of pairs that are named.
_UNKNOWN, _PAIRS = 0.5, 4
# Share of the scatter of a channel from which the RMSE is that of a constant.
_FOLLOWS = 0.9
# Excess of the mean square error over the noise from sample to sample that is reported: at least this share, and so
# many times one over the root of the number of samples, which is four standard deviations of the ratio.
_EXCESS, _SCATTER = 0.2, 15.0
# More integration steps are asked for where they move a parameter by this share of its standard error, or the output by
# this share of the RMSE: standard errors contain the error of the steps.
_MOVES, _SHOWS, _TINY = 0.5, 0.1, 1e-300

_KIND, _VERSION, _TEXT = "jaxmodsim fit result", 2, "result.json"
_PARTS = {"estimate": ParameterEstimate, "diagnostics": FitDiagnostics, "provenance": FitProvenance}
# Functions are not saved.
_LEFT_OUT = ("model",)


@dataclass(frozen=True, kw_only=True, repr=False)
class FitResult(AbstractReadable):
    """A fitted model.

    - `estimate`: parameters with their covariance. `diagnostics`: of the fit. `provenance`: records and model.
    - `search`: the end of the search, which other functions start from; None in a result that was loaded.

    **Example:**

    ```python
    t = jnp.linspace(0.0, 2.0, 401)
    x = 1e-3 * jnp.sin(jnp.pi * t)
    force = jms.identify.law_force(jms.Dahl(sigma0=2e4, Fc=3.0), t, x)  # a synthetic record
    noisy = force + 0.1 * jax.random.normal(jax.random.key(0), t.shape)
    result = jms.fit_law(jms.Dahl(sigma0=1e4, Fc=2.0), jms.Record(t, noisy, {"x": x}))
    low, high = result.estimate.intervals()["Fc"]
    print(f"Fc between {low:.3f} and {high:.3f} N, residual {result.rmse:.3f} N")
    ```

    ```text
    Fc between 2.975 and 3.001 N, residual 0.102 N
    ```
    """

    estimate: ParameterEstimate
    diagnostics: FitDiagnostics
    provenance: FitProvenance
    search: SearchResult | None

    @property
    def values(self) -> dict[str, float]:
        """Parameters by name."""
        return self.estimate.values

    @property
    def errors(self) -> dict[str, float]:
        """Standard errors by name."""
        return self.estimate.errors

    @property
    def model(self) -> eqx.Module | None:
        """The scene or law with the fitted numbers; None in a result that was loaded without one."""
        return self.provenance.model

    @property
    def record(self) -> Record:
        """The record, if there is only one.

        **Raises:**

        - `ValueError` for several.
        """
        records = self.provenance.records
        if len(records) > 1:
            raise ValueError(f"{len(records)} records were fitted: read `provenance.records` instead.")
        return next(iter(records))

    @property
    def residuals(self) -> tuple[dict[str, np.ndarray], ...]:
        """Output less measured value by channel, one dict a record."""
        return self.provenance.residuals

    @property
    def simulated(self) -> Float[np.ndarray, " samples"]:
        """The model's output along the one channel of the one record.

        **Raises:**

        - `ValueError` if there are several.
        """
        residual = next(iter(self.residuals[0].values()))
        return self.record.measured + residual  # both refuse several

    @property
    def rmse(self) -> float:
        """Root mean square of `simulated - measured` of the one channel.

        **Raises:**

        - `ValueError` if there are several.
        """
        rmse = self.diagnostics.rmse
        if len(rmse) > 1:
            raise ValueError(f"There are the channels {', '.join(rmse)}: read `diagnostics.rmse` instead.")
        return next(iter(rmse.values()))

    def search_for(self, purpose: str) -> SearchResult:
        """The search, which a result that was loaded from a file does not have.

        **Raises:**

        - `ValueError` naming the purpose, for a loaded result.
        """
        if self.search is None:
            raise ValueError(f"{purpose} needs the search of the fit, which a loaded result does not have: fit again.")
        return self.search

    def save(self, path: str | PathLike[str]) -> None:
        """Write everything except the model's functions and the search into one file, atomically.

        A zip of one JSON text and of arrays (`numpy.load` opens it, too), in which all numbers are exact.
        """
        arrays: dict[str, np.ndarray] = {}
        parts = {name: value for part in _PARTS for name, value in vars(getattr(self, part)).items()}
        body = {name: _packed(x, name, arrays) for name, x in parts.items() if name not in _LEFT_OUT}
        head = {"kind": _KIND, "format": _VERSION, "jaxmodsim": metadata.version("jaxmodsim")}
        text = json.dumps({**head, "fields": body}, indent=1, allow_nan=False)
        with written_whole(path) as file, zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr(_TEXT, text)
            for name, array in arrays.items():
                buffer = io.BytesIO()
                np.lib.format.write_array(buffer, array, allow_pickle=False)
                archive.writestr(f"{name}.npy", buffer.getvalue())

    @staticmethod
    def load(path: str | PathLike[str], model: eqx.Module | None = None) -> "FitResult":
        """A result that `save` wrote. It cannot run the model, so `profile` and `evaluate_on` refuse it.

        **Arguments:**

        - `path`: of the file.
        - `model`: the fitted scene or law, with any numbers; the result has it with the fitted numbers.

        **Raises:**

        - `ValueError` for a damaged or a different file, or a model with numbers of other names.
        - `OSError` if the file cannot be read.
        """
        names = {part: [field.name for field in fields(kind)] for part, kind in _PARTS.items()}
        stored = _read_fields(path, [name for own in names.values() for name in own if name not in _LEFT_OUT])
        stored["model"] = None if model is None else with_numbers(model, stored["numbers"])
        parts = {part: kind(**{name: stored[name] for name in names[part]}) for part, kind in _PARTS.items()}
        return FitResult(**parts, search=None)

    def to_dict(self) -> dict[str, object]:
        """Everything except samples and model, in types of JSON; numbers that are not finite are None."""
        estimate, diagnostics, intervals = self.estimate, self.diagnostics, self.estimate.intervals()
        return jsonable(
            {
                "records": [record.name for record in self.provenance.records],
                "samples": [len(record.t) for record in self.provenance.records],
                "rmse": diagnostics.rmse,
                "noise": diagnostics.noise,
                "parameters": {
                    name: {
                        "value": value,
                        "standard_error": error,
                        "interval": list(intervals[name]),
                        "start": start,
                        "unit": unit,
                    }
                    for name, value, error, start, unit in estimate.rows()
                },
                "correlation": {"names": list(estimate.values), "matrix": estimate.correlation.tolist()},
                "evaluations": diagnostics.evaluations,
                "ending": diagnostics.ending,
                "step_error": diagnostics.step_error,
                "step_moves": diagnostics.step_moves,
                "warnings": list(warnings_for(self)),
            }
        )

    def __str__(self) -> str:
        """A table of all parameters, and the warnings."""
        return table_of(self).text()

    __repr__ = __str__


@table_of.register
def _(result: FitResult) -> Table:
    intervals = result.estimate.intervals()
    rows = []
    for name, value, error, _, unit in result.estimate.rows():
        low, high = intervals[name]
        label = f"{name} [{unit}]" if unit else name
        rows.append((label, f"{value:.6g}", f"{error:.2g}", interval_text(low, high)))
    errors = ", ".join(f"{name} {x:.6g}" for name, x in result.diagnostics.rmse.items())
    names = ", ".join(record.name for record in result.provenance.records)
    head = ("parameter", "value", "standard error", "95 % interval")
    ending = f"{result.diagnostics.evaluations} evaluations, {result.diagnostics.ending}"
    return Table(f"Fit to {names}, RMSE {errors}", head, rows, (ending, *warnings_for(result)))


def warnings_for(result: FitResult) -> tuple[str, ...]:
    """Limitations of a fit, in sentences: causes of wrong standard errors, undetermined parameters, and the reasons.

    Parameters and pairs that an issue of the motion or a weak combination explains are not listed again.

    **Returns:**

    The sentences.
    """
    estimate, diagnostics = result.estimate, result.diagnostics
    errors, bounds = estimate.errors, estimate.bounds
    explained = {name for issue in diagnostics.issues for name in issue.about}
    sentences = _of_the_search(result)
    silent = [name for name in estimate.values if not np.isfinite(errors[name]) and name not in explained]
    sentences += [f"{name} has no effect on this record." for name in silent]
    sentences += [issue.sentence for issue in diagnostics.issues]
    sentences += _above_the_noise(result)
    for name, value in estimate.values.items():
        if np.isfinite(errors[name]) and value in bounds[name]:
            sentences.append(f"{name} ended on its limit {value:g}.")
    directions = sloppy_directions(estimate, diagnostics, explained)
    sentences += [direction.sentence for direction in directions]
    named = explained | {name for direction in directions for name in direction.about}
    for name, value in estimate.values.items():
        share = errors[name] / scale if (scale := estimate.scale(name)) else np.inf
        if _UNKNOWN < share < np.inf and value not in bounds[name] and name not in named:
            of = "its value" if scale == abs(value) else f"{scale:.2g}, which would move the motion by its own size"
            sentences.append(
                f"{name} is not determined by this record: its standard error is {100 * share:.0f} % of {of}."
            )
    pairs = [(a, b, c) for a, b, c in _alike(estimate) if not {a, b} <= named]
    for a, b, c in pairs[:_PAIRS]:
        sentences.append(f"{a} and {b} are hardly told apart (correlation {c:+.3f}).")
    if len(pairs) > _PAIRS:
        sentences.append(f"{len(pairs) - _PAIRS} more pairs have correlations as large: see `estimate.correlation`.")
    if diagnostics.single_precision:
        sentences.append("Computed in single precision: enable jax_enable_x64 for reliable numbers.")
    return tuple(sentences)


def is_step_size_limited(result: FitResult) -> bool:
    """Whether the error of the integration steps shows in a parameter or in the output.

    Four times as many would move a parameter by half of its standard error, or a channel by a tenth of its RMSE.

    **Returns:**

    A `bool`.
    """
    return bool(_step_shows(result.diagnostics))


def _step_shows(diagnostics: FitDiagnostics) -> str:
    """What four times as many integration steps would move, in words; empty if that is little."""
    moves = diagnostics.step_moves
    shares = {name: x / max(diagnostics.rmse[name], _TINY) for name, x in diagnostics.step_error.items()}
    if moves and (most := max(moves.values())) > _MOVES:
        return f"{max(moves, key=moves.__getitem__)} moves by {most:.2g} standard errors"
    if shares and (most := max(shares.values())) > _SHOWS:
        return f"{max(shares, key=shares.__getitem__)} moves by {100 * most:.0f} % of its RMSE (root mean square)"
    return ""


def uncertain_of(estimate: ParameterEstimate) -> dict[str, tuple[str, ...]]:
    """Uncertain parameters, each with those that have a large correlation with it."""
    pairs, errors, uncertain = _alike(estimate), estimate.errors, {}
    for name, value in estimate.values.items():
        others = tuple(b if a == name else a for a, b, _ in pairs if name in (a, b))
        if others or not errors[name] < _UNCERTAIN * estimate.scale(name) or value in estimate.bounds[name]:
            uncertain[name] = others
    return uncertain


def _of_the_search(result: FitResult) -> list[str]:
    diagnostics, sentences = result.diagnostics, []
    if not ended_by_itself(diagnostics.ending):
        sentences.append(f"The search {diagnostics.ending}: do not trust the standard errors.")
    if shows := _step_shows(diagnostics):
        sentences.append(f"The integration step shows: with four times as many, {shows}. Raise substeps.")
    for channel, rmse in diagnostics.rmse.items():
        columns = _columns(result, channel)
        scatter = np.sqrt(np.mean(np.concatenate([x - np.mean(x) for x in columns]) ** 2)) if columns else 0.0
        if columns and rmse > _FOLLOWS * scatter > 0:
            sentences.append(
                f"{channel}: the model follows nothing of the record; its RMSE of {rmse:.2g} is hardly less than that"
                f" of a constant, {scatter:.2g}, if at all. Check column, sign and unit of the input."
            )
    return sentences


def _above_the_noise(result: FitResult) -> list[str]:
    sentences = []
    for channel, rmse in result.diagnostics.rmse.items():
        columns = _columns(result, channel)
        samples = sum(x.size for x in columns)
        # At rest, rounding to a sensor step has an error of up to half of it.
        levels = [max(sample_noise(x), 0.5 * resolution(x)) for x in columns]
        noise = math.sqrt(sum(x.size * level**2 for x, level in zip(columns, levels, strict=True)) / max(samples, 1))
        if columns and rmse**2 > (1 + max(_EXCESS, _SCATTER / math.sqrt(samples))) * noise**2:
            sentences.append(
                f"{channel}: the RMSE of {rmse:.3g} is above the noise from sample to sample, {noise:.2g}: the model"
                " misses part of the motion, or the noise is correlated in time."
            )
    return sentences


def _columns(result: FitResult, channel: str) -> list[np.ndarray]:
    return [record.channels[channel] for record in result.provenance.records if channel in record.channels]


def _alike(estimate: ParameterEstimate) -> list[tuple[str, str, float]]:
    """Pairs of parameters with a large correlation, the largest first."""
    pairs = correlated(list(estimate.values), estimate.correlation, _ALIKE)
    return sorted(pairs, key=lambda pair: -abs(pair[2]))


def _read_fields(path: str | PathLike[str], wanted: list[str]) -> dict[str, Any]:
    """The saved fields of a result by name, with the errors of `FitResult.load`."""
    content = io.BytesIO(Path(path).read_bytes())
    try:
        with np.load(content, allow_pickle=False) as archive:
            if _TEXT not in archive.files:
                raise ValueError(f"it holds no {_TEXT}")
            text = json.loads(archive[_TEXT])
            arrays = {name: archive[name] for name in archive.files if name != _TEXT}
    except Exception as error:  # damaged bytes can raise anything
        raise ValueError(f"{path} was not written by FitResult.save, or it is damaged: {error}") from error
    if not isinstance(text, dict) or text.get("kind") != _KIND:
        raise ValueError(f"{path} is no result of a fit: its kind is not {_KIND!r}.")
    if text.get("format") != _VERSION:
        raise ValueError(
            f"{path} has the format {text.get('format')!r}, written by jaxmodsim {text.get('jaxmodsim')}, but this"
            f" version reads format {_VERSION}."
        )
    body = text.get("fields")
    if not isinstance(body, dict) or set(body) != set(wanted):
        lacks = sorted(set(wanted) - set(body or {}))
        raise ValueError(f"{path} is damaged: it lacks {', '.join(lacks) or 'nothing, but holds more than it should'}.")
    try:
        return {name: _unpacked(body[name], arrays) for name in wanted}
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise ValueError(f"{path} is damaged: {error!r}") from error


def _packed(x: object, name: str, arrays: dict[str, np.ndarray]) -> object:
    """In types of JSON, with numbers that are not finite as text; appends to `arrays`."""
    if isinstance(x, Record):
        return {"record": _packed({**vars(x), "linear": tuple(sorted(x.linear))}, name, arrays)}
    if isinstance(x, IdentifiabilityIssue):
        return {"issue": [x.sentence, list(x.about)]}
    if isinstance(x, Mapping):
        return {"dict": {k: _packed(each, f"{name}/{k}", arrays) for k, each in x.items()}}
    if isinstance(x, tuple):
        return {"tuple": [_packed(each, f"{name}/{i}", arrays) for i, each in enumerate(x)]}
    if isinstance(x, np.ndarray):
        arrays[name] = x
        return {"array": name}
    if isinstance(x, float) and not math.isfinite(x):
        return {"float": str(x)}
    if isinstance(x, np.generic) or not (x is None or isinstance(x, str | bool | int | float)):
        raise TypeError(f"{name} is a {type(x).__name__}, which cannot be saved in the file of a result.")
    return x


def _unpacked(x: object, arrays: Mapping[str, np.ndarray]) -> Any:
    if not isinstance(x, dict):
        return x
    ((kind, inside),) = x.items()
    if kind == "record":
        parts = _unpacked(inside, arrays)
        return Record(measured=parts.pop("channels"), **parts)
    if kind == "issue":
        return IdentifiabilityIssue(inside[0], tuple(inside[1]))
    if kind == "dict":
        return {k: _unpacked(each, arrays) for k, each in inside.items()}
    if kind == "tuple":
        return tuple(_unpacked(each, arrays) for each in inside)
    if kind == "array":
        return arrays[inside]
    if kind == "float":
        return float(inside)
    raise KeyError(kind)
