"""Derivatives from stored steps, in plain diffrax: those of `ForwardMode`, which differentiates the same steps."""

from typing import Any

import diffrax as dfx
import jax
import jax.core
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmodsim import EventController, EventSolver, Gauss, Rodas5P, StoredSteps
from jaxmodsim._core.compat import eqxi
from jaxmodsim.solvers._error_checks import without_single_roundings

# Over the steps of the plain run, which are those of `ForwardMode`.
SAME_STEPS = StoredSteps(probe=False)
NUMBERS = {"mu": 1.5, "f": 0.4, "x0": 1.0, "t0": 0.2, "t1": 3.0}
SOLVERS: dict[str, Any] = {
    "Tsit5": dfx.Tsit5(),
    "Dopri8": dfx.Dopri8(),
    "Kvaerno5": dfx.Kvaerno5(),
    "Rodas5P": Rodas5P(),
    "Gauss": Gauss(),
}
SAVE_AT = {
    "times": lambda p, ts: dfx.SaveAt(ts=ts, fn=lambda t, y, args: p["f"] * t * y[0]),  # closes over a number
    "everything": lambda p, ts: dfx.SaveAt(t0=True, t1=True, ts=ts),
    "all kinds": lambda p, ts: dfx.SaveAt(
        subs=[
            dfx.SubSaveAt(ts=ts, fn=lambda t, y, args: p["f"] * t * y[0]),
            dfx.SubSaveAt(t0=True, t1=True, ts=ts),
            dfx.SubSaveAt(ts=ts[:2]),
            dfx.SubSaveAt(t1=True, fn=lambda t, y, args: args["mu"] * y),
        ]
    ),
    "steps": lambda p, ts: dfx.SaveAt(subs=[dfx.SubSaveAt(steps=True), dfx.SubSaveAt(steps=3, t0=True, t1=True)]),
    "dense": lambda p, ts: dfx.SaveAt(dense=True),
}


def van_der_pol(t: Any, y: Any, p: Any) -> Any:
    return jnp.stack([y[1], p["mu"] * (1 - y[0] ** 2) * y[1] - y[0] + p["f"] * jnp.cos(t)])


def total(p: Any, adjoint: Any, solver: str, save: str, max_steps: int = 500) -> Any:
    """Weighted sum of what is saved of a run."""
    ts = jnp.stack([p["t0"] + 0.3, p["t0"] + 0.8, p["t1"] - 0.2])
    fixed = solver == "Gauss"
    solution = dfx.diffeqsolve(
        dfx.ODETerm(van_der_pol),
        SOLVERS[solver],
        p["t0"],
        p["t1"],
        0.02 if fixed else 0.01,
        jnp.stack([p["x0"], jnp.zeros_like(p["x0"])]),
        p,
        saveat=SAVE_AT[save](p, ts),
        stepsize_controller=dfx.ConstantStepSize() if fixed else dfx.PIDController(1e-7, 1e-9),
        adjoint=adjoint,
        max_steps=max_steps,
        throw=max_steps == 500,
    )
    if save == "dense":
        return jnp.sum(jax.vmap(solution.evaluate)(ts))

    def weighted(y: Any) -> Any:
        weights = jnp.reshape(jnp.sin(jnp.arange(y.size, dtype=y.dtype)), y.shape)
        return jnp.sum(jnp.where(jnp.isfinite(y), y, 0.0) * weights)

    times: Any = [] if save == "steps" else [weighted(t) for t in jax.tree.leaves(solution.ts)]
    return sum([weighted(y) for y in jax.tree.leaves(solution.ys)], jnp.zeros(())) + sum(times)


def numbers(dtype: Any = float) -> dict[str, Any]:
    return {name: jnp.asarray(x, dtype) for name, x in NUMBERS.items()}


@pytest.mark.parametrize(
    ("solver", "save"),
    [("Tsit5", save) for save in ("all kinds", "steps", "dense")] + [(x, "times") for x in SOLVERS if x != "Tsit5"],
)
def test_equals_forward_mode(solver: str, save: str) -> None:
    """In both modes. Except by t0, with which `ForwardMode` moves all steps: that differs by the error of the method.

    Equations of an implicit method are solved to a tolerance, and t1 enters them by the length of a step.
    """
    ahead = jax.jit(jax.jacfwd(lambda p: total(p, dfx.ForwardMode(), solver, save)))(numbers())
    for mode in (jax.grad, jax.jacfwd):
        slopes = jax.jit(mode(lambda p: total(p, SAME_STEPS, solver, save)))(numbers())
        for name in ("mu", "f", "x0", "t1"):
            np.testing.assert_allclose(slopes[name], ahead[name], rtol=1e-8 if name == "t1" else 1e-11, err_msg=name)
        if save != "steps":  # the times of steps are constants
            np.testing.assert_allclose(slopes["t0"], ahead["t0"], rtol=1e-3)


