"""Friction laws fitted to measured presliding loops, judged on loops they have not seen.

Every law is fitted by `fit_law` to the first half of the record, then run through all of it; its error on the second
half is what counts. The record is `test_data_2.txt` of FrictionModels.jl (J. Christopherson, MIT licence), converted to
SI; it lies beside the repository and not in it. Forces are per newton of the measured load.
"""

import time
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from _measure import machine_line
from _options import begin
from _report import new_result, write_figure, write_result

import jaxmodsim as jms
from jaxmodsim.identify import law_force, remarks

HERE = Path(__file__).parent
RECORD = HERE.parents[1] / "shared" / "data" / "presliding" / "hysteresis.csv"
# What a first look at the loops says: the level over the load, and displacements over which the force turns [m].
LEVEL, SPAN = 0.45, (2e-5, 4e-4)


def maxwell(n: int) -> jms.MaxwellSlip:
    """Elements of equal force that give way one after the other; corners round enough for a smooth search."""
    force = np.full(n, LEVEL / n)
    deflections = np.geomspace(*SPAN, n) if n > 1 else np.array([np.sqrt(SPAN[0] * SPAN[1])])
    return jms.MaxwellSlip(k=force / deflections, Fc=force, corner=0.2)


def laws() -> dict[str, tuple[Any, tuple[str, ...] | None]]:
    """Law with start values, and which of them are free; None for all that the fit takes by itself.

    The record slides at one slow speed, so there is nothing in it on a Stribeck effect. LuGre is fitted without, and
    once with it, to show what a fit makes of that.
    """
    numbers = {"sigma0": 1e4, "sigma1": 0.0, "sigma2": 0.0, "Fc": LEVEL, "Fs": LEVEL, "vs": 1e-3}
    damped, stribeck = numbers | {"sigma1": 1.0}, numbers | {"Fs": 1.1 * LEVEL, "vs": 1e-4}
    elastic = jms.ElastoPlastic(**numbers, Fba=0.5 * LEVEL)
    return {
        "Dahl": (jms.Dahl(1e4, LEVEL), None),
        "LuGre": (jms.LuGre(**damped), ("sigma0", "sigma1", "Fc")),
        "LuGre, Stribeck effect free": (jms.LuGre(**stribeck), ("sigma0", "Fc", "Fs", "vs")),
        "ElastoPlastic": (elastic, ("sigma0", "Fba", "Fc")),
        "MaxwellSlip, 1 element": (maxwell(1), None),
        "MaxwellSlip, 4 elements": (maxwell(4), None),
        "MaxwellSlip, 8 elements": (maxwell(8), None),
        "ElastoPlastic, asymmetric": (
            jms.asymmetric(elastic, Fc=0.98 * LEVEL, Fs=0.98 * LEVEL),
            ("forward.sigma0", "forward.Fba", "forward.Fc", "backward.Fc"),
        ),
        "MaxwellSlip, 4 elements, asymmetric": (
            jms.asymmetric(maxwell(4), Fc=np.full(4, 0.98 * LEVEL / 4)),
            ("forward.k", "forward.Fc", "backward.Fc"),
        ),
    }


def main() -> None:
    """Fit, judge, draw, and write `presliding.json`."""
    options = begin(
        "Laws on measured presliding loops.",
        smoke="two laws and a part of the record, to a temporary folder",
        record=RECORD,
    )
    if not options.record.exists():
        print(f"skipped: there is no record at {options.record}")
        return
    columns = np.loadtxt(options.record, delimiter=",", skiprows=1).T
    t, normal, x, force = columns[:, :8000] if options.smoke else columns
    half = len(t) // 2
    known = jms.Record(t[:half], force[:half], {"x": x[:half], "normal": normal[:half]}, name="first half")
    rows, drawn = [], {}
    for name, (law, free) in list(laws().items())[: 2 if options.smoke else None]:
        row, drawn[name] = judge(name, law, free, known, (t, normal, x, force))
        rows.append(row)
        print(row)
    content = new_result("presliding", options, "optimistix") | {"laws": rows}
    content["tables"] = [table(rows, machine_line(content["machine"]))]
    write_result(content, options)
    draw(x, force, half, drawn, rows, options.out / "presliding.png")


