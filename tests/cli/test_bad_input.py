from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from hno.data import datamodule
from hno.data.labels import label_set
from hno.games import make
from hno.types import Extremal, best_of
from tests import conftest as shared
from tests.cli.conftest import SMOKE, Command, refused


@pytest.mark.usefixtures("no_labels")
@pytest.mark.parametrize(
    ("override", "near"),
    [
        ("game=narow_road", "'narrow_road'"),
        ("game=lane-change", "'lane_change'"),
        ("operator=hmo", "'hno'"),
        ("activation=tan", "'tanh'"),
        ("optimizer=adm", "'adam'"),
        ("experiment=smok", "'smoke'"),
        ("logger=wandbb", "'wandb'"),
        ("game.name=dron", "'drone'"),
        ("function=valuee", "'value'"),
        ("network=deepnet", "'deeponet'"),
        ("network.name=deepnet", "'deeponet'"),
        ("network.widht=8", "'width'"),
        ("activation.frequenzy=3", "'frequency'"),
        ("operator.nmae=hno", "'name'"),
        ("function=value function.member=3", "'members'"),
        ("optimizer.weight_decai=0.1", "'weight_decay'"),
        ("sampler.bond=0.1", "'band'"),
        ("sampler.band.raech=0.1", "'reach'"),
        ("activation.name=sine", "'sin'"),
        ("optimizer.name=soop", "'soap'"),
        ("optimizer.schedule=cosin", "'cosine'"),
        ("game.constants.radios=2", "'radius'"),
        ("+game.constants.radios=2", "'radius'"),
        ("+trainer.max_step=5", "'max_steps'"),
        ("+loss.norms=l1", "'norm'"),
        ("++data.validations=5", "'validation'"),
        ("+evaluation.start=5", "'starts'"),
        ("+seeed=3", "'seed'"),
        ("trainer.max_step=5", "'max_steps'"),
        ("actvation=sin", "'activation'"),
        ("data.trajectorys=5", "'trajectories'"),
    ],
)
def test_unknown_names_are_answered_with_the_list_and_the_nearest(command: Command, override: str, near: str) -> None:
    refused(command("train", *SMOKE, *override.split()), "Known: ", f"Did you mean {near}?")


@pytest.mark.usefixtures("no_labels")
@pytest.mark.parametrize(
    ("types", "message"),
    [
        ("[[1]]", "2 finite numbers, one per player; got [1]"),
        ("[[1,2,3]]", "2 finite numbers, one per player; got [1, 2, 3]"),
        ("[[1,nan]]", "2 finite numbers"),
        ("[[inf,1]]", "2 finite numbers"),
        ("[[1,one]]", "2 finite numbers"),
        ("[1,1]", "2 finite numbers"),
        ("grid1", "corners, gridN"),
        ("true", "types must be a number, text or a list; got True"),
    ],
)
@pytest.mark.parametrize("entry", ["data.types", "evaluation.types"])
def test_impossible_types(command: Command, entry: str, types: str, message: str) -> None:
    run = command("train", *SMOKE, f"{entry}={types}")
    refused(run, message, entry)
    assert not run.folder.exists()


def test_types_outside_the_range_are_a_visible_warning(command: Command) -> None:
    run = command("train", *SMOKE, "trainer.max_steps=1", "evaluation.types=[[0.5,1]]", "evaluation.starts=1")
    assert run.code == 0, run.text
    assert "ExtrapolationWarning: theta = (0.5, 1.0) lies outside the types [1.0, 1.0] to [5.0, 5.0]" in run.text
    assert "extrapolate" in (run.folder / "train.log").read_text()
    assert [row["theta"] for row in run.results["table"]] == [[1.0, 1.0], [0.5, 1.0]]


def test_types_inside_the_range_warn_of_nothing(command: Command) -> None:
    assert "extrapolate" not in command("train", *SMOKE, "trainer.max_steps=1").text


