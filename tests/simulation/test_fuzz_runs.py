"""Runs of any numbers: a right answer, a refusal that names the argument, or a code with what was computed until then.

`pytest tests/simulation/test_fuzz_runs.py --hypothesis-profile=deep` draws many more examples than the suite does.
"""

import re
from dataclasses import dataclass, fields, replace
from typing import Any

import jax
import jax.tree_util as jtu
import jaxtyping
import numpy as np
import pytest
from hypothesis import strategies as st

import jaxmodsim as jms

from ..helpers.fuzz import ODD, decades, fuzz, is_deep, signed

STEPS, EVENTS = 3000, 64
# Below that XLA takes numbers for zero.
TINY = 1e-307


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
        with np.errstate(all="ignore"):
            return np.clip(self.t0 + np.asarray(self.shares) * self.span, self.t0, self.t1)


# Exactly at rest, hardly moving, and beyond all machines.
states = st.one_of(st.just(0.0), signed(decades(-9, 4)), st.sampled_from([5e-324, -1e-300, 1e12, -1e100]))
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


PLAIN = Drawn(2.0, 0.0, 3.0, 1.0, 0.5, 1e-2, 1e3, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, (0.0, 0.5, 0.5, 1.0), 1e-6, 1e-9, 1e-3)


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
# Each takes seconds to compile.
SUITE = ("none", "coulomb", "regularized", "dead zone", "lugre", "maxwell slip")
DEEP = tuple(LAWS)
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
    np.testing.assert_allclose(t[reached], ts[reached], rtol=0, atol=TINY)
    assert np.isinf(t[~reached]).all(), t
    for x in jtu.tree_leaves((found.q, found.qd, found.z, found.modes)):
        assert np.isfinite(np.asarray(x)[reached]).all(), x
        assert np.isinf(np.asarray(x)[~reached]).all(), x
    assert int(found.stats["num_steps"]) <= STEPS
    assert found.result.message.endswith(".")
    if code == 0:
        assert reached.all()
        assert abs(float(found.t_end) - float(found.request.t1)) <= TINY
    else:
        assert float(found.request.t0) - TINY <= float(found.t_end) <= float(found.request.t1) + TINY
    return code == 0


@dataclass(frozen=True)
class Scales:
    """Sizes that errors are measured by."""

    q: float
    v: float
    energy: np.ndarray
    error: float
    tiny_v: float


def scales(found: jms.Trajectory, x: Drawn) -> Scales:
    """Energy along the run, and what it may be wrong by for the errors that each step may make."""
    t = np.asarray(found.t)
    q, v = (np.asarray(y)[np.isfinite(t), 0] for y in (found.q, found.qd))
    top = float(np.max(np.abs([*v, x.qd0, x.belt])))
    far = float(np.max(np.abs([*q, x.q0]))) + top * (float(found.t_end) - x.t0)
    with np.errstate(over="ignore"):  # of fixed steps that are far too long
        energy = 0.5 * x.m * v**2 + 0.5 * x.k * q**2 - x.F * q
    rtol = max(x.rtol, 1e-13)
    each = (x.m * top) * (rtol * top + x.atol) + (x.k * far + abs(x.F)) * (rtol * far + x.atol)
    rounding = 1e-15 * (most("stribeck", x) + abs(x.F) + x.k * far) * (float(found.t_end) - x.t0) / x.m
    each = each + (x.m * rounding + (abs(x.F) + x.k * far) * (float(found.t_end) - x.t0)) * rounding
    return Scales(far, top, energy, 10.0 * (int(found.stats["num_steps"]) + 1) * each, rounding + 5e-324)


def most(law: str, x: Drawn) -> float:
    """Largest force of friction at rest [N]."""
    return {"none": 0.0, "viscous": 0.0, "maxwell slip": 1.5 * x.Fc, "dahl": x.Fc}.get(law, x.Fs)


def check_energy(law: str, found: jms.Trajectory, x: Drawn) -> None:
    """Friction gives no energy, a belt no more than its velocity times the limit, and without both it stays."""
    if law in FIXED:  # fixed steps, however long, keep no energy
        return
    size, t = scales(found, x), np.asarray(found.t)
    start = 0.5 * x.m * x.qd0**2 + 0.5 * x.k * x.q0**2 - x.F * x.q0
    gain = size.energy + stored(found) - start
    wet = 2.0 * x.damping * (1.0 + x.rise) * (size.v + abs(x.belt))
    given = 0.0 if law == "none" else (most(law, x) + wet) * abs(x.belt) * (t - x.t0)
    assert (gain <= given + size.error).all(), (gain, given, size.error)
    if law == "none":
        assert (gain >= -size.error).all(), (gain, size.error)


