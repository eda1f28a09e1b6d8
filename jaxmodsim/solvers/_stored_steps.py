"""Forward and reverse mode over the accepted steps of a run."""

from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax.core import ShapedArray
from jaxtyping import Array, PyTree

from .._core.arrays import Fn
from .._core.compat import AVAILABLE, Primitive, UndefinedPrimal, diffrax_loop, eqxi, lax_loop
from ._controllers import FiniteSteps
from ._error_checks import without_single_roundings
from ._over_steps import (
    ForwardOverSteps,
    RecordedRun,
    ReverseOverSteps,
    RunTangents,
    StepInputs,
    StepPlan,
    StepRecord,
    empty_buffers,
    is_none,
    is_save_state,
)
from ._probe import ProbedController, ProbedStep, direction, has_error_control, start, without_probe

_TWICE = "StoredSteps does not differentiate a derivative in reverse mode: take jax.hessian, or jax.jacfwd of jax.grad."


class StoredSteps(dfx.AbstractAdjoint):
    """Derivatives of the accepted steps, each differentiated once, in the order of time or in the reverse order.

    The run stores the state at the start of every accepted step. Forward mode (`jax.jvp`, `jax.jacfwd`) applies
    `jax.jvp` to these steps, reverse mode (`jax.grad`, `jax.jacrev`) applies `jax.vjp` to them in reverse order.
    `jax.hessian` and other derivatives forward over reverse, or forward over forward, work likewise. The derivative is
    that of the run, to rounding, at any tolerance: no step is repeated with other rounding, which events and error
    control would amplify. Times of steps, and thus the step size controller, count as constants. Constant steps, by
    which diffrax divides a run evenly, move with its ends. Rejected steps cost nothing.

    Derivatives hold for the initial state, for everything in `args`, terms and solver, for `t0`, `t1`, the times in
    `SaveAt(ts=...)`, and for the numbers that their functions close over. A run that ends early gives the derivative of
    the integrated part.

    Memory, only for derivatives: `max_steps / every` times the size of the state and of the solver's state, `every`
    times the same in reverse mode, and two times for each of `max_steps`.

    **Arguments:**

    - `every`: 1 to store the state of every step, n of every n-th; the others are repeated at their recorded times.
    - `probe`: whether the error of a derivative limits the steps, too, if a `diffrax.PIDController` chooses them. A
      differentiated run then carries its tangent in one random direction of the differentiated numbers, each changed
      by its magnitude. The error estimate of this tangent enters the norm of the step size control, relative to the
      largest values of its components so far. Without it steps grow without limit at rest, and the derivatives of such
      a run are wrong. The differentiated run makes other steps than the plain run; both keep the tolerance.
    - `brief`: whether this error is relative to a mean of each component over the time so far instead. Stiff forces
      that act briefly, such as those of a contact, need that: derivatives are large in the contact and nearly cancel
      behind it. It takes up to three times the steps. `simulate` asks for it where a scene has `HuntCrossley` contacts.

    **Raises:**

    - `ValueError` for `every` below 1, `max_steps=None`, and diffrax's own terminating `event`.
    - `RuntimeError` for reverse mode of a derivative.

    **Example:**

    ```python
    def end(scene):
        return jms.simulate(scene, [1.0], [0.0], 2.0, adjoint=jms.StoredSteps(every=4)).q[-1, 0]

    slope = jax.grad(end)(jms.problems.braked_spring.scene())
    print(f"{slope.params['k']:.5f} m/(N/m)")
    ```

    ```text
    -0.13685 m/(N/m)
    ```

    ??? cite "Reference"

        Tangents in the error norm:

        ```bibtex
        @article{eberhard1999automatic,
            author={Eberhard, Peter and Bischof, Christian},
            title={Automatic differentiation of numerical integration algorithms},
            journal={Mathematics of Computation}, volume={68}, number={226}, pages={717--731}, year={1999},
        }
        ```
    """

    every: int = eqx.field(static=True, default=1)
    probe: bool = eqx.field(static=True, default=True)
    brief: bool = eqx.field(static=True, default=False)

    def __check_init__(self) -> None:
        if self.every < 1:
            raise ValueError(f"every must be at least 1, but every={self.every}: it is a number of steps.")

    def loop(
        self, *, solver: dfx.AbstractSolver, event: dfx.Event | None, max_steps: int | None, **given: Any
    ) -> tuple[PyTree, dict[str, Any]]:
        """See `diffrax.AbstractAdjoint`."""
        if max_steps is None:
            raise ValueError("StoredSteps stores every step and needs a bound on their number, but max_steps=None.")
        if event is not None:
            raise ValueError("StoredSteps does not differentiate diffrax's terminating event: use EventSolver.")
        solver = _differentiable_in_both_modes(solver)
        if "stored_steps" in AVAILABLE:
            return self._stored(solver=solver, max_steps=max_steps, **given), {}
        return dfx.DirectAdjoint().loop(solver=solver, event=event, max_steps=max_steps, **given)

    def _stored(
        self,
        *,
        args: PyTree,
        terms: PyTree,
        solver: PyTree,
        stepsize_controller: dfx.AbstractStepSizeController,
        saveat: dfx.SaveAt,
        t0: Array,
        t1: Array,
        dt0: Array | None,
        max_steps: int,
        init_state: PyTree,
        progress_meter: dfx.AbstractProgressMeter,
        **_: Any,
    ) -> PyTree:
        """The final state of diffrax's loop, by a primitive with derivatives of its own."""
        begin, order = init_state, solver.error_order(terms)
        y0, args_of_step = begin.y, (begin.tprev, begin.tnext, begin.y, begin.solver_state)

        # Numbers of the terms, the solver, `args` and the closures of their functions become leaves.
        def step(t0: Array, t1: Array, y: PyTree, state: PyTree, jump: bool | Array) -> PyTree:
            return solver.step(terms, t0, t1, y, args, state, jump)

        traced, jumps = _traced_once(step, *args_of_step, begin.made_jump), not isinstance(begin.made_jump, bool)
        if not jumps and _tells_of_jumps(stepsize_controller, args, begin, order, traced):
            traced, jumps = _traced_once(step, *args_of_step, jnp.asarray(False)), True
        even = isinstance(stepsize_controller, dfx.ConstantStepSize | FiniteSteps)
        subs = [sub for sub in jtu.tree_leaves(saveat.subs, is_leaf=_is_sub) if _is_sub(sub)]
        fns = [eqx.filter_closure_convert(lambda t, y, fn=sub.fn: fn(t, y, args), t0, y0) for sub in subs]
        inputs = StepInputs(traced, fns, [sub.ts for sub in subs], t0, t1, y0, begin.solver_state)
        stripped = eqx.tree_at(lambda s: (s.y, s.solver_state), begin, (None, None), is_leaf=is_none)
        fixed = _Fixed(
            stepsize_controller,
            saveat,
            dt0,
            args,
            progress_meter,
            stripped,
            max_steps,
            order,
            StepPlan(solver.interpolation_cls, [(sub.t0, sub.t1, sub.steps) for sub in subs], jumps, even, self.every),
            _projection(solver, t0, y0, args),
            self.probe and has_error_control(stepsize_controller),
            self.brief,
        )
        return eqxi.filter_primitive_bind(_run_p, _traced_run(inputs, fixed, None), inputs, fixed, False)


