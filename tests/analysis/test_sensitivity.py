"""`sensitivity` against closed forms and finite differences, in both modes, through events; and its figure."""
# ruff: noqa: ARG001 (Lagrangians have the arguments that the scene passes, used or not)

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxmodsim as jms
from jaxmodsim import plot, problems
from jaxmodsim.scene import replace_numbers, scene_numbers

from ..helpers.differences import central_difference

SPRING = {"m": 0.7, "k": 3.1, "Fc": 0.2, "Fs": 0.2, "x0": 0.9}
TS = jnp.linspace(0.0, 5.0, 51)


def free(t: Any, q: Any, qd: Any, p: Any) -> Any:
    return 0.5 * p["m"] * qd[0] ** 2


def many(t: Any, q: Any, qd: Any, p: Any) -> Any:
    return 0.5 * jnp.sum(p["parts"]) * qd[0] ** 2


ramp = jms.AppliedForce(lambda t, q, qd, p: t[None])
LUGRE = jms.LuGre(sigma0=750.0, sigma1=1.0, sigma2=0.1, Fc=1.5, Fs=1.75, vs=0.2)
BENCH = jms.Scene(free, params={"m": 2.0}, effects=(ramp, jms.Friction(LUGRE)))


@pytest.mark.parametrize("mode", ["forward", "reverse"])
def test_resting_place_and_time_of_a_braked_spring(mode: Any) -> None:
    """Through all reversals, against the derivatives of the closed form."""
    rest = problems.braked_spring.rest(**SPRING)
    slopes = jax.jacrev(lambda n: problems.braked_spring.rest(**n)[1:])({n: jnp.asarray(x) for n, x in SPRING.items()})
    last = int(rest.half_cycles) - 1
    scene = problems.braked_spring.scene(jms.Coulomb(SPRING["Fc"], SPRING["Fs"]), m=SPRING["m"], k=SPRING["k"])
    found = jms.sensitivity(
        scene,
        lambda run: jnp.stack([run.events.t[last], run.q[-1, 0]]),
        ("m", "k", "friction.Fc", "friction.Fs", "q0[0]"),
        q0=[SPRING["x0"]],
        qd0=[0.0],
        t1=float(rest.t) + 1.0,
        mode=mode,
        rtol=1e-11,
        atol=1e-13,
    )
    assert found.mode == mode
    names = {"m": "m", "k": "k", "Fc": "friction.Fc", "Fs": "friction.Fs", "x0": "q0[0]"}
    for short, name in names.items():
        expected = np.array([slopes[0][short], slopes[1][short]])
        # Both modes to 1e-9 of the closed form, so to twice that of each other.
        np.testing.assert_allclose(found.derivatives[name], expected, atol=1e-9, err_msg=name)
        relative = SPRING[short] * expected / np.abs([rest.t, rest.x])
        np.testing.assert_allclose(found.normalised[name], relative, atol=1e-8)
    assert not found.over_time
    assert "mode changes" in found.warnings[0]


@pytest.fixture(scope="module")
def bench() -> jms.Sensitivity:
    return jms.sensitivity(BENCH, "qd[0]", q0=[0.0], qd0=[0.0], t1=5.0, ts=TS, rtol=1e-10, atol=1e-12)


def test_lugre_bench_against_differences(bench: jms.Sensitivity) -> None:
    numbers = scene_numbers(BENCH)
    assert bench.mode == "forward"
    assert set(bench.derivatives) == set(numbers) - {"friction.belt_velocity"}
    for name in ("m", "friction.Fs", "friction.sigma0"):

        def at(x: float, name: str = name) -> Any:
            scene = replace_numbers(BENCH, {name: jnp.asarray(x, float)})
            return jms.simulate(scene, [0.0], [0.0], 5.0, ts=TS, rtol=1e-10, atol=1e-12).qd[:, 0]

        p = float(numbers[name])
        differences = central_difference(at, p, 1e-3 * p)
        np.testing.assert_allclose(bench.derivatives[name], differences, atol=1e-6 / p, err_msg=name)
        scale = np.sqrt(np.mean(np.square(bench.observable)))
        np.testing.assert_allclose(bench.normalised[name], p * bench.derivatives[name] / scale, rtol=1e-12)


