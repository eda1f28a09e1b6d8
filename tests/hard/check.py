"""Checks of hard cases under every transform, in both floating types."""

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxmodsim.analysis import check_gradients
from jaxmodsim.scene import Scene
from jaxmodsim.simulation import SimulationError, Trajectory, outcome_messages

from .case import Answer, FunctionTask, HardCase, MeasuredNumber, RefusedCalls, SceneTask, differentiate

# Ways in which a hard case is run.
TRANSFORMS = ("alone", "jit", "vmap", "forward", "reverse", "energy")
DTYPES = ("float64", "float32")

# Derivatives may be this much less accurate than values.
_SLOPE = 10.0
# The energy balance closes to this many times the tolerance of the answer, relative to the energies there are.
_BALANCE = 10.0
# Energies [J] below this are none.
_NO_ENERGY = 1e-15
# Relative step of finite differences of answers, whose error is 1e-9 or so.
_STEP = 1e-3


@dataclass(frozen=True)
class CheckFinding:
    """The result of a case under one transform.

    - `transform`, `dtype`: of `TRANSFORMS` and `DTYPES`.
    - `error`: relative to what is asked, so that 1 is the limit; NaN where there is no number to compare.
    - `ok`: whether it is as it should be.
    - `sentence`: what was found.
    """

    transform: str
    dtype: str
    error: float
    ok: bool
    sentence: str


@dataclass(frozen=True)
class CaseReport:
    """What was found on a case.

    - `case`: the `HardCase`.
    - `findings`: in the order of the types, and of the transforms in each.
    """

    case: HardCase
    findings: tuple[CheckFinding, ...]

    @property
    def ok(self) -> bool:
        """Whether every transform is as it should be."""
        return all(finding.ok for finding in self.findings)

    def worst(self, dtype: str) -> float:
        """Largest error, 1 being the limit; NaN where there is none."""
        errors = [each.error for each in self.findings if each.dtype == dtype]
        return max((error for error in errors if not math.isnan(error)), default=math.nan)


def check(case: HardCase, transforms: Sequence[str] = TRANSFORMS, dtypes: Sequence[str] = DTYPES) -> CaseReport:
    """Run a hard case and compare it with what is right.

    - `alone`, `jit`, `vmap`: the answer, or the sentence with which the run ends. Under `vmap` one of three runs gets
      NaN for its number: it must say that it failed, and the others be right.
    - `forward`, `reverse`: the derivative by the number of the case; where there is none, it must be finite, and
      `check_gradients` must not approve it (checked with `reverse`).
    - `energy`: the energy balance of the run, in float64.

    **Arguments:**

    - `case`: the `HardCase`.
    - `transforms`: which of `TRANSFORMS`.
    - `dtypes`: which of `DTYPES`; what a case leaves out is left out.

    **Returns:**

    A `CaseReport`.

    **Raises:**

    - `ValueError` for transforms or types that are none, and without double precision, which float64 needs.
    """
    check_choice(transforms, dtypes)
    if isinstance(case.task, RefusedCalls):
        return CaseReport(case, tuple(_refusals(case.task)))
    if isinstance(case.task, MeasuredNumber):
        return CaseReport(case, (_measured(case, case.task),))
    findings = []
    for dtype in dtypes:
        if dtype == "float32" and case.single is None:
            continue
        trial = _Trial(case, case.task.cast(dtype), dtype)
        findings += [trial.look(transform) for transform in transforms if trial.applies(transform)]
    return CaseReport(case, tuple(findings))


def check_choice(transforms: Sequence[str], dtypes: Sequence[str]) -> None:
    """Refuse transforms and types that are none, and single precision.

    **Raises:**

    - `ValueError` that names what there is.
    """
    for name, given, known in (("transforms", transforms, TRANSFORMS), ("dtypes", dtypes, DTYPES)):
        if unknown := [each for each in given if each not in known]:
            raise ValueError(f"{name} must be of {', '.join(known)}, but {unknown[0]!r} was given.")
    if jnp.result_type(float) != jnp.float64:
        raise ValueError('Hard cases need double precision: jax.config.update("jax_enable_x64", True).')


