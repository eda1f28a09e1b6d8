"""Arguments that make no sense: refused by a sentence of ours that names them, or taken where they do make sense.

`pytest tests/simulation/test_fuzz_arguments.py --hypothesis-profile=deep` draws many more examples than the suite does.
"""

import datetime
import re
import traceback
import warnings
from collections.abc import Callable, Mapping
from decimal import Decimal
from fractions import Fraction
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import jaxtyping
import numpy as np
import pytest
from hypothesis import strategies as st

import jaxmodsim as jms
from jaxmodsim import identify, metrics, sweeps
from jaxmodsim.simulation import _simulate, _to_accuracy

from ..helpers.fuzz import fuzz

PACKAGE = str(Path(jms.__file__).parent)


def energy(t: Any, q: Any, qd: Any, p: Any) -> Any:
    del t
    return 0.5 * p["m"] * jnp.sum(qd**2) - 0.5 * jnp.sum(q**2)


SCENE = jms.Scene(energy, params={"m": 1.0, "u": 0.0}, effects=(jms.Friction(jms.Viscous(1.0)),))
T = np.linspace(0.0, 1.0, 9)
RECORD = jms.Record(T, np.sin(T), {"u": np.cos(T)})


# What Python says itself of a function that takes other arguments.
ARITY = "positional arguments|takes no arguments"


class Call(NamedTuple):
    """Something public with arguments that make sense.

    - `also`: what a refusal may call an argument, where not by its name.
    """

    make: Callable[..., Any]
    arguments: dict[str, Any]
    also: Mapping[str, str] = MappingProxyType({})


def law(kind: Any, *more: str, **numbers: Any) -> Call:
    return Call(kind, numbers | dict.fromkeys(more))


