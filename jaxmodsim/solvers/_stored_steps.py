"""Forward and reverse mode from the steps that were made."""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import diffrax as dfx
import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax import lax
from jax.core import ShapedArray
from jax.interpreters.ad import UndefinedPrimal
from jaxtyping import Array, Int, PyTree

from ._controllers import FiniteSteps

_lax_loop = partial(eqxi.while_loop, kind="lax")
_TWICE = "StoredSteps does not differentiate a derivative in reverse mode: take jax.hessian, or jax.jacfwd of jax.grad."


class StoredSteps(dfx.AbstractAdjoint):
    """Derivatives of the steps that were made, each step differentiated once, forward or from the last to the first.

    The run keeps what every accepted step began with. Forward mode (`jax.jvp`, `jax.jacfwd`) goes over `jax.jvp` of
    these steps, reverse mode (`jax.grad`, `jax.jacrev`) back over `jax.vjp` of them. `jax.hessian` and other forward
    over reverse or forward over forward derivatives work likewise. Nothing is computed a second time in another order,
    so rounding, which events and error control would enlarge, does not enter: the derivative is that of the run, to
    rounding, at any tolerance. The times of the steps, and with them the work of the step size controller, count as
    constants; those of constant steps, by which diffrax divides a run evenly, move with its ends. Rejected steps cost
    nothing.

    Derivatives hold by the initial state, by everything in `args`, terms and solver, by `t0`, `t1`, the times in
    `SaveAt(ts=...)`, and by what their functions close over. A run that ended early gives the derivative of the part
    that was integrated.

    Memory, only where a derivative is taken: `max_steps / every` times the size of the state and of the solver's state,
    `every` times the same in reverse mode, and `max_steps` times two times.

    **Arguments:**

    - `every`: keep the state of every such step, at least 1; those between are made again, at their recorded times.

    **Raises:**

    - `ValueError` for `every` below 1, `max_steps=None`, and diffrax's own terminating `event`.
    - `NotImplementedError` for reverse mode over reverse mode.
    """

    every: int = eqx.field(static=True, default=1)

    def __check_init__(self) -> None:
        if self.every < 1:
            raise ValueError(f"every must be at least 1, but every={self.every}: it is a number of steps.")

    def loop(
        self,
        *,
        args: PyTree,
        terms: PyTree,
        solver: dfx.AbstractSolver,
        stepsize_controller: dfx.AbstractStepSizeController,
        event: dfx.Event | None,
        saveat: dfx.SaveAt,
        t0: Array,
        t1: Array,
        dt0: Array | None,
        max_steps: int | None,
        init_state: Any,
        progress_meter: dfx.AbstractProgressMeter,
        throw: bool,
        passed_solver_state: bool,
        passed_controller_state: bool,
    ) -> tuple[Any, dict[str, Any]]:
        """See `diffrax.AbstractAdjoint`."""
        del throw, passed_solver_state, passed_controller_state
        if max_steps is None:
            raise ValueError("StoredSteps keeps every step and needs a bound on their number, but max_steps=None.")
        if event is not None:
            raise ValueError("StoredSteps does not differentiate diffrax's terminating event: use EventSolver.")
        solver = _differentiable_in_both_modes(solver)
        begin, order = init_state, solver.error_order(terms)
        y0, args_of_step = begin.y, (begin.tprev, begin.tnext, begin.y, begin.solver_state)

        # Numbers of the terms, of the solver and of `args`, and what their functions close over, become leaves.
        def step(t0: Array, t1: Array, y: PyTree, state: PyTree, jump: Any) -> Any:
            return solver.step(terms, t0, t1, y, args, state, jump)

        traced, jumps = _traced_once(step, *args_of_step, begin.made_jump), not isinstance(begin.made_jump, bool)
        if not jumps and _tells_of_jumps(stepsize_controller, args, begin, order, traced):
            traced, jumps = _traced_once(step, *args_of_step, jnp.asarray(False)), True
        even = isinstance(stepsize_controller, dfx.ConstantStepSize | FiniteSteps)
        subs = [sub for sub in jtu.tree_leaves(saveat.subs, is_leaf=_is_sub) if _is_sub(sub)]
        fns = [eqx.filter_closure_convert(lambda t, y, fn=sub.fn: fn(t, y, args), t0, y0) for sub in subs]
        inputs = _Inputs(traced, fns, [sub.ts for sub in subs], t0, t1, y0, begin.solver_state)
        stripped = eqx.tree_at(lambda s: (s.y, s.solver_state), begin, (None, None), is_leaf=lambda x: x is None)
        fixed = _Fixed(
            stepsize_controller,
            saveat,
            dt0,
            args,
            progress_meter,
            stripped,
            max_steps,
            self._loop,
            order,
            _How(solver.interpolation_cls, [(sub.t0, sub.t1, sub.steps) for sub in subs], jumps, even, self.every),
        )
        run = eqx.filter_closure_convert(lambda inputs: _solve(inputs, fixed, False), inputs)
        return eqxi.filter_primitive_bind(_run_p, run, inputs, fixed, False), {}