def _refusals(task: RefusedCalls) -> list[CheckFinding]:
    findings = []
    for name, call in task.calls.items():
        try:
            call()
            ok, text = False, "nothing was raised"
        except (ValueError, SimulationError, eqx.EquinoxRuntimeError) as error:
            ok, text = re.search(task.match[name], str(error)) is not None, str(error)
        findings.append(CheckFinding("alone", "float64", math.nan, ok, f"{name}: {text}"))
    return findings


def _measured(case: HardCase, task: MeasuredNumber) -> CheckFinding:
    assert case.exact is not None
    value, right = task.fn(), case.exact(0.0)
    error = abs(value - right) / (case.scale or abs(right)) / case.tolerance
    return CheckFinding("alone", "float64", error, error <= 1.0, f"{value:.9g}, right is {right:.9g}.")


# Compiled once for all cases of one structure.
@eqx.filter_jit
def _jit(task: SceneTask | FunctionTask, x: Array) -> Answer:
    return task.answer(x)


@eqx.filter_jit
def _vmap(task: SceneTask | FunctionTask, x: Array) -> Answer:
    return jax.vmap(task.answer)(x)


@eqx.filter_jit
def _forward(task: SceneTask | FunctionTask, x: Array) -> tuple[Answer, Array]:
    def value(x: Array) -> tuple[Array, Answer]:
        answer = task.answer(x)
        return answer.value, answer

    _, slope, answer = jax.jvp(value, (x,), (jnp.ones_like(x),), has_aux=True)
    return answer, slope


@eqx.filter_jit
def _reverse(task: SceneTask | FunctionTask, x: Array) -> tuple[Answer, Array]:
    def value(x: Array) -> tuple[Array, Answer]:
        answer = task.answer(x)
        return answer.value, answer

    (_, answer), slope = jax.value_and_grad(value, has_aux=True)(x)
    return answer, slope


