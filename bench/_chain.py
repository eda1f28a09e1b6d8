"""The chain of n links, and its accelerations by jaxmodsim, by hand in JAX, by sympy and by MuJoCo.

Point masses of 0.5 to 2 kg on links of 0.5 to 2 m, angles from straight down [rad]. By hand means: the closed form,
once in arrays and once written out in scalars with everything this library knows about XLA on CPU (sines formed once,
an elimination in quotients); the faster of the two stands for it.
"""

import time
from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import mujoco
import numpy as np
import sympy
from mujoco.rollout import Rollout
from sympy.physics.mechanics import LagrangesMethod, dynamicsymbols, msubs

import jaxmodsim as jms
from jaxmodsim._core.cholesky import solve_positive_definite
from jaxmodsim._core.fusion import fusion_barrier, opaque_one
from jaxmodsim.problems import n_link_pendulum, n_link_pendulum_acceleration
from jaxmodsim.scene import State, vector_field

G = 9.81
# Of the Euler steps in a loop [s].
STEP = 1e-4


def numbers(n: int) -> dict[str, Any]:
    """Masses [kg], lengths [m] and gravity [m/s^2]."""
    rng = np.random.default_rng(n)
    return {"m": rng.uniform(0.5, 2.0, n), "l": rng.uniform(0.5, 2.0, n), "g": G}


