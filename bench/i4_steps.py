"""One step of Rodas5P: against what the processor could do at most, against hand-written code, against explicit steps.

- The LuGre testbench, 1024 runs in one `jax.vmap` or 64 at a time in `jax.lax.map`: time of a run in steps made, the
  slowest lane's for all of a group, as they wait for each other. The limit: the operations in the step that JAX traces,
  equal terms once, each kind at the rate at which XLA runs it here on an array of 512 doubles that stays in the cache:
  additions and products in fused pairs, quotients, exponentials. That is about the least that a program which computes
  this step can take on one core, as it neither loads nor stores nor waits.
- The double pendulum with LuGre's law in its joints: 1024 runs of the scene, and of its equations written out by hand
  in scalars, by the same solver.
- The chain of six links with LuGre's law in its joints: a step of Rodas5P in steps of Tsit5.

    python bench/i4_steps.py [--smoke] [--out DIR]
"""

import dataclasses
from collections import Counter
from functools import partial
from typing import Any

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
from _lugre import TESTBENCH, lugre_field, parameter_sets
from _measure import machine_line, measure
from _options import begin
from _report import new_result, target_rows, write_result

import jaxmodsim as jms
from jaxmodsim._core.fusion import fusion_barrier, opaque_one
from jaxmodsim.problems import n_link_pendulum
from jaxmodsim.solvers import RODAS5P, rosenbrock_step

RTOL = 1e-4
KINDS = {"add": "sum", "sub": "sum", "add_any": "sum", "mul": "sum", "neg": "sum", "abs": "sum", "max": "sum"}
KINDS |= {"div": "quotient", "exp": "exponential"}
LAW = {"sigma0": 1e3, "sigma1": 3.0, "sigma2": 0.05, "Fc": 0.5, "Fs": 0.7, "vs": 0.1}
G = 9.81


def main() -> None:
    """Measure, and write `steps.json`."""
    options = begin("One step of Rodas5P.")
    smoke = options.smoke
    content = new_result("steps", options, "diffrax", "numpy")
    count, rounds = (64, 1) if smoke else (1024, 15)
    content["limit"] = limit = _limit(rounds)
    content["testbench"] = testbench = _testbench(count, rounds)
    content["joints"] = joints = _joints(2 if smoke else count, rounds)
    content["chain"] = chain = _chain(2 if smoke else 6, rounds)
    near = testbench["64 at a time"]["step_ns"] / limit["step_ns"]
    targets = target_rows(
        [
            ("testbench, 1024 at once, 64 at a time: step in the limit of the processor", "<= 4", near),
            ("the same, all 1024 in one batch", "<= 4", testbench["one batch"]["step_ns"] / limit["step_ns"]),
            ("double pendulum with joints, 1024 at once: step in that by hand", "<= 1.5", joints["ratio"]),
            ("six links with joints: step of Rodas5P in a step of Tsit5", "<= 4", chain["ratio"]),
        ]
    )
    rows = [
        ["testbench, limit of the processor", f"{limit['step_ns']:.3g}", ""],
        *([f"testbench, {way}", f"{row['step_ns']:.3g}", f"{row['steps']:.3g}"] for way, row in testbench.items()),
        *([f"double pendulum, {way}", f"{joints[way]['step_ns']:.3g}", f"{joints[way]['steps']:.3g}"] for way in WAYS),
        *(
            [f"chain of six, {each}", f"{chain[each]['step_ns']:.3g}", f"{chain[each]['steps']:.3g}"]
            for each in SOLVERS
        ),
    ]
    counted = ", ".join(f"{number} {kind}s" for kind, number in limit["operations"].items())
    rates = ", ".join(f"{rate:.2g} {kind}s" for kind, rate in limit["rates_per_ns"].items())
    caption = f"Time per step and lane. The limit: {counted}, at {rates} per ns. {machine_line(content['machine'])}"
    content["tables"] = [
        {"columns": ["what", "step [ns]", "steps of a run"], "rows": rows, "caption": caption},
        {"columns": ["ratio", "target", "measured", "met"], "rows": targets, "caption": ""},
    ]
    write_result(content, options)


