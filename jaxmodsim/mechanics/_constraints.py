"""Constraints: equations of position and velocity, their multipliers, and the projection onto them.

All constraints together have the velocity equations `w(t, q, qd) = 0` with `J = dw/dqd`. They change the unconstrained
accelerations `a` to `qdd = a + M^-1 J^T lambda`, where `J M^-1 J^T lambda = -(J a + bias)`. For redundant constraints
that matrix is singular: the motion is unique, and the multipliers are those of least norm.
"""

import abc
from collections.abc import Callable, Sequence
from functools import partial
from itertools import accumulate
from typing import TYPE_CHECKING, Any, NamedTuple, cast

import equinox as eqx
import jax
import jax.numpy as jnp
from equinox import AbstractVar
from jaxtyping import Array, Float, PyTree

from .._core.arguments import as_label
from .._core.arrays import PerDof, Scalar, apply_matrix
from .._core.cholesky import factor_positive_definite, solve_balanced
from .._core.functions import as_function, result_shape
from .._core.parameters import AbstractRanged, Number, parameter
from .._core.position import PositionFn, as_optional_position_fn
from .._core.safe import safe_norm
from .._core.scalarise import in_scalars
from .._core.trace_checks import traced


class AbstractEquations(eqx.Module):
    """One or several equations of the motion, each with a multiplier."""

    if TYPE_CHECKING:
        stabilise = cast("Array", None)  # not a field, which would come before those of the constraints
    else:
        # Rate [1/s] at which errors decay.
        stabilise: AbstractVar[Number]

    @abc.abstractmethod
    def error(self, t: Scalar, q: PerDof, params: PyTree) -> Float[Array, " m"] | None:
        """Residual of the position, shape `[m]`; None for a constraint on velocities alone."""

    @abc.abstractmethod
    def rate(self, t: Scalar, q: PerDof, qd: PerDof, params: PyTree) -> Float[Array, " m"]:
        """Residual of the velocity, shape `[m]`."""


class AbstractConstraint(AbstractEquations, AbstractRanged):
    """Equations of the motion that a scene has as a part, with their force."""

    # Name of the constraint in the results and for friction; None for the default name.
    if TYPE_CHECKING:
        name = cast("str | None", None)
    else:
        name: AbstractVar[str | None]

    @abc.abstractmethod
    def check(self, q: PerDof, qd: PerDof, params: PyTree, name: str) -> None:
        """Check shapes while tracing; raises `ValueError` naming the constraint."""

    @abc.abstractmethod
    def force(self, t: Scalar, q: PerDof, params: PyTree, multiplier: Float[Array, " m"]) -> Float[Array, "..."] | None:
        """Cartesian force [N] at the constrained point; None without a point."""

    @abc.abstractmethod
    def per_multiplier(self, t: Scalar, q: PerDof, params: PyTree) -> Scalar:
        """Magnitude [N] of the force for a multiplier of one, for a single equation."""


class AbstractPositionConstraint(AbstractConstraint):
    """A constraint on the position of a point, or on the coordinates."""

    if TYPE_CHECKING:
        at = cast("PositionFn | None", None)
    else:
        at: AbstractVar[PositionFn | None]

    @abc.abstractmethod
    def value(self, t: Scalar, x: Float[Array, "..."], params: PyTree) -> Float[Array, "..."]:
        """Residual at the position `x`, or at the coordinates if `at` is None; a number or shape `[m]`."""

    def error(self, t: Scalar, q: PerDof, params: PyTree) -> Float[Array, " m"]:
        """Residual at the coordinates, shape `[m]`."""
        where = lambda q: q if self.at is None else self.at(q, params)  # noqa: E731
        return in_scalars(lambda t, q: self._values(t, where(q), params), t, q, seed=None)

    def _values(self, t: Scalar, x: Float[Array, "..."], params: PyTree) -> Float[Array, " m"]:
        return jnp.ravel(jnp.asarray(self.value(t, x, params), x.dtype))

    def rate(self, t: Scalar, q: PerDof, qd: PerDof, params: PyTree) -> Float[Array, " m"]:
        """Time derivative of the residual, shape `[m]`."""
        return jax.jvp(lambda t, q: self.error(t, q, params), (t, q), (jnp.ones_like(t), qd))[1]

    def check_value(self, fn: Callable[..., Any], role: str, q: PerDof, params: PyTree, name: str) -> None:
        """Check that `fn`, with a `role` such as "phi of Constraint", returns a number or a vector."""
        place = {"q": q}
        if self.at is not None:
            place = {"x": traced(self.at, q=q, params=params, name=f"at of {role.split()[-1]} {name!r}")}
        _check_vector(f"{role} {name!r}", fn, t=q[0], **place, params=params)

    def force(self, t: Scalar, q: PerDof, params: PyTree, multiplier: Float[Array, " m"]) -> Float[Array, "..."] | None:
        """`(d value/dx)^T lambda` [N], with the shape of the result of `at`."""
        if self.at is None:
            return None
        _, pull = jax.vjp(lambda x: self._values(t, x, params), self.at(q, params))
        return pull(multiplier)[0]

    def per_multiplier(self, t: Scalar, q: PerDof, params: PyTree) -> Scalar:
        """Length of d value/dx; one without `at`, where the value must be a length along the normal."""
        force = self.force(t, q, params, jnp.ones(1, q.dtype))
        return jnp.ones_like(t) if force is None else safe_norm(jnp.ravel(force))