def stored(found: jms.Trajectory) -> Any:
    """Energy [J] in bristles."""
    if not found.z:
        return 0.0
    (effect,), (z,) = found.scene.effects, found.z.values()
    return np.asarray(jax.vmap(effect.stored_energy)(z))


def check_limits(law: str, found: jms.Trajectory, x: Drawn) -> None:
    """Bristles and forces within their limits, modes that are modes, and no slip in stick."""
    q, v = np.asarray(found.q)[:, 0], np.asarray(found.qd)[:, 0]
    size = scales(found, x)
    limit = most(law, x) * (1.0 + 10.0 * x.rtol)
    if found.modes is not None:
        mode = np.asarray(found.modes)[:, 0]
        assert np.isin(mode, (-1.0, 0.0, 1.0)).all(), mode
        stick = mode == 0
        assert (abs(v - x.belt)[stick] <= 1e-12 * size.v + size.tiny_v).all(), v
        assert (abs(x.F - x.k * q)[stick] <= 1.011 * x.Fs + x.k * (x.rtol * size.q + x.atol)).all(), q
        assert (mode * (v - x.belt) >= -10 * (x.rtol * size.v + x.atol)).all(), (mode, v)
    if found.z:
        (z,) = found.z.values()
        force = sum(np.abs(np.asarray(y)).reshape(len(q), -1) @ k for y, k in pulls(law, z, x))
        limit = limit + 10 * x.sigma * x.atol * (int(found.stats["num_steps"]) + 1)
        # Between the ends of steps there is dense output, with an error of its own.
        assert (force <= np.where(found.t == x.t1, 1.0, 1.01) * limit).all(), (force, limit)
    if law in ("regularized", *FIXED):
        force = np.asarray(found.forces["friction"])
        assert (abs(force) <= x.Fs * (1 + 1e-12)).all(), force


def pulls(law: str, z: Any, x: Drawn) -> list[Any]:
    """Deflections of bristles with their stiffnesses."""
    if law == "maxwell slip":
        return [(z, np.array([x.sigma, 0.1 * x.sigma]))]
    return [(z.z if law == "armstrong" else z, np.array([x.sigma]))]


def check_tighter(law: str, found: jms.Trajectory, x: Drawn) -> None:
    """The same run again with smaller errors is the same motion."""
    if law in FIXED or x.rtol > 1e-4:
        return
    again = run(law, x, rtol=max(1e-3 * x.rtol, 1e-13), atol=1e-3 * x.atol)
    if int(again.code):
        return
    size, n = scales(found, x), int(found.stats["num_steps"]) + 1
    for a, b, top in ((found.q, again.q, size.q), (found.qd, again.qd, size.v)):
        off = np.abs(np.asarray(a) - np.asarray(b)).max()
        assert off <= 100 * n * (max(x.rtol, 1e-13) * top + x.atol), (
            off,
            top,
            np.asarray(a)[:, 0],
            np.asarray(b)[:, 0],
            int(again.stats["num_steps"]),
        )


def check_closed_form(law: str, found: jms.Trajectory, x: Drawn) -> None:
    """Without a spring, viscous and Coulomb friction have one."""
    if x.k or law not in ("viscous", "coulomb") or abs(abs(x.F) - x.Fs) < 1e-9 * x.Fs:
        return
    t = np.asarray(found.t) - x.t0
    v = viscous(x, t) if law == "viscous" else coulomb(x, t)
    n, top = int(found.stats["num_steps"]) + 1, max(np.abs(v).max(), scales(found, x).v)
    off = abs(np.asarray(found.qd)[:, 0] - v).max()
    # A time is rounded where it is far from zero.
    late = 1e-15 * abs(x.t0) * (abs(x.F) + x.Fs + x.damping * top) / x.m
    assert off <= 10 * n * (max(x.rtol, 1e-13) * top + x.atol) + late + TINY, (off, v)


