"""Commands about the machine that studies run on."""

from sinsjax.console import plain_console, print_line
from sinsjax.platform import runtime


def info() -> None:
    """Show versions, devices, compiler options and the folder of compiled programs."""
    runtime.configure()
    runtime.start_backend()
    console = plain_console()
    entries = runtime.info()
    entries["options"] = ", ".join(f"{key} = {value}" for key, value in entries["options"].items())
    for key, value in (entries | _plugin_methods()).items():
        print_line(console, f"{key:>20}  {value}")


def _plugin_methods() -> dict[str, str]:
    """Return the methods of other packages, and the reasons why some cannot be used."""
    from sinsjax.study.keys import BROKEN, PACKAGES  # without plug-ins that clash with its keys

    methods = (f"{name} ({' '.join(package)})" for name, package in PACKAGES.items())
    broken = "; ".join(BROKEN.values())
    entries = {"plug-in methods": ", ".join(methods), "not usable": broken}
    return {key: value for key, value in entries.items() if value}


COMMANDS = (info,)
