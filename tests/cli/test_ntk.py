from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch

from hno.control import Feedback
from hno.evaluation.ntk import TangentKernel
from hno.evaluation.sections import Evaluation
from hno.evaluation.spectrum import spectrum, summary
from hno.games import make
from hno.operators import make_operator
from hno.types import Status
from tests.cli.conftest import SMOKE, Command, refused
from tests.fakes import fake_labels, small_architecture

FAST = ("workers=1", "starts=4", "dt=0.25")


def test_the_kernel_at_training_types_is_in_the_results(command: Command, random_checkpoint: Path) -> None:
    run = command("evaluate", f"checkpoint={random_checkpoint}", "theta=1,1;1,2", "ntk=true", "ntk_rows=65", *FAST)
    assert run.code == 0, run.text
    section = run.results["ntk"]
    assert [(entry["theta"], entry["points"], entry["block"], entry["reason"]) for entry in section] == [
        ([1, 1], 3, 60, None)
    ]
    assert run.results["seconds"]["ntk"] > 0
    for kind in ("kernel", "product"):
        found = section[0][kind]
        assert found["rows"] == 60
        assert found["cutoff"] == 60 * 2.0**-52
        assert found["condition"] == pytest.approx(found["curve"][0][1] / found["curve"][-1][1])
        assert 1 <= found["effective_rank"] <= found["rank"] <= 60
    assert "Neural tangent kernel" in run.text
    assert "paper's product" in run.text


def test_training_can_end_with_the_kernel(command: Command) -> None:
    run = command(
        "train", *SMOKE, "function=value", "trainer.max_steps=1", "evaluation.ntk=true", "evaluation.ntk_rows=40"
    )
    assert run.code == 0, run.text
    assert [(entry["theta"], entry["kernel"]["rows"]) for entry in run.results["ntk"]] == [([1, 1], 40)]
    assert "Neural tangent kernel" in run.text


@pytest.mark.usefixtures("no_labels")
@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("function=value evaluation.ntk_rows=19", "must be"),
        ("evaluation.ntk=maybe", "must be"),
        (
            "function=value function.members=3",
            "ntk=true is for one net, this operator has 3. Train it with function.members=1",
        ),
        ("function=potential", "ntk=true is for the players' values, which function=value learns"),
    ],
)
def test_a_training_that_cannot_is_refused_before_it_begins(command: Command, override: str, message: str) -> None:
    refused(command("train", *SMOKE, "evaluation.ntk=true", *override.split()), message)


def test_no_kernel_unless_asked_for(command: Command, random_checkpoint: Path) -> None:
    run = command("evaluate", f"checkpoint={random_checkpoint}", "theta=1,2", *FAST)
    assert run.code == 0, run.text
    assert "ntk" not in run.results
    assert "tangent" not in run.text


@pytest.mark.usefixtures("no_labels")
@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["ntk=yes please"], "ntk must be a valid boolean; got 'yes please'"),
        (["ntk=true", "ntk_rows=19"], "ntk_rows must be a whole number of at least 20, the rows of one point; got 19"),
        (["ntk=true", "ntk_rows=many"], "ntk_rows must be"),
        (["ntk=true", "ntk_rows=true"], "ntk_rows must be"),
        (["ntk=true", "theta=1,2"], 'needs a type of the training run among theta; these are "1,1"'),
    ],
)
def test_impossible_settings(command: Command, random_checkpoint: Path, overrides: list[str], message: str) -> None:
    refused(command("evaluate", f"checkpoint={random_checkpoint}", *overrides, *FAST), message)


def test_a_type_without_labels_says_why() -> None:
    torch.manual_seed(0)
    operator = make_operator(make("narrow_road"), small_architecture(width=8, depth=1))
    failed = fake_labels(operator.game, (1.0, 1.0), status=[Status.STALLED] * 4)
    labels = [failed, fake_labels(operator.game, (1.0, 5.0)), fake_labels(operator.game, (3.0, 3.0))]
    seen, types = [(1.0, 1.0), (1.0, 5.0)], [(1.0, 1.0), (1.0, 5.0), (3.0, 3.0)]
    evaluation = Evaluation(
        "any", Feedback(operator), seen, types, {"ntk_rows": 40, "seed": 0}, lambda condition: labels, labels,
    )  # fmt: skip
    section = TangentKernel().compute(evaluation)
    assert [(entry["theta"], entry["points"]) for entry in section] == [([1.0, 1.0], 0), ([1.0, 5.0], 2)]
    assert (section[0]["kernel"], section[0]["product"]) == (None, None)
    assert "None of 4 boundary value problems" in section[0]["reason"]
    assert shown(section)[0] == ["1, 1", "0", "J J'", *["n/a"] * 4]


def shown(section: list[dict[str, Any]]) -> list[list[str]]:
    """Cells of the section's table."""
    found = TangentKernel()
    return [[column.format(row[column.name]) for column in found.columns] for row in found.rows(section)]


def test_a_kernel_that_is_cut_off_has_no_condition_number_in_the_table() -> None:
    rank_one = summary(spectrum(torch.ones(4, 4, dtype=torch.float64)))
    (first, _) = shown([{"theta": [1, 1], "points": 1, "kernel": rank_one, "product": rank_one}])
    assert first[3:6] == ["> 1.13e+15", "1 of 4", "1.0"]
