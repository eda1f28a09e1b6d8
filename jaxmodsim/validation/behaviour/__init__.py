"""The behaviour bench: what each friction law does in the standard experiments, and what it does not."""

from ._bench import EXPERIMENTS as EXPERIMENTS
from ._bench import run_bench as run_bench
from ._experiment import Experiment as Experiment
from ._laws import LawCase as LawCase
from ._laws import law_cases as law_cases
from ._outcome import Finding as Finding
from ._outcome import Limit as Limit
from ._outcome import Line as Line
from ._outcome import Outcome as Outcome
from ._outcome import Verdict as Verdict
