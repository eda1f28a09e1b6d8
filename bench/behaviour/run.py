"""Run all laws in all experiments."""

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor

from bench.behaviour.drive import CHARACTERISTIC, LAG
from bench.behaviour.experiment import Experiment, ExperimentResult, LawCase, law_cases
from bench.behaviour.passivity import PASSIVITY
from bench.behaviour.presliding import MEMORY, PRESLIDING
from bench.behaviour.pulled import BREAK_AWAY, CREEP, STICK_SLIP

# The standard experiments by name.
EXPERIMENTS: dict[str, Experiment] = {
    each.name: each for each in (CHARACTERISTIC, PRESLIDING, MEMORY, BREAK_AWAY, LAG, STICK_SLIP, CREEP, PASSIVITY)
}
# Number of laws at a time: most time is compilation, which releases the interpreter lock.
_WORKERS = 2


def run_bench(
    laws: Sequence[LawCase] | None = None,
    experiments: Mapping[str, Experiment] = EXPERIMENTS,
    *,
    progress: Callable[[str], object] | None = None,
) -> dict[str, dict[str, ExperimentResult]]:
    """Perform the experiments on the laws.

    **Arguments:**

    - `laws`: by default all of `law_cases()`.
    - `experiments`: by name; by default all.
    - `progress`: called with the name of each law when it is done.

    **Returns:**

    Outcomes by law and experiment.
    """

    def one(case: LawCase) -> dict[str, ExperimentResult]:
        outcomes = {name: experiment(case) for name, experiment in experiments.items()}
        if progress is not None:
            progress(case.name)
        return outcomes

    chosen = law_cases() if laws is None else laws
    with ThreadPoolExecutor(_WORKERS) as pool:
        return dict(zip([each.name for each in chosen], pool.map(one, chosen), strict=True))
