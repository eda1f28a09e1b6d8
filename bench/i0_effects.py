"""What each effect adds: operations and time, to one evaluation of the vector field, to a run, and to a compilation.

A mass of 1 kg on a spring of 100 N/m, on a belt at 0.1 m/s where there is friction, 10 s at rtol 1e-6; and a point mass
in a plane, free and on a rod. Each effect is held against the same mechanism with nothing, by the same solver:

- the field: operations, transcendental functions and bytes that XLA counts in the compiled evaluation at one state; its
  time in a loop of evaluations of which each depends on the last;
- a run: those that XLA counts in the compiled run, where the body of a loop counts once, so that they are about those
  of one step; its time, warm, and its number of steps;
- a compilation from cleared caches: time of `jax.jit(...).lower`, which traces, and of `.compile()`; the shortest.

A field and a run with nothing are held against those written by hand in JAX, by d/dt dL/dqd = dL/dq and by closed form:
same primitives, same operations.

    python bench/i0_effects.py [--smoke] [--out DIR]
"""

import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.extend
import jax.numpy as jnp
import numpy as np
from _measure import machine_line, measure
from _options import begin
from _report import new_result, write_figure, write_result
from matplotlib import pyplot as plt

import jaxmodsim as jms
from jaxmodsim.problems import (
    belt_oscillator,
    braked_spring,
    cartesian_pendulum,
    spherical_pendulum,
    spherical_pendulum_acceleration,
)
from jaxmodsim.scene import State, scene_guards, vector_field

T1, LOOP = 10.0, 2000
COUNTED = {"flops": "operations", "transcendentals": "transcendental", "bytes accessed": "bytes"}
BRISTLE = {"sigma0": 1e4, "sigma1": 100.0, "sigma2": 0.4, "Fc": 5.0, "Fs": 8.0, "vs": 0.05}
NOTHING, STIFF, FIXED, FREE, AUDITED = (
    "nothing",
    "nothing, by Rodas5P",
    "nothing, steps of 1 ms",
    "nothing, in a plane",
    "viscous, kept at 100 times",
)


@dataclass(frozen=True)
class Case:
    """A scene and how it is run.

    - `scene`, `q0`, `qd0`: what is run, [m] and [m/s].
    - `base`: name of the case with nothing that it is held against.
    - `options`: of `simulate`.
    - `read`: what the run returns, from the `Trajectory`.
    """

    scene: jms.Scene
    base: str = STIFF
    q0: tuple[float, ...] = (0.05,)
    qd0: tuple[float, ...] = (0.1,)
    options: dict[str, Any] = field(default_factory=dict)
    read: Callable[[jms.Trajectory], Any] = lambda run: run.qd[-1]

    def run(self, scene: jms.Scene) -> Any:
        """The run, to be traced."""
        return self.read(jms.simulate(scene, list(self.q0), list(self.qd0), T1, **self.options))

    @property
    def state(self) -> tuple[State, Any]:
        """A state within the run, and its modes where there are any: in slip, slower than the belt."""
        q, qd = jnp.asarray(self.q0), 0.5 * jnp.asarray(self.qd0)
        return State(q, qd, self.scene.initial_state(q)), -jnp.ones(
            len(self.scene.event_driven)
        ) if self.scene.event_driven else None


def spring(*effects: Any) -> jms.Scene:
    """The mass on its spring, without a belt."""
    return eqx.tree_at(lambda scene: scene.effects, braked_spring(m=1.0, k=100.0), effects)


