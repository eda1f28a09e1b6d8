"""A self-locking worm drive."""

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from ..friction import Coulomb
from ..mechanics import Constraint
from ..scene import AppliedForce, Friction, Scene

# Moments of inertia [kg m^2] and pitch radii [m] of worm and wheel, lead angle [rad], coefficient of friction, and
# torques of motor and load [N m].
PARAMS = {"J1": 1e-4, "J2": 2e-2, "r1": 0.01, "r2": 0.04, "lead": 0.12, "mu": 0.15, "motor": 0.0, "load": 8.0}


def _energy(t: Array, q: Array, qd: Array, p: dict[str, Array]) -> Array:
    return 0.5 * (p["J1"] * qd[0] ** 2 + p["J2"] * qd[1] ** 2)


def _torques(t: Array, q: Array, qd: Array, p: dict[str, Array]) -> Array:
    return jnp.stack([p["motor"], -p["load"]])


def _across(t: Array, q: Array, p: dict[str, Array]) -> Array:
    """Overlap of the teeth across their flanks."""
    return p["r2"] * q[1] * jnp.cos(p["lead"]) - p["r1"] * q[0] * jnp.sin(p["lead"])


def _along(q: Array, p: dict[str, Array]) -> Array:
    """Sliding distance along the teeth."""
    return p["r1"] * q[0] * jnp.cos(p["lead"]) + p["r2"] * q[1] * jnp.sin(p["lead"])


def scene(
    *,
    J1: ArrayLike = PARAMS["J1"],
    J2: ArrayLike = PARAMS["J2"],
    r1: ArrayLike = PARAMS["r1"],
    r2: ArrayLike = PARAMS["r2"],
    lead: ArrayLike = PARAMS["lead"],
    mu: ArrayLike = PARAMS["mu"],
    motor: ArrayLike = PARAMS["motor"],
    load: ArrayLike = PARAMS["load"],
) -> Scene:
    """Rigid worm and wheel, with Coulomb friction in proportion to the transmitted force.

    The coordinates are the angles of worm and wheel [rad], with `r2 wheel = r1 worm tan(lead)`. The load drives the
    wheel backwards. With the friction angle `phi = atan(mu)` the drive is self-locking for phi >= lead: no load turns
    the worm. `state` has initial states.

    **Arguments:**

    - `J1`, `J2`: moments of inertia of worm and wheel [kg m^2], > 0.
    - `r1`, `r2`: pitch radii of worm and wheel [m], > 0.
    - `lead`: lead angle of the worm [rad], > 0 and < pi/2.
    - `mu`: coefficient of friction between the teeth, >= 0.
    - `motor`: torque on the worm [N m]. `load`: torque on the wheel against positive angles [N m].

    **Returns:**

    A `Scene` with the constraint `mesh`, whose multiplier is the normal force between the teeth [N], and the effect
    `friction` along the teeth. In slip it follows `acceleration`. If the load drives the worm and
    `J1/r1^2 < (J2/r2^2) tan(lead) tan(phi - lead)`, the friction force is not unique (jamming), and the run ends.
    """
    mesh = Constraint(_across, name="mesh")
    friction = Friction(Coulomb(mu), along=_along, normal_force="mesh")
    return Scene(
        _energy,
        params={"J1": J1, "J2": J2, "r1": r1, "r2": r2, "lead": lead, "motor": motor, "load": load},
        effects=(AppliedForce(_torques), friction),
        constraints=(mesh,),
        coordinates=("worm [rad]", "wheel [rad]"),
    )


def state(
    speed: ArrayLike, *, r1: ArrayLike = PARAMS["r1"], r2: ArrayLike = PARAMS["r2"], lead: ArrayLike = PARAMS["lead"]
) -> tuple[Float[Array, "2"], Float[Array, "2"]]:
    """Coordinates and velocities at the origin.

    **Arguments:**

    - `speed`: angular velocity of the worm [rad/s].
    - `r1`, `r2`, `lead`: as for `scene`.

    **Returns:**

    `(q0, qd0)` for `simulate`, shape `[2]` each.
    """
    speed = jnp.asarray(speed, float)
    return jnp.zeros(2), jnp.stack([speed, speed * jnp.asarray(r1) / r2 * jnp.tan(lead)])


