"""Rodas5P: a Rosenbrock method of order 5 for stiff equations, as a diffrax solver."""

from collections.abc import Callable
from typing import ClassVar

import diffrax as dfx
import equinox as eqx
import numpy as np
from jaxtyping import PyTree

from .._core.arrays import Real
from ._equation import check_floating, check_ode, in_own_time
from ._rosenbrock import RosenbrockStep, RosenbrockTableau, rosenbrock_step
from ._state_layout import PolynomialInterpolation, State


def _lower(rows: tuple[tuple[float, ...], ...]) -> np.ndarray:
    """Square matrix from the rows of its strictly lower triangle."""
    table = np.zeros((len(rows), len(rows)))
    for i, row in enumerate(rows):
        table[i, : len(row)] = row
    return table


_STAGE = _lower(
    (
        (),
        (3.0,),
        (2.849394379747939, 0.45842242204463923),
        (-6.954028509809101, 2.489845061869568, -10.358996098473584),
        (2.8029986275628964, 0.5072464736228206, -0.3988312541770524, -0.04721187230404641),
        (-7.502846399306121, 2.561846144803919, -11.627539656261098, -0.18268767659942256, 0.030198172008377946),
        (-7.502846399306121, 2.561846144803919, -11.627539656261098, -0.18268767659942256, 0.030198172008377946, 1.0),
        (
            -7.502846399306121,
            2.561846144803919,
            -11.627539656261098,
            -0.18268767659942256,
            0.030198172008377946,
            1.0,
            1.0,
        ),
    ),
)
# Coefficients of `Rodas5P`.
RODAS5P = RosenbrockTableau(
    gamma=0.21193756319429014,
    stage=_STAGE,
    coupling=_lower(
        (
            (),
            (-14.155112264123755,),
            (-17.97296035885952, -2.859693295451294),
            (147.12150275711716, -1.41221402718213, 71.68940251302358),
            (165.43517024871676, -0.4592823456491126, 42.90938336958603, -5.961986721573306),
            (24.854864614690072, -3.0009227002832186, 47.4931110020768, 5.5814197821558125, -0.6610691825249471),
            (
                30.91273214028599,
                -3.1208243349937974,
                77.79954646070892,
                34.28646028294783,
                -19.097331116725623,
                -28.087943162872662,
            ),
            (
                37.80277123390563,
                -3.2571969029072276,
                112.26918849496327,
                66.9347231244047,
                -40.06618937091002,
                -54.66780262877968,
                -9.48861652309627,
            ),
        ),
    ),
    nodes=np.array(
        (0.0, 0.6358126895828704, 0.4095798393397535, 0.9769306725060716, 0.4288403609558664, 1.0, 1.0, 1.0)
    ),
    time=np.array(
        (
            0.21193756319429014,
            -0.42387512638858027,
            -0.3384627126235924,
            1.8046452872882734,
            2.325825639765069,
            0.0,
            0.0,
            0.0,
        )
    ),
    # Stiffly accurate: the solution is the last stage's point plus the last increment, which is the error estimate.
    solution=_STAGE[-1] + np.eye(8)[-1],
    error=np.eye(8)[-1],
    dense=np.array(
        (
            (
                25.948786856663858,
                -2.5579724845846235,
                10.433815404888879,
                -2.3679251022685204,
                0.524948541321073,
                1.1241088310450404,
                0.4272876194431874,
                -0.17202221070155493,
            ),
            (
                -9.91568850695171,
                -0.9689944594115154,
                3.0438037242978453,
                -24.495224566215796,
                20.176138334709044,
                15.98066361424651,
                -6.789040303419874,
                -6.710236069923372,
            ),
            (
                11.419903575922262,
                2.8879645146136994,
                72.92137995996029,
                80.12511834622643,
                -52.072871366152654,
                -59.78993625266729,
                -0.15582684282751913,
                4.883087185713722,
            ),
        )
    ),
)


