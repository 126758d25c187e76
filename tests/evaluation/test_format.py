from __future__ import annotations

import pytest

from hno.evaluation.format import counted, interval, number, percent, short_names, signed, significant, types


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (number(1234.5), "1,234.50"),
        (number(-0.001), "0.00"),
        (number(-0.005001), "-0.01"),
        (significant(-0.0), "0"),
        (significant(12345.0), "1.23e+04"),
        (percent(0.0), "0.00 %"),
        (percent(-0.0), "0.00 %"),
        (percent(0.5), "50.00 %"),
        (percent(0.00001), "< 0.01 %"),
        (percent(-0.00001), "> -0.01 %"),
        (percent(0.00005), "0.01 %"),
        (signed(0.1234), "+12.3 %"),
        (signed(-12.3456), "-1,234.6 %"),
        (signed(-0.0001), "0.0 %"),
        (signed(0.0001), "0.0 %"),
        (interval((-0.000001, 0.125)), "0.00 to 12.50 %"),
        (types((1.0, 2.5)), "1, 2.5"),
        (types(None), "all"),
        (counted(1, "start"), "1 start"),
        (counted(1200, "start"), "1,200 starts"),
    ],
)
def test_a_number_is_rounded_once_and_a_zero_has_no_sign(text: str, expected: str) -> None:
    assert text == expected


def test_what_does_not_exist_is_not_available() -> None:
    assert [show(None) for show in (number, significant, percent, signed, interval)] == ["n/a"] * 5


def test_short_names_drop_the_folders_that_all_paths_share() -> None:
    assert short_names(["/a/b/c/x.ckpt", "/a/b/d/x.ckpt"]) == ["c/x.ckpt", "d/x.ckpt"]
    assert short_names(["/a/b/x.ckpt"]) == ["x.ckpt"]