def everything() -> dict[str, Case]:
    """All cases by name; those with nothing first."""
    stribeck = jms.Stribeck(Fc=5.0, Fs=8.0, vs=0.05, Fv=0.4)
    fixed = {"dt": 1e-3, "solver": dfx.Tsit5()}
    rod, place = cartesian_pendulum(), {"q0": (1.0, 0.0), "qd0": (0.0, 0.0)}
    viscous, hundred = spring(jms.Friction(jms.Viscous(0.4))), {"ts": np.linspace(0.0, T1, 100)}
    laws = {
        "Coulomb, exact": jms.Coulomb(5.0, 8.0),
        "Stribeck, exact": stribeck,
        "Regularized(Stribeck)": jms.Regularized(stribeck, 1e-3),
        "Dahl": jms.Dahl(1e4, 5.0),
        "LuGre": jms.LuGre(**BRISTLE),
        "ElastoPlastic": jms.ElastoPlastic(**BRISTLE, Fba=4.0),
        "MaxwellSlip, 4 elements": jms.MaxwellSlip([4e3, 3e3, 2e3, 1e3], [1.25] * 4),
    }
    bare, free = spring(), eqx.tree_at(lambda scene: scene.constraints, rod, ())
    return {
        NOTHING: Case(bare, NOTHING),
        STIFF: Case(bare, STIFF, options={"solver": jms.Rodas5P()}),
        FIXED: Case(bare, FIXED, options=fixed),
        FREE: Case(free, FREE, **place),
        "Viscous": Case(viscous, NOTHING),
        **{name: Case(belt_oscillator(law, m=1.0, k=100.0, belt=0.1)) for name, law in laws.items()},
        "DeadZone(Stribeck)": Case(
            belt_oscillator(jms.DeadZone(stribeck, 1e-3), m=1.0, k=100.0, belt=0.1), FIXED, options=fixed
        ),
        "events, none comes": Case(belt_oscillator(jms.Coulomb(5.0), m=1.0, k=100.0, belt=10.0)),
        "constraint": Case(rod, FREE, **place),
        "kept at 100 times": Case(bare, NOTHING, options=hundred, read=lambda run: run.qd),
        "kept at 1000 times": Case(bare, NOTHING, options={"ts": np.linspace(0.0, T1, 1000)}, read=lambda run: run.qd),
        AUDITED: Case(viscous, AUDITED, options=hundred, read=lambda run: run.qd),
        "run.energy, at 100 times": Case(
            viscous, AUDITED, options=hundred, read=lambda run: (run.qd, run.energy.balance)
        ),
        "energy_audit, at 100 times": Case(
            viscous, AUDITED, options=hundred, read=lambda run: (run.qd, jms.energy_audit(run).closing_error)
        ),
    }  # fmt: skip


def main() -> None:
    """Measure, and write `effects.json` and `.png`."""
    options = begin("What each effect adds.")
    smoke, cases = options.smoke, everything()
    if smoke:
        cases = {name: cases[name] for name in (NOTHING, STIFF, "Viscous", "LuGre")}
    found = {name: {"base": case.base, **_counts(case)} for name, case in cases.items()}
    for turn in range(1 if smoke else 3):
        for name, case in cases.items():
            _add_compile_times(found[name], case, turn)
    fields = {name: _field_call(case) for name, case in cases.items()}
    runs = {name: _run_call(case) for name, case in cases.items()}
    hand = by_hand()
    calls = {f"field: {name}": call for name, call in fields.items()}
    calls |= {f"run: {name}": call for name, call in runs.items()}
    calls |= {f"hand: {name}": call for name, call in _hand_calls(hand).items()}
    times = measure(calls, 1 if smoke else 25, limit_s=10.0)
    for name, row in found.items():
        row["field"]["seconds"] = times[f"field: {name}"]["minimum_s"] / LOOP
        row["run"]["seconds"] = times[f"run: {name}"]["median_s"]
    content = new_result("effects", options, "diffrax") | {
        "cases": found,
        "nothing": {name: _against_hand(row, name, times) for name, row in hand.items()},
        "times": times,
    }
    content["tables"] = [_hand_table(content), _field_table(content), _run_table(content), _target_table(content)]
    write_result(content, options)
    draw(content, options.out / "effects.png")


