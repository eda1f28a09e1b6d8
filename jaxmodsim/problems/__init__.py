"""Reference systems by name, each with its exact or reference solution."""

from ._box import BOX_LUGRE_V10 as BOX_LUGRE_V10
from ._box import BOX_LUGRE_Z10 as BOX_LUGRE_Z10
from ._box import box_coulomb as box_coulomb
from ._box import box_lugre as box_lugre
from ._box import box_stribeck as box_stribeck
from ._box import ramped_box as ramped_box
from ._bristle import slipping_bristle as slipping_bristle
from ._bristle import slipping_bristle_deflection as slipping_bristle_deflection
from ._pendulum import spherical_pendulum as spherical_pendulum
from ._pendulum import spherical_pendulum_acceleration as spherical_pendulum_acceleration
from ._pendulum import spherical_pendulum_reaction as spherical_pendulum_reaction
from ._spiral import SphericalSpiral as SphericalSpiral
from ._spiral import spiral_bead as spiral_bead
from ._spiral import spiral_bead_acceleration as spiral_bead_acceleration
from ._spring import BRAKED_SPRING as BRAKED_SPRING
from ._spring import BRAKED_SPRING_STOP as BRAKED_SPRING_STOP
from ._spring import Rest as Rest
from ._spring import braked_spring as braked_spring
from ._spring import braked_spring_law as braked_spring_law
from ._spring import braked_spring_motion as braked_spring_motion
from ._spring import braked_spring_rest as braked_spring_rest
