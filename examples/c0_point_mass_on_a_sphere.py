"""A point mass in cylindrical and spherical frames, on a sphere, and on a spiral: an exercise solved and checked.

NTNU course TTK4130, exercise 9, problem 1. What is derived there by hand comes here from positions by differentiation;
every formula is printed with its largest error at random states, and must hold to rounding. The lettering (a) to (j) is
this example's reading of it. Frames: (r, theta, z) and (r, phi, theta), with phi from the z axis; gravity along -z.

Run it: `python examples/c0_point_mass_on_a_sphere.py [--smoke] [--out DIR]`; --smoke leaves out what compiles
longest: the runs by Gauss, in x, y, z, and under dry friction, and the account of energy.
"""

import argparse
from functools import partial
from pathlib import Path

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

import jaxmodsim as jms
from jaxmodsim.mechanics import acceleration, energies
from jaxmodsim.scene import State, forward_dynamics, vector_field

# Before any array is made, and the scenes below hold some.
jms.tune_cpu()
jax.config.update("jax_enable_x64", True)

BLUE, RED, GREEN, GREY, YELLOW = "#0072b2", "#d55e00", "#009e73", "#8a8a8a", "#e69f00"
EYE = (75.0, -60.0)  # phi and theta of the onlooker [deg]
CYLINDRICAL, SPHERICAL = jms.Cylindrical(), jms.Spherical()
M, R, G, A = 0.5, 1.2, 9.81, 0.2
NUMBERS = {"m": M, "R": R, "g": G, "a": A}
RANDOM, STATES, ROUNDING = np.random.default_rng(0), 200, 1e-12  # of numbers up to 1e2
START = ([0.6, 0.0], [0.0, 4.0])  # of the pendulum
NOW, POINTS = jnp.zeros(()), 3001  # saved times of a run; another number of them would compile anew


# The mechanisms: where the mass is, as a function of the coordinates, says it all.
def on_sphere(q, p):
    """Position [m] at q = (phi, theta) [rad]."""
    return SPHERICAL.position([p["R"], q[0], q[1]])


def on_spiral(q, p):
    """Position [m] at q = (theta,) [rad] on phi = arccot(a theta)."""
    theta, slope = q[0], p["a"] * q[0]
    return p["R"] / jnp.sqrt(1.0 + slope**2) * jnp.stack([jnp.cos(theta), jnp.sin(theta), slope])


def in_space(q):
    """Position [m] at q = (x, y, z)."""
    return q


def height(t, x, p):
    """Height above the sphere [m]."""
    return jnp.sqrt(jnp.sum(x**2)) - p["R"]


def by_hand(t, q, qd, p):
    """Lagrangian [J] of the mass on the sphere, with the velocity of part (f)."""
    speed2 = p["R"] ** 2 * (qd[0] ** 2 + (jnp.sin(q[0]) * qd[1]) ** 2)
    return 0.5 * p["m"] * speed2 - p["m"] * p["g"] * p["R"] * jnp.cos(q[0])


ON_SPHERE, ON_SPIRAL, IN_SPACE = (jms.point_mass(M, where, G) for where in (on_sphere, on_spiral, in_space))
PENDULUM = jms.Scene(by_hand, params=NUMBERS)
HELD = jms.Scene(IN_SPACE, params=NUMBERS, constraints=(jms.Constraint(height, at=in_space, name="sphere"),))


def bead(law, normal_force=None):
    """Bead on the spiral under a friction law along it; drag is one, so that what it takes is accounted as loss."""
    friction = jms.Friction(law, along=on_spiral, normal_force=normal_force)
    return jms.Scene(ON_SPIRAL, params=NUMBERS, effects=(friction,))


# What the parts share.
def claim(words, found, formula, bound=ROUNDING):
    """Print a claim with its largest error, and insist on it."""
    error = float(np.max(np.abs(np.asarray(found) - np.asarray(formula))))
    print(f"    {error:.0e}  {words}")
    assert error < bound, f"{words}: the error is {error}, not below {bound}"


def states(*ranges):
    """Random numbers in these ranges, shape [states, ranges]."""
    low, high = np.array(ranges).T
    return jnp.asarray(RANDOM.uniform(low, high, (STATES, len(ranges))))


def columns(*rows):
    """Vectors, shape [states, n], from their components."""
    return np.stack(np.broadcast_arrays(*rows), axis=-1)