class Constraint(AbstractPositionConstraint):
    """A holonomic constraint `phi(t, q, params) = 0`, enforced by the force of its multiplier.

    The equations of motion are `M qdd = load + Q + J^T lambda` with `J = dphi/dq`: a positive multiplier pushes towards
    larger phi. For example, that of a rod under tension, `phi = |x| - l`, is negative. If phi is a length along the
    normal, the multiplier is the normal force in newtons. A constraint that can only push, such as a floor, is a
    `Contact`.

    **Arguments:**

    - `phi`: `phi(t, q, params)`, a scalar or shape `[m]`, any unit. With `at`, `phi(t, x, params)` of the position x.
    - `at`: `at(q)` or `at(q, params)`, the position [m] of the constrained point, or of several in an array of any
      shape. With it `run.reactions` has the force in space, for any unit of phi.
    - `stabilise`: rate [1/s], >= 0, at which a position error decays: the accelerations obey
      `phi'' + 2 stabilise phi' + stabilise^2 phi = 0` (Baumgarte 1972). By default 0, because `simulate` projects the
      state onto the constraint after every step.
    - `name`: name in `run.reactions`, and for `Friction(normal_force=name)`.

    **Raises:**

    - `ValueError` if an argument is not a function or out of range, and (in the run) for wrong shapes.

    **Example:**

    ```python
    rod = jms.Constraint(lambda t, q, p: jnp.hypot(q[0], q[1]) - 1.0, name="rod")
    scene = jms.Scene(lambda t, q, qd, p: 0.5 * jnp.sum(qd**2) - 9.81 * q[1], constraints=(rod,))
    run = jms.simulate(scene, [0.0, -1.0], [1.0, 0.0], 1.0, ts=[0.0, 1.0])
    print(f"{run.reactions['rod'].multiplier[0, 0]:.2f} N")  # -(m g + m v^2/l)
    ```

    ```text
    -10.81 N
    ```

    ??? cite "Reference"

        ```bibtex
        @article{baumgarte1972stabilization,
            author={Baumgarte, J.},
            title={Stabilization of constraints and integrals of motion in dynamical systems},
            journal={Computer Methods in Applied Mechanics and Engineering}, volume={1}, number={1}, pages={1--16},
            year={1972},
        }
        ```
    """

    phi: Callable[..., Any] = eqx.field(converter=partial(as_function, name="Constraint phi"))
    at: PositionFn | None = eqx.field(default=None, converter=partial(as_optional_position_fn, name="Constraint at"))
    stabilise: Number = parameter("stabilise", "1/s", lower=0.0, default=0.0)
    name: str | None = eqx.field(default=None, static=True, converter=partial(as_label, name="Constraint name"))

    def value(self, t: Scalar, x: Float[Array, "..."], params: PyTree) -> Float[Array, "..."]:
        """The value of phi."""
        return self.phi(t, x, params)

    def check(self, q: PerDof, qd: PerDof, params: PyTree, name: str) -> None:
        """Check that phi is a number or a vector."""
        self.check_value(self.phi, "phi of Constraint", q, params, name)