@pytest.mark.usefixtures("no_labels")
@pytest.mark.parametrize(
    ("override", "message"),
    [
        *((f"{name}={size}", name) for size in ("0", "-3", "1.5", "many") for name in (
            "trainer.max_steps", "data.trajectories", "network.width", "evaluation.starts",
        )),
        *((f"{name}=0", name) for name in (
            "network.depth", "data.validation", "data.workers", "trainer.validate_every", "trainer.print_every",
            "trainer.threads", "optimizer.lr",
        )),
        *((f"function=value function.members={number}", "function.members must be an odd whole number, such as 1 or 3")
          for number in ("0", "2")),
        *((f"function=value function.members={number}", "function.members must be a valid integer")
          for number in ("1.5", "true", "null", "three")),
        ("function.exact_terminal=1", "function.exact_terminal must be a valid boolean"),
        ("data.batch_sizes.bvp=0", "data.batch_sizes.bvp must be greater than or equal to 1; got 0"),
        ("data.batch_sizes.interior=-8", "data.batch_sizes.interior must be greater than or equal to 1; got -8"),
        ("optimizer.lr=-0.1", "optimizer.lr must be greater than 0; got -0.1"),
        ("optimizer.lr=nan", "optimizer.lr must be a finite number"),
        ("data.pretrain=1.2", "data.pretrain must be less than or equal to 1; got 1.2"),
        ("data.widening=-0.1", "data.widening must be greater than or equal to 0; got -0.1"),
        ("data.finish=-0.1", "data.finish must be greater than or equal to 0; got -0.1"),
        ("sampler.band=-1", "sampler.band.share must be greater than or equal to 0; got -1"),
        ("logger.names=[csw]", "logger.names.0 must be 'csv', 'tensorboard' or 'wandb'; got 'csw'"),
        ("~sampler.band.share", "sampler.band.share is missing"),
        ("evaluation.clearance=-0.1", "clearance must be"),
        ("evaluation.dt=0", "dt must be"),
        ("evaluation.dt=0.07", "divides the horizon of 3 s"),
        ("loss.weights.value=-1", "loss.weights.value must be"),
        ("loss.weights.residual=nan", "loss.weights.residual must be"),
        ("loss.norm=l7", "loss.norm must be 'huber', 'l1' or 'l2'"),
        ("data.interior_types=ring", "data.interior_types must be 'labelled' or 'box'; got 'ring'"),
        ("seed=-1", "seed must be greater than or equal to 0; got -1"),
        ("seed=4294967296", "seed must be less than or equal to 4294967295"),
        *((f"{name}=true", name) for name in ("seed", "trainer.max_steps", "optimizer.lr", "data.pretrain")),
    ],
)  # fmt: skip
def test_impossible_numbers(command: Command, override: str, message: str) -> None:
    run = command("train", *SMOKE, *override.split())
    refused(run, message)
    assert not run.folder.exists()


@pytest.mark.usefixtures("no_labels")
def test_every_mistake_is_named_at_once(command: Command) -> None:
    run = command("train", *SMOKE, "seed=-1", "trainer.max_step=3", "network.width=wide")
    refused(run, "seed must be", "trainer.max_step does not exist", "network.width must be a valid integer; got 'wide'")


@pytest.mark.usefixtures("no_labels")
def test_weights_and_terms_belong_together(command: Command) -> None:
    both = "Every loss term needs a weight and every weight a term; got the terms"
    refused(
        command("train", *SMOKE, "operator=sno", "loss.weights.residual=0.1"),
        both,
        "weights of branches, costate, residual",
    )
    refused(command("train", *SMOKE, "loss.weights.residual=null"), both)
    refused(command("train", *SMOKE, "loss.terms.residual=null"), both)
    dry = command("train", *SMOKE, "loss.terms.residual=null", "loss.weights.residual=null", "--dry-run")
    assert dry.code == 0
    assert "residual" not in dry.text


