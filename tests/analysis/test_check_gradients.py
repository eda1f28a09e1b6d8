from typing import Any

import jax
import jax.numpy as jnp
import pytest

import jaxmodsim as jms
from jaxmodsim import problems

# One structure for all stick-slip cases, so that it is compiled once: a braked spring, pulled by A sin t.
BRAKED = {"m": 1.3, "k": 2.7, "A": 0.0, "x0": 1.0, "Fc": 0.11, "Fs": 0.15}
BOX = {**BRAKED, "k": 0.0, "x0": 0.0}
# The belt is at rest like the mass, and its velocity has a kink there.
FREE = ("m", "k", "A", "x0", "friction.Fc", "friction.Fs")


def energy(t: Any, q: Any, qd: Any, p: Any) -> Any:
    del t
    return 0.5 * p["m"] * qd[0] ** 2 - 0.5 * p["k"] * q[0] ** 2


def pull(t: Any, q: Any, qd: Any, p: Any) -> Any:
    del q, qd
    return jnp.reshape(p["A"] * jnp.sin(t), (1,))


def spring(**numbers: float) -> jms.Scene:
    friction = jms.Friction(jms.Coulomb(Fc=numbers["Fc"], Fs=numbers["Fs"]))
    params = {name: numbers[name] for name in ("m", "k", "A", "x0")}
    return jms.Scene(energy, params=params, effects=(jms.AppliedForce(pull), friction))


def end(scene: jms.Scene, simulate: Any = jms.simulate) -> jax.Array:
    start = jnp.reshape(scene.params["x0"], (1,))
    return simulate(scene, start, [0.0], 3.5, rtol=1e-8).q[-1, 0]


def box_energy(t: Any, q: Any, qd: Any, p: Any) -> Any:
    del t, q
    return 0.5 * p["box"][0] * qd[0] ** 2


def ramp(t: Any, q: Any, qd: Any, p: Any) -> Any:
    del q, qd
    return jnp.reshape(p["box"][1] * t, (1,))


def lugre_box() -> jms.Scene:
    """Mass and ramp in one array, LuGre, no events, in single precision."""
    effects = (jms.AppliedForce(ramp), jms.Friction(problems.ramped_box.lugre()))
    scene = jms.Scene(box_energy, params={"box": jnp.array([2.0, 1.0])}, effects=effects)
    return jax.tree.map(lambda x: x.astype(jnp.float32), scene)


def slide(scene: jms.Scene, simulate: Any = jms.simulate) -> jax.Array:
    return simulate(scene, [0.0], [0.0], 5.0, rtol=1e-5, atol=1e-7).qd[-1, 0]


def bare_energy(t: Any, q: Any, qd: Any, p: Any) -> Any:
    del t, q, p
    return 0.5 * qd[0] ** 2


def test_stick_slip_agrees_with_differences_and_closed_form() -> None:
    check = jms.check_gradients(end, spring(**BRAKED), names=FREE)
    assert check.ok, str(check)
    assert check.dtype == "float64"

    def closed(numbers: dict[str, Any]) -> Any:
        return problems.braked_spring.motion(jnp.asarray(3.5), **numbers)[0]

    truth = jax.grad(closed)({name: value for name, value in BRAKED.items() if name != "A"})
    for name, value in {name: float(x) for name, x in truth.items()}.items():
        found = check.numbers[f"friction.{name}" if name in ("Fc", "Fs") else name]
        assert found.forward == pytest.approx(value, rel=1e-6, abs=1e-9)
        assert found.reverse == pytest.approx(value, rel=1e-6, abs=1e-9)
        assert abs(found.differences - value) <= found.error + 1e-7
        assert found.error < 1e-5
    assert not check.warnings


