"""Timing, and in one line where and with what a result was made: shared by all benches."""

from typing import Any

from jaxmodsim._core.timing import measure as measure


def scaled(report: dict[str, Any], count: int) -> dict[str, Any]:
    """The same report per run, for calls that make `count` runs each; the first call stays as it is."""
    if "failed" in report:
        return report
    return report | {
        "median_s": report["median_s"] / count,
        "quartiles_s": [x / count for x in report["quartiles_s"]],
        "minimum_s": report["minimum_s"] / count,
        "runs_per_call": count,
    }


def machine_line(machine: dict[str, Any]) -> str:
    """One line that names processor, versions, date and commit."""
    versions = ", ".join(f"{name} {version}" for name, version in machine["versions"].items())
    state = " with uncommitted changes" if machine["uncommitted_changes"] else ""
    return (
        f"{machine['cpu']}, {machine['cores']} cores, Python {machine['python']}, {versions};"
        f" {machine['date']}, commit {machine['commit'][:10] or 'unknown'}{state}."
    )
