"""The heading is in compass convention."""

import numpy as np
import pytest
from support.studies import small_study

from sinsjax.engine.metrics import Observation
from sinsjax.execution import run, tables
from sinsjax.types import Vec3


@pytest.mark.nightly
@pytest.mark.optimised(False)
def test_heading_is_clockwise_from_north():
    study = small_study(axes={"yaw_center_deg": [10.0, -100.0]}, alignment={"phi_u0_deg": 0.0})
    made = run.run(study, curves=True)
    for table in made:
        yaw, heading = (np.array(table[f"{name}_deg"]) for name in ("yaw", "heading"))
        assert ((heading >= 0) & (heading < 360)).all()
        np.testing.assert_allclose(np.cos(np.deg2rad(heading + yaw)), 1, atol=1e-12)
    assert set(np.round(np.array(made.summary["heading_deg"]), -1)) == {350.0, 100.0}


def test_heading_of_east_is_90_and_just_west_of_north_is_zero():
    zero = np.zeros(3)
    seen = Observation(
        Vec3(zero, zero, zero), Vec3(zero, zero, zero), zero, zero, np.r_[1e-30, 0.0, -np.pi / 2]
    )
    told = tables.TableBuilder(small_study())._angle_columns(seen)["heading_deg"]
    assert told.to_pylist() == [0.0, 0.0, 90.0]
