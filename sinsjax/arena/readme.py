"""The README of an export, for an engineer who has never used sinsjax."""

RECORDS = "imu"
"""Folder of the records in an export."""

_AXES = {
    "enu": "x right, y front, z up; navigation frame east, north, up",
    "ned": "x front, y right, z down; navigation frame north, east, down",
}
_EULER = {
    "enu": "yaw counter-clockwise from north, C_b^n = Rz(yaw) Rx(pitch) Ry(roll)",
    "ned": "yaw clockwise from north, C_b^n = Rz(yaw) Ry(pitch) Rx(roll)",
}
_COLUMNS = {
    "psins": "blanks between columns, no names: wx wy wz vx vy vz t",
    "csv": "commas between columns, names in the first line, with units",
    "parquet": "Parquet, names with units",
}
_UNITS = {
    "rates": "rad/s and m/s^2, means over each sample",
    "increments": "rad and m/s per sample",
}


def describe_export(
    study: str, digest: str, *, format: str, quantity: str, frame: str, blind: bool
) -> str:
    """Return the text of README.txt.

    Args:
        study: name of the study.
        digest: of the study.
        format: see `export.ExportOptions`, as the following arguments.
        quantity: of the records.
        frame: of records and attitudes.
        blind: whether the truth is left out.
    """
    truth = "truth.parquet, attitude at record times; keep it from your program"
    return f"""\
sinsjax export of the study {study!r}, digest {digest}

initial.csv   one row per run to align: run_id (with gaps; do not renumber), draw_id, variant_id;
              the first attitude, misaligned on purpose (nan: find it without one), and the velocity
              that the program starts from; latitude, height, gravity; rate; end of the run in s;
              the record in `file`, which several runs may share.
study.toml    the study: Earth ([earth]: rate and model), sensor noise and biases ([sensors], for Q
              and P0), motion. Its true velocity is that of the motion: none on a still base.
records       {RECORDS}/: {_COLUMNS[format]}.
              Gyros and accelerometers in {_UNITS[quantity]};
              time in s at the end of each sample. Specific force: at rest z reads \
{"+g" if frame == "enu" else "-g"}.
              Rotation vector of a sample: a + (a0 x a)/12, with the angles a of the sample and a0
              of the one before; velocity: v + a x v/2 + a x (a x v)/6 + (a0 x v + v0 x a)/12.
              Vibration is included: the unit integrates its own coning and sculling.
axes          {_AXES[frame]}.
angles        deg; {_EULER[frame]}.
              Pitch is positive with the front up, roll with the right side down.
quaternion    q_w q_x q_y q_z from body to navigation frame, scalar first.
truth         {"left out (--blind)" if blind else truth}.

Return one CSV or Parquet file with, for each run, a row at `end_s` (to half a sample) or a history:
  study        the digest above in a column, or in a first line `# study = {digest}`
  run_id       of initial.csv (or draw_id and variant_id)
  time_s       on the clock of the records
  yaw_deg, pitch_deg, roll_deg    or q_w, q_x, q_y, q_z
  sigma_yaw_deg, sigma_pitch_deg, sigma_roll_deg    optional, 1 sigma
A line `# frame = enu` or `# frame = ned` states another convention than that of this export. A run
without a row at its end is a failure and counts as 180 deg.
Then: sinsjax score DIR results.csv --name my_filter
"""
