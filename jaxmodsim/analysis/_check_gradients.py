"""`check_gradients`: forward mode, reverse mode and finite differences side by side."""

import functools
import inspect
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array

from .._core.arrays import is_known
from .._core.readable import Table
from ..scene import Scene, elements, read_element, replace_elements
from ..simulation import Trajectory, simulate
from ..solvers import StoredSteps
from ._differences import (
    Agreement,
    DerivativeEstimate,
    Grazing,
    Histories,
    History,
    Probe,
    Sample,
    changed,
    estimate,
    first_difference,
    grazing,
    kink,
    probe,
    usable,
)

Verdict = Literal["agree", "disagree", "modes change", "grazing", "kink", "unclear", "no differences"]

# Tolerances by bytes of the type: of derivatives against differences, and of forward against reverse mode.
_RTOL = {8: 1e-3, 4: 1e-2}
_RTOL_MODES = {8: 1e-6, 4: 1e-3}
# Differences with a larger relative error are inconclusive.
_UNCLEAR = 0.1
# Derivatives below this fraction of the largest, each per relative change of its number, count as zero.
_TINY = 1e-3
_MODES = {0: "stick", 1: "forward slip", -1: "backward slip"}
_INTERFACE = (
    "check_gradients needs a function fn(scene, simulate) that runs the scene with its argument `simulate` and returns"
    " one number, as in: def fn(scene, simulate=jaxmodsim.simulate): return simulate(scene, [1.0], [0.0],"
    " 5.0).q[-1, 0]."
)


@dataclass(frozen=True)
class NumberCheck:
    """The derivative of a function by one number of a scene, from three methods.

    - `name`, `value`: of the number.
    - `forward`, `reverse`: the derivative by `jax.jvp` and by `jax.grad`.
    - `differences`, `error`, `step`: the derivative by finite differences, its estimated error, and the smaller of the
      two steps of the extrapolation; NaN without differences.
    - `verdict`: `agree`; `disagree`; `modes change`, `grazing` or `kink` (not differentiable here, see
      `check_gradients`); `unclear` (the differences are too noisy); `no differences` (the runs next to this one fail).
    - `warnings`: sentences that explain the verdict and advise.
    """

    name: str
    value: float
    forward: float
    reverse: float
    differences: float
    error: float
    step: float
    verdict: Verdict
    warnings: tuple[str, ...]


@dataclass(frozen=True)
class GradientCheck:
    """The result of `check_gradients`, which prints as a table.

    - `value`: of the function.
    - `dtype`: floating type of the function.
    - `numbers`: a `NumberCheck` for each number, by name.
    - `warnings`: sentences about the numbers and the check as a whole.
    - `ok`: whether all derivatives agree with each other and with the differences. Warnings may still limit the range
      in which they do.

    **Example:**

    ```python
    def end(scene, simulate=jms.simulate):
        return simulate(scene, [1.0], [0.0], 2.0).q[-1, 0]

    check = jms.check_gradients(end, jms.problems.braked_spring.scene(), names=("k",))
    print(check.numbers["k"].verdict, check.warnings)
    ```

    ```text
    agree ()
    ```
    """

    value: float
    dtype: str
    numbers: dict[str, NumberCheck]
    warnings: tuple[str, ...]

    @property
    def ok(self) -> bool:
        """Whether the verdict on every number is `agree`."""
        return all(number.verdict == "agree" for number in self.numbers.values())

    def __str__(self) -> str:
        """A table of the numbers, and the warnings."""
        rows = [
            (
                *(n.name, f"{n.value:.5g}", f"{n.forward:.7g}", f"{n.reverse:.7g}", f"{n.differences:.7g}"),
                *(f"{n.error:.1g}", f"{n.step:.2g}", n.verdict),
            )
            for n in self.numbers.values()
        ]
        head = ("number", "value", "forward", "reverse", "differences", "+-", "step", "verdict")
        return Table(f"fn = {self.value:.9g} ({self.dtype})", head, rows, self.warnings).text()


