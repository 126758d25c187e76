"""Runs that go on in a folder where something else lies, or with a damaged file."""

from __future__ import annotations

from pathlib import Path

import lightning as L
import pytest
import torch

from hno.cli.resume import take_over
from hno.training.checkpoint import find_checkpoint, same_run
from hno.training.saving import BEST, LAST, PREVIOUS, RESUMED, read_content, seal
from tests.faults.checkpoints import EVERY, operator_content, run, trained
from tests.training.test_fit import equal


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Of a run that has ended, with records in its checkpoints."""
    run(tmp_path)
    for path in tmp_path.glob("*.ckpt"):
        path.write_bytes(seal(read_content(path) | {"hno": operator_content()["hno"]}))
    return tmp_path


@pytest.mark.parametrize("what", ["another seed", "another width", "another record", "empty", "truncated"])
def test_a_best_checkpoint_that_is_not_of_the_run_is_not_used(
    folder: Path, caplog: pytest.LogCaptureFixture, what: str
) -> None:
    best, last = folder / BEST, folder / LAST
    assert same_run(best, last)
    whole, content = best.read_bytes(), read_content(best)
    record = content["hno"]
    if what == "another seed":
        record["provenance"]["seed"] += 1
    if what == "another width":
        record["architecture"]["network"]["options"]["width"] += 1
    if what == "another record":
        record["format"] = torch.zeros(2)
    best.write_bytes({"empty": b"", "truncated": whole[:-9]}.get(what, seal(content)))
    found = run(folder, resume=last)
    assert (found.best, found.checkpoint) == (None, last)
    take_over(str(last), folder)
    assert not best.exists()
    stranger = f"{best} is of another run than {last} and is not used."
    damaged = f"{best} is not a readable checkpoint: "
    assert (stranger if what.startswith("another") else damaged) in caplog.text
    assert what.startswith("another") or f"The run goes on from {last}." in caplog.text


def test_the_best_checkpoint_of_the_run_goes_along(folder: Path, tmp_path: Path) -> None:
    to = tmp_path / "to" / BEST
    to.parent.mkdir()
    take_over(str(folder / LAST), to.parent)
    assert to.read_bytes() == (folder / BEST).read_bytes()
    take_over(None, to.parent)
    assert not to.exists()


class PowerCut(L.Callback):
    """The machine is gone after the second checkpoint."""

    def on_train_batch_start(self, trainer: L.Trainer, *others: object) -> None:
        if trainer.global_step == 2 * EVERY + 1:
            raise KeyError("power cut")


def test_a_damaged_last_checkpoint_is_passed_over_and_the_run_ends_the_same(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    steps, cut = 3 * EVERY, tmp_path / "cut"
    whole, found = trained(tmp_path / "whole", steps=steps)
    with pytest.raises(KeyError, match="power cut"):
        run(cut, steps=steps, callbacks=[PowerCut()])
    (cut / LAST).write_bytes((cut / LAST).read_bytes()[:-1])
    resume = find_checkpoint(cut, RESUMED)
    assert resume == cut / PREVIOUS
    assert f"{cut / LAST} is damaged and passed over." in caplog.text
    resumed, again = trained(cut, steps=steps, seed=3, resume=resume)
    assert equal(whole, resumed)
    assert (found.metrics, found.best) == (again.metrics, again.best)
    assert read_content(cut / LAST)["global_step"] == steps


def test_drafts_of_a_killed_process_are_gone_after_the_next_start(tmp_path: Path) -> None:
    for name in (BEST, LAST):
        (tmp_path / f".{name}.abc123").write_bytes(b"half")
    run(tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == [BEST, LAST, PREVIOUS]
