"""Reverse mode from the steps that were made."""

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
from jaxtyping import Array, Float, Int, PyTree


class StoredSteps(dfx.AbstractAdjoint):
    """Reverse mode from the steps that were made, each differentiated once, from the last to the first.

    The run keeps what every accepted step began with, and the derivative goes back over `jax.vjp` of these steps.
    Nothing is computed a second time in another order, so rounding, which events and error control would enlarge,
    does not enter: the derivative is that of the run, to rounding, at any tolerance. The times of the steps, and with
    them the work of the step size controller, count as constants. Rejected steps cost nothing.

    Derivatives hold by the initial state, by everything in `args`, terms and solver, by `t0`, `t1`, the times in
    `SaveAt(ts=...)`, and by what its functions close over. A run that ended early gives the derivative of the part that
    was integrated.

    Memory: `max_steps` times the size of the state and of the solver's state.

    **Raises:**

    - `ValueError` for `max_steps=None`, and for diffrax's own terminating `event`.
    """

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
        y0 = init_state.y
        subs = _subs(saveat)
        # What the functions close over may be differentiated: it becomes leaves.
        fns = [eqx.filter_closure_convert(sub.fn, t0, y0, args) for sub in subs]
        times = [sub.ts for sub in subs]
        inputs = _Inputs(terms, solver, args, fns, times, t0, t1, y0, init_state.solver_state)
        fixed = _Fixed(stepsize_controller, saveat, dt0, progress_meter, init_state, max_steps, self._loop)
        numbers, rest = eqx.partition(fixed, eqx.is_inexact_array)
        final = _run(inputs, eqx.combine(lax.stop_gradient(numbers), rest))
        return jtu.tree_map(lambda x: x if eqx.is_inexact_array(x) else _without_tangent(x), final), {}


class _Inputs(NamedTuple):
    """What a run is differentiated by."""

    terms: PyTree
    solver: Any
    args: PyTree
    # Of each `SubSaveAt`, its function and its times.
    fns: list[PyTree]
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
    progress_meter: Any
    state: Any
    max_steps: int
    loop: Callable[..., Any]


class _Step(NamedTuple):
    """What an accepted step began with."""

    t0: Array
    t1: Array
    made_jump: Any
    y: PyTree
    solver_state: PyTree


def _without_tangent(x: Any) -> Any:
    """Integers and booleans as they are: JAX gives those that a rule of its own returns tangents, on which fails what
    has no derivative, such as diffrax's test of the result.
    """
    return lax.bitwise_or(x, jnp.zeros_like(x)) if eqx.is_array(x) else x


def _is_sub(x: Any) -> bool:
    return isinstance(x, dfx.SubSaveAt)


def _subs(saveat: Any) -> list[Any]:
    return [sub for sub in jtu.tree_leaves(saveat.subs, is_leaf=_is_sub) if _is_sub(sub)]


_lax_loop = partial(eqxi.while_loop, kind="lax")


def _solve(inputs: _Inputs, fixed: _Fixed, keeps: bool) -> tuple[Any, _Step | None, bool]:
    """The final state of diffrax's loop, the steps, shape `[max_steps, ...]`, if wanted, and whether any jumps."""
    steps, jumps = [], []

    def outer(cond: Any, body: Any, init: Any, *, max_steps: int, buffers: Any) -> Any:
        if not keeps:
            return _lax_loop(cond, body, init, max_steps=max_steps, buffers=buffers)
        empty = jtu.tree_map(lambda x: jnp.zeros((max_steps, *jnp.shape(x)), jnp.result_type(x)), _began(init))

        def step(carry: Any) -> Any:
            state, kept = carry
            at, after = state.num_accepted_steps, body(state)
            # diffrax keeps it a Python boolean where the controller never tells of a jump.
            jumps.append(not isinstance(after.made_jump, bool))
            return after, jtu.tree_map(lambda x, kept: kept.at[at].set(x), _began(state), kept)

        final, kept = _lax_loop(
            lambda carry: cond(carry[0]),
            step,
            (init, empty),
            max_steps=max_steps,
            buffers=lambda carry: (buffers(carry[0]), carry[1]),
        )
        steps.append(kept)
        return final

    def inner(cond: Any, body: Any, init: Any, max_steps: int, buffers: Any, checkpoints: int) -> Any:
        del checkpoints
        return _lax_loop(cond, body, init, max_steps=max_steps, buffers=buffers)

    state = eqx.tree_at(
        lambda s: (s.y, s.solver_state), fixed.state, (inputs.y0, inputs.solver_state), is_leaf=lambda x: x is None
    )
    final, _ = fixed.loop(
        args=inputs.args,
        terms=inputs.terms,
        solver=inputs.solver,
        stepsize_controller=fixed.controller,
        event=None,
        saveat=_saveat(inputs, fixed),
        t0=inputs.t0,
        t1=inputs.t1,
        dt0=fixed.dt0,
        max_steps=fixed.max_steps,
        init_state=state,
        inner_while_loop=inner,
        outer_while_loop=outer,
        progress_meter=fixed.progress_meter,
    )
    return final, steps[0] if keeps else None, any(jumps)


