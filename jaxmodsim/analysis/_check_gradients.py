"""`check_gradients`: forward mode, reverse mode and finite differences side by side."""

import functools
import inspect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import jax
import jax.core
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, PyTree

from ..scene import Scene, elements, read_element, replace_elements
from ..simulation import Trajectory, simulate
from ..solvers import StoredSteps
from . import _words as words
from ._differences import (
    Agreement,
    DerivativeEstimate,
    Histories,
    History,
    Probe,
    Sample,
    estimate,
    grazing,
    kink,
    probe,
    usable,
)

Verdict = Literal["agree", "part", "modes change", "grazing", "kink", "unclear", "no differences"]

# Admissible relative differences, by bytes of the type: between derivatives and differences, between the two modes.
_RTOL = {8: 1e-3, 4: 1e-2}
_RTOL_MODES = {8: 1e-6, 4: 1e-3}
# Differences with an estimated error above this part of the derivative say nothing.
_UNCLEAR = 0.1
# Adjoints whose steps keep the tolerance for derivatives; None stands for the default.
_INTERFACE = (
    "check_gradients needs a function fn(scene, simulate) that returns one number and runs the scene with the"
    " `simulate` it is given, as in: def fn(scene, simulate=jaxmodsim.simulate): return simulate(scene, [1.0], [0.0],"
    " 5.0).q[-1, 0]."
)


@dataclass(frozen=True)
class NumberCheck:
    """The derivative of a function by one number of a scene, three times.

    - `name`, `value`: of the number.
    - `forward`, `reverse`: the derivative by `jax.jvp` and by `jax.grad`.
    - `differences`, `error`, `step`: the derivative by finite differences, its estimated error, and the smaller one
      of the two steps it was extrapolated from; NaN where there is none.
    - `verdict`: `agree`; `part`; `modes change`, `grazing` or `kink` (not differentiable here, see
      `check_gradients`); `unclear` (the differences are too noisy to tell); `no differences` (the runs next to this one
      fail).
    - `remarks`: what it means and what to do, in sentences.
    """

    name: str
    value: float
    forward: float
    reverse: float
    differences: float
    error: float
    step: float
    verdict: Verdict
    remarks: tuple[str, ...]


@dataclass(frozen=True)
class GradientCheck:
    """What `check_gradients` found; print it.

    - `value`: of the function.
    - `dtype`: floating type that it was computed in.
    - `numbers`: a `NumberCheck` for each number, by name.
    - `remarks`: in sentences, of all numbers and of the check as a whole.
    - `ok`: whether all derivatives agree with each other and with the differences. Remarks may still say how far
      from here that ends.
    """

    value: float
    dtype: str
    numbers: dict[str, NumberCheck]
    remarks: tuple[str, ...]

    @property
    def ok(self) -> bool:
        """Whether the verdict on every number is `agree`."""
        return all(number.verdict == "agree" for number in self.numbers.values())

    def __str__(self) -> str:
        """A table of the numbers, and the remarks."""
        width = max(len(name) for name in self.numbers)
        heads = f"{'value':>11}  {'forward':>13}  {'reverse':>13}  {'differences':>13}  {'+-':>8}  {'step':>8}"
        lines = [f"fn = {self.value:.9g} ({self.dtype})", f"{'':{width}}  {heads}  verdict"]
        for n in self.numbers.values():
            values = f"{n.value:11.5g}  {n.forward:13.7g}  {n.reverse:13.7g}  {n.differences:13.7g}"
            lines.append(f"{n.name:{width}}  {values}  {n.error:8.1g}  {n.step:8.2g}  {n.verdict}")
        return "\n".join([*lines, *(f"- {remark}" for remark in self.remarks)])