# What XLA counts, and what takes time.


def counted(compiled: Any) -> dict[str, float]:
    """Operations, transcendental functions and bytes accessed, as XLA counts them; it leaves out what is zero."""
    analysis = compiled.cost_analysis()
    return {short: float(analysis.get(name, 0.0)) for name, short in COUNTED.items()}


def _field(case: Case) -> Callable[..., Any]:
    mode = case.state[1]
    return lambda t, y, scene: vector_field(t, y, scene, mode)


def _counts(case: Case) -> dict[str, Any]:
    state, mode = case.state
    t = jnp.asarray(0.3)
    found = {
        "field": counted(jax.jit(_field(case)).lower(t, state, case.scene).compile()),
        "run": counted(jax.jit(case.run).lower(case.scene).compile()),
    }
    if mode is not None:
        tolerances = jnp.asarray(1e-6), jnp.asarray(1e-9)
        guards = jax.jit(lambda t, y, scene: scene_guards(t, y, scene, mode, jnp.asarray(1e-12), tolerances)[0])
        found["guards"] = counted(guards.lower(t, state, case.scene).compile())
    run = jms.simulate(case.scene, list(case.q0), list(case.qd0), T1, **case.options)
    found["run"]["steps"] = int(run.stats["num_steps"])
    found["run"]["events"] = int(np.isfinite(run.events.t).sum()) if case.scene.event_driven else 0
    return found


def _add_compile_times(row: dict[str, Any], case: Case, turn: int) -> None:
    """Shortest time of a turn to trace and lower the run, and to compile it."""
    jax.clear_caches()
    # A function of its own, which nothing has seen.
    start = time.perf_counter()
    lowered = jax.jit(lambda scene: case.run(scene)).lower(case.scene)
    between = time.perf_counter()
    lowered.compile()
    taken = {"lower_s": between - start, "compile_s": time.perf_counter() - between}
    row["compilation"] = taken if turn == 0 else {key: min(row["compilation"][key], taken[key]) for key in taken}


def _chain(function: Callable[..., Any], t: Any, y: Any, given: Any) -> Any:
    """So many evaluations of a field, each at the state that the last one has moved a little."""

    def once(_: Any, y: Any) -> Any:
        return jax.tree.map(lambda a, b: a + 1e-12 * b, y, function(t, y, given))

    return jax.lax.fori_loop(0, LOOP, once, y)


def _field_call(case: Case) -> Callable[[], Any]:
    chain, t, state = jax.jit(partial(_chain, _field(case))), jnp.asarray(0.3), case.state[0]
    return lambda: jax.block_until_ready(chain(t, state, case.scene))


def _run_call(case: Case) -> Callable[[], Any]:
    run = jax.jit(case.run)
    return lambda: jax.block_until_ready(run(case.scene))


# Nothing, against the same by hand.


def euler_lagrange(scene: jms.Scene, t: Any, y: State) -> State:
    """d/dt dL/dqd = dL/dq by hand, for one coordinate."""

    def momentum(t: Any, q: Any, qd: Any) -> Any:
        by_q, by_qd = jax.grad(scene.lagrangian, argnums=(1, 2))(t, q, qd, scene.params)
        return by_qd, by_q

    _, push, by_q = jax.linearize(momentum, t, y.q, y.qd, has_aux=True)
    still, rest = jnp.zeros_like(t), jnp.zeros_like(y.q)
    mass = push(still, rest, jnp.ones_like(y.qd))[None]
    return State(y.qd, (by_q - push(jnp.ones_like(t), y.qd, rest)) / mass[0], {})