def viscous(x: Drawn, t: np.ndarray) -> np.ndarray:
    """Velocity [m/s] under viscous friction and a constant force."""
    fading = x.damping / x.m * t
    return x.belt + (x.qd0 - x.belt) * np.exp(-fading) - x.F / x.damping * np.expm1(-fading)


def coulomb(x: Drawn, t: np.ndarray) -> np.ndarray:
    """Velocity [m/s] under Coulomb friction and a constant force: slip, and after its end stick or slip back."""
    slip = x.qd0 - x.belt
    away = (x.F - np.sign(x.F) * x.Fc) / x.m if abs(x.F) > x.Fs else 0.0
    if slip == 0:
        return x.belt + away * t
    rate = (x.F - np.sign(slip) * x.Fc) / x.m
    stop = -slip / rate if np.sign(rate) * np.sign(slip) < 0 else np.inf
    return x.belt + np.where(t < stop, slip + rate * t, away * np.where(t < stop, 0.0, t - stop))


@pytest.fixture(autouse=True)
def _as_users_have_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)


@pytest.mark.parametrize("law", DEEP if is_deep() else SUITE)
def test_any_numbers_give_the_right_motion_or_a_code(law: str) -> None:
    @fuzz(0.03, numbers)
    def check(x: Drawn) -> None:
        found = run(law, x)
        if check_whole(found, x.ts):
            check_energy(law, found, x)
            check_limits(law, found, x)
            check_tighter(law, found, x)
            check_closed_form(law, found, x)

    check()


FIELDS = [field.name for field in fields(Drawn) if field.name != "shares"]
NAMED = "|".join(["q0", "qd0", "t0", "t1", "ts", "rtol", "atol", "Fc", "Fs", "width"])


@fuzz(0.1, numbers, st.lists(st.tuples(st.sampled_from(FIELDS), ODD), min_size=1, max_size=3))
def test_numbers_that_are_none_or_hardly_one(x: Drawn, changes: list[tuple[str, float]]) -> None:
    x = replace(x, **dict(changes))
    words = ""
    try:
        check_whole(run("regularized", x), x.ts)
    except ValueError as refusal:
        words = str(refusal)
    nan = re.match(r"The number '(m|k|F)' of the scene is NaN", words)
    named = np.isnan(getattr(x, nan[1])) if nan else re.search(rf"\b({NAMED})\b", words)
    assert not words or named, words


@fuzz(0.08, numbers)
def test_single_precision(x: Drawn) -> None:
    scene = jtu.tree_map(lambda leaf: leaf.astype("float32"), scene_of("regularized", x))
    q0, qd0 = (np.array([y], "float32") if abs(y) < 1e30 else np.zeros(1, "float32") for y in (x.q0, x.qd0))
    numbers = {"t0": x.t0, "ts": x.ts, "rtol": x.rtol, "atol": x.atol}
    if x.t0 != x.t1 and np.float32(x.t0) == np.float32(x.t1):
        with pytest.raises(ValueError, match="are the same number in float32"):
            jms.simulate(scene, q0, qd0, x.t1, **numbers)
        return
    found = jms.simulate(scene, q0, qd0, x.t1, max_steps=STEPS, max_events=EVENTS, throw=False, **numbers)
    assert found.q.dtype == np.float32
    check_whole(found, x.ts.astype("float32"))


# A number as other kinds of Python and NumPy.
KINDS = (float, np.float64, np.asarray, np.float32, lambda y: np.asarray(y, "float32"), jax.numpy.asarray)


@fuzz(0.03, st.integers(-3, 3), st.integers(0, 2), *(st.sampled_from([int, np.int32, *KINDS]) for _ in range(4)))
def test_kinds_of_numbers(start: int, span: int, state: Any, rate: Any, begin: Any, end: Any) -> None:
    """Whole numbers of any kind are the same ones."""
    scene = scene_of("regularized", PLAIN)
    given = [state(start)], [rate(1)], end(start + span)
    found = jms.simulate(
        scene, *given, t0=begin(start), ts=np.full(4, start), max_steps=STEPS, max_events=EVENTS, throw=False
    )
    usual = [float(start)], [1.0], float(start + span)
    wanted = jms.simulate(
        scene, *usual, t0=float(start), ts=np.full(4, float(start)), max_steps=STEPS, max_events=EVENTS, throw=False
    )
    np.testing.assert_array_equal(found.q, wanted.q)
    assert int(found.code) == int(wanted.code)
