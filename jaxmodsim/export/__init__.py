"""The same law in another program, where that program has it."""

from ._modelica import to_modelica as to_modelica
from ._mujoco import to_mujoco as to_mujoco
