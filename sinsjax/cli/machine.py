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
    for key, value in (known | _describe_plugins()).items():
        say(console, f"{key:>20}  {value}")


def _describe_plugins() -> dict[str, str]:
    """Return the plug-in methods, and the reasons why some cannot be used."""
    from sinsjax.study.keys import REGISTRY  # without plug-ins that clash with keys of a study

    usable = (f"{name} ({' '.join(package)})" for name, package in REGISTRY.packages.items())
    broken = "; ".join(REGISTRY.broken.values())
    lines = {"plug-in methods": ", ".join(usable), "not usable": broken}
    return {key: value for key, value in lines.items() if value}


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
