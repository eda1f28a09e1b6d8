"""Ways to run one problem: solvers, steps, floating types, formulations of its friction."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import diffrax as dfx
import equinox as eqx

from ..friction import AbstractSetValuedLaw, DeadZone, LuGre, Regularized
from ..scene import Friction, Scene
from ..solvers import Rodas5P

_DTYPES = ("float32", "float64")


@dataclass(frozen=True)
class Method:
    """One way to run a problem; each of its settings becomes a row of `work_precision`.

    - `solver`: any diffrax solver, also `jaxmodsim.Rodas5P`, `Gauss`, `ImplicitFriction`; by default the one that
      `simulate` chooses.
    - `scene`: another formulation of the problem, such as one of `formulations`; None for the problem's own scene. Its
      coordinates must be the same.
    - `steps`: fixed steps [s], > 0, in place of tolerances.
    - `dtype`: `"float32"` or `"float64"`; by default that of the scene.
    """

    solver: dfx.AbstractSolver | None = None
    scene: Scene | None = None
    steps: Sequence[float] | None = None
    dtype: str | None = None

    def __post_init__(self) -> None:
        """Refuse what is no way to run a scene."""
        if self.solver is not None and not isinstance(self.solver, dfx.AbstractSolver):
            raise ValueError(f"solver must be a diffrax solver, as in diffrax.Tsit5(), but {self.solver!r} was given.")
        if self.scene is not None and not isinstance(self.scene, Scene):
            raise ValueError(f"scene must be a Scene, but a {type(self.scene).__name__} was given.")
        if self.steps is not None and (not len(self.steps) or any(not x > 0 for x in self.steps)):
            raise ValueError(f"steps must be fixed steps [s], > 0, as in (1e-3, 1e-4), but {self.steps!r} was given.")
        if self.dtype not in (None, *_DTYPES):
            raise ValueError(f"dtype must be 'float32' or 'float64', but {self.dtype!r} was given.")


def default_methods(scene: Scene) -> dict[str, Method]:
    """Solvers that a careful user would try on the scene."""
    if scene.mode_names:
        solvers = (Rodas5P(), dfx.Tsit5())
    elif any(effect.stiff for effect in scene.effects):
        solvers = (Rodas5P(), dfx.Kvaerno5(), dfx.Tsit5())
    else:
        solvers = (dfx.Tsit5(), dfx.Dopri8(), Rodas5P())
    return {type(solver).__name__: Method(solver) for solver in solvers}


def formulations(scene: Scene, *, width: float, sigma0: float | None = None, sigma1: float = 0.0) -> dict[str, Scene]:
    """The scene with its set-valued laws in other formulations, by name.

    ```python
    methods = {"exact": Method()}
    for name, other in formulations(scene, width=1e-3).items():
        methods[name] = Method(scene=other, steps=(1e-3, 1e-4) if name == "DeadZone" else None)
    ```

    `DeadZone` needs fixed steps: its field jumps at the edges of the band.

    **Arguments:**

    - `scene`: a `Scene` with set-valued laws that run exactly (`Coulomb`, `Stribeck`).
    - `width`: of `Regularized` and `DeadZone` [m/s or rad/s], > 0.
    - `sigma0`: stiffness of the bristles of `LuGre` [N/m], > 0; None for no such formulation. Of `Coulomb` with
      stiction the force falls over the velocity `width`.
    - `sigma1`: damping of the bristles [N s/m], >= 0.

    **Returns:**

    Scenes under `Regularized`, `DeadZone` and, with `sigma0`, `LuGre`.

    **Raises:**

    - `ValueError` if no law of the scene is set-valued, numbers are out of range, or with `sigma0` for a law other than
      `Coulomb` and the Gaussian `Stribeck`.
    """
    if not isinstance(scene, Scene):
        raise ValueError(f"formulations needs a Scene, but a {type(scene).__name__} was given.")
    at = [i for i, effect in enumerate(scene.effects) if isinstance(effect, Friction) and effect.event_driven]
    if not at:
        raise ValueError(
            "No law of this scene is set-valued: other formulations are there for Coulomb, Stribeck and laws made of"
            " them."
        )

    def laws(scene: Scene) -> list[Any]:
        return [scene.effects[i].law for i in at]  # pyright: ignore[reportAttributeAccessIssue]

    scenes = {
        "Regularized": eqx.tree_at(laws, scene, [Regularized(law, width) for law in laws(scene)]),
        "DeadZone": eqx.tree_at(laws, scene, [DeadZone(law, width) for law in laws(scene)]),
    }
    if sigma0 is not None:
        scenes["LuGre"] = eqx.tree_at(laws, scene, [_bristle(law, width, sigma0, sigma1) for law in laws(scene)])
    return scenes


def _bristle(law: AbstractSetValuedLaw, width: float, sigma0: float, sigma1: float) -> LuGre:
    numbers = law.lugre_numbers(width)
    if numbers is None:
        raise ValueError(
            "LuGre takes the place of Coulomb and of the Gaussian Stribeck, but the law is"
            f" {law}. Leave out sigma0, and build the bristle's scene yourself."
        )
    return LuGre(sigma0=sigma0, sigma1=sigma1, **numbers)