def check_gradients(
    fn: Callable[..., object],
    scene: Scene,
    *,
    names: Sequence[str] | None = None,
    scales: Mapping[str, float] | None = None,
    rtol: float | None = None,
) -> GradientCheck:
    """Compare forward-mode, reverse-mode and finite-difference derivatives of a function of a scene.

    The function must run the scene with its second argument `simulate`, which records the modes of the runs. With
    `jaxmodsim.simulate` as the default of that argument, the same function works with `jax.grad`. The function may run
    several scenes, including others made from this one. Initial values and times are checked if it reads them from
    `scene.params`. Do not put the function inside `jax.jit`: `simulate` compiles by itself.

    **Differences.** The function is evaluated at +-1 % of each number and at four more steps, each a quarter of the one
    before (float32: 4 %, three more). A step is used if its runs and those of all smaller steps succeed with the modes
    of the unperturbed run. Richardson extrapolation combines two successive steps; the pair with the smallest estimated
    error is reported, with its smaller step. The error estimate is the correction of the extrapolation, plus the noise
    of the runs over the step. If runs fail on one side (out of range), the differences are one-sided.

    **Not differentiable here.**

    - `modes change`: the sequence of mode changes of an effect differs at one of the two smallest steps. If it differs
      at larger steps only, the derivative is right, and a warning gives the distance. This is also the only check for
      events that just fail to happen, such as a load that almost reaches the limit of stick. Mode changes of two
      effects that swap their order count as unchanged.
    - `grazing`: derivatives and differences disagree or are unclear, and the time of an event follows a square root
      that ends within 5 % of the number. A guard that crosses zero at a vanishing rate has such an event. If
      derivatives and differences agree, a warning names the event. Grazing in a combination of numbers alone is not
      detected.
    - `kink`: the modes are the same, but the slopes from below and above differ at the three smallest steps, as at the
      corner of `abs` or `maximum`.

    **Arguments:**

    - `fn`: `fn(scene, simulate)` -> a real scalar.
    - `scene`: the `Scene` at which to check.
    - `names`: names of the numbers to check, as in `jaxmodsim.scene.scene_numbers`, with `[i]` for one entry of an
      array; by default all.
    - `scales`: by name, the magnitude to which the steps are relative, > 0; by default the absolute value of the
      number, or 1 if it is 0.
    - `rtol`: largest relative deviation from the differences, in addition to three times their estimated error; by
      default 1e-3, in float32 1e-2. Forward and reverse mode must agree to 1e-6, in float32 to 1e-3. Derivatives that
      are tiny relative to the function, its other derivatives and the `atol` of its runs count as zero.

    **Returns:**

    A `GradientCheck`: `.ok`, `.numbers[name]`, `.warnings`, and a table when printed.

    **Raises:**

    - `ValueError` if `fn` does not take `simulate`, does not use it, or returns no finite real scalar; if the scene has
      no numbers, or none of a name in `names`.
    - `SimulationError` if the run at `scene` itself ends early.

    **Example:**

    ```python
    def end(scene, simulate=jms.simulate):
        return simulate(scene, [1.0], [0.0], 2.0).q[-1, 0]

    scene = jms.problems.braked_spring.scene()
    print(jms.check_gradients(end, scene).ok, f"{jax.grad(end)(scene).params['k']:.5f} m/(N/m)")
    ```

    ```text
    True -0.13685 m/(N/m)
    ```
    """
    entries = _entries(scene, names, scales or {})
    runs: list[Trajectory] = []
    evaluate = functools.partial(_evaluate, fn, scene, runs, _recording(runs))
    value, recorded, atol, adjoints = _first(fn, scene, runs)
    itemsize = min(x.dtype.itemsize for x in (value, *jtu.tree_leaves(scene)))
    if itemsize not in _RTOL:
        raise ValueError(f"check_gradients works in float32 and float64, but the scene holds {value.dtype}.")
    gradient = jax.grad(fn)(scene, simulate)
    forward = {name: _forward(fn, scene, name) for name in entries}
    reverse = {name: read_element(gradient, name) for name in entries}
    scale = {name: (scales or {}).get(name, abs(x) or 1.0) for name, x in entries.items()}
    slopes = [abs(d[name]) * scale[name] for d in (forward, reverse) for name in entries]
    limits = Agreement(
        float(np.finfo(f"f{itemsize}").eps),
        _RTOL[itemsize] if rtol is None else rtol,
        _RTOL_MODES[itemsize],
        max([atol, abs(float(value)), *(s for s in slopes if np.isfinite(s))]),
    )
    numbers = {}
    for name, x in entries.items():
        sample = functools.partial(evaluate, name)
        evaluations = probe(sample, sample(x), scale[name], itemsize)
        numbers[name] = _judge(name, evaluations, forward[name], reverse[name], scale[name], limits)
    warnings = [warning for number in numbers.values() for warning in number.warnings]
    if adjoints and any(number.verdict == "disagree" for number in numbers.values()):
        warnings.append(
            f"The steps of a run with adjoint={' or '.join(adjoints)} control the error of the motion alone, which can"
            " leave derivatives wrong. Omit adjoint: by default the steps control the error of the derivatives too."
        )
    if not recorded:
        warnings.append(
            "Modes of runs inside jax.jit or jax.vmap are not recorded: mode changes and grazing go unseen."
        )
    return GradientCheck(float(value), f"float{8 * itemsize}", numbers, tuple(warnings))


