"""Values of keys in the variants of a part."""

import numpy as np
from support.studies import small_study

from sinsjax.study.variants import Variants


def test_size_of_a_bias_is_that_of_its_largest_axis_whatever_its_sign() -> None:
    study = small_study(axes={"gyro_bias_deg_per_h": [[-0.3, 0.1, 0.0], -0.2, 0.0]})
    sizes = Variants(study, np.arange(3)).rms("gyro_bias_deg_per_h")
    np.testing.assert_array_equal(sizes, [0.3, 0.2, 0.0])
