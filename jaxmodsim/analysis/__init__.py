"""Checks of what a scene gives."""

from ._check_gradients import GradientCheck as GradientCheck
from ._check_gradients import NumberCheck as NumberCheck
from ._check_gradients import check_gradients as check_gradients