def by_hand() -> dict[str, dict[str, Any]]:
    """Mechanisms with nothing: scene, state, and fields `function(t, y, scene)` by hand."""
    box, pendulum = spring(), spherical_pendulum()

    def sprung(t: Any, y: State, scene: jms.Scene) -> State:
        del t
        return State(y.qd, -scene.params["k"] / scene.params["m"] * y.q, {})

    def swinging(t: Any, y: State, scene: jms.Scene) -> State:
        del t
        p = scene.params
        return State(y.qd, spherical_pendulum_acceleration(y.q, y.qd, R=p["R"], g=p["g"]), {})

    return {
        "mass on a spring": {
            "scene": box,
            "state": State(jnp.array([0.05]), jnp.array([0.1]), {}),
            "by d/dt dL/dqd = dL/dq": lambda t, y, scene: euler_lagrange(scene, t, y),
            "by closed form": sprung,
        },
        "spherical pendulum": {
            "scene": pendulum,
            "state": State(jnp.array([2.0, 0.1]), jnp.array([0.3, 2.0]), {}),
            "by closed form": swinging,
        },
    }


OURS = "jaxmodsim"


def _ways(row: dict[str, Any]) -> dict[str, Callable[..., Any]]:
    return {OURS: vector_field} | {way: function for way, function in row.items() if way.startswith("by ")}


def hand_run(function: Callable[..., Any], y: State, scene: jms.Scene) -> Any:
    """A run by plain diffrax, with the settings of `simulate`."""
    solved = dfx.diffeqsolve(
        dfx.ODETerm(function), dfx.Tsit5(), 0.0, T1, None, y, args=scene,
        stepsize_controller=dfx.PIDController(rtol=1e-6, atol=1e-9), max_steps=16384, throw=False,
    )  # fmt: skip
    assert solved.ys is not None
    return solved.ys.qd[-1]


def our_run(y: State, scene: jms.Scene) -> Any:
    """The same by `simulate`."""
    return jms.simulate(scene, y.q, y.qd, T1, solver=dfx.Tsit5()).qd[-1]


def _hand_calls(hand: dict[str, dict[str, Any]]) -> dict[str, Callable[[], Any]]:
    calls: dict[str, Callable[[], Any]] = {}
    t = jnp.asarray(0.3)
    for name, row in hand.items():
        state, scene = row["state"], row["scene"]
        for way, function in _ways(row).items():
            chain = jax.jit(partial(_chain, function))
            calls[f"{name}, {way}, field"] = lambda c=chain, y=state, s=scene: jax.block_until_ready(c(t, y, s))
            run = jax.jit(our_run if way == OURS else partial(hand_run, function))
            calls[f"{name}, {way}, run"] = lambda r=run, y=state, s=scene: jax.block_until_ready(r(y, s))
    return calls


def _against_hand(row: dict[str, Any], name: str, times: dict[str, Any]) -> dict[str, Any]:
    """Primitives, what XLA counts, and time of a field and of a run in each way."""
    t, found = jnp.asarray(0.3), {}
    for way, function in _ways(row).items():
        run = our_run if way == OURS else partial(hand_run, function)
        found[way] = {
            "primitives": dict(_primitives(jax.make_jaxpr(function)(t, row["state"], row["scene"]).jaxpr)),
            "field": counted(jax.jit(function).lower(t, row["state"], row["scene"]).compile()),
            "run": counted(jax.jit(run).lower(row["state"], row["scene"]).compile()),
        }
        found[way]["field"]["seconds"] = times[f"hand: {name}, {way}, field"]["minimum_s"] / LOOP
        found[way]["run"]["seconds"] = times[f"hand: {name}, {way}, run"]["median_s"]
    return found


def _primitives(jaxpr: Any) -> Counter[str]:
    """Primitives, with those inside of called functions and without the calls themselves."""
    total: Counter[str] = Counter()
    for equation in jaxpr.eqns:
        inner = [x.jaxpr for x in equation.params.values() if isinstance(x, jax.extend.core.ClosedJaxpr)]
        total += sum((_primitives(x) for x in inner), Counter()) if inner else Counter([equation.primitive.name])
    return total


# Tables.