BRISTLE = {"sigma0": 1e3, "sigma1": 1.0, "sigma2": 1.0, "Fc": 1.0, "Fs": 1.5, "vs": 0.1}
MOTION = {"q0": [0.0], "qd0": [0.0]}
CALLS = {
    "Viscous": law(jms.Viscous, Fv=1.0),
    "Coulomb": law(jms.Coulomb, Fc=1.0, Fs=2.0),
    "Stribeck": law(jms.Stribeck, Fc=1.0, Fs=2.0, vs=0.1, Fv=1.0, exponent=2.0, fall=jms.friction.lorentzian),
    "Dahl": law(jms.Dahl, sigma0=1.0, Fc=1.0),
    "LuGre": law(jms.LuGre, "vd", **BRISTLE),
    "ElastoPlastic": law(jms.ElastoPlastic, Fba=0.5, **BRISTLE),
    "MaxwellSlip": law(jms.MaxwellSlip, "Fs", "vs", k=[1.0, 2.0], Fc=[1.0, 2.0], C=1.0, sigma2=1.0, corner=0.1),
    "Armstrong": law(jms.Armstrong, sigma0=1.0, Fc=1.0, Fs=2.0, vs=0.1, Fv=1.0, tau=1.0, gamma=1.0),
    "Curve": law(jms.Curve, fn=jnp.tanh, gain=1.0),
    "Regularized": law(jms.Regularized, law=jms.Coulomb(1.0), width=0.1),
    "DeadZone": law(jms.DeadZone, law=jms.Coulomb(1.0), width=0.1),
    "Sign": law(jms.Sign, law=jms.Coulomb(1.0)),
    "asymmetric": Call(jms.asymmetric, {"law": jms.Coulomb(1.0, 2.0), "Fc": 1.5}),
    "scaled_by": Call(
        jms.scaled_by, {"law": jms.Coulomb(1.0), "fn": lambda t, q, qd, p: 1.0, "parameters": ("Fc",)}
    ),
    "Friction": law(jms.Friction, "along", "normal_force", "name", "ellipse", law=jms.Viscous(1.0), belt_velocity=0.0),
    "AppliedForce": law(jms.AppliedForce, "at", "name", fn=lambda t, q, qd, p: q),
    "Constraint": law(jms.Constraint, "at", "name", phi=lambda t, q, p: q[0], stabilise=0.0),
    "VelocityConstraint": law(jms.VelocityConstraint, "name", psi=lambda t, q, qd, p: qd[0]),
    "Signal": law(jms.Signal, t=T, values=T, linear=False),
    "point_mass": Call(jms.point_mass, {"m": 1.0, "position": lambda q: q, "gravity": 9.81}),
    "Scene": Call(jms.Scene, {"lagrangian": energy, "params": {"m": 1.0}, "effects": (), "constraints": ()}),
    "simulate": Call(
        jms.simulate,
        {"scene": SCENE, **MOTION, "t1": 1.0, "t0": 0.0, "ts": T, "z0": None, "rtol": 1e-6, "atol": 1e-9, "dt": None,
         "dtmax": None, "solver": None, "adjoint": None, "max_steps": 9, "max_events": 9, "stick_on_chatter": False,
         "project": True, "record": (), "throw": True},
    ),
    "simulate_to_accuracy": Call(
        jms.simulate_to_accuracy,
        {"scene": SCENE, **MOTION, "t1": 1.0, "accuracy": 1e-3, "observable": None, "throw": True},
    ),
    "project_initial_state": Call(jms.project_initial_state, {"scene": SCENE, **MOTION, "t0": 0.0, "hold": ()}),
    "Record": Call(
        jms.Record,
        {"t": T, "measured": T, "inputs": {"u": T}, "name": "r", "linear": ("u",), "noise": 0.1,
         "slips": {"friction": [0.5]}},
        {"measured": "measured|columns?", "inputs": "inputs|columns", "linear": "linear|noise"},
    ),
    "part": Call(RECORD.part, {"start": 0.0, "end": 1.0, "name": None}),
    "windows": Call(RECORD.windows, {"seconds": 0.5}, {"seconds": "seconds|windows"}),
    "sweep": Call(
        sweeps.plan_sweep,
        {"system": SCENE, "over": {"m": [1.0, 2.0]}, "observe": ["q[0]"], **MOTION, "t1": 1.0, "chunk": 1},
        {"system": "system|function", "observe": "observe|observable"},
    ),
    "latin_hypercube": Call(sweeps.latin_hypercube, {"ranges": {"m": (1.0, 2.0)}, "count": 2, "seed": 0}),
    "sobol": Call(sweeps.sobol, {"ranges": {"m": (1.0, 2.0)}, "count": 2, "seed": 0}),
    "Derivative": Call(sweeps.Derivative, {"of": "q[0]", "wrt": ("m",)}),
    "classes": Call(metrics.classes, {"fn": lambda run: 0, "names": ("rests",)}),
    "fit": Call(
        identify.fit,
        {"scene": SCENE, "records": RECORD, "free": ("m",), "observe": "q[0]", **MOTION, "delay": None, "limits": None,
         "passive": (), "prior": None, "loss": None, "controller": None, "shooting": None, "initializer": (),
         "substeps": 1, "accuracy": 1e-8, "rtol": 1e-6, "max_steps": 1, "progress": False},
        {"observe": f"observe|{ARITY}", "progress": f"progress|{ARITY}"},
    ),
}  # fmt: skip


class Thing:
    """Nothing that anyone has heard of."""


def nothing(*arguments: Any, **named: Any) -> None:
    del arguments, named


