"""The derivative of a run from its accepted steps, in both modes."""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax import lax
from jaxtyping import Array, Int, PyTree

from .._core.compat import eqxi, lax_loop


class StepPlan(NamedTuple):
    """Properties of a run that are known while compiling."""

    interpolation_cls: Callable[..., dfx.AbstractPath]
    # Of each `SubSaveAt`: t0, t1 and steps.
    subs: list[tuple[bool, bool, int]]
    # Whether the solver receives a flag for jumps.
    jumps: bool
    # Whether the steps are constant, so that their times move with the ends of the run.
    even: bool
    every: int


class StepInputs(NamedTuple):
    """Inputs of a run that have derivatives."""

    step: Callable[..., PyTree]
    # For each `SubSaveAt` its function and its times.
    fns: list[Callable[[Array, PyTree], PyTree]]
    times: list[PyTree]
    t0: Array
    t1: Array
    y0: PyTree
    solver_state: PyTree


class StepRecord(NamedTuple):
    """Start of an accepted step, or of an array of them."""

    t0: Array
    t1: Array
    made_jump: PyTree
    # y and the solver's state, for the steps whose state is stored.
    began: tuple[PyTree, PyTree]


class RecordedRun(NamedTuple):
    """A finished run."""

    inputs: StepInputs
    final: PyTree
    steps: StepRecord
    how: StepPlan


class RunTangents(NamedTuple):
    """Derivatives or cotangents of the outputs of a run. None is zero."""

    y: PyTree
    solver_state: PyTree
    # For each `SubSaveAt` values and times.
    saved: list[tuple[PyTree, PyTree]]
    dense_infos: PyTree
    # Those of the steps, if these have derivatives, too.
    steps: StepRecord | None


