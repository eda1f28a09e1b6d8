"""Laws whose parameters depend on the state of the mechanism."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import TypeVar

import equinox as eqx
from jaxtyping import ArrayLike

from ..._core.arguments import as_names
from ..._core.parameters import modules_of, ranges_of
from ..._core.state_dependent import StateDependent, as_state_function
from .._law import AbstractLaw

_Law = TypeVar("_Law")
_Module = TypeVar("_Module", bound=eqx.Module)


def scaled_by(law: _Law, fn: object, parameters: Sequence[str] | None = None) -> _Law:
    """A law whose force, or some of whose parameters, are multiplied by a function of the mechanism's state.

    Friction that depends on position (`lambda t, q, qd, p: 1 + 0.2 * jnp.sin(q[0] / p["pitch"])`), on load or
    temperature (entries of `params`), on time. Works on any law, wrapped or not, and several times over.

    **Arguments:**

    - `law`: any law.
    - `fn`: `fn(t, q, qd, params)` returns the factor, one number; zero and below count as 1e-30. Numbers that are to
      be differentiated or fitted belong into `params`, not into `fn`. In `fit_law`, q and qd are the slip and its
      velocity, shape `[1]`, and `params` holds the record's inputs.
    - `parameters`: names of the parameters that are multiplied, in all parts of the law that have them; by default all
      those that carry newtons (`Fc`, `sigma0`, ...), which multiplies the force.

    **Returns:**

    A law of the same kind. It has values only at a state: `law.bind_state(t, q, qd, params)`.

    **Raises:**

    - `ValueError` if `law` is no law, `fn` no function, or a name is not one of its parameters.

    The factor should keep the parameters in their ranges (Fs >= Fc): that is not checked along a run.
    """
    if not isinstance(law, AbstractLaw):
        raise ValueError(f"scaled_by needs a law, but {law!r} was given; of a function of velocity make a Curve(fn).")
    factor = as_state_function(fn, name="scaled_by fn")
    known = {name: r.unit for _, module in modules_of(law) for name, r in ranges_of(module).items()}
    chosen = (
        [name for name, unit in known.items() if unit.startswith("N")]
        if parameters is None
        else list(as_names(parameters, name="scaled_by parameters"))
    )
    unknown = [name for name in chosen if name not in known]
    if unknown or not chosen or isinstance(parameters, str):
        raise ValueError(
            f"scaled_by needs a list of parameters of {type(law).__name__}, among {', '.join(known) or 'none'}"
            " (those in newtons by default; one that was left out must be given to the law first); given:"
            f" {parameters!r}."
        )
    return _vary(law, factor, chosen)


def _vary(module: _Module, factor: Callable[..., ArrayLike], chosen: list[str]) -> _Module:
    """`module` with the chosen parameters, its own and those of the modules in it, made to vary."""
    names, values = [], []
    for field in dataclasses.fields(module):
        value = getattr(module, field.name)
        if field.name in ranges_of(module):
            if field.name in chosen:
                names.append(field.name)
                values.append(StateDependent(value, factor))
        elif isinstance(value, AbstractLaw):
            names.append(field.name)
            values.append(_vary(value, factor, chosen))
        elif field.name == "backward":  # the numbers of an asymmetric law for negative slip
            names.append(field.name)
            values.append({n: StateDependent(x, factor) if n in chosen else x for n, x in value.items()})
    if not names:
        return module
    return eqx.tree_at(lambda m: [getattr(m, name) for name in names], module, values, is_leaf=_is_whole)


def _is_whole(x: object) -> bool:
    return isinstance(x, StateDependent | dict)
