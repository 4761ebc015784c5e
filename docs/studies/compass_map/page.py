"""Numbers of the page on compass alignment over a tape that is gone over again."""

from sinsjax.report.folder import Page, Sources

from .map import mapped
from .schedules import compared, searched


def page(sources: Sources) -> Page:
    """The map over turn, sigma and tape, the search of schedules, and the best of them."""
    return Page.joined(
        compared(sources["compass_80s_best"]),
        searched(sources["compass_80s_search"]),
        mapped(sources["paper2_map"]),
    )
