"""Tasks on which others compare differentiable simulators: derivatives of collisions, and an optimal control.

Published derivatives and losses stand in the notebooks of the repository.
"""

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import brentq, minimize, minimize_scalar

import jaxmodsim as jms
from bench.conformance.case import ATOL, RTOL, Case, Numbers, Reference, Setup

SOURCE = "DesmondZhong/diff_sim_grads @ 1fa5ccb3, {}"
# Steps of a second in task 1; radius of the balls and weight of the control in task 3.
STEPS, RADIUS, EPSILON = 480, 0.2, 0.1
# Thickness of the wall [m], and published costs over it and against it.
THICKNESS, WALL_COSTS = 1e-3, (-((np.sin(1.5) / 9.81) ** 2), -(0.06**2))
# Losses of task 3 after 1000 iterations, as published; the optimum there is the least value on a grid of 100 instants.
TASK3_LOSSES = {
    "PBD (Warp)": 1.4302428, "PBD (Brax)": 1.4297202, "compliant (Warp)": 1.6622765, "compliant (Brax)": 2.0000002,
    "convex (DiffCoSim), time of impact": 1.4078553915023804, "convex (DiffCoSim)": 2.0013787746429443,
    "direct (DiffTaichi), time of impact": 1.39581298828125, "direct (DiffTaichi)": 2.00144362449646,
    "LCP (Nimble)": 1.4086288577968151, "optimum": 1.396542,
}  # fmt: skip
# Initial velocities of task 2 after 1000 iterations.
TASK2_VELOCITIES = {
    "PBD (Warp)": (9.729905, -4.0706034), "PBD (Brax)": (10.48652363, -4.75180626),
    "compliant (Warp)": (10.638576, -4.282096), "compliant (Brax)": (-2.49346685, -4.79271269),
    "convex (DiffCoSim), time of impact": (10.257491, -4.2041483), "convex (DiffCoSim)": (-2.4933767, -4.3371224),
    "direct (DiffTaichi), time of impact": (10.18414593, -4.16055489),
    "direct (DiffTaichi)": (-2.49333715, -4.29840183), "LCP (Nimble)": (10.299694, -4.1396265),
}  # fmt: skip


def ball(t, q, qd, p):
    """Lagrangian of a ball of 1 kg in a plane."""
    return 0.5 * jnp.sum(qd**2) - p["g"] * q[1]


def bounce_once(p: Numbers) -> Setup:
    """A ball without weight strikes a floor; a force acts in the first of 480 steps."""
    floor = jms.Contact(lambda t, q, p: q[1] - 0.1, restitution=p["e"], name="floor")
    push = jms.AppliedForce(lambda t, q, qd, p: jnp.stack([0.0 * p["u"], p["u"]]))
    params = {"g": 0.0, "u": jms.Signal([0.0, 1.0 / STEPS], jnp.stack([p["u"], 0.0 * p["u"]]))}
    scene = jms.Scene(ball, params, (push,), constraints=(floor,))
    return Setup(scene, jnp.stack([-1.0 + 0.0 * p["y"], p["y"]]), jnp.stack([2.0 + 0.0 * p["vy"], p["vy"]]))


def exact_bounce_once(y, vy, u, e) -> Reference:
    """Straight lines before and after the impact."""
    h = 1.0 / STEPS
    v = vy + u * h
    y_h = y + vy * h + 0.5 * u * h * h
    t = h + (0.1 - y_h) / v
    return Reference(np.array([0.1 - e * v * (1.0 - t)]), [(t, "floor open")])


def ground_and_wall(p: Numbers) -> Setup:
    """A ball bounces from the ground and a wall."""
    ground = jms.Contact(lambda t, q, p: q[1] - 0.1, restitution=p["e"], name="ground")
    wall = jms.Contact(lambda t, q, p: 1.65 - q[0], restitution=p["e"], name="wall")
    scene = jms.Scene(ball, {"g": 9.8}, constraints=(ground, wall))
    return Setup(scene, jnp.stack([p["x"], p["y"]]), jnp.stack([p["vx"], p["vy"]]))


def exact_end(x, y, vx, vy, e) -> np.ndarray:
    """Place after 0.6 s: a bounce of either coordinate by itself, at most one."""
    at_wall = (1.65 - x) / vx if vx > 0 else np.inf
    end_x = x + 0.6 * vx if at_wall > 0.6 else 1.65 - e * vx * (0.6 - at_wall)
    at_ground = (vy + np.sqrt(vy * vy + 2.0 * 9.8 * (y - 0.1))) / 9.8
    left, up = 0.6 - at_ground, -e * (vy - 9.8 * at_ground)
    end_y = y + 0.6 * vy - 0.5 * 9.8 * 0.36 if left < 0 else 0.1 + up * left - 0.5 * 9.8 * left**2
    return np.array([end_x, end_y])