def _saveat(inputs: _Inputs, fixed: _Fixed) -> Any:
    """With the functions and times that are differentiated."""
    each = iter(zip(inputs.fns, inputs.times, strict=True))

    def put(sub: dfx.SubSaveAt) -> dfx.SubSaveAt:
        fn, times = next(each)
        sub = eqx.tree_at(lambda s: s.fn, sub, fn)
        return sub if times is None else eqx.tree_at(lambda s: s.ts, sub, times)

    return eqx.tree_at(lambda s: s.subs, fixed.saveat, jtu.tree_map(put, fixed.saveat.subs, is_leaf=_is_sub))


def _began(state: Any) -> _Step:
    return _Step(state.tprev, state.tnext, jnp.asarray(state.made_jump), state.y, state.solver_state)


@eqx.filter_custom_vjp
def _run(inputs: _Inputs, fixed: _Fixed) -> Any:
    return _solve(inputs, fixed, False)[0]


class _Known:
    """What is known while compiling: which inputs are differentiated, and whether the solver is told of jumps.

    A leaf that is no array; residuals of other kinds would become arrays.
    """

    def __init__(self, perturbed: _Inputs, jumps: bool):
        self.perturbed, self.jumps = perturbed, jumps


@_run.def_fwd
def _(perturbed: _Inputs, inputs: _Inputs, fixed: _Fixed) -> tuple[Any, Any]:
    final, steps, jumps = _solve(inputs, fixed, True)
    return final, (final, steps, _Known(perturbed, jumps))


@_run.def_bwd
def _(residuals: Any, ct: Any, perturbed: Any, inputs: _Inputs, fixed: _Fixed) -> _Inputs:
    final, steps, known = residuals
    del perturbed
    return _WayBack(inputs, known, fixed, final, steps, ct).result()


class _Numbers(NamedTuple):
    """What cotangents are summed for: the differentiated leaves, None elsewhere."""

    terms: PyTree
    solver: PyTree
    args: PyTree
    fns: list[PyTree]


class _Carry(NamedTuple):
    """Cotangents on the way back, of the state after the step `k` and of what does not change, and what is left."""

    k: Int[Array, ""]
    y: PyTree
    solver_state: PyTree
    numbers: _Numbers
    t0: Float[Array, ""]
    t1: Float[Array, ""]
    # By the times of each `SubSaveAt`; None where it has none.
    ts: list[Any]
    # Values kept by each `SubSaveAt`, and how many of its own times among them, that are not treated yet.
    saved: list[Int[Array, ""]]
    timed: list[Int[Array, ""]]


class _Pulled(NamedTuple):
    """Cotangents that one saved time adds: of the dense output of its step, the ends of that, and the numbers."""

    saved: Int[Array, ""]
    timed: Int[Array, ""]
    dense: PyTree
    ends: tuple[Array, Array]
    numbers: _Numbers
    ts: Any


