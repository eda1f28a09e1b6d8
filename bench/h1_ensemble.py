"""Ensembles on whatever JAX runs on, a GPU where there is one: the Lorenz system, and the LuGre testbench.

The Lorenz case is the published one of ensemble solvers: rho in [0, 21], t in [0, 1], y0 = (1, 0, 0), Tsit5,
float32, adaptive with tolerances of 1e-8 and with fixed steps of 1e-3, from 8 to 8 388 608 trajectories. Published for
a V100 and the largest adaptive one: 2611 ms by JAX `vmap`, 49 to 70 ms by a kernel written for it. All runs go through
`sweep`.

The limit is stated in operations: a step of Tsit5 evaluates the field six times (9 operations each), combines stages
(3 components, 27 products and sums of two operations in all) and estimates the error (about 25): 240 operations, 215
without the estimate; LuGre's testbench counts the operations that XLA reports for one step of Rodas5P. Peak rates of
arithmetic and of memory are measured here, by a product of matrices and by a copy.

    python bench/h1_ensemble.py [--smoke] [--out DIR]
"""

from typing import Any

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
from _lugre import TESTBENCH, lugre_field, parameter_sets, run_sweep
from _measure import machine_line, measure, scaled
from _options import begin
from _report import new_result, write_result

import jaxmodsim as jms

SIGMA, BETA = 10.0, 8.0 / 3.0
ADAPTIVE_OPERATIONS, FIXED_OPERATIONS = 240, 215
RTOL = 1e-5


def main() -> None:
    """Measure, and write `ensemble.json`, or `ensemble_gpu.json` on an accelerator."""
    options = begin("Ensembles on the devices at hand.")
    smoke, platform = options.smoke, jax.default_backend()
    largest = 1 << (9 if smoke else 23 if platform != "cpu" else 17)
    counts = [1 << k for k in range(3, largest.bit_length(), 1 if smoke else 4)]
    counts += [largest] if counts[-1] != largest else []
    peak = peak_rates()
    name = "ensemble" if platform == "cpu" else f"ensemble_{platform}"
    content = new_result(name, options, "diffrax", "numpy") | {
        "devices": [str(device) for device in jax.local_devices()],
        "peak": peak,
        "lorenz": _lorenz(counts, peak, 1 if smoke else 5),
        "lugre": _lugre([512] if smoke else [1 << 12, 1 << 16, *([1 << 20] if platform != "cpu" else [])], peak),
    }
    content["tables"] = [_table(content)]
    write_result(content, options)


def lorenz_field(t: Any, y: Any, rho: Any) -> Any:
    """The Lorenz system; the state is a tuple of scalars."""
    del t
    a, b, c = y
    return SIGMA * (b - a), rho * a - b - a * c, a * b - BETA * c


def _solved(rho: Any, dt: float | None) -> Any:
    one, none = jnp.ones((), jnp.float32), jnp.zeros((), jnp.float32)
    return dfx.diffeqsolve(
        dfx.ODETerm(lorenz_field),
        dfx.Tsit5(),
        none,
        one,
        None if dt is None else jnp.asarray(dt, jnp.float32),
        (one, none, none),
        args=rho.astype(jnp.float32),
        stepsize_controller=dfx.PIDController(rtol=1e-8, atol=1e-8) if dt is None else dfx.ConstantStepSize(),
        adjoint=dfx.ForwardMode(),
        max_steps=1 << 14,
        throw=False,
    )


def adaptive(rho: Any) -> dict[str, Any]:
    """End of a trajectory, by adaptive steps."""
    solved = _solved(rho, None)
    return {"x": solved.ys[0][-1], "steps": solved.stats["num_steps"]}


def fixed(rho: Any) -> dict[str, Any]:
    """End of a trajectory, by steps of 1e-3."""
    solved = _solved(rho, 1e-3)
    return {"x": solved.ys[0][-1], "steps": solved.stats["num_steps"]}


