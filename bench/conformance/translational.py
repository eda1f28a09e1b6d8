"""Examples of the Modelica Standard Library with masses on a line: friction with a stop, brakes, gaps, preload."""

import jax.numpy as jnp
import numpy as np

import jaxmodsim as jms
from bench.conformance import references_translational as references
from bench.conformance.case import Case, Numbers, Setup
from bench.conformance.references import eddy_current_brake as exact_eddy_current_brake
from bench.conformance.rotational import eddy_current_brake, gap_force

SOURCE = "modelica/ModelicaStandardLibrary @ bd753330a, Modelica/Mechanics/Translational/Examples/{}.mo"
RESULTS = "modelica/MAP-LIB_ReferenceResults @ d6a2b9b2, Modelica/Mechanics/Translational/Examples/{0}/{0}.csv"


def masses(t, q, qd, p):
    """Lagrangian of masses `m` on a line."""
    return 0.5 * jnp.sum(p["m"] * qd**2)


class Stop(jms.Stribeck):
    """The Stribeck curve of Modelica's stop, whose largest force at rest is 0.1 % above its start."""

    def static_limit(self, direction):
        """Largest force at rest [N]."""
        return 1.001 * jnp.asarray(self.Fs)


def _stribeck(p: Numbers) -> jms.Stribeck:
    return Stop(Fc=p["Fc"], Fs=p["Fc"] + p["Fs"], vs=1.0 / p["fexp"], Fv=p["Fv"], exponent=1.0)


def brake(p: Numbers) -> Setup:
    """A mass that is braked from 0.1 s on."""
    params = {"m": p["m"][None], "on": jms.Signal([0.0, 0.1], [0.0, 2.0]), "fn": p["capacity"]}
    law = jms.Friction(jms.Coulomb(p["mu"]), normal_force=lambda t, q, qd, p: p["fn"] * p["on"], name="brake")
    return Setup(jms.Scene(masses, params, (law,)), np.zeros(1), np.ones(1))


def friction(p: Numbers) -> Setup:
    """A mass with Stribeck friction under a sine force."""
    force = jms.AppliedForce(lambda t, q, qd, p: p["force"] * jnp.sin(0.5 * jnp.pi * t)[None])
    scene = jms.Scene(
        masses, {"m": p["m"][None], "force": p["force"]}, (force, jms.Friction(_stribeck(p), name="stop1"))
    )
    return Setup(scene, np.zeros(1), np.zeros(1))


def friction_stop(p: Numbers) -> Setup:
    """A mass with Stribeck friction on a spring, which strikes a stop without a rebound."""

    def lagrangian(t, q, qd, p):
        return masses(t, q, qd, p) - 0.5 * p["c"] * (q[0] + 0.25) ** 2

    stop = jms.Contact(lambda t, q, p: q[0] + 0.4, restitution=0.0, name="lower")
    scene = jms.Scene(
        lagrangian, {"m": p["m"][None], "c": p["c"]}, (jms.Friction(_stribeck(p), name="stop2"),), constraints=(stop,)
    )
    return Setup(scene, np.zeros(1), np.array([-5.0]))


def elasto_gap(p: Numbers) -> Setup:
    """A mass between two springs with dampers, and one that touches them one at a time."""

    def forces(t, q, qd, p):
        c, d = p["c"], p["d"]
        push = gap_force(-q[1] - 0.5, -qd[1], c, d) - gap_force(q[1] - 0.5, qd[1], c, d)
        return jnp.stack([-2.0 * (c * q[0] + d * qd[0]), push])

    params = {"m": jnp.stack([p["m"], p["m"]]), "c": p["c"], "d": p["d"]}
    return Setup(jms.Scene(masses, params, (jms.AppliedForce(forces),)), np.full(2, 2.0), np.zeros(2))


def _case(
    name: str, make, numbers: dict[str, float], t1: float, outputs, observe, published, reference, **more
) -> Case:
    def exact(**numbers: float):
        return reference(*numbers.values())

    example = name.partition(", ")[0]
    return Case(
        f"Translational.{name}", SOURCE.format(example), numbers, make, t1, outputs, observe, exact, published,
        results=RESULTS.format(example), **more,
    )  # fmt: skip


def _end(q, qd):
    return q[0], qd[0]


CASES = (
    _case(
        "Brake", brake, {"m": 1.0, "capacity": 1.0, "mu": 0.5}, 2.0, ("mass1.s [m]", "mass1.v [m/s]"), _end,
        (0.59999999999301157, -1.1102230246251565e-16), references.brake, by=("capacity", "mu", "m"),
        modes=((1.1, "brake stick"),),
    ),
    _case(
        "Friction, stop1", friction, {"m": 1.0, "Fv": 1.0, "Fc": 5.0, "Fs": 10.0, "fexp": 2.0, "force": 25.0}, 5.0,
        ("stop1.s [m]", "stop1.v [m/s]"), _end, (1.7684628213204434, 6.8648585898125738),
        references.friction, by=("Fc", "Fs", "m"),
        modes=((0.410143135297, "stop1 forward"), (2.44268882456, "stop1 backward"), (4.44193990087, "stop1 forward")),
        note="The law is a subclass of `Stribeck` with Modelica's factor of 1.001 on the limit at rest.",
    ),
    _case(
        "Friction, stop2", friction_stop, {"m": 1.0, "Fv": 1.0, "Fc": 3.0, "Fs": 5.0, "fexp": 2.0, "c": 500.0}, 5.0,
        ("stop2.s [m]", "stop2.v [m/s]"), _end, (-0.24751584799147497, -1.0136235951133056e-10),
        references.friction_stop, by=("Fc", "Fs", "m"), compared=("stop2",),
        modes=((0.0605969540595, "stop2 forward"), (0.201105639685, "stop2 backward"),
               (0.341616547959, "stop2 forward"), (0.482140109526, "stop2 backward"),
               (0.622692612163, "stop2 forward"), (0.763328813916, "stop2 backward"),
               (0.904204209026, "stop2 forward"), (1.04597406053, "stop2 stick")),
        note="Without the upper stop, which the mass does not reach.",
    ),
    _case(
        "ElastoGap", elasto_gap, {"m": 1.0, "c": 10.0, "d": 1.5}, 5.0,
        ("elastoGap1.v_rel [m/s]", "elastoGap2.s_rel [m]", "springDamper1.v_rel [m/s]", "springDamper2.s_rel [m]"),
        lambda q, qd: (qd[1], 2.0 - q[1], qd[0], 2.0 - q[0]),
        (0.53752970968098934, 2.7078870235576407, -0.0041932374877375706, 2.0003503785615258),
        references.elasto_gap, by=("c", "d", "m"),
    ),
    _case(
        "EddyCurrentBrake", eddy_current_brake,
        {"J": 1.0, "torque": 100.0, "speed": 10.0, "capacity": 1.0, "coefficient": 3.92e-3}, 1.0,
        ("mass.s [m]", "heatCapacitor.T [K]"), lambda q, qd: (q[0], 293.15 + 0.5 * (400.0 - qd[0] ** 2)),
        (2.5622780615885228, 493.14984771874254), exact_eddy_current_brake, by=("torque", "coefficient"),
    ),
)  # fmt: skip
