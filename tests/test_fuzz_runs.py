"""Runs of any numbers: a right answer, a refusal that names the argument, or a code with what was computed until then.

`pytest tests/test_fuzz_runs.py --hypothesis-profile=deep` draws many more examples than the suite does.
"""

from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import jax.tree_util as jtu
import jaxtyping
import numpy as np
import pytest
from hypothesis import strategies as st

import jaxmodsim as jms

from .fuzz import ODD, decades, fuzz, signed

STEPS, EVENTS = 3000, 64


def box(t: Any, q: Any, qd: Any, p: Any) -> Any:
    """A mass on a spring under a constant force."""
    del t
    return 0.5 * p["m"] * qd[0] ** 2 - 0.5 * p["k"] * q[0] ** 2 + p["F"] * q[0]


@dataclass(frozen=True)
class Drawn:
    """Numbers of a run."""

    m: float
    k: float
    F: float
    Fc: float
    rise: float
    vs: float
    sigma: float
    damping: float
    belt: float
    q0: float
    qd0: float
    t0: float
    span: float
    shares: tuple[float, ...]
    rtol: float
    atol: float
    dt: float

    @property
    def Fs(self) -> float:
        """Stiction [N]."""
        return self.Fc * (1.0 + self.rise)

    @property
    def t1(self) -> float:
        """End [s]."""
        return self.t0 + self.span

    @property
    def ts(self) -> np.ndarray:
        """Saved times [s]."""
        return np.clip(self.t0 + np.asarray(self.shares) * self.span, self.t0, self.t1)


# Exactly at rest, hardly moving, and beyond all machines.
states = st.one_of(st.just(0.0), signed(decades(-9, 4)), st.sampled_from([5e-324, -1e-300, 1e12, -1e150]))
forces = signed(decades(-6, 6))
shares = st.lists(st.sampled_from([0.0, 0.1, 0.25, 0.5, 0.5, 0.9, 1.0]), min_size=4, max_size=4).map(sorted).map(tuple)
numbers = st.builds(
    Drawn,
    m=decades(-6, 6),
    k=st.one_of(st.just(0.0), decades(-2, 9)),
    F=forces,
    Fc=decades(-6, 6),
    rise=st.one_of(st.just(0.0), st.floats(0.0, 3.0)),
    vs=decades(-6, 1),
    sigma=decades(-2, 9),
    damping=decades(-6, 6),
    belt=signed(decades(-6, 2)),
    q0=states,
    qd0=states,
    t0=st.sampled_from([0.0, 0.0, 0.0, 1e9, -1e9, 1e-9, -3.0]),
    span=st.one_of(st.just(0.0), decades(-12, 5), decades(-3, 1)),
    shares=shares,
    rtol=decades(-12, -1),
    atol=st.one_of(st.just(0.0), decades(-14, -1)),
    dt=decades(-9, 2),
)


def sigmas(x: Drawn) -> dict[str, Any]:
    return {"sigma0": x.sigma, "sigma1": x.damping, "sigma2": x.damping * (1.0 + x.rise)}


LAWS = {
    "none": lambda x: None,
    "viscous": lambda x: jms.Viscous(x.damping),
    "coulomb": lambda x: jms.Coulomb(x.Fc, x.Fs),
    "stribeck": lambda x: jms.Stribeck(x.Fc, x.Fs, x.vs, x.damping),
    "regularized": lambda x: jms.Regularized(jms.Coulomb(x.Fc, x.Fs), x.vs),
    "dead zone": lambda x: jms.DeadZone(jms.Coulomb(x.Fc, x.Fs), x.vs),
    "sign": lambda x: jms.Sign(jms.Coulomb(x.Fc, x.Fs)),
    "lugre": lambda x: jms.LuGre(**sigmas(x), Fc=x.Fc, Fs=x.Fs, vs=x.vs),
    "dahl": lambda x: jms.Dahl(x.sigma, x.Fc),
    "elasto-plastic": lambda x: jms.ElastoPlastic(**sigmas(x), Fba=0.9 * x.Fc, Fc=x.Fc, Fs=x.Fs, vs=x.vs),
    "maxwell slip": lambda x: jms.MaxwellSlip([x.sigma, 0.1 * x.sigma], [x.Fc, 0.5 * x.Fc]),
    "armstrong": lambda x: jms.Armstrong(x.sigma, x.Fc, x.Fs, x.vs, x.damping, 0.1 + x.rise, 0.1 + x.rise),
}
FIXED = ("dead zone", "sign")