def at_states(fn, *given):
    """What `fn` gives at each of many states."""
    return jax.tree.map(np.asarray, jax.jit(jax.vmap(fn))(*given))


@partial(jax.jit, static_argnums=0)
def moving(place, q, qd):
    """Positions and velocities [m, m/s] at many states."""
    return jax.vmap(lambda q, qd: jax.jvp(lambda q: place(q, NUMBERS), (q,), (qd,)))(q, qd)


@jax.jit
def energy(run):
    """Energy [J] along a run."""
    each = partial(energies, run.scene.lagrangian, params=run.scene.params)
    return sum(jax.vmap(each)(run.t, run.q, run.qd))


def losses(run, force):
    """Energy [J] that a bead has lost, and the integral of a force [N] against it times its velocity."""
    total, (_, v) = energy(run), moving(on_spiral, run.q, run.qd)
    slip = np.linalg.norm(v, axis=1) * np.sign(run.qd[:, 0])
    return total[0] - total[-1], np.trapezoid(force * slip, run.t)


def frame(chart, vectors, turn, q, qd, qdd):
    """Claims on unit vectors and angular velocity of a frame; returns components of velocity and acceleration."""

    @jax.jit
    def look(q, qd, qdd):
        basis, rate = jax.jvp(chart.basis, (q,), (qd,))
        own = chart.angular_velocity(q, qd), chart.velocity(q, qd), chart.acceleration(q, qd, qdd)
        return basis, rate, chart.right_handed(q), *own

    basis, rate, right_handed, w, v, a = map(np.asarray, look(q, qd, qdd))
    claim("the unit vectors are these,", basis, np.stack(vectors, axis=2))
    claim("orthonormal, e_i . e_j = (i == j),", np.swapaxes(basis, 1, 2) @ basis, np.eye(3))
    claim("and right-handed, e_1 x e_2 = e_3", np.cross(basis[..., 0], basis[..., 1]), basis[..., 2])
    assert right_handed.all()
    letter, formula, expected = turn
    print(f"({letter}) Its angular velocity in its own components: w = {formula}")
    claim("this is what the frame has,", w, expected)
    spatial = np.einsum("nij,nj->ni", basis, expected)[:, :, None]
    claim("and it turns the unit vectors, d e_i/dt = w x e_i", rate, np.cross(spatial, basis, axis=1))
    return v.T, a.T


def cylindrical():
    """Parts (a) to (c)."""
    q, qd, qdd = states((0.5, 2), (-3, 3), (-2, 2)), states(*[(-3, 3)] * 3), states(*[(-3, 3)] * 3)
    (r, theta, _), (r1, theta1, z1), (r2, theta2, z2) = (np.asarray(x).T for x in (q, qd, qdd))
    s, c, zero = np.sin(theta), np.cos(theta), np.zeros(STATES)
    print("(a) Cylindrical frame: e_r = (cos theta, sin theta, 0), e_theta = (-sin theta, cos theta, 0), e_z")
    vectors = columns(c, s, zero), columns(-s, c, zero), columns(zero, zero, 1.0)
    turn = ("b", "(0, 0, theta')", columns(zero, zero, theta1))
    v, a = frame(CYLINDRICAL, vectors, turn, q, qd, qdd)
    print("(c) Velocity and acceleration in it, with the centripetal and Coriolis terms")
    claim("v = (r', r theta', z')", v, [r1, r * theta1, z1])
    claim("a_r = r'' - r theta'^2", a[0], r2 - r * theta1**2)
    claim("a_theta = r theta'' + 2 r' theta'", a[1], r * theta2 + 2.0 * r1 * theta1)
    claim("a_z = z''", a[2], z2)


