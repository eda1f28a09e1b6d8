"""The behaviour bench: what each friction law does in the standard experiments, and what it does not."""

from ._break_away import BREAK_AWAY as BREAK_AWAY
from ._characteristic import CHARACTERISTIC as CHARACTERISTIC
from ._creep import CREEP as CREEP
from ._experiment import Experiment as Experiment
from ._lag import LAG as LAG
from ._laws import Specimen as Specimen
from ._laws import specimens as specimens
from ._nature import BY_NATURE as BY_NATURE
from ._outcome import Finding as Finding
from ._outcome import Limit as Limit
from ._outcome import Line as Line
from ._outcome import Outcome as Outcome
from ._outcome import Verdict as Verdict
from ._passivity import PASSIVITY as PASSIVITY
from ._presliding import MEMORY as MEMORY
from ._presliding import PRESLIDING as PRESLIDING
from ._stick_slip import STICK_SLIP as STICK_SLIP

EXPERIMENTS: dict[str, Experiment] = {
    each.name: each
    for each in (CHARACTERISTIC, PRESLIDING, MEMORY, BREAK_AWAY, LAG, STICK_SLIP, CREEP, PASSIVITY)
}