class VelocityConstraint(AbstractConstraint):
    """A nonholonomic constraint on velocities: rolling, or a blade that does not slip sideways.

    The equations of motion are `M qdd = load + Q + A^T lambda` with `A = dpsi/dqd`.

    **Arguments:**

    - `psi`: `psi(t, q, qd, params)`, zero in admissible motion, a scalar or shape `[m]`; linear in qd. (For a nonlinear
      psi the matrix A follows Chetaev's rule.)
    - `stabilise`: rate [1/s], >= 0, at which a velocity error decays: `psi' + stabilise psi = 0`.
    - `name`: name in `run.reactions`.

    **Raises:**

    - `ValueError` as `Constraint`.

    **Example:**

    ```python
    blade = jms.VelocityConstraint(lambda t, q, qd, p: qd[0] * jnp.sin(q[2]) - qd[1] * jnp.cos(q[2]))
    scene = jms.Scene(lambda t, q, qd, p: 0.5 * jnp.sum(qd**2), constraints=(blade,))
    run = jms.simulate(scene, [0.0, 0.0, 0.0], [1.0, 0.0, 1.0], jnp.pi)  # a half circle
    print(run.q.round(3))
    ```

    ```text
    [[0.    2.    3.142]]
    ```
    """

    psi: Callable[..., Any] = eqx.field(converter=partial(as_function, name="VelocityConstraint psi"))
    stabilise: Number = parameter("stabilise", "1/s", lower=0.0, default=0.0)
    name: str | None = eqx.field(default=None, static=True, converter=partial(as_label, name="VelocityConstraint name"))

    def error(self, t: Scalar, q: PerDof, params: PyTree) -> None:
        """None: the constraint does not exclude positions."""

    def rate(self, t: Scalar, q: PerDof, qd: PerDof, params: PyTree) -> Float[Array, " m"]:
        """The value of psi, shape `[m]`."""
        psi = lambda t, q, qd: jnp.ravel(jnp.asarray(self.psi(t, q, qd, params), q.dtype))  # noqa: E731
        return in_scalars(psi, t, q, qd, seed=None)

    def check(self, q: PerDof, qd: PerDof, params: PyTree, name: str) -> None:
        """Check that psi is a number or a vector."""
        _check_vector(f"psi of VelocityConstraint {name!r}", self.psi, t=q[0], q=q, qd=qd, params=params)

    def force(self, t: Scalar, q: PerDof, params: PyTree, multiplier: Float[Array, " m"]) -> None:
        """None: the constraint has no point."""

    def per_multiplier(self, t: Scalar, q: PerDof, params: PyTree) -> Scalar:
        """One, if psi is a velocity."""
        return jnp.ones_like(t)


def _check_vector(role: str, fn: Callable[..., Any], **args: Any) -> None:
    shape = result_shape(fn, **args, name=role)
    if shape is None or len(shape) > 1 or shape == (0,):
        result = "no array" if shape is None else f"shape {shape}"
        raise ValueError(
            f"{role} must return one number or a vector, but it returned {result}. Return jnp.array([...]) with one"
            " entry for each equation."
        )


# Newton steps of a projection: each squares the error of an integration step.
_NEWTON = 2

Constraints = Sequence[AbstractEquations]


class LinearizedConstraints(NamedTuple):
    """All m equations of the constraints at one state.

    - `rows`: J, shape `[m, dof]`.
    - `bias`: rate of w for qdd = 0, with the stabilization terms, shape `[m]`.
    - `minv_jt`: rows `M^-1 J_k`, the accelerations by unit multipliers, shape `[m, dof]`.
    - `matrix`: `J M^-1 J^T`, shape `[m, m]`.
    """

    rows: Float[Array, "m dof"]
    bias: Float[Array, " m"]
    minv_jt: Float[Array, "m dof"]
    matrix: Float[Array, "m m"]

    def multipliers(self, qdd: Float[Array, "dof *k"]) -> Float[Array, "m *k"]:
        """Multipliers that make the accelerations `qdd` admissible; of k columns the first, the others are changes."""
        rate = apply_matrix(self.rows, qdd)
        bias = self.bias if qdd.ndim == 1 else jnp.pad(self.bias[:, None], ((0, 0), (0, qdd.shape[1] - 1)))
        return -solve_balanced(self.matrix, rate + bias)

    def respond(self, qdd: Float[Array, "dof *k"]) -> Float[Array, "dof *k"]:
        """Change of the accelerations if the unconstrained accelerations change by `qdd`, one or several."""
        return qdd - self.apply_force(solve_balanced(self.matrix, apply_matrix(self.rows, qdd)))

    def apply_force(self, multipliers: Float[Array, "m *k"]) -> Float[Array, "dof *k"]:
        """Accelerations by the multipliers."""
        return apply_matrix(self.minv_jt.T, multipliers)

    def force(self, multipliers: Float[Array, " m"]) -> PerDof:
        """Generalised force of the multipliers."""
        return jnp.sum(self.rows * multipliers[:, None], axis=0)


def linearize_constraints(
    constraints: Constraints, t: Scalar, q: PerDof, qd: PerDof, params: PyTree, mass: Float[Array, "dof dof"]
) -> LinearizedConstraints:
    """Linearize the constraints at one state of a mechanism with the mass matrix `mass`.

    **Returns:**

    The `LinearizedConstraints` of all m equations.
    """

    def along(t: Array, q: Array) -> Array:
        return rates(constraints, t, q, params)(qd)

    rows = _jacobian(rates(constraints, t, q, params), qd)
    w, bias = jax.jvp(along, (t, q), (jnp.ones_like(t), qd))
    for each, part in zip(constraints, parts(constraints, t, q, qd, params), strict=True):
        error, rate = each.error(t, q, params), jnp.asarray(each.stabilise, q.dtype)
        damped = rate * w[part] if error is None else 2.0 * rate * w[part] + rate**2 * error
        bias = bias.at[part].add(damped)
    return LinearizedConstraints(rows, bias, *_mobility(rows, mass))