def spherical():
    """Parts (d) to (f)."""
    q, qd, qdd = states((0.5, 2), (0.3, 2.8), (-3, 3)), states(*[(-3, 3)] * 3), states(*[(-3, 3)] * 3)
    (r, phi, theta), (r1, phi1, theta1), (r2, phi2, theta2) = (np.asarray(x).T for x in (q, qd, qdd))
    s, c, st, ct = np.sin(phi), np.cos(phi), np.sin(theta), np.cos(theta)
    print("(d) Spherical frame: e_r = (sin phi cos theta, sin phi sin theta, cos phi), e_phi = d e_r/d phi, e_theta")
    vectors = columns(s * ct, s * st, c), columns(c * ct, c * st, -s), columns(-st, ct, 0.0)
    turn = ("e", "(cos(phi) theta', -sin(phi) theta', phi')", columns(c * theta1, -s * theta1, phi1))
    v, a = frame(SPHERICAL, vectors, turn, q, qd, qdd)
    print("(f) Velocity and acceleration in it")
    claim("v = (r', r phi', r sin(phi) theta')", v, [r1, r * phi1, r * s * theta1])
    claim("a_r = r'' - r phi'^2 - r sin(phi)^2 theta'^2", a[0], r2 - r * phi1**2 - r * s**2 * theta1**2)
    a_phi = r * phi2 + 2.0 * r1 * phi1 - r * s * c * theta1**2
    claim("a_phi = r phi'' + 2 r' phi' - r sin(phi) cos(phi) theta'^2", a[1], a_phi)
    a_theta = r * s * theta2 + 2.0 * r1 * s * theta1 + 2.0 * r * c * phi1 * theta1
    claim("a_theta = r sin(phi) theta'' + 2 r' sin(phi) theta' + 2 r cos(phi) phi' theta'", a[2], a_theta)


def sphere():
    """Part (g), and the equations of motion of part (h)."""
    q, qd = states((0.3, 2.8), (-3, 3)), states((-3, 3), (-4, 4))
    (phi, _), (phi1, theta1) = np.asarray(q).T, np.asarray(qd).T
    s, c, zero = np.sin(phi), np.cos(phi), np.zeros(STATES)
    qdd = at_states(lambda q, qd: acceleration(by_hand, NOW, q, qd, NUMBERS), q, qd)
    print("(g) Mass on the sphere r = R: the force of constraint is m a - m g, with a of part (f)")
    place = columns(R, *np.asarray(q).T)
    total = SPHERICAL.acceleration(place, columns(zero, phi1, theta1), columns(zero, *qdd.T))
    f = M * np.asarray(total) - M * columns(-G * c, G * s, zero)
    radial = M * (G * c - R * phi1**2 - R * s**2 * theta1**2)
    claim("f_r = m (g cos(phi) - R phi'^2 - R sin(phi)^2 theta'^2)", f[:, 0], radial)
    claim("f_phi = f_theta = 0: the sphere is smooth", f[:, 1:], 0.0)
    vector = radial[:, None] * np.asarray(SPHERICAL.basis(place))[:, :, 0]
    found = at_states(lambda q, qd: ON_SPHERE.reaction(NOW, q, qd, NUMBERS), q, qd)
    claim("the same as a vector, f_r e_r, is the `reaction` of `point_mass(m, position)`", found, vector)
    found = at_states(lambda x, v: forward_dynamics(NOW, State(x, v, {}), HELD).reactions, *moving(on_sphere, q, qd))
    claim("and in x, y, z with the constraint |x| = R, f_r is its multiplier", found["sphere"].multiplier[:, 0], radial)
    print("(h) The spherical pendulum by Lagrange, from L = m v^2/2 - m g z")
    claim("phi'' = sin(phi) cos(phi) theta'^2 + (g/R) sin(phi)", qdd[:, 0], s * c * theta1**2 + G / R * s)
    claim("theta'' = -2 cot(phi) phi' theta'", qdd[:, 1], -2.0 * c / s * phi1 * theta1)


def pendulum(smoke):
    """The rest of part (h): what is conserved along a run. Returns times, and errors of momentum and energy."""
    print("    theta is cyclic (dL/dtheta = 0): its momentum m R^2 sin(phi)^2 theta' is conserved; relative errors:")
    assert jms.cyclic_coordinates(PENDULUM, 2) == (1,)
    t1, errors = 60.0, {}
    p0, ts = M * R**2 * np.sin(START[0][0]) ** 2 * START[1][1], jnp.linspace(0.0, t1, POINTS)
    runs = {"Tsit5, rtol 1e-6": (jms.simulate(PENDULUM, *START, t1, ts=ts), 1e-2, 1e-2)}
    if not smoke:
        symplectic = jms.simulate(PENDULUM, *START, t1, ts=ts, solver=jms.Gauss(), dt=5e-3)
        runs["Gauss, dt 5 ms"] = (symplectic, ROUNDING, 1e-6)
    for name, (run, bound_p, bound_e) in runs.items():
        p, e = np.asarray(run.momentum[:, 1]) / p0, np.asarray(energy(run))
        claim(f"{name}, {t1:g} s: momentum,", p, 1.0, bound_p)
        claim("and energy", e / e[0], 1.0, bound_e)
        errors[name] = np.abs(p - 1.0), np.abs(e / e[0] - 1.0)
    return ts, errors


