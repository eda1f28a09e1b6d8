"""What a model makes of a run: scenes by fixed steps or by events, laws under a measured motion."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..scene import Scene, Signal, State, replace_numbers, scene_numbers
from ..simulation import simulate
from ._entries import join_entries
from ._observe import Observable, needs_forces, observed, observer
from ._replay import Controller, run_samples
from ._runs import Runs

DELAY = "delay."


class Seen(NamedTuple):
    """What a model gives for one run: channels, slip instants, and the state at the last sample."""

    channels: dict[str, Float[Array, " samples"]]
    slips: dict[str, Float[Array, " instants"]]
    end: State | None


class ReplayEngine(eqx.Module):
    """A scene without events, by fixed steps from sample to sample."""

    scene: Scene
    delays: dict[str, Array]
    controller: Controller | None
    observables: tuple[tuple[str, Observable], ...] = eqx.field(static=True)
    linear: frozenset[str] = eqx.field(static=True)
    substeps: int = eqx.field(static=True)

    def __call__(self, values: dict[str, Array], start: State, run: Runs) -> Seen:
        """Run the scene with these values over the samples."""
        scene = with_values(self.scene, values)
        inputs = delayed(run.t, run.inputs, self.linear, self.delays | values)
        seen, end = run_samples(
            scene,
            run.t,
            inputs,
            start,
            observer(self.observables),
            substeps=self.substeps,
            linear=self.linear,
            controller=self.controller,
        )
        return Seen(seen, {}, end)


class EventEngine(eqx.Module):
    """A scene with set-valued laws, by events; NaN where the run ends early."""

    scene: Scene
    delays: dict[str, Array]
    observables: tuple[tuple[str, Observable], ...] = eqx.field(static=True)
    linear: frozenset[str] = eqx.field(static=True)
    slips: tuple[str, ...] = eqx.field(static=True)
    rtol: float = eqx.field(static=True)
    atol: float = eqx.field(static=True)
    max_events: int = eqx.field(static=True)

    def __call__(self, values: dict[str, Array], start: State, run: Runs) -> Seen:
        """Run the scene with these values over the samples."""
        scene = with_values(self.scene, values)
        inputs = delayed(run.t, run.inputs, self.linear, self.delays | values)
        if inputs:
            signals = {name: Signal(run.t, x, linear=name in self.linear) for name, x in inputs.items()}
            scene = eqx.tree_at(lambda x: x.params, scene, {**scene.params, **signals})
        done = simulate(
            scene,
            start.q,
            start.qd,
            run.t[-1],
            t0=run.t[0],
            ts=run.t,
            z0=start.z,
            rtol=self.rtol,
            atol=self.atol,
            adjoint=dfx.ForwardMode(),
            max_events=self.max_events,
            throw=False,
        )
        fine = done.code == 0
        forces = done.forces if any(needs_forces(x) for _, x in self.observables) else {}
        channels = {
            name: jnp.where(
                fine, jax.vmap(lambda q, qd, f, x=x: observed(x, q, qd, f))(done.q, done.qd, forces), jnp.nan
            )
            for name, x in self.observables
        }
        end = State(done.q[-1], done.qd[-1], jax.tree.map(lambda x: x[-1], done.z))
        return Seen(channels, self._slips(scene, done, run), end)

    def _slips(self, scene: Scene, done: Any, run: Runs) -> dict[str, Array]:
        """The first instants at which elements broke away; the end of the run for those that did not come."""
        if not self.slips:
            return {}
        events, found = done.events, {}
        for effect in self.slips:
            broke = (events.effect == scene.names.index(effect)) & (events.before == 0)
            times = jnp.sort(jnp.where(broke, events.t, jnp.inf))[: run.slips[effect].shape[0]]
            short = run.slips[effect].shape[0] - times.shape[0]
            times = jnp.pad(times, (0, max(short, 0)), constant_values=jnp.inf)
            found[effect] = jnp.where(jnp.isfinite(times), times, run.t[-1])
        return found


def with_values(scene: Scene, values: Mapping[str, Any]) -> Scene:
    """The scene with numbers of these names replaced; delays are none of them."""
    own = {name: jnp.asarray(x) for name, x in values.items() if not name.startswith(DELAY)}
    return replace_numbers(scene, join_entries(scene_numbers(scene), own))


def delayed(
    t: Float[Array, " samples"],
    inputs: dict[str, Float[Array, " samples"]],
    linear: frozenset[str],
    values: dict[str, Array],
) -> dict[str, Float[Array, " samples"]]:
    """Inputs that come later by the `delay.*` [s] among the values, which may be a fraction of a sample.

    A held input that jumps between two samples is replaced by its mean over the interval: the impulse is exact, and
    the derivative by the delay exists.
    """
    shifted = dict(inputs)
    for name, x in inputs.items():
        if DELAY + name not in values:
            continue
        tau = values[DELAY + name]
        if name in linear:
            shifted[name] = jnp.interp(t - tau, t, x)
            continue
        dt = jnp.diff(t)
        impulse = jnp.concatenate([jnp.zeros(1, x.dtype), jnp.cumsum(dt * x[:-1])])
        # Outside the record the first and the last sample go on.
        late = t - tau
        at = (
            jnp.interp(late, t, impulse) + x[0] * jnp.minimum(late - t[0], 0.0) + x[-1] * jnp.maximum(late - t[-1], 0.0)
        )
        mean = jnp.diff(at) / jnp.where(dt > 0, dt, 1.0)
        shifted[name] = jnp.concatenate([jnp.where(dt > 0, mean, x[:-1]), x[-1:]])
    return shifted
