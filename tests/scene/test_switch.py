"""Events of the user's own: closed forms and matrix exponentials on either side of a guard."""

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm
from scipy.optimize import brentq

import jaxmodsim as jms

lagrangian = lambda t, q, qd, p: 0.5 * p["m"] * qd[0] ** 2  # noqa: E731
delayed = lambda t, q, qd, p: t - p["begin"]  # noqa: E731
constant = lambda t, q, qd, p: p["F"] * jnp.ones(1)  # noqa: E731


PUSHED = jms.Scene(
    lagrangian, params={"m": 2.0, "begin": 3.0, "F": 7.0}, effects=(jms.Switch(delayed, above=constant, name="push"),)
)


def place(scene):
    return jms.simulate(scene, [0.0], [0.0], 10.0).q[-1, 0]


@pytest.mark.quick
def test_a_switching_time_has_its_derivative():
    # q = F (t - begin)^2 / (2 m)
    assert place(PUSHED) == pytest.approx(85.75, rel=1e-9)
    gradient = jax.jit(jax.grad(place))(PUSHED).params
    assert gradient["begin"] == pytest.approx(-24.5, rel=1e-9)
    assert gradient["F"] == pytest.approx(12.25, rel=1e-9)
    assert gradient["m"] == pytest.approx(-42.875, rel=1e-9)


def test_a_switching_time_has_its_second_derivative():
    def by_begin(begin):
        return place(jms.Scene(lagrangian, params={**PUSHED.params, "begin": begin}, effects=PUSHED.effects))

    assert jax.jit(jax.hessian(by_begin))(3.0) == pytest.approx(3.5, rel=1e-8)


@pytest.mark.parametrize("k", [1e8, 1e10])
def test_derivatives_behind_a_switch_onto_a_stiff_spring(k):
    """It acts for pi/sqrt(k), 3e-4 s or 3e-5 s, and gives the speed back."""
    spring = jms.Switch(lambda t, q, qd, p: q[0], below=lambda t, q, qd, p: -p["k"] * q, name="spring")
    scene = jms.Scene(lambda t, q, qd, p: 0.5 * qd[0] ** 2, {"k": k}, (spring,))

    def after(v):
        return jms.simulate(scene, [0.1], -v[None], 1.0, rtol=1e-9, atol=1e-12).qd[-1, 0]

    value, slope = jax.jit(jax.value_and_grad(after))(2.0)
    np.testing.assert_allclose([value, slope], [2.0, 1.0], rtol=1e-7)


def test_a_switch_at_a_sample_of_an_input_has_the_derivative_of_its_own_force():
    """The jump of the input does not move with the switch."""
    motor = jms.Switch(lambda t, q, qd, p: p["stop"] - t, above=constant, name="motor")
    push = jms.AppliedForce(lambda t, q, qd, p: p["u"][None])

    def by_stop(stop, u):
        params = {"m": 1.0, "F": 2.0, "stop": stop, "u": jms.Signal(jnp.array([0.0, 1.0]), u)}
        return jms.simulate(jms.Scene(lagrangian, params=params, effects=(motor, push)), [0.0], [0.0], 2.0).q[-1, 0]

    inputs = jnp.array([[4.0, 0.0], [0.0, 4.0], [3.0, 3.0]])
    # F (2 - stop)
    np.testing.assert_allclose(jax.jit(jax.vmap(jax.grad(by_stop), (None, 0)))(1.0, inputs), 2.0, rtol=1e-8)


def test_a_switch_is_logged_saved_and_balanced():
    run = jms.simulate(PUSHED, [0.0], [0.0], 10.0, ts=jnp.linspace(0.0, 10.0, 11))
    (change,) = run.mode_changes
    assert change[1:] == ("push", "below", "above")
    assert change.t == pytest.approx(3.0, rel=1e-14)
    # A sample at the event itself holds what is after it.
    assert run.mode["push"].tolist() == [-1.0] * 3 + [1.0] * 8
    assert run.forces["push"][:, 0].tolist() == [0.0] * 3 + [7.0] * 8
    np.testing.assert_allclose(run.energy.balance, 0.0, atol=1e-10)


# x' = A x, with another matrix on either side of x[0] + 0.3 x[1] = level.
SIDE = np.array([1.0, 0.3])
NUMBERS = {"k": (4.0, 30.0), "c": (0.1, 0.6), "level": 0.2}


def matrix(side, numbers):
    return np.array([[0.0, 1.0], [-numbers["k"][side], -numbers["c"][side]]])