class AbstractOverSteps:
    """The part that both modes share: parts of a run as functions of the differentiated numbers."""

    def __init__(self, by: StepInputs, run: RecordedRun):
        self.inputs, self.final, self.steps, self.how = run
        # Of the step and of the functions of `SaveAt`.
        self.numbers, self.constants = split(by[:2], run.inputs[:2])
        self.count = jnp.asarray(run.final.num_accepted_steps)
        self.saves = [x for x in jtu.tree_leaves(run.final.save_state, is_leaf=is_save_state) if is_save_state(x)]

    def times(self, k: Array) -> tuple[tuple[Array, Array], bool | Array]:
        """Ends of a step, and whether there was a jump before it."""
        t0, t1, jump = jtu.tree_map(lambda x: x[k], self.steps[:3])
        return (t0, t1), jump if self.how.jumps else False

    def stored(self, k: Array) -> tuple[PyTree, PyTree]:
        """The stored state of this step, or of the last stored step before it."""
        return jtu.tree_map(lambda x: x[k // self.how.every], self.steps.began)

    def ends_by_run(self, k: Array, ends: tuple[Array, Array]) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
        """Derivatives of each end of a step with respect to t0 and t1 of the run."""
        t0, t1 = self.inputs.t0, self.inputs.t1
        if self.how.even:  # the first step has the length dt0, the others divide the run evenly
            part = lambda j, t: (t - t0) / (t1 - t0) * ((j != 1) | (t == t1))  # noqa: E731
            start, end = part(k, ends[0]), part(k + 1, ends[1])
            return (1.0 - start, start), (1.0 - end, end)
        last, zero = (k == self.count - 1) & (ends[1] == t1), jnp.zeros_like(t0)
        return (jnp.where(k == 0, 1.0, zero), zero), (zero, jnp.where(last, 1.0, zero))

    def advance(
        self, rest: PyTree, jump: bool | Array, began: PyTree, ends: tuple[Array, Array], numbers: PyTree
    ) -> PyTree:
        """One step: floating arrays of state, solver's state and dense output, and the rest of these."""
        step, (y, state) = eqx.combine(numbers[0], self.constants[0]), eqx.combine(began, rest)
        y, _, dense, state, _ = step(*ends, y, state, jump)
        return eqx.partition((y, state, dense), eqx.is_inexact_array)

    def made_again(self, k: Array, began: tuple[PyTree, PyTree]) -> tuple[PyTree, PyTree]:
        """State and solver's state after a step."""
        ends, jump = self.times(k)
        y, _, _, state, _ = self.inputs.step(*ends, *began, jump)
        return y, state

    def value(self, i: int, t: Array, y: PyTree, rest: PyTree, numbers: PyTree) -> PyTree:
        """The value that the i-th `SubSaveAt` saves of a state."""
        fn = eqx.combine(numbers[1][i], self.constants[1][i])
        return _numbers(fn(t, eqx.combine(y, rest)))

    def at_time(
        self, i: int, rest: PyTree, t: Array, dense: PyTree, ends: tuple[Array, Array], numbers: PyTree
    ) -> PyTree:
        """The value that it saves at a time within a step."""
        y = self.how.interpolation_cls(t0=ends[0], t1=ends[1], **eqx.combine(dense, rest)).evaluate(t)
        return self.value(i, t, *eqx.partition(y, eqx.is_inexact_array), numbers)

    def at_the_end(self, i: int) -> tuple[Array, Array]:
        """Whether the i-th `SubSaveAt` saves the last state at t1, and whether the run has no length.

        A run of no length makes no step, and saves all times of `ts` at its end.
        """
        (_, t1, steps), times = self.how.subs[i], self.inputs.times[i]
        last = jnp.asarray(t1 and steps != 1)
        if steps > 1:
            last &= self.count % steps != 0
        return last, (self.inputs.t0 == self.inputs.t1) & (times is not None)

    def rows_at_once(self, i: int, empty: Array) -> Array:
        """Which entries are the times of `ts` in a run of no length."""
        size, t0, times = self.saves[i].ts.shape[0], self.how.subs[i][0], self.inputs.times[i]
        at = jnp.arange(size) - t0
        return empty & (at >= 0) & (at < (0 if times is None else times.shape[0]))


class _Ahead(NamedTuple):
    """State of forward mode: derivatives of the state before the step `k`, and of the rows saved so far."""

    k: Int[Array, ""]
    began: tuple[PyTree, PyTree]
    # The state itself, unless every state is stored.
    state: PyTree
    # For each `SubSaveAt` the number of saved rows, the number of times of `ts` among them, and their derivatives.
    saved: list[Int[Array, ""]]
    timed: list[Int[Array, ""]]
    rows: list[tuple[PyTree, Array]]
    dense: PyTree
    steps: StepRecord | None


class ForwardOverSteps(AbstractOverSteps):
    """The derivative of a run, from the first step to the last."""

    def __init__(self, by: StepInputs, run: RecordedRun, keeps: bool):
        super().__init__(by, run)
        self.by, self.keeps = by, keeps
        self.d_t0, self.d_t1 = filled(by.t0, run.inputs.t0), filled(by.t1, run.inputs.t1)
        self.d_times = [filled(d, t) for d, t in zip(by.times, run.inputs.times, strict=True)]

    def result(self) -> RunTangents:
        """Derivatives of the outputs of the run."""
        ahead = lax_loop(
            lambda ahead: ahead.k < self.count,
            self.over_step,
            self.before_the_run(),
            max_steps=None,
            buffers=lambda ahead: (ahead.rows, ahead.dense, ahead.steps),
        )
        y, solver_state = ahead.began
        return RunTangents(y, solver_state, self.after_the_run(ahead), ahead.dense, ahead.steps)

    def write(self, rows: PyTree, i: int, at: Array, pred: PyTree, of: PyTree, change: PyTree) -> PyTree:
        """`rows` with the derivative of the value that the i-th `SubSaveAt` saves of time and state, if `pred`."""
        y, rest = eqx.partition(of[1], eqx.is_inexact_array)
        value = lambda t, y, n: self.value(i, t, y, rest, n)  # noqa: E731
        _, row = jax.jvp(value, (of[0], y, self.numbers), (*change, self.by[:2]))
        return _set(rows, at, (row, change[0]), pred)

    def before_the_run(self) -> _Ahead:
        """Derivatives of the first state, and of the rows saved at t0."""
        inputs, began = self.inputs, (self.inputs.y0, self.inputs.solver_state)
        d_began = filled((self.by.y0, self.by.solver_state), began)
        rows = [jtu.tree_map(jnp.zeros_like, (_numbers(save.ys), save.ts)) for save in self.saves]
        for i, (t0, _, _) in enumerate(self.how.subs):
            if t0:
                rows[i] = self.write(rows[i], i, jnp.asarray(0), True, (inputs.t0, inputs.y0), (self.d_t0, d_began[0]))
        return _Ahead(
            jnp.asarray(0),
            d_began,
            began if self.how.every > 1 else None,
            [jnp.asarray(int(t0)) for t0, _, _ in self.how.subs],
            [jnp.asarray(0) for _ in self.how.subs],
            rows,
            jtu.tree_map(jnp.zeros_like, _numbers(self.final.dense_infos)),
            jtu.tree_map(jnp.zeros_like, _numbers(self.steps)) if self.keeps else None,
        )

    def over_step(self, ahead: _Ahead) -> _Ahead:
        """Derivatives from the start of a step to its end."""
        k, every = ahead.k, self.how.every
        ends, jump = self.times(k)
        state = self.stored(k)
        if every > 1:
            state = jtu.tree_map(lambda a, b: jnp.where(k % every == 0, a, b), state, ahead.state)
        began, rest = eqx.partition(state, eqx.is_inexact_array)
        d_ends = tuple(by_t0 * self.d_t0 + by_t1 * self.d_t1 for by_t0, by_t1 in self.ends_by_run(k, ends))
        (y, state, dense), (d_y, d_state, d_dense), others = jax.jvp(
            partial(self.advance, rest, jump),
            (began, ends, self.numbers),
            (ahead.began, d_ends, self.by[:2]),
            has_aux=True,
        )
        for i, (_, _, every_row) in enumerate(self.how.subs):
            if self.inputs.times[i] is not None:
                over_time = partial(self.over_time, i, others[2], (dense, ends), (d_dense, d_ends))
                ahead.saved[i], ahead.timed[i], ahead.rows[i] = lax_loop(
                    partial(self.inside, i, ends[1]),
                    over_time,
                    (ahead.saved[i], ahead.timed[i], ahead.rows[i]),
                    max_steps=None,
                    buffers=lambda carry: carry[2],
                )
            if every_row:
                at, kept, after = ahead.saved[i], (k + 1) % every_row == 0, eqx.combine(y, others[0])
                ahead.rows[i] = self.write(ahead.rows[i], i, at, kept, (ends[1], after), (d_ends[1], d_y))
                ahead.saved[i] = at + kept
        steps = ahead.steps
        if steps is not None:
            began = _set(steps.began, k // every, ahead.began, k % every == 0)
            t0, t1 = _set(steps[:2], k, d_ends, True)
            steps = StepRecord(t0, t1, None, began)
        return ahead._replace(
            k=k + 1,
            began=(d_y, d_state),
            state=None if ahead.state is None else eqx.combine((y, state), others[:2]),
            dense=_set(ahead.dense, k, d_dense, True) if self.final.dense_infos is not None else ahead.dense,
            steps=steps,
        )

    def inside(self, i: int, t1: Array, carry: PyTree) -> Array:
        """Whether the next saved time lies in this step."""
        times, timed = self.inputs.times[i], carry[1]
        return (timed < times.shape[0]) & (times[timed] <= t1)

    def over_time(self, i: int, rest: PyTree, step: PyTree, d_step: PyTree, carry: PyTree) -> PyTree:
        """The derivative at one saved time."""
        saved, timed, rows = carry
        t, d_t = self.inputs.times[i][timed], self.d_times[i][timed]
        _, row = jax.jvp(partial(self.at_time, i, rest), (t, *step, self.numbers), (d_t, *d_step, self.by[:2]))
        return saved + 1, timed + 1, _set(rows, saved, (row, d_t), True)

    def after_the_run(self, ahead: _Ahead) -> list[tuple[PyTree, Array]]:
        """Derivatives of all saved rows."""
        final, (d_y, _), rows = self.final, ahead.began, ahead.rows
        d_t = jnp.where(final.tprev == self.inputs.t1, self.d_t1, 0.0)
        for i, (_, t1, every_row) in enumerate(self.how.subs):
            (last, empty), times = self.at_the_end(i), self.inputs.times[i]
            if times is not None:
                one = jtu.tree_map(jnp.zeros_like, jtu.tree_map(lambda x: x[:1], rows[i]))
                one = self.write(one, i, jnp.asarray(0), True, (final.tprev, final.y), (d_t, d_y))
                at_once = self.rows_at_once(i, empty)
                rows[i] = jtu.tree_map(lambda x, one: jnp.where(_column(at_once, x), one, x), rows[i], one)  # noqa: B023
                ahead.saved[i] = ahead.saved[i] + jnp.where(empty, times.shape[0], 0)
            if t1 and every_row != 1:
                rows[i] = self.write(rows[i], i, ahead.saved[i], last, (final.tprev, final.y), (d_t, d_y))
        return rows


class _Back(NamedTuple):
    """State of reverse mode: cotangents of the state after the step `k` and of constants, and the rows that remain."""

    k: Int[Array, ""]
    began: tuple[PyTree, PyTree]
    # The repeated states of the last block of steps, unless every state is stored.
    states: PyTree
    numbers: PyTree
    t0: Array
    t1: Array
    # For the times of each `SubSaveAt`; None without.
    times: list[PyTree]
    # For each `SubSaveAt` the number of rows that remain, and of times of `ts` among them.
    saved: list[Int[Array, ""]]
    timed: list[Int[Array, ""]]


class _Pulled(NamedTuple):
    """Cotangents to which saved times add: of the dense output of a step, of its ends, and of the numbers."""

    saved: Int[Array, ""]
    timed: Int[Array, ""]
    dense: PyTree
    ends: tuple[Array, Array]
    numbers: PyTree
    times: Array


class ReverseOverSteps(AbstractOverSteps):
    """The derivative of a run, from the last step to the first."""

    def __init__(self, by: StepInputs, run: RecordedRun, cts: RunTangents):
        super().__init__(by, run)
        self.by, self.cts = by, cts
        # Cotangents of the values and times of each `SubSaveAt`; None if nothing depends on them.
        self.rows = [
            filled(ct, (kept.ys, kept.ts)) if jtu.tree_leaves(ct) else None
            for ct, kept in zip(cts.saved, self.saves, strict=True)
        ]
        self.dense = filled(cts.dense_infos, run.final.dense_infos) if jtu.tree_leaves(cts.dense_infos) else None

    def result(self) -> StepInputs:
        """Cotangents of the inputs."""
        back = lax.while_loop(lambda back: back.k >= 0, self.over_step, self.after_the_run())
        back = self.before_the_run(back)
        step, fns = back.numbers
        cts = StepInputs(step, fns, back.times, back.t0, back.t1, *back.began)
        return jtu.tree_map(lambda asked, ct: None if asked is None else ct, self.by, cts, is_leaf=is_none)

    def row(self, i: int, index: Array, where: bool | Array = True) -> PyTree:
        """Cotangents of the values and the time of one row; zero unless `where`."""
        return jtu.tree_map(lambda c: jnp.where(where, c[index], 0.0), self.rows[i])

    def pull_value(self, i: int, t: Array, y: PyTree, ct: tuple[PyTree, Array], back: _Back) -> tuple[Array, _Back]:
        """Cotangent of the time of a row; those of state and numbers are added to `back`."""
        y, rest = eqx.partition(y, eqx.is_inexact_array)
        _, pull = jax.vjp(lambda t, y, n: self.value(i, t, y, rest, n), t, y, self.numbers)
        ct_t, ct_y, more = pull(ct[0])
        began = (_add(back.began[0], ct_y), back.began[1])
        return ct_t + ct[1], back._replace(began=began, numbers=_add(back.numbers, more))

    def after_the_run(self) -> _Back:
        """Cotangents of the last state, from its own and from the rows saved at the end."""
        final, (t0, t1), cts = self.final, (self.inputs.t0, self.inputs.t1), self.cts
        first, every = (self.inputs.y0, self.inputs.solver_state), self.how.every
        back = _Back(
            self.count - 1,
            filled((cts.y, cts.solver_state), (final.y, final.solver_state)),
            empty_buffers(first, every) if every > 1 else None,
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
            # With `steps` above 1 diffrax counts a row at t1 in any case, and writes it only if it is the last one.
            count, rows, times = back.saved[i] - (last | (every_row > 1)), self.rows[i], self.inputs.times[i]
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
        """Cotangents of the first state, with those of the rows saved at t0."""
        for i, (t0, _, _) in enumerate(self.how.subs):
            if t0 and self.rows[i] is not None:
                ct = self.row(i, jnp.asarray(0))
                ct_t, back = self.pull_value(i, self.inputs.t0, self.inputs.y0, ct, back)
                back = back._replace(t0=back.t0 + ct_t)
        return back

    def state(self, back: _Back) -> tuple[PyTree, PyTree]:
        """The state before a step, and the states of the steps from the last stored one to that."""
        k, every, states = back.k, self.how.every, back.states
        if states is None:
            return self.stored(k), None
        start = k // every * every
        unknown = (k == self.count - 1) | ((k + 1) % every == 0)

        def again(carry: PyTree) -> PyTree:
            j, state, states = carry
            states = jtu.tree_map(lambda x, xs: xs.at[j - start].set(x), state, states)
            return j + 1, self.made_again(j, state), states

        *_, states = lax.while_loop(lambda carry: unknown & (carry[0] <= k), again, (start, self.stored(k), states))
        return jtu.tree_map(lambda xs: xs[k - start], states), states

    def over_step(self, back: _Back) -> _Back:
        """Cotangents from the end of a step to its start."""
        k = back.k
        (ends, jump), (state, states) = self.times(k), self.state(back)
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

    def over_time(self, i: int, rest: PyTree, step: PyTree, pulled: _Pulled) -> _Pulled:
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


def is_none(x: object) -> bool:
    return x is None


def _numbers(tree: PyTree) -> PyTree:
    return eqx.filter(tree, eqx.is_inexact_array)


def split(by: PyTree, program: PyTree) -> tuple[PyTree, PyTree]:
    """The numbers of a program by which it is differentiated, None elsewhere, and the rest."""
    return eqx.partition(program, jtu.tree_map(lambda d, _: d is not None, by, program, is_leaf=is_none))


def filled(change: PyTree, like: PyTree) -> PyTree:
    """Derivatives or cotangents with zeros in place of None."""

    def fill(x: PyTree, d: PyTree) -> PyTree:
        return x if x is None else jnp.zeros_like(x) if d is None else d

    like = _numbers(like)
    if not jtu.tree_leaves(change):
        return jtu.tree_map(jnp.zeros_like, like)
    return jtu.tree_map(fill, like, change, is_leaf=is_none)


def _add(a: PyTree, b: PyTree) -> PyTree:
    return jtu.tree_map(jnp.add, a, b)


def _set(buffers: PyTree, at: Array, entries: PyTree, pred: PyTree) -> PyTree:
    return jtu.tree_map(lambda x, xs: eqxi.buffer_at_set(xs, at, x, pred=pred), entries, buffers)


def _column(mask: Array, like: Array) -> Array:
    """`mask` of the entries of `like`, along its first axis."""
    return jnp.expand_dims(mask, tuple(range(1, like.ndim)))


def empty_buffers(tree: PyTree, size: int) -> PyTree:
    return jtu.tree_map(lambda x: jnp.zeros((size, *jnp.shape(x)), jnp.result_type(x)), tree)


def is_save_state(x: object) -> bool:
    return hasattr(x, "saveat_ts_index")
