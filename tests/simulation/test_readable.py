"""What objects print and show in a notebook: names, values, units, on a screen at most."""

import pydoc
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from IPython.core.formatters import DisplayFormatter

import jaxmodsim as jms
from jaxmodsim.problems import belt_oscillator

TS = np.linspace(0.0, 2.0, 201)
SCENE = belt_oscillator.scene(c=0.3)


def end(scene: Any) -> Any:
    return jms.simulate(scene, [0.0], [0.1], 2.0).q[-1, 0]


@pytest.fixture(scope="module")
def run() -> jms.Trajectory:
    return jms.simulate(SCENE, [0.0], [0.1], 2.0, ts=TS)


def rows(thing: object) -> list[list[str]]:
    return [line.split("  ")[1:] for line in str(thing).splitlines() if line.startswith("  ")]


def test_a_scene_and_its_gradient_print_names_values_and_units() -> None:
    lines = str(SCENE).splitlines()
    assert lines[0] == "Scene of _lagrangian in x [m]"
    assert "  friction.Fs [N]               8" in lines
    assert "  friction.belt_velocity [m/s]  0.1" in lines
    assert lines[-1] == "effects: friction (Coulomb), damper (Viscous)"
    gradient = jax.grad(end)(SCENE)
    (line,) = [x for x in str(gradient).splitlines() if "friction.Fc [N]" in x]
    np.testing.assert_allclose(float(line.split()[-1]), gradient.effects[0].law.Fc, rtol=1e-5)
    mass = eqx.filter(SCENE, lambda x: x is SCENE.params["m"])
    by_mass = eqx.filter_grad(lambda part: end(eqx.combine(part, SCENE)))(mass)
    assert [row[0] for row in rows(by_mass)] == ["number [unit]", "m"]
    many = jms.Scene(lambda t, q, qd, p: 0.5 * qd[0] ** 2, params={f"p{i}": i for i in range(40)})
    assert len(str(many).splitlines()) <= 30
    assert "... and 18 more" in str(many)
    loaded = jms.problems.slider_crank.scene(mu=0.1)
    assert "friction.Fc [N per N]" in str(loaded)


def test_a_law_prints_its_parameters() -> None:
    assert str(jms.Coulomb(5.0, 8.0)).splitlines()[2:] == ["  Fc [N]         5", "  Fs [N]         8"]
    assert str(jms.asymmetric(jms.Coulomb(1.0), Fc=2.0)).startswith("asymmetric(Coulomb)\n")
    wrapped = str(jms.Regularized(jms.Coulomb(1.0), width=1e-3))
    assert wrapped.startswith("Regularized(Coulomb): smooth")
    assert "width [m/s]    0.001" in wrapped
    assert "[0.1, 0.2]" in str(jms.MaxwellSlip(k=[1.0, 2.0], Fc=[0.1, 0.2]))


def test_a_run_prints_how_it_ended_and_how_far_it_went(run: jms.Trajectory) -> None:
    first, head, x, _, stats = str(run).splitlines()
    assert first == "Trajectory, 201 of 201 times up to 2 s: The run reached t1."
    assert head.split() == ["first", "last", "least", "greatest"]
    assert x.split() == ["x", "[m]", *(f"{value:.6g}" for value in (0.0, run.q[-1, 0], 0.0, run.q.max()))]
    assert "num_events 3" in stats
    assert repr(run) == str(run)
    assert repr(run.result) == "The run reached t1."
    runs = jax.vmap(lambda v: jms.simulate(SCENE, [0.0], v[None], 2.0, throw=False))(jnp.array([0.1, 0.2]))
    assert "2 x The run reached t1." in str(runs)
    seen = []
    jax.jit(lambda run: seen.append(f"{run} {run.result!r}"))(run)
    assert "Traced" in seen[0]


def test_mode_changes_are_in_words_and_without_padding(run: jms.Trajectory) -> None:
    changes = run.mode_changes
    assert len(changes) == run.stats["num_events"] == len(run.events.t)
    assert [change[1:] for change in changes] == [
        ("friction", "stick", "backward"),
        ("friction", "backward", "stick"),
        ("friction", "stick", "backward"),
    ]
    np.testing.assert_array_equal([change.t for change in changes], run.events.t)
    with pytest.raises(IndexError):
        _ = run.events.t[3]
    smooth = jms.simulate(jms.problems.n_link_pendulum.scene(1), [0.1], [0.0], 0.1)
    assert smooth.mode_changes == ()