def _entries(scene: object, names: Sequence[str] | None, scales: Mapping[str, float]) -> dict[str, float]:
    """The numbers to check, by name."""
    if not isinstance(scene, Scene):
        raise ValueError(f"check_gradients needs a Scene, but a {type(scene).__name__} was given.")
    numbers = {name: read_element(scene, name) for name in elements(scene)}
    if not numbers:
        raise ValueError("The scene holds no numbers to differentiate by: give it params or effects.")
    wanted = list(numbers) if names is None else [names] if isinstance(names, str) else list(names)
    for name in (*wanted, *scales):
        if name not in numbers:
            raise ValueError(f"The scene has no number {name!r}; there are: {', '.join(numbers)}.")
    if not wanted:
        raise ValueError("names is empty: name at least one number, or leave it out to check all.")
    for name, scale in scales.items():
        if not (np.isfinite(scale) and scale > 0):
            raise ValueError(f"scales[{name!r}] must be a positive number, but it is {scale!r}.")
    return {name: numbers[name] for name in wanted}


def _recording(runs: list[Trajectory]) -> Callable[..., Trajectory]:
    """`simulate`, with all runs appended to `runs`."""

    @functools.wraps(simulate)
    def run(*args: Any, **options: Any) -> Trajectory:
        runs.append(simulate(*args, **options))
        return runs[-1]

    return run


def _first(fn: Callable[..., Any], scene: Scene, runs: list[Trajectory]) -> tuple[Array, bool, float, tuple[str, ...]]:
    """The value at the scene, whether its runs are recorded, their atol, and the diffrax adjoints that they use.

    **Raises:**

    - `ValueError` for a function that cannot be checked.
    """
    if not callable(fn):
        raise ValueError(f"{_INTERFACE} A {type(fn).__name__} was given.")
    try:
        inspect.signature(fn).bind(scene, simulate)
    except TypeError as error:
        raise ValueError(f"{_INTERFACE} This function does not take these two arguments: {error}.") from error
    value = fn(scene, _recording(runs))
    shape, dtype = getattr(value, "shape", None), getattr(value, "dtype", None)
    if dtype is None or shape != () or not jnp.issubdtype(dtype, jnp.floating):
        given = f"an array of shape {shape} and type {dtype}" if dtype is not None else f"{value!r}"
        raise ValueError(f"fn must return one real number (a JAX scalar), but it returned {given}.")
    if not runs:
        raise ValueError(f"{_INTERFACE} This function did not call it.")
    if not np.isfinite(value):
        raise ValueError(f"fn must return a finite number, but it returned {value} at this scene.")
    recorded = [run for run in runs if is_known(*jtu.tree_leaves(run))]
    atol = max((float(run.request.atol) for run in recorded), default=0.0)
    complete = len(recorded) == len(runs)
    adjoints = [run.request.adjoint.rest for run in runs if run.request.adjoint is not None]
    others = {type(each).__name__ for each in adjoints if not isinstance(each, StoredSteps)}
    runs.clear()
    return jnp.asarray(value), complete, atol, tuple(sorted(others))


