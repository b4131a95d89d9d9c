import numpy as np

from rejeu.logs.formatting import number


def test_large_numbers_have_thousands_separators_and_small_ones_four_digits():
    assert [number(x) for x in (1234567.0, -1234567.0, 1000.0, -1000.4)] == [
        "1,234,567",
        "-1,234,567",
        "1,000",
        "-1,000",
    ]
    assert [number(x) for x in (999.96, -0.012345, 1e12, -1e30, np.nan)] == ["1000", "-0.01235", "1e+12", "-1e+30", "-"]