def test_events_energy_and_counts_print_in_words_outside_of_traces(run: jms.Trajectory) -> None:
    title, head, *lines = str(run.events).splitlines()
    assert title == "3 mode changes"
    assert head.split() == ["t", "[s]", "effect", "before", "after"]
    assert [line.split()[1:] for line in lines] == [list(change[1:]) for change in run.mode_changes]
    assert repr(run.events) == str(run.events)
    assert [row[0].strip() for row in rows(run.energy)[1:]] == [f"{name} [J]" for name in (
        "kinetic", "potential", "stored", "work_in", "dissipated", "balance",
    )]  # fmt: skip
    assert all(type(count) is int for count in run.stats.values())
    seen = []
    jax.jit(lambda run: seen.append((str(run.events), str(run.energy), run.events.t.shape)))(run)
    (events, energy, (size,)) = seen[0]
    assert events == f"Events, times of shape ({size},)"
    assert energy == "Energy, shape (201,)"
    assert size > 3
    ball = jms.simulate(jms.problems.bouncing_ball.scene(e=0.5), [1.0], [0.0], 1.0)
    assert str(ball.events).splitlines()[2].split()[1:] == ["floor", "open", "impact"]
    both = jms.Scene(
        lambda t, q, qd, p: 0.5 * jnp.sum(qd**2),
        {},
        [jms.Friction(jms.Coulomb(1.0), along=lambda q, i=i: q[i], name=f"part_{i}") for i in range(2)],
    )
    stopped = jms.simulate(both, [0.0, 0.0], [1.0, 1.0], 2.0)
    assert str(stopped.events).splitlines()[0] == f"2 mode changes at {stopped.stats['num_events']} times"
    none = jms.simulate(jms.problems.n_link_pendulum.scene(1), [0.1], [0.0], 0.1)
    assert str(none.events) == "0 mode changes"


def test_a_notebook_shows_tables(run: jms.Trajectory) -> None:
    for thing, text in ((SCENE, "friction.Fs [N]"), (run, "x_dot [m/s]"), (jms.Coulomb(1.0), "Fc [N]")):
        shown, _ = DisplayFormatter().format(thing)
        assert f"<td style='text-align:left'>{text}</td>" in shown["text/html"]


def test_reactions_print_their_ranges() -> None:
    floor = jms.Contact(lambda t, q, p: q[0], name="floor")
    ball = jms.Scene(lambda t, q, qd, p: 0.5 * qd[0] ** 2 - 9.81 * q[0], {}, constraints=(floor,))
    reaction = jms.simulate(ball, [0.0], [0.0], 1.0, ts=np.linspace(0.0, 1.0, 11)).reactions["floor"]
    ranges = "shape (11, 1), 9.81 to 9.81"
    assert str(reaction) == repr(reaction) == f"ConstraintReaction(multiplier: {ranges}; generalised: {ranges})"


@pytest.mark.quick
def test_help_and_version() -> None:
    text = pydoc.plain(pydoc.render_doc(jms))
    public = [name for name in dir(jms) if name[0] not in "_" and name not in ("TYPE_CHECKING", "cli", "jaxtyping")]
    listed = set(text.replace(",", " ").replace(";", " ").replace(".", " ").replace("(", " ").replace(")", " ").split())
    rooms = {"friction", "mechanics", "scene", "simulation", "solvers"}
    assert set(public) - rooms <= listed
    assert "ts: 'ArrayLike | list[float] | None' = None" in pydoc.plain(pydoc.render_doc(jms.simulate))
    assert jms.__version__.count(".") == 2
    with pytest.raises(AttributeError, match="'Lugre'") as raised:
        _ = jms.Lugre  # pyright: ignore[reportAttributeAccessIssue]
    assert (raised.value.name, raised.value.obj) == ("Lugre", jms)  # of which Python asks: did you mean 'LuGre'?