def _forward(fn: Callable[..., object], scene: Scene, name: str) -> float:
    """Derivative in forward mode."""
    zero = jtu.tree_map(jnp.zeros_like, scene)
    try:
        tangent = jax.jvp(lambda s: fn(s, simulate), (scene,), (replace_elements(zero, {name: 1.0}),))[1]
    except TypeError as error:
        if "custom_vjp" not in str(error):
            raise
        raise ValueError("fn has no derivative in forward mode: part of it has a jax.custom_vjp rule only.") from error
    return float(tangent)


def _evaluate(
    fn: Callable[..., Any],
    scene: Scene,
    runs: list[Trajectory],
    simulate: Callable[..., Trajectory],
    name: str,
    x: float,
) -> Sample:
    """Evaluate the function with one number of the scene replaced."""
    changed_scene = replace_elements(scene, {name: x})
    x = read_element(changed_scene, name)  # as rounded to its type
    runs.clear()
    try:
        value = float(fn(changed_scene, simulate))
    except (RuntimeError, ValueError) as error:
        return Sample(x, float("nan"), {}, str(error).strip().splitlines()[0].split(" The run stopped at")[0])
    histories: Histories = {}
    for i, run in enumerate(r for r in runs if is_known(*jtu.tree_leaves(r))):
        histories.update({(i, effect): history for effect, history in _histories(run).items()})
    return Sample(x, value, histories, "" if np.isfinite(value) else f"fn returns {value}.")


def _histories(run: Trajectory) -> dict[str, History]:
    """Mode changes by effect."""
    events = jtu.tree_map(np.asarray, run.events)
    histories = {}
    for i, effect in enumerate(run.scene.part_names):
        mine = (events.effect == i) & np.isfinite(events.t)
        if mine.any():
            pairs = zip(events.before[mine].tolist(), events.after[mine].tolist(), strict=True)
            histories[effect] = History(float(run.request.t0), events.t[mine].astype(float), tuple(pairs))
    return histories


def _judge(
    name: str, evaluations: Probe, forward: float, reverse: float, scale: float, limits: Agreement
) -> NumberCheck:
    """The verdict on one number, with its warnings."""
    center, guess = evaluations.center, estimate(evaluations, limits.eps)
    shown = guess or DerivativeEstimate(float("nan"), float("nan"), float("nan"), "")
    number = functools.partial(NumberCheck, name, center.x, forward, reverse, shown.value, shown.error, shown.step)
    sides = [(side, usable(center, side)) for side in (evaluations.below, evaluations.above)]
    ends = tuple(_end_warning(name, center, side[first - 1]) for side, first in sides if first)
    if any(len(side) - 2 < first and not side[first - 1].trouble for side, first in sides):
        warning = (
            f"{name}: not differentiable here, as far as the steps can resolve: the modes change next to this value,"
            " and a gradient is valid on one side at most. Move away from this value before you use a gradient."
        )
        return number("modes change", (*ends, warning))
    if guess is None:
        warning = f"{name}: too few runs near this value succeed. Pass smaller steps by scales={{{name!r}: ...}}."
        return number("no differences", (*ends, warning))
    if guess.sides != "both":
        ends = (*ends, f"{name}: the differences are from {guess.sides} only.")
    least = limits.rtol * limits.size / scale
    corner = kink(evaluations)
    if corner is not None and abs(corner[1] - corner[0]) > max(limits.rtol * max(map(abs, corner)), least):
        warning = (
            f"{name}: not differentiable here: the slope is {corner[0]:.7g} from below and {corner[1]:.7g} from above,"
            " with the same modes. Look for abs, maximum, sign or where at a corner, or move away from this value."
        )
        return number("kink", (warning, *ends))
    near = grazing(evaluations, scale)
    touch = () if near is None else (_grazing_warning(name, center.x, near),)
    disagreements = _disagreement_warnings(name, forward, reverse, guess, limits, scale)
    size = max(abs(forward), abs(reverse), abs(guess.value))
    unclear = 3 * guess.error > max(_UNCLEAR * size, least)
    if near is not None and (disagreements or unclear):
        return number("grazing", (*touch, *disagreements, *ends))
    if disagreements:
        return number("disagree", (*disagreements, *ends))
    if unclear:
        warning = (
            f"{name}: the differences have an error of {guess.error:.1g} and are inconclusive. Tighten rtol and atol of"
            f" simulate, or pass other steps by scales={{{name!r}: ...}}."
        )
        return number("unclear", (warning, *ends))
    return number("agree", (*touch, *ends))


