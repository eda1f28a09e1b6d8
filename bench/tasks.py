"""The tasks of the matrix: scene, parameters, reference solution and error measures; and the class of its cases.

- `lugre_testbench`: a box of 2 kg on a table, pulled by the force `1 N/s * t` for 10 s from rest, with LuGre friction;
- `pulled_spring`: a box of 1 kg, pulled for 20 s through a spring of 2 N/m whose end moves at 0.1 m/s, with the law of
  1995, as in T. N. Do, A. A. Ferri, O. A. Bauchau, "Efficient simulation of a dynamic system with LuGre friction",
  Journal of Computational and Nonlinear Dynamics 2:281, 2007;
- `stick_slip`: a mass on a spring rides on a belt, with Coulomb friction `Fc` in slip and up to `Fs` in stick, for 60 s
  and 122 events. It sticks until `k x = Fs`, then slips back, about once a second.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np

import jaxmodsim as jms
from bench.record import Result
from jaxmodsim.problems import belt_oscillator, bristles, ramped_box

LUGRE = ("sigma0", "sigma1", "sigma2", "Fc", "Fs", "vs")
MAX_STEPS = 1_000_000


@dataclass(frozen=True)
class Box:
    """A run with LuGre friction: `mass x'' = rate t - stiffness x - F(v, z)` from rest; states are (x, v, z).

    - `make`: builds the scene from the law.
    - `numbers`: parameters of the law, in the order of `LUGRE`.
    - `mass` [kg], `rate` [N/s], `stiffness` [N/m], `t1` [s].
    - `samples`: number of equispaced times over which errors are taken.
    - `atol`: ratio of the absolute to the relative tolerance.
    - `bristle`: magnitude of the bristle deflection [m].
    - `confirmed`: largest relative difference between the reference and RK4 with steps of 10 us.
    """

    make: Callable[[Any], jms.Scene]
    numbers: tuple[float, ...]
    mass: float
    rate: float
    stiffness: float
    t1: float
    samples: int
    atol: float
    bristle: float
    confirmed: float

    @property
    def times(self) -> np.ndarray:
        """Times of the error measures [s]."""
        return np.linspace(0.0, self.t1, self.samples)

    def scene(self, p: Any) -> jms.Scene:
        """The scene with six parameters of the law."""
        return self.make(jms.LuGre(*(p[i] for i in range(6))))

    def simulate(self, p: Any, rtol: Any, **options: Any) -> jms.Trajectory:
        """A run by `jaxmodsim`."""
        given = {"rtol": rtol, "atol": self.atol * rtol} | options
        return jms.simulate(self.scene(p), [0.0], [0.0], self.t1, **given)

    def load(self, t: Any, x: Any) -> Any:
        """Force on the box without friction [N]."""
        return self.rate * t - self.stiffness * x if self.stiffness else self.rate * t

    def field(self, t: Any, y: Any, p: Any) -> Any:
        """A vector field by hand for JAX: a tuple of three scalars."""
        sigma0, sigma1, sigma2, coulomb, stiction, vs = (p[i] for i in range(6))
        x, v, z = y
        ratio = v / vs
        level = coulomb + (stiction - coulomb) * jnp.exp(-ratio * ratio)
        rate = v - sigma0 * jnp.abs(v) / level * z
        return v, (self.load(t, x) - (sigma0 * z + sigma1 * rate + sigma2 * v)) / self.mass, rate

    def with_friction(self, states: np.ndarray) -> np.ndarray:
        """States of the shape `[time, 3]`, with the friction force [N] as a fourth column."""
        x, v, z = states.T
        rest = self.field(0.0, (x, v, z), self.numbers)[1]
        return np.column_stack([states, self.load(0.0, x) - self.mass * np.asarray(rest)])

    def our_states(self, rtol: float, atol: float) -> tuple[np.ndarray, int]:
        """States at the times of the task, and the number of steps."""
        run = self.simulate(self.numbers, rtol, atol=atol, ts=self.times, max_steps=MAX_STEPS)
        return np.stack([run.q[:, 0], run.qd[:, 0], run.z["friction"]], axis=1), int(run.stats["num_steps"])

    def rk4_states(self, h: float) -> np.ndarray:
        """States at the times of the task by RK4 with steps of about `h`."""
        count = round(self.t1 / (self.samples - 1) / h)
        h = self.t1 / (self.samples - 1) / count

        def moved(y: Any, slope: Any, by: float) -> Any:
            return tuple(a + by * b for a, b in zip(y, slope, strict=True))

        def step(i: Any, y: Any, t0: Any, p: Any) -> Any:
            t = t0 + i * h
            a = self.field(t, y, p)
            b = self.field(t + h / 2, moved(y, a, h / 2), p)
            c = self.field(t + h / 2, moved(y, b, h / 2), p)
            d = self.field(t + h, moved(y, c, h), p)
            return tuple(y[k] + h / 6 * (a[k] + 2 * b[k] + 2 * c[k] + d[k]) for k in range(3))

        @jax.jit
        def run(p: Any, ts: Any) -> Any:
            def sample(y: Any, t0: Any) -> Any:
                y = jax.lax.fori_loop(0, count, lambda i, y: step(i, y, t0, p), y)
                return y, jnp.stack(y)

            return jax.lax.scan(sample, (jnp.zeros(()),) * 3, ts)[1]

        states = run(jnp.asarray(self.numbers), jnp.asarray(self.times[:-1]))
        return np.vstack([np.zeros(3), np.asarray(states)])

    @cached_property
    def reference(self) -> np.ndarray:
        """States by `simulate` at 1e-12, with friction as a fourth column; RK4 must confirm them."""
        # The absolute tolerance suits the smallest entry of the state, the bristle deflection.
        states, _ = self.our_states(1e-12, 1e-11 * self.bristle)
        other = self.rk4_states(1e-5)
        disagreement = float(np.max(np.abs(states - other) / np.abs(other).max(axis=0)))
        if not disagreement < self.confirmed:
            raise AssertionError(f"The two reference solutions differ by {disagreement:.1e}.")
        return self.with_friction(states)

    def errors(self, states: np.ndarray) -> dict[str, tuple[float, str]]:
        """Largest errors over the run, of v and the friction force F relative to their maxima, and of F in newtons."""
        exact = self.reference
        worst = np.max(np.abs(self.with_friction(states) - exact), axis=0)
        relative = worst / np.abs(exact).max(axis=0)
        both = float(max(relative[1], relative[3])) if np.isfinite(relative[[1, 3]]).all() else math.inf
        found = {"error of v": (float(relative[1]), "1"), "error of F": (float(relative[3]), "1")}
        return found | {"error of v and F": (both, "1"), "error of F in newtons": (float(worst[3]), "N")}

    def sets(self, count: int) -> np.ndarray:
        """Fixed sets of the six parameters, within 20 %, with `sigma1` from 0 to 10 N s/m."""
        rng, nominal = np.random.default_rng(20240229), np.array(self.numbers)
        sets = nominal * (1.0 + 0.2 * rng.uniform(-1.0, 1.0, (count, 6)))
        sets[:, 1] = rng.uniform(0.0, 10.0, count)
        sets[:, 4] = np.maximum(sets[:, 4], 1.02 * sets[:, 3])
        return sets

    def exact_ends(self, sets: np.ndarray) -> np.ndarray:
        """End velocities of many sets, by `simulate` at 1e-11."""
        return np.asarray(jax.jit(jax.vmap(lambda p: self.simulate(p, 1e-11).qd[-1, 0]))(jnp.asarray(sets)))

    def exact_gradient(self) -> np.ndarray:
        """Derivatives of the end velocity by the six parameters, from a run of the field by hand at 1e-13."""
        tight, start = dfx.PIDController(rtol=1e-13, atol=self.atol * 1e-13), (jnp.zeros(()),) * 3

        def run(p: Any) -> Any:
            return dfx.diffeqsolve(
                dfx.ODETerm(self.field), jms.Rodas5P(), 0.0, self.t1, None, start, args=p, max_steps=MAX_STEPS,
                stepsize_controller=tight, adjoint=dfx.ForwardMode(),
            ).ys[1][-1]  # pyright: ignore[reportOptionalSubscript]  # fmt: skip

        return np.asarray(jax.jit(jax.jacfwd(run))(jnp.asarray(self.numbers)))

    def gradient_error(self, found: np.ndarray, exact: np.ndarray) -> float:
        """Largest error of the gradient by the logarithms of the parameters, relative to its largest entry.

        That of `sigma1`, which may be 0, is per N s/m. Derivatives by `sigma0` and `sigma1` are nearly zero, so errors
        relative to each of them say little.
        """
        scale = np.where(np.array(self.numbers) == 0.0, 1.0, np.array(self.numbers))
        return float(np.max(np.abs(found - exact) * scale) / np.max(np.abs(exact) * scale))


@dataclass(frozen=True)
class Belt:
    """The belt oscillator with its closed form, started at x = 0 with the velocity of the belt.

    - `numbers`: Fc [N], Fs [N], k [N/m], m [kg], vb [m/s].
    - `t1` [s].
    - `atol`: absolute tolerance for a relative one: m and m/s, both of the order of 0.1 here.
    """

    numbers: tuple[float, ...] = (5.0, 8.0, 100.0, 1.0, 0.1)
    t1: float = 60.0
    atol: float = 1e-3

    def named(self, p: Any) -> dict[str, Any]:
        """The five parameters by name."""
        return {"Fc": p[0], "Fs": p[1], "k": p[2], "m": p[3], "belt": p[4]}

    def scene(self, p: Any) -> jms.Scene:
        """The scene of the five parameters."""
        return belt_oscillator.scene(jms.Coulomb(p[0], p[1]), k=p[2], m=p[3], belt=p[4])

    def simulate(self, p: Any, rtol: Any, **options: Any) -> jms.Trajectory:
        """A run by `jaxmodsim`."""
        given = {"rtol": rtol, "atol": self.atol * rtol} | options
        return jms.simulate(self.scene(p), jnp.zeros(1, p.dtype), p[4:], self.t1, **given)

    def exact_end(self, p: Any) -> Any:
        """Position [m] at `t1`, in closed form."""
        return belt_oscillator.motion(jnp.asarray(self.t1), **self.named(p))[0]

    def sets(self, count: int) -> np.ndarray:
        """Fixed sets of the five parameters, within 3 % of the nominal ones."""
        rng = np.random.default_rng(20240229)
        return np.array(self.numbers) * (1.0 + 0.03 * rng.uniform(-1.0, 1.0, (count, 5)))

    @property
    def judged(self) -> np.ndarray:
        """Sets for the error measures: the nominal one and 16 others."""
        return np.vstack([self.numbers, self.sets(16)])

    def exact_ends(self, sets: np.ndarray) -> np.ndarray:
        """End positions of many sets."""
        return np.asarray(jax.vmap(self.exact_end)(jnp.asarray(sets)))

    def errors(self, ends: np.ndarray) -> dict[str, tuple[float, str]]:
        """Largest error of the end position over `judged`."""
        return {"error of x": (float(np.max(np.abs(ends - self.exact_ends(self.judged[: len(ends)])))), "m")}

    def exact_gradient(self) -> np.ndarray:
        """Derivatives of the end position by the five parameters."""
        return np.asarray(jax.grad(self.exact_end)(jnp.asarray(self.numbers)))

    def gradient_error(self, found: np.ndarray, exact: np.ndarray) -> float:
        """Largest relative error."""
        return float(np.max(np.abs(found / exact - 1.0)))


# The state ranges from 2 mm (z) to 50 m (x).
TESTBENCH = Box(ramped_box.scene, (750.0, 0.0, 0.1, 1.5, 1.75, 0.2), 2.0, 1.0, 0.0, 10.0, 101, 1e-3, 1e-3, 1e-9)
# The bristle reaches 15 um; with a finer absolute tolerance all solvers take longer for the same error.
PULLED = Box(
    bristles.pulled_box, (1e5, math.sqrt(1e5), 0.4, 1.0, 1.5, 1e-3), 1.0, 0.2, 2.0, 20.0, 4001, 1e-4, 1e-6, 1e-7
)
BELT = Belt()


@dataclass(frozen=True)
class Case:
    """A column of the matrix.

    - `task`: scene, and closed form or reference.
    - `quantities`: functions of `bench.quantities`, which measure all peers.
    - `ladder`: tolerances. Each peer is measured at the loosest one whose error `measure` is at most `goal`.
    - `goal`: None for 1.05 times the error of `jaxmodsim` at 1e-6.
    - `small`: peers of a smoke run. `packages`: packages whose versions are recorded. `settings`: numbers in captions.
    """

    name: str
    task: Box | Belt
    quantities: tuple[Callable[[Any], None], ...]
    ladder: tuple[float, ...]
    measure: str
    goal: float | None = 1e-6
    small: tuple[str, ...] = ("jaxmodsim", "diffrax Heun", "CVODES (CasADi)", "CVODE (scikit-sundae)")
    packages: tuple[str, ...] = ("diffrax", "casadi", "scikit-sundae", "scipy", "numpy")
    settings: dict[str, Any] = field(default_factory=dict)

    def result(self) -> Result:
        """An empty result."""
        return Result(self.name, self.packages, {"atol_over_rtol": self.task.atol, "t1": self.task.t1} | self.settings)
