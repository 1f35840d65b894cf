from __future__ import annotations

import pytest

from pipeline.tables.statistics import better_beyond_spread, mean, spread


def test_spread_is_the_sample_standard_deviation() -> None:
    """2, 4, 9: mean 5, squares 9 + 1 + 16 = 26, over two 13."""
    assert mean([2, 4, 9]) == 5
    assert spread([2, 4, 9]) == pytest.approx(13**0.5)
    assert spread([3.0, 3.0]) == 0


def test_one_value_has_a_mean_and_no_spread() -> None:
    assert mean([7.5]) == 7.5
    assert spread([7.5]) is None
    assert spread([]) is None
    with pytest.raises(ValueError, match="no values"):
        mean([])


def test_better_only_beyond_both_spreads_together() -> None:
    """Both spreads are 1 here, so that a lead of exactly 2 is not enough."""
    assert not better_beyond_spread([11, 12, 13], [9, 10, 11])
    assert better_beyond_spread([11.1, 12.1, 13.1], [9, 10, 11])
    assert not better_beyond_spread([9, 10, 11], [11.1, 12.1, 13.1])


def test_lower_may_be_better() -> None:
    assert better_beyond_spread([0.1, 0.1], [0.2, 0.2], higher=False)
    assert not better_beyond_spread([0.1, 0.1], [0.2, 0.2], higher=True)


def test_a_single_value_claims_only_against_a_spread() -> None:
    assert better_beyond_spread([12.0], [9.0, 11.0])  # 2 ahead, spread 1.41
    assert not better_beyond_spread([11.0], [9.0, 11.0])  # 1 ahead
    assert not better_beyond_spread([30.0], [10.0])
    assert not better_beyond_spread([30.0, 30.0], [])
