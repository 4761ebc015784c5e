"""Commands about the machine that studies run on."""

from typing import Annotated

import typer

from sinsjax.console import plain_console, say
from sinsjax.platform import runtime


def info() -> None:
    """Show versions, devices, compiler options and the folder of compiled programs."""
    runtime.configure()
    runtime.require_backend()
    console = plain_console()
    known = runtime.info()
    known["options"] = ", ".join(f"{key} = {value}" for key, value in known["options"].items())
    for key, value in (known | _methods_from_outside()).items():
        say(console, f"{key:>20}  {value}")


def _methods_from_outside() -> dict[str, str]:
    """Methods that other packages bring, and why some cannot be used."""
    from sinsjax.methods.registry import PACKAGES
    from sinsjax.study.keys import BROKEN

    brought = (f"{name} ({' '.join(PACKAGES[name])})" for name in PACKAGES)
    told = {"methods from outside": ", ".join(brought), "not usable": "; ".join(BROKEN.values())}
    return {key: value for key, value in told.items() if value}


def bench(
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object per line.")] = False,
    limit: Annotated[
        bool, typer.Option("--limit", help="Also build and run the limit kernel (needs gcc).")
    ] = False,
    repeats: Annotated[
        int, typer.Option(help="Timings per row; shows the median.", min=1, metavar="N")
    ] = 7,
) -> None:
    """Time the engine's step on one core, with the short benchmark set.

    Example: sinsjax bench --limit
    """
    from sinsjax import bench as benchmarks

    benchmarks.run(plain_console(), as_json=as_json, limit=limit, repeats=repeats)


COMMANDS = (info, bench)
