"""Memory that labels take."""

from __future__ import annotations

import subprocess
import sys

import pytest

CHILD = """
import resource, sys, torch
from hno import games, solve

def peak():
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)

torch.set_num_threads(1)
game, size = games.make(sys.argv[1]), int(sys.argv[2])
x0 = game.initial_box.sample(size, torch.Generator().manual_seed(0))
before = peak()
found = solve(game, x0, torch.tensor([[1.0, 5.0]]).expand(size, -1))
print(peak() - before, len(found.status))
"""


def memory(name: str, size: int) -> int:
    """Bytes that solving adds to the peak of a fresh process."""
    command = [sys.executable, "-c", CHILD, name, str(size)]
    taken, rows = subprocess.run(command, check=True, capture_output=True, text=True).stdout.split()
    assert int(rows) == size
    return int(taken)


@pytest.mark.slow
def test_two_thousand_starts_take_less_than_two_gibibytes():
    assert memory("narrow_road", 2000) < 2 * 2**30


@pytest.mark.slow
@pytest.mark.parametrize("name", ["narrow_road", "drone"])
def test_memory_does_not_grow_with_the_number_of_starts(name):
    """States are solved in chunks of 128."""
    assert memory(name, 384) < 1.3 * memory(name, 128)
