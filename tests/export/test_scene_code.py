"""Scenes as C99: compiled, run, and compared with JAX."""

import ctypes
import functools
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
import pytest

import jaxmodsim as jms
from jaxmodsim import to_c
from jaxmodsim._core.compat import AVAILABLE
from jaxmodsim.problems import belt_oscillator, ramped_box
from jaxmodsim.scene import State, vector_field

from ..helpers.compilers import COMPILER

pytestmark = pytest.mark.skipif("jaxprs" not in AVAILABLE, reason="needs the programs that JAX traces")
needs_compiler = pytest.mark.skipif(COMPILER is None, reason="needs a C compiler: cc, gcc or clang")
FLAGS = ["-std=c99", "-pedantic", "-Wall", "-Wextra", "-Werror", "-Wmissing-prototypes", "-O1"]
CHECKED = ["-fsanitize=undefined,address", "-fno-sanitize-recover=all"]

# Reads what to do, the numbers and the state, and prints what comes of it, all in hexadecimal.
MAIN = """
#include <stdio.h>
#include <stdlib.h>
static double next(void) { double x; if (scanf("%lf", &x) != 1) exit(2); return x; }
int main(void) {
  REAL p[scene_P], y[scene_Y], out[scene_Y] = {0};
  char kind;
  while (scanf(" %c", &kind) == 1) {
    const double t0 = next(), t1 = next();
    const long steps = (long)next();
    for (int i = 0; i < scene_P; ++i) p[i] = next();
    for (int i = 0; i < scene_Y; ++i) y[i] = next();
    int solved = 1;
    if (kind == 'r') scene_rate(t0, p, y, out);
    if (kind == 's') solved = scene_run(t0, t1, steps, p, y);
    FRICTION
    printf("%d", solved);
    for (int i = 0; i < scene_Y; ++i) printf(" %a", (double)out[i]);
    for (int i = 0; i < scene_Y; ++i) printf(" %a", (double)y[i]);
    printf("\\n");
  }
  return 0;
}
"""


def arm_energy(t: Any, q: Any, qd: Any, p: Any) -> Any:
    del t
    coupled = jnp.cos(q[1] - q[0]) * qd[0] * qd[1]
    return 0.5 * p["m"] * jnp.sum(qd**2) + 0.4 * p["m"] * coupled + p["g"] * jnp.cos(q[0])


def one_mass(t: Any, q: Any, qd: Any, p: Any) -> Any:
    del t, q
    return 0.5 * p["m"] * qd[0] ** 2


def many_functions(t: Any, q: Any, qd: Any, p: Any) -> Any:
    """A force of all the functions that are written, on arguments where they have values."""
    x, v = q[0], qd[0]
    a = 0.5 + 0.4 * jnp.sin(x) * jnp.cos(v)
    smooth = [jnp.tan(a), jnp.arcsin(a), jnp.arccos(a), jnp.arctan(x), jnp.arctan2(v, a), jnp.sinh(a), jnp.cosh(x)]
    smooth += [jnp.tanh(v), jnp.exp(v), jnp.expm1(a), jnp.log(a), jnp.log1p(a), jnp.sqrt(a), jnp.cbrt(x)]
    smooth += [jnp.log2(a), jnp.exp2(x), a ** p["n"]]
    smooth += [1.0 / (x**3 + 8.0 * jnp.sign(x)), jax.lax.rsqrt(a), jax.nn.sigmoid(x), jnp.linalg.norm(q - p["at"])]
    bent = [jnp.floor(3.0 * x), jnp.ceil(x * v), jnp.sign(v), jnp.clip(x, -0.5, 0.5), jnp.maximum(x, v), jnp.abs(v)]
    bent += [jnp.where((x > 0) ^ (v > 0), x, v), jnp.where(jnp.isfinite(x) & ~(v <= 0), t, x), jnp.fmod(x, 0.7)]
    bent += [jnp.max(p["at"] * x), jnp.where(jnp.any(q > p["at"]), 1.0, x), jax.lax.cond(x > v, jnp.sin, jnp.cos, x)]
    powers = jnp.stack([*smooth, *bent])
    return jnp.sum(jnp.where(jnp.arange(powers.size) < powers.size, powers, 0.0))[None]