class _Fixed(NamedTuple):
    """Inputs of a run without a derivative."""

    controller: PyTree
    saveat: PyTree
    dt0: Array | None
    args: PyTree
    progress_meter: PyTree
    state: PyTree
    max_steps: int
    error_order: PyTree
    how: StepPlan
    # The projection after every step, from time and state to the state; None without one.
    project: Callable[[Array, PyTree], PyTree] | None
    # Whether a probe limits the steps of a differentiated run, and whether its errors are relative to means.
    probe: bool
    brief: bool


class _Solver(NamedTuple):
    """A solver for diffrax's loop, with a traced step."""

    advance: Callable[..., PyTree]
    order: PyTree
    how: StepPlan

    def step(
        self, terms: PyTree, t0: Array, t1: Array, y: PyTree, args: PyTree, state: PyTree, jump: bool | Array
    ) -> PyTree:
        del terms, args
        return self.advance(t0, t1, y, state, jnp.asarray(jump) if self.how.jumps else jump)

    def error_order(self, terms: PyTree) -> PyTree:
        del terms
        return self.order

    @property
    def interpolation_cls(self) -> Callable[..., dfx.AbstractPath]:
        return self.how.interpolation_cls


def _projection(solver: PyTree, t0: Array, y0: PyTree, args: PyTree) -> Fn | None:
    project = getattr(solver, "project", None)
    return None if project is None else eqx.filter_closure_convert(lambda t, y: project(t, y, args), t0, y0)