@dataclass(frozen=True)
class _Trial:
    """A case in one floating type."""

    case: HardCase
    task: SceneTask | FunctionTask
    dtype: str

    @property
    def x(self) -> Array:
        return jnp.asarray(self.task.x, self.dtype)

    def gives_up(self, answer: Answer) -> bool:
        """Whether the run ends with the sentence that it may end with in float32."""
        may = self.case.single_ends if self.dtype == "float32" else ""
        return bool(may) and int(answer.code) != 0 and re.search(may, self.messages[int(answer.code)]) is not None

    @cached_property
    def right(self) -> float | None:
        """The answer; None where the run ends early and says so, which is all that is asked."""
        case = self.case
        if case.exact is not None:
            return float(case.exact(float(self.x)))
        return None if case.second is None else case.second()

    @property
    def scale(self) -> float:
        return self.case.scale if self.case.scale is not None else abs(self.right or 0.0) or 1.0

    @property
    def tolerance(self) -> float:
        single = self.case.single
        return self.case.tolerance if self.dtype == "float64" or single is None else single

    def applies(self, transform: str) -> bool:
        if transform in self.case.skips or f"{transform} {self.dtype}" in self.case.skips:
            return False
        if transform == "energy":
            runs = isinstance(self.task, SceneTask) and not self.case.ends and self.case.conserves
            return runs and self.dtype == "float64"
        return transform not in ("forward", "reverse") or not (self.case.ends and self.right is None)

    def look(self, transform: str) -> CheckFinding:
        """One transform."""
        if transform == "energy":
            return self.energy()
        if transform in ("forward", "reverse"):
            return self.derivative(transform)
        if transform == "vmap":
            return self.batch()
        return self.finding(transform, self.task.answer(self.x) if transform == "alone" else _jit(self.task, self.x))

    def finding(self, transform: str, answer: Answer) -> CheckFinding:
        """An answer, compared."""
        code, value = int(answer.code), float(answer.value)
        sentence, ends = self.messages[code], self.case.ends
        if self.gives_up(answer):
            return CheckFinding(transform, self.dtype, math.nan, True, sentence)
        ended = re.search(ends, sentence) is not None if ends else code == 0
        if self.right is None:
            return CheckFinding(transform, self.dtype, math.nan, ended and code != 0, sentence)
        error = abs(value - self.right) / self.scale / self.tolerance
        right = math.isfinite(value) and error <= 1.0
        return CheckFinding(
            transform, self.dtype, error, ended and right, f"{value:.12g}, right is {self.right:.12g}. {sentence}"
        )

    def batch(self) -> CheckFinding:
        """Three runs under `vmap`, of which the second gets NaN."""
        numbers = jnp.stack([self.x, jnp.full_like(self.x, jnp.nan), self.x])
        answers = _vmap(self.task, numbers)
        first, sick, last = (Answer(answers.code[i], answers.value[i]) for i in range(3))
        finding, other = (self.finding("vmap", each) for each in (first, last))
        if isinstance(self.task, SceneTask) and int(sick.code) == 0:
            return CheckFinding(
                "vmap", self.dtype, finding.error, False, "A run whose number is NaN says that all is well."
            )
        # Rounding may differ between the entries of the processor's vectors: the two differ then, but both are right.
        return finding if other.ok else other

    def derivative(self, transform: str) -> CheckFinding:
        """A derivative, compared."""
        answer, slope = (_forward if transform == "forward" else _reverse)(self.task, self.x)
        finding, slope = self.finding(transform, answer), float(slope)
        if not finding.ok or self.gives_up(answer):
            return finding
        if not math.isfinite(slope):
            return CheckFinding(transform, self.dtype, math.inf, False, f"The derivative is {slope}.")
        if self.case.undefined:
            return self.flagged(transform, slope)
        right = self.slope()
        size = max(abs(right), self.scale / (abs(self.task.x) or 1.0))
        error = abs(slope - right) / size / (_SLOPE * self.tolerance)
        return CheckFinding(transform, self.dtype, error, error <= 1.0, f"{slope:.9g}, right is {right:.9g}.")

    def slope(self) -> float:
        """The right derivative: of the closed form, or by finite differences of answers in double precision."""
        if self.case.slope is not None:
            return self.case.slope(float(self.x))
        if self.case.exact is not None:
            return differentiate(self.case.exact, float(self.x))
        task = self.case.task
        assert isinstance(task, SceneTask | FunctionTask)
        return differentiate(lambda x: float(_jit(task, jnp.asarray(x, float)).value), task.x, _STEP)

    def flagged(self, transform: str, slope: float) -> CheckFinding:
        """Where there is no derivative: that of the modes as they are, and a warning."""
        if transform == "forward" or not isinstance(self.task, SceneTask):
            return CheckFinding(
                transform, self.dtype, math.nan, True, f"{slope:.9g}, and there is none: {self.case.undefined}"
            )
        verdict = _watched(self.task)
        sentence = f"check_gradients says: {verdict}"
        return CheckFinding(transform, self.dtype, math.nan, verdict != "agree", sentence)

    def energy(self) -> CheckFinding:
        """The energy balance at the end, relative to the largest energy there is."""
        assert isinstance(self.task, SceneTask)
        book = self.task.run(self.x).energy
        parts = (book.kinetic, book.potential, book.stored, book.work_in, book.dissipated)
        # Without any energy there is nothing to lose.
        size = max(float(jnp.max(jnp.abs(part))) for part in parts)
        size = size if size > _NO_ENERGY else 1.0
        error = float(jnp.max(jnp.abs(book.balance))) / size / (_BALANCE * self.tolerance)
        return CheckFinding(
            "energy", self.dtype, error, error <= 1.0, f"{error * _BALANCE * self.tolerance:.2g} of {size:.3g} J"
        )

    @property
    def messages(self) -> tuple[str, ...]:
        if isinstance(self.task, SceneTask):
            return outcome_messages(self.task.scene, self.task.q0.shape[0])
        return ("The run reached t1.", "The run ended early.")


def _watched(task: SceneTask) -> str:
    """The verdict of `check_gradients` on the number of a case."""

    def fn(scene: Scene, simulate: Callable[..., Trajectory]) -> Array:
        run = simulate(scene, task.q0, task.qd0, task.t1, **task.numbers, **dict(task.choices))
        return task.read(run)

    return check_gradients(fn, task.scene, names=[task.by]).numbers[task.by].verdict
