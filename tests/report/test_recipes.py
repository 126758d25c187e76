"""Pooled counts and spreads over seeds, against the formulas written out."""

from __future__ import annotations

import itertools
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import beta, t

from hno.evaluation.outcome import pooled
from hno.report.page_data import heat_map
from hno.report.recipes import Recipe, best, by_type, headline, recipes, rivals, spread
from hno.report.records import Row, Run, type_row
from hno.report.runs import load
from hno.report.tables import recipe_table
from hno.report.verdicts import denominator
from tests.report.folders import make_results, row, write_run

FIRST, SECOND = (1.0, 1.0), (5.0, 5.0)


def result(theta: tuple[float, ...], collisions: int, starts: int, excess_cost: float | None = None) -> Row:
    return type_row(row(theta, collisions, starts) | {"median_excess_cost": excess_cost, "median_label_cost": 10.0})


def write(folder: Path, seed: int, collisions: Sequence[int], **entries: Any) -> None:
    names = {"game": "drone", "operator": "sno", "function": "value", "activation": "tanh"} | entries
    table = [row(theta, count, 100) for theta, count in zip((FIRST, SECOND), collisions, strict=True)]
    results = {"status": "finished", "reason": None, "seed": seed, "seconds": {"labels": 1.0 + seed}}
    results |= {"config": {"operator": names["operator"], "seed": seed}, "table": table, "episodes": None} | names
    write_run(folder, results, extras=False)


def loaded(folder: Path) -> tuple[Run, ...]:
    return load(folder).runs


@given(starts=st.integers(1, 400), share=st.floats(0, 1))
def test_the_interval_is_clopper_pearson(starts, share):
    hits = round(share * starts)
    (counts,) = by_type([result(FIRST, hits, starts)])
    low, high = counts["interval"]
    assert low == pytest.approx(beta.ppf(0.025, hits, starts - hits + 1) if hits else 0.0)
    assert high == pytest.approx(beta.ppf(0.975, hits + 1, starts - hits) if hits < starts else 1.0)


@given(st.lists(st.floats(-5, 5), min_size=2, max_size=8))
def test_the_spread_is_students(values):
    count, found = len(values), spread(values)
    centre = sum(values) / count
    deviation = math.sqrt(sum((value - centre) ** 2 for value in values) / (count - 1))
    assert found.mean == pytest.approx(centre, abs=1e-12)
    half = t.ppf(0.975, count - 1) * deviation / math.sqrt(count)
    assert found.interval == pytest.approx((centre - half, centre + half), abs=1e-9)
    assert (found.low, found.high, found.seeds) == (min(values), max(values), count)


def test_nothing_is_not_zero():
    assert spread([None, None]) is None
    assert spread([None, 3.0]) == (3.0, None, 3.0, 3.0, 1)
    (counts,) = by_type([result(FIRST, 0, 0)])
    assert [counts[name] for name in ("rate", "interval", "relative_excess")] == [None, None, None]


def test_types_outside_the_box_stay_marked_over_seeds_and_on_the_page():
    inside, outside = (
        type_row(row(theta, 1) | {"extrapolated": flag}) for theta, flag in ((FIRST, False), (SECOND, True))
    )
    cells = heat_map(by_type([inside, outside, outside]))["cells"]
    assert ["extrapolated" in cell["tip"] for cell in cells] == [False, True]


@pytest.mark.parametrize(
    ("counts", "shown"), [([(0, 0)], "n/a"), ([(0, 9), (0, 9)], "none"), ([(0, 9), (1, 10)], "(5, 5) 10.00 %")]
)
def test_where_nothing_collided_no_type_is_the_worst(tmp_path, counts, shown):
    table = [row(theta, *found) for theta, found in zip((FIRST, SECOND), counts, strict=False)]
    write(tmp_path / "0", 0, (0, 0), table=table)
    assert cell(tmp_path, "worst type") == shown


def test_counts_are_pooled_and_other_numbers_averaged():
    (found,) = by_type([result(FIRST, 1, 100, 2.0), result(FIRST, 4, 50, None), result(FIRST, 0, 50, 4.0)])
    assert (found["collisions"], found["safe_starts"], found["relative_excess"]) == (5, 200, pytest.approx(0.3))


def test_the_excess_of_a_run_is_the_median_over_types():
    rows = [result((k, k), 0, 9, cost) for k, cost in enumerate((1.0, 2.0, 7.0))]
    assert pooled(rows).relative_excess == pytest.approx(0.2)


def rate(recipe: Recipe) -> tuple[int, int]:
    return recipe.pooled.collisions, recipe.pooled.safe_starts


def cell(folder: Path, heading: str) -> str:
    """Of the one line of the table of recipes."""
    table = recipe_table(recipes(loaded(folder)))
    (texts,) = table.texts
    return texts[[column.title for column in table.columns].index(heading)]


