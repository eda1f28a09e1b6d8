"""Numbers that are none, too large, too small, or of another type."""

import math
from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from jaxmodsim.friction import Coulomb, Stribeck
from jaxmodsim.identify import Record
from jaxmodsim.problems import braked_spring, ramped_box
from jaxmodsim.scene import Signal
from jaxmodsim.simulation import Trajectory, simulate

from .case import HardCase, MeasuredNumber, RefusedCalls, motion, position, velocity

FAMILY = "numbers"
_NAN, _INF = float("nan"), float("inf")


def _run(**changes: PyTree) -> Trajectory:
    given = {"q0": [1.0], "qd0": [0.0], "t1": 1.0} | changes
    return simulate(
        braked_spring.scene(braked_spring.coulomb()), given.pop("q0"), given.pop("qd0"), given.pop("t1"), **given
    )


def _poisoned(value: float) -> Trajectory:
    scene = eqx.tree_at(
        lambda scene: scene.params["k"], braked_spring.scene(braked_spring.coulomb()), jnp.asarray(value)
    )
    return simulate(scene, [1.0], [0.0], 1.0)


def _refused(name: str, why: str, naive: str, calls: dict[str, tuple[Callable[[], object], str]]) -> HardCase:
    task = RefusedCalls(
        {key: call for key, (call, _) in calls.items()}, {key: text for key, (_, text) in calls.items()}
    )
    return HardCase(name, why, naive, task, asks="errors that name what is wrong")


def _garbage() -> list[HardCase]:
    t = np.linspace(0.0, 1.0, 11)
    hole = np.where(t == 0.5, _NAN, t)
    return [
        _refused(
            "nan_parameters",
            "NaN or infinity among the parameters: given, put in later, or computed.",
            "NaN all the way to the end, or a step control that never accepts anything.",
            {
                "law": (lambda: Coulomb(_NAN), "Fc must be finite"),
                "infinite law": (lambda: ramped_box.lugre(sigma0=_INF), "sigma0 must be finite"),
                "put in later": (lambda: _poisoned(_NAN), "'k' of the scene is NaN"),
                "infinite, put in later": (lambda: _poisoned(_INF), "not finite"),
            },
        ),
        _refused(
            "nan_states",
            "NaN or infinity in the initial state, the times or the tolerances.",
            "A run of NaN under a success code.",
            {
                "q0": (lambda: _run(q0=[_NAN]), "q0 must be finite"),
                "qd0": (lambda: _run(qd0=[_INF]), "qd0 must be finite"),
                "t1": (lambda: _run(t1=_INF), "t1 must be finite"),
                "rtol": (lambda: _run(rtol=_NAN), "rtol must be finite"),
                "dt": (lambda: _run(dt=0.0), "dt must be positive"),
            },
        ),
        _refused(
            "nan_records",
            "Holes in measured records and inputs.",
            "A fit that converges to NaN, or not at all.",
            {
                "time": (lambda: Record(hole, {"q[0]": t}), "t "),
                "signal": (lambda: Signal(t, hole), "values"),
            },
        ),
        _refused(
            "times_unfit",
            "Times to save at: none, out of order, outside the run.",
            "An index error, or numbers beyond the end that nothing was computed for.",
            {
                "empty": (lambda: _run(ts=[]), r"ts must be a vector of times, shape \[time\]"),
                "unsorted": (lambda: _run(ts=[0.5, 0.2]), "ts must increase"),
                "outside": (lambda: _run(ts=[0.5, 2.0]), r"ts must lie within \[t0, t1\]"),
                "before": (lambda: _run(ts=[-0.5, 0.5]), r"ts must lie within \[t0, t1\]"),
                "backwards": (lambda: _run(t1=-1.0), "t1 must not be before t0"),
            },
        ),
    ]


def _same_times() -> float:
    """Largest difference between the rows of times given twice, and between a run with one time and one without."""
    twice = _run(ts=[0.5, 0.5, 1.0, 1.0])
    last, end = _run(ts=[1.0]), _run()
    rows = np.abs(np.diff(np.asarray(twice.q)[:, 0]))[[0, 2]]
    return float(max(*rows, abs(float(last.q[-1, 0] - end.q[-1, 0]))))


def _same_types() -> float:
    """Largest difference between runs whose numbers are Python's, NumPy's and JAX's, whole and floating."""
    kinds: list[Callable[[float], PyTree]] = [float, int, np.int32, np.float64, np.asarray, jnp.asarray]
    ends = []
    for kind in kinds:
        scene = braked_spring.scene(Coulomb(kind(1), kind(2)), m=kind(1), k=kind(10))
        run = simulate(scene, [kind(1)], [kind(0)], kind(3), ts=[kind(1), kind(2), kind(3)])
        ends.append(np.asarray(run.q))
    return float(max(np.max(np.abs(end - ends[0])) for end in ends))


def _extremes() -> list[HardCase]:
    thin = Stribeck(Fc=1.5, Fs=1.75, vs=1e-160)
    return [
        HardCase(
            "overflow_in_stribeck",
            "vs = 1e-160 m/s: (v/vs)^2 overflows, and its derivative is infinity times zero.",
            "NaN in the derivative, though the value is right.",
            motion(ramped_box.scene(thin), [0.0], [0.0], 10.0, by="friction.Fc", read=velocity),
            # It breaks away at Fs and then feels Fc: v = ((t - Fc)^2 - (Fs - Fc)^2)/(2 m).
            lambda Fc: ((10.0 - Fc) ** 2 - (1.75 - Fc) ** 2) / 4.0,
            # 1e-160 is zero in float32.
            single=None,
        ),
        HardCase(
            "subnormal_state",
            "A deflection of 1e-310 m, below what processors compute with at full speed, or at all.",
            "NaN where it is divided by, or a hundredfold slower run.",
            motion(braked_spring.scene(m=1.0, k=1.0), [1e-310], [0.0], 5.0, by="k", read=position),
            lambda _: 0.0,
            scale=1.0,
            conserves=False,
        ),
        HardCase(
            "huge_state",
            "A deflection of 1e150 m: its square is the energy, the square of that overflows.",
            "Infinity in norms.",
            motion(braked_spring.scene(m=1.0, k=1.0), [1e150], [0.0], 5.0, by="q0[0]", read=position),
            lambda x0: x0 * math.cos(5.0),
            # No such number in float32.
            single=None,
        ),
        HardCase(
            "types_mixed",
            "Whole numbers, Python's, NumPy's and JAX's, for masses, states and times.",
            "Integer arrays that round the motion off, or an error from a loop whose types differ.",
            MeasuredNumber(_same_types),
            lambda _: 0.0,
            asks="largest difference between the runs [m]",
            scale=1.0,
            tolerance=1e-15,
        ),
        HardCase(
            "times_repeated",
            "Times given twice, and a single one.",
            "Rows of NaN for the second of two.",
            MeasuredNumber(_same_times),
            lambda _: 0.0,
            asks="largest difference between what must be equal [m]",
            scale=1.0,
            tolerance=1e-15,
        ),
    ]


def cases() -> list[HardCase]:
    """The cases of this family."""
    return [*_garbage(), *_extremes()]