def check_gradients(
    fn: Callable[..., object],
    scene: Scene,
    *,
    names: Sequence[str] | None = None,
    scales: Mapping[str, float] | None = None,
    rtol: float | None = None,
) -> GradientCheck:
    """Compare forward-mode, reverse-mode and finite-difference derivatives of a function of a scene.

    ```python
    def end(scene, simulate=jaxmodsim.simulate):
        return simulate(scene, [1.0], [0.0], 5.0).q[-1, 0]

    print(jaxmodsim.check_gradients(end, scene))
    jax.grad(end)(scene)
    ```

    The function gets the `simulate` to use as its second argument, so that the modes of the runs are watched. Give it
    `jaxmodsim.simulate` as a default, and it serves `jax.grad` as it is. It may run several scenes, also others made of
    this one; initial values and times are checked if it takes them from `scene.params`. Do not put it inside `jax.jit`:
    `simulate` compiles by itself.

    **Differences.** Each number is changed by +-1 % of itself and by a fourth of that four times (float32: 4 %, three
    times), each run anew. Of these steps those count from which on, down to the smallest, no run has failed and all
    have the same modes as the run in the middle. Two successive steps are extrapolated (Richardson); the pair with the
    smallest estimated error is reported, with the smaller one of its steps. The error is what the smaller step would
    have changed by, plus the noise of the runs, as seen at the smallest steps, over the step. If runs fail on one
    side (out of range), the differences are one-sided.

    **Not differentiable here.**

    - `modes change`: the mode changes of an effect (before, after, of each effect in order) are others at
      one of the two smallest steps. Where this happens further away, within the largest step, the derivative is
      right, and a remark says how near that is. An event that just fails to happen, such as a load that almost
      reaches the limit of stick, is seen in this way and no other: if it happens within the largest step.
      Effects whose changes only swap their order count as unchanged.
    - `grazing`: derivatives and differences part or are unclear, and the time of an event goes as a square root that
      ends within 5 % of the number, as that of an event whose guard crosses zero at a vanishing rate. If they agree
      there is a remark only. An event that is far from grazing in each number alone, but close to it in a combination
      of them, is not seen.
    - `kink`: the modes are the same, but the slopes from below and above differ at the three smallest steps, as
      from `abs` or `maximum` at their corner.

    **Arguments:**

    - `fn`: `fn(scene, simulate)` -> a real scalar.
    - `scene`: the `Scene` at which to check.
    - `names`: of the numbers to check, as in `jaxmodsim.scene.scene_numbers`, with `[i]` behind for one entry of an
      array; by default all.
    - `scales`: by name, what the steps are relative to, > 0; by default the number's absolute value, and 1 if it is 0.
    - `rtol`: admissible relative deviation from the differences, beside three times their estimated error; by
      default 1e-3, in float32 1e-2. Forward and reverse mode must agree to 1e-6, in float32 to 1e-3. What is tiny
      beside the function, its other derivatives and the `atol` of its runs counts as zero.

    **Returns:**

    A `GradientCheck`: `.ok`, `.numbers[name]`, `.remarks`, and a table when printed.

    **Raises:**

    - `ValueError` if `fn` does not take `simulate`, does not use it, or gives no finite real scalar; if the scene has
      no numbers, or not those that were named.
    - `SimulationError` if the run at `scene` itself ends early.
    """
    entries = _entries(scene, names, scales or {})
    runs: list[Trajectory] = []
    evaluate = functools.partial(_evaluate, fn, scene, runs, _recording(runs))
    value, watched, noise, adjoints = _first(fn, scene, runs)
    itemsize = min(x.dtype.itemsize for x in (value, *jtu.tree_leaves(scene)))
    if itemsize not in _RTOL:
        raise ValueError(f"check_gradients works in float32 and float64, but the scene holds {value.dtype}.")
    gradient = jax.grad(fn)(scene, simulate)
    forward = {name: _forward(fn, scene, name) for name in entries}
    reverse = {name: read_element(gradient, name) for name in entries}
    scale = {name: (scales or {}).get(name, abs(x) or 1.0) for name, x in entries.items()}
    slopes = [abs(d[name]) * scale[name] for d in (forward, reverse) for name in entries]
    limits = Agreement(
        itemsize,
        float(np.finfo(f"f{itemsize}").eps),
        _RTOL[itemsize] if rtol is None else rtol,
        _RTOL_MODES[itemsize],
        max([noise, abs(float(value)), *(s for s in slopes if np.isfinite(s))]),
    )
    numbers = {}
    for name, x in entries.items():
        sample = functools.partial(evaluate, name)
        evaluations = probe(sample, sample(x), scale[name], itemsize)
        numbers[name] = _judge(name, evaluations, forward[name], reverse[name], scale[name], limits)
    remarks = [remark for number in numbers.values() for remark in number.remarks]
    if adjoints and any(number.verdict == "part" for number in numbers.values()):
        remarks.append(words.adjoint(adjoints))
    if not watched:
        remarks.append(
            "Runs inside jax.jit or jax.vmap cannot be watched: changes of modes and grazing go unseen there."
        )
    return GradientCheck(float(value), f"float{8 * itemsize}", numbers, tuple(remarks))


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
            raise ValueError(f"The scene has no number {name!r}; it has: {', '.join(numbers)}.")
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
    """The value at the scene, whether its runs can be watched, their atol, and the adjoints that diffrax has for them.

    What cannot be checked is refused.
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
        raise ValueError(f"fn gives {value} at this scene, which has no derivative.")
    watched = [run for run in runs if not _traced(run)]
    atol = max((float(run.request.atol) for run in watched), default=0.0)
    complete = len(watched) == len(runs)
    adjoints = [run.request.adjoint.rest for run in runs if run.request.adjoint is not None]
    others = {type(each).__name__ for each in adjoints if not isinstance(each, StoredSteps)}
    runs.clear()
    return jnp.asarray(value), complete, atol, tuple(sorted(others))


def _traced(tree: PyTree) -> bool:
    return any(isinstance(x, jax.core.Tracer) for x in jtu.tree_leaves(tree))


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
    """The function with one number replaced."""
    changed_scene = replace_elements(scene, {name: x})
    x = read_element(changed_scene, name)  # as rounded to its type
    runs.clear()
    try:
        value = float(fn(changed_scene, simulate))
    except (RuntimeError, ValueError) as error:
        return Sample(x, float("nan"), {}, str(error).strip().splitlines()[0].split(" The run stopped at")[0])
    histories: Histories = {}
    for i, run in enumerate(r for r in runs if not _traced(r)):
        histories.update({(i, effect): history for effect, history in _histories(run).items()})
    return Sample(x, value, histories, "" if np.isfinite(value) else f"fn gives {value}.")


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
    """The verdict on one number, and the sentences that go with it."""
    center, guess = evaluations.center, estimate(evaluations, limits.eps)
    shown = guess or DerivativeEstimate(float("nan"), float("nan"), float("nan"), "")
    number = functools.partial(NumberCheck, name, center.x, forward, reverse, shown.value, shown.error, shown.step)
    sides = [(side, usable(center, side)) for side in (evaluations.below, evaluations.above)]
    ends = tuple(words.end(name, center, side[first - 1]) for side, first in sides if first)
    if any(len(side) - 2 < first and not side[first - 1].trouble for side, first in sides):
        return number("modes change", (*ends, words.modes_change(name)))
    if guess is None:
        return number("no differences", (*ends, words.no_differences(name)))
    if guess.sides != "both":
        ends = (*ends, words.one_sided(name, guess))
    least = limits.rtol * limits.size / scale
    corner = kink(evaluations)
    if corner is not None and abs(corner[1] - corner[0]) > max(limits.rtol * max(map(abs, corner)), least):
        return number("kink", (words.kink(name, corner), *ends))
    near = grazing(evaluations, scale)
    touch = () if near is None else (words.grazing(name, center.x, near),)
    part = words.parting(name, forward, reverse, guess, limits, scale)
    size = max(abs(forward), abs(reverse), abs(guess.value))
    unclear = 3 * guess.error > max(_UNCLEAR * size, least)
    if near is not None and (part or unclear):
        return number("grazing", (*touch, *part, *ends))
    if part:
        return number("part", (*part, *ends))
    if unclear:
        return number("unclear", (words.unclear(name, guess), *ends))
    return number("agree", (*touch, *ends))