def poles():
    """Past the poles, where the angles of part (h) fail. Returns runs in x, y, z."""
    print("    Past the lower pole, from phi = 2, theta' = w; steps at rtol 1e-9 in angles, and in x, y, z on |x| = R:")
    fine = {"ts": jnp.linspace(0.0, 3.0, POINTS), "rtol": 1e-9, "atol": 1e-11}

    def held(q, qd):
        x, v = moving(on_sphere, jnp.array([q]), jnp.array([qd]))
        return jms.simulate(HELD, x[0], v[0], 3.0, **fine)

    for w in (1.0, 1e-2, 1e-4, 1e-6, 1e-8):
        angles, free = jms.simulate(PENDULUM, [2.0, 0.0], [0.0, w], 3.0, **fine), held([2.0, 0.0], [0.0, w])
        apart = jnp.max(jnp.abs(moving(on_sphere, angles.q, angles.qd)[0] - free.q))
        steps = [int(run.stats["num_steps"]) for run in (angles, free)]
        print(f"    w = {w:5.0e} rad/s: {steps[0]:5d} and {steps[1]:4d} steps; {apart:.0e} m apart")
    refused = jms.simulate(PENDULUM, [0.0, 0.0], [0.1, 0.0], 3.0, throw=False, **fine)
    print(f"    From the upper pole the angles cannot start: {refused.result}")
    over = jms.simulate(HELD, [0.0, 0.0, R], [0.1, 0.0, 0.0], 3.0, **fine)
    radial, cosine = over.reactions["sphere"].multiplier[:, 0], over.q[:, 2] / R
    i = int(jnp.argmax(radial < 0))
    print("    In x, y, z a mass starts there at v0 and passes both poles.")
    lift = np.interp(0.0, -radial[i - 1 : i + 1], cosine[i - 1 : i + 1])
    words = "f_r turns inwards (lying loose, it would lift off) at cos(phi) = 2/3 + v0^2/(3 g R)"
    claim(words, lift, 2.0 / 3.0 + 0.1**2 / (3.0 * G * R), 1e-6)
    return {"over the poles": over, "around": held(*START)}


def spiral():
    """The equations of motion of parts (i) and (j)."""
    q, qd, k, mu = states((-10, 10)), states((-3, 3)), 0.7, 0.3
    theta, theta1 = np.asarray(q)[:, 0], np.asarray(qd)[:, 0]
    u = (A * theta) ** 2
    pace = R * np.sqrt(1.0 + A**2 + u) / (1.0 + u)
    free = A**2 * theta * (1.0 + 2.0 * A**2 + u) / ((1.0 + u) * (1.0 + A**2 + u)) * theta1**2
    free = free - G / R * A * np.sqrt(1.0 + u) / (1.0 + A**2 + u)
    print("(i) Bead on the spiral phi = arccot(a theta), written with u = (a theta)^2")
    v2 = np.sum(np.square(moving(on_spiral, q, qd)[1]), axis=1)
    claim("v^2 = (s' theta')^2 with the length per radian s' = R sqrt(1 + a^2 + u)/(1 + u)", v2, (pace * theta1) ** 2)
    words = "theta'' = a^2 theta (1 + 2 a^2 + u)/((1 + u)(1 + a^2 + u)) theta'^2 - (g/R) a sqrt(1 + u)/(1 + a^2 + u)"
    claim(words, at_states(lambda q, qd: acceleration(ON_SPIRAL, NOW, q, qd, NUMBERS), q, qd)[:, 0], free)
    normal = at_states(lambda q, qd: ON_SPIRAL.normal_force(NOW, q, qd, NUMBERS), q, qd)
    newton = at_states(lambda q, qd: jms.problems.spiral_bead.normal_force(q, qd, **NUMBERS), q, qd)
    claim("the force N of the wire, across the path, is that of Newton's law in the frame of (d)", normal, newton)
    print("(j) The same with drag, and with dry friction under the force of the wire")

    def rate(scene, direction=None):
        return at_states(lambda q, qd, mode: vector_field(NOW, State(q, qd, {}), scene, mode).qd, q, qd, direction)[
            :, 0
        ]

    claim("a drag -k v adds -(k/m) theta' to theta''", rate(bead(jms.Viscous(k))), free - k / M * theta1)
    slowed = free - mu * newton / (M * pace) * np.sign(theta1)
    claim(
        "friction mu N adds -mu N/(m s') sign(theta')",
        rate(bead(jms.Coulomb(mu), ON_SPIRAL.normal_force), jnp.sign(qd)),
        slowed,
    )


