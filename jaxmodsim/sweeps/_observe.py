"""What a sweep observes in each run."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TypeAlias

import jax.numpy as jnp
from jaxtyping import Array

from .._core.arguments import as_names
from .._core.trace_checks import check_indices
from ..simulation import Trajectory, named_series
from ._grid import RESERVED

# A function of the run that returns real numbers, or a name as in `simulation.named_series`.
Observable: TypeAlias = Callable[[Trajectory], object] | str


@dataclass(frozen=True)
class Derivative:
    """Derivatives of an observable by numbers of the run, for `observe` of `sweep`.

    ```python
    slopes = jaxmodsim.sweeps.Derivative("qd[0]", ("m", "friction.Fc"))
    jaxmodsim.sweep(scene, {"k": stiffnesses}, {"v": "qd[0]", "dv": slopes}, ...)
    ```

    In forward mode, through all events, together with the run itself: n derivatives cost about `2 + 0.1 n` plain runs.

    **Arguments:**

    - `of`: the observable, a function of the run or a name.
    - `wrt`: names of single numbers as `over` has them: of the scene, or `q0[0]`, `t1` and so on. A tuple of them gives
      the result a dimension with their names; a name alone does not.
    """

    of: Observable
    wrt: tuple[str, ...] | str

    def __post_init__(self) -> None:
        """Refuse what is no name."""
        names = (self.wrt,) if isinstance(self.wrt, str) else as_names(self.wrt, name="wrt")
        if not names or len(set(names)) < len(names):
            raise ValueError(f"wrt must be a name or a tuple of different names, but {self.wrt!r} was given.")
        object.__setattr__(self, "wrt", self.wrt if isinstance(self.wrt, str) else names)

    @property
    def names(self) -> tuple[str, ...]:
        """The numbers to differentiate by."""
        return (self.wrt,) if isinstance(self.wrt, str) else tuple(self.wrt)


@dataclass(frozen=True)
class Observation:
    """One variable of the result."""

    name: str
    of: Observable | Derivative
    unit: str

    @property
    def value(self) -> Observable:
        """What is evaluated; of a derivative, what is differentiated."""
        return self.of.of if isinstance(self.of, Derivative) else self.of


def observations(observe: object) -> tuple[Observation, ...]:
    """Read what a sweep is to observe.

    **Raises:**

    - `ValueError` for what is neither names nor a mapping of names to functions, names and derivatives.
    """
    if isinstance(observe, str):
        observe = (observe,)
    if isinstance(observe, list | tuple) and observe and all(isinstance(name, str) for name in observe):
        observe = {name: name for name in observe}
    if not isinstance(observe, Mapping) or not observe:
        raise ValueError(
            "observe must say what to keep of each run, as in observe={'v_end': lambda run: run.qd[-1, 0]} or"
            f" observe=['q[0]', 'friction'], but {observe!r} was given."
        )
    return tuple(_observation(name, given) for name, given in observe.items())


def _observation(name: object, given: object) -> Observation:
    unit = None
    if isinstance(given, tuple) and len(given) == 2 and isinstance(given[1], str):
        given, unit = given
    if not isinstance(name, str) or "/" in name:
        raise ValueError(f"observe needs names without a slash, which parts of a store have, but {name!r} was given.")
    if name in RESERVED:
        raise ValueError(f"observe cannot have the name {name!r}: every result has it.")
    if not (isinstance(given, str | Derivative) or callable(given)):
        raise ValueError(
            f"observe[{name!r}] must be a function of the run, a name such as 'q[0]', or one of these with its unit, as"
            f" in (lambda run: run.t[-1], 's'), but {given!r} was given."
        )
    if unit is None:
        unit = getattr(given, "unit", "")
    return Observation(name, given, unit if isinstance(unit, str) else "")


def observed(what: Observation, run: Trajectory, alone: bool) -> Array:
    """The value of an observable; of a named one without the time axis where the run keeps its end `alone`.

    **Raises:**

    - `ValueError` for what is no array of real numbers, and for an index out of range; see `traced`.
    """
    of = what.value
    if isinstance(of, str):
        value = named_series(run, of)
        return value[-1] if alone else value
    check_indices(lambda: of(run), name=f"observe[{what.name!r}]")
    return real(what.name, of(run))


def real(name: str, value: object) -> Array:
    """As a floating array.

    **Raises:**

    - `ValueError` for what is none.
    """
    try:
        value = jnp.asarray(value)
    except (TypeError, ValueError):
        kind = type(value).__name__
        raise ValueError(f"{name!r} must be an array of real numbers, but it returned a {kind}.") from None
    if jnp.issubdtype(value.dtype, jnp.complexfloating):
        raise ValueError(f"{name!r} must be real, but it is complex: observe real and imaginary part apart.")
    return value if jnp.issubdtype(value.dtype, jnp.floating) else value.astype(jnp.result_type(float))
