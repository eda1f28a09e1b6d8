import os

import jax
import jaxlib.version

# Nearly all of the time goes into tracing and compiling. XLA's older way to emit fused loops, straight as LLVM code,
# compiles in 60 % of the time. XLA ends the process over an option that it does not know: only where it was tried.
# For the way that users have: XLA_FLAGS=--xla_cpu_use_fusion_emitters=true.
_OPTION, _FLAGS = "xla_cpu_use_fusion_emitters", os.environ.get("XLA_FLAGS", "")
if jaxlib.version.__version_info__[:2] == (0, 10) and _OPTION not in _FLAGS:
    os.environ["XLA_FLAGS"] = f"{_FLAGS} --{_OPTION}=false".strip()


jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_rank_promotion", "raise")
