"""The two shapes that stand in most signatures."""

from typing import TypeAlias

from jaxtyping import Array, Float

# One number.
Scalar: TypeAlias = Float[Array, ""]
# One number for each coordinate.
PerDof: TypeAlias = Float[Array, " dof"]
