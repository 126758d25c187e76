from __future__ import annotations

import hashlib
import os
import pickle
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

import hno
from hno.control import Feedback
from hno.games import make
from hno.games.base import ExtrapolationWarning
from hno.operators import Choice, ValueOperator
from hno.operators import make_operator as built
from hno.registry import UnknownNameError
from hno.training.checkpoint import CheckpointError, Provenance, check_resumable, load_operator, read_checkpoint, record
from hno.training.saving import MARK, seal
from hno.types import Field, Points, Types
from tests.operators.conftest import GAMES, MakeOperator, architecture, random_points

Save = Callable[..., Path]


ORIGIN = Provenance("hno", [(1.0, 1.0), (1.0, 5.0)], 7, "hash")


UNTRAINED = {
    "global_step": 0,
    "loops": {
        "fit_loop": {
            "epoch_loop.automatic_optimization.optim_progress": {"optimizer": {"step": {"total": {"completed": 0}}}},
            "epoch_loop.batch_progress": {},
            "epoch_progress": {},
        }
    },
    "optimizer_states": [{"state": {}, "param_groups": [{"params": [0]}]}],
    "lr_schedulers": [],
    "callbacks": {},
}
"""As much of what Lightning adds as is looked at before a training goes on."""


def saved(operator: ValueOperator, **options: Any) -> dict[str, Any]:
    """What training writes of an operator of these options."""
    weights = {f"operator.{name}": weight for name, weight in operator.state_dict().items()}
    return record(operator.game, architecture(**options), ORIGIN) | {"state_dict": weights}


@pytest.fixture
def save(make_operator: MakeOperator, tmp_path: Path) -> Save:
    """Write the checkpoint of a random operator, with some entries of its record or content replaced."""

    def write(game: str = "narrow_road", spec: dict[str, Any] | None = None, **content: Any) -> Path:
        whole = saved(make_operator(game))
        whole["hno"] |= spec or {}
        path = tmp_path / "last.ckpt"
        path.write_bytes(seal(whole | content))
        return path

    return write


def refused(path: Path, **options: str) -> str:
    with pytest.raises(CheckpointError) as error:
        load_operator(path, **options)
    assert str(path) in str(error.value)
    return str(error.value)


@pytest.mark.parametrize("game", GAMES)
def test_round_trip(make_operator: MakeOperator, save: Save, game: str) -> None:
    path, original = save(game), make_operator(game)
    loaded, parts, origin = load_operator(path, game)
    points = random_points(original.game)
    assert all(map(torch.equal, loaded.field(points), original.field(points)))
    assert (parts, origin) == (architecture(), ORIGIN)
    assert not loaded.training
    assert not any(weights.requires_grad for weights in loaded.parameters())
    policy = hno.load_policy(path)
    assert policy.types == [(1.0, 1.0), (1.0, 5.0)]
    assert policy.names() == {"game": game, "operator": "hno", "function": "value", "activation": "tanh"}


def test_branches_that_are_played_travel_with_the_checkpoint(tmp_path: Path) -> None:
    """A branch that no label has stays closed after loading, also where its W would be the largest."""
    chosen = replace(architecture(), function=Choice("potential", {"exact_terminal": True}))
    torch.manual_seed(0)
    original = built(make("narrow_road"), chosen)
    points = random_points(original.game, 32)
    for closed in (None, 0, 1):
        original.active.fill_(True)
        if closed is not None:
            original.set_branches(torch.tensor([1 - closed]))
        weights = {f"operator.{name}": weight for name, weight in original.state_dict().items()}
        (tmp_path / "last.ckpt").write_bytes(seal(record(original.game, chosen, ORIGIN) | {"state_dict": weights}))
        loaded, parts, _ = load_operator(tmp_path / "last.ckpt")
        assert (parts, loaded.potential) == (chosen, True)
        assert torch.equal(loaded.active, original.active)
        assert all(map(torch.equal, loaded.field(points), original.field(points)))
        policy = hno.load_policy(tmp_path / "last.ckpt")
        assert policy.names()["function"] == "potential"
        assert set(policy.branch(*points).tolist()) == {0, 1} - {closed}
        assert torch.equal(policy.act(*points), Feedback(original).act(*points))


