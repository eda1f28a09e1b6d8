"""The behaviour bench: what each friction law does in the standard experiments, and what it does not."""

from ._bench import EXPERIMENTS as EXPERIMENTS
from ._bench import run_bench as run_bench
from ._experiment import Experiment as Experiment
from ._laws import LawCase as LawCase
from ._laws import law_cases as law_cases
from ._limitations import KNOWN_LIMITATIONS as KNOWN_LIMITATIONS
from ._limitations import known_limitation as known_limitation
from ._result import ExperimentResult as ExperimentResult
from ._result import LawMeasurement as LawMeasurement
from ._result import Verdict as Verdict
