"""A certificate in words: the bounds, the confidence with which they hold, and what they rest on."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from hno.evaluation import format as text
from hno.evaluation.certificate import POINTS, SPLIT, SUBSTEPS, Bound, Certificate, Plan, Region, SafeBound
from hno.games import Game


def describe(found: Certificate, game: Game, content: Mapping[str, Any]) -> list[str]:
    """Lines for people.

    Args:
        found: the certificate.
        game: its game.
        content: `names` and `checkpoint` of the model, the `draws` that made it, and `earlier` certificates.
    """
    plan, model = found.plan, f"{content['names']['game']}, {content['checkpoint']}"
    bounds = [_every(found.every), *_safe(found.safe, game, plan), _region(found.region, plan)]
    return [
        f"{model}: N = {plan.tests:,} tests, seed {plan.seed}, beta = {plan.beta:g}. The probability of collision is",
        *(f"  {bound}" for bound in bounds),
        *_confidence(found, len(content["earlier"])),
        "Assumed:",
        *(f"  {one}" for one in assumptions(plan, game, content["draws"])),
    ]  # fmt: skip


def _every(found: Bound) -> str:
    return f"at most {text.percent(found.bound)} over all starts: {found.collisions:,} of {found.tests:,} collide"


def _safe(found: SafeBound | None, game: Game, plan: Plan) -> list[str]:
    if found is None:
        return []
    keeps = f"{found.clearance:g} {game.constraint_unit}".strip()
    counts = f"{found.collisions:,} of {plan.tests:,} tests start so and collide"
    known = f"{found.safe:,} of the first {found.solved:,} start so, {found.unsolved:,} are unsolved"
    unknown = f"{found.unsolved_collisions:,} of the unsolved collide"
    return [
        f"at most {text.percent(found.bound)} over starts whose equilibrium keeps {keeps}: {counts}; {known}",
        f"at most {text.percent(found.worst_bound)} over these if unsolved ones may be among them: {unknown}",
    ]


def _region(found: Region | None, plan: Plan) -> str:
    if found is None:
        return f"at most {text.percent(plan.target)} over no set of starts that was found"
    where = "all starts" if found.level is None else f"starts with {found.margin} >= {found.level:.6g}"
    share = f"{text.percent(found.share, 1)} of all; {found.collisions:,} of {found.tests:,} collide"
    return f"at most {text.percent(found.target)} over the region of {where}, {share}"


def _confidence(found: Certificate, made: int) -> list[str]:
    beta, number = found.plan.beta, found.statements
    said = [f"Each of these {number} holds with confidence 1 - {beta:g}, all together with 1 - {number * beta:g}."]
    if made:
        count = text.counted(made, "other certificate")
        said += [f"Here {count} were made before: for whoever picks one, beta is {made + 1} times as large."]
    return said


def assumptions(plan: Plan, game: Game, draws: Sequence[Sequence[Any]]) -> list[str]:
    """What the bounds rest on.

    Args:
        plan: what was tested.
        game: the game.
        draws: use, split and seed of every draw that made the model.
    """
    types = "types uniform in the type box" if plan.types is None else f"{len(plan.types)} types, each as likely"
    noise = f"noise of {plan.noise:g} half widths on controls" if plan.noise else "no noise"
    delay = f"controls {plan.delay} steps late" if plan.delay else "no delay"
    others = ", ".join(f"{use} ({split} {seed})" for use, split, seed in draws if seed is not None)
    unknown = ", ".join(use for use, _, seed in draws if seed is None)
    said = [
        f"starts uniform in the start box, {types}; independent, drawn by seed {plan.seed} for {SPLIT!r}",
        f"all {game.players} players play this controller in the game's own physics; {noise}, {delay}",
        f"controls held for {plan.dt:g} s, {SUBSTEPS} Runge-Kutta steps each, {POINTS} states of each are looked at",
        f"the tests did not choose the model: other seeds drew {others}",
    ]
    return said + ([f"the tests are independent of {unknown}, whose seeds nobody knows"] if unknown else [])