# Made anew for each example.
GARBAGE: dict[str, Callable[[], Any]] = {
    "None": lambda: None,
    "True": lambda: True,
    "text": lambda: "text",
    "empty text": lambda: "",
    "bytes": lambda: b"bytes",
    "complex": lambda: 1j,
    "empty list": lambda: [],
    "empty tuple": lambda: (),
    "empty dict": lambda: {},
    "dict": lambda: {"a": 1},
    "dict of numbers": lambda: {1: 2},
    "nested": lambda: [[[]]],
    "ragged": lambda: [[1.0], [2.0, 3.0]],
    "two numbers": lambda: [1, 2],
    "texts": lambda: ["a", "b"],
    "Nones": lambda: [None, None],
    "object": Thing,
    "class": lambda: Thing,
    "function of nothing": lambda: lambda: None,
    "function": lambda: nothing,
    "empty array": lambda: np.array([]),
    "matrix": lambda: np.zeros((2, 2)),
    "array of text": lambda: np.array("a"),
    "array of objects": lambda: np.array([None, Thing()]),
    "array of truth": lambda: np.array([True]),
    "complex array": lambda: jnp.array([1j]),
    "int32": lambda: np.arange(3, dtype=np.int32),
    "NaN": lambda: float("nan"),
    "infinity": lambda: float("inf"),
    "huge": lambda: 10**400,
    "negative": lambda: -1,
    "zero": lambda: 0,
    "zero float": lambda: 0.0,
    "half": lambda: 0.5,
    "Fraction": lambda: Fraction(1, 2),
    "Decimal": lambda: Decimal("0.5"),
    "date": lambda: datetime.datetime(2020, 1, 1),
    "date of numpy": lambda: np.datetime64("2020-01-01"),
    "range": lambda: range(3),
    "set": lambda: {1, 2},
    "generator": lambda: (x for x in (1.0, 2.0)),
    "path": lambda: Path("a"),
    "a scene": lambda: SCENE,
    "a law": lambda: jms.Coulomb(1.0),
    "an effect": lambda: jms.Friction(jms.Viscous(1.0)),
    "a record": lambda: RECORD,
    "memory": lambda: memoryview(b"ab"),
}


@pytest.fixture(autouse=True)
def _as_users_have_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)

    def traced(request: Any) -> Any:
        shapes = jax.eval_shape(solve, request)
        return jtu.tree_map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)

    solve = _simulate.solve
    # Compiling takes longest, and does not look at arguments.
    monkeypatch.setattr(_simulate, "solve", traced)
    monkeypatch.setattr(_to_accuracy, "_search", lambda *more: None)


def refusal(call: Call, argument: str, garbage: Any) -> str | None:
    """What is wrong with how garbage is taken; None if nothing is."""
    try:
        with warnings.catch_warnings():
            # Of JAX, where generators are parts of pytrees.
            warnings.filterwarnings("ignore", "Python iterable type", DeprecationWarning)
            call.make(**(call.arguments | {argument: garbage}))
    except (ValueError, TypeError) as error:
        text, frames = str(error), traceback.extract_tb(error.__traceback__)
        if not frames[-1].filename.startswith(PACKAGE):
            return f"{type(error).__name__} from {frames[-1].filename}:{frames[-1].lineno}: {text[:300]}"
        if not re.search(rf"(?i)\b({call.also.get(argument, argument)})\b", text):
            return f"does not name it: {text[:300]}"
        return None
    except jms.SimulationError:
        return None
    except Exception as error:
        return f"{type(error).__name__}: {str(error)[:300]}"
    return None


EACH = [(name, argument) for name, call in CALLS.items() for argument in call.arguments]


@fuzz(0.2, st.sampled_from(EACH), st.sampled_from(list(GARBAGE)))
def test_garbage_is_refused_by_name(where: tuple[str, str], kind: str) -> None:
    name, argument = where
    wrong = refusal(CALLS[name], argument, GARBAGE[kind]())
    assert wrong is None, f"{name}({argument}={kind}): {wrong}"


def moved(lagrangian: Any = energy, effects: Any = (), constraints: Any = ()) -> Any:
    scene = jms.Scene(lagrangian, params={"m": 1.0}, effects=effects, constraints=constraints)
    return jms.simulate(scene, [0.0], [0.0], 1.0)


def rubbed(**arguments: Any) -> Any:
    return moved(effects=(jms.Friction(**({"law": jms.Viscous(1.0)} | arguments)),))