@pytest.fixture(scope="module")
def wanted() -> dict[str, Any]:
    return jax.jit(jax.grad(lambda p: total(p, StoredSteps(), "Tsit5", "everything")))(numbers())


@pytest.mark.parametrize("every", [3, 500])
def test_steps_between_those_kept_are_made_again(every: int, wanted: dict[str, Any]) -> None:
    """At their recorded times: a run of 40 steps, all of them from the first one if no other is kept."""
    for mode in (jax.grad, jax.jacfwd):
        slopes = jax.jit(mode(lambda p: total(p, StoredSteps(every), "Tsit5", "everything")))(numbers())
        for name in NUMBERS:
            np.testing.assert_allclose(slopes[name], wanted[name], rtol=1e-10, err_msg=name)


def test_second_derivatives() -> None:
    """Forward over reverse and twice forward; reverse over reverse says what to take."""
    names = ("mu", "f", "x0")

    def by(x: Any, adjoint: Any) -> Any:
        return total({**numbers(), **dict(zip(names, x, strict=True))}, adjoint, "Tsit5", "times")

    x = jnp.array([NUMBERS[name] for name in names])
    wanted = jax.jit(jax.jacfwd(jax.jacfwd(lambda x: by(x, dfx.ForwardMode()))))(x)
    for second in (jax.hessian(by), jax.jacfwd(jax.jacfwd(by))):
        np.testing.assert_allclose(jax.jit(second, static_argnums=1)(x, SAME_STEPS), wanted, rtol=1e-10, atol=1e-12)
    for outer in (jax.jacrev(jax.jacrev(by)), jax.jacrev(jax.jacfwd(by))):
        with pytest.raises(RuntimeError, match=r"take jax\.hessian, or jax\.jacfwd of jax\.grad"):
            jax.jit(outer, static_argnums=1)(x, StoredSteps())


def test_what_functions_close_over_is_differentiated() -> None:
    """y' = -k y from 1, k nowhere but in the function: y(1) = exp(-k)."""

    def end(k: Any) -> Any:
        solution = dfx.diffeqsolve(
            dfx.ODETerm(lambda t, y, args: -k * y),
            dfx.Dopri8(),
            0.0,
            1.0,
            0.1,
            jnp.ones(()),
            stepsize_controller=dfx.PIDController(1e-12, 1e-12),
            adjoint=StoredSteps(),
            max_steps=200,
        )
        ys: Any = solution.ys
        return ys[0]

    for mode in (jax.grad, jax.jacfwd):
        for slope in (mode(end)(0.7), mode(lambda k: jax.jit(end)(2.0 * k))(0.35) / 2.0):
            np.testing.assert_allclose(slope, -np.exp(-0.7), rtol=1e-11)


def test_closed_form_of_a_start_time() -> None:
    """y' = a cos(t) y from 1 at t0: y(t1) = exp(a (sin t1 - sin t0))."""

    def end(a: Any, t0: Any, t1: Any) -> Any:
        solution = dfx.diffeqsolve(
            dfx.ODETerm(lambda t, y, a: a * jnp.cos(t) * y),
            dfx.Dopri8(),
            t0,
            t1,
            0.1,
            jnp.ones(()),
            a,
            stepsize_controller=dfx.PIDController(1e-12, 1e-12),
            adjoint=StoredSteps(),
            max_steps=500,
        )
        ys: Any = solution.ys
        return ys[0]

    a, t0, t1 = 0.7, 0.4, 2.5
    exact = np.exp(a * (np.sin(t1) - np.sin(t0)))
    value, slopes = jax.value_and_grad(end, argnums=(0, 1, 2))(*map(jnp.asarray, (a, t0, t1)))
    np.testing.assert_allclose(value, exact, rtol=1e-11)
    right = np.array([np.sin(t1) - np.sin(t0), -a * np.cos(t0), a * np.cos(t1)]) * exact
    np.testing.assert_allclose(slopes, right, rtol=1e-10)