def exactly(numbers, x, t):
    """State after t and the instants of the crossings, from matrix exponentials and roots."""
    now, times = 0.0, []
    side = int(SIDE @ x > numbers["level"])
    while True:
        a = matrix(side, numbers)

        def guard(h, a=a, x=x):
            return SIDE @ expm(a * h) @ x - numbers["level"]

        grid = np.linspace(1e-6, t - now, 4001)
        signs = np.sign([guard(h) for h in grid])
        crossed = np.flatnonzero(signs != (1.0 if side else -1.0))
        if not crossed.size or t - now < 1e-6:
            return expm(a * (t - now)) @ x, times
        i = crossed[0]
        h = float(brentq(guard, grid[i - 1], grid[i], xtol=1e-15))  # pyright: ignore[reportArgumentType]
        now, x, side = now + h, expm(a * h) @ x, 1 - side
        times.append(now)


side_of = lambda t, q, qd, p: q[0] + 0.3 * qd[0] - p["level"]  # noqa: E731


def spring(i):
    return lambda t, q, qd, p: -p["k"][i] * q - p["c"][i] * qd


LINEAR = jms.Scene(
    lambda t, q, qd, p: 0.5 * qd[0] ** 2,
    params={"k": jnp.asarray(NUMBERS["k"]), "c": jnp.asarray(NUMBERS["c"]), "level": NUMBERS["level"]},
    effects=(jms.Switch(side_of, above=spring(1), below=spring(0)),),
)


@pytest.fixture(scope="module")
def of_linear():
    return jax.jit(lambda scene: jms.simulate(scene, [1.0], [0.0], 6.0, rtol=1e-10, atol=1e-12, max_events=32))


def test_two_linear_systems_take_turns(of_linear):
    run = of_linear(LINEAR)
    end, times = exactly(NUMBERS, np.array([1.0, 0.0]), 6.0)
    assert len(times) > 4
    np.testing.assert_allclose([run.q[-1, 0], run.qd[-1, 0]], end, rtol=1e-7, atol=1e-8)
    events = jms.simulate(LINEAR, [1.0], [0.0], 6.0, rtol=1e-10, atol=1e-12, max_events=32).events
    np.testing.assert_allclose(events.t, times, rtol=1e-9)


def test_derivatives_of_two_linear_systems_are_those_of_the_exponentials(of_linear):
    forward = jax.jit(jax.jacfwd(lambda scene: of_linear(scene).q[-1, 0]))(LINEAR).params
    reverse = jax.jit(jax.grad(lambda scene: of_linear(scene).q[-1, 0]))(LINEAR).params

    def difference(name, i=None, h=1e-5):
        # Central: the error of 1e-10 over h, and h^2 of the third derivative.
        def at(step):
            numbers = dict(NUMBERS)
            if i is None:
                numbers[name] += step
            else:
                numbers[name] = tuple(x + step * (j == i) for j, x in enumerate(NUMBERS[name]))
            return exactly(numbers, np.array([1.0, 0.0]), 6.0)[0][0]

        return (at(h) - at(-h)) / (2.0 * h)

    for mode in (forward, reverse):
        assert mode["level"] == pytest.approx(difference("level"), rel=1e-6)
        for name in ("k", "c"):
            expected = [difference(name, i) for i in (0, 1)]
            np.testing.assert_allclose(mode[name], expected, rtol=1e-6, atol=1e-8)


