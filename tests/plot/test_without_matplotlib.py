"""Figures are an extra: without matplotlib all else works, and what needs it says how to get it."""

import subprocess
import sys

CODE = """
import sys
sys.modules["matplotlib"] = None
import jaxmodsim as jms
run = jms.simulate(jms.problems.ramped_box.scene(), [0.0], [0.0], 0.1)
assert run.result.ok
jms.metrics, jms.sweeps, jms.fit, jms.work_precision
try:
    jms.plot
except ImportError as error:
    print(error)
"""


def test_without_matplotlib() -> None:
    done = subprocess.run([sys.executable, "-c", CODE], capture_output=True, text=True, check=True)
    assert done.stdout == 'jaxmodsim.plot needs matplotlib: pip install "jaxmodsim[plot]".\n'
