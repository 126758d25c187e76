"""Meshes hold every label node, and find it again."""

from __future__ import annotations

import pytest
import torch

from hno.games import make
from hno.pontryagin.mesh import graded_mesh, label_places, label_times


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("horizon", [2.95, 3.0, 4.0, 10.0])
def test_label_nodes_are_found_among_others(horizon, dtype):
    labels = label_times(make("narrow_road", horizon=horizon), dtype=dtype, device=torch.device("cpu"))
    weight = torch.rand(3, len(labels) - 1, generator=torch.Generator().manual_seed(0)).to(dtype)
    t = graded_mesh(labels, weight, 40)
    assert bool((t.diff(dim=-1) > 0).all())
    assert torch.equal(t.gather(1, label_places(t, labels)), labels.expand(3, -1))


@pytest.mark.parametrize("every", [1, 2, 3])
def test_double_label_nodes_are_found_after_rounding_to_single(every):
    """Controls at label nodes in double precision are looked up at coarser times in single precision."""
    game = make("narrow_road", horizon=10.0)
    labels = label_times(game, dtype=torch.float64, device=torch.device("cpu"))
    times = label_times(game, dtype=torch.float32, device=torch.device("cpu"))[::every]
    places = label_places(labels.float().unsqueeze(0), times)[0]
    assert places.tolist() == list(range(0, len(labels), every))


def test_intervals_get_nodes_by_their_weight():
    labels = torch.linspace(0, 1, 3, dtype=torch.float64)
    t = graded_mesh(labels, torch.tensor([[3.0, 1.0]], dtype=torch.float64), 8)
    assert int((t < 0.5).sum()) == 1 + 6
    torch.testing.assert_close(t[0, :8], torch.linspace(0, 0.5, 8, dtype=torch.float64))