def efficiency(lead: ArrayLike, mu: ArrayLike) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
    """Efficiencies in steady motion, driven by the motor and by the load.

    They are `tan(lead)/tan(lead + phi)` and `tan(lead - phi)/tan(lead)` with `phi = atan(mu)`. The second one is 0 for
    a self-locking drive, phi >= lead. For `Geared` on the worm they are `1/(1 + mu_drive)` and `1 - mu_back`.

    **Arguments:**

    - `lead`, `mu`: as for `scene`.

    **Returns:**

    Both efficiencies, of the common shape of the arguments.
    """
    angle = jnp.arctan(mu)
    return (
        jnp.tan(lead) / jnp.tan(lead + angle),
        jnp.where(angle < lead, jnp.tan(lead - angle), 0.0) / jnp.tan(lead),
    )


def holding_torques(
    *,
    load: ArrayLike = PARAMS["load"],
    r1: ArrayLike = PARAMS["r1"],
    r2: ArrayLike = PARAMS["r2"],
    lead: ArrayLike = PARAMS["lead"],
    mu: ArrayLike = PARAMS["mu"],
) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
    """Smallest and largest motor torque [N m] at which the drive stays at rest.

    They are `r1 (load/r2) tan(lead - phi)` and `r1 (load/r2) tan(lead + phi)`. For a positive load and a self-locking
    drive the first one is negative: the motor must push to lower the load.

    **Arguments:**

    - `load`, `r1`, `r2`, `lead`, `mu`: as for `scene`.

    **Returns:**

    Both torques, of the common shape of the arguments.
    """
    force, angle = jnp.asarray(load) / r2, jnp.arctan(mu)
    ends = [r1 * force * jnp.tan(lead - angle), r1 * force * jnp.tan(lead + angle)]
    return jnp.minimum(*ends), jnp.maximum(*ends)


def acceleration(
    direction: ArrayLike,
    *,
    J1: ArrayLike = PARAMS["J1"],
    J2: ArrayLike = PARAMS["J2"],
    r1: ArrayLike = PARAMS["r1"],
    r2: ArrayLike = PARAMS["r2"],
    lead: ArrayLike = PARAMS["lead"],
    mu: ArrayLike = PARAMS["mu"],
    motor: ArrayLike = PARAMS["motor"],
    load: ArrayLike = PARAMS["load"],
) -> Float[Array, ""]:
    """Angular acceleration of the worm [rad/s^2] in slip, in closed form.

    It is `(motor/r1 - (load/r2) T)/(J1/r1^2 + J2/r2^2 tan(lead) T)/r1`, with `T = tan(lead + phi)` if the motor drives
    and `T = tan(lead - phi)` if the load drives. This depends on the direction of slip and on the loaded flank: the
    tooth force along the wheel, `load/r2 + J2/r2^2 tan(lead) r1 worm''`, is positive if the worm pushes the wheel.

    **Arguments:**

    - `direction`: sign of the velocity of the worm.
    - All others: as for `scene`.

    **Returns:**

    The acceleration, shape `[]`.
    """
    mass1, mass2 = jnp.asarray(J1) / jnp.square(r1), jnp.asarray(J2) / jnp.square(r2)
    push, force, slope = jnp.asarray(motor) / r1, jnp.asarray(load) / r2, jnp.tan(lead)

    def solution(side: float) -> tuple[Array, Array]:
        """Acceleration of the pitch line of the worm, and force on the wheel, with one flank loaded."""
        T = jnp.tan(lead + side * direction * jnp.arctan(mu))
        rate = (push - force * T) / (mass1 + mass2 * slope * T)
        return rate, force + mass2 * slope * rate

    forward, tooth_force = solution(1.0)
    return jnp.where(tooth_force >= 0, forward, solution(-1.0)[0]) / r1