class _How(NamedTuple):
    """What is known of a run while compiling."""

    interpolation_cls: Callable[..., dfx.AbstractPath]
    # Of each `SubSaveAt`: t0, t1 and steps.
    subs: list[tuple[bool, bool, int]]
    # Whether the solver is told of jumps.
    jumps: bool
    # Whether the steps are constant: their times move with the ends of the run.
    even: bool
    every: int


class _Inputs(NamedTuple):
    """What a run is differentiated by."""

    step: Callable[..., Any]
    # Of each `SubSaveAt`, its function and its times.
    fns: list[Callable[[Array, PyTree], PyTree]]
    times: list[Any]
    t0: Array
    t1: Array
    y0: PyTree
    solver_state: PyTree


class _Fixed(NamedTuple):
    """What it is not differentiated by."""

    controller: Any
    saveat: Any
    dt0: Any
    args: PyTree
    progress_meter: Any
    state: Any
    max_steps: int
    loop: Callable[..., Any]
    error_order: Any
    how: _How


class _Steps(NamedTuple):
    """What accepted steps began with, one or an array of them."""

    t0: Array
    t1: Array
    made_jump: Any
    # Of the steps whose state is kept: y and the solver's state.
    began: tuple[PyTree, PyTree]


class _Run(NamedTuple):
    """A run that was made, and what its derivative is taken of."""

    inputs: _Inputs
    final: Any
    steps: _Steps
    how: _How


class _Tangents(NamedTuple):
    """Of what a run gives: derivatives, or cotangents. None is zero."""

    y: PyTree
    solver_state: PyTree
    # Of each `SubSaveAt`: values and times.
    saved: list[tuple[PyTree, Any]]
    dense_infos: PyTree
    # Of the steps, where these are differentiated, too.
    steps: _Steps | None


class _Solver(NamedTuple):
    """What diffrax's loop asks of a solver, with a step that is traced already."""

    advance: Callable[..., Any]
    order: Any
    how: _How

    def step(self, terms: Any, t0: Any, t1: Any, y: Any, args: Any, state: Any, jump: Any) -> Any:
        del terms, args
        return self.advance(t0, t1, y, state, jnp.asarray(jump) if self.how.jumps else jump)

    def error_order(self, terms: Any) -> Any:
        del terms
        return self.order

    @property
    def interpolation_cls(self) -> Any:
        return self.how.interpolation_cls


def _is_sub(x: Any) -> bool:
    return isinstance(x, dfx.SubSaveAt)


def _differentiable_in_both_modes(solver: Any) -> Any:
    """With loops over the stages of diffrax's Runge-Kutta methods that either mode can go through."""
    is_method = lambda x: isinstance(x, dfx.AbstractRungeKutta) and x.scan_kind is None  # noqa: E731

    def bounded(x: Any) -> Any:
        return eqx.tree_at(lambda s: s.scan_kind, x, "bounded", is_leaf=_is_none) if is_method(x) else x

    return jtu.tree_map(bounded, solver, is_leaf=is_method)


def _tells_of_jumps(controller: Any, args: PyTree, state: Any, order: Any, step: Callable[..., Any]) -> bool:
    """Whether `made_jump` is traced: diffrax keeps it a Python boolean where the controller never tells of a jump."""

    def made_jump(controller: Any, args: PyTree, state: Any) -> Any:
        t0, t1, y0 = state.tprev, state.tnext, state.y
        y1, y_error, *_ = step(t0, t1, y0, state.solver_state, False)
        return controller.adapt_step_size(t0, t1, y0, y1, args, y_error, order, state.controller_state)[3]

    return not isinstance(eqx.filter_eval_shape(made_jump, controller, args, state), bool)


def _traced_once(fn: Callable[..., Any], *args: Any) -> Callable[..., Any]:
    """`fn`, traced at `args`, as a pytree of what it closes over; its program is one equation in those that call it."""
    numbers, program = eqx.partition(eqx.filter_closure_convert(fn, *args), eqx.is_array)
    return eqx.Partial(eqx.filter_jit(lambda numbers, *args: eqx.combine(numbers, program)(*args)), numbers)