def test_a_spiral_that_turns_at_the_unit_circle():
    """x' = A x, turning one way inside the unit circle and the other way outside, by `EventSolver` itself.

    From |x| = e^-1 it reaches the circle at t = 1, at the angle -2 pi, and goes back.
    """
    turn = 2.0 * jnp.pi

    def field(_, s, args):
        del args
        sign = jnp.where(s.mode > 0, -1.0, 1.0)
        a = jnp.array([[1.0, sign * turn], [-sign * turn, 1.0]])
        return s.rate(a @ s.y)

    def guards(_, s, args):
        del args
        return s.mode[None] * -(1.0 - jnp.sum(s.y**2))

    def end(x0, t1):
        solver = jms.EventSolver(dfx.Tsit5(), guards, lambda t, s, args, fired: s._replace(mode=-s.mode))
        solution = dfx.diffeqsolve(
            dfx.ODETerm(field),
            solver,
            0.0,
            t1,
            None,
            solver.start(0.0, x0, jnp.asarray(-1.0)),
            stepsize_controller=jms.EventController(dfx.PIDController(rtol=1e-11, atol=1e-11)),
            adjoint=jms.StoredSteps(),
        )
        assert solution.ys is not None
        return solution.ys.y[-1]

    x0 = jnp.array([jnp.exp(-1.0), 0.0])
    angle = turn * 0.5
    expected = np.exp(0.5) * np.array([np.cos(angle), np.sin(angle)])
    np.testing.assert_allclose(jax.jit(end)(x0, 1.5), expected, rtol=1e-8, atol=1e-8)
    # With the radius r = x0 the circle is reached at -log r; from there the angle turns back.
    by_radius = jax.jit(jax.jacrev(lambda r: end(jnp.array([r, 0.0]), 1.5)))(jnp.exp(-1.0))
    r = np.exp(-1.0)
    # x(t) = r e^t (cos, sin)(2 pi (t + 2 log r)), as the time outside is t + log r and inside -log r
    x = np.exp(1.5) * r * np.array([np.cos(angle), np.sin(angle)])
    spin = np.exp(1.5) * r * np.array([-np.sin(angle), np.cos(angle)]) * 2.0 * turn / r
    np.testing.assert_allclose(by_radius, x / r + spin, rtol=1e-7, atol=1e-6)


def test_an_event_without_a_force_has_a_time_with_derivatives():
    # A free fall from h passes the light barrier at height b at sqrt(2 (h - b)/g).
    barrier = jms.Switch(lambda t, q, qd, p: q[0] - p["b"], name="barrier")
    scene = jms.Scene(lambda t, q, qd, p: 0.5 * qd[0] ** 2 - 9.81 * q[0], params={"b": 1.0}, effects=(barrier,))
    fall = np.sqrt(2.0 * 4.0 / 9.81)

    def passes(scene):
        return jms.simulate(scene, [5.0], [0.0], 1.0).events.t[0]

    assert passes(scene) == pytest.approx(fall, rel=1e-9)
    assert jax.jit(jax.grad(passes))(scene).params["b"] == pytest.approx(-1.0 / (9.81 * fall), rel=1e-8)


def test_a_switch_breaks_a_stick_at_its_instant():
    # A box of 2 kg sticks under 1 N below its limit of 3 N; another 7 N from t = 3 on move it.
    scene = jms.Scene(
        lagrangian,
        params=PUSHED.params,
        effects=(
            jms.AppliedForce(lambda t, q, qd, p: jnp.ones(1)),
            jms.Friction(jms.Coulomb(3.0)),
            jms.Switch(delayed, above=constant),
        ),
    )
    assert place(scene) == pytest.approx(5.0 / 2.0 * 24.5, rel=1e-8)
    gradient = jax.jit(jax.grad(place))(scene)
    assert gradient.params["begin"] == pytest.approx(-5.0 / 2.0 * 7.0, rel=1e-8)
    assert gradient.effects[1].law.Fc == pytest.approx(-24.5 / 2.0, rel=1e-8)
    changes = jms.simulate(scene, [0.0], [0.0], 10.0).mode_changes
    assert [(x.effect, x.before, x.after) for x in changes] == [
        ("friction", "stick", "forward"),
        ("switch", "below", "above"),
    ]
    assert changes[0].t == changes[1].t


def test_a_switch_throws_a_ball_off_the_floor():
    # It lies there, until at t = 3 a force of 5 g lifts it with 4 g.
    scene = jms.Scene(
        lambda t, q, qd, p: 0.5 * qd[0] ** 2 - 9.81 * q[0],
        params={"begin": 3.0, "F": 5.0 * 9.81},
        effects=(jms.Switch(delayed, above=constant),),
        constraints=(jms.Contact(lambda t, q, p: q[0]),),
    )

    def height(scene):
        return jms.simulate(scene, [0.0], [0.0], 4.0).q[-1, 0]

    assert height(scene) == pytest.approx(0.5 * 4.0 * 9.81, rel=1e-8)
    assert jax.jit(jax.grad(height))(scene).params["begin"] == pytest.approx(-4.0 * 9.81, rel=1e-8)


def test_runs_side_by_side_switch_at_their_own_times():
    begin = jnp.array([0.5, 3.0, 9.0, 20.0])
    scenes = jax.vmap(lambda x: jms.Scene(lagrangian, params={**PUSHED.params, "begin": x}, effects=PUSHED.effects))(
        begin
    )
    expected = 7.0 / 4.0 * np.maximum(10.0 - begin, 0.0) ** 2
    np.testing.assert_allclose(jax.jit(jax.vmap(place))(scenes), expected, rtol=1e-8, atol=1e-12)


