"""Charts and their frames against textbook formulas and against derivatives by complex steps."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxmodsim as jms
from jaxmodsim.mechanics._charts import AbstractChart

SAMPLES = 400
METHODS = {  # name -> how many of q, qd, qdd it takes
    "position": 1,
    "jacobian": 1,
    "scale_factors": 1,
    "basis": 1,
    "right_handed": 1,
    "angular_velocity": 2,
    "velocity": 2,
    "acceleration": 3,
}
NEED_A_FRAME = ("basis", "right_handed", "angular_velocity", "velocity", "acceleration")


def draw(low: Any, high: Any, *shape: int, seed: int) -> jax.Array:
    return jnp.asarray(np.random.default_rng(seed).uniform(low, high, (*shape, 3)))


QD, QDD = draw(-3, 3, SAMPLES, seed=1), draw(-3, 3, SAMPLES, seed=2)


def close(ours: Any, wanted: Any, tolerance: float = 1e-12) -> None:
    """Equal to `tolerance` of the largest entry (at least of one)."""
    assert ours.shape == wanted.shape
    np.testing.assert_allclose(ours, wanted, rtol=0, atol=tolerance * max(1.0, float(np.abs(wanted).max())))


# CylindricalTextbook components, at one point.


class CylindricalTextbook:
    """Cylindrical coordinates (r, theta, z)."""

    chart: AbstractChart = jms.Cylindrical()
    q = draw([0.1, -4, -2], [3, 4, 2], SAMPLES, seed=3)
    pole = 0  # the coordinate that is zero there

    @staticmethod
    def scale_factors(q: Any) -> Any:
        return jnp.stack([jnp.ones_like(q[0]), q[0], jnp.ones_like(q[0])])

    @staticmethod
    def basis(q: Any) -> Any:
        s, c, o = jnp.sin(q[1]), jnp.cos(q[1]), jnp.zeros_like(q[1])
        return jnp.stack([jnp.stack([c, -s, o]), jnp.stack([s, c, o]), jnp.stack([o, o, o + 1])])

    @staticmethod
    def angular_velocity(q: Any, qd: Any) -> Any:
        del q
        return jnp.stack([0 * qd[0], 0 * qd[0], qd[1]])

    @staticmethod
    def velocity(q: Any, qd: Any) -> Any:
        return jnp.stack([qd[0], q[0] * qd[1], qd[2]])

    @staticmethod
    def acceleration(q: Any, qd: Any, qdd: Any) -> Any:
        return jnp.stack([qdd[0] - q[0] * qd[1] ** 2, q[0] * qdd[1] + 2 * qd[0] * qd[1], qdd[2]])


class SphericalTextbook:
    """Spherical coordinates (r, phi, theta)."""

    chart: AbstractChart = jms.Spherical()
    q = draw([0.1, 0.1, -4], [3, np.pi - 0.1, 4], SAMPLES, seed=4)
    pole = 1

    @staticmethod
    def scale_factors(q: Any) -> Any:
        return jnp.stack([jnp.ones_like(q[0]), q[0], q[0] * jnp.sin(q[1])])

    @staticmethod
    def basis(q: Any) -> Any:
        (s, c), (st, ct) = (jnp.sin(q[1]), jnp.cos(q[1])), (jnp.sin(q[2]), jnp.cos(q[2]))
        return jnp.stack([jnp.stack([s * ct, c * ct, -st]), jnp.stack([s * st, c * st, ct]), jnp.stack([c, -s, 0 * s])])

    @staticmethod
    def angular_velocity(q: Any, qd: Any) -> Any:
        return jnp.stack([jnp.cos(q[1]) * qd[2], -jnp.sin(q[1]) * qd[2], qd[1]])

    @staticmethod
    def velocity(q: Any, qd: Any) -> Any:
        return jnp.stack([qd[0], q[0] * qd[1], q[0] * jnp.sin(q[1]) * qd[2]])

    @staticmethod
    def acceleration(q: Any, qd: Any, qdd: Any) -> Any:
        r, s, c = q[0], jnp.sin(q[1]), jnp.cos(q[1])
        return jnp.stack(
            [
                qdd[0] - r * qd[1] ** 2 - r * s**2 * qd[2] ** 2,
                r * qdd[1] + 2 * qd[0] * qd[1] - r * s * c * qd[2] ** 2,
                r * s * qdd[2] + 2 * qd[0] * qd[2] * s + 2 * r * qd[1] * qd[2] * c,
            ]
        )


textbooks = pytest.mark.parametrize("book", [CylindricalTextbook, SphericalTextbook], ids=["cylindrical", "spherical"])


@pytest.mark.quick
@textbooks
@pytest.mark.parametrize("method", ["scale_factors", "basis", "angular_velocity", "velocity", "acceleration"])
def test_textbook_components(book: Any, method: str) -> None:
    states = (book.q, QD, QDD)[: METHODS[method]]
    close(getattr(book.chart, method)(*states), jax.vmap(getattr(book, method))(*states))


@textbooks
def test_position_and_frame_agree(book: Any) -> None:
    """E is a rotation, E v the velocity in space: of the position, through its Jacobian and by a difference."""
    chart, q = book.chart, book.q
    basis = np.asarray(chart.basis(q))
    close(np.swapaxes(basis, 1, 2) @ basis, np.broadcast_to(np.eye(3), basis.shape), 1e-14)
    close(np.linalg.det(basis), np.ones(SAMPLES))
    assert np.all(chart.right_handed(q))
    spatial = np.einsum("nij,nj->ni", basis, chart.velocity(q, QD))
    close(spatial, np.einsum("nij,nj->ni", chart.jacobian(q), QD))
    step = 1e-5  # a central difference: error step^2 times a third derivative (some 200 here), roundings 1e-16/step
    difference = (chart.position(q + step * QD) - chart.position(q - step * QD)) / (2 * step)
    close(spatial, np.asarray(difference), 1e-7)


# Poles. The formulas hold there too, and are smooth.


@textbooks
def test_poles_in_value_and_derivative(book: Any) -> None:
    distances = jnp.repeat(jnp.array([0.0, 1e-200, 1e-12]), 7)
    q, qd, qdd = (x[: len(distances)] for x in (book.q, QD, QDD))
    q = q.at[:, book.pole].set(distances)
    assert np.all(book.chart.right_handed(q))
    close(book.chart.basis(q), jax.vmap(book.basis)(q))

    def with_slopes(of: Any, derivative: Any) -> Any:
        def components(q: Any, qd: Any, qdd: Any) -> Any:
            # By qdd the acceleration has the derivatives that the velocity has by qd.
            return jnp.stack([of.angular_velocity(q, qd), of.acceleration(q, qd, qdd)])

        return jax.jit(jax.vmap(lambda *x: (components(*x), *derivative(components, (0, 1, 2))(*x))))(q, qd, qdd)

    for ours, wanted in zip(with_slopes(book.chart, jax.jacrev), with_slopes(book, jax.jacfwd), strict=True):
        close(ours, wanted)


@textbooks
def test_second_derivatives_at_the_pole(book: Any) -> None:
    q, qd = book.q[0].at[book.pole].set(0.0), QD[0]
    ours, wanted = (jax.jit(jax.hessian(of.angular_velocity))(q, qd) for of in (book.chart, book))
    close(ours, wanted)


def test_lower_pole() -> None:
    """A floating sine of pi is not zero; the direction of so short a tangent is still right."""
    q = SphericalTextbook.q[:7].at[:, 1].set(np.pi)
    close(jms.Spherical().angular_velocity(q, QD[:7]), jax.vmap(SphericalTextbook.angular_velocity)(q, QD[:7]))


@textbooks
def test_scale_factors_at_the_pole(book: Any) -> None:
    """The length |h| of the vanishing tangent has a kink there, and the derivative zero; the others have their own."""
    q = book.q[0].at[book.pole].set(0.0)
    close(book.chart.scale_factors(q), book.scale_factors(q), 0.0)
    vanishing = book.scale_factors(q) == 0
    expected = jnp.where(vanishing[:, None], 0.0, jax.jacfwd(book.scale_factors)(q))
    for derivative in (jax.jacfwd, jax.jacrev):
        close(derivative(book.chart.scale_factors)(q), expected)


@textbooks
def test_beyond_the_pole_the_frame_is_left_handed(book: Any) -> None:
    """The turned tangent takes its vector along; the angular velocity is that of the frame all the same."""
    q = (-book.q[:7]).at[:, 1 - book.pole].multiply(-1)
    assert not np.any(book.chart.right_handed(q))  # Spherical: r > 0, phi < 0
    basis, omega = book.chart.basis(q), book.chart.angular_velocity(q, QD[:7])
    rate = jax.jvp(book.chart.basis, (q,), (QD[:7],))[1]
    spatial = jnp.einsum("nij,nj->ni", basis, omega)
    close(jnp.cross(spatial[:, None, :], jnp.swapaxes(basis, 1, 2)), jnp.swapaxes(rate, 1, 2))


# Any chart: Gram-Schmidt written once more, on tangents written by hand, differentiated by complex steps.


def spherical_reordered(q: Any) -> Any:
    """(r, theta, phi): orthogonal and left-handed."""
    r, theta, phi = q
    return jnp.stack([r * jnp.sin(phi) * jnp.cos(theta), r * jnp.sin(phi) * jnp.sin(theta), r * jnp.cos(phi)])


def spherical_reordered_tangents(q: Any) -> Any:
    r, s, c, st, ct = q[0], np.sin(q[2]), np.cos(q[2]), np.sin(q[1]), np.cos(q[1])
    return [[s * ct, s * st, c], [-r * s * st, r * s * ct, 0 * r], [r * c * ct, r * c * st, -r * s]]


def elliptic(q: Any) -> Any:
    """Elliptic cylinder: orthogonal, right-handed, unequal scale factors."""
    return jnp.stack([jnp.cosh(q[0]) * jnp.cos(q[1]), jnp.sinh(q[0]) * jnp.sin(q[1]), q[2]])


def elliptic_tangents(q: Any) -> Any:
    ch, sh, s, c, o = np.cosh(q[0]), np.sinh(q[0]), np.sin(q[1]), np.cos(q[1]), 0 * q[0]
    return [[sh * c, ch * s, o], [-ch * s, sh * c, o], [o, o, o + 1]]


def skew(q: Any) -> Any:
    """Parabolic coordinates, sheared: no two tangents are normal to each other; left-handed."""
    u, v, w = q
    return jnp.stack([u * v + 0.3 * w, 0.5 * (u**2 - v**2) + 0.2 * w * u, w + 0.4 * v])


def skew_tangents(q: Any) -> Any:
    u, v, w = q
    return [[v, u + 0.2 * w, 0 * u], [u, -v, 0.4 + 0 * u], [0.3 + 0 * u, 0.2 * u, 1 + 0 * u]]


def gram_schmidt(tangents: Any) -> Any:
    """On complex arrays `[samples, 3]`, with a product that is analytic."""
    frame: list[Any] = []
    for tangent in tangents:
        for unit in frame:
            tangent = tangent - (tangent * unit).sum(1, keepdims=True) * unit
        frame.append(tangent / np.sqrt((tangent * tangent).sum(1, keepdims=True)))
    return frame


@pytest.mark.parametrize(
    ("position", "tangents", "right_handed"),
    [
        (spherical_reordered, spherical_reordered_tangents, False),
        (elliptic, elliptic_tangents, True),
        (skew, skew_tangents, False),
    ],
)
def test_any_chart(position: Callable[..., Any], tangents: Callable[..., Any], right_handed: bool) -> None:
    chart, q = jms.Chart(position), draw([0.5, 0.5, 0.5], [1.5, 1.5, 1.5], SAMPLES, seed=5)
    step = 1e-100  # a complex step has no difference to round, so it may be as short as this

    def at(q: Any) -> Any:
        return [np.stack(tangent, axis=1) for tangent in tangents(np.asarray(q).T)]

    moved = at(q + 1j * step * QD)
    jacobian = np.stack(at(q), axis=2)
    jacobian_rate = np.imag(np.stack(moved, axis=2)) / step
    frame = np.stack(gram_schmidt(at(q)), axis=2)
    rate = np.imag(np.stack(gram_schmidt(moved), axis=2)) / step
    turn = rate @ np.swapaxes(frame, 1, 2)  # the matrix of the cross product with the angular velocity in space
    spatial = np.stack([turn[:, 2, 1], turn[:, 0, 2], turn[:, 1, 0]], axis=1)

    def components(vector: Any) -> Any:
        return np.einsum("nji,nj->ni", frame, vector)

    def times(matrix: Any, vector: Any) -> Any:
        return np.einsum("nij,nj->ni", matrix, vector)

    close(chart.jacobian(q), jacobian)
    close(chart.scale_factors(q), np.linalg.norm(jacobian, axis=1))
    close(chart.basis(q), frame)
    close(chart.angular_velocity(q, QD), components(spatial))
    close(chart.velocity(q, QD), components(times(jacobian, QD)))
    close(chart.acceleration(q, QD, QDD), components(times(jacobian, QDD) + times(jacobian_rate, QD)))
    close(jax.jvp(chart.basis, (q,), (QD,))[1], rate)
    np.testing.assert_array_equal(chart.right_handed(q), np.full(SAMPLES, right_handed))


class Screw(eqx.Module):
    """Cylindrical coordinates whose z is counted from a screw surface that climbs by `pitch` [m/rad]."""

    pitch: jax.Array

    def __call__(self, q: Any) -> Any:
        return jnp.stack([q[0] * jnp.cos(q[1]), q[0] * jnp.sin(q[1]), q[2] + self.pitch * q[1]])


@pytest.mark.parametrize("through", [lambda p: jms.Chart(Screw(p)), lambda p: jms.Chart(lambda q: Screw(p)(q))])
def test_derivative_by_a_number_of_the_chart(through: Callable[..., jms.Chart]) -> None:
    """v = (r', h theta' + z' p/h, z' r/h) with h = sqrt(r^2 + p^2); the number is a leaf, or closed over."""
    q, qd, p = jnp.array([1.1, 0.4, -0.3]), jnp.array([0.7, -1.2, 0.9]), jnp.array(0.6)
    r, h = 1.1, np.hypot(1.1, 0.6)
    close(through(p).velocity(q, qd), np.array([0.7, -1.2 * h + 0.9 * 0.6 / h, 0.9 * r / h]))
    wanted = np.array([0.0, -1.2 * 0.6 / h + 0.9 * r**2 / h**3, -0.9 * r * 0.6 / h**3])
    close(jax.jacrev(lambda p: through(p).velocity(q, qd))(p), wanted)
    close(jax.jacfwd(lambda p: through(p).velocity(q, qd))(p), wanted)


def test_numbers_of_a_chart_are_leaves() -> None:
    assert jax.tree.leaves(jms.Chart(Screw(jnp.array(0.6)))) == [0.6]
    assert jax.tree.leaves(jms.Chart(skew)) == []


@pytest.mark.parametrize("missing", [0, 1, 2])
def test_whichever_tangent_is_missing(missing: int) -> None:
    """Cylindrical coordinates with theta in any place: on the axis the frame is completed to a right-handed one."""
    order = [1, 0, 2] if missing == 0 else [0, 1, 2] if missing == 1 else [0, 2, 1]
    chart = jms.Chart(lambda q: jms.Cylindrical().position(jnp.stack([q[order.index(i)] for i in range(3)])))
    axis = jnp.array([0.0, 0.8, 0.5])[jnp.array(order)]
    wanted = np.array(CylindricalTextbook.basis(jnp.array([1.0, 0.8, 0.5])))[:, order]
    wanted[:, missing] *= np.linalg.det(wanted)
    close(chart.basis(axis), wanted, 1e-15)
    assert chart.right_handed(axis)


# Where there is no frame.

ORIGIN = jnp.array([0.0, 0.4, 0.7])
ONES = jnp.ones(3)
SENTENCE = r"more than one of the three tangents .* is zero, or they are linearly.*Avoid such points"


@pytest.mark.parametrize("method", NEED_A_FRAME)
def test_no_frame_is_an_error(method: str) -> None:
    with pytest.raises(RuntimeError, match=SENTENCE):
        getattr(jms.Spherical(), method)(ORIGIN, *(ONES, ONES)[: METHODS[method] - 1])


@pytest.mark.parametrize(
    ("run", "given"),
    [
        (jax.jit(jms.Spherical().basis), ORIGIN),
        (jax.grad(lambda q: jms.Spherical().velocity(q, ONES).sum()), ORIGIN),
        (jax.vmap(jms.Spherical().basis), jnp.stack([ONES, ORIGIN])),  # one sick lane is enough
    ],
    ids=["jit", "grad", "vmap"],
)
def test_no_frame_is_an_error_when_transformed(run: Callable[..., Any], given: jax.Array) -> None:
    with pytest.raises(RuntimeError, match=SENTENCE):
        jax.block_until_ready(run(given))


def test_what_needs_no_frame_stays_finite() -> None:
    chart = jms.Spherical()
    close(chart.position(ORIGIN), np.zeros(3))
    close(chart.jacobian(ORIGIN)[:, 1:], np.zeros((3, 2)))
    close(chart.scale_factors(ORIGIN), np.array([1.0, 0.0, 0.0]))
    assert np.all(np.isfinite(jax.jacrev(chart.scale_factors)(ORIGIN)))


def leaning(angle: float) -> Callable[[Any], Any]:
    """Three tangents in general position, of which two enclose `angle`; lengths from 1e-9 to 1e6."""
    first, second = np.array([1.0, -2.0, 2.0]) / 3, np.array([2.0, 2.0, 1.0]) / 3
    tangents = np.stack([1e-9 * first, 1e6 * (np.cos(angle) * first + np.sin(angle) * second), [0.3, 0.1, -1.0]])
    return lambda q: jnp.sum(jnp.asarray(tangents.T, q.dtype) * q[None, :], axis=1)


@pytest.mark.parametrize(("dtype", "apart", "dependent"), [(jnp.float64, 1e-11, 1e-15), (jnp.float32, 1e-3, 3e-7)])
def test_nearly_dependent_tangents(dtype: Any, apart: float, dependent: float) -> None:
    q = jnp.ones(3, dtype)
    basis = np.asarray(jms.Chart(leaning(apart)).basis(q))
    np.testing.assert_allclose(basis.T @ basis, np.eye(3), atol=4 * float(jnp.finfo(dtype).eps))
    with pytest.raises(RuntimeError, match=SENTENCE):
        jms.Chart(leaning(dependent)).basis(q)


def test_not_a_number_passes() -> None:
    """A solver that tries a bad step sees it, instead of an error about tangents."""
    assert np.all(np.isnan(jms.Spherical().velocity(jnp.full(3, jnp.nan), ONES)))


# Arrays.


@pytest.mark.parametrize("method", METHODS)
def test_a_batch_is_a_loop(method: str) -> None:
    states = [x[:6].reshape(2, 3, 3) for x in (SphericalTextbook.q, QD, QDD)][: METHODS[method]]
    function = getattr(jms.Spherical(), method)
    batch = function(*states)
    loop = [[function(*(x[i, j] for x in states)) for j in range(3)] for i in range(2)]
    assert batch.shape == np.shape(loop)
    np.testing.assert_allclose(batch, loop, rtol=0, atol=1e-14)


@pytest.mark.parametrize("method", METHODS)
def test_single_precision(method: str) -> None:
    function, given = getattr(jms.Spherical(), method), [SphericalTextbook.q, QD, QDD][: METHODS[method]]
    single = function(*(x.astype(jnp.float32) for x in given))
    assert single.dtype == (bool if method == "right_handed" else jnp.float32)
    close(single.astype(float), function(*given).astype(float), 2e-6)


@textbooks
def test_poles_in_single_precision(book: Any) -> None:
    q, qd = (x[:21].astype(jnp.float32) for x in (book.q, QD))
    q = q.at[:, book.pole].set(jnp.repeat(jnp.array([0.0, 1e-30, 1e-12], jnp.float32), 7))
    close(book.chart.angular_velocity(q, qd), jax.vmap(book.angular_velocity)(q, qd), 1e-6)
    # Derivatives by r divide roundings by r, here 0.15 and more.
    slope = jax.jit(jax.vmap(jax.jacfwd(book.chart.angular_velocity)))(q, qd)
    close(slope, jax.vmap(jax.jacfwd(book.angular_velocity))(q, qd), 1e-5)


def test_integers_and_lists() -> None:
    wanted = jms.Cylindrical().velocity(jnp.array([2.0, 1.0, 0.0]), jnp.array([1.0, 3.0, -1.0]))
    assert wanted.dtype == jnp.float64
    for q in ([2, 1, 0], (2.0, 1.0, 0.0), np.array([2, 1, 0]), jnp.array([2, 1, 0])):
        ours = jms.Cylindrical().velocity(q, [1, 3, -1])
        assert ours.dtype == wanted.dtype
        np.testing.assert_array_equal(ours, wanted)


@pytest.mark.parametrize(
    ("call", "text"),
    [
        (lambda: jms.Cylindrical().basis([1.0, 2.0]), r"q must have the shape \[..., 3\].*has the shape \[2\]"),
        (lambda: jms.Cylindrical().position(jnp.ones((3, 2))), r"q must have the shape .*\[3, 2\]"),
        (lambda: jms.Spherical().scale_factors(1.0), r"q must have the shape .*\[\]"),
        (lambda: jms.Spherical().velocity(ONES, ONES[None]), r"qd must have the shape of q, \[3\], .*\[1, 3\]"),
        (lambda: jms.Spherical().acceleration(ONES, ONES, [1.0, 2.0]), r"qdd must have the shape of q.*\[2\]"),
        (lambda: jms.Spherical().basis(ONES * 1j), "q must be a real number or an array of real numbers"),
        (lambda: jms.Chart(3.0), "Chart position must be a function, but 3.0 was given"),
        (lambda: jms.Chart(lambda q: q[:2]).basis(ONES), r"of shape \[3\], .*it returned float64\[2\]"),
        (lambda: jms.Chart(lambda q: q[None]).position(ONES), r"it returned float64\[1, 3\]"),
        (lambda: jms.Chart(lambda q: [q[0], q[1], q[2]]).velocity(ONES, ONES), "a list. Return jnp.stack"),
        (lambda: jms.Chart(lambda q: jnp.arange(3) + 0 * q.astype(int)).basis(ONES), r"it returned int64\[3\]"),
        (lambda: jms.Chart(lambda q: None).position(ONES), "it returned a NoneType"),
    ],
)
def test_wrong_structure(call: Callable[[], Any], text: str) -> None:
    with pytest.raises(ValueError, match=text):
        call()