def loss_of_place(x, y):
    """Square of the distance to the target of task 2."""
    return (x + 2.0) ** 2 + (y - 1.5) ** 2


def exact_ground_and_wall(x, y, vx, vy, e) -> Reference:
    """Loss of the place after 0.6 s."""
    return Reference(np.array([loss_of_place(*exact_end(x, y, vx, vy, e))]), [])


def two_balls(p: Numbers) -> Setup:
    """A ball is pushed along the diagonal and strikes another one, whose place at 1 s counts."""

    def lagrangian(t, q, qd, p):
        return 0.5 * jnp.sum(qd**2)

    def gap(t, q, p):
        return jnp.sqrt(jnp.sum((q[2:] - q[:2]) ** 2)) - 2.0 * RADIUS

    push = jms.AppliedForce(lambda t, q, qd, p: jnp.stack([p["u"], p["u"], 0.0 * p["u"], 0.0 * p["u"]]))
    balls = jms.Contact(gap, restitution=1.0, name="balls")
    scene = jms.Scene(lagrangian, {"u": p["u"]}, (push,), constraints=(balls,))
    q0 = jnp.stack([p["start"], p["start"], -1.0 + 0.0 * p["start"], -1.0 + 0.0 * p["start"]])
    return Setup(scene, q0, np.zeros(4))


def exact_two_balls(u, start) -> Reference:
    """The place of ball 2 at 1 s under a constant force."""
    way = -1.0 - start - 2.0 * RADIUS / np.sqrt(2.0)
    t = np.sqrt(2.0 * way / u)
    return Reference(np.array([-1.0 + u * t * (1.0 - t)]), [(t, "balls open")])


def ball_with_wall(p: Numbers) -> Setup:
    """A ball is thrown at a wall of finite height; it stays where it lands."""

    def wall(t, q, p):
        return jnp.maximum(jnp.maximum(p["d"] - q[0], q[0] - p["d"] - THICKNESS), q[1] - 0.02)

    contacts = (jms.Contact(wall, name="wall"), jms.Contact(lambda t, q, p: q[1], name="ground"))
    grip = jms.Friction(jms.Coulomb(10.0), along=lambda q: q[0], normal_force="ground", name="grip")
    scene = jms.Scene(ball, {"g": p["g"], "d": p["d"]}, (grip,), constraints=contacts)
    v = p["v"] * jnp.stack([jnp.cos(p["angle"]), jnp.sin(p["angle"])])
    return Setup(scene, np.array([0.0, 1e-12]), v)


def exact_ball_with_wall(angle, v, g, d) -> Reference:
    """The end of the parabola, or the wall where the ball is too low there."""
    end = v**2 * np.sin(2.0 * angle) / g
    height = d * np.tan(angle) - 0.5 * g * (d / (v * np.cos(angle))) ** 2
    return Reference(np.array([-(min(end, d if height <= 0.02 else end) ** 2)]), [])


def bouncing_block(p: Numbers) -> Setup:
    """A block without weight strikes the ground after 10 us."""
    ground = jms.Contact(lambda t, q, p: q[1], restitution=p["e"], name="ground")
    scene = jms.Scene(ball, {"g": 0.0}, constraints=(ground,))
    return Setup(scene, jnp.stack([0.0 * p["y"], p["y"]]), jnp.stack([0.0 * p["y"], p["v"]]))


def exact_bouncing_block(y, v, e) -> Reference:
    """Straight lines before and after the impact."""
    return Reference(np.array([-e * v * (1e-3 + y / v)]), [(-y / v, "ground open")])


def least_loss() -> float:
    """The least loss of task 3 over all controls.

    With the instant s and the speed v at the collision, the force is a straight line until s and zero afterwards:
    `2 (1 - v (1 - s))^2 + 2 eps (4 v^2/s - 12 v d/s^2 + 12 d^2/s^3)` with the way d to the collision.
    """
    way = 1.0 - 2.0 * RADIUS / np.sqrt(2.0)

    def loss(s: float) -> float:
        a = 8.0 * EPSILON / s + 2.0 * (1.0 - s) ** 2
        b = -(4.0 * (1.0 - s) + 24.0 * EPSILON * way / s**2)
        return 2.0 + 24.0 * EPSILON * way**2 / s**3 - b * b / (4.0 * a)

    return float(minimize_scalar(loss, bounds=(0.3, 0.99), method="bounded", options={"xatol": 1e-12}).fun)


def energy_of_control(ts, u, end):
    """Integral of the square of a control that is linear between samples, from 0 to `end`."""
    slope = (u[1:] - u[:-1]) / (ts[1:] - ts[:-1])
    t = jnp.clip(end - ts[:-1], 0.0, ts[1:] - ts[:-1])
    return jnp.sum(u[:-1] ** 2 * t + u[:-1] * slope * t**2 + slope**2 * t**3 / 3.0)