class _WayBack:
    """The derivative of a run from its steps."""

    def __init__(self, inputs: _Inputs, known: _Known, fixed: _Fixed, final: Any, steps: _Step, ct: Any):
        self.inputs, self.jumps, self.final, self.steps, self.ct = inputs, known.jumps, final, steps, ct
        self.subs = _subs(fixed.saveat)
        self.numbers, self.constants = eqx.partition(_Numbers(*inputs[:4]), _Numbers(*known.perturbed[:4]))
        self.kept, cts = _save_states(final), _save_states(ct)
        # Cotangents of values and times that each `SubSaveAt` kept; None where nothing of it is differentiated.
        self.cts = [
            (_filled(c.ys, kept.ys), _filled(c.ts, kept.ts)) if jtu.tree_leaves((c.ys, c.ts)) else None
            for c, kept in zip(cts, self.kept, strict=True)
        ]
        infos = ct.dense_infos
        self.ct_infos = _filled(infos, final.dense_infos) if jtu.tree_leaves(infos) else None

    def result(self) -> _Inputs:
        """Cotangents of the inputs."""
        carry = self.after_the_run()
        carry = lax.while_loop(lambda carry: carry.k >= 0, self.over_step, carry)
        carry = self.before_the_run(carry)
        return _Inputs(*carry.numbers, carry.ts, carry.t0, carry.t1, carry.y, carry.solver_state)

    def asks(self, i: int) -> bool:
        """Whether anything that the i-th `SubSaveAt` keeps is differentiated."""
        return self.cts[i] is not None

    def row(self, i: int, index: Array) -> tuple[PyTree, Array]:
        """Cotangents of one entry, of values and time."""
        return jtu.tree_map(lambda c: c[index], self.cts[i])

    def value(self, i: int, t: Array, y: PyTree, numbers: _Numbers) -> PyTree:
        """What the i-th `SubSaveAt` keeps of a state."""
        every = eqx.combine(numbers, self.constants)
        return _numbers(every.fns[i](t, y, every.args))

    def pull_value(self, i: int, t: Array, y: PyTree, ct: tuple[PyTree, Array], numbers: _Numbers) -> Any:
        """Cotangents of time, state and numbers, the last added to `numbers`."""
        y, rest = eqx.partition(y, eqx.is_inexact_array)
        _, pull = jax.vjp(lambda t, y, n: self.value(i, t, eqx.combine(y, rest), n), t, y, self.numbers)
        ct_t, ct_y, more = pull(ct[0])
        return ct_t + ct[1], ct_y, _add(numbers, more)

    def after_the_run(self) -> _Carry:
        """Cotangents of the last state, from that and from what was kept at the end."""
        final, (t0, t1) = self.final, (self.inputs.t0, self.inputs.t1)
        carry = _Carry(
            jnp.asarray(final.num_accepted_steps) - 1,
            _filled(self.ct.y, final.y),
            _filled(self.ct.solver_state, final.solver_state),
            jtu.tree_map(jnp.zeros_like, self.numbers),
            jnp.zeros_like(t0),
            jnp.zeros_like(t1),
            jtu.tree_map(jnp.zeros_like, self.inputs.times),
            [jnp.asarray(each.save_index) for each in self.kept],
            [jnp.asarray(each.saveat_ts_index) for each in self.kept],
        )
        reached = final.tprev == t1
        for i, sub in enumerate(self.subs):
            last = jnp.asarray(sub.t1 and sub.steps != 1)
            if sub.steps > 1:
                last &= final.num_accepted_steps % sub.steps != 0
            count, empty = carry.saved[i] - last, (t0 == t1) & (sub.ts is not None)
            if self.asks(i) and (sub.ts is not None or (sub.t1 and sub.steps != 1)):
                ct = jtu.tree_map(lambda c: jnp.where(last, c, 0.0), self.row(i, count))  # noqa: B023
                if sub.ts is not None:  # a run of no length keeps all of its times at once, and makes no step
                    at_once = jnp.arange(self.kept[i].ts.shape[0]) - sub.t0
                    at_once = empty & (at_once >= 0) & (at_once < sub.ts.shape[0])
                    rows = jax.vmap(partial(self.row, i))(jnp.arange(self.kept[i].ts.shape[0]))
                    ct = _add(ct, jtu.tree_map(lambda c: _weighted(at_once, c), rows))  # noqa: B023
                ct_t, ct_y, numbers = self.pull_value(i, final.tprev, final.y, ct, carry.numbers)
                carry = carry._replace(
                    y=_add(carry.y, ct_y), numbers=numbers, t1=carry.t1 + jnp.where(reached, ct_t, 0.0)
                )
            carry.saved[i] = count
            carry.timed[i] = jnp.where(empty, 0, carry.timed[i])
        return carry

    def before_the_run(self, carry: _Carry) -> _Carry:
        """With the cotangents of what was kept at t0."""
        for i, sub in enumerate(self.subs):
            if sub.t0 and self.asks(i):
                ct = self.row(i, jnp.asarray(0))
                ct_t, ct_y, numbers = self.pull_value(i, self.inputs.t0, self.inputs.y0, ct, carry.numbers)
                carry = carry._replace(y=_add(carry.y, ct_y), numbers=numbers, t0=carry.t0 + ct_t)
        return carry

    def over_step(self, carry: _Carry) -> _Carry:
        """From the end of a step to its start."""
        k, step = carry.k, jtu.tree_map(lambda x: x[carry.k], self.steps)
        began, rest = eqx.partition((step.y, step.solver_state), eqx.is_inexact_array)
        jump = step.made_jump if self.jumps else False

        def advance(began: Any, ends: tuple[Array, Array], numbers: _Numbers) -> Any:
            every, (y, state) = eqx.combine(numbers, self.constants), eqx.combine(began, rest)
            y, _, dense, state, _ = every.solver.step(every.terms, *ends, y, every.args, state, jump)
            numbers, others = eqx.partition((y, state, dense), eqx.is_inexact_array)
            return numbers, others

        ends = (step.t0, step.t1)
        (y, _, dense), pull, others = jax.vjp(advance, began, ends, self.numbers, has_aux=True)
        last = (k == self.final.num_accepted_steps - 1) & (step.t1 == self.inputs.t1)
        for i, sub in enumerate(self.subs):
            if sub.steps == 0:
                continue
            kept = (k + 1) % sub.steps == 0
            carry.saved[i] = carry.saved[i] - kept
            if self.asks(i):
                ct = jtu.tree_map(lambda c: jnp.where(kept, c, 0.0), self.row(i, carry.saved[i]))  # noqa: B023
                after = eqx.combine(y, others[0])
                ct_t, ct_y, numbers = self.pull_value(i, step.t1, after, ct, carry.numbers)
                carry = carry._replace(y=_add(carry.y, ct_y), numbers=numbers, t1=carry.t1 + jnp.where(last, ct_t, 0.0))
        no_dense = self.ct_infos is None
        ct_dense = jtu.tree_map(jnp.zeros_like, dense) if no_dense else jtu.tree_map(lambda x: x[k], self.ct_infos)
        pulled_ends = jtu.tree_map(jnp.zeros_like, ends)
        numbers = carry.numbers
        for i, sub in enumerate(self.subs):
            if sub.ts is None or not self.asks(i):
                continue
            pulled = _Pulled(carry.saved[i], carry.timed[i], ct_dense, pulled_ends, numbers, carry.ts[i])
            inside = partial(self._inside, i, step, k)
            pulled = lax.while_loop(inside, partial(self._over_time, i, step, (dense, others[2])), pulled)
            ct_dense, pulled_ends, numbers = pulled.dense, pulled.ends, pulled.numbers
            carry.saved[i], carry.timed[i], carry.ts[i] = pulled.saved, pulled.timed, pulled.ts
        (ct_y, ct_state), ct_ends, more = pull((carry.y, carry.solver_state, ct_dense))
        ct_ends = _add(ct_ends, pulled_ends)
        return carry._replace(
            k=k - 1,
            y=ct_y,
            solver_state=ct_state,
            numbers=_add(numbers, more),
            t0=carry.t0 + jnp.where(k == 0, ct_ends[0], 0.0),
            t1=carry.t1 + jnp.where(last, ct_ends[1], 0.0),
        )

    def _inside(self, i: int, step: _Step, k: Array, pulled: _Pulled) -> Array:
        """Whether the next saved time lies in this step."""
        t = self.inputs.times[i][jnp.maximum(pulled.timed - 1, 0)]
        return (pulled.timed > 0) & ((t > step.t0) | (k == 0))

    def _over_time(self, i: int, step: _Step, dense: tuple[PyTree, PyTree], pulled: _Pulled) -> _Pulled:
        """Cotangents of one saved time."""
        count, timed, solver = pulled.saved - 1, pulled.timed - 1, self.inputs.solver

        def value(t: Array, dense_numbers: PyTree, ends: tuple[Array, Array], numbers: _Numbers) -> PyTree:
            info = eqx.combine(dense_numbers, dense[1])
            y = solver.interpolation_cls(t0=ends[0], t1=ends[1], **info).evaluate(t)
            return self.value(i, t, y, numbers)

        t, (ct, ct_time) = self.inputs.times[i][timed], self.row(i, count)
        _, pull = jax.vjp(value, t, dense[0], (step.t0, step.t1), self.numbers)
        ct_t, ct_dense, ct_ends, more = pull(ct)
        return _Pulled(
            count,
            timed,
            _add(pulled.dense, ct_dense),
            _add(pulled.ends, ct_ends),
            _add(pulled.numbers, more),
            pulled.ts.at[timed].add(ct_t + ct_time),
        )


def _numbers(tree: PyTree) -> PyTree:
    return eqx.filter(tree, eqx.is_inexact_array)


def _filled(ct: PyTree, like: PyTree) -> PyTree:
    """Cotangents with zeros in place of None."""

    def fill(x: Any, c: Any) -> Any:
        return x if x is None else jnp.zeros_like(x) if c is None else c

    like = _numbers(like)
    if not jtu.tree_leaves(ct):
        return jtu.tree_map(jnp.zeros_like, like)
    return jtu.tree_map(fill, like, ct, is_leaf=lambda x: x is None)


def _add(a: PyTree, b: PyTree) -> PyTree:
    return jtu.tree_map(jnp.add, a, b)


def _weighted(weight: Array, x: Array) -> Array:
    """Sum of the entries of `x` where `weight`."""
    return jnp.sum(jnp.where(jnp.expand_dims(weight, tuple(range(1, x.ndim))), x, 0.0), axis=0)


def _save_states(state: Any) -> list[Any]:
    """Those of each `SubSaveAt`, in order."""
    is_save = lambda x: hasattr(x, "saveat_ts_index")  # noqa: E731
    return [x for x in jtu.tree_leaves(state.save_state, is_leaf=is_save) if is_save(x)]
