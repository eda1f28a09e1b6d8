"""Effects: where forces act on the mechanism."""

from ._applied_force import AppliedForce as AppliedForce
from ._effect import AbstractEffect as AbstractEffect
from ._effect import Action as Action
from ._effect import Power as Power
from ._friction import Friction as Friction
