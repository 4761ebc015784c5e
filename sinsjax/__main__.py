"""The ``sinsjax`` command, and ``python -m sinsjax``."""

import atexit
import os
import sys
import threading
from typing import NoReturn


def command() -> NoReturn:
    """Run the command line, and end the process once all that was begun is done.

    The interpreter's own exit would first destroy every object of the extension modules. That takes
    a third of a second, and rarely aborts the process ("terminate called", exit code 134) on a C++
    thread that such an object still uses.
    """
    code: object = 130
    try:
        from sinsjax.cli import main

        main()
    except SystemExit as stop:
        code = stop.code
    except KeyboardInterrupt:  # during the import of modules; `main` reports later ones
        print("interrupted: nothing was started", file=sys.stderr)
    for thread in threading.enumerate():
        if thread is not threading.current_thread() and not thread.daemon:
            thread.join()
    atexit._run_exitfuncs()
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except OSError as error:
            if not isinstance(error, BrokenPipeError):  # but a full disk
                code = code or 2
                print(f"error: standard output: {error.strerror}", file=sys.stderr)
        except (AttributeError, ValueError):  # none, or closed
            pass
    os._exit(code if isinstance(code, int) else bool(code))


if __name__ == "__main__":
    command()
