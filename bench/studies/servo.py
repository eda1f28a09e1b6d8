"""`jaxmodsim fit --axis servo` on nine measured records of a Dynamixel XL330: laws ranked by records left out.

One command fits all gear laws to all records and without each trajectory and each gain. Then, for each trajectory and
each gain, one command fits the others, and `jaxmodsim predict` predicts the records left out, with their bands.
"""

import json
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from bench.record import Result, command

# Outside the repository: M. Duclusaud, G. Passault, V. Padois, O. Ly, arXiv 2410.08650; github.com/Rhoban/bam.
XL330 = Path(__file__).parents[3] / "shared" / "data" / "xl330"
GROUPS = ("lift_and_drop", "sin_sin", "up_and_down", "kp100", "kp200", "kp400")
# Mean absolute errors [mrad] of the published parameters at gains 100, 200, 400, over four trajectories.
PUBLISHED = {"M6, published": (17.1, 41.4, 56.5), "M1, published": (49.8, 55.1, 63.1)}
GAINS = (100, 200, 400)
# XL330-M288 at 5 V (ROBOTIS e-manual): stall at 0.52 N m and 1.47 A.
DATA_SHEET = ("--prior", "kt=0.354:0.035", "--prior", "R=3.4:0.34")


def main(smoke: bool, out: Path) -> Result | None:
    """Fit and predict; a smoke run takes one law and two seconds of four records. Without the records: no result."""
    del out
    if not XL330.exists():
        print(f"skipped: there are no records in {XL330}")
        return None
    result = Result("servo", ("scipy",), {"goal": 36})
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        paths = _records(folder, smoke)
        result.settings["samples"] = sum(len(path.read_text().splitlines()) - 1 for path in paths)
        started = time.perf_counter()
        report = _fit(paths, folder / "fit", "M3" if smoke else "all")
        result.settings["seconds"] = round(time.perf_counter() - started)
        result.settings["evaluations"] = max(row["of all fits"] for row in report["ranking"])
        _add_ranking(result, report)
        known = _fit(paths, folder / "known", report["model"], *DATA_SHEET)
        _add_ranking(result, known, ", data sheet")
        for peer, errors in PUBLISHED.items():
            for gain, error in zip(GAINS, errors, strict=True):
                result.add(f"gain {gain}", error, "mrad", peer=peer)
        result.settings["warnings"] = " ".join(report["warnings"])
        for group in GROUPS[:1] if smoke else GROUPS:
            _predict_left_out(result, paths, group, folder / group, report["model"])
    return result


def _records(folder: Path, smoke: bool) -> list[Path]:
    paths = sorted(XL330.glob("*.csv"))
    if not smoke:
        return paths
    short = [folder / path.name for path in paths if "kp200" not in path.name and "up" not in path.name]
    for path in short:
        path.write_text("".join((XL330 / path.name).read_text().splitlines(keepends=True)[:501]))
    return short


def _add_ranking(result: Result, report: dict[str, Any], suffix: str = "") -> None:
    for row in report["ranking"]:
        law, peer = report["laws"][row["law"]], {"peer": row["law"] + suffix}
        result.add("parameters", row["parameters"], **peer)
        result.add("fitted", row["fitted [mrad]"], "mrad", **peer)
        result.add("trajectory left out", row["trajectory left out"], "mrad", **peer)
        result.add("gain left out", row["gain left out"], "mrad", **peer)
        for gain in GAINS:
            result.add(f"gain {gain}", _at_gain(law, gain), "mrad", **peer)


def _at_gain(law: dict[str, Any], gain: int) -> float | None:
    """Mean error [mrad] of the records of a gain, each with its trajectory left out."""
    errors = [
        1e3 * error
        for name, group in law["left_out"].items()
        if name.startswith("trajectory")
        for record, error in group.items()
        if record.startswith(f"kp{gain}_")
    ]
    return sum(errors) / len(errors) if errors else None


def _predict_left_out(result: Result, paths: Sequence[Path], group: str, folder: Path, law: str) -> None:
    """Fit the records outside the group, and predict those in it, by the commands."""
    out = [path for path in paths if group in path.name]
    if not out or len(out) == len(paths):
        return
    _fit([path for path in paths if path not in out], folder, law)
    command("predict", str(folder / "fit.json"), *map(str, out), "--out", str(folder))
    for path in out:
        row = json.loads((folder / f"{path.stem}.json").read_text())
        case = {"case": path.stem, "at": "gain" if group.startswith("kp") else "trajectory"}
        result.add("error", 1e3 * row["mean_absolute_error"], "mrad", **case)
        result.add("samples in the band", 100 * row["inside"], "%", **case)
        result.add("half band", 1e3 * row["half_band"], "mrad", **case)


def _fit(paths: Sequence[Path], folder: Path, laws: str, *options: str) -> dict[str, Any]:
    command("fit", *map(str, paths), "--axis", "servo", "--laws", laws, "--out", str(folder), *options)
    return json.loads((folder / "fit.json").read_text())
