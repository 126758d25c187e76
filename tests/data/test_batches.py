from __future__ import annotations

import copy
import math
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from torch import Tensor

from hno.data import GameData, LabelPlan
from hno.data.curriculum import Curriculum
from hno.data.datamodule import BOX_TYPES
from hno.data.exchange import write_own
from hno.data.rows import NoLabelsError, rows_of
from hno.games import make
from hno.types import Batch, Status
from tests.data.conftest import TYPES, MakeData
from tests.fakes import fake_labels


def parts(batch: Batch) -> dict[str, list[Tensor]]:
    return {name: [*sample.points, *(sample.labels or ())] for name, sample in batch.items()}


def equal(one: Batch, other: Batch) -> bool:
    one_parts, other_parts = parts(one), parts(other)
    same = (all(map(torch.equal, one_parts[n], other_parts[n])) for n in one_parts)
    return one_parts.keys() == other_parts.keys() and all(same)


def any_equal_rows(one: Tensor, other: Tensor) -> bool:
    return bool((one.flatten(1).unsqueeze(1) == other.flatten(1)).all(-1).any())


def test_batch_is_a_pure_function_of_seed_and_step(make_data: MakeData) -> None:
    forwards, backwards = make_data(seed=3), make_data(seed=3)
    torch.manual_seed(1)
    first = {step: forwards.batch(step) for step in (0, 4, 11)}
    torch.manual_seed(2)
    again = {step: backwards.batch(step) for step in (11, 4, 0)}
    assert all(equal(first[step], again[step]) for step in first)


def test_batch_leaves_the_global_generator_alone(make_data: MakeData) -> None:
    data = make_data()
    before = torch.random.get_rng_state()
    data.batch(5)
    assert torch.equal(torch.random.get_rng_state(), before)


def test_batches_differ_between_steps_and_seeds(make_data: MakeData) -> None:
    data, other = make_data(seed=0), make_data(seed=1)
    here, later, elsewhere = data.batch(10), data.batch(11), other.batch(10)
    for different in (later, elsewhere):
        for name in here:
            assert not torch.equal(here[name].points.x, different[name].points.x)
        assert not any_equal_rows(here["interior"].points.x, different["interior"].points.x)


def test_another_process_draws_the_same_batches_without_labels_of_its_own(make_data: MakeData) -> None:
    data = make_data()
    data.trainer = SimpleNamespace(global_rank=1, global_step=0)
    other = data.for_another_process()
    assert (other.trainer, other.extremals) == (None, [])
    other.setup("fit")
    assert equal(data.batch(10), other.batch(10))
    assert data.extremals, "this one keeps them"


@pytest.mark.parametrize("period", [2**10, 2**12, 2**16, 2**20, 300_000])
def test_batches_do_not_repeat_within_a_run(make_data: MakeData, period: int) -> None:
    """PyTorch's CPU generator reads the lowest 32 bits of its seed."""
    data = make_data()
    assert not torch.equal(data.batch(3)["bvp"].points.x, data.batch(3 + period)["bvp"].points.x)


def test_seed_and_step_do_not_play_the_same_part(make_data: MakeData) -> None:
    assert not equal(make_data(seed=1).batch(2), make_data(seed=2).batch(1))


def test_loader_continues_at_the_step_of_the_trainer(make_data: MakeData) -> None:
    data = make_data()
    data.trainer = SimpleNamespace(global_rank=0, global_step=7)
    batches = iter(data.train_dataloader())
    assert equal(next(batches), data.batch(7))
    assert equal(next(batches), data.batch(8))


@pytest.mark.parametrize("streams", [{"bvp"}, {"bvp", "interior"}, {"bvp", "terminal"}, {"interior"}])
def test_only_named_streams_are_built(make_data: MakeData, streams: set[str]) -> None:
    assert make_data(streams=streams).batch(3).keys() == streams