def judge(name: str, law: Any, free: Any, known: jms.Record, columns: tuple[Any, ...]) -> tuple[dict[str, Any], Any]:
    """Fit to the known half; errors on both, and the force over the whole record."""
    t, normal, x, force = columns
    start = time.perf_counter()
    found = jms.fit_law(law, known, free, max_steps=400)
    seconds = time.perf_counter() - start
    modelled = np.asarray(law_force(found.model, jnp.asarray(t), jnp.asarray(x), jnp.asarray(normal)))  # type: ignore[arg-type]
    error, half = modelled - force, len(known.t)
    row = {
        "law": name,
        "parameters": len(found.values),
        "rmse_fitted": float(np.sqrt(np.mean(error[:half] ** 2))),
        "rmse_held_back": float(np.sqrt(np.mean(error[half:] ** 2))),
        "evaluations": found.diagnostics.evaluations,
        "ending": found.ending,
        "seconds": seconds,
        "values": found.values,
        "remarks": list(remarks(found)),
    }
    return row, modelled


def table(rows: list[dict[str, Any]], machine: str) -> dict[str, Any]:
    """Laws by their error on the half that was held back, and how much more than the best that is."""
    ranked = sorted(rows, key=lambda row: row["rmse_held_back"])
    best = ranked[0]["rmse_held_back"]
    cells = [
        [
            row["law"],
            str(row["parameters"]),
            f"{1e3 * row['rmse_fitted']:.1f}",
            f"{1e3 * row['rmse_held_back']:.1f}",
            f"{row['rmse_held_back'] / best:.2f}",
            f"{row['evaluations']}, {row['ending'].split(' at ')[0].split(';')[0]}",
            f"{row['seconds']:.1f}",
        ]
        for row in ranked
    ]
    names = ["law", "parameters", "fitted half [mN]", "held-back half [mN]", "over the best", "evaluations", "fit [s]"]
    caption = (
        "Friction force of measured presliding loops (5 N of load, peaks of 2.6 N): root mean square of the error on"
        f" the half that was fitted and on the other. {machine}"
    )
    return {"columns": names, "rows": cells, "caption": caption}


def draw(x: Any, force: Any, half: int, drawn: dict[str, Any], rows: list[dict[str, Any]], path: Path) -> None:
    """A few loops of the half that was held back, measured and by each law."""
    columns = min(3, len(drawn))
    lines = -(-len(drawn) // columns)
    figure, axes = plt.subplots(
        lines, columns, figsize=(4.0 * columns, 3.0 * lines), sharex=True, sharey=True, squeeze=False,
        layout="constrained",
    )  # fmt: skip
    part = slice(half + (len(x) - half) // 3, half + (len(x) - half) // 3 + 2400)
    micrometres = 1e6 * (x - np.mean(x))
    errors = {row["law"]: row["rmse_held_back"] for row in rows}
    for panel, (name, modelled) in zip(axes.flat, drawn.items(), strict=False):
        panel.plot(micrometres[part], force[part], color="#8a8a8a", lw=2.6, label="measured")
        panel.plot(micrometres[part], modelled[part], color="#c2452d", lw=1.1, label="modelled")
        panel.set_title(f"{name}\n{1e3 * errors[name]:.0f} mN", fontsize=9)
        panel.grid(alpha=0.2)
    for panel in axes.flat[len(drawn) :]:
        panel.set_visible(False)
    for panel in axes[-1]:
        panel.set_xlabel("displacement [um]")
    for panel in axes[:, 0]:
        panel.set_ylabel("friction force [N]")
    axes[0, 0].legend(fontsize=8)
    figure.suptitle("Loops that no law was fitted to")
    write_figure(figure, path, dpi=110)


if __name__ == "__main__":
    main()