def _lorenz(counts: list[int], peak: dict[str, float], rounds: int) -> list[dict[str, Any]]:
    rows = []
    for kind, function, operations in (
        ("adaptive 1e-8", adaptive, ADAPTIVE_OPERATIONS),
        ("fixed 1e-3", fixed, FIXED_OPERATIONS),
    ):
        for count in counts:
            over = {"rho": np.linspace(0.0, 21.0, count)}
            call = lambda function=function, over=over: jms.sweep(function, over)  # noqa: E731
            row = scaled(measure({kind: call}, rounds, limit_s=20.0)[kind], count)
            steps = float(call()["steps"].mean())
            row |= {"kind": kind, "count": count, "steps": steps, "total_s": row["median_s"] * count}
            row["fraction_of_arithmetic"] = operations * steps / row["median_s"] / peak["flops_float32"]
            rows.append(row)
    return rows


def _lugre(counts: list[int], peak: dict[str, float]) -> list[dict[str, Any]]:
    rows = []
    for count in counts:
        sets = parameter_sets(count)
        call = lambda sets=sets: run_sweep(sets, RTOL)  # noqa: E731
        row = scaled(measure({"lugre": call}, 5, limit_s=30.0)["lugre"], count)
        steps = float(call()["num_steps"].mean())
        row |= {"kind": "LuGre, Rodas5P 1e-5, float64", "count": count, "steps": steps}
        row["total_s"] = row["median_s"] * count
        row["fraction_of_arithmetic"] = step_operations() * steps / row["median_s"] / peak["flops_float64"]
        rows.append(row)
    return rows


def step_operations() -> float:
    """Operations of one step of Rodas5P on the testbench, as XLA counts them, with the field written by hand."""
    solver, term, y = jms.Rodas5P(), dfx.ODETerm(lugre_field), (jnp.zeros(()),) * 3

    def step(y: Any, p: Any) -> Any:
        t0, t1 = jnp.zeros(()), jnp.ones(())
        state = solver.init(term, t0, t1, y, p)
        return solver.step(term, t0, t1, y, p, state, made_jump=jnp.asarray(False))[:2]

    return float(jax.jit(step).lower(y, jnp.asarray(TESTBENCH.nominal)).compile().cost_analysis()["flops"])


def peak_rates() -> dict[str, float]:
    """Operations per second by a product of matrices, close to what is possible; bytes per second by a copy."""
    size = 1 << (11 if jax.default_backend() == "cpu" else 13)
    product, copy = jax.jit(lambda x: jnp.matmul(x, x, precision="highest")), jax.jit(lambda x: x + 1.0)
    squares = {kind: jnp.ones((size, size), kind) for kind in ("float32", "float64")}
    big = jnp.ones(size * size * 8, jnp.float32)
    calls = {f"flops_{kind}": lambda x=x: product(x).block_until_ready() for kind, x in squares.items()}
    calls["bytes_per_second"] = lambda: copy(big).block_until_ready()
    work = {"flops_float32": 2.0 * size**3, "flops_float64": 2.0 * size**3, "bytes_per_second": 8.0 * big.size}
    return {name: work[name] / row["minimum_s"] for name, row in measure(calls, 9).items()}


def _table(content: dict[str, Any]) -> dict[str, Any]:
    rows = [
        [
            row["kind"],
            f"{row['count']:,}",
            f"{row['steps']:.0f}",
            f"{row['total_s'] * 1e3:,.3g}",
            f"{1.0 / row['median_s']:,.0f}",
            f"{row['fraction_of_arithmetic']:.1%}",
        ]
        for row in [*content["lorenz"], *content["lugre"]]
    ]
    peak = content["peak"]
    return {
        "caption": f"Ensembles through `sweep` on {', '.join(content['devices'])}; peak rates measured:"
        f" {peak['flops_float32'] / 1e9:,.0f} and {peak['flops_float64'] / 1e9:,.0f} Gflop/s in float32 and float64,"
        f" {peak['bytes_per_second'] / 1e9:,.0f} GB/s. {machine_line(content['machine'])}",
        "columns": ["case", "runs", "steps", "all [ms]", "runs per second", "of peak arithmetic"],
        "rows": rows,
    }


if __name__ == "__main__":
    main()
