"""Compilers of this machine, and the marker of tests that run FMUs."""

import shutil

import pytest

from jaxmodsim._core.compat import AVAILABLE
from jaxmodsim.export import _compile

COMPILER = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")
OWN = _compile.own_platform()
needs_fmpy = pytest.mark.skipif(
    "jaxprs" not in AVAILABLE or _compile.compiler_of(OWN) is None,
    reason="needs the programs that JAX traces, and a C compiler: ziglang, cc, gcc or clang",
)
