"""The command line: `jaxmodsim demo | testbench | fit | predict | sweep | orbit | branch | export | cache`."""

import os
import sys


def main() -> None:
    """Entry point; an error of the user is one sentence on stderr and exit code 2."""
    try:
        from ._app import run
    except ImportError as error:
        sys.stderr.write(f"jaxmodsim: the command line needs {error.name}: pip install 'jaxmodsim[cli]'\n")
        sys.exit(2)
    try:
        run()
    except SystemExit as ending:
        if ending.code == 130:
            # After Ctrl-C XLA may still be compiling, and crashes if the interpreter ends meanwhile.
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(130)
        raise
