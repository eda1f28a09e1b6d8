"""Reference systems by name, each with its exact or reference solution."""

from ._box import BOX_LUGRE_V10 as BOX_LUGRE_V10
from ._box import BOX_LUGRE_Z10 as BOX_LUGRE_Z10
from ._box import box_coulomb as box_coulomb
from ._box import box_lugre as box_lugre
from ._box import box_stribeck as box_stribeck
from ._box import ramped_box as ramped_box