@pytest.mark.usefixtures("no_labels")
@pytest.mark.parametrize("options", [(), ("-m",)])
def test_unwritable_output_folder(command: Command, options: tuple[str, ...]) -> None:
    run = command("train", *options, *SMOKE, "hydra.sweep.dir=/proc/nowhere", folder=Path("/proc/nowhere"))
    refused(run, "output folder cannot be written", "/proc/nowhere", "--to <folder>")


def test_unwritable_label_folder(command: Command) -> None:
    run = command("train", *SMOKE, "data.cache=/proc/nowhere")
    refused(run, "Labels cannot be written to /proc/nowhere")
    assert run.results["status"] == "failed"


@pytest.fixture
def own_cache(labels: Callable[..., Extremal], tmp_path: Path) -> Path:
    """A copy of the labels that a smoke run needs."""
    for request in (shared.SMOKE, shared.TEST):
        own = label_set(make("narrow_road"), request, tmp_path / "labels")
        own.append(0, 0, labels("narrow_road", request))
        own.write_manifest()
    return tmp_path / "labels"


@pytest.mark.parametrize(
    ("split", "damage"),
    [
        ("train", "truncated"),
        ("test", "flipped"),
        pytest.param("train", "flipped", marks=pytest.mark.slow),
        pytest.param("test", "truncated", marks=pytest.mark.slow),
    ],
)
def test_damaged_label_file(command: Command, own_cache: Path, split: str, damage: str) -> None:
    (path,) = own_cache.rglob(f"1-1_{split}*/shard-*.safetensors")
    sound = path.read_bytes()
    content = bytearray(sound)
    content[len(content) // 2] ^= 1
    path.write_bytes(content[:-100] if damage == "truncated" else content)
    damaged = path.read_bytes()
    run = command("train", *SMOKE, "trainer.max_steps=1", f"data.cache={own_cache}")
    assert run.code == 0
    assert f"It is moved to {path.name}.damaged" in run.text
    assert path.with_name(f"{path.name}.damaged").read_bytes() == damaged
    assert path.read_bytes() == sound


def test_a_label_file_that_was_moved_away_is_solved_again(command: Command, own_cache: Path) -> None:
    (path,) = own_cache.rglob("1-1_test*/shard-*.safetensors")
    before = path.read_bytes()
    path.unlink()
    assert command("train", *SMOKE, "trainer.max_steps=1", f"data.cache={own_cache}").code == 0
    assert path.read_bytes() == before


@pytest.mark.usefixtures("no_labels")
def test_resuming_from_what_is_no_run(command: Command, tmp_path: Path, random_checkpoint: Path) -> None:
    before, foreign = random_checkpoint.read_bytes(), tmp_path / "foreign.ckpt"
    (tmp_path / "empty").mkdir()
    foreign.write_bytes(b"these are no weights")
    for place, said in (
        ("/nowhere/last.ckpt", "There is no checkpoint at /nowhere."),
        (tmp_path / "empty", f"There is no checkpoint at {tmp_path}/empty/last.ckpt"),
        (foreign, f"There is no run to go on with in {foreign}"),
        (random_checkpoint, f"There is no run to go on with in {random_checkpoint.parent}"),
    ):
        refused(command("train", *SMOKE, f"resume={place}"), said)
    assert random_checkpoint.read_bytes() == before


def test_every_label_failed(command: Command, monkeypatch: pytest.MonkeyPatch, labels: Callable[..., Extremal]) -> None:
    found = best_of(labels("narrow_road", shared.SMOKE))
    stalled = found._replace(status=torch.ones_like(found.status))
    monkeypatch.setattr(datamodule, "labels_for", lambda *arguments: ([stalled], 0.0))
    run = command("train", *SMOKE)
    refused(run, "None of 3 boundary value problems of NarrowRoad converged")
    assert run.results["reason"].startswith("NoLabelsError")


@pytest.mark.usefixtures("no_labels")
def test_a_weight_of_an_unknown_term(command: Command) -> None:
    run = command("train", *SMOKE, "loss.weights.residuals=1.0", "loss.terms.residuals={}")
    refused(run, "loss.terms.residuals does not exist", "Did you mean 'residual'")
