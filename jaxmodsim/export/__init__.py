"""Laws in other programs, where these have them, and scenes in other languages."""

from ._modelica import to_modelica as to_modelica
from ._mujoco import to_mujoco as to_mujoco
from ._scene_code import to_c as to_c
from ._scene_code import to_javascript as to_javascript