def transmitted(t: Any, q: Any, qd: Any, p: Any) -> Any:
    """Torque of the spring in an elastic gear."""
    del t, qd
    return p["k"] * (q[0] - q[1])


LUGRE = jms.LuGre(sigma0=1e4, sigma1=12.0, sigma2=0.1, Fc=1.0, Fs=1.5, vs=0.01)
SCENES: dict[str, Callable[[], tuple[jms.Scene, int]]] = {
    "lugre box": lambda: (ramped_box.scene(ramped_box.lugre(sigma1=12.0)), 1),
    "coulomb belt": lambda: (belt_oscillator.scene(jms.Regularized(belt_oscillator.stribeck(), 1e-9)), 1),
    "arm with two laws": lambda: (
        jms.Scene(
            arm_energy,
            params={"m": 1.0, "g": 9.0},
            effects=(
                jms.Friction(LUGRE, along=lambda q: q[0]),
                jms.Friction(jms.Dahl(1e3, 0.7), along=lambda q: q[1] - q[0], normal_force=lambda t, q, qd, p: p["m"]),
            ),
        ),
        2,
    ),
    "block in the plane": lambda: (
        jms.Scene(
            lambda t, q, qd, p: 0.5 * p["m"] * jnp.sum(qd**2) - 3.0 * p["m"] * q[0],
            params={"m": 1.0},
            effects=(jms.Friction(LUGRE, along=lambda q: q, ellipse=1.5),),
        ),
        2,
    ),
    "elastic gear": lambda: (
        jms.Scene(
            lambda t, q, qd, p: 0.5 * p["m"] * jnp.sum(qd**2) - 0.5 * p["k"] * (q[0] - q[1]) ** 2 + 2.0 * q[0],
            params={"m": 0.1, "k": 30.0},
            effects=(
                jms.Friction(
                    jms.Bristle(jms.Geared(jms.Stribeck(0.1, 0.2, 0.1), 0.2, transmitted, 0.3), 1e-3),
                    along=lambda q: q[0],
                ),
                jms.Friction(
                    jms.Regularized(jms.ServoGear(1.0, transmitted, 0.1, 0.01, 0.2, 0.3, 1.5, 0.1, 0.2), 1e-3),
                    along=lambda q: q[1],
                ),
            ),
        ),
        2,
    ),
    "many functions": lambda: (
        jms.Scene(
            one_mass,
            params={"m": 1.0, "n": 1.7, "at": np.array([0.1, -0.3])},
            effects=(jms.AppliedForce(many_functions),),
        ),
        1,
    ),
}


@functools.cache
def scene_of(name: str) -> tuple[jms.Scene, int]:
    return SCENES[name]()


def state_of(scene: jms.Scene, y: Any, dof: int) -> State:
    like = State(jnp.zeros(dof), jnp.zeros(dof), scene.initial_state(jnp.zeros(dof)))
    leaves, ends = [], np.cumsum([np.size(x) for x in jtu.tree_leaves(like)])
    for leaf, end in zip(jtu.tree_leaves(like), ends, strict=True):
        leaves.append(jnp.asarray(y[end - np.size(leaf) : end]).reshape(leaf.shape))
    return jtu.tree_unflatten(jtu.tree_structure(like), leaves)


def flat(tree: Any) -> np.ndarray:
    return np.concatenate([np.ravel(x) for x in jtu.tree_leaves(tree)])


def random_states(scene: jms.Scene, dof: int, count: int) -> np.ndarray:
    """Positions and velocities of both signs, deflections about as large as they get; some at rest."""
    rng = np.random.default_rng(0)
    own = flat(scene.initial_state(jnp.zeros(dof))).size if scene.initial_state(jnp.zeros(dof)) else 0
    y = rng.normal(size=(count, 2 * dof + own)) * [*[1.0] * dof, *[0.3] * dof, *[1e-4] * own]
    y[::10, dof:] = 0.0
    return y


