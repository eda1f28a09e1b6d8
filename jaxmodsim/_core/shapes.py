"""Types of numbers and functions that most signatures have."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, TypeAlias

from jaxtyping import Array, Float, PyTree, ScalarLike

# One number.
Scalar: TypeAlias = Float[Array, ""]
# One number for each coordinate.
PerDof: TypeAlias = Float[Array, " dof"]
# One number or flag as diffrax passes it: an array, or a number of Python.
if TYPE_CHECKING:
    Real: TypeAlias = Any  # type checkers know no arithmetic of such a union
else:
    Real: TypeAlias = ScalarLike
# A function of arrays.
Fn: TypeAlias = Callable[..., PyTree]