def beads(smoke):
    """The runs of parts (i) and (j), and where their energy goes. Returns the runs and the account."""
    k, mu, t1, start = 0.15, 0.2, 10.0, ([7.0], [-5.5])
    fine = {"ts": jnp.linspace(0.0, t1, POINTS), "rtol": 1e-9, "atol": 1e-11}
    runs = {"no drag": jms.simulate(bead(jms.Viscous(0.0)), *start, t1, **fine)}
    runs[f"drag, k = {k:g} N s/m"] = drag = jms.simulate(bead(jms.Viscous(k)), *start, t1, **fine)
    print(f"    {t1:g} s down the wire, errors in joules:")
    kept = energy(runs["no drag"])
    claim("without drag the energy is conserved,", kept, kept[0], 1e-6)
    words = "with it what is lost is the integral of k v^2 (by the trapezoidal rule)"
    claim(words, *losses(drag, drag.forces["friction"]), 1e-4)
    if smoke:
        return runs, None
    audit = jms.energy_audit(drag)
    gone = audit.kinetic[0] + audit.potential[0] - audit.kinetic - audit.potential
    claim("and what the account of the run calls dissipated", audit.dissipated["friction"], gone, 1e-6)
    # The default for one coordinate with events, Rodas5P, takes twice as long to compile.
    dry = jms.simulate(
        bead(jms.Coulomb(mu), ON_SPIRAL.normal_force), *start, t1, **fine, solver=dfx.Tsit5(), max_events=8
    )
    runs[f"dry friction, mu = {mu:g}"] = dry
    claim("under friction it is the integral of mu N v", *losses(dry, dry.forces["friction"]), 1e-4)
    _, tangent = moving(on_spiral, dry.q[-1:], jnp.ones((1, 1)))
    slope = float(tangent[0, 2] / jnp.linalg.norm(tangent))
    stuck = float(dry.t[jnp.argmax(dry.mode["friction"] == 0)])
    print(f"    From t = {stuck:.2f} s on it sticks, where the wire still falls by {slope:.3f} < mu:")
    claim("friction carries the weight along the wire, m g dz/ds", -dry.forces["friction"][-1], M * G * slope)
    return runs, audit


def path(axis, x, color, **options):
    """A path on the sphere, pale on the far side."""
    near = (np.asarray(x) @ SPHERICAL.basis([1.0, *np.deg2rad(EYE)])[:, 0] > 0)[:, None]
    axis.plot(*np.where(near, np.nan, x).T, color=color, alpha=0.25, **options)
    axis.plot(*np.where(near, x, np.nan).T, color=color, **options)


def globe(axis, title):
    """A sphere to draw paths on."""
    axis.set_proj_type("ortho")
    axis.view_init(elev=90.0 - EYE[0], azim=EYE[1])
    turn = np.linspace(0.0, 2.0 * np.pi, 73)[:, None]
    for phi in (30.0, 60.0, 90.0, 120.0, 150.0):
        path(axis, SPHERICAL.position(columns(R, np.deg2rad(phi), turn[:, 0])), "#bbbbbb", lw=0.6)
    _, down, right = SPHERICAL.basis([1.0, *np.deg2rad(EYE)]).T
    axis.plot(*(R * (np.cos(turn) * down + np.sin(turn) * right)).T, color=GREY, lw=1)
    for each in (axis.xaxis, axis.yaxis, axis.zaxis):
        each.pane.set_alpha(0.0)
    axis.grid(visible=False)
    axis.set(title=title, **{f"{x}ticks": [-1, 0, 1] for x in "xyz"}, **{f"{x}label": f"{x} [m]" for x in "xyz"})
    axis.set_box_aspect((1, 1, 1), zoom=1.1)


def below(axis, ncols=2):
    """A legend below a panel."""
    axis.legend(loc="upper center", bbox_to_anchor=(0.5, -0.14), ncols=ncols, frameon=False, fontsize=9)


