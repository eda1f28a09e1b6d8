"""Reference systems by name, each with its exact or reference solution; `problems.hard`: where simulations go wrong."""

from importlib import import_module as _import_module
from typing import TYPE_CHECKING
from typing import Any as _Any

from ._ball import BouncingBall as BouncingBall
from ._ball import bouncing_ball_bounces as bouncing_ball_bounces
from ._ball import bouncing_ball_motion as bouncing_ball_motion
from ._ball import bouncing_ball_rest as bouncing_ball_rest
from ._belt import BELT_OSCILLATOR as BELT_OSCILLATOR
from ._belt import BELT_STRIBECK as BELT_STRIBECK
from ._belt import BeltCycle as BeltCycle
from ._belt import belt_coulomb as belt_coulomb
from ._belt import belt_onset_speed as belt_onset_speed
from ._belt import belt_oscillator as belt_oscillator
from ._belt import belt_oscillator_cycle as belt_oscillator_cycle
from ._belt import belt_oscillator_motion as belt_oscillator_motion
from ._belt import belt_stribeck as belt_stribeck
from ._belts import COUPLED_BELTS as COUPLED_BELTS
from ._belts import COUPLED_BELTS_LAWS as COUPLED_BELTS_LAWS
from ._belts import FirstSlip as FirstSlip
from ._belts import coupled_belts as coupled_belts
from ._belts import coupled_belts_first_slip as coupled_belts_first_slip
from ._box import BOX_LUGRE_V10 as BOX_LUGRE_V10
from ._box import BOX_LUGRE_Z10 as BOX_LUGRE_Z10
from ._box import box_coulomb as box_coulomb
from ._box import box_lugre as box_lugre
from ._box import box_stribeck as box_stribeck
from ._box import ramped_box as ramped_box
from ._bristle import slipping_bristle as slipping_bristle
from ._bristle import slipping_bristle_deflection as slipping_bristle_deflection
from ._cart_pole import CART_POLE as CART_POLE
from ._cart_pole import cart_pole as cart_pole
from ._cart_pole import cart_pole_acceleration as cart_pole_acceleration
from ._cartesian_pendulum import cartesian_pendulum as cartesian_pendulum
from ._cartesian_pendulum import cartesian_pendulum_acceleration as cartesian_pendulum_acceleration
from ._cartesian_pendulum import cartesian_pendulum_tension as cartesian_pendulum_tension
from ._cartesian_pendulum import cartesian_spherical_pendulum as cartesian_spherical_pendulum
from ._chain import double_pendulum as double_pendulum
from ._chain import n_link_pendulum as n_link_pendulum
from ._chain import n_link_pendulum_acceleration as n_link_pendulum_acceleration
from ._charged_particle import CHARGED_PARTICLE as CHARGED_PARTICLE
from ._charged_particle import charged_particle as charged_particle
from ._charged_particle import charged_particle_acceleration as charged_particle_acceleration
from ._charged_particle import charged_particle_motion as charged_particle_motion
from ._foucault import FOUCAULT_PENDULUM as FOUCAULT_PENDULUM
from ._foucault import foucault_pendulum as foucault_pendulum
from ._foucault import foucault_pendulum_acceleration as foucault_pendulum_acceleration
from ._foucault import foucault_pendulum_motion as foucault_pendulum_motion
from ._foucault import foucault_pendulum_precession as foucault_pendulum_precession
from ._four_bar import FOUR_BAR as FOUR_BAR
from ._four_bar import four_bar as four_bar
from ._four_bar import four_bar_acceleration as four_bar_acceleration
from ._four_bar import four_bar_state as four_bar_state
from ._knife_edge import KNIFE_EDGE as KNIFE_EDGE
from ._knife_edge import knife_edge as knife_edge
from ._knife_edge import knife_edge_acceleration as knife_edge_acceleration
from ._knife_edge import knife_edge_force as knife_edge_force
from ._knife_edge import knife_edge_motion as knife_edge_motion
from ._named import Case as Case
from ._named import named_problems as named_problems
from ._pendulum import spherical_pendulum as spherical_pendulum
from ._pendulum import spherical_pendulum_acceleration as spherical_pendulum_acceleration
from ._pendulum import spherical_pendulum_motion as spherical_pendulum_motion
from ._pendulum import spherical_pendulum_reaction as spherical_pendulum_reaction
from ._piecewise import LinearStickSlip as LinearStickSlip
from ._piecewise import StickSlipMotion as StickSlipMotion
from ._piecewise import stick_slip_motion as stick_slip_motion
from ._piecewise_scene import linear_stick_slip as linear_stick_slip
from ._pulled_box import PULLED_BOX as PULLED_BOX
from ._pulled_box import PULLED_BOX_LUGRE as PULLED_BOX_LUGRE
from ._pulled_box import pulled_box as pulled_box
from ._pulled_box import pulled_box_lugre as pulled_box_lugre
from ._rod_on_floor import ROD_ON_ROUGH_FLOOR as ROD_ON_ROUGH_FLOOR
from ._rod_on_floor import rod_on_rough_floor as rod_on_rough_floor
from ._rod_on_floor import rod_on_rough_floor_acceleration as rod_on_rough_floor_acceleration
from ._rod_on_floor import rod_on_rough_floor_compliance as rod_on_rough_floor_compliance
from ._rod_on_floor import rod_on_rough_floor_normal_force as rod_on_rough_floor_normal_force
from ._rod_on_floor import rod_on_rough_floor_state as rod_on_rough_floor_state
from ._rolling_disc import ROLLING_DISC as ROLLING_DISC
from ._rolling_disc import rolling_disc as rolling_disc
from ._rolling_disc import rolling_disc_acceleration as rolling_disc_acceleration
from ._rolling_disc import rolling_disc_steady_spin as rolling_disc_steady_spin
from ._rolling_disc import rolling_disc_velocity as rolling_disc_velocity
from ._slider_crank import SLIDER_CRANK as SLIDER_CRANK
from ._slider_crank import SliderCrankForces as SliderCrankForces
from ._slider_crank import slider_crank as slider_crank
from ._slider_crank import slider_crank_acceleration as slider_crank_acceleration
from ._slider_crank import slider_crank_forces as slider_crank_forces
from ._slider_crank import slider_crank_state as slider_crank_state
from ._spiral import SphericalSpiral as SphericalSpiral
from ._spiral import spiral_bead as spiral_bead
from ._spiral import spiral_bead_acceleration as spiral_bead_acceleration
from ._spiral import spiral_bead_normal_force as spiral_bead_normal_force
from ._spring import BRAKED_SPRING as BRAKED_SPRING
from ._spring import BRAKED_SPRING_STOP as BRAKED_SPRING_STOP
from ._spring import Rest as Rest
from ._spring import braked_spring as braked_spring
from ._spring import braked_spring_law as braked_spring_law
from ._spring import braked_spring_motion as braked_spring_motion
from ._spring import braked_spring_rest as braked_spring_rest
from ._stick_slip_pendulum import STICK_SLIP_PENDULUM as STICK_SLIP_PENDULUM
from ._stick_slip_pendulum import stick_slip_pendulum as stick_slip_pendulum
from ._stick_slip_pendulum import stick_slip_pendulum_turn as stick_slip_pendulum_turn

if TYPE_CHECKING:
    from . import hard as hard


def __getattr__(name: str) -> _Any:
    # It runs scenes and checks gradients, which the reference systems themselves do not need.
    if name == "hard":
        return _import_module(f"{__name__}.hard")
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