def _end_warning(name: str, center: Sample, beside: Sample) -> str:
    """Why the differences end at the evaluation `beside`: it fails, or its modes are others."""
    place = f"{name}: at {beside.x:.7g}, {_percent(beside.x - center.x, center.x)} from here,"
    if beside.trouble:
        return f"{place} the run fails: {beside.trouble}"
    key = changed(center.histories, beside.histories)
    assert key is not None
    here, there = (sample.histories.get(key) for sample in (center, beside))
    k = first_difference(here, there) if here and there else 0
    text = f"{place} the sequence of modes differs: change {k + 1} of {key[1]!r}{_run(key[0])}"
    old, new = _change(here, k), _change(there, k)
    if new is None:
        return f"{text}, {old} here, does not happen there."
    if old is None:
        return f"{text}, {new}, happens there only."
    return f"{text} is {new} in place of {old}."


def _grazing_warning(name: str, x: float, near: Grazing) -> str:
    return (
        f"{name}: grazing suspected: the time of the event of {near.effect!r} at t = {near.t:.6g}{_run(near.run)}"
        f" follows a square root that ends near {name} = {near.vanishes:.6g}, {_percent(near.vanishes - x, x)} from"
        " here, with infinite derivatives. A gradient is valid within a small part of that distance."
    )


def _disagreement_warnings(
    name: str, forward: float, reverse: float, guess: DerivativeEstimate, limits: Agreement, scale: float
) -> tuple[str, ...]:
    """How the three derivatives disagree; empty if they agree."""
    derivatives = {"forward mode": forward, "reverse mode": reverse}
    bad = [mode for mode, value in derivatives.items() if not math.isfinite(value)]
    if bad:
        return (
            f"{name}: the derivative by {' and '.join(bad)} is not finite, but the differences give {guess.value:.7g}."
            " Look for a square root, norm or power at zero, and for where() around a division by zero.",
        )
    texts = []
    size, least = max(abs(forward), abs(reverse)), limits.size / scale
    if abs(forward - reverse) > limits.rtol_modes * (size + least):
        texts.append(
            f"{name}: forward and reverse mode disagree by {_percent(forward - reverse, size)}: {forward:.7g} and"
            f" {reverse:.7g}. Look for a custom_vjp or custom_jvp in the functions that fn calls."
        )
    wrong = {
        mode: value
        for mode, value in derivatives.items()
        if abs(value - guess.value)
        > limits.rtol * (max(abs(value), abs(guess.value)) + _TINY * least) + 3 * guess.error
    }
    if wrong:
        value = max(wrong.values(), key=lambda v: abs(v - guess.value))
        who = "both modes give" if len(wrong) == 2 else f"{next(iter(wrong))} gives"
        why = (
            "The number is cut off from the result: look for stop_gradient, float() or numpy in fn and in the scene."
            if value == 0
            else "Look for stop_gradient, custom_jvp or custom_vjp, and for loose tolerances or a large dt of simulate."
        )
        texts.append(
            f"{name}: {who} {value:.7g}, but the differences give {guess.value:.7g} (+- {guess.error:.1g}), an error"
            f" of {_percent(value - guess.value, guess.value)}. {why}"
        )
    return tuple(texts)


def _change(history: History | None, k: int) -> str | None:
    if history is None or k >= len(history.changes):
        return None
    before, after = history.changes[k]
    return f"{_MODES[before]} to {_MODES[after]} at t = {history.t[k]:.6g}"


def _run(index: int) -> str:
    return f" in run {index + 1}" if index else ""


def _percent(change: float, of: float) -> str:
    return f"{100 * abs(change / of):.2g} %" if of else f"{abs(change):.2g}"