def _is_sub(x: object) -> bool:
    return isinstance(x, dfx.SubSaveAt)


def _differentiable_in_both_modes(solver: PyTree) -> PyTree:
    """The solver, with loops over the stages of diffrax's Runge-Kutta methods that both modes can differentiate."""
    is_method = lambda x: isinstance(x, dfx.AbstractRungeKutta) and x.scan_kind is None  # noqa: E731

    def bounded(x: PyTree) -> PyTree:
        return eqx.tree_at(lambda s: s.scan_kind, x, "bounded", is_leaf=is_none) if is_method(x) else x

    return jtu.tree_map(bounded, solver, is_leaf=is_method)


def _tells_of_jumps(
    controller: PyTree, args: PyTree, state: PyTree, order: PyTree, step: Callable[..., PyTree]
) -> bool:
    """Whether `made_jump` is traced: diffrax keeps it a Python boolean if the controller never reports a jump."""

    def made_jump(controller: PyTree, args: PyTree, state: PyTree) -> bool | Array:
        t0, t1, y0 = state.tprev, state.tnext, state.y
        y1, y_error, *_ = step(t0, t1, y0, state.solver_state, False)
        return controller.adapt_step_size(t0, t1, y0, y1, args, y_error, order, state.controller_state)[3]

    return not isinstance(eqx.filter_eval_shape(made_jump, controller, args, state), bool)


def _traced_once(fn: Callable[..., PyTree], *args: PyTree) -> Callable[..., PyTree]:
    """`fn`, traced at `args`, as a pytree of its closure; its program is one equation in the programs that call it."""
    numbers, program = eqx.partition(eqx.filter_closure_convert(fn, *args), eqx.is_array)
    return eqx.Partial(eqx.filter_jit(lambda numbers, *args: eqx.combine(numbers, program)(*args)), numbers)


def _traced_run(inputs: StepInputs, fixed: _Fixed, by: StepInputs | None) -> Fn:
    """`_solve`, traced at `inputs`, as a pytree of its closure."""
    run: Any = eqx.filter_closure_convert(lambda inputs: _solve(inputs, fixed, by), inputs)
    return eqx.tree_at(lambda run: run.jaxpr, run, without_single_roundings(run.jaxpr))