def optimal_control(pieces: int = 20) -> tuple[float, int]:
    """Least loss of task 3 from a constant force of 3 N, by our gradients in reverse mode, and the number of runs.

    The control is linear in each of `pieces`, and zero after the collision, so that it costs nothing there.
    """
    ts = np.linspace(0.0, 1.0, pieces + 1)

    @jax.jit
    @jax.value_and_grad
    def loss(u):
        scene, q0, qd0 = two_balls({"u": jms.Signal(ts, u, linear=True), "start": jnp.asarray(-2.0)})
        run = jms.simulate(scene, q0, qd0, 1.0, rtol=1e-10, atol=1e-12, throw=False, max_events=4, record=("events",))
        return jnp.sum(run.q[-1, 2:] ** 2) + 2.0 * EPSILON * energy_of_control(ts, u, run.events.t[0])

    def numbers(u):
        value, slope = loss(jnp.asarray(u))
        return float(value), np.asarray(slope)

    found = minimize(numbers, np.full(pieces + 1, 3.0), jac=True, method="BFGS", options={"gtol": 1e-9})
    return float(found.fun), int(found.nfev)


def target_velocity(vx: float = 9.0, vy: float = -4.5) -> tuple[np.ndarray, int]:
    """The initial velocity of task 2 that hits the target, by Newton's method with our Jacobian; and its iterations."""

    @jax.jit
    def end(v):
        p = {"x": jnp.asarray(-0.5), "y": jnp.asarray(1.0), "vx": v[0], "vy": v[1], "e": jnp.asarray(0.92)}
        scene, q0, qd0 = ground_and_wall(p)
        place = jms.simulate(scene, q0, qd0, 0.6, rtol=RTOL, atol=ATOL, throw=False).q[-1]
        return place - jnp.array([-2.0, 1.5]), place

    slope = jax.jit(jax.jacfwd(end, has_aux=True))
    v = jnp.array([vx, vy])
    count, change = 0, v
    while jnp.max(jnp.abs(change)) > 1e-12 and count < 20:
        count += 1
        jacobian, place = slope(v)
        change = jnp.linalg.solve(jacobian, place - jnp.array([-2.0, 1.5]))
        v = v - change
    return np.asarray(v), count


def exact_target_velocity() -> np.ndarray:
    """The same from the closed forms of either coordinate."""
    vx = brentq(lambda v: exact_end(-0.5, 1.0, v, -4.0, 0.92)[0] + 2.0, 5.0, 20.0, xtol=1e-14)
    vy = brentq(lambda v: exact_end(-0.5, 1.0, 9.0, v, 0.92)[1] - 1.5, -5.0, -3.5, xtol=1e-14)
    return np.array([vx, vy])


CASES = (
    Case(
        "diff_sim_grads task1", SOURCE.format("task1_bounce_once"), bounce_once,
        {"y": 1.0, "vy": -2.0, "u": 0.0, "e": 1.0}, 1.0, ("height [m]",), lambda q, qd: (q[1],), (), exact_bounce_once,
        by=("y", "vy", "u"),
    ),
    Case(
        "diff_sim_grads task2", SOURCE.format("task2_bounce_ground_wall"), ground_and_wall,
        {"x": -0.5, "y": 1.0, "vx": 5.0, "vy": -5.0, "e": 0.92}, 0.6, ("loss [m^2]",),
        lambda q, qd: (loss_of_place(q[0], q[1]),), (), exact_ground_and_wall, by=("x", "y", "vx", "vy"),
    ),
    Case(
        "diff_sim_grads task3", SOURCE.format("task3_two_balls"), two_balls,
        {"u": 3.0, "start": -2.0}, 1.0, ("place of ball 2 [m]",), lambda q, qd: (q[2],),
        (), exact_two_balls, by=("u", "start"),
    ),
    *(
        Case(
            f"alpha_gradient ball_with_wall, {name}",
            "hjsuh94/alpha_gradient @ 5e2ef6f3, examples/ball_with_wall/ball_with_wall.py",
            ball_with_wall, {"angle": angle, "v": 1.0, "g": 9.81, "d": 0.06}, 0.3, ("cost [m^2]",),
            lambda q, qd: (-(q[0] ** 2),), (published,), exact_ball_with_wall,
            by=("angle", "v", "d"), note="Published: the closed form. The wall has a thickness of 1 mm here.",
        )
        for name, angle, published in (("over", 0.75, WALL_COSTS[0]), ("against", 0.5, WALL_COSTS[1]))
    ),
    Case(
        "nimblephysics bouncing block", "keenon/nimblephysics @ c405b056, unittests/comprehensive/test_Gradients.cpp",
        bouncing_block, {"y": 1e-5, "v": -1.0, "e": 0.5}, 1e-3, ("y [m]",), lambda q, qd: (q[1],),
        (), exact_bouncing_block, by=("y", "v", "e"),
        note="Published: the derivative -0.5 by y, which the test accepts with an error of 0.005.",
    ),
)  # fmt: skip
