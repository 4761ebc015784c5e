"""The section of a study file that says how to read an IMU record."""

from typing import Annotated, Literal

from pydantic import AfterValidator, Field, model_validator

from sinsjax.records.layout import Layout, axes, fault
from sinsjax.value_types import (
    AccelNoise,
    GyroNoise,
    Seconds,
    SecondsOrZero,
    Section,
    Starts,
    Triad,
    invalid,
)


def _axes_order(order: str) -> str:
    """Refuses what no turn of the box gives."""
    try:
        axes(order)
    except ValueError as error:
        raise invalid(str(error)) from None
    return order


class RecordSection(Section):
    """[record]: how to read an IMU record, and where in it the draws start."""

    format: Literal["psins", "csv", "parquet", "arrays"] = Field(
        description="file format, or 'arrays' from Python"
    )
    from_s: SecondsOrZero | None = Field(
        None, description="where the part that is used begins, s from the record's beginning"
    )
    to_s: Seconds | None = Field(None, description="where that part ends, s; default: its end")
    quantity: Literal["increments", "rates"] | None = Field(
        None, description="what the columns hold (csv, parquet)"
    )
    time_column: str | None = Field(
        None, description="time stamps (csv, parquet); without it rate_hz gives the times"
    )
    gyro_columns: Triad | None = Field(None, description="x, y, z gyro columns (csv, parquet)")
    accel_columns: Triad | None = Field(
        None, description="x, y, z accelerometer columns (csv, parquet)"
    )
    gyro_unit: Literal["rad", "deg", "arcsec", "rad_per_s", "deg_per_s", "deg_per_h"] | None = (
        Field(None, description="unit of the gyro columns (csv, parquet)")
    )
    accel_unit: Literal["m_per_s", "g_s", "ug_s", "m_per_s2", "g", "mg", "ug"] | None = Field(
        None, description="unit of the accelerometer columns (csv, parquet)"
    )
    axes_order: Annotated[str, AfterValidator(_axes_order)] = Field(
        "xyz",
        description="the record's axes that point right, front and up, such as 'y-xz', or where its"
        " x, y and z point: 'rfu', 'frd', 'flu'",
    )
    time_unit: Literal["s", "ms", "us", "ns", "iso"] | None = Field(
        None, description="unit of the time stamps, 'iso' for dates with time; default 's'"
    )
    start_s: Starts = Field(
        default_factory=lambda given: (given.get("from_s") or 0.0,),
        description="start times from the record's beginning, s; default: from_s, else 0",
    )
    max_gap_s: SecondsOrZero | None = Field(
        None, description="longest gap that is interpolated, s; default 0: none"
    )
    gyro_bias_deg_per_h: GyroNoise | None = Field(
        None, description="gyro bias that a plausible record may have, deg/h; default 10"
    )
    accel_bias_ug: AccelNoise | None = Field(
        None, description="accelerometer bias that a plausible record may have, ug; default 5000"
    )
    trust: bool | None = Field(
        None, description="whether an implausible record is aligned all the same; default false"
    )

    @model_validator(mode="after")
    def _columns_fit_format(self) -> "RecordSection":
        self._check_times()
        needed = ("quantity", "gyro_columns", "accel_columns", "gyro_unit", "accel_unit")
        if self.format in ("psins", "arrays"):
            told = [
                key
                for key in (*needed, "time_column", "max_gap_s")
                if getattr(self, key) is not None
            ]
            if self.format == "arrays" and self.axes_order != "xyz":
                told.append("axes_order")
            why = "which fixes it" if self.format == "psins" else "which come with it"
            for key in told:
                raise invalid(f"does not apply to format '{self.format}', {why}", key=key)
            return self
        for key in needed:
            if getattr(self, key) is None:
                raise invalid(f"required with format '{self.format}'", key=key)
        # Whether a rate is needed is known with the rest of the study.
        if found := fault(self.layout(rate_hz=1.0)):
            raise invalid(found.text, key=found.key)
        return self

    def layout(self, rate_hz: float | None) -> Layout:
        """How the file holds the record, at a rate if the study gives one."""
        given = {key: getattr(self, key, None) for key in Layout._fields} | {"rate_hz": rate_hz}
        return Layout(**{key: value for key, value in given.items() if value is not None})

    def _check_times(self) -> None:
        if self.time_unit is not None and self.time_column is None:
            raise invalid("requires a time_column", key="time_unit")
        begin, end = self.from_s or 0.0, self.to_s
        if end is not None and end <= begin:
            raise invalid(f"must be after from_s = {begin:g}, not {end:g}", key="to_s")
        if min(self.start_s) < begin:
            text = f"{min(self.start_s):g} s lies before from_s = {begin:g}"
            raise invalid(text, key="start_s")