@pytest.mark.parametrize("every", [1, 3])
def test_the_derivative_is_that_of_the_steps(every: int) -> None:
    """y' = -k y in ten steps of Euler, not of the equation: y_j = (1 - 0.2 k)^j, and lines between them."""
    at = np.array([0.25, 0.6, 2.0])  # within a step, at the end of one, at the end of the run

    def saved(k: Any) -> Any:
        solution = dfx.diffeqsolve(
            dfx.ODETerm(lambda t, y, k: -k * y),
            dfx.Euler(),
            0.0,
            2.0,
            0.2,
            jnp.ones(()),
            k,
            saveat=dfx.SaveAt(subs=[dfx.SubSaveAt(steps=2, t0=True), dfx.SubSaveAt(ts=jnp.asarray(at), t1=True)]),
            adjoint=StoredSteps(every),
            max_steps=16,
        )
        steps, times = solution.ys  # pyright: ignore[reportGeneralTypeIssues]
        return jnp.concatenate([steps[:6], times])

    def exact(k: Any) -> Any:
        steps = (1.0 - 0.2 * k) ** jnp.arange(11)
        between = [steps[j] * (1.0 - k * (t - 0.2 * j)) for j, t in ((1, at[0]), (2, at[1]))]
        return jnp.concatenate([steps[::2], jnp.stack(between), steps[10:], steps[10:]])

    k = jnp.asarray(0.7)
    np.testing.assert_allclose(saved(k), exact(k), rtol=1e-13)
    for mode in (jax.jacfwd, jax.jacrev):
        np.testing.assert_allclose(jax.jit(mode(saved))(k), jax.jacfwd(exact)(k), rtol=1e-12)


def test_vmap_and_float32() -> None:
    """Runs of different lengths in one batch are as each alone; in float32 to its rounding."""
    t1 = jnp.linspace(1.5, 3.0, 3)
    value = lambda p: total(p, StoredSteps(), "Tsit5", "times")  # noqa: E731
    gradient = jax.jit(jax.grad(value))
    together = jax.jit(jax.vmap(lambda t: gradient({**numbers(), "t1": t})))(t1)
    for i, t in enumerate(t1):
        alone = gradient({**numbers(), "t1": t})
        for name in NUMBERS:
            np.testing.assert_allclose(together[name][i], alone[name], rtol=1e-11)
    # Numbers that all runs have in common, inside of the derivative.
    common = jax.jit(jax.grad(lambda p: jnp.sum(jax.vmap(lambda t: value({**p, "t1": t}))(t1))))(numbers())
    for name in ("mu", "f", "x0"):
        np.testing.assert_allclose(common[name], jnp.sum(together[name]), rtol=1e-11)
    single = gradient(numbers(jnp.float32))
    for name, x in single.items():
        assert x.dtype == jnp.float32
        np.testing.assert_allclose(x, together[name][-1], rtol=2e-4)


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_a_hundred_roundings_in_one_step(dtype: Any) -> None:
    """Before any time, zero and those next to a power of two among them, as by the calls of diffrax."""

    def floor(t: Any) -> Any:
        for _ in range(100):
            t = eqxi.prevbefore(t)
        return t

    t = jnp.asarray([1.0, 1.0 + 50 * jnp.finfo(dtype).eps, 3.7, -2.5, 0.0, 1e-30, -1e-30, 1e5, jnp.inf], dtype)
    short = without_single_roundings(jax.make_jaxpr(floor)(t[0]).jaxpr)
    assert len(short.eqns) == 2
    found = jax.vmap(lambda t: jax.core.eval_jaxpr(short, [], t)[0])(t)
    np.testing.assert_array_equal(found, jax.vmap(floor)(t))


def test_a_run_that_ends_early_or_has_no_length() -> None:
    """The derivative is that of what was integrated: no step beyond, none at all."""

    def five(p: Any, adjoint: Any) -> Any:
        return total(p, adjoint, "Tsit5", "everything", max_steps=5)

    ahead = jax.jit(jax.jacfwd(lambda p: five(p, dfx.ForwardMode())))(numbers())
    for mode in (jax.grad, jax.jacfwd):
        few = jax.jit(mode(lambda p: five(p, SAME_STEPS)))(numbers())
        for name in ("mu", "f", "x0"):
            np.testing.assert_allclose(few[name], ahead[name], rtol=1e-11)
        assert few["t1"] == ahead["t1"] == 0.0

    def still(x: Any) -> Any:
        solution = dfx.diffeqsolve(
            dfx.ODETerm(lambda t, y, args: -y),
            dfx.Tsit5(),
            1.0,
            1.0,
            0.1,
            x,
            saveat=dfx.SaveAt(ts=jnp.ones(2)),
            adjoint=StoredSteps(),
            max_steps=10,
        )
        ys: Any = solution.ys
        return jnp.sum(ys)

    assert jax.grad(still)(jnp.asarray(2.0)) == jax.jacfwd(still)(jnp.asarray(2.0)) == 2.0