def _limit(rounds: int) -> dict[str, Any]:
    """Operations of a step of the testbench, the rate of each kind, and the time they take at least."""
    zero, p = jnp.zeros(()), jnp.asarray(TESTBENCH.nominal)
    tableau = dataclasses.replace(RODAS5P, dense=None)  # these runs keep their end alone

    def step(t: Any, dt: Any, y: Any, p: Any) -> Any:
        made = rosenbrock_step(tableau, lambda t, y: lugre_field(t, y, p), t, dt, y, pivot=False)
        return made.y1, made.error

    operations = Counter(_kinds(jax.make_jaxpr(step)(zero, zero + 0.1, (zero, zero, zero), p).jaxpr))
    x = jnp.linspace(0.1, 0.9, 512)
    calls = {kind: partial(_many, kind, x) for kind in ("sum", "quotient", "exponential")}
    times = measure({kind: lambda call=call: call().block_until_ready() for kind, call in calls.items()}, rounds)
    rates = {kind: LOOPS * 512 * NUMBERS[kind] / (1e9 * found["minimum_s"]) for kind, found in times.items()}
    return {
        "operations": dict(operations),
        "rates_per_ns": rates,
        "step_ns": sum(number / rates[kind] for kind, number in operations.items()),
    }


# Operations for each entry in one pass: sixteen polynomials of degree 16, a product and a sum to the degree; the sums
# that join quotients and exponentials are not counted.
LOOPS, TERMS = 2000, 16
NUMBERS = {"sum": 2 * TERMS * TERMS, "quotient": TERMS, "exponential": TERMS}


@partial(jax.jit, static_argnums=0)
def _many(kind: str, x: Any) -> Any:
    """Operations that do not wait for each other, as often as there are loops."""

    def body(_: Any, y: Any) -> Any:
        terms = [y + (1.0 + k) for k in range(TERMS)]
        if kind == "quotient":
            terms = [x / term for term in terms]
        elif kind == "exponential":
            terms = [jnp.exp(-term) for term in terms]
        else:
            for _ in range(TERMS):
                terms = [term * x + 0.3 for term in terms]
        return 1e-3 * sum(terms[1:], terms[0])

    return jax.lax.fori_loop(0, LOOPS, body, x)


def _kinds(jaxpr: Any) -> list[str]:
    """Kind of each operation, those of equal terms once."""
    return _walk(jaxpr, list(range(len(jaxpr.invars))), {})[0]


def _walk(jaxpr: Any, inputs: list[Any], seen: dict[Any, int]) -> tuple[list[str], list[Any]]:
    """Kinds in a traced function whose inputs have these numbers; numbers of its outputs. Equal terms have one."""
    kinds: list[str] = []
    numbers: dict[Any, Any] = dict(zip(jaxpr.invars, inputs, strict=True))

    def read(atom: Any) -> Any:
        return str(atom.val) if hasattr(atom, "val") else numbers.get(atom, id(atom))

    for eqn in jaxpr.eqns:
        operands = [read(x) for x in eqn.invars]
        inner = eqn.params.get("jaxpr") or eqn.params.get("call_jaxpr")
        if inner is not None:
            found, outputs = _walk(inner.jaxpr, operands, seen)
            kinds += found
            numbers.update(zip(eqn.outvars, outputs, strict=True))
            continue
        key = (eqn.primitive.name, *operands, str(eqn.params))
        if key not in seen and eqn.primitive.name in KINDS:
            kinds.append(KINDS[eqn.primitive.name])
        seen.setdefault(key, 1000 + len(seen))
        numbers.update({var: (seen[key], i) for i, var in enumerate(eqn.outvars)})
    return kinds, [read(x) for x in jaxpr.outvars]


def _testbench(count: int, rounds: int) -> dict[str, Any]:
    sets = jnp.asarray(parameter_sets(count))

    def end(p: Any) -> Any:
        scene = TESTBENCH.scene(jms.LuGre(*(p[i] for i in range(6))))
        run = jms.simulate(scene, [0.0], [0.0], TESTBENCH.t1, rtol=RTOL, atol=TESTBENCH.atol * RTOL)
        return run.qd[-1, 0], run.stats["num_steps"]

    ways = {
        "one batch": (jax.jit(jax.vmap(end)), count),
        "64 at a time": (jax.jit(partial(jax.lax.map, end, batch_size=64)), 64),
    }
    times = measure({way: lambda run=run: jax.block_until_ready(run(sets)) for way, (run, _) in ways.items()}, rounds)
    found = {}
    for way, (run, group) in ways.items():
        # A group makes as many steps as its slowest lane.
        made = float(np.mean(np.asarray(run(sets)[1]).reshape(-1, group).max(axis=1)))
        found[way] = times[way] | {"steps": made, "step_ns": 1e9 * times[way]["median_s"] / (count * made)}
    return found


def _joint(i: int, q: Any, p: Any) -> Any:
    del p
    return q[i] - q[i - 1] if i else q[0]


