"""The command line: `jaxmodsim demo | testbench | fit | sweep | orbit | branch | bench | cache`."""

import os
import sys


def main() -> None:
    """Entry point; errors of the user's are one sentence and exit code 2."""
    try:
        import rich
        import typer
    except ImportError as error:
        sys.stderr.write(f"jaxmodsim: the command line needs {error.name}: pip install 'jaxmodsim[cli]'\n")
        sys.exit(2)
    del rich, typer
    from ._app import run

    try:
        run()
    except SystemExit as ending:
        if ending.code == 130:
            # XLA may still be compiling what Ctrl-C interrupted, and crashes if the interpreter ends under it.
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(130)
        raise