def test_collocation_waits_for_the_curriculum(make_data: MakeData) -> None:
    data = make_data(curriculum=Curriculum(5, 10))
    assert data.batch(4).keys() == {"bvp"}
    assert data.batch(5).keys() == {"bvp", "interior", "terminal"}


def test_collocation_ends_with_the_curriculum(make_data: MakeData) -> None:
    """Labelled rows are drawn as if it went on."""
    data, endless = (make_data(curriculum=Curriculum(5, 10, end)) for end in (8, None))
    assert equal(data.batch(7), endless.batch(7))
    assert data.batch(8).keys() == {"bvp"}
    assert torch.equal(data.batch(8)["bvp"].points.x, endless.batch(8)["bvp"].points.x)


@pytest.mark.parametrize("curriculum", [Curriculum(5, 10), Curriculum(0, 10, 20)])
def test_nothing_to_train_without_collocation_is_refused(make_data: MakeData, curriculum: Curriculum) -> None:
    with pytest.raises(ValueError, match=r"data\.pretrain and data\.finish to 0"):
        make_data(streams={"interior", "terminal"}, curriculum=curriculum)


@pytest.mark.parametrize("widen", [(), (1.0, 0.0), (-2.0,)])
def test_widths_are_positive_and_there_is_one(widen: tuple[float, ...]) -> None:
    with pytest.raises(ValueError, match=r"data\.widen must be one or several positive widths"):
        GameData(make("narrow_road"), {"bvp"}, labels=LabelPlan(widen=widen))


def test_batch_sizes(make_data: MakeData) -> None:
    data = make_data()
    assert {name: len(sample.points.tau) for name, sample in data.batch(0).items()} == data.batch_sizes
    full = make_data(batch_sizes={"bvp": None, "interior": None, "terminal": 5}).batch(0)
    assert torch.equal(full["bvp"].points.x, data.train_rows.points.x)
    assert len(full["interior"].points.tau) == data.train_rows.size


def labelled_rows(data: GameData) -> Tensor:
    """Every (tau, x, theta, value, costate) of the labels, one row each, by another way than the datamodule's."""
    rows = [
        torch.cat([data.game.horizon - found.t[k, None], *(part.flatten() for part in at)])
        for found in data.extremals
        for b in range(len(found.status))
        for k in range(len(found.t))
        for at in [(found.x[b, k], found.theta[b], found.value[b, k], found.costate[b, k])]
    ]
    return torch.stack(rows).float()


def test_supervised_rows_keep_label_state_time_and_type_together(make_data: MakeData) -> None:
    data = make_data()
    sample = data.batch(0)["bvp"]
    assert sample.labels is not None
    drawn = torch.cat([part.reshape(len(sample.points.tau), -1) for part in (*sample.points, *sample.labels)], -1)
    assert bool((drawn.unsqueeze(1) == labelled_rows(data)).all(-1).any(-1).all())
    assert len(sample.points.theta.unique(dim=0)) == len(TYPES)


def test_held_out_trajectories_are_not_trained_on(make_data: MakeData) -> None:
    data = make_data()
    (whole,) = data.val_dataloader()
    assert len(whole.points.tau) == len(TYPES) * len(data.extremals[0].t)
    assert torch.equal(whole.points.x[0], data.extremals[0].x[-1, 0].float())
    assert not any_equal_rows(whole.points.x, data.train_rows.points.x)


@pytest.mark.parametrize("source", ["labelled", "box"])
def test_every_stream_carries_its_types_as_a_table(make_data: MakeData, source: str) -> None:
    """Nothing has to look for equal types later, and the branch runs once for each of them."""
    data = make_data(interior_types=source)
    samples = {f"{name} {step}": sample for step in (0, 7) for name, sample in data.batch(step).items()}
    samples |= {f"large {name}": sample for name, sample in data.large_batch(7).items()}
    (samples["validation"],) = data.val_dataloader()
    assert len(samples) == 3 * 3 + 1
    for name, (points, _, table) in samples.items():
        assert table is not None, name
        assert table.which.dtype == torch.int64
        assert torch.equal(table.distinct[table.which], points.theta), name
        assert len(table.distinct.unique(dim=0)) == len(table.distinct), name
        of_box = source == "box" and ("interior" in name or "terminal" in name)
        assert len(table.distinct) == (BOX_TYPES if of_box else len(TYPES)), name