def _solve(inputs: _Inputs, fixed: _Fixed, keeps: bool) -> Any:
    """The final state of diffrax's loop, and the steps if they are wanted."""
    every, size, kept = fixed.how.every, fixed.max_steps, []

    def outer(cond: Any, body: Any, init: Any, *, max_steps: int, buffers: Any) -> Any:
        if not keeps:
            return _lax_loop(cond, body, init, max_steps=max_steps, buffers=buffers)

        def step(carry: Any) -> Any:
            state, steps = carry
            at, one, after = state.num_accepted_steps, _beginning(state), body(state)
            began = jtu.tree_map(
                lambda x, xs: eqxi.buffer_at_set(xs, at // every, x, pred=True if every == 1 else at % every == 0),
                one.began,
                steps.began,
            )
            times = jtu.tree_map(lambda x, xs: xs.at[at].set(x), one[:3], steps[:3])
            return after, _Steps(*times, began)

        one = _beginning(init)
        empty = _Steps(*_buffers(one[:3], size), _buffers(one.began, -(-size // every)))
        final, steps = _lax_loop(
            lambda carry: cond(carry[0]),
            step,
            (init, empty),
            max_steps=max_steps,
            buffers=lambda carry: (buffers(carry[0]), carry[1]),
        )
        kept.append(steps)
        return final

    def inner(cond: Any, body: Any, init: Any, max_steps: int, buffers: Any, checkpoints: int) -> Any:
        del checkpoints
        return _lax_loop(cond, body, init, max_steps=max_steps, buffers=buffers)

    each = iter(zip(inputs.fns, inputs.times, strict=True))

    def put(sub: dfx.SubSaveAt) -> dfx.SubSaveAt:
        fn, times = next(each)
        return dfx.SubSaveAt(t0=sub.t0, t1=sub.t1, ts=times, steps=sub.steps, fn=lambda t, y, _: fn(t, y))

    state = eqx.tree_at(
        lambda s: (s.y, s.solver_state), fixed.state, (inputs.y0, inputs.solver_state), is_leaf=lambda x: x is None
    )
    saveat = eqx.tree_at(lambda s: s.subs, fixed.saveat, jtu.tree_map(put, fixed.saveat.subs, is_leaf=_is_sub))
    final, _ = fixed.loop(
        args=fixed.args,
        terms=None,
        solver=_Solver(inputs.step, fixed.error_order, fixed.how),
        stepsize_controller=fixed.controller,
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
    return (final, kept[0]) if keeps else final


def _beginning(state: Any) -> _Steps:
    return _Steps(state.tprev, state.tnext, jnp.asarray(state.made_jump), (state.y, state.solver_state))


def _buffers(tree: PyTree, size: int) -> PyTree:
    return jtu.tree_map(lambda x: jnp.zeros((size, *jnp.shape(x)), jnp.result_type(x)), tree)


# The run and its derivative are primitives, the second linear in the tangents and with a transpose of its own. So one
# function has a rule for either mode.
def _struct(tree: PyTree) -> PyTree:
    return jtu.tree_map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype) if isinstance(x, ShapedArray) else x, tree)


def _aval(tree: PyTree) -> PyTree:
    return jtu.tree_map(lambda x: ShapedArray(x.shape, x.dtype) if isinstance(x, jax.ShapeDtypeStruct) else x, tree)


def _array(x: Any) -> Any:
    """Constants of a program come in other forms, too."""
    return x if isinstance(x, UndefinedPrimal | jax.Array) else jnp.asarray(x)


def _primitive(name: str, fn: Callable[..., Any], jvp: Callable[..., Any], transpose: Callable[..., Any]) -> Any:
    rules = eqxi.filter_primitive_jvp(jvp), eqxi.filter_primitive_transpose(transpose)
    return eqxi.create_vprim(
        name,
        eqxi.filter_primitive_def(fn),
        eqxi.filter_primitive_def(lambda *args: _aval(eqx.filter_eval_shape(fn, *_struct(args)))),
        lambda primals, tangents, **params: rules[0]([_array(x) for x in primals], tangents, **params),
        lambda cts, *inputs, **params: rules[1](cts, *[_array(x) for x in inputs], **params),
    )


def _make(run: Callable[[_Inputs], Any], inputs: _Inputs, fixed: _Fixed, keeps: bool) -> Any:
    """The run."""
    del fixed, keeps
    return run(inputs)


def _make_jvp(primals: Any, tangents: Any) -> Any:
    (run, inputs, fixed, keeps), by = primals, tangents[1]
    if not keeps:
        run = eqx.filter_closure_convert(lambda inputs: _solve(inputs, fixed, True), inputs)
    final, steps = eqxi.filter_primitive_bind(_run_p, run, inputs, fixed, True)
    if jtu.tree_leaves(by):
        # Under vmap this makes a batch of each input where the run is one: only then is the transpose right.
        one = jnp.where(final.num_accepted_steps >= 0, 1.0, 0.0)
        by = jtu.tree_map(lambda d: d * one.astype(d.dtype), by)
        change = eqxi.filter_primitive_bind(_change_p, by, _Run(inputs, final, steps, fixed.how), keeps)
    else:
        change = _Tangents(None, None, [(None, None)] * len(fixed.how.subs), None, None)
    saves = iter(change.saved)

    def saved(state: Any) -> Any:
        ys, ts = next(saves)
        return eqx.tree_at(lambda s: (s.ys, s.ts), _none(state), (ys, ts), is_leaf=lambda x: x is None)

    t_final = eqx.tree_at(
        lambda s: (s.y, s.solver_state, s.save_state, s.dense_infos),
        _none(final),
        (
            change.y,
            change.solver_state,
            jtu.tree_map(saved, final.save_state, is_leaf=_is_save),
            change.dense_infos,
        ),
        is_leaf=lambda x: x is None,
    )
    if not keeps:
        return final, t_final
    return (final, steps), (t_final, _none(steps) if change.steps is None else change.steps)


def _none(tree: PyTree) -> PyTree:
    return jtu.tree_map(lambda _: None, tree)


def _is_save(x: Any) -> bool:
    return hasattr(x, "saveat_ts_index")


def _make_transpose(inputs: Any, cts: Any) -> Any:
    del inputs, cts
    raise AssertionError("The run is not linear.")


def _change(by: _Inputs, run: _Run, keeps: bool) -> _Tangents:
    """What a run changes by if its inputs do."""
    return _once(_Forward(by, run, keeps).result())


def _change_jvp(primals: Any, tangents: Any) -> Any:
    by, run, keeps = primals
    return eqx.filter_jvp(lambda by, run: _change(by, run, keeps), (by, run), tangents[:2])


def _change_transpose(inputs: Any, cts: _Tangents) -> Any:
    by, run, keeps = inputs
    if keeps:
        raise NotImplementedError(_TWICE)
    by = jtu.tree_map(
        lambda x: isinstance(x, UndefinedPrimal) or None, by, is_leaf=lambda x: isinstance(x, UndefinedPrimal)
    )
    return _once(_Reverse(by, run, cts).result()), _none(run), None


def _once(derivative: PyTree) -> PyTree:
    """`derivative`, whose own derivative is not available in reverse mode."""
    return eqxi.nondifferentiable_backward(derivative, msg=_TWICE)


class _Derivative:
    """What both modes share: the parts of a run as functions of what they are differentiated by."""

    def __init__(self, by: _Inputs, run: _Run):
        self.inputs, self.final, self.steps, self.how = run
        program = run.inputs[:2]
        # The differentiated numbers of the step and of what is saved, None elsewhere, and the rest.
        self.numbers = jtu.tree_map(lambda d, x: None if d is None else x, by[:2], program, is_leaf=_is_none)
        self.constants = jtu.tree_map(lambda d, x: x if d is None else None, by[:2], program, is_leaf=_is_none)
        self.count = jnp.asarray(run.final.num_accepted_steps)
        self.saves = [x for x in jtu.tree_leaves(run.final.save_state, is_leaf=_is_save) if _is_save(x)]

    def times(self, k: Array) -> tuple[tuple[Array, Array], Any]:
        """Ends of a step, and whether a jump was made before it."""
        t0, t1, jump = jtu.tree_map(lambda x: x[k], self.steps[:3])
        return (t0, t1), jump if self.how.jumps else False

    def stored(self, k: Array) -> tuple[PyTree, PyTree]:
        """The state that is kept of this step, or of the one before it that is kept."""
        return jtu.tree_map(lambda x: x[k // self.how.every], self.steps.began)

    def ends_by_run(self, k: Array, ends: tuple[Array, Array]) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
        """Derivatives of the ends of a step, of each by t0 and by t1 of the run."""
        t0, t1 = self.inputs.t0, self.inputs.t1
        if self.how.even:  # the first step has the length that was given, the others divide the run evenly
            part = lambda j, t: (t - t0) / (t1 - t0) * ((j != 1) | (t == t1))  # noqa: E731
            start, end = part(k, ends[0]), part(k + 1, ends[1])
            return (1.0 - start, start), (1.0 - end, end)
        last, zero = (k == self.count - 1) & (ends[1] == t1), jnp.zeros_like(t0)
        return (jnp.where(k == 0, 1.0, zero), zero), (zero, jnp.where(last, 1.0, zero))

    def advance(self, rest: PyTree, jump: Any, began: PyTree, ends: tuple[Array, Array], numbers: PyTree) -> Any:
        """One step: numbers of state, solver's state and dense output, and the rest of these."""
        step, (y, state) = eqx.combine(numbers[0], self.constants[0]), eqx.combine(began, rest)
        y, _, dense, state, _ = step(*ends, y, state, jump)
        return eqx.partition((y, state, dense), eqx.is_inexact_array)

    def made_again(self, k: Array, began: tuple[PyTree, PyTree]) -> tuple[PyTree, PyTree]:
        """State and solver's state after a step."""
        ends, jump = self.times(k)
        y, _, _, state, _ = self.inputs.step(*ends, *began, jump)
        return y, state

    def value(self, i: int, t: Array, y: PyTree, rest: PyTree, numbers: PyTree) -> PyTree:
        """What the i-th `SubSaveAt` keeps of a state."""
        fn = eqx.combine(numbers[1][i], self.constants[1][i])
        return _numbers(fn(t, eqx.combine(y, rest)))

    def at_time(self, i: int, rest: PyTree, t: Array, dense: PyTree, ends: tuple[Array, Array], numbers: PyTree) -> Any:
        """What it keeps at a time within a step."""
        y = self.how.interpolation_cls(t0=ends[0], t1=ends[1], **eqx.combine(dense, rest)).evaluate(t)
        return self.value(i, t, *eqx.partition(y, eqx.is_inexact_array), numbers)

    def at_the_end(self, i: int) -> tuple[Array, Array]:
        """Whether the i-th `SubSaveAt` keeps the last state beside others, and whether it has all of its times there.

        That is so in a run of no length, which makes no step.
        """
        (_, t1, steps), times = self.how.subs[i], self.inputs.times[i]
        last = jnp.asarray(t1 and steps != 1)
        if steps > 1:
            last &= self.count % steps != 0
        return last, (self.inputs.t0 == self.inputs.t1) & (times is not None)

    def rows_at_once(self, i: int, empty: Array) -> Array:
        """Which entries are those of a run of no length."""
        size, t0, times = self.saves[i].ts.shape[0], self.how.subs[i][0], self.inputs.times[i]
        at = jnp.arange(size) - t0
        return empty & (at >= 0) & (at < (0 if times is None else times.shape[0]))


class _Ahead(NamedTuple):
    """Derivatives on the way forward, of the state before the step `k` and of what was kept so far."""

    k: Int[Array, ""]
    began: tuple[PyTree, PyTree]
    # The state itself where not every one is stored.
    state: Any
    # Of each `SubSaveAt`: how many entries it has kept, how many of its own times, and their derivatives.
    saved: list[Int[Array, ""]]
    timed: list[Int[Array, ""]]
    rows: list[tuple[PyTree, Array]]
    dense: PyTree
    steps: _Steps | None


class _Forward(_Derivative):
    """The derivative of a run, from the first step to the last."""

    def __init__(self, by: _Inputs, run: _Run, keeps: bool):
        super().__init__(by, run)
        self.by, self.keeps = by, keeps
        self.d_t0, self.d_t1 = _filled(by.t0, run.inputs.t0), _filled(by.t1, run.inputs.t1)
        self.d_times = [_filled(d, t) for d, t in zip(by.times, run.inputs.times, strict=True)]

    def result(self) -> _Tangents:
        """Derivatives of what the run gave."""
        ahead = _lax_loop(
            lambda ahead: ahead.k < self.count,
            self.over_step,
            self.before_the_run(),
            max_steps=None,
            buffers=lambda ahead: (ahead.rows, ahead.dense, ahead.steps),
        )
        y, solver_state = ahead.began
        return _Tangents(y, solver_state, self.after_the_run(ahead), ahead.dense, ahead.steps)

    def write(self, rows: Any, i: int, at: Array, pred: Any, t: Any, y: Any, d_t: Any, d_y: Any) -> Any:
        """With the derivative of what the i-th `SubSaveAt` keeps of a state, if `pred`."""
        (t, y), (d_t, d_y) = (t, eqx.partition(y, eqx.is_inexact_array)), (d_t, d_y)
        value = lambda t, y_, n: self.value(i, t, y_, y[1], n)  # noqa: E731
        _, row = jax.jvp(value, (t, y[0], self.numbers), (d_t, d_y, self.by[:2]))
        return _set(rows, at, (row, d_t), pred)

    def before_the_run(self) -> _Ahead:
        """Of the first state, and of what is kept of it."""
        inputs, save_states = self.inputs, self.saves
        began = (inputs.y0, inputs.solver_state)
        d_began = _filled((self.by.y0, self.by.solver_state), began)
        rows = [jtu.tree_map(jnp.zeros_like, (_numbers(save.ys), save.ts)) for save in save_states]
        for i, (t0, _, _) in enumerate(self.how.subs):
            if t0:
                rows[i] = self.write(rows[i], i, jnp.asarray(0), True, inputs.t0, inputs.y0, self.d_t0, d_began[0])
        steps = jtu.tree_map(jnp.zeros_like, _numbers(self.steps)) if self.keeps else None
        return _Ahead(
            jnp.asarray(0),
            d_began,
            began if self.how.every > 1 else None,
            [jnp.asarray(int(t0)) for t0, _, _ in self.how.subs],
            [jnp.asarray(0) for _ in self.how.subs],
            rows,
            jtu.tree_map(jnp.zeros_like, _numbers(self.final.dense_infos)),
            steps,
        )

    def over_step(self, ahead: _Ahead) -> _Ahead:
        """From the start of a step to its end."""
        k, every = ahead.k, self.how.every
        ends, jump = self.times(k)
        state = self.stored(k)
        if every > 1:
            state = jtu.tree_map(lambda a, b: jnp.where(k % every == 0, a, b), state, ahead.state)
        began, rest = eqx.partition(state, eqx.is_inexact_array)
        start, end = self.ends_by_run(k, ends)
        d_ends = tuple(by[0] * self.d_t0 + by[1] * self.d_t1 for by in (start, end))
        (y, state, dense), (d_y, d_state, d_dense), others = jax.jvp(
            partial(self.advance, rest, jump),
            (began, ends, self.numbers),
            (ahead.began, d_ends, self.by[:2]),
            has_aux=True,
        )
        for i, (_, _, every_row) in enumerate(self.how.subs):
            if self.inputs.times[i] is not None:
                over_time = partial(self.over_time, i, others[2], (dense, ends), (d_dense, d_ends))
                ahead.saved[i], ahead.timed[i], ahead.rows[i] = _lax_loop(
                    partial(self.inside, i, ends[1]),
                    over_time,
                    (ahead.saved[i], ahead.timed[i], ahead.rows[i]),
                    max_steps=None,
                    buffers=lambda carry: carry[2],
                )
            if every_row:
                kept, after = (k + 1) % every_row == 0, eqx.combine(y, others[0])
                at = ahead.saved[i]
                ahead.rows[i] = self.write(ahead.rows[i], i, at, kept, ends[1], after, d_ends[1], d_y)
                ahead.saved[i] = at + kept
        steps = ahead.steps
        if steps is not None:
            began = _set(steps.began, k // every, ahead.began, k % every == 0)
            steps = _Steps(*_set(steps[:2], k, d_ends, True), None, began)
        return ahead._replace(
            k=k + 1,
            began=(d_y, d_state),
            state=None if ahead.state is None else eqx.combine((y, state), others[:2]),
            dense=_set(ahead.dense, k, d_dense, True) if self.final.dense_infos is not None else ahead.dense,
            steps=steps,
        )

    def inside(self, i: int, t1: Array, carry: Any) -> Array:
        """Whether the next saved time lies in this step."""
        times, timed = self.inputs.times[i], carry[1]
        return (timed < times.shape[0]) & (times[timed] <= t1)

    def over_time(self, i: int, rest: PyTree, step: Any, d_step: Any, carry: Any) -> Any:
        """The derivative at one saved time."""
        saved, timed, rows = carry
        t, d_t = self.inputs.times[i][timed], self.d_times[i][timed]
        value = partial(self.at_time, i, rest)
        _, row = jax.jvp(value, (t, *step, self.numbers), (d_t, *d_step, self.by[:2]))
        return saved + 1, timed + 1, _set(rows, saved, (row, d_t), True)

    def after_the_run(self, ahead: _Ahead) -> list[tuple[PyTree, Array]]:
        """Of everything that is kept."""
        final, (d_y, _), rows = self.final, ahead.began, ahead.rows
        d_t = jnp.where(final.tprev == self.inputs.t1, self.d_t1, 0.0)
        for i, (_, t1, every_row) in enumerate(self.how.subs):
            (last, empty), times = self.at_the_end(i), self.inputs.times[i]
            if times is not None:
                one = jtu.tree_map(jnp.zeros_like, jtu.tree_map(lambda x: x[:1], rows[i]))
                one = self.write(one, i, jnp.asarray(0), True, final.tprev, final.y, d_t, d_y)
                at_once = self.rows_at_once(i, empty)
                rows[i] = jtu.tree_map(lambda x, one: jnp.where(_column(at_once, x), one, x), rows[i], one)  # noqa: B023
                ahead.saved[i] = ahead.saved[i] + jnp.where(empty, times.shape[0], 0)
            if t1 and every_row != 1:
                rows[i] = self.write(rows[i], i, ahead.saved[i], last, final.tprev, final.y, d_t, d_y)
        return rows


class _Back(NamedTuple):
    """Cotangents on the way back, of the state after the step `k` and of what does not change, and what is left."""

    k: Int[Array, ""]
    began: tuple[PyTree, PyTree]
    # The states of the last steps made again, where not every one is stored.
    states: Any
    numbers: PyTree
    t0: Array
    t1: Array
    # By the times of each `SubSaveAt`; None where it has none.
    times: list[Any]
    # Of each `SubSaveAt`: entries, and its own times among them, that are not treated yet.
    saved: list[Int[Array, ""]]
    timed: list[Int[Array, ""]]


class _Pulled(NamedTuple):
    """Cotangents that one saved time adds: of the dense output of its step, the ends of that, and the numbers."""

    saved: Int[Array, ""]
    timed: Int[Array, ""]
    dense: PyTree
    ends: tuple[Array, Array]
    numbers: PyTree
    times: Array


class _Reverse(_Derivative):
    """The derivative of a run, from the last step to the first."""

    def __init__(self, by: _Inputs, run: _Run, cts: _Tangents):
        super().__init__(by, run)
        self.by, self.cts = by, cts
        # Cotangents of values and times that each `SubSaveAt` kept; None where nothing of it is differentiated.
        self.rows = [
            _filled(ct, (kept.ys, kept.ts)) if jtu.tree_leaves(ct) else None
            for ct, kept in zip(cts.saved, self.saves, strict=True)
        ]
        infos = cts.dense_infos
        self.dense = _filled(infos, run.final.dense_infos) if jtu.tree_leaves(infos) else None

    def result(self) -> _Inputs:
        """Cotangents of the inputs."""
        back = lax.while_loop(lambda back: back.k >= 0, self.over_step, self.after_the_run())
        back = self.before_the_run(back)
        cts = _Inputs(*back.numbers, back.times, back.t0, back.t1, *back.began)
        return jtu.tree_map(lambda asked, ct: None if asked is None else ct, self.by, cts, is_leaf=_is_none)

    def row(self, i: int, index: Array, where: Any = True) -> Any:
        """Cotangents of one entry, of values and time; zero unless `where`."""
        return jtu.tree_map(lambda c: jnp.where(where, c[index], 0.0), self.rows[i])

    def pull_value(self, i: int, t: Array, y: PyTree, ct: tuple[PyTree, Array], back: _Back) -> tuple[Array, _Back]:
        """The cotangent of the time of an entry; those of state and numbers are added."""
        y, rest = eqx.partition(y, eqx.is_inexact_array)
        _, pull = jax.vjp(lambda t, y, n: self.value(i, t, y, rest, n), t, y, self.numbers)
        ct_t, ct_y, more = pull(ct[0])
        began = (_add(back.began[0], ct_y), back.began[1])
        return ct_t + ct[1], back._replace(began=began, numbers=_add(back.numbers, more))

    def after_the_run(self) -> _Back:
        """Cotangents of the last state, from that and from what was kept at the end."""
        final, (t0, t1), cts = self.final, (self.inputs.t0, self.inputs.t1), self.cts
        first, every = (self.inputs.y0, self.inputs.solver_state), self.how.every
        back = _Back(
            self.count - 1,
            _filled((cts.y, cts.solver_state), (final.y, final.solver_state)),
            _buffers(first, every) if every > 1 else None,
            jtu.tree_map(jnp.zeros_like, self.numbers),
            jnp.zeros_like(t0),
            jnp.zeros_like(t1),
            jtu.tree_map(jnp.zeros_like, self.inputs.times),
            [jnp.asarray(each.save_index) for each in self.saves],
            [jnp.asarray(each.saveat_ts_index) for each in self.saves],
        )
        reached = final.tprev == t1
        for i, (_, sub_t1, every_row) in enumerate(self.how.subs):
            last, empty = self.at_the_end(i)
            count, rows, times = back.saved[i] - last, self.rows[i], self.inputs.times[i]
            if rows is not None and (times is not None or (sub_t1 and every_row != 1)):
                ct = self.row(i, count, last)
                if times is not None:
                    at_once = self.rows_at_once(i, empty)
                    ct = _add(ct, jtu.tree_map(lambda c: jnp.sum(jnp.where(_column(at_once, c), c, 0.0), 0), rows))  # noqa: B023
                ct_t, back = self.pull_value(i, final.tprev, final.y, ct, back)
                back = back._replace(t1=back.t1 + jnp.where(reached, ct_t, 0.0))
            back.saved[i] = count
            back.timed[i] = jnp.where(empty, 0, back.timed[i])
        return back

    def before_the_run(self, back: _Back) -> _Back:
        """With the cotangents of what was kept at t0."""
        for i, (t0, _, _) in enumerate(self.how.subs):
            if t0 and self.rows[i] is not None:
                ct = self.row(i, jnp.asarray(0))
                ct_t, back = self.pull_value(i, self.inputs.t0, self.inputs.y0, ct, back)
                back = back._replace(t0=back.t0 + ct_t)
        return back

    def state(self, back: _Back) -> tuple[Any, Any]:
        """The state before a step, and the states of the steps between that and the last one that is stored."""
        k, every, states = back.k, self.how.every, back.states
        if states is None:
            return self.stored(k), None
        start = k // every * every
        unknown = (k == self.count - 1) | ((k + 1) % every == 0)

        def again(carry: Any) -> Any:
            j, state, states = carry
            states = jtu.tree_map(lambda x, xs: xs.at[j - start].set(x), state, states)
            return j + 1, self.made_again(j, state), states

        *_, states = lax.while_loop(lambda carry: unknown & (carry[0] <= k), again, (start, self.stored(k), states))
        return jtu.tree_map(lambda xs: xs[k - start], states), states

    def over_step(self, back: _Back) -> _Back:
        """From the end of a step to its start."""
        k = back.k
        ends, jump = self.times(k)
        state, states = self.state(back)
        began, rest = eqx.partition(state, eqx.is_inexact_array)
        (y, _, dense), pull, others = jax.vjp(
            partial(self.advance, rest, jump), began, ends, self.numbers, has_aux=True
        )
        pulled_ends = jtu.tree_map(jnp.zeros_like, ends)
        for i, (_, _, every_row) in enumerate(self.how.subs):
            if every_row == 0:
                continue
            kept = (k + 1) % every_row == 0
            back.saved[i] = back.saved[i] - kept
            if self.rows[i] is not None:
                after = eqx.combine(y, others[0])
                ct_t, back = self.pull_value(i, ends[1], after, self.row(i, back.saved[i], kept), back)
                pulled_ends = (pulled_ends[0], pulled_ends[1] + ct_t)
        stored = self.dense
        ct_dense = jtu.tree_map(jnp.zeros_like, dense) if stored is None else jtu.tree_map(lambda x: x[k], stored)
        numbers = back.numbers
        for i, times in enumerate(self.inputs.times):
            if times is None or self.rows[i] is None:
                continue
            pulled = _Pulled(back.saved[i], back.timed[i], ct_dense, pulled_ends, numbers, back.times[i])
            over_time = partial(self.over_time, i, others[2], (dense, ends))
            pulled = lax.while_loop(partial(self.inside, i, ends[0], k), over_time, pulled)
            ct_dense, pulled_ends, numbers = pulled.dense, pulled.ends, pulled.numbers
            back.saved[i], back.timed[i], back.times[i] = pulled.saved, pulled.timed, pulled.times
        ct_began, ct_ends, more = pull((*back.began, ct_dense))
        (start, end), by_run = _add(ct_ends, pulled_ends), self.ends_by_run(k, ends)
        return back._replace(
            k=k - 1,
            began=ct_began,
            states=states,
            numbers=_add(numbers, more),
            t0=back.t0 + by_run[0][0] * start + by_run[1][0] * end,
            t1=back.t1 + by_run[0][1] * start + by_run[1][1] * end,
        )

    def inside(self, i: int, t0: Array, k: Array, pulled: _Pulled) -> Array:
        """Whether the saved time before lies in this step."""
        t = self.inputs.times[i][jnp.maximum(pulled.timed - 1, 0)]
        return (pulled.timed > 0) & ((t > t0) | (k == 0))

    def over_time(self, i: int, rest: PyTree, step: Any, pulled: _Pulled) -> _Pulled:
        """Cotangents of one saved time."""
        saved, timed = pulled.saved - 1, pulled.timed - 1
        ct, ct_time = self.row(i, saved)
        _, pull = jax.vjp(partial(self.at_time, i, rest), self.inputs.times[i][timed], *step, self.numbers)
        ct_t, ct_dense, ct_ends, more = pull(ct)
        return _Pulled(
            saved,
            timed,
            _add(pulled.dense, ct_dense),
            _add(pulled.ends, ct_ends),
            _add(pulled.numbers, more),
            pulled.times.at[timed].add(ct_t + ct_time),
        )


def _is_none(x: Any) -> bool:
    return x is None


def _numbers(tree: PyTree) -> PyTree:
    return eqx.filter(tree, eqx.is_inexact_array)


def _filled(change: PyTree, like: PyTree) -> PyTree:
    """Derivatives or cotangents with zeros in place of None."""

    def fill(x: Any, d: Any) -> Any:
        return x if x is None else jnp.zeros_like(x) if d is None else d

    like = _numbers(like)
    if not jtu.tree_leaves(change):
        return jtu.tree_map(jnp.zeros_like, like)
    return jtu.tree_map(fill, like, change, is_leaf=_is_none)


def _add(a: PyTree, b: PyTree) -> PyTree:
    return jtu.tree_map(jnp.add, a, b)


def _set(buffers: PyTree, at: Array, entries: PyTree, pred: Any) -> PyTree:
    return jtu.tree_map(lambda x, xs: eqxi.buffer_at_set(xs, at, x, pred=pred), entries, buffers)


def _column(mask: Array, like: Array) -> Array:
    """`mask` of the entries of `like`, along its first axis."""
    return jnp.expand_dims(mask, tuple(range(1, like.ndim)))


_run_p = _primitive("run", _make, _make_jvp, _make_transpose)
_change_p = _primitive("change_of_run", _change, _change_jvp, _change_transpose)
