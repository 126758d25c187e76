from __future__ import annotations

import json

import pytest
import torch

from hno.data.certificates import CLEARANCE, GLOBAL_GAP, LOCAL_GAP, inevitable, safe, summaries, summary
from hno.games import make
from hno.types import Extremal, Status, join, part
from tests.fakes import fake_labels

CLEARANCES = [0.5, CLEARANCE, 0.019, 0.0, -0.3, 0.5, -0.3]
STATUS = [Status.CONVERGED] * 5 + [Status.STALLED, Status.INACCURATE]


@pytest.fixture
def found() -> Extremal:
    return fake_labels(make("narrow_road"), count=7, status=STATUS, clearance=CLEARANCES)


def test_safe_starts_converged_and_keep_the_clearance(found: Extremal) -> None:
    assert safe(found).tolist() == [True, True, False, False, False, False, False]
    assert safe(found, clearance=0.1).tolist() == [True] + [False] * 6


def test_inevitable_collisions_converged_and_touch(found: Extremal) -> None:
    assert inevitable(found).tolist() == [False, False, False, True, True, False, False]


def test_summary_counts_every_start_once_by_status(found: Extremal) -> None:
    counts = summary(found)
    assert counts["starts"] == 7
    assert counts["status"] == {"converged": 5, "stalled": 1, "max_steps": 0, "not_finite": 0, "inaccurate": 1}
    assert (counts["safe"], counts["inevitable"]) == (2, 2)


def test_summary_counts_starts_by_their_best_equilibrium_and_certifies_all(found: Extremal) -> None:
    """Rows 2 and 3 are other equilibria of the second start, rows 5 and 6 of the third."""
    several = found._replace(start=torch.tensor([0, 1, 1, 1, 2, 2, 2]))
    several.local_gap[3] = 0.25
    counts = summary(several)
    assert (counts["starts"], counts["status"]["converged"], counts["status"]["stalled"]) == (3, 3, 0)
    assert (counts["safe"], counts["inevitable"]) == (2, 1)
    assert (counts["largest_local_gap"], counts["above_local_gap"]) == (0.25, 1)


def test_summary_takes_the_worst_of_converged_rows_and_of_all_players(found: Extremal) -> None:
    found.local_gap[1, 1], found.local_gap[5, 0] = 0.25, 9.0
    found.global_gap[2, 0], found.global_gap[6, 1] = 0.5, 9.0
    found.reintegration[3], found.reintegration[5] = 0.125, 9.0
    counts = summary(found)
    assert (counts["largest_local_gap"], counts["largest_global_gap"]) == (0.25, 0.5)
    assert counts["largest_reintegration"] == 0.125
    assert counts["largest_residual"] == found.residual[:5].max()
    assert (counts["above_local_gap"], counts["above_global_gap"]) == (1, 1)


def test_gaps_at_their_limit_are_not_above(found: Extremal) -> None:
    at_limit = found._replace(
        local_gap=torch.full_like(found.local_gap, LOCAL_GAP), global_gap=torch.full_like(found.global_gap, GLOBAL_GAP)
    )
    assert (summary(at_limit)["above_local_gap"], summary(at_limit)["above_global_gap"]) == (0, 0)


def test_gaps_that_do_not_exist_count_as_above(found: Extremal) -> None:
    found.local_gap[0, 1] = found.global_gap[1, 0] = found.global_gap[2] = torch.nan
    counts = summary(found)
    assert (counts["above_local_gap"], counts["above_global_gap"]) == (1, 2)
    assert counts["largest_local_gap"] is None
    assert counts["largest_global_gap"] is None


@pytest.mark.parametrize("gap", [torch.nan, torch.inf])
def test_summary_is_json(found: Extremal, gap: float) -> None:
    found.local_gap[0], found.residual[1] = gap, gap
    counts = summary(found)
    assert json.loads(json.dumps(counts, allow_nan=False)) == counts


def test_without_a_converged_row_there_is_no_worst_one() -> None:
    counts = summary(fake_labels(make("narrow_road"), status=[Status.MAX_STEPS] * 4))
    assert [value for name, value in counts.items() if name.startswith("largest")] == [None] * 4
    assert [counts[name] for name in ("safe", "inevitable", "above_local_gap", "above_global_gap")] == [0] * 4


def test_summaries_are_those_of_each_type() -> None:
    """A file of one's own may hold several types in any order."""
    game, failed = make("narrow_road"), [Status.STALLED] * 2
    mixed = join([fake_labels(game, (1.0, 1.0), 3), fake_labels(game, (2.0, 1.0), 2, status=failed)])
    found = summaries([part(mixed, torch.tensor([0, 3, 1, 4, 2])), fake_labels(game, (5.0, 5.0), 1)])
    assert [(e["theta"], e["starts"], e["status"]["stalled"], e["safe"]) for e in found] == [
        ([1, 1], 3, 0, 3), ([2, 1], 2, 2, 0), ([5, 5], 1, 0, 1),
    ]  # fmt: skip