def test_seeds_of_one_recipe_are_one_line(tmp_path):
    write(tmp_path / "0", 0, (0, 1))
    write(tmp_path / "1", 1, (2, 5))
    (recipe,) = recipes(loaded(tmp_path))
    assert rate(recipe) == (8, 400)
    assert [(entry["theta"], entry["collisions"], entry["safe_starts"]) for entry in recipe.types] == [
        (FIRST, 2, 200),
        (SECOND, 6, 200),
    ]
    assert (recipe.rates.low, recipe.rates.high) == (1 / 200, 7 / 200)
    assert recipe.seconds("labels").mean == 1.5
    assert recipe.variant == ""


@pytest.mark.parametrize(("seeds", "shown"), [((0,), "cached"), ((0, 1), "5 (partly cached)"), ((1, 2), "15")])
def test_labels_from_the_cache_are_said_to_be(tmp_path, seeds, shown):
    for seed in seeds:
        write(tmp_path / str(seed), seed, (0, 1), seconds={"labels": 10.0 * seed, "training": 50.0})
    assert cell(tmp_path, "labels, s") == shown


def test_another_setting_is_another_recipe_and_says_which(tmp_path):
    for name, weight in (("0", 0.1), ("1", 0.2)):
        write(tmp_path / name, 0, (0, 0), config={"loss": {"weight": weight}, "seed": 0, "data": {"cache": name}})
    assert [recipe.variant for recipe in recipes(loaded(tmp_path))] == ["loss.weight=0.1", "loss.weight=0.2"]


def test_a_potential_and_values_are_recipes_of_their_own(tmp_path):
    for name in ("potential", "value"):
        write(tmp_path / name, 0, (0, 1), function=name)
    found = recipes(loaded(tmp_path))
    assert [(one.function, one.name, one.seeds) for one in found] == [
        ("potential", "sno / potential / tanh", "1 seed"),
        ("value", "sno / value / tanh", "1 seed"),
    ]
    assert [row["function"] for row in recipe_table(found).rows] == ["potential", "value"]


def test_results_that_do_not_say_what_was_learned_have_names_without_it(tmp_path):
    write(tmp_path / "0", 0, (0, 1))
    results = json.loads((tmp_path / "0" / "results.json").read_text())
    del results["function"]
    (tmp_path / "0" / "results.json").write_text(json.dumps(results))
    (recipe,) = recipes(loaded(tmp_path))
    assert recipe.name == "sno / tanh"


def test_the_same_seed_counts_once(tmp_path):
    write(tmp_path / "0", 0, (50, 50))
    write(tmp_path / "1", 0, (1, 1))
    (recipe,) = recipes(loaded(tmp_path))
    assert rate(recipe) == (2, 200)
    assert [run.name for run in recipe.repeated] == ["0"]


def test_failed_and_unfinished_runs_are_told_but_not_counted(tmp_path):
    write(tmp_path / "0", 0, (1, 0))
    write(tmp_path / "1", 1, (90, 90), status="failed", reason="diverged")
    write(tmp_path / "2", 2, (90, 90), status="running")
    (recipe,) = recipes(loaded(tmp_path))
    assert (rate(recipe), recipe.failed, recipe.unfinished) == ((1, 200), 1, 1)


def test_the_best_has_the_lowest_rate_and_names_its_rivals(tmp_path):
    for operator, collisions in (("sno", (0, 1)), ("hno", (0, 2)), ("other", (40, 60))):
        write(tmp_path / operator, 0, collisions, operator=operator)
    found = recipes(loaded(tmp_path))
    (chosen,) = best(found)
    assert chosen.operator == "sno"
    assert [(one.recipe.operator, one.told_apart) for one in rivals(chosen, found)] == [
        ("hno", False),
        ("other", True),
    ]


def test_other_conditions_of_play_are_not_compared(tmp_path):
    write(tmp_path / "0", 0, (5, 5))
    write(tmp_path / "1", 0, (0, 0), operator="hno", noise=0.2)
    write(tmp_path / "2", 0, (0, 0), operator="narrow", table=[row(FIRST, 0, 100)])
    write(tmp_path / "3", 0, (0, 0), operator="elsewhere", table=[row(FIRST, 50, 100), row((2.0, 2.0), 0, 100)])
    config = {"game": {"name": "drone", "constants": {"radius": 0.1}}, "seed": 0}
    write(tmp_path / "4", 0, (0, 0), operator="easy", config=config)
    found = recipes(loaded(tmp_path))
    assert len(best(found)) == 5
    assert rate(headline(best(found))) == (10, 200)
    assert any("radius 0.1" in recipe.conditions for recipe in found)
    assert all(rivals(chosen, found) == [] for chosen in best(found))


def test_runs_without_a_configuration_are_told_apart_by_their_steps(tmp_path):
    import numpy as np

    for k, steps in enumerate((10, 20)):
        results = make_results("drone", "sno", "tanh", 0, np.random.default_rng(0), [FIRST], steps=steps)
        del results["config"]
        write_run(tmp_path / str(k), results, extras=False)
    assert [recipe.variant for recipe in recipes(loaded(tmp_path))] == ["steps=10", "steps=20"]