def draw(conserved, swings, runs, audit):
    """The figure."""
    figure = Figure(figsize=(15, 9), layout="constrained")
    grid = figure.add_gridspec(2, 3, width_ratios=(1.2, 1, 1))
    ball, wire = (figure.add_subplot(grid[i, 0], projection="3d") for i in (0, 1))
    force, errors, speed, account = (figure.add_subplot(grid[i, j]) for i in (0, 1) for j in (1, 2))

    globe(ball, "Spherical pendulum: around, and over the poles")
    for (name, run), color in zip(swings.items(), (RED, BLUE), strict=False):
        path(ball, run.q, color, lw=2)
        formula = M * (G * run.q[:, 2] - np.sum(np.square(run.qd), axis=1)) / R
        force.plot(run.t, formula, color=color, lw=6, alpha=0.3, label=f"{name}: formula")
        force.plot(run.t, run.reactions["sphere"].multiplier[:, 0], color=color, lw=1.2, label="multiplier of |x| = R")
        below(force)
    force.axhspan(0.0, 8.0, color=GREY, alpha=0.15, lw=0)
    force.text(0.0, 6.2, "outwards: a mass that lies loose stays on")
    force.text(0.0, -24.0, "inwards:\nit lifts off")
    force.set(ylabel="radial force of constraint [N]", ylim=(-28, 8), title="The sphere pushes, then pulls")

    t, by_solver = conserved
    for (name, both), color in zip(by_solver.items(), (RED, BLUE), strict=False):
        for x, what, style in zip(both, ("momentum of theta", "energy"), ("-", "--"), strict=True):
            errors.semilogy(t[1:], np.maximum.accumulate(x)[1:], color=color, ls=style, lw=1.8, label=f"{name}: {what}")
    errors.set(ylabel="largest relative error so far", ylim=(1e-17, 1e-2), title="What a run conserves")
    below(errors)

    globe(wire, "Bead on the spiral: a dot every 0.2 s")
    turns = np.linspace(-60.0, 8.0, 4000)[:, None]
    path(wire, moving(on_spiral, turns, turns)[0], "black", lw=1)
    for (name, run), color in zip(runs.items(), (BLUE, RED, GREEN), strict=False):
        x, v = map(np.asarray, moving(on_spiral, run.q, run.qd))
        speed.plot(run.t, np.linalg.norm(v, axis=1), color=color, lw=2, label=name)
        if name != "no drag":
            path(wire, x[::60], color, ls="", marker="o", ms=4)
        if "dry" in name:
            wire.plot(*x[-1], color=color, marker="*", ms=16, mec="black", ls="", label="sticks here")
            wire.legend(loc="upper left", bbox_to_anchor=(0.0, 0.95), frameon=False)
    speed.set(ylabel="speed [m/s]", ylim=(0, None), title="Free, braked by drag, stuck by friction")
    below(speed, 3)

    if audit is not None:
        stack = audit.kinetic, audit.potential + M * G * R, audit.dissipated["friction"]
        names = "kinetic", "potential, from the lower pole", "dissipated"
        account.stackplot(audit.t, *stack, labels=names, colors=(BLUE, YELLOW, GREY), alpha=0.6)
        below(account, 3)
    account.set(ylabel="energy [J]", title="Drag: nothing is missing")
    for axis in (force, errors, speed, account):
        axis.set_xlabel("time [s]")
    for letter, axis in zip("abcdef", (ball, force, errors, wire, speed, account), strict=True):
        title = axis.get_title()
        axis.set_title("")
        axis.set_title(f"$\\bf{{{letter}}}$  {title}", loc="left")
    return figure


def main(out: Path, smoke: bool = False) -> None:
    """All parts in order, then the figure."""
    print("largest error at random states, and of what")
    cylindrical()
    spherical()
    sphere()
    conserved = pendulum(smoke)
    swings = {} if smoke else poles()
    spiral()
    runs, audit = beads(smoke)
    out.mkdir(parents=True, exist_ok=True)
    draw(conserved, swings, runs, audit).savefig(out / "c0_point_mass_on_a_sphere.png", dpi=130)
    print(f"wrote {out / 'c0_point_mass_on_a_sphere.png'}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--smoke", action="store_true", help="small and quick")
    parser.add_argument("--out", type=Path, default=Path("example-output"))
    arguments = parser.parse_args()
    main(arguments.out, arguments.smoke)
