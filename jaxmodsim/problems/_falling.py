"""What several problems have in common: a mass that falls."""

from jaxtyping import Array


def falling(t: Array, q: Array, qd: Array, p: dict[str, Array]) -> Array:
    """Lagrangian [J] of a mass `m` [kg] at the height `q[0]` [m] under gravity `g` [m/s^2]."""
    return 0.5 * p["m"] * qd[0] ** 2 - p["m"] * p["g"] * q[0]
