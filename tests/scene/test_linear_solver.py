"""The linear systems of a step, from the structure of mechanics: those of the Jacobian that is formed."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

from jaxmodsim import AppliedForce, Coulomb, DeadZone, Friction, LuGre, MaxwellSlip, Regularized, Scene, scaled_by
from jaxmodsim.problems import n_link_pendulum, slider_crank
from jaxmodsim.scene import State, has_linear_solver, linear_solver, vector_field

LUGRE = LuGre(sigma0=100.0, sigma1=1.0, sigma2=0.05, Fc=0.2, Fs=0.3, vs=0.1)
SMOOTH = Friction(Regularized(Coulomb(Fc=0.3), 0.1), along=lambda q: q[0])
SPRINGS = Friction(MaxwellSlip(k=[10.0, 20.0], Fc=[0.1, 0.2]), along=lambda q: q[1] - q[0])
PLANAR = Friction(
    scaled_by(LUGRE, lambda t, q, qd, p: 1.0 + 0.1 * qd[0] ** 2),
    along=lambda q: jnp.stack([jnp.sin(q[0]) + jnp.sin(q[1]), jnp.cos(q[0])]),
    normal_force=lambda t, q, qd, p: 1.0 + q[0] ** 2 + jnp.sin(t) ** 2,
)
FORCE = AppliedForce(lambda t, q, qd, p: jnp.stack([jnp.sin(t) * q[1], p["l"][0] * qd[0] ** 2]))


def chain(n: int, *effects: Any) -> Scene:
    base = n_link_pendulum.scene(n)
    return Scene(base.lagrangian, params=base.params, effects=effects)


def joints(n: int) -> tuple[Friction, ...]:
    return tuple(Friction(LUGRE, along=lambda q, i=i: q[i]) for i in range(n))


SCENES = {
    "one": chain(1, *joints(1)),
    "three joints": chain(3, *joints(3)),
    "no states": chain(2, SMOOTH),
    "states of several entries": chain(2, SMOOTH, FORCE, SPRINGS, PLANAR),
}


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
@pytest.mark.parametrize("pivot", [False, True])
@pytest.mark.parametrize("name", SCENES)
def test_solves_with_the_jacobian(name: str, pivot: bool, dtype: Any) -> None:
    rng = np.random.default_rng(4)
    cast = lambda x: jnp.asarray(x, dtype)  # noqa: E731
    scene = jax.tree.map(cast, SCENES[name])
    q, qd = cast(rng.normal(size=scene.params["l"].shape)), cast(rng.normal(size=scene.params["l"].shape))
    z = jax.tree.map(lambda x: cast(1e-3 * rng.normal(size=x.shape)), scene.initial_state(q))
    t, shift = cast(0.3), cast(37.0)
    y, whole = ravel_pytree(State(q, qd, z))
    rhs = cast(rng.normal(size=y.shape))

    def field(y: Any) -> Any:
        return ravel_pytree(vector_field(t, whole(y), scene))[0]

    @jax.jit
    def solution(rhs: Any) -> Any:
        qdd = vector_field(t, whole(y), scene).qd
        solve = linear_solver(t, whole(y), qdd, scene, shift=shift, pivot=pivot)
        return ravel_pytree(solve(whole(rhs)))[0]

    x, matrix = solution(rhs), shift * jnp.eye(y.shape[0], dtype=dtype) - jax.jit(jax.jacfwd(field))(y)
    assert x.dtype == dtype
    # Rounding, enlarged by the condition of the systems, 1e2 to 1e4.
    np.testing.assert_allclose(matrix @ x, rhs, atol=1e3 * float(jnp.finfo(dtype).eps))


def test_what_it_does_not_know() -> None:
    """Constraints, and friction that depends on accelerations."""
    assert has_linear_solver(chain(2))
    assert not has_linear_solver(chain(2, Friction(Coulomb(Fc=0.3), along=lambda q: q[0])))
    assert not has_linear_solver(chain(2, Friction(DeadZone(Coulomb(Fc=0.3), 0.1), along=lambda q: q[0])))
    assert not has_linear_solver(slider_crank.scene())


def test_derivatives_of_the_solution() -> None:
    """By the state, the acceleration and the shift at once: forward and reverse, against central differences."""
    scene = SCENES["states of several entries"]
    q, qd, qdd = jnp.array([0.3, 0.5]), jnp.array([0.1, -0.4]), jnp.array([1.0, -2.0])
    z = jax.tree.map(lambda x: x + 1e-3, scene.initial_state(q))
    rhs = State(q, qd, z)

    @jax.jit
    def total(x: Any) -> Any:
        y = State(x * q, x * qd, jax.tree.map(lambda each: x * each, z))
        solve = linear_solver(x * 0.3, y, x * qdd, scene, shift=37.0 * x, pivot=False)
        return jnp.sum(ravel_pytree(solve(rhs))[0] ** 2)

    one = jnp.array(1.0)
    reverse, forward = jax.grad(total)(one), jax.jvp(total, (one,), (one,))[1]
    np.testing.assert_allclose(reverse, forward, rtol=1e-11)
    # Step 1e-5: truncation 1e-10 and rounding 1e-11 of the value.
    np.testing.assert_allclose(forward, (total(one + 1e-5) - total(one - 1e-5)) / 2e-5, rtol=1e-6)