def test_ranking_and_table(bench: jms.Sensitivity) -> None:
    names = [name for name, _ in bench.ranking]
    sizes = [size for _, size in bench.ranking]
    assert sizes == sorted(sizes, reverse=True)
    assert set(names[:3]) == {"m", "friction.Fc", "friction.Fs"}
    text = str(bench)
    assert text.splitlines()[0].startswith("qd[0] [m/s or rad/s]: 51 times")
    assert "friction.sigma0 [N/m]" in text
    assert text.index("friction.Fc") < text.index("friction.vs")


def test_figure(bench: jms.Sensitivity) -> None:
    figure = plot.sensitivity_figure(bench, most=3)
    above, middle, below = figure.axes
    assert above.get_ylabel() == "qd[0] [m/s or rad/s]"
    assert middle.get_xlabel() == "time [s]"
    assert len(below.patches) == 3
    assert [label.get_text().split(" = ")[0] for label in below.get_yticklabels()] == [n for n, _ in bench.ranking[:3]]
    largest = bench.ranking[0][0]
    np.testing.assert_array_equal(middle.get_lines()[0].get_ydata(), bench.normalised[largest])


def test_many_parameters_and_one_output_run_in_reverse() -> None:
    """A force t on the mass M: at the end qd = t1^2 / (2 M)."""
    scene = jms.Scene(many, params={"parts": jnp.full(100, 0.02), "u": jms.Signal([0.0], [1.0])}, effects=(ramp,))
    found = jms.sensitivity(scene, lambda run: run.qd[-1, 0], q0=[0.0], qd0=[0.0], t1=2.0)
    assert found.mode == "reverse"
    assert set(found.derivatives) == {f"parts[{i}]" for i in range(100)}
    np.testing.assert_allclose([*found.derivatives.values()], -0.5, rtol=1e-5)
    assert len(plot.sensitivity_figure(found).axes) == 1


def test_zeros_count_as_one_unit_with_a_warning() -> None:
    scene = jms.Scene(free, params={"m": 2.0}, effects=(jms.Friction(jms.Viscous(0.5)),))
    found = jms.sensitivity(scene, "friction", ("qd0", "friction.Fv"), q0=[0.0], qd0=[0.0], t1=1.0, ts=[0.0, 1.0])
    assert set(found.derivatives) == {"qd0[0]", "friction.Fv"}
    np.testing.assert_allclose(found.normalised["qd0[0]"], 0.5 * np.exp([0.0, -0.25]), rtol=1e-5)
    assert any("one unit: qd0[0]" in warning for warning in found.warnings)
    assert any("observable is zero" in warning for warning in found.warnings)


def test_numerical_settings_of_laws_are_left_out() -> None:
    law = jms.Regularized(jms.Coulomb(0.5), 1e-3)
    scene = jms.Scene(free, params={"m": 2.0, "unused": 0.0}, effects=(jms.Friction(law),))
    found = jms.sensitivity(scene, "q[0]", q0=[1.0], qd0=[1.0], t1=1.0, ts=[0.0, 1.0])
    assert set(found.derivatives) == {"m", "friction.Fc"}
    # The box stops not: q = q0 + qd0 t - Fc/m t^2/2.
    np.testing.assert_allclose(found.derivatives["friction.Fc"][-1], -0.25, rtol=1e-3)


@pytest.mark.parametrize(
    ("observable", "more", "text"),
    [
        (
            "qd[0]",
            {"wrt": "friction.Fk"},
            r"names 'friction.Fk', which is no number of the scene; there are: m, friction.sigma0",
        ),
        ("qd[0]", {"wrt": ("m", "m")}, "twice"),
        ("qd[0]", {"wrt": ()}, "empty"),
        ("qd[0]", {"mode": "backward"}, "'forward', 'reverse'"),
        ("qd[0]", {"adjoint": None}, "omit it"),
        ("qd[1]", {}, r"there are: q\[0\], qd\[0\], applied\[0\], friction"),
        ("friction[0]", {}, "No observable"),
        ("", {}, "No observable"),
        (lambda run: run.q, {}, "Pick one"),
        (lambda run: 1.0, {}, "returned 1.0"),
        (lambda run: run.qd[:, 0] / 0.0, {}, "must be finite"),
    ],
)
def test_garbage_is_refused(observable: Any, more: Any, text: str) -> None:
    with pytest.raises(ValueError, match=text):
        jms.sensitivity(BENCH, observable, q0=[0.0], qd0=[0.0], t1=5.0, ts=TS, **more)
