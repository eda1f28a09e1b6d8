"""How long a user waits: for the import, for the first run, for the first gradient, each in a process of its own.

Compiled Python files are there, as after any first import. Imports in turns with those of JAX and diffrax alone; first
calls count from where the imports are done.

    python bench/i5_start.py [--smoke] [--out DIR]
"""

import os
import statistics
import subprocess
import sys
import tempfile

from _measure import machine_line
from _options import begin
from _report import new_result, target_rows, write_result

_IMPORTS = "import time\nbegan = time.perf_counter()\nimport jax, diffrax\n"
_OURS = "import jaxmodsim as jms\n"
_END = "print(time.perf_counter() - began)\n"
_READY = """
import numpy as np
from jaxmodsim import problems
if {tuned}: jms.tune_cpu()
jax.config.update("jax_enable_x64", True)
"""
_BOX = """
began = time.perf_counter()
run = lambda scene: jms.simulate(scene, [0.0], [0.0], 10.0).q[-1, 0]
"""
_CHAIN = """
n = {links}
joints = [lambda q, p: q[0], *(lambda q, p, i=i: q[i] - q[i - 1] for i in range(1, n))]
law = jms.LuGre(sigma0=1e3, sigma1=3.0, sigma2=0.05, Fc=0.5, Fs=0.7, vs=0.1)
began = time.perf_counter()
bare = problems.n_link_pendulum(n)
effects = tuple(jms.Friction(law, along=joint, name=f"joint_{{i}}") for i, joint in enumerate(joints))
scene = jms.Scene(bare.lagrangian, bare.params, effects)
jms.simulate(scene, np.linspace(0.5, 1.5, n), np.zeros(n), 1.0, max_steps=100_000).q.block_until_ready()
"""
_START = _IMPORTS + _OURS + _READY
_SCENE = "problems.ramped_box(problems.box_lugre())"
LABELS = {
    "peers": "import jax, diffrax",
    "ours": "import jax, diffrax, jaxmodsim",
    "first": "first run of a LuGre scene",
    "gradient": "first gradient of it",
    "chain": "first run of six links with LuGre joints",
}


def main() -> None:
    """Measure, and write `start.json`."""
    options = begin("How long a user waits.")
    smoke = options.smoke
    rounds = 1 if smoke else 7
    codes = {"peers": _IMPORTS, "ours": _IMPORTS + _OURS}
    for tuned in (True,) if smoke else (False, True):
        ready = _START.format(tuned=tuned)
        codes |= {
            _label("first", tuned): f"{ready}{_BOX}run({_SCENE}).block_until_ready()\n",
            _label("gradient", tuned): f"{ready}{_BOX}jax.block_until_ready(jax.grad(run)({_SCENE}))\n",
            _label("chain", tuned): ready + _CHAIN.format(links=2 if smoke else 6),
        }
    with tempfile.TemporaryDirectory() as folder:
        seconds: dict[str, list[float]] = {label: [] for label in codes}
        for turn in range(rounds + 1):
            for label, code in codes.items():
                # The slow ones less often; the first turn only writes the compiled Python files.
                if (turn == 0 and label not in ("peers", "ours")) or (label.startswith("chain") and turn > 2):
                    continue
                taken = _seconds(code + _END, folder)
                seconds[label] += [taken] if turn else []
    content = new_result("start", options, "diffrax", "equinox", "numpy")
    content["seconds"] = seconds
    median = {label: statistics.median(taken) for label, taken in seconds.items()}
    share = median["ours"] / median["peers"] - 1.0
    targets = [("import, in that of JAX and diffrax: share on top", "<= 0.1", share)]
    for kind, limit in (("first", "<= 2.5"), ("gradient", "<= 6"), ("chain", "<= 8")):
        for label in (_label(kind, False), _label(kind, True)):
            if label in median:
                targets.append((f"{_words(label)} [s]", limit, median[label]))
    rows = [[_words(label), f"{value:.2f}"] for label, value in median.items()]
    caption = f"Medians, each in fresh processes. {machine_line(content['machine'])}"
    content["tables"] = [
        {"columns": ["what", "time [s]"], "rows": rows, "caption": caption},
        {"columns": ["what", "target", "measured", "met"], "rows": target_rows(targets), "caption": ""},
    ]
    write_result(content, options)


def _label(kind: str, tuned: bool) -> str:
    return f"{kind}{', tuned' if tuned else ''}"


def _words(label: str) -> str:
    kind, _, tuned = label.partition(", ")
    return LABELS[kind] + (", with `tune_cpu`" if tuned else "")


def _seconds(code: str, folder: str) -> float:
    """What a script prints, in an environment where compiled Python files are kept and nothing else is."""
    kept = {name: value for name, value in os.environ.items() if name not in ("PYTHONDONTWRITEBYTECODE", "XLA_FLAGS")}
    kept["PYTHONPYCACHEPREFIX"] = folder
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, env=kept)
    return float(done.stdout)


if __name__ == "__main__":
    main()