# What is made of a function of a user, and what a refusal calls it.
FUNCTIONS: dict[str, tuple[Callable[[Any], Any], str]] = {
    "lagrangian": (lambda fn: moved(fn), "lagrangian"),
    "applied force": (lambda fn: moved(effects=(jms.AppliedForce(fn),)), "applied"),
    "at": (lambda fn: moved(effects=(jms.AppliedForce(lambda t, q, qd, p: q, at=fn),)), "at|applied"),
    "along": (lambda fn: rubbed(along=fn), "along"),
    "belt_velocity": (lambda fn: rubbed(belt_velocity=fn), "belt_velocity"),
    "normal_force": (lambda fn: rubbed(normal_force=fn), "normal_force"),
    "curve": (lambda fn: rubbed(law=jms.Curve(fn)), "curve|fn"),
    "factor": (lambda fn: rubbed(law=jms.scaled_by(jms.Viscous(1.0), fn)), "fn"),
    "phi": (lambda fn: moved(constraints=(jms.Constraint(fn),)), "phi"),
    "psi": (lambda fn: moved(constraints=(jms.VelocityConstraint(fn),)), "psi"),
}


@fuzz(0.03, st.sampled_from(list(FUNCTIONS)), st.sampled_from(list(GARBAGE)))
def test_functions_that_return_garbage_are_refused_by_name(name: str, kind: str) -> None:
    run, words = FUNCTIONS[name]
    call = Call(run, {"fn": None}, {"fn": words})
    garbage = GARBAGE[kind]()
    wrong = refusal(call, "fn", (lambda q: garbage) if name in ("at", "along") else lambda *state: garbage)
    assert wrong is None, f"{name} returning {kind}: {wrong}"


# What was an error from deep inside, or was taken, when it was found.
FOUND = [
    ("LuGre", "Fc", "huge", "Fc is too large for float64"),
    ("Coulomb", "Fs", "array of text", "Fs must be a real number"),
    ("Stribeck", "fall", "text", "fall must be a function"),
    ("Friction", "name", "matrix", "Friction name must be a text"),
    ("Signal", "linear", "None", "Signal linear must be True or False"),
    ("scaled_by", "parameters", "object", "scaled_by parameters must be a list of names"),
    ("simulate", "z0", "text", "z0 must be a mapping with names as keys"),
    ("simulate", "throw", "matrix", "throw must be True or False"),
    ("simulate", "max_steps", "huge", "max_steps must be a positive integer, but one of 401 digits"),
    ("project_initial_state", "q0", "complex array", "q0 must hold real numbers"),
    ("project_initial_state", "scene", "None", "project_initial_state needs a Scene"),
    ("Record", "inputs", "True", "inputs must be a mapping with names as keys"),
    ("Record", "t", "complex array", "column 't' must hold real numbers"),
    ("part", "start", "text", "start must hold real numbers"),
    ("windows", "seconds", "None", "seconds must hold real numbers"),
    ("sweep", "q0", "text", "q0 must hold real numbers"),
    ("sobol", "seed", "negative", "seed must be an integer >= 0"),
    ("fit", "scene", "None", "scene must be a Scene"),
    ("fit", "records", "None", "records must be a Record or several"),
    ("fit", "loss", "text", "loss must be a loss such as"),
    ("fit", "initializer", "text", "initializer must be one such as"),
    ("fit", "rtol", "complex", "rtol must hold real numbers"),
]


@pytest.mark.parametrize(("name", "argument", "kind", "text"), FOUND)
def test_what_was_not_refused_by_name(name: str, argument: str, kind: str, text: str) -> None:
    call = CALLS[name]
    with pytest.raises(ValueError, match=text):
        call.make(**(call.arguments | {argument: GARBAGE[kind]()}))


@pytest.mark.parametrize(
    ("name", "kind", "text"),
    [
        ("lagrangian", "zero", "The Lagrangian must return one number .* that depends on the state"),
        ("lagrangian", "text", "The result of the Lagrangian must hold real numbers, but 'text'"),
        ("applied force", "complex array", "The result of fn of AppliedForce 'applied' must hold real numbers"),
        ("along", "None", "The result of Friction along must be an array of real numbers, but it is None"),
        ("normal_force", "complex", "normal_force.* must hold real numbers"),
        ("phi", "text", "The result of phi of Constraint 'constraint' must hold real numbers"),
    ],
)
def test_what_a_function_returned_was_not_refused_by_name(name: str, kind: str, text: str) -> None:
    garbage = GARBAGE[kind]()
    with pytest.raises(ValueError, match=text):
        FUNCTIONS[name][0]((lambda q: garbage) if name == "along" else lambda *state: garbage)
