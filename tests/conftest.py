import io
import os
import sys
from contextlib import redirect_stderr, redirect_stdout

import jax
import jaxlib.version
import pytest

# Nearly all of the time goes into tracing and compiling. XLA's older way to emit fused loops, straight as LLVM code,
# compiles in 60 % of the time. XLA ends the process over an option that it does not know: only where it was tried.
# For the way that users have: XLA_FLAGS=--xla_cpu_use_fusion_emitters=true.
_OPTION, _FLAGS = "xla_cpu_use_fusion_emitters", os.environ.get("XLA_FLAGS", "")
if jaxlib.version.__version_info__[:2] == (0, 10) and _OPTION not in _FLAGS:
    os.environ["XLA_FLAGS"] = f"{_FLAGS} --{_OPTION}=false".strip()


jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_rank_promotion", "raise")


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