def _hand_table(content: dict[str, Any]) -> dict[str, Any]:
    rows = []
    for name, ways in content["nothing"].items():
        ours = ways[OURS]
        for way, row in ways.items():
            ratios = [f"{ours[part]['seconds'] / row[part]['seconds']:.2f}" for part in ("field", "run")]
            rows.append(
                [
                    f"{name}, {way}",
                    str(sum(row["primitives"].values())),
                    f"{row['field']['operations']:.0f}",
                    f"{row['field']['transcendental']:.0f}",
                    f"{1e9 * row['field']['seconds']:.3g}",
                    ratios[0],
                    f"{row['run']['operations']:.0f}",
                    f"{1e6 * row['run']['seconds']:.3g}",
                    ratios[1],
                ]
            )
    columns = ["nothing", "primitives", "operations", "transcendental", "field [ns]", "ours in it"]
    columns += ["operations in a run", "run [us]", "ours in it"]
    caption = (
        "A scene with nothing in it, and the same by hand in JAX: primitives traced and operations that XLA counts in"
        f" one evaluation of the field; a run of {T1:g} s by Tsit5 at 1e-6, of ours with all its checks, by hand in"
        f" plain diffrax. {_caption(content)}"
    )
    return {"columns": columns, "rows": rows, "caption": caption}


def _added(content: dict[str, Any], name: str, part: str, key: str) -> float:
    cases = content["cases"]
    return cases[name][part][key] - cases[cases[name]["base"]][part][key]


def _cell(content: dict[str, Any], name: str, part: str, key: str, unit: float = 1.0) -> str:
    """Of a case with nothing what there is; of an effect what it adds."""
    case = content["cases"][name]
    if case["base"] == name:
        return f"{unit * case[part][key]:.3g}"
    value = unit * _added(content, name, part, key)
    return f"{value:+.3g}" if abs(value) < 1e4 else f"{value:+.0f}"


def _field_table(content: dict[str, Any]) -> dict[str, Any]:
    rows = []
    for name, case in content["cases"].items():
        if name not in (STIFF, FIXED) and not _is_how(name):
            guards = case.get("guards")
            cells = [_cell(content, name, "field", key) for key in COUNTED.values()]
            extra = f"{guards['operations']:.0f}" if guards else "-"
            rows.append([name, *cells, _cell(content, name, "field", "seconds", 1e9), extra])
    caption = (
        "One evaluation of the vector field: of nothing what XLA counts and its time, of each effect what it adds."
        f" Guards: operations to watch for the next event, in each step beside those of the field. {_caption(content)}"
    )
    columns = ["effect", "operations", "transcendental", "bytes", "time [ns]", "guards, operations"]
    return {"columns": columns, "rows": rows, "caption": caption}


def _is_how(name: str) -> bool:
    """Whether a case differs in what is done with a run, not in its field."""
    return "times" in name


def _run_table(content: dict[str, Any]) -> dict[str, Any]:
    rows = []
    for name, case in content["cases"].items():
        run, base = case["run"], case["base"]
        step = 1e6 * run["seconds"] / run["steps"]
        rows.append(
            [
                name,
                "-" if base == name else base,
                *(_cell(content, name, "run", key) for key in COUNTED.values()),
                str(run["steps"]),
                str(run["events"]),
                _cell(content, name, "run", "seconds", 1e6),
                f"{step:.2f}",
                _cell(content, name, "compilation", "lower_s"),
                _cell(content, name, "compilation", "compile_s"),
            ]
        )
    caption = (
        f"A run of {T1:g} s and its compilation: of nothing what there is, of each effect what it adds to the case in"
        " the second column; steps, events and time per step are its own. XLA counts the body of a loop once, so"
        f" operations are about those of a step. {_caption(content)}"
    )
    columns = ["effect", "against", "operations", "transcendental", "bytes", "steps", "events", "run [us]", "step [us]"]
    return {"columns": [*columns, "trace and lower [s]", "compile [s]"], "rows": rows, "caption": caption}