class InC:
    """The program of a scene, compiled with every check there is."""

    def __init__(self, scene: jms.Scene, dof: int, folder: Path) -> None:
        text = to_c(scene, dof)
        call = "if (kind == 'f') scene_friction(t0, t1, p, y, out);" if "scene_friction" in text else ""
        real = "float" if "const float scene_numbers" in text else "double"
        source, self.program = folder / "scene.c", folder / "scene"
        source.write_text(text + MAIN.replace("FRICTION", call).replace("REAL", real))
        assert COMPILER is not None
        found = subprocess.run(
            [COMPILER, *CHECKED, "-x", "c", "-", "-o", str(folder / "try")], input=b"int main(void){return 0;}"
        )
        checks = CHECKED if found.returncode == 0 else []
        subprocess.run([COMPILER, *FLAGS, *checks, str(source), "-lm", "-o", str(self.program)], check=True)
        self.numbers, self.size = flat(scene), 0

    def __call__(self, kind: str, t0: Any, t1: Any, states: np.ndarray, steps: int = 1) -> tuple[Any, Any, Any]:
        """For each state whether it was solved, what was filled, and the state after."""
        times = np.broadcast_arrays(t0, t1, np.zeros(len(states)))[:2]
        lines = [
            " ".join([kind, float(a).hex(), float(b).hex(), str(steps), *(float(x).hex() for x in (*self.numbers, *y))])
            for a, b, y in zip(*times, states, strict=True)
        ]
        done = subprocess.run([str(self.program)], input="\n".join(lines), capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        rows = [[float.fromhex(x) for x in line.split()[1:]] for line in done.stdout.splitlines()]
        out, after = np.split(np.array(rows), 2, axis=1)
        return [line[0] == "1" for line in done.stdout.splitlines()], out, after


@pytest.fixture(scope="module")
def in_c(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], InC]:
    return functools.cache(lambda name: InC(*scene_of(name), tmp_path_factory.mktemp("c")))


@needs_compiler
@pytest.mark.parametrize("name", SCENES)
def test_the_right_hand_side_in_c_is_that_of_jax(name: str, in_c: Callable[[str], InC]) -> None:
    """To four units in the last place of its terms: as if that had been the rounding of numbers and state."""
    scene, dof = scene_of(name)
    y = random_states(scene, dof, 200)
    t = np.linspace(0.0, 5.0, len(y))

    def rate(t: Any, y: Any, scene: jms.Scene) -> Any:
        return jnp.concatenate([jnp.ravel(x) for x in jtu.tree_leaves(vector_field(t, state_of(scene, y, dof), scene))])

    values = jax.jit(jax.vmap(rate, (0, 0, None)))(t, y, scene)
    by = jax.jit(jax.vmap(jax.jacfwd(rate, (0, 1, 2)), (0, 0, None)))(t, y, scene)
    terms = np.abs(np.asarray(values))
    for slope, at in zip(jtu.tree_leaves(by), [t, y, *jtu.tree_leaves(scene)], strict=True):
        at = np.asarray(at) if at is t or at is y else np.broadcast_to(at, (len(y), *np.shape(at)))
        parts = np.abs(np.asarray(slope).reshape(*values.shape, -1) * at.reshape(len(y), 1, -1))
        terms = terms + np.where(np.isfinite(parts), parts, 0.0).sum(-1)
    _, out, _ = in_c(name)("r", t, t, y)
    assert (np.abs(out - values) <= 4 * np.finfo(float).eps * terms).all()


@needs_compiler
@pytest.mark.parametrize(
    "name", ["lugre box", "coulomb belt", "arm with two laws", "block in the plane", "elastic gear"]
)
def test_a_run_in_c_is_that_of_simulate(name: str, in_c: Callable[[str], InC]) -> None:
    scene, dof = scene_of(name)
    y0, h, t1 = random_states(scene, dof, 2)[1] * 0.1, 1e-3, 3.0
    start = state_of(scene, y0, dof)
    run = jms.simulate(scene, start.q, start.qd, t1, z0=start.z, dt=h, solver=jms.ImplicitFriction())
    (solved,), _, after = in_c(name)("s", 0.0, h, y0[None], steps=round(t1 / h))
    assert solved
    expected = flat((run.q[-1], run.qd[-1], {key: z[-1] for key, z in (run.z or {}).items()}))
    np.testing.assert_allclose(after[0], expected, rtol=1e-9, atol=1e-12)