def started(folder: Path, name: str, collided: str, key: str = "same", counted: str = "") -> None:
    """A run whose single starts are kept."""
    write(folder / name, 0, (collided.count("1"), 0), operator=name)
    content = json.loads((folder / name / "results.json").read_text()) | {"outcomes": "outcomes.json"}
    (folder / name / "results.json").write_text(json.dumps(content))
    one = {"theta": FIRST, "key": key, "counted": counted or "1" * len(collided), "collided": collided}
    (folder / name / "outcomes.json").write_text(json.dumps({"types": [one]}))


@pytest.mark.parametrize(
    ("other", "key", "p_value"),
    [
        ("1" * 8 + "0" * 92, "same", 2 / 2**8),
        ("0" * 100, "same", 1.0),
        ("1" + "0" * 99, "same", 1.0),
        ("1" * 8 + "0" * 92, "others", None),
    ],
)
def test_recipes_are_told_apart_start_by_start(tmp_path, other, key, p_value):
    """McNemar's exact test: of starts from which only one collides, either is as likely. Other starts have no pairs."""
    started(tmp_path, "hno", "0" * 100)
    started(tmp_path, "sno", other, key)
    found = recipes(loaded(tmp_path))
    (rival,) = rivals(best(found)[0], found)
    assert rival.p_value == (None if p_value is None else pytest.approx(p_value))
    if p_value is not None:
        assert rival.told_apart == (p_value < 0.05)


def test_starts_that_do_not_count_do_not_tell_recipes_apart(tmp_path):
    counted = "0" * 8 + "1" * 92
    started(tmp_path, "hno", "0" * 100, counted=counted)
    started(tmp_path, "sno", "1" * 8 + "0" * 92, counted=counted)
    found = recipes(loaded(tmp_path))
    assert rivals(found[0], found)[0].p_value == 1.0


def test_what_was_swept_names_recipes_in_its_order_and_no_two_alike(tmp_path):
    """The example of a sweep over four keys; the alphabet would begin with another."""
    for number, (optimizer, sampler, lr) in enumerate(
        itertools.product(("soap", "adam"), ("mixed", "uniform"), (1, 2))
    ):
        config = {"optimizer": {"name": optimizer, "lr": lr, "a": optimizer}, "data": {"a": sampler}, "seed": 0}
        write(tmp_path / str(number), 0, (0, 0), config=config)
        task = [f"optimizer={optimizer}", f"sampler={sampler}", f"++optimizer.lr={lr}", "experiment=smoke", "seed=0"]
        hydra = {"job": {"name": "train"}, "overrides": {"task": task}}
        (tmp_path / str(number) / ".hydra" / "hydra.yaml").write_text(json.dumps({"hydra": hydra}))
    names = [one.variant for one in recipes(loaded(tmp_path))]
    assert len(set(names)) == 8
    assert names[0] == "optimizer=soap, sampler=mixed, optimizer.lr=1"
    assert len({texts[1] for texts in recipe_table(recipes(loaded(tmp_path))).texts}) == 8


def test_recipes_that_no_command_line_tells_apart_are_named_by_their_settings(tmp_path):
    for number in range(9):
        bits = {f"k{place}": number >> place & 1 for place in range(4)}
        write(tmp_path / str(number), 0, (0, 0), config={**bits, "seed": 0})
    names = [one.variant for one in recipes(loaded(tmp_path))]
    assert len(set(names)) == 9


def test_of_several_rivals_each_p_value_is_corrected(tmp_path):
    """6 and 7 starts from which one alone collides: the larger p-value stays, and the smaller one is doubled."""
    started(tmp_path, "hno", "0" * 100)
    for name, collisions in (("sno", 6), ("own", 7)):
        started(tmp_path, name, "1" * collisions + "0" * (100 - collisions))
    found = recipes(loaded(tmp_path))
    chosen = best(found)[0]
    p_values = {one.recipe.operator: one.p_value for one in rivals(chosen, found)}
    assert p_values == {"sno": pytest.approx(2 / 2**6), "own": pytest.approx(2 * 2 / 2**7)}


def test_values_that_begin_alike_are_named_whole(tmp_path):
    for number in range(2):
        write(tmp_path / str(number), 0, (0, 0), config={"files": "a" * 60 + str(number), "seed": 0})
    assert {one.variant[-2:] for one in recipes(loaded(tmp_path))} == {"a0", "a1"}


def test_every_start_that_does_not_count_has_a_reason(tmp_path):
    """Of 103 starts one collides whatever anyone does; of two nothing is said."""
    write(tmp_path, 0, (0, 0), config={"evaluation": {"safe": True}, "seed": 0})
    content = json.loads((tmp_path / "results.json").read_text())
    content["table"] = [row(FIRST, 0, 100) | {"starts": 103, "inevitable": 1, "marginal": 0, "unsolved": 0}]
    (tmp_path / "results.json").write_text(json.dumps(content))
    (found,) = recipes(loaded(tmp_path))
    said = denominator(found)
    assert said.startswith(
        "100 of 103 starts count; left out: 1 whose equilibrium collides, 2 for reasons that the table does not name."
    )
    assert said.endswith("They were drawn until so many were safe; those that were not are not in the table.")