def _target_table(content: dict[str, Any]) -> dict[str, Any]:
    ways = content["nothing"]["mass on a spring"]
    ours, hand = ways[OURS], ways["by d/dt dL/dqd = dL/dq"]
    counts = [f"{sum(row['primitives'].values())}" for row in (ours, hand)]
    field = [f"{row['field']['operations']:.0f}" for row in (ours, hand)]
    rows = [
        ["primitives", "equal", " and ".join(counts), "yes" if ours["primitives"] == hand["primitives"] else "no"],
        ["operations by XLA", "equal", " and ".join(field), "yes" if field[0] == field[1] else "no"],
    ]
    caption = f"A field with nothing against d/dt dL/dqd = dL/dq by hand. {machine_line(content['machine'])}"
    return {"columns": ["quantity", "target", "measured", "met"], "rows": rows, "caption": caption}


def _caption(content: dict[str, Any]) -> str:
    return f"All in one process, with `jaxmodsim.tune_cpu()`. {machine_line(content['machine'])}"


# Name of a panel, part and key of its numbers, unit, and the label of its axis.
PANELS = (
    ("One evaluation of the field", "field", "operations", 1.0, "operations added [1]"),
    ("One evaluation of the field", "field", "seconds", 1e9, "time added [ns]"),
    (f"A run of {T1:g} s", "run", "seconds", 1e6, "time added [us]"),
    ("A compilation", "compilation", "total_s", 1.0, "time added [s]"),
)


def _short(value: float) -> str:
    return f"{value:.0f}" if value >= 100.0 else f"{value:.2g}"


def draw(content: dict[str, Any], path: Path) -> None:
    """What each effect adds, a bar each on a logarithmic scale; a line shows what there is with nothing."""
    for case in content["cases"].values():
        case["compilation"]["total_s"] = sum(case["compilation"][key] for key in ("lower_s", "compile_s"))
    names = [name for name, case in content["cases"].items() if case["base"] != name][::-1]
    figure, axes = plt.subplots(1, 4, figsize=(14.0, 0.9 + 0.33 * len(names)), sharey=True, layout="constrained")
    for panel, (title, part, key, unit, label) in zip(axes, PANELS, strict=True):
        there = unit * content["cases"][NOTHING][part][key]
        values = np.array([unit * _added(content, name, part, key) for name in names])
        if part == "field":
            values = np.where([_is_how(name) for name in names], np.nan, values)
        least = 10.0 ** np.floor(np.log10(min(there, *values[values > 0.02 * there]))) if (values > 0).any() else there
        panel.barh(names, np.where(values > least, values - least, 0.0), left=least, color="C0", height=0.66)
        for place, value in enumerate(values):
            text = "-" if np.isnan(value) else _short(value) if value > least else "about 0"
            panel.annotate(
                text, (max(value, least) if value > least else least, place), xytext=(4, 0),
                textcoords="offset points", va="center", fontsize=8, zorder=4,
                bbox={"facecolor": "white", "edgecolor": "none", "pad": 0.6},
            )  # fmt: skip
        panel.axvline(there, color="C1", lw=1.2, ls="--")
        panel.annotate(
            f"nothing: {_short(there)}", (there, len(names) - 0.45), xytext=(3, 0), textcoords="offset points",
            color="C1", fontsize=8, annotation_clip=False,
        )  # fmt: skip
        panel.set_xscale("log")
        panel.set_xlim(least, 6.0 * max(there, np.nanmax(values)))
        panel.set_ylim(-0.6, len(names) + 0.1)
        panel.set_xlabel(label)
        panel.set_title(title, loc="left", fontsize=10)
        panel.spines[["top", "right"]].set_visible(False)
        panel.grid(axis="x", which="major", alpha=0.25)
    write_figure(figure, path)


if __name__ == "__main__":
    main()