@needs_compiler
@pytest.mark.parametrize("name", ["lugre box", "arm with two laws"])
def test_the_feed_forward_is_the_force_of_the_laws(name: str, in_c: Callable[[str], InC]) -> None:
    scene, dof = scene_of(name)
    y, h = random_states(scene, dof, 50), jnp.asarray(1e-3)

    def expected(y: Any) -> Any:
        state = state_of(scene, y, dof)
        force, after = jnp.zeros(dof), {}
        for key, effect in zip(scene.names, scene.effects, strict=True):
            if isinstance(effect, jms.Friction):
                law: Any = effect.law
                along = effect.direction(state.q, scene.params)
                after[key] = law.step_exact(jnp.sum(along * state.qd), state.z[key], h)
                mean = (after[key] - state.z[key]) / h
                load = 1.0 if effect.normal_force is None else scene.params["m"]
                force += along * load * law.force_given_zdot(jnp.sum(along * state.qd), after[key], mean)
        return force, jnp.stack(list(after.values()))

    force, z = jax.jit(jax.vmap(expected))(y)
    _, out, after = in_c(name)("f", 0.0, float(h), y)
    np.testing.assert_allclose(out[:, :dof], force, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(after[:, 2 * dof :], z, rtol=1e-12, atol=1e-18)
    assert (after[:, : 2 * dof] == y[:, : 2 * dof]).all()


@needs_compiler
def test_steps_end_whatever_they_are_given(in_c: Callable[[str], InC]) -> None:
    """Infinite numbers, steps of no length and backwards: nothing that the sanitizers know, and an answer."""
    worst = np.array([np.nan, np.inf, -np.inf, 1e308, 1e-308, 0.0])
    y = np.array([[a, b, c] for a in worst for b in worst for c in worst])
    for h in (0.0, -1.0, 1e300, np.nan):
        solved, _, after = in_c("lugre box")("s", 0.0, h, y)
        assert len(solved) == len(after) == len(y)
        # No success with numbers that are not finite, as in `simulate`.
        assert np.isfinite(after[np.array(solved)]).all()


@needs_compiler
@pytest.mark.parametrize("dof", [1, 2])
def test_steps_are_solved_while_a_velocity_decays_below_the_normal_numbers(dof: int, tmp_path: Path) -> None:
    law = jms.Regularized(jms.Coulomb(1.5), 1e-3)
    effects = tuple(jms.Friction(law, along=lambda q, i=i: q[i] - (q[i - 1] if i else 0.0)) for i in range(dof))
    scene = jms.Scene(lambda t, q, qd, p: 0.5 * p["m"] * jnp.sum(qd**2), {"m": 2.0}, effects)
    start = np.concatenate([np.zeros(dof), np.full(dof, 0.3)])[None]
    (solved,), _, after = InC(scene, dof, tmp_path)("s", 0.0, 1e-3, start, steps=10_000)
    assert solved
    assert np.all(np.abs(after[0, dof:]) < 1e-300)


@needs_compiler
def test_a_scene_of_float32_is_written_in_float(tmp_path: Path) -> None:
    scene, dof = scene_of("lugre box")
    scene = jtu.tree_map(lambda x: jnp.asarray(x, jnp.float32), scene)
    text = to_c(scene, dof)
    assert "double" not in text
    h = 1e-3
    run = jms.simulate(
        scene, jnp.zeros(1, jnp.float32), jnp.zeros(1, jnp.float32), 3.0, dt=h, solver=jms.ImplicitFriction()
    )
    (solved,), _, after = InC(scene, dof, tmp_path)("s", 0.0, h, np.zeros((1, 3)), steps=3000)
    assert solved
    np.testing.assert_allclose(after[0, :2], [run.q[-1, 0], run.qd[-1, 0]], rtol=1e-3)


def test_the_state_at_rest_is_that_of_the_laws() -> None:
    """Armstrong's law has rested long: its stiction is whole."""
    law = jms.Armstrong(1e4, 1.0, 1.5, 0.01, 0.2, 0.1, 1.0)
    assert "scene_rest[scene_Y] = {0.0, 0.0, 0.0, 1.0, 1.0, 0.0}" in to_c(ramped_box.scene(law))


def test_the_text_names_its_numbers_and_allocates_nothing() -> None:
    text = to_c(scene_of("lugre box")[0], name="press")
    for word in ("press_p_m", "press_p_friction_sigma0", "press_step", "press_friction", "q[0], qd[0], friction.z"):
        assert word in text
    for word in ("malloc", "static", "goto", "while"):
        assert word not in text


def library_of(code: str, folder: Path) -> ctypes.CDLL:
    source, library = folder / "code.c", folder / "code.so"
    source.write_text(code)
    subprocess.run([str(COMPILER), *FLAGS, "-shared", "-fPIC", str(source), "-o", str(library)], check=True)
    return ctypes.CDLL(str(library))


def pointers(*arrays: np.ndarray) -> list[Any]:
    return [a.ctypes.data_as(ctypes.POINTER(ctypes.c_double)) for a in arrays]


@needs_compiler
def test_a_slice_at_a_computed_index_is_that_of_jax(tmp_path: Path) -> None:
    """JAX moves a slice that begins outside of the array to its first or last place."""

    def part(x: Any, place: Any) -> Any:
        return (jax.lax.dynamic_slice(x, (place[0].astype(int), place[1].astype(int)), (2, 1)),)

    like = {"x": jnp.zeros((4, 3)), "place": jnp.zeros(2)}
    code = jms.export.function_to_c(part, like, ("y",), name="part", purpose="A slice.")
    compiled, x = library_of(code, tmp_path), np.arange(12.0).reshape(4, 3)
    for place in ([0.0, 0.0], [1.0, 2.0], [2.0, 1.0], [9.0, 9.0], [-9.0, 1.0]):
        y = np.zeros((2, 1))
        compiled.part(*pointers(x, np.array(place), y))
        np.testing.assert_array_equal(y, part(jnp.asarray(x), jnp.array(place))[0])


def swapped(x: Any) -> Any:
    """A known number of steps, in which each carried value becomes the other."""
    return jnp.stack(jax.lax.fori_loop(0, 5, lambda _, pair: (pair[1], pair[0] + pair[1]), (x[0, 0], x[0, 1])))


def backwards(x: Any) -> Any:
    """A loop over rows from the last to the first, whose results stand in the order of the rows."""
    last, rows = jax.lax.scan(lambda carry, row: (0.5 * carry + row, carry * row), x[0], x, reverse=True)
    return jnp.concatenate([last[None], rows])


OPERATIONS: dict[str, Callable[[Any], Any]] = {
    "argmax": lambda x: jnp.stack([jnp.argmax(x, axis=axis).astype(x.dtype).sum() for axis in (0, 1)]),
    "argmin": lambda x: jnp.argmin(x, axis=0).astype(x.dtype),
    "backwards": backwards,
    "clip": lambda x: jnp.clip(x, -1.0, 2.0),
    "cumsum": lambda x: jnp.cumsum(x, axis=1),
    "powers": lambda x: jnp.stack([x**3, x**-2, jnp.square(x), jnp.abs(x) ** 0.7]),
    "remainder": lambda x: jax.lax.rem(jnp.round(x).astype(int), jnp.array(3)).astype(x.dtype),
    "roots": lambda x: jax.lax.rsqrt(jnp.abs(x)),
    "rounded": lambda x: jnp.stack([jnp.round(x), jnp.floor(x), jnp.ceil(x), jnp.sign(x)]),
    "sigmoid": lambda x: jax.nn.sigmoid(x),
    "sorted pair": lambda x: jnp.stack([jnp.minimum(x[0], x[1]), jnp.maximum(x[0], x[1])]),
    "swapped": swapped,
    "written": lambda x: x.at[1, 2].set(7.0).at[:, 0].add(x[:, 1]),
}


@needs_compiler
@pytest.mark.parametrize("name", OPERATIONS)
def test_an_operation_in_c_is_that_of_jax(name: str, tmp_path: Path) -> None:
    code = jms.export.function_to_c(
        lambda x: (OPERATIONS[name](x),), {"x": jnp.zeros((3, 4))}, ("y",), name="f", purpose=name
    )
    compiled = library_of(code, tmp_path)
    ties = np.array([[1.0, 1.0, -1.0, 2.5], [1.0, 3.5, -1.0, 0.5], [-0.5, 3.5, 4.0, -2.5]])
    for x in (ties, *np.random.default_rng(0).normal(0.0, 3.0, (3, 3, 4))):
        expected = np.asarray(OPERATIONS[name](jnp.asarray(x)))
        y = np.zeros_like(expected)
        compiled.f(*pointers(x, y))
        np.testing.assert_allclose(y, expected, rtol=1e-14)


@needs_compiler
def test_members_of_a_batched_loop_end_on_their_own(tmp_path: Path) -> None:
    def halvings(x: Any) -> Any:
        """Halves a number until it is below one, at most 60 times; the second result counts."""
        return jax.lax.while_loop(
            lambda each: (each[1] < 60.0) & (each[0] > 1.0), lambda each: (0.5 * each[0], each[1] + 1.0), (x, 0.0 * x)
        )

    like = {"x": jnp.zeros(4)}
    code = jms.export.function_to_c(jax.vmap(halvings), like, ("y", "n"), name="halve", purpose="Halvings.")
    x, y, n = np.array([0.5, 3.0, 1e6, 1e30]), np.zeros(4), np.zeros(4)
    library_of(code, tmp_path).halve(*pointers(x, y, n))
    np.testing.assert_array_equal(n, [0, 2, 20, 60])
    np.testing.assert_array_equal(y, x / 2**n)


def with_force(force: Any) -> jms.Scene:
    return jms.Scene(one_mass, params={"m": 1.0}, effects=(jms.AppliedForce(force),))


def endless(t: Any, q: Any, qd: Any, p: Any) -> Any:
    del t, qd, p
    return jax.lax.while_loop(lambda x: x[0] > 1.0, lambda x: 0.5 * x, q)


REFUSED: dict[str, tuple[Callable[[], Any], str]] = {
    "set-valued law": (lambda: ramped_box.scene(jms.Coulomb(1.0)), r"wrap the law as Regularized"),
    "dead zone": (lambda: ramped_box.scene(jms.DeadZone(jms.Coulomb(1.0), 1e-3)), "is a DeadZone"),
    "constraint": (
        lambda: jms.Scene(one_mass, params={"m": 1.0}, constraints=(jms.Constraint(lambda q: q[0], name="wall"),)),
        "'wall': use independent coordinates",
    ),
    "signal": (
        lambda: jms.Scene(one_mass, params={"m": jms.Signal([0.0, 1.0], [1.0, 2.0])}),
        "does not support a Signal",
    ),
    "sort": (lambda: with_force(lambda t, q, qd, p: jnp.sort(jnp.stack([q[0], qd[0]]))[:1]), "does not support sort"),
    "gamma function": (lambda: with_force(lambda t, q, qd, p: jax.lax.lgamma(q)), "does not support lgamma"),
    "loop without a limit": (lambda: with_force(endless), "loop without a known limit"),
    "large array": (lambda: with_force(lambda t, q, qd, p: jnp.sum(q[0] * jnp.arange(2e4))[None]), "arrays with 20000"),
}


@pytest.mark.quick
@pytest.mark.parametrize("case", REFUSED)
def test_what_cannot_be_written_is_refused_by_name(case: str) -> None:
    make, text = REFUSED[case]
    with pytest.raises(ValueError, match=text):
        to_c(make())


def test_wrong_arguments_are_refused() -> None:
    box = scene_of("lugre box")[0]
    with pytest.raises(ValueError, match="name must be an identifier"):
        to_c(box, name="a b")
    with pytest.raises(ValueError, match="dof must be"):
        to_c(box, 0)
    with pytest.raises(ValueError, match="returned the shape"):
        to_c(with_force(lambda t, q, qd, p: q[:1]), 2)
    with pytest.raises(ValueError, match="have the same name in C"):
        to_c(jms.Scene(one_mass, params={"m": 1.0, "a.b": 1.0, "a_b": 1.0}))
