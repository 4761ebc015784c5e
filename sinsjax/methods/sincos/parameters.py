"""[surge] as numbers, beside those of every filter."""

from typing import Any

from sinsjax.methods.filters import parameters as filters
from sinsjax.methods.filters.stages import FilterParams
from sinsjax.methods.parameters import Columns
from sinsjax.methods.sincos import method, surge


def with_surge(columns: Columns, site: Any, ug: float) -> FilterParams:
    """Numbers of the filter with states of the surge, leaves (variants,)."""
    still = filters.parameters(method.STATES, columns, site, ug)
    variance = columns.column("r_surge_m_per_s") ** 2
    time = columns.column("r_surge_time_s")
    begin = (*(variance * time**2,) * 2, *(variance,) * 2)
    driven = 2 * variance / time / columns.rate_hz
    return still._replace(
        p0=(*still.p0, *begin),
        q=(*still.q, *(0.0 * driven,) * 2, *(driven,) * 2),
        reset_to=(*still.reset_to, *begin),
        own=surge.SurgeParams(1 / time),
    )
