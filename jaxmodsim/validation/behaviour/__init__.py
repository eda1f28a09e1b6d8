"""The behaviour bench: what each friction law does in the standard experiments, and what it does not."""

from ._bench import EXPERIMENTS as EXPERIMENTS
from ._bench import run_bench as run_bench
from ._experiment import Experiment as Experiment
from ._laws import law_cases as law_cases
from ._result import ExperimentResult as ExperimentResult
from ._result import Verdict as Verdict