def test_break_away_agrees_and_a_belt_at_rest_is_named() -> None:
    check = jms.check_gradients(end, spring(**{**BOX, "A": 0.3}))
    assert {name for name, number in check.numbers.items() if number.verdict != "agree"} == {"friction.belt_velocity"}
    assert check.numbers["friction.belt_velocity"].verdict == "modes change"
    assert not check.ok
    text = str(check)
    assert "friction.belt_velocity: not differentiable here" in text
    assert "forward slip to stick at t = " in text
    assert all(name in text for name in check.numbers)


def test_lugre_in_single_precision_without_events() -> None:
    names = ("box[0]", "box[1]", "friction.sigma1", "friction.sigma2", "friction.Fc", "friction.Fs", "friction.vs")
    check = jms.check_gradients(slide, lugre_box(), names=names)
    assert check.ok, str(check)
    assert check.dtype == "float32"
    assert tuple(check.numbers) == names
    # By float64 at tight tolerances.
    for name, value in (("box[0]", -1.343461), ("box[1]", 5.380806), ("friction.Fc", -1.191515)):
        assert check.numbers[name].differences == pytest.approx(value, rel=1e-3)
        assert check.numbers[name].error < 1e-2
    # sigma1 is at the end of its range.
    assert "the differences are from above only" in " ".join(check.numbers["friction.sigma1"].warnings)

    def stopped(scene: jms.Scene, simulate: Any) -> Any:
        return slide(scene, simulate) + jax.lax.stop_gradient(scene.params["box"][1])

    assert verdicts(jms.check_gradients(stopped, lugre_box(), names=names[:2])) == {"box[1]": "disagree"}


@jax.custom_jvp
def square(x: Any) -> Any:
    return x * x


@square.defjvp
def _one_percent_off(primals: Any, tangents: Any) -> Any:
    return square(*primals), 2.02 * primals[0] * tangents[0]


def verdicts(check: Any) -> dict[str, str]:
    return {name: number.verdict for name, number in check.numbers.items() if number.verdict != "agree"}


def test_a_wrong_rule_and_a_stopped_gradient_are_named() -> None:
    def off(scene: jms.Scene, simulate: Any) -> Any:
        return end(scene, simulate) - square(scene.params["m"])

    check = jms.check_gradients(off, spring(**BRAKED), names=FREE)
    assert verdicts(check) == {"m": "disagree"}
    (warning,) = check.warnings
    assert warning.startswith("m: both modes give -4.2")
    assert "custom_jvp" in warning

    def stopped(scene: jms.Scene, simulate: Any) -> Any:
        run = end(scene, simulate)
        return run - jax.lax.stop_gradient(run) + jax.lax.stop_gradient(scene.effects[1].law.Fs)  # type: ignore[union-attr]

    check = jms.check_gradients(stopped, spring(**BRAKED), names=["friction.Fs"])
    assert verdicts(check) == {"friction.Fs": "disagree"}
    assert "cut off from the result" in check.warnings[0]


def test_the_edge_of_another_number_of_half_cycles() -> None:
    edge = (BRAKED["Fs"] + 2.0 * BRAKED["Fc"]) / BRAKED["k"]
    check = jms.check_gradients(end, spring(**{**BRAKED, "x0": edge}), names=("m", "k", "x0", "friction.Fs"))
    assert verdicts(check) == dict.fromkeys(("k", "x0", "friction.Fs"), "modes change")
    assert "backward slip to forward slip at t = 2.17992 in place of backward slip to stick" in str(check)

    # Half a percent away the gradient is right, and a warning says how far it holds.
    check = jms.check_gradients(end, spring(**{**BRAKED, "x0": 1.005 * edge}), names=["x0"])
    assert check.ok
    (warning,) = check.warnings
    assert "1 % from here, the sequence of modes differs: change 1 of 'friction'" in warning