def _solve(inputs: StepInputs, fixed: _Fixed, by: StepInputs | None) -> PyTree:
    """The final state of diffrax's loop; for a differentiated run the steps, too.

    A probe then limits the steps, if an error estimate determines them.
    """
    every, size, kept, keeps = fixed.how.every, fixed.max_steps, [], by is not None
    y0, step, controller = inputs.y0, inputs.step, fixed.controller
    if by is not None and fixed.probe and jtu.tree_leaves((by.step, by.y0)):
        change = direction(inputs.step, y0, (by.step, by.y0), controller)
        y0 = start(inputs.t0, y0, inputs.solver_state, change[1], fixed.project, fixed.brief)
        step = ProbedStep(step, change[0], controller)
        controller = ProbedController(controller)

    def outer(cond: Fn, body: Fn, init: PyTree, *, max_steps: int, buffers: Fn) -> PyTree:
        if not keeps:
            return lax_loop(cond, body, init, max_steps=max_steps, buffers=buffers)

        def step(carry: PyTree) -> PyTree:
            state, steps = carry
            at, one, after = state.num_accepted_steps, _beginning(state), body(state)
            began = jtu.tree_map(
                lambda x, xs: eqxi.buffer_at_set(xs, at // every, x, pred=True if every == 1 else at % every == 0),
                one.began,
                steps.began,
            )
            t0, t1, jump = jtu.tree_map(lambda x, xs: xs.at[at].set(x), one[:3], steps[:3])
            return after, StepRecord(t0, t1, jump, began)

        one = _beginning(init)
        empty = empty_buffers(one, size)._replace(began=empty_buffers(one.began, -(-size // every)))
        final, steps = lax_loop(
            lambda carry: cond(carry[0]),
            step,
            (init, empty),
            max_steps=max_steps,
            buffers=lambda carry: (buffers(carry[0]), carry[1]),
        )
        kept.append(steps)
        return final

    def inner(cond: Fn, body: Fn, init: PyTree, max_steps: int, buffers: Fn, checkpoints: int) -> PyTree:
        del checkpoints
        return lax_loop(cond, body, init, max_steps=max_steps, buffers=buffers)

    each = iter(zip(inputs.fns, inputs.times, strict=True))

    def put(sub: dfx.SubSaveAt) -> dfx.SubSaveAt:
        fn, times = next(each)
        return dfx.SubSaveAt(
            t0=sub.t0, t1=sub.t1, ts=times, steps=sub.steps, fn=lambda t, y, _: fn(t, without_probe(y))
        )

    state = eqx.tree_at(lambda s: (s.y, s.solver_state), fixed.state, (y0, inputs.solver_state), is_leaf=is_none)
    saveat = eqx.tree_at(lambda s: s.subs, fixed.saveat, jtu.tree_map(put, fixed.saveat.subs, is_leaf=_is_sub))
    final, _ = diffrax_loop(
        args=fixed.args,
        terms=None,
        solver=_Solver(step, fixed.error_order, fixed.how),
        stepsize_controller=controller,
        event=None,
        saveat=saveat,
        t0=inputs.t0,
        t1=inputs.t1,
        dt0=fixed.dt0,
        max_steps=fixed.max_steps,
        init_state=state,
        inner_while_loop=inner,
        outer_while_loop=outer,
        progress_meter=fixed.progress_meter,
    )
    final = eqx.tree_at(lambda s: s.y, final, without_probe(final.y))
    return (final, kept[0]) if keeps else final


def _beginning(state: PyTree) -> StepRecord:
    y = without_probe(state.y)
    return StepRecord(state.tprev, state.tnext, jnp.asarray(state.made_jump), (y, state.solver_state))


# The run and its derivative are primitives; the second is linear in the tangents and has a transpose of its own. One
# function thus has a rule for both modes.
def _struct(tree: PyTree) -> PyTree:
    return jtu.tree_map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype) if isinstance(x, ShapedArray) else x, tree)


def _aval(tree: PyTree) -> PyTree:
    return jtu.tree_map(lambda x: ShapedArray(x.shape, x.dtype) if isinstance(x, jax.ShapeDtypeStruct) else x, tree)


def _array(x: PyTree) -> PyTree:
    """`x` as an array, unless JAX asks for its cotangent; constants of a program may have other types."""
    return x if _is_asked(x) or isinstance(x, jax.Array) else jnp.asarray(x)


def _primitive(name: str, fn: Fn, jvp: Fn, transpose: Fn) -> Primitive:
    rules = eqxi.filter_primitive_jvp(jvp), eqxi.filter_primitive_transpose(transpose)
    return eqxi.create_vprim(
        name,
        eqxi.filter_primitive_def(fn),
        eqxi.filter_primitive_def(lambda *args: _aval(eqx.filter_eval_shape(fn, *_struct(args)))),
        lambda primals, tangents, **params: rules[0]([_array(x) for x in primals], tangents, **params),
        lambda cts, *inputs, **params: rules[1](cts, *[_array(x) for x in inputs], **params),
    )


def _make(run: Callable[[StepInputs], PyTree], inputs: StepInputs, fixed: _Fixed, keeps: bool) -> PyTree:
    """The run."""
    del fixed, keeps
    return run(inputs)


def _make_jvp(primals: PyTree, tangents: PyTree) -> PyTree:
    (run, inputs, fixed, keeps), by = primals, tangents[1]
    if not keeps:
        asked = jtu.tree_map(lambda _: True, by)
        run = _traced_run(inputs, fixed, asked)
    final, steps = eqxi.filter_primitive_bind(_run_p, run, inputs, fixed, True)
    if jtu.tree_leaves(by):
        # Under vmap this gives each input a batch if the run has one, which the transpose needs.
        one = jnp.where(final.num_accepted_steps >= 0, 1.0, 0.0)
        by = jtu.tree_map(lambda d: d * one.astype(d.dtype), by)
        change = eqxi.filter_primitive_bind(_change_p, by, RecordedRun(inputs, final, steps, fixed.how), keeps)
    else:
        change = RunTangents(None, None, [(None, None)] * len(fixed.how.subs), None, None)
    saves = iter(change.saved)

    def saved(state: PyTree) -> PyTree:
        ys, ts = next(saves)
        return eqx.tree_at(lambda s: (s.ys, s.ts), _none(state), (ys, ts), is_leaf=is_none)

    t_final = eqx.tree_at(
        lambda s: (s.y, s.solver_state, s.save_state, s.dense_infos),
        _none(final),
        (
            change.y,
            change.solver_state,
            jtu.tree_map(saved, final.save_state, is_leaf=is_save_state),
            change.dense_infos,
        ),
        is_leaf=is_none,
    )
    if not keeps:
        return final, t_final
    return (final, steps), (t_final, _none(steps) if change.steps is None else change.steps)


def _none(tree: PyTree) -> PyTree:
    return jtu.tree_map(lambda _: None, tree)


def _make_transpose(inputs: PyTree, cts: PyTree) -> PyTree:
    del inputs, cts
    raise AssertionError("The run is not linear.")


def _change(by: StepInputs, run: RecordedRun, keeps: bool) -> RunTangents:
    """Change of a run by a change of its inputs."""
    return _once(ForwardOverSteps(by, run, keeps).result())


def _change_jvp(primals: PyTree, tangents: PyTree) -> PyTree:
    by, run, keeps = primals
    return eqx.filter_jvp(lambda by, run: _change(by, run, keeps), (by, run), tangents[:2])


def _is_asked(x: object) -> bool:
    """Whether JAX asks for the cotangent of this input."""
    return isinstance(x, UndefinedPrimal)


def _change_transpose(inputs: PyTree, cts: RunTangents) -> PyTree:
    by, run, keeps = inputs
    if keeps:
        raise RuntimeError(_TWICE)
    by = jtu.tree_map(lambda x: _is_asked(x) or None, by, is_leaf=_is_asked)
    return _once(ReverseOverSteps(by, run, cts).result()), _none(run), None


def _once(derivative: PyTree) -> PyTree:
    """`derivative`, whose own derivative is not available in reverse mode."""
    return eqxi.nondifferentiable_backward(derivative, msg=_TWICE)


if "stored_steps" in AVAILABLE:
    _run_p = _primitive("run", _make, _make_jvp, _make_transpose)
    _change_p = _primitive("change_of_run", _change, _change_jvp, _change_transpose)
