"""Numbers of the page on repeated passes of the compass: a static base, and a recorded car."""

from sinsjax.report.study_page import Page, Sources

from . import car, static


def page(sources: Sources) -> Page:
    """Return the map and the best schedules of a static base, and the cases of a recorded car."""
    return Page.merge(static.page(sources), car.page(sources))