def states(n: int, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Angles [rad] and their rates [rad/s], shape `[count, n]`."""
    rng = np.random.default_rng(20240229)
    return rng.uniform(-1.0, 1.0, (count, n)), rng.uniform(-1.0, 1.0, (count, n))


def scene(n: int) -> jms.Scene:
    """The chain as a scene."""
    return n_link_pendulum(n, **numbers(n))


def ours(q: Any, qd: Any, scene: jms.Scene) -> Any:
    """Accelerations from the Lagrangian."""
    return vector_field(jnp.zeros_like(q[0]), State(q, qd, {}), scene).qd


def arrays(q: Any, qd: Any, scene: jms.Scene) -> Any:
    """Closed form in arrays."""
    return n_link_pendulum_acceleration(q, qd, **scene.params)


def scalars(q: Any, qd: Any, scene: jms.Scene) -> Any:
    """Closed form in scalars."""
    n, p, unit = q.shape[0], scene.params, opaque_one(q[0])
    m, l, w = ([x[i] for i in range(n)] for x in (p["m"], p["l"], qd))  # noqa: E741
    s, c = (
        [fusion_barrier(jnp.sin(q[i]), unit) for i in range(n)],
        [fusion_barrier(jnp.cos(q[i]), unit) for i in range(n)],
    )
    below = [sum(m[i + 1 :], m[i]) for i in range(n)]
    mass: list[list[Any]] = [[None] * n for _ in range(n)]
    load = [-below[i] * p["g"] * l[i] * s[i] for i in range(n)]
    for i in range(n):
        for j in range(i + 1):
            size = below[i] * l[i] * l[j]
            mass[i][j] = mass[j][i] = size * (c[i] * c[j] + s[i] * s[j])
            slope = size * (s[i] * c[j] - c[i] * s[j])
            load[i] = load[i] - slope * w[j] * w[j]
            load[j] = load[j] + slope * w[i] * w[i]
    return solve_positive_definite(jnp.stack([jnp.stack(row) for row in mass]), jnp.stack(load))


class Symbolic:
    """Equations by `LagrangesMethod`, turned into NumPy functions with common terms taken out."""

    def __init__(self, n: int) -> None:
        start = time.perf_counter()
        q = list(dynamicsymbols(f"q:{n}"))
        m, l, g = sympy.symbols(f"m:{n}"), sympy.symbols(f"l:{n}"), sympy.Symbol("g")  # noqa: E741
        clock = vars(dynamicsymbols)["_t"]
        x = z = energy = sympy.Integer(0)
        for i in range(n):
            x, z = x + l[i] * sympy.sin(q[i]), z - l[i] * sympy.cos(q[i])
            energy += m[i] * (x.diff(clock) ** 2 + z.diff(clock) ** 2) / 2 - m[i] * g * z
        method: Any = LagrangesMethod(energy, q)
        method.form_lagranges_equations()
        angles, rates = sympy.symbols(f"a:{n}"), sympy.symbols(f"b:{n}")
        plain = dict(zip([y.diff() for y in q], rates, strict=True)) | dict(zip(q, angles, strict=True))
        mass, load = msubs(method.mass_matrix, plain), msubs(method.forcing, plain)
        self.evaluate = sympy.lambdify([angles, rates, m, l, g], [mass.tolist(), list(load)], "numpy", cse=True)
        self.numbers = tuple(numbers(n).values())
        self.derived_s = time.perf_counter() - start

    def alone(self, q: np.ndarray, qd: np.ndarray) -> np.ndarray:
        """At one state."""
        mass, load = self.evaluate(q, qd, *self.numbers)
        return np.linalg.solve(np.array(mass), np.array(load))

    def many(self, q: np.ndarray, qd: np.ndarray) -> np.ndarray:
        """At many states, every term an array over them."""
        mass, load = self.evaluate(q.T, qd.T, *self.numbers)
        n, count = len(load), q.shape[0]
        table = np.empty((count, n, n))
        for i in range(n):
            for j in range(n):
                table[:, i, j] = mass[i][j]
        return np.linalg.solve(table, np.stack(load, axis=1)[:, :, None])[:, :, 0]


class Engine:
    """MuJoCo: nested bodies on hinges, without contacts and constraints; its angles are those from link to link."""

    def __init__(self, n: int, threads: int) -> None:
        start = time.perf_counter()
        self.model = mujoco.MjModel.from_xml_string(_mjcf(n))
        self.compiled_s = time.perf_counter() - start
        self.data = mujoco.MjData(self.model)
        self.workers = [mujoco.MjData(self.model) for _ in range(threads)]
        self.pool = Rollout(nthread=threads)

    def place(self, q: np.ndarray, qd: np.ndarray) -> None:
        """Go to one state."""
        self.data.qpos, self.data.qvel = np.diff(q, prepend=0.0), np.diff(qd, prepend=0.0)

    def forward(self) -> None:
        """Accelerations at the state it is in."""
        mujoco.mj_forward(self.model, self.data)

    def accelerations(self) -> np.ndarray:
        """Of the angles from straight down."""
        return np.cumsum(self.data.qacc)

    def steps(self, count: int) -> None:
        """Accelerations, each followed by a step of Euler."""
        mujoco.mj_step(self.model, self.data, count)

    def rows(self, q: np.ndarray, qd: np.ndarray) -> np.ndarray:
        """States as `once_each` takes them: time, angles, rates."""
        zero = np.zeros((q.shape[0], 1))
        state = np.hstack([zero, np.diff(q, axis=1, prepend=0.0), np.diff(qd, axis=1, prepend=0.0)])
        size = mujoco.mj_stateSize(self.model, mujoco.mjtState.mjSTATE_FULLPHYSICS)
        if state.shape[1] != size:
            raise ValueError(f"MuJoCo's state has {size} numbers, not {state.shape[1]}.")
        return state

    def once_each(self, rows: np.ndarray) -> None:
        """One step of Euler from each of many states, over all threads."""
        self.pool.rollout(self.model, self.workers, rows, nstep=1, skip_checks=False)

    def one_by_one(self, q: np.ndarray, qd: np.ndarray) -> None:
        """Accelerations at many states in a loop of Python, from angles and rates of its own kind."""
        for angles, rates in zip(q, qd, strict=True):
            self.data.qpos, self.data.qvel = angles, rates
            mujoco.mj_forward(self.model, self.data)


def _mjcf(n: int) -> str:
    p = numbers(n)
    bodies = ""
    for i in range(n):
        above = 0.0 if i == 0 else p["l"][i - 1]
        bodies += (
            f'<body pos="0 0 {-float(above)!r}"><joint type="hinge" axis="0 -1 0"/>'
            f'<inertial pos="0 0 {-float(p["l"][i])!r}" mass="{float(p["m"][i])!r}" diaginertia="1e-12 1e-12 1e-12"/>'
        )
    return (
        f'<mujoco><compiler angle="radian"/><option timestep="{STEP}" gravity="0 0 {-G}" integrator="Euler">'
        '<flag contact="disable" constraint="disable"/></option>'
        f"<worldbody>{bodies}{'</body>' * n}</worldbody></mujoco>"
    )


Accelerations = Callable[[Any, Any, jms.Scene], Any]
JAX: dict[str, Accelerations] = {"jaxmodsim": ours, "JAX by hand, arrays": arrays, "JAX by hand, scalars": scalars}