def test_a_guard_of_zero_at_the_start_counts_by_its_rate():
    def run(velocity):
        scene = jms.Scene(lagrangian, params={"m": 1.0}, effects=(jms.Switch(lambda t, q, qd, p: q[0]),))
        return jms.simulate(scene, [0.0], [velocity], 1.0)

    for velocity, side in ((1.0, 1.0), (-1.0, -1.0)):
        outcome = run(velocity)
        assert outcome.mode["switch"].tolist() == [side]
        assert not outcome.mode_changes


def test_forces_that_push_back_from_both_sides_are_named():
    relay = jms.Switch(
        lambda t, q, qd, p: q[0] + qd[0],
        above=lambda t, q, qd, p: -jnp.ones(1),
        below=lambda t, q, qd, p: jnp.ones(1),
        name="relay",
    )
    far = jms.Contact(lambda t, q, p: q[0] + 100.0)
    # Impacts may accumulate, and friction may be held: neither is a reason to keep the side of a switch.
    for contacts, held in (((), False), ((), True), ((far,), False)):
        scene = jms.Scene(lagrangian, {"m": 1.0}, (relay,), contacts)
        with pytest.raises(jms.SimulationError, match=r"crossings of 'relay' accumulate.*sliding mode"):
            jms.simulate(scene, [0.1], [0.0], 10.0, stick_on_chatter=held)


@pytest.mark.quick
def test_wrong_functions_are_refused():
    with pytest.raises(ValueError, match="Switch guard must be a function"):
        jms.Switch(1.0)
    with pytest.raises(ValueError, match="Switch above must be a function"):
        jms.Switch(delayed, above=3.0)
    for switch, message in (
        (jms.Switch(lambda t, q, qd, p: q), r"guard returned the shape \(1,\), but \(\) is needed: one number"),
        (jms.Switch(delayed, below=lambda t, q, qd, p: jnp.ones(2)), r"below returned the shape \(2,\), but \(1,\)"),
    ):
        scene = jms.Scene(lagrangian, params=PUSHED.params, effects=(switch,))
        with pytest.raises(ValueError, match=message):
            jms.simulate(scene, [0.0], [0.0], 1.0)
    with pytest.raises(ValueError, match="ImplicitFriction takes no events, by which push changes"):
        jms.simulate(PUSHED, [0.0], [0.0], 1.0, dt=0.1, solver=jms.ImplicitFriction())


def test_an_orbit_passes_switches():
    """x'' + 0.3 x' + k x = cos 2t, with k = 1 for x < 0 and 5 for x > 0, against DOP853 from crossing to crossing."""
    stop = jms.Switch(lambda t, q, qd, p: q[0], above=lambda t, q, qd, p: -p["k"] * q, name="stop")
    scene = jms.Scene(
        lambda t, q, qd, p: 0.5 * (qd[0] ** 2 - q[0] ** 2),
        params={"k": 4.0},
        effects=(stop, jms.AppliedForce(lambda t, q, qd, p: jnp.cos(2.0 * t) - 0.3 * qd)),
    )
    orbit = jms.periodic_orbit(scene, ([0.1], [0.0]), period=lambda p: np.pi)

    def field(t, y, k):
        return [y[1], np.cos(2.0 * t) - 0.3 * y[1] - k * y[0]]

    class Crossing:
        terminal, direction = True, 0.0

        def __call__(self, t, y, k):
            del t, k
            return y[0]

    crossing = Crossing()
    t, y = float(orbit.t0), np.array([orbit.q[0], orbit.qd[0]])
    end, begin = t + np.pi, y
    for _ in range(16):
        above = y[0] > 0 or (y[0] == 0 and y[1] > 0)
        k, crossing.direction = (5.0, -1.0) if above else (1.0, 1.0)
        part = solve_ivp(field, (t, end), y, args=(k,), events=crossing, method="DOP853", rtol=1e-12, atol=1e-14)
        t, y = part.t[-1], part.y[:, -1]
        if part.status == 0:
            break
        y = np.array([0.0, y[1]])
    np.testing.assert_allclose(y, begin, atol=1e-7)
    # By Liouville's formula the multipliers' product is that of the damping alone.
    assert np.prod(orbit.multipliers).real == pytest.approx(np.exp(-0.3 * np.pi), rel=1e-6)
    assert orbit.stick == {"stop": 0.0}
