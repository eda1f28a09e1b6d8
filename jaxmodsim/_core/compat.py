"""Private interfaces of JAX, jaxlib, equinox, diffrax and Python, in groups behind probes.

Such interfaces may change with any release. Each group is probed when this module is imported; `AVAILABLE` names the
available groups. Code that needs a missing group uses public interfaces instead, and one warning lists the losses. Only
`to_c` has no alternative: it raises an error with the versions to install. The environment variable
`JAXMODSIM_PROBES_OFF` disables groups: `kernels,programs`, or `all`.
"""

import logging
import os
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from types import TracebackType
from typing import TYPE_CHECKING, Any, final

import jax

from .system import versions

AVAILABLE: set[str] = set()
_OFF = set(os.environ.get("JAXMODSIM_PROBES_OFF", "").split(","))
_LOSSES: list[str] = []

if not TYPE_CHECKING:  # substitutes for missing names
    ClosedJaxpr = Jaxpr = JaxprEqn = Literal = Primitive = UndefinedPrimal = jaxpr_as_fun = object
    ad = batching = mlir = ir = stablehlo = eqxi = diffrax_loop = lax_loop = xla_bridge = object
    get_opaque_trace_state = object  # each call returns a new object, so no two states are equal


@contextmanager
def _probe(group: str, loss: str) -> Iterator[None]:
    before = dict(globals())
    try:
        yield
        if _OFF & {group, "all"}:
            raise ImportError("switched off")
        AVAILABLE.add(group)
    except (ImportError, AttributeError) as error:
        globals().update(before)  # a group is available as a whole or not at all
        _LOSSES.append(f"{group} ({error}): {loss}")


def _need(owner: object, names: str) -> None:
    """Raise if an object, or the fields of a class, lack one of these names."""
    existing = {*dir(owner), *getattr(owner, "__annotations__", ())}
    if missing := sorted(set(names.split()) - existing):
        raise AttributeError(f"{getattr(owner, '__name__', owner)} has no {', '.join(missing)}")


with _probe(
    "jaxprs",
    "runs and derivatives take several times as long, and JAX keeps no compiled run in its persistent cache; indices"
    " out of range and step functions in functions of a scene are not reported; to_c raises an error",
):
    from jax.extend.core import ClosedJaxpr as ClosedJaxpr
    from jax.extend.core import Jaxpr as Jaxpr
    from jax.extend.core import JaxprEqn as JaxprEqn
    from jax.extend.core import Literal as Literal
    from jax.extend.core import Primitive as Primitive
    from jax.extend.core import jaxpr_as_fun as jaxpr_as_fun

    _need(Jaxpr, "constvars eqns invars outvars replace")
    _need(ClosedJaxpr, "consts in_avals jaxpr")
    _need(JaxprEqn, "effects invars outvars params primitive replace")
    _need(Primitive, "bind get_bind_params multiple_results")

with _probe("kernels", "single runs and their derivatives take several times as long on CPU"):
    import jaxlib.version
    from jax.extend.core import Primitive as Primitive
    from jax.interpreters import ad as ad
    from jax.interpreters import batching as batching
    from jax.interpreters import mlir as mlir
    from jaxlib.mlir import ir as ir
    from jaxlib.mlir.dialects import stablehlo as stablehlo

    # XLA ends the process if it cannot compile a marked call, so only tested versions pass.
    if not (0, 10) <= jaxlib.version.__version_info__[:2] <= (0, 12):
        raise ImportError(f"not tested with jaxlib {jaxlib.version.__version__}")

with _probe(
    "stored_steps",
    "StoredSteps is diffrax.DirectAdjoint: derivatives take several times as long to compile, and are inaccurate where"
    " little moves",
):
    import equinox.internal as eqxi
    from diffrax import _integrate
    from jax.extend.core import Primitive as Primitive
    from jax.interpreters.ad import UndefinedPrimal as UndefinedPrimal

    _need(eqxi, "buffer_at_set create_vprim filter_primitive_bind filter_primitive_def filter_primitive_jvp")
    _need(eqxi, "filter_primitive_transpose nondifferentiable_backward unvmap_any")
    _need(
        _integrate.State,
        "controller_state dense_infos made_jump num_accepted_steps save_state solver_state tnext tprev y",
    )
    _need(_integrate.SaveState, "save_index saveat_ts_index ts ys")
    diffrax_loop = _integrate.loop
    lax_loop = partial(eqxi.while_loop, kind="lax")

with _probe("trace_state", "events and energies of a traced run are computed at each access"):
    from jax.extend.core import get_opaque_trace_state as get_opaque_trace_state

with _probe("programs", "long compilations are not reported"):
    _need(jax.jit(abs), "_cache_size")

with _probe("backends", "tune_cpu raises no error if JAX has computed something already"):
    from jax._src import xla_bridge

    _need(xla_bridge, "backends_are_initialized")

with _probe("last_line", "the cause of an error inside jax.jit is not repeated after the traceback"):
    _need(sys, "excepthook")

if _LOSSES:
    logging.getLogger("jaxmodsim").warning(
        "Private interfaces that make jaxmodsim fast are disabled with %s. %s.",
        ", ".join(map(" ".join, versions("jax", "equinox", "diffrax").items())),
        ". ".join(_LOSSES),
    )


def scan_counts(params: Mapping[str, Any]) -> tuple[int, int]:
    """Numbers of constants and of carried values of a `scan`, from the parameters of its equation."""
    if "ft_in" in params:  # from JAX 0.11
        consts, carry, _ = params["ft_in"].unpack()
        return len(consts), len(carry)
    return params["num_consts"], params["num_carry"]


def programs_of(function: Any) -> int:
    """Number of programs that a function of `jax.jit` has compiled; 0 if unknown."""
    return function._cache_size() if "programs" in AVAILABLE else 0


def backend_has_started() -> bool:
    """Whether JAX has computed something; False if unknown."""
    return "backends" in AVAILABLE and xla_bridge.backends_are_initialized()


@final
class _Hook:
    """Hook that Python calls with an uncaught error."""

    def __init__(
        self,
        before: Callable[[type[BaseException], BaseException, TracebackType | None], object],
        after: Callable[[BaseException], None],
    ) -> None:
        self.before, self.after = before, after

    def __call__(self, kind: type[BaseException], error: BaseException, traceback: TracebackType | None) -> None:
        self.before(kind, error, traceback)
        self.after(error)


def after_traceback(say: Callable[[BaseException], None]) -> None:
    """Call `say` with the error that ends the program, after Python's traceback.

    Only the first call has an effect.
    """
    if "last_line" in AVAILABLE and not isinstance(sys.excepthook, _Hook):
        sys.excepthook = _Hook(sys.excepthook, say)
