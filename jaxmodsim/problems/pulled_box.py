"""A box on a table, pulled through a spring whose end moves evenly: stick-slip by a bristle."""

from jaxtyping import Array, ArrayLike

from ..friction import LuGre
from ..scene import Friction, Scene

# Mass [kg], stiffness of the spring [N/m], velocity of its end [m/s]; and the law: C. Canudas de Wit, H. Olsson,
# K. J. Astrom and P. Lischinsky, A new model for control of systems with friction, IEEE Transactions on Automatic
# Control 40:419, 1995, table 1 and section III.
PARAMS = {"m": 1.0, "k": 2.0, "pull": 0.1}
LUGRE = {"sigma0": 1e5, "sigma1": 1e5**0.5, "sigma2": 0.4, "Fc": 1.0, "Fs": 1.5, "vs": 1e-3}


def _lagrangian(t: Array, q: Array, qd: Array, p: dict[str, Array]) -> Array:
    return 0.5 * p["m"] * qd[0] ** 2 - 0.5 * p["k"] * (p["pull"] * t - q[0]) ** 2


def scene(
    law: object = None, *, m: ArrayLike = PARAMS["m"], k: ArrayLike = PARAMS["k"], pull: ArrayLike = PARAMS["pull"]
) -> Scene:
    """Box on a table, pulled through a spring, relaxed at t = 0 and q = 0, whose end moves at constant velocity.

    **Arguments:**

    - `law`: friction law between box and table; None for `lugre()`.
    - `m`: mass [kg], > 0.
    - `k`: stiffness of the spring [N/m], > 0.
    - `pull`: velocity of the end of the spring [m/s].

    **Returns:**

    A `Scene` with one coordinate [m] and the effect `friction`. The bristles of 1995 settle within 1e-5 s where the box
    slips, and it sticks for seconds: a stiff problem.
    """
    law = lugre() if law is None else law
    return Scene(_lagrangian, params={"m": m, "k": k, "pull": pull}, effects=(Friction(law),), coordinates=("x [m]",))


def lugre(**changes: ArrayLike) -> LuGre:
    """The LuGre law of `LUGRE`, with `changes` to its parameters."""
    return LuGre(**{**LUGRE, **changes})