def chain_with_joints(n: int) -> jms.Scene:
    """The chain with LuGre's law in each joint."""
    bare = n_link_pendulum(n)
    joints = tuple(jms.Friction(jms.LuGre(**LAW), along=_JOINTS[i], name=f"joint_{i}") for i in range(n))
    return jms.Scene(bare.lagrangian, bare.params, joints)


# Functions count by identity.
_JOINTS = [partial(_joint, i) for i in range(6)]
WAYS, SOLVERS = ("the scene", "by hand"), ("Rodas5P", "Tsit5")


def _by_hand(t: Any, y: Any, p: Any) -> Any:
    """Double pendulum, LuGre's law in its joints, scalars; unit masses and lengths, angles from straight down."""
    del t
    a, b, va, vb, za, zb = y
    unit = opaque_one(jax.lax.stop_gradient(a))
    c, s = fusion_barrier((jnp.cos(a - b), jnp.sin(a - b)), unit)
    slip = (va, vb - va)
    rates, forces = [], []
    for v, z in zip(slip, (za, zb), strict=True):
        ratio = v / p["vs"]
        level = p["Fc"] + (p["Fs"] - p["Fc"]) * jnp.exp(-ratio * ratio)
        rate = v - p["sigma0"] * jnp.abs(v) / level * z
        rates.append(rate)
        forces.append(p["sigma0"] * z + p["sigma1"] * rate + p["sigma2"] * v)
    first = -s * vb * vb - 2.0 * G * fusion_barrier(jnp.sin(a), unit) - forces[0] + forces[1]
    second = s * va * va - G * fusion_barrier(jnp.sin(b), unit) - forces[1]
    determinant = 2.0 - c * c
    return va, vb, (first - c * second) / determinant, (2.0 * second - c * first) / determinant, *rates


def _joints(count: int, rounds: int) -> dict[str, Any]:
    start = np.linspace(0.5, 1.5, count)
    scene, p = chain_with_joints(2), {name: jnp.asarray(value) for name, value in LAW.items()}

    def ours(a: Any) -> Any:
        q0 = jnp.stack([a, a + 0.3])
        run = jms.simulate(scene, q0, [0.0, 0.0], 1.0, rtol=1e-6, atol=1e-9, max_steps=100_000)
        return run.q[-1, 0], run.stats["num_steps"]

    def hand(a: Any) -> Any:
        zero = jnp.zeros_like(a)
        solved = dfx.diffeqsolve(
            dfx.ODETerm(_by_hand), jms.Rodas5P(), 0.0, 1.0, None, (a, a + 0.3, zero, zero, zero, zero), args=p,
            stepsize_controller=dfx.PIDController(1e-6, 1e-9, pcoeff=0.25, icoeff=0.5), max_steps=100_000,
        )  # fmt: skip
        assert solved.ys is not None
        return solved.ys[0][-1], solved.stats["num_steps"]

    runs = dict(zip(WAYS, (jax.jit(jax.vmap(ours)), jax.jit(jax.vmap(hand))), strict=True))
    one, other = (np.asarray(run(start)[0]) for run in runs.values())
    if not np.allclose(one, other, rtol=0.0, atol=1e-4):
        raise AssertionError(f"The scene and its equations differ by {np.max(np.abs(one - other)):.1e}.")
    times = measure({way: lambda run=run: jax.block_until_ready(run(start)) for way, run in runs.items()}, rounds)
    found: dict[str, Any] = {}
    for way, run in runs.items():
        made = int(np.max(np.asarray(run(start)[1])))
        found[way] = times[way] | {"steps": made, "step_ns": 1e9 * times[way]["median_s"] / (count * made)}
    return found | {"ratio": found["the scene"]["step_ns"] / found["by hand"]["step_ns"]}


def _chain(n: int, rounds: int) -> dict[str, Any]:
    scene, q0 = chain_with_joints(n), np.linspace(0.5, 1.5, n)
    solvers = dict(zip(SOLVERS, (jms.Rodas5P(), dfx.Tsit5()), strict=True))

    def run(solver: Any) -> jms.Trajectory:
        return jms.simulate(scene, q0, np.zeros(n), 1.0, rtol=1e-6, solver=solver, max_steps=100_000)

    times = measure({name: lambda s=s: run(s).q.block_until_ready() for name, s in solvers.items()}, rounds)
    found: dict[str, Any] = {}
    for name, solver in solvers.items():
        made = int(run(solver).stats["num_steps"])
        found[name] = times[name] | {"steps": made, "step_ns": 1e9 * times[name]["median_s"] / made}
    return found | {"ratio": found["Rodas5P"]["step_ns"] / found["Tsit5"]["step_ns"]}


if __name__ == "__main__":
    main()