@pytest.mark.parametrize(
    ("solver", "rise", "before"),
    [
        ("Tsit5", 1e2, 0.0),
        ("Tsit5", 1e6, 0.0),
        ("Tsit5", 1e6, 1e-6),
        ("Rodas5P", 1e2, 0.0),
        ("Rodas5P", 1e6, 0.0),
        ("Rodas5P", 1e8, 1e-6),
    ],
)
def test_a_number_that_is_small_up_to_a_kink(solver: str, rise: float, before: float) -> None:
    """x' = 1, s' = rise max(x - c, 0) (1 - s): tangents of s grow from x = c on, and 1 - s is a Gaussian bell."""

    def field(_: Any, y: Any, p: Any) -> Any:
        x, s = y
        return jnp.ones_like(x), p["rise"] * jnp.maximum(x - p["c"], 0.0) * (1.0 - s)

    def end(p: Any) -> Any:
        solution = dfx.diffeqsolve(
            dfx.ODETerm(field),
            SOLVERS[solver],
            0.0,
            p["t1"],
            0.01,
            (jnp.zeros(()), before * p["c"]),
            p,
            stepsize_controller=dfx.PIDController(1e-6, 1e-9),
            adjoint=StoredSteps(),
            max_steps=300,
        )
        ys: Any = solution.ys
        return ys[1][0]

    def exact(p: Any) -> Any:
        return 1.0 - (1.0 - before * p["c"]) * jnp.exp(-0.5 * p["rise"] * (p["t1"] - p["c"]) ** 2)

    p = jax.tree.map(jnp.asarray, {"rise": rise, "c": 1.0, "t1": 1.0 + rise**-0.5})
    slopes, wanted = jax.jit(jax.grad(end))(p), jax.grad(exact)(p)
    for name in p:
        np.testing.assert_allclose(slopes[name], wanted[name], rtol=1e-5, err_msg=name)


def test_events() -> None:
    """A ball that bounces three times; its height at the end and the time of the last bounce, against closed forms."""
    g, e, h, t1 = 9.81, 0.8, 1.0, 2.0

    def end(x: Any) -> Any:
        h = x[2]
        solver = EventSolver(
            dfx.Tsit5(),
            lambda t, s, args: s.y[:1],
            lambda t, s, args, fired: s._replace(y=jnp.stack([jnp.zeros_like(args[1]), -args[1] * s.y[1]])),
        )
        solution = dfx.diffeqsolve(
            dfx.ODETerm(lambda t, s, args: s.rate(jnp.stack([s.y[1], -args[0]]))),
            solver,
            0.0,
            t1,
            0.01,
            solver.start(0.0, jnp.stack([h, jnp.zeros_like(h)]), None, x),
            x,
            stepsize_controller=EventController(dfx.PIDController(1e-9, 1e-9)),
            adjoint=StoredSteps(),
            max_steps=200,
        )
        ys: Any = solution.ys
        found = jnp.stack([ys.y[0, 0], ys.t[0]])
        return found, found

    def exact(x: Any) -> Any:
        g, e, h = x
        fall = jnp.sqrt(2 * h / g)
        last = fall * (1 + 2 * e + 2 * e**2)
        return jnp.stack([e**3 * g * fall * (t1 - last) - 0.5 * g * (t1 - last) ** 2, last])

    x = jnp.array([g, e, h])
    for mode in (jax.jacrev, jax.jacfwd):
        slopes, found = jax.jit(mode(end, has_aux=True))(x)
        np.testing.assert_allclose(found, exact(x), rtol=1e-8)
        np.testing.assert_allclose(slopes, jax.jacfwd(exact)(x), rtol=1e-7)


def test_what_cannot_be_is_refused() -> None:
    def solve(**how: Any) -> Any:
        return dfx.diffeqsolve(
            dfx.ODETerm(lambda t, y, args: -y), dfx.Tsit5(), 0.0, 1.0, 0.1, jnp.ones(1), adjoint=StoredSteps(), **how
        )

    with pytest.raises(ValueError, match="every must be at least 1, but every=0"):
        StoredSteps(every=0)
    with pytest.raises(ValueError, match="max_steps=None"):
        solve(max_steps=None)
    with pytest.raises(ValueError, match="use EventSolver"):
        solve(event=dfx.Event(lambda t, y, args, **_: y[0] - 0.5))
