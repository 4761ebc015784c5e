"""``python -m sinsjax``."""

from sinsjax.cli import main

main()