def test_a_load_that_peaks_at_the_limit() -> None:
    """A sin t against the limit Fs of stick: the event at A = Fs (1 + d) has the time asin(Fs/A)."""
    limit = BRAKED["Fs"]
    above = jms.check_gradients(end, spring(**{**BOX, "A": 1.02 * limit}), names=["A"])
    assert above.ok
    assert "A: grazing suspected: the time of the event of 'friction' at t = 1.372" in above.warnings[0]

    close = jms.check_gradients(end, spring(**{**BOX, "A": 1.0002 * limit}), names=["A", "m"])
    assert verdicts(close) == {"A": "grazing"}
    assert "happen" in " ".join(close.warnings)

    at = jms.check_gradients(end, spring(**{**BOX, "A": limit}), names=["A"])
    assert verdicts(at) == {"A": "modes change"}

    below = jms.check_gradients(end, spring(**{**BOX, "A": 0.995 * limit}), names=["A"])
    assert below.ok
    assert "happens there only" in below.warnings[0]

    far = jms.check_gradients(end, spring(**{**BOX, "A": 2.0 * limit}), names=["A"])
    assert far.ok
    assert not far.warnings


def test_kinks_and_ends_of_ranges() -> None:
    def corner(scene: jms.Scene, simulate: Any) -> Any:
        return end(scene, simulate) + jnp.abs(scene.params["x0"] - 1.0)

    check = jms.check_gradients(corner, spring(**BRAKED), names=["x0", "m"])
    assert verdicts(check) == {"x0": "kink"}
    assert "-0.67" in check.warnings[0]
    assert "1.32" in check.warnings[0]

    check = jms.check_gradients(end, spring(**{**BRAKED, "Fs": BRAKED["Fc"]}), names=["friction.Fc", "friction.Fs"])
    assert check.ok, str(check)
    assert "from below only" in " ".join(check.numbers["friction.Fc"].warnings)
    assert "from above only" in " ".join(check.numbers["friction.Fs"].warnings)
    assert "must be finite and >= Fc" in str(check)


def test_traced_runs_are_not_recorded() -> None:
    def hidden(scene: jms.Scene, simulate: Any) -> Any:
        jax.eval_shape(lambda: slide(scene, simulate))
        return slide(scene, simulate)

    check = jms.check_gradients(hidden, lugre_box(), names=["box[0]"])
    assert check.ok
    assert "are not recorded" in check.warnings[-1]


@jax.custom_vjp
def backward_only(x: Any) -> Any:
    return x


backward_only.defvjp(lambda x: (x, None), lambda _, g: (g,))


@pytest.mark.parametrize(
    ("fn", "options", "message"),
    [
        (lambda scene: 0.0 * scene.params["m"], {}, r"fn\(scene, simulate\)"),
        (lambda scene, _: scene.params["box"][0], {}, "did not call it"),
        (lambda scene, _: jms.simulate(scene, [0.0], [0.0], 5.0).q[-1, 0], {}, "did not call it"),
        (lambda scene, simulate: simulate(scene, [0.0], [0.0], 5.0).q[-1], {}, r"one real number .* shape \(1,\)"),
        (lambda scene, simulate: float(slide(scene, simulate)), {}, "one real number .* but it returned"),
        (lambda scene, simulate: jnp.argmax(simulate(scene, [0.0], [0.0], 5.0).q[-1]), {}, "one real number .* int"),
        (lambda scene, simulate: slide(scene, simulate) / 0.0, {}, "finite number, but it returned -?inf"),
        (lambda scene, simulate: backward_only(slide(scene, simulate)), {}, "custom_vjp"),
        (slide, {"names": ["k"]}, r"no number 'k'; there are: box\[0\], box\[1\]"),
        (slide, {"names": []}, "names is empty"),
        (slide, {"scales": {"box[0]": 0.0}}, r"scales\['box\[0\]'\] must be a positive number"),
    ],
)
def test_misuse(fn: Any, options: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        jms.check_gradients(fn, lugre_box(), **options)


def test_scenes_that_cannot_be_checked() -> None:
    bare = jms.Scene(bare_energy)
    with pytest.raises(ValueError, match="holds no numbers"):
        jms.check_gradients(slide, bare)
    anything: Any = jms.check_gradients
    with pytest.raises(Exception, match="scene"):
        anything(slide, {"m": 1.0})