def parts(constraints: Constraints, t: Scalar, q: PerDof, qd: PerDof, params: PyTree) -> list[slice]:
    """Slice of the equations of each constraint.

    **Returns:**

    A slice of the m equations for each constraint, in their order.
    """
    ends = list(accumulate(jax.eval_shape(each.rate, t, q, qd, params).shape[0] for each in constraints))
    return [slice(start, end) for start, end in zip([0, *ends], ends, strict=False)]


def errors(constraints: Constraints, t: Scalar, params: PyTree) -> Callable[[PerDof], Float[Array, " h"]]:
    """Residuals of all holonomic constraints as a function of the coordinates; h = 0 if there are none.

    **Returns:**

    A function from q, shape `[dof]`, to the residuals, shape `[h]`, in the units of the constraints.
    """

    def at(q: Array) -> Array:
        holonomic = [each.error(t, q, params) for each in constraints]
        return jnp.concatenate([jnp.zeros(0, q.dtype), *(error for error in holonomic if error is not None)])

    return at


def rates(constraints: Constraints, t: Scalar, q: PerDof, params: PyTree) -> Callable[[PerDof], Float[Array, " m"]]:
    """Residuals of all constraints as a function of the velocities.

    **Returns:**

    A function from qd, shape `[dof]`, to the residuals, shape `[m]`, in the units of the constraints per second.
    """

    def at(qd: Array) -> Array:
        return jnp.concatenate([each.rate(t, q, qd, params) for each in constraints])

    return at


def project(
    constraints: Constraints, t: Scalar, q: PerDof, qd: PerDof, params: PyTree, mass: Float[Array, "dof dof"]
) -> tuple[PerDof, PerDof]:
    """Project coordinates and velocities onto the constraints, by least changes in the metric of the mass matrix.

    Two steps of Newton's method change the coordinates, then two the velocities by the smallest impulses, all with the
    mass matrix and the Jacobian of the start. Of errors that are small, as those of a step, the third power is left.

    **Returns:**

    Coordinates and velocities, shape `[dof]` each.
    """
    error = errors(constraints, t, params)
    rows = _jacobian(error, q)
    minv_jt, matrix = _mobility(rows, mass)
    for _ in range(_NEWTON if rows.size else 0):
        q = q - jnp.sum(minv_jt * solve_balanced(matrix, error(q))[:, None], axis=0)
    rate = rates(constraints, t, q, params)
    if jax.eval_shape(rate, qd).shape != rows.shape[:1]:  # not all constraints are holonomic
        minv_jt, matrix = _mobility(_jacobian(rate, qd), mass)
    for _ in range(_NEWTON):
        qd = qd - jnp.sum(minv_jt * solve_balanced(matrix, rate(qd))[:, None], axis=0)
    return q, qd


def constraint_residual(
    constraints: Constraints, t: Scalar, q: PerDof, qd: PerDof, params: PyTree
) -> tuple[Scalar, Scalar]:
    """Distances of coordinates and velocities from the constraints, relative to their own size or to one.

    Each residual is divided by the length of its gradient. This distance from its own surface also reveals constraints
    that contradict each other. No derivatives.

    **Returns:**

    Both distances, shape `[]` each, >= 0.
    """
    q, qd = jax.lax.stop_gradient((q, qd))

    def distance_from(fn: Callable[[Array], Array], x: Array) -> Array:
        error, rows = fn(x), _jacobian(fn, x)
        slope = safe_norm(rows, axis=1)
        distance = jnp.abs(error) / jnp.where(slope > 0, slope, 1.0)
        return jnp.max(distance, initial=0.0) / jnp.maximum(1.0, jnp.max(jnp.abs(x)))

    return distance_from(errors(constraints, t, params), q), distance_from(rates(constraints, t, q, params), qd)


def _jacobian(fn: object, x: PerDof) -> Float[Array, "m dof"]:
    """Jacobian in reverse mode: there are never more independent constraints than coordinates."""
    return jax.jacrev(fn)(x)  # pyright: ignore[reportArgumentType]


def _mobility(rows: Float[Array, "m dof"], mass: Float[Array, "dof dof"]) -> tuple[Array, Array]:
    """Rows `M^-1 J_k`, and `J M^-1 J^T`."""
    minv_jt = factor_positive_definite(mass)(rows.T).T
    return minv_jt, jnp.sum(rows[:, None, :] * minv_jt[None, :, :], axis=2)