def scene_of(law: str, x: Drawn) -> jms.Scene:
    made = LAWS[law](x)
    effects = () if made is None else (jms.Friction(made, belt_velocity=x.belt),)
    return jms.Scene(box, params={"m": x.m, "k": x.k, "F": x.F}, effects=effects)


def run(law: str, x: Drawn, **changes: Any) -> jms.Trajectory:
    control: dict[str, Any] = {"dt": x.dt} if law in FIXED else {"rtol": x.rtol, "atol": x.atol}
    arguments = {"t0": x.t0, "ts": x.ts, "max_steps": STEPS, "max_events": EVENTS, "throw": False} | control | changes
    return jms.simulate(scene_of(law, x), [x.q0], [x.qd0], x.t1, **arguments)


def check_whole(found: jms.Trajectory, ts: np.ndarray) -> bool:
    """Everything up to the end that was reached and infinity afterwards; gives whether that is t1."""
    t, code = np.asarray(found.t), int(found.code)
    reached = np.isfinite(t)
    assert (np.diff(reached.astype(int)) <= 0).all(), t
    np.testing.assert_array_equal(t[reached], ts[reached])
    assert np.isinf(t[~reached]).all(), t
    for x in jtu.tree_leaves((found.q, found.qd, found.z, found.modes)):
        assert np.isfinite(np.asarray(x)[reached]).all(), x
        assert np.isinf(np.asarray(x)[~reached]).all(), x
    assert int(found.stats["num_steps"]) <= STEPS
    assert found.result.message.endswith(".")
    if code == 0:
        assert reached.all()
        assert float(found.t_end) == float(found.problem.t1)
    else:
        assert float(found.problem.t0) <= float(found.t_end) <= float(found.problem.t1)
    return code == 0


@dataclass(frozen=True)
class Scales:
    """Sizes that errors are measured by."""

    q: float
    v: float
    energy: np.ndarray
    error: float


def scales(found: jms.Trajectory, x: Drawn) -> Scales:
    """Energy along the run, and what it may be wrong by for the errors that each step may make."""
    t = np.asarray(found.t)
    q, v = (np.asarray(y)[np.isfinite(t), 0] for y in (found.q, found.qd))
    top = float(np.max(np.abs([*v, x.qd0, x.belt])))
    far = float(np.max(np.abs([*q, x.q0]))) + top * (float(found.t_end) - x.t0)
    energy = 0.5 * x.m * v**2 + 0.5 * x.k * q**2 - x.F * q
    rtol = max(x.rtol, 1e-13)
    each = (x.m * top) * (rtol * top + x.atol) + (x.k * far + abs(x.F)) * (rtol * far + x.atol)
    return Scales(far, top, energy, 10.0 * (int(found.stats["num_steps"]) + 1) * each)


def check_energy(law: str, found: jms.Trajectory, x: Drawn) -> None:
    """Friction takes energy, and no more than its limit along the way; a belt gives no more than that."""
    size, t = scales(found, x), np.asarray(found.t)
    reached = np.isfinite(t)
    if not reached.any():
        return
    start = 0.5 * x.m * x.qd0**2 + 0.5 * x.k * x.q0**2 - x.F * x.q0
    gain = size.energy + stored(law, found, x)[reached] - start
    given = 0.0 if law == "none" else most(law, x) * abs(x.belt) * (t[reached] - x.t0)
    assert (gain <= given + size.error).all(), (gain, given, size.error)
    if law == "none":
        assert (gain >= -size.error).all(), (gain, size.error)


def most(law: str, x: Drawn) -> float:
    """Largest force of friction that does not depend on velocity [N]."""
    return x.Fc * 1.5 if law == "maxwell slip" else x.Fc if law == "dahl" else x.Fs


def stored(law: str, found: jms.Trajectory, x: Drawn) -> np.ndarray:
    """Energy [J] in bristles."""
    del x
    if not found.z:
        return np.zeros(found.t.shape[0])
    (effect,) = found.scene.effects
    (z,) = found.z.values()
    del law
    states = [jtu.tree_map(lambda y, i=i: y[i], z) for i in range(found.t.shape[0])]
    return np.asarray([float(effect.stored(state)) for state in states])


@pytest.mark.parametrize("law", LAWS)
def test_explore(law: str) -> None:
    @fuzz(0.03, numbers)
    def check(x: Drawn) -> None:
        found = run(law, x)
        check_whole(found, x.ts)

    check()
