"""Whether 95 % intervals hold the truth 95 times in 100: LuGre's six parameters from 200 noisy records.

A mass on a spring, driven through stick and slip, 2 000 samples of its position. Every repeat has noise of its own,
white or with a memory, starts from parameters wrong by up to a factor of ten, and is fitted side by side with the
others.
"""

import time

import jax
import jax.numpy as jnp
import numpy as np
from _measure import machine_line
from _options import begin
from _report import new_result, write_result
from g0_fit_cost import NAMES, sprung

import jaxmodsim as jms
from jaxmodsim.identify import Staged, coverage, replay

TRUTH = (1e4, 40.0, 2.0, 1.0, 1.5, 0.02)
WRONG = (1e5, 4.0, 0.2, 0.3, 2.0, 0.1)
NOISE = 1e-5


def main() -> None:
    """Measure, and write `coverage.json`."""
    options = begin("Coverage of intervals.", smoke="a few repeats, into a temporary folder")
    repeats = 8 if options.smoke else 200
    t = np.arange(2000) * 2e-3
    u = 3 * np.sin(2 * np.pi * 0.7 * t) + 2 * np.sin(2 * np.pi * 1.9 * t) + 1.2 * np.sin(2 * np.pi * 0.31 * t)
    zero = jnp.zeros(1)
    run = jax.jit(replay, static_argnums=(5, 6))
    q = run(sprung(*TRUTH), jnp.asarray(t), {"u": jnp.asarray(u)}, zero, zero)
    record = jms.Record(t, np.asarray(q), {"u": u}, noise=NOISE)
    fitted = jms.fit(sprung(*WRONG), record, tuple(f"friction.{x}" for x in NAMES), q0=[0.0], initializer=Staged())
    content = new_result("coverage", options) | {"repeats": repeats}
    rows = []
    for label, memory in (("white", 0.0), ("correlation 0.9 from sample to sample", 0.9)):
        started = time.perf_counter()
        found = coverage(fitted, repeats, memory=memory, initializer=Staged())
        seconds = time.perf_counter() - started
        print(label, found, f"{seconds:.0f} s", sep="\n")
        shares = [found.shares[f"friction.{name}"] for name in NAMES]
        rows.append([label, *(f"{100 * share:.1f}" for share in shares), f"{found.converged}", f"{seconds:.0f}"])
        content[label] = {"shares": found.shares, "converged": found.converged, "seconds": seconds}
    caption = (
        f"Share of {repeats} repeats whose 95 % interval held the truth; starts wrong by up to a factor of ten."
        f" {machine_line(content['machine'])}"
    )
    columns = ["noise", *(f"{name} [%]" for name in NAMES), "converged", "time [s]"]
    content["tables"] = [{"columns": columns, "rows": rows, "caption": caption}]
    write_result(content, options)


if __name__ == "__main__":
    main()