# diffrax traces a step several times. As one function of jit it is traced, linearised and transposed once.
@eqx.filter_jit
def _step(method: "Rodas5P", terms: PyTree, t0: Real, t1: Real, y0: PyTree, args: PyTree) -> RosenbrockStep:
    field, start, length = in_own_time(terms, t0, t1, args)
    given, solver = method.linear_solver, None
    if given is not None:
        solver = lambda t, y, rate, shift: given(t, y, args, rate, shift, method.pivot)  # noqa: E731
    return rosenbrock_step(RODAS5P, field, start, length, y0, pivot=method.pivot, linear_solver=solver)


class Rodas5P(dfx.AbstractAdaptiveSolver):
    """Steinebach's Rodas5P for stiff equations: eight stages, order 5, L-stable, no iteration.

    It works in `diffrax.diffeqsolve` with an `ODETerm`, forward and backward in time, with adaptive or fixed steps and
    any adjoint, on any pytree of real floating arrays, in float32 and float64. Up to 12 state entries the linear
    algebra is unrolled to scalars, so that XLA compiles a step as a few loops; above, it is loops over rows.
    Dense output has order 4.

    **Arguments:**

    - `pivot`: whether the eliminations swap rows. Error control makes that unnecessary: it rejects a step with a bad
      pivot. Fixed steps have no such check, so `simulate(..., dt=...)` sets `pivot`.
    - `linear_solver`: `linear_solver(t, y, args, rate, shift, pivot)` -> the function from `rhs` to the solution of
      `(shift I - J) x = rhs`, both of the structure of `y`, with the Jacobian J of the field at (t, y), and the field
      `rate` there. By default J is formed column by column. `jaxmodsim.simulate` sets a solver that uses the structure
      of mechanics, for scenes with several coordinates; it must be differentiable in all numbers.

    **Raises:**

    - `ValueError` (while tracing) for complex or integer states, and for terms other than an `ODETerm`.

    **Example:**

    ```python
    stiff = diffrax.ODETerm(lambda t, y, args: 1e4 * (jnp.cos(t) - y))
    control = diffrax.PIDController(rtol=1e-6, atol=1e-6)
    solution = diffrax.diffeqsolve(stiff, jms.Rodas5P(), 0.0, 1.0, None, jnp.zeros(1), stepsize_controller=control)
    print(solution.stats["num_accepted_steps"], "steps to", solution.ys[-1].round(5))
    ```

    ```text
    22 steps to [0.54039]
    ```

    ??? cite "Reference"

        ```bibtex
        @article{steinebach2023rodas5p,
            author={Steinebach, Gerd},
            title={Construction of {R}osenbrock--{W}anner method {R}odas5{P} and numerical benchmarks within the
                   {J}ulia {D}ifferential {E}equations package},
            journal={BIT Numerical Mathematics}, volume={63}, number={27}, year={2023},
        }
        ```
    """

    pivot: bool = eqx.field(default=False, static=True)
    linear_solver: Callable[..., Callable[[State], State]] | None = None
    # Not `ODETerm`: `diffrax.BacksolveAdjoint` solves its adjoint equation, a term of another class.
    term_structure: ClassVar = dfx.AbstractTerm
    interpolation_cls: ClassVar = PolynomialInterpolation

    def order(self, terms: PyTree) -> int:
        """Order of the solution: 5."""
        del terms
        return 5

    def error_order(self, terms: PyTree) -> int:
        """Local order of the error estimate, that of the embedded method of order 4: 5."""
        del terms
        return 5

    def init(self, terms: PyTree, t0: Real, t1: Real, y0: PyTree, args: PyTree) -> None:
        """No memory from step to step; refuses terms and states of a wrong type."""
        del t0, t1, args
        check_ode(terms, method="Rodas5P")
        check_floating(y0, method="Rodas5P")

    def func(self, terms: PyTree, t0: Real, y0: PyTree, args: PyTree) -> PyTree:
        """The vector field."""
        return terms.vf(t0, y0, args)

    def step(
        self, terms: PyTree, t0: Real, t1: Real, y0: PyTree, args: PyTree, solver_state: None, made_jump: Real
    ) -> tuple[PyTree, PyTree, dict[str, PyTree], None, dfx.RESULTS]:
        """One step; see `rosenbrock_step`."""
        del solver_state, made_jump
        step = _step(self, terms, t0, t1, y0, args)
        return step.y1, step.error, {"y0": y0, "y1": step.y1, "k": step.dense}, None, dfx.RESULTS.successful
