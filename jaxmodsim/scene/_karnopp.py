"""Forces of friction elements that stick in a band of velocities about rest (`DeadZone`)."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, PyTree

from .._core.arrays import PerDof, Scalar
from ..friction import AbstractKarnoppLaw
from .forces._effect import Action
from .forces._friction import Friction

# Sweeps of projected Gauss-Seidel over sticking elements that the mechanism couples.
_SWEEPS = 50


def karnopp_forces(
    elements: dict[str, Friction],
    slipping: dict[str, Action],
    accelerate: Callable[[Array], Array],
    respond: Callable[[Array], Array],
    rhs: PerDof,
    t: Scalar,
    q: PerDof,
    qd: PerDof,
    params: PyTree,
) -> dict[str, Action]:
    """Forces that keep the slip velocities constant, within the limits of stick.

    With directions D (rows), the slip acceleration is `D qdd + dD/dt qd - belt'`; each sticking force F enters it
    as `-D W D^T F`. Elements are solved one after the other, several of them in repeated sweeps, which
    converge because that matrix is positive semidefinite.

    **Arguments:**

    - `elements`: the elements by name.
    - `slipping`: their actions in slip, which `rhs` contains.
    - `accelerate`: maps a generalised force to accelerations within the constraints.
    - `respond`: W, the change of accelerations with a generalised force.
    - `rhs`: generalised force of all effects.
    """
    names = list(elements)
    active, limits, rows = [], [], []
    free, one = rhs, jnp.ones_like(t)
    for name in names:
        effect, law = elements[name], elements[name].law
        assert isinstance(law, AbstractKarnoppLaw)
        holds = law.holds(effect.slip(t, q, qd, params))
        free = free - jnp.where(holds, slipping[name].generalised, 0.0)
        load = effect.load(t, q, qd, params)
        limits.append([effect.static_limit(-one, load), effect.static_limit(one, load)])
        active.append(holds)
        rows.append(effect.direction(q, params))
    reach = [*respond(jnp.stack(rows, axis=1)).T]
    qdd = accelerate(free)
    drive = [elements[name].slip_and_rate(t, q, qd, qdd, params)[1] for name in names]
    coupling = [[jnp.sum(a * b) for b in reach] for a in rows]

    def sweep(forces: list[Array]) -> list[Array]:
        new = list(forces)
        for i in range(len(names)):
            others = sum(coupling[i][j] * new[j] for j in range(len(names)) if j != i)
            force = jnp.clip((drive[i] - others) / coupling[i][i], -limits[i][0], limits[i][1])
            new[i] = jnp.where(active[i], force, 0.0)
        return new

    forces = sweep([jnp.zeros_like(t) for _ in names])
    if len(names) > 1:
        forces = jax.lax.fori_loop(0, _SWEEPS, lambda _, f: sweep(f), forces)
    return {
        name: Action(
            jnp.where(on, elements[name].apply_force(q, force, params), slipping[name].generalised),
            jnp.where(on, force, slipping[name].force),
        )
        for name, on, force in zip(names, active, forces, strict=True)
    }