def test_changed_constants_travel_with_the_checkpoint(make_operator: MakeOperator, tmp_path: Path) -> None:
    (tmp_path / "last.ckpt").write_bytes(seal(saved(make_operator(make("narrow_road", radius=1.4)))))
    assert load_operator(tmp_path / "last.ckpt")[0].game.radius == 1.4


def test_missing_file(tmp_path: Path) -> None:
    assert "There is no checkpoint at" in refused(tmp_path / "nowhere.ckpt")


@pytest.mark.parametrize("kept", [0, 1, 100, 0.3, 0.9, 0.999])
def test_truncated_file(save: Save, kept: float) -> None:
    path = save()
    content = path.read_bytes()
    path.write_bytes(content[: int(kept * len(content)) if kept < 1 else int(kept)])
    assert "not a readable checkpoint" in refused(path)


@pytest.mark.parametrize("content", [b"", b"not a checkpoint", b"PK\x03\x04 half a zip", bytes(range(256)) * 4])
def test_foreign_bytes(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "last.ckpt"
    path.write_bytes(content)
    assert "not a readable checkpoint" in refused(path)


def test_a_folder_is_no_checkpoint(tmp_path: Path) -> None:
    refused(tmp_path)


@pytest.mark.parametrize("content", [{"state_dict": {}}, {"weights": torch.zeros(2)}, [1, 2], torch.zeros(3)])
def test_checkpoint_of_another_program(tmp_path: Path, content: object) -> None:
    path = tmp_path / "other.ckpt"
    torch.save(content, path)
    assert "not written by hno, or by a version before format 5" in refused(path)
    path.write_bytes(seal(content))
    assert "was not written by hno" in refused(path)


class Trap:
    """Unpickling this creates a file."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[object, ...]:
        return os.mkdir, (str(self.path),)


@pytest.mark.filterwarnings("ignore:Detected pickle protocol 4")
@pytest.mark.parametrize("how", ["torch", "pickle", "inside"])
def test_code_in_a_checkpoint_is_refused_and_not_run(save: Save, tmp_path: Path, how: str) -> None:
    sprung, path = tmp_path / "sprung", tmp_path / "last.ckpt"
    if how == "pickle":
        body = pickle.dumps(Trap(sprung)) + MARK
        path.write_bytes(body + hashlib.sha256(body).hexdigest().encode())
    elif how == "torch":
        path.write_bytes(seal(Trap(sprung)))
    else:
        path = save(extra=Trap(sprung))
    for load in (load_operator, read_checkpoint, hno.load_policy):
        with pytest.raises(CheckpointError, match="not a readable checkpoint"):
            load(path)
    assert not sprung.exists()
    if how == "pickle":
        pickle.loads(path.read_bytes())
    else:
        torch.load(path, weights_only=False)
    assert sprung.exists(), "the trap itself works"


def test_checkpoint_of_another_game(save: Save) -> None:
    message = refused(save("drone"), game="narrow_road")
    assert "'drone'" in message
    assert "'narrow_road'" in message


@pytest.mark.parametrize("part", ["function", "network", "activation"])
def test_a_part_that_is_not_registered_here(save: Save, part: str) -> None:
    parts = asdict(architecture()) | {part: {"name": "elsewhere", "options": {}}}
    with pytest.raises(UnknownNameError, match=rf"No {part} named 'elsewhere'\. Known: "):
        load_operator(save(spec={"architecture": parts}))


def test_a_game_that_is_not_registered_here(save: Save) -> None:
    wanted = r"game 'elsewhere', which is not registered here.*import that script first\. Known: "
    with pytest.raises(UnknownNameError, match=wanted):
        load_operator(save(spec={"game": "elsewhere"}))


def test_changed_physics(save: Save, monkeypatch: pytest.MonkeyPatch) -> None:
    path = save()
    monkeypatch.setattr(type(make("narrow_road")), "penalty_height", 2e4)
    assert "another version of the game 'narrow_road'" in refused(path)


def test_weights_of_another_network(save: Save) -> None:
    assert "does not hold the weights" in refused(save(spec={"architecture": asdict(architecture(width=32))}))
    assert "does not hold the weights" in refused(save(state_dict={}))


@pytest.mark.parametrize("version", [1, 2, 3, 4, 99, None])
def test_another_format_is_one_clear_sentence(save: Save, version: int | None) -> None:
    """Format 2 is what the releases before wrote: an operator's own name, options and types."""
    older = {"format": version, "game": "narrow_road", "operator": "hno", "options": {"width": 64}, "seen_types": []}
    path = save(hno=older)
    assert refused(path) == f"{path} has format {version}, this version of hno reads format 7: train it again."
    assert "train it again" in refused(save(spec={"format": version}))


@pytest.mark.parametrize("entry", ["game", "constants", "fingerprint", "architecture", "provenance"])
def test_an_incomplete_record_is_refused(make_operator: MakeOperator, tmp_path: Path, entry: str) -> None:
    whole = saved(make_operator())
    del whole["hno"][entry]
    path = tmp_path / "last.ckpt"
    path.write_bytes(seal(whole))
    assert refused(path) == f"{path} is not complete: its entry 'hno' lacks {entry}. Train it again."


def test_resuming_asks_for_the_same_game_operator_network_and_origin(make_operator: MakeOperator, save: Save) -> None:
    path, game = save(**UNTRAINED), make("narrow_road")
    check_resumable(path, record(game, architecture(), ORIGIN))
    for other, differs in (
        (record(make("drone"), architecture(), ORIGIN), "game 'narrow_road', expected 'drone'"),
        (record(make("narrow_road", radius=1.4), architecture(), ORIGIN), "radius"),
        (record(game, architecture(width=32), ORIGIN), "width 16, expected 32"),
        (record(game, architecture(members=3), ORIGIN), "members 1, expected 3"),
        (record(game, architecture("sin"), ORIGIN), "'tanh', expected 'sin'"),
        (record(game, architecture(), replace(ORIGIN, method="sno")), "method 'hno', expected 'sno'"),
        (record(game, architecture(), replace(ORIGIN, seed=8)), "seed 7, expected 8"),
        (record(game, architecture(), replace(ORIGIN, training_hash="another")), "training_hash"),
    ):
        with pytest.raises(CheckpointError, match=f"{differs}.*Resume with its own configuration"):
            check_resumable(path, other)


def car_controls(own: Tensor) -> Tensor:
    """(angular velocity, acceleration) as the paper states them."""
    return torch.stack([(own[..., 2] / 200).clamp(-1, 1), (own[..., 3] / 2).clamp(-5, 10)], -1)


def drone_controls(own: Tensor) -> Tensor:
    """(roll, pitch, thrust) as the paper states them."""
    limit = torch.tensor(0.05).tan()
    roll = (9.81 * own[..., 3] / 200).clamp(-limit, limit).atan()
    pitch = (-9.81 * own[..., 4] / 200).clamp(-limit, limit).atan()
    return torch.stack([roll, pitch, (own[..., 5] / 2).clamp(-2, 2) + 9.81], -1)


PAPER = {"narrow_road": car_controls, "lane_change": car_controls, "drone": drone_controls}


@pytest.mark.parametrize("game", GAMES)
@pytest.mark.parametrize("size", [1.0, 40.0, 4000.0])
def test_policy_plays_the_controls_of_the_paper(save: Save, game: str, size: float) -> None:
    path = save(game)
    policy = hno.load_policy(path)
    policy.operator.value_scale.fill_(size)
    points = random_points(policy.game, 50)
    u = policy(*points)
    assert u.shape == (50, 2, policy.game.control_dim)
    box = policy.game.control_box
    assert bool(((u >= box.lo - 1e-6) & (u <= box.hi + 1e-6)).all())
    costate = policy.operator.field(points).costate
    own = torch.stack([costate[:, 0, 0], costate[:, 1, 1]], 1)
    torch.testing.assert_close(u, PAPER[game](own), rtol=1e-5, atol=1e-6)


def test_policy_reads_own_costates_only(make_operator: MakeOperator, monkeypatch: pytest.MonkeyPatch) -> None:
    operator = make_operator()
    policy, points = Feedback(operator), random_points(operator.game)
    before, field = policy(*points), operator.field

    def with_other_cross_costates(at: Points, types: Types | None = None) -> Field:
        known = field(at)
        costate = known.costate.clone()
        costate[:, 0, 1] += 100
        costate[:, 1, 0] -= 100
        return known._replace(costate=costate)

    monkeypatch.setattr(operator, "field", with_other_cross_costates)
    assert torch.equal(policy(*points), before)


def test_policy_works_where_gradients_are_switched_off(save: Save) -> None:
    policy = hno.load_policy(save())
    points = random_points(policy.game)
    with torch.no_grad():
        assert torch.equal(policy(*points), policy(*points))


def test_policy_works_in_inference_mode(save: Save) -> None:
    policy = hno.load_policy(save())
    points = random_points(policy.game)
    with torch.inference_mode():
        inside = policy(*(part.clone() for part in points))
    torch.testing.assert_close(inside, policy(*points), rtol=0, atol=0)


@pytest.mark.parametrize("which", ["tau", "x", "theta"])
def test_policy_refuses_entries_that_are_not_finite(save: Save, which: str) -> None:
    policy = hno.load_policy(save())
    points = random_points(policy.game)
    broken = getattr(points, which).clone()
    broken.view(-1)[-1] = torch.nan
    with pytest.raises(ValueError, match="finite"):
        policy(*points._replace(**{which: broken}))


def test_policy_warns_outside_the_types(save: Save) -> None:
    policy = hno.load_policy(save())
    points = random_points(policy.game)
    with pytest.warns(ExtrapolationWarning):
        policy(*points._replace(theta=points.theta + 9))


@pytest.mark.parametrize("game", GAMES)
def test_fingerprint_is_the_same_in_every_dtype(game: str) -> None:
    assert make(game).double().fingerprint() == make(game).fingerprint()


def test_fingerprint_tells_sensors_apart() -> None:
    changed = make("narrow_road")
    changed.first_sensor = 0.5
    assert changed.fingerprint() != make("narrow_road").fingerprint()


def test_an_answer_takes_one_thread_unless_told_otherwise(save: Save, monkeypatch: pytest.MonkeyPatch) -> None:
    seen = []
    monkeypatch.setattr(torch, "get_num_threads", lambda: 7)
    monkeypatch.setattr(torch, "set_num_threads", seen.append)
    points = random_points(make("narrow_road"))
    for threads in (1, 2):
        policy = hno.load_policy(save(), threads=threads)
        field = policy.operator.field
        monkeypatch.setattr(policy.operator, "field", lambda at, field=field: (seen.append("asked"), field(at))[1])
        for ask in (policy, policy.value, policy.costate):
            ask(*points)
    assert seen == [1, "asked", 7] * 3 + [2, "asked", 7] * 3


def test_the_folder_of_a_run_is_enough(save: Save) -> None:
    path = save()
    points = random_points(make("narrow_road"))
    assert torch.equal(hno.load_policy(path.parent)(*points), hno.load_policy(path)(*points))
    path.unlink()
    assert "There is no checkpoint at" in refused(path.parent)
