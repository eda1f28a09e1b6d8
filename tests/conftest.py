import io
import os
import sys
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any

import jax
import jaxlib.version
import pytest
from xdist.scheduler import LoadScopeScheduling

from . import fuzz

# Nearly all of the time goes into tracing and compiling. XLA's older way to emit fused loops, straight as LLVM code,
# compiles in 60 % of the time. XLA ends the process over an option that it does not know: only where it was tried.
# For the way that users have: XLA_FLAGS=--xla_cpu_use_fusion_emitters=true.
_OPTION, _FLAGS = "xla_cpu_use_fusion_emitters", os.environ.get("XLA_FLAGS", "")
if jaxlib.version.__version_info__[:2] == (0, 10) and _OPTION not in _FLAGS:
    os.environ["XLA_FLAGS"] = f"{_FLAGS} --{_OPTION}=false".strip()


jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_rank_promotion", "raise")
fuzz.register()


# Tests of a module share what they have compiled and computed, so a module stays in one process. Those of these modules
# share nothing: they are given out one by one, and last, which keeps all processes busy to the end.
_APART = {"test_belt", "test_constraints", "test_contact", "test_gauss", "test_implicit_friction", "test_stick_slip"}


class ByModule(LoadScopeScheduling):
    def _split_scope(self, nodeid: str) -> str:
        module = nodeid.split("::")[0]
        return nodeid if Path(module).stem in _APART else module


@pytest.hookimpl(optionalhook=True)  # there is no such hook without processes
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> ByModule:
    return ByModule(config, log)


@pytest.fixture(scope="module")
def run_command():
    """Run a command line in this process; gives its exit code, output and errors."""
    from jaxmodsim.cli import _app  # what needs no command line does not load it

    def run(*arguments: str) -> tuple[int, str, str]:
        out, errors = io.StringIO(), io.StringIO()
        with pytest.MonkeyPatch.context() as patch, redirect_stdout(out), redirect_stderr(errors):
            # The tests have started JAX already, in double precision.
            patch.setattr(_app, "_start", lambda: None)
            patch.setattr(sys, "argv", ["jaxmodsim", *arguments])
            with pytest.raises(SystemExit) as ending:
                _app.run()
        return int(ending.value.code or 0), out.getvalue(), errors.getvalue()

    return run
