"""Laws as components of other programs, scenes and functions as code in other languages."""

from ._fmu import fmu as fmu
from ._function_code import function_to_c as function_to_c
from ._laws import to_modelica as to_modelica
from ._laws import to_mujoco as to_mujoco
from ._scene_code import to_c as to_c