def test_own_labels_are_in_the_table(make_data: MakeData, tmp_path: Path) -> None:
    game, path = make("narrow_road"), tmp_path / "mine.safetensors"
    write_own(path, game, fake_labels(game, (2.5, 3.5), 4), "a test")
    data = make_data(game, files=[path])
    assert data.type_list == [*TYPES, (2.5, 3.5)]
    for points, _, table in data.batch(5).values():
        assert table is not None
        assert [2.5, 3.5] in table.distinct.tolist()
        assert torch.equal(table.distinct[table.which], points.theta)


def test_large_batch_is_every_labelled_row_and_collocation_in_proportion(make_data: MakeData) -> None:
    data = make_data()
    size, before = data.train_rows.size, dict(data.batch_sizes)
    assert size > 2 * 32
    large, factor = data.large_batch(8), math.ceil(size / 32)
    assert {name: sample.size for name, sample in large.items()} == {
        "bvp": size, "interior": 64 * factor, "terminal": 16 * factor,
    }  # fmt: skip
    assert torch.equal(large["bvp"].points.x, data.train_rows.points.x)
    assert data.batch_sizes == before
    assert equal(large, data.large_batch(8))
    full = make_data(batch_sizes={"bvp": None, "interior": None, "terminal": 5})
    assert equal(full.large_batch(8), full.batch(8))


def test_failed_trajectories_are_no_labels() -> None:
    game = make("narrow_road")
    status = [Status.CONVERGED, Status.STALLED, Status.NOT_FINITE, Status.MAX_STEPS]
    found = fake_labels(game, status=status)
    rows = rows_of(game, [found])
    assert torch.equal(rows.points.x, found.x[0].float())


def test_without_a_single_label_there_is_a_message(make_data: MakeData) -> None:
    game = make("narrow_road")
    failed = fake_labels(game, status=[Status.STALLED] * 4)
    with pytest.raises(NoLabelsError, match=r"None of 8 .*check_game"):
        rows_of(game, [failed, failed])


def test_scales_are_mean_sizes(make_data: MakeData) -> None:
    data = make_data()
    value, costate = data.scales()
    trained = [found.costate[:3].abs().mean((0, 1)) for found in data.extremals]
    torch.testing.assert_close(costate, torch.stack(trained).mean(0).float())
    torch.testing.assert_close(
        value, torch.stack([found.value[:3].abs().mean() for found in data.extremals]).mean().float()
    )


def test_batches_do_not_follow_the_game_elsewhere(make_data: MakeData) -> None:
    """The operator moves its own game to a device and a precision; the batches stay."""
    game = make("narrow_road")
    data = make_data(game)
    before = copy.deepcopy(data.batch(2))
    game.double()
    assert equal(data.batch(2), before)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"interior_types": "boxes"}, "'labelled' or 'box'"),
        ({"trajectories": 0}, "trajectories"),
        ({"validation": -1}, "validation"),
        ({"batch_sizes": {"bvp": 0, "interior": 1, "terminal": 1}}, "bvp"),
        ({"batch_sizes": {"bvp": 1, "interior": -8, "terminal": 1}}, "interior"),
    ],
)
def test_impossible_settings_are_refused(make_data: MakeData, changes: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make_data(**changes)


def test_scales_stay_positive_where_no_value_depends_on_a_state(make_data: MakeData) -> None:
    data = make_data()
    data.train_rows.labels.costate[..., 2] = 0
    value, costate = data.scales()
    width = data.game.state_box.width[:, 2]
    torch.testing.assert_close(costate[..., 2], (1e-3 * value / width).expand(2, 2))
    assert bool((costate > 0).all())
